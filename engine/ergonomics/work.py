"""What several methods read from a task in the same way: repetitions, doubts, refusals."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

from engine.datatypes import Lift, Provenance, RiskResult
from engine.ergonomics.base import Exposure, MethodInfo, RiskLevel
from engine.ergonomics.methods.rnle import (
    ASSUMED_FREQUENCY_PER_MIN,
    DOUBTFUL_CONDITIONS,
    FREQUENCY_WINDOW_S,
    find_child_doubts,
)

__all__ = [
    "Repetitions",
    "classify",
    "combine_lifts",
    "find_child_doubts",
    "list_doubts",
    "read_lifts",
    "read_repetitions",
    "refuse",
]

ASSUMED_DURATION_H = 1.0
DEMANDING_PER_DAY = 480.0
"""One lift a minute through a day of 8 h: shows what an assumption of rare lifting hides."""


@dataclass(frozen=True)
class Repetitions:
    """How often a day the observed work is done, all its lifts together."""

    frequency_per_min: float
    duration_h: float
    frequency_from: Provenance
    duration_from: Provenance
    assumptions: tuple[str, ...] = ()

    @property
    def per_day(self) -> float:
        """Lifts a day."""
        return 60.0 * self.frequency_per_min * self.duration_h

    @property
    def demanding_per_day(self) -> float:
        """Lifts on a hard day, where the real number is not known; else NaN."""
        is_assumed = Provenance.ASSUMED in (self.frequency_from, self.duration_from)
        return max(DEMANDING_PER_DAY, self.per_day) if is_assumed else math.nan


def read_repetitions(exposure: Exposure) -> Repetitions:
    """Read, count or assume how often the work is done.

    The rate is the user's; without it, counted where at least 15 min were watched; else rare
    lifting is assumed, the most favourable case, and stated.
    """
    task = exposure.task
    notes: list[str] = []
    frequency, frequency_from = task.frequency_per_min, Provenance.USER
    if frequency is None and exposure.observed_s >= FREQUENCY_WINDOW_S:
        frequency = len(exposure.lifts) / (exposure.observed_s / 60.0)
        frequency_from = Provenance.DERIVED
    if frequency is None:
        frequency, frequency_from = ASSUMED_FREQUENCY_PER_MIN, Provenance.ASSUMED
        notes.append(
            f"Lifting frequency not given: {frequency:g} lifts per minute assumed, a favourable "
            "case."
        )
    duration, duration_from = task.duration_h, Provenance.USER
    if duration is None:
        duration, duration_from = ASSUMED_DURATION_H, Provenance.ASSUMED
        notes.append(f"Duration not given: {duration:g} h a day assumed, a favourable case.")
    return Repetitions(frequency, duration, frequency_from, duration_from, tuple(notes))


def read_lifts(exposure: Exposure) -> tuple[Lift, ...]:
    """Return the lifts in as many hands as the user says, or, left unsaid, as were seen."""
    hands = exposure.task.hands
    if hands is None:
        return exposure.lifts
    return tuple(replace(lift, hands=hands) for lift in exposure.lifts)


def list_doubts(exposure: Exposure, lift: Lift | None = None) -> list[str]:
    """List in plain words the conditions of the clip (and of a lift) that raise doubts."""
    keys = (*exposure.conditions, *(lift.notes if lift else ()))
    doubts = [DOUBTFUL_CONDITIONS[key] for key in keys if key in DOUBTFUL_CONDITIONS]
    return list(dict.fromkeys([*doubts, *find_child_doubts(exposure.subject)]))


def classify(levels: Sequence[RiskLevel], value: float) -> RiskLevel | None:
    """Return the level of a value; None where it is not known."""
    return next((level for level in levels if value <= level.upper), None)


def refuse(info: MethodInfo, *reasons: str, steps: tuple[str, ...] = ()) -> RiskResult:
    """Return the result of a method that can't be used, and why.

    Its only steps are the checks that failed.
    """
    return RiskResult(
        method=info.name,
        value=math.nan,
        category="not applicable",
        reference=info.reference,
        is_applicable=False,
        reasons=tuple(dict.fromkeys(reasons)),
        steps=steps or tuple(f"Checked: {reason}" for reason in dict.fromkeys(reasons)),
    )


def combine_lifts(info: MethodInfo, results: Sequence[RiskResult]) -> RiskResult:
    """Return the result of a trial: that of the worst lift, with every lift's own beside it."""
    assessed = [result for result in results if result.is_applicable]
    if not assessed:
        reasons = [reason for result in results for reason in result.reasons]
        whole = refuse(info, *(reasons or ["no lift was found in the video"]))
        return replace(whole, per_lift=tuple(results))
    worst = max(assessed, key=lambda r: -math.inf if math.isnan(r.value) else r.value)
    skipped = tuple(
        f"Lift {r.lift_index + 1} was not assessed: {'; '.join(r.reasons)}."
        for r in results
        if not r.is_applicable and r.lift_index is not None
    )
    summary = {
        "governing_lift": worst.lift_index,
        "n_lifts": len(results),
        "n_assessed": len(assessed),
    }
    return replace(
        worst,
        lift_index=None,
        per_lift=tuple(results),
        reasons=(*worst.reasons, *skipped),
        details={**worst.details, **summary},
    )
