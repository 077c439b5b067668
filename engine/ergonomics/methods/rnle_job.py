"""The composite lifting index of a job: all lifts of a trial together.

Every measured lift is a task of the job (or, repeated, a share of one: the sum is the same). The
equation and its refusals are those of `rnle`; `engine.ergonomics.lifting_job` adds them up.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

from engine.datatypes import Provenance, RiskInput, RiskResult
from engine.ergonomics.base import Exposure, MethodInfo
from engine.ergonomics.lifting_equation import METRIC, Duration
from engine.ergonomics.lifting_job import CompositeIndex, LiftingTask, compute_cli
from engine.ergonomics.methods.rnle import (
    ASSUMED_FREQUENCY_PER_MIN,
    FREQUENCY_WINDOW_S,
    LEVELS,
    classify,
)
from engine.ergonomics.methods.rnle import METHOD as RNLE
from engine.ergonomics.work import refuse

__all__ = ["METHOD", "count_frequency", "read_tasks"]

MULTIPLIERS_BUT_FREQUENCY = ("HM", "VM", "DM", "AM", "CM")
MANY_TASKS = 10
"""More different tasks than this are better described by the variable lifting index."""


def count_frequency(exposure: Exposure) -> float | None:
    """Count lifts per minute in the clip; None where fewer than two lifts were seen.

    A clip shorter than 15 min shows the pace of its moment, not that of the day.
    """
    if len(exposure.lifts) < 2 or not exposure.observed_s > 0:
        return None
    return len(exposure.lifts) / (exposure.observed_s / 60.0)


def _firwl(details: Mapping[str, Any], bound: int | None) -> float:
    """Return the frequency-independent limit of a lift, kg: the smaller of the ends that count."""
    multiplier = details["origin"]["FM"]
    if bound is not None and multiplier > 0:
        return float(details["rwl_interval_kg"][bound] / multiplier)
    limits = (
        METRIC.load_constant * math.prod(details[end][name] for name in MULTIPLIERS_BUT_FREQUENCY)
        for end in details["counted_ends"]
    )
    return float(min(limits))


def read_tasks(
    lifts: Sequence[RiskResult],
    frequency_per_min: float,
    load_kg: float,
    *,
    bound: int | None = None,
) -> list[LiftingTask]:
    """Make one task of every assessed lift, each with its share of the frequency.

    Parameters
    ----------
    lifts
        Results of `rnle`, applicable ones only.
    frequency_per_min
        Of all lifts together.
    load_kg
        What is lifted.
    bound
        0 or 1 to take every limit at the lower or upper end of its interval; None for its value.
    """
    return [
        LiftingTask(
            name=f"lift {(part.lift_index or 0) + 1}",
            firwl_kg=_firwl(part.details, bound),
            V_cm=part.details["origin"]["V_cm"],
            frequency_per_min=frequency_per_min / len(lifts),
            mean_load_kg=load_kg,
            max_load_kg=load_kg,
        )
        for part in lifts
    ]


class RnleJob:
    """The composite lifting index (CLI)."""

    info = MethodInfo(
        name="rnle_job",
        title="Composite lifting index of the job",
        reference="Applications Manual for the Revised NIOSH Lifting Equation, DHHS (NIOSH) "
        "94-110, revised September 2021, section 2 (multi-task) [V2]. Five bands: ISO "
        "11228-1:2021 reading, cut points [V2].",
        verification="V2",
        levels=LEVELS,
        value_name="composite lifting index",
        description="All lifts of the trial as one job: the worst lift, and what the others add "
        "by the higher rate. With one lift it equals its lifting index.",
    )

    def assess(self, exposure: Exposure) -> RiskResult:
        """Judge the job.

        Returns
        -------
        RiskResult
            `value` is the CLI. Its interval takes the errors of all lifts as common, the wide case.
        """
        frequency, source, notes, doubts = _read_frequency(exposure)
        work = replace(exposure.task, frequency_per_min=frequency)
        whole = RNLE.assess(replace(exposure, task=work))
        lifts = [part for part in whole.per_lift if part.is_applicable]
        if not lifts:
            return refuse(self.info, *whole.reasons)
        if exposure.task.load_kg is None:
            reason = "the load is not given: without it there is no index, only limits by lift"
            return refuse(self.info, reason)
        if len(lifts) < len(whole.per_lift):
            doubts.append(
                f"only {len(lifts)} of {len(whole.per_lift)} lifts could be assessed; the job's "
                "index is that of those"
            )
        duration = Duration(lifts[0].details["duration_class"])
        return self._compose(exposure, lifts, whole, frequency, source, duration, notes, doubts)

    def _compose(
        self,
        exposure: Exposure,
        lifts: Sequence[RiskResult],
        whole: RiskResult,
        frequency: float,
        source: Provenance,
        duration: Duration,
        notes: Sequence[str],
        doubts: list[str],
    ) -> RiskResult:
        load_kg = exposure.task.load_kg or 0.0
        found = compute_cli(read_tasks(lifts, frequency, load_kg), duration)
        high, low = (
            compute_cli(read_tasks(lifts, frequency, load_kg, bound=k), duration).value
            for k in (0, 1)
        )
        level = classify(found.value)
        # What the lifts have in common is said once.
        doubts += [d for part in lifts for d in part.details["doubts"]]
        doubts = list(dict.fromkeys(doubts))
        assumptions = [
            *notes,
            *(a for a in whole.details["assumptions"] if "frequency" not in a),
        ]
        return RiskResult(
            method=self.info.name,
            value=found.value,
            category="unknown" if level is None else level.name,
            inputs=_list_inputs(exposure, lifts, frequency, source),
            steps=_explain(found, frequency, duration),
            interval=(low, high),
            reference=self.info.reference,
            reasons=(*assumptions, *doubts),
            details={
                **_details(found, lifts, frequency, duration),
                "assumptions": assumptions,
                "doubts": doubts,
            },
        )


def _read_frequency(
    exposure: Exposure,
) -> tuple[float, Provenance, list[str], list[str]]:
    """Return lifts per minute, where they come from, what was assumed, and doubts."""
    if exposure.task.frequency_per_min is not None:
        return exposure.task.frequency_per_min, Provenance.USER, [], []
    counted = count_frequency(exposure)
    if counted is None:
        note = (
            f"Lifting frequency not given: at most {ASSUMED_FREQUENCY_PER_MIN:g} lifts per minute "
            "assumed, the most favourable case."
        )
        return ASSUMED_FREQUENCY_PER_MIN, Provenance.ASSUMED, [note], []
    note = (
        f"Lifting frequency not given: {counted:.1f} lifts per minute counted in "
        f"{exposure.observed_s:.0f} s of video."
    )
    if exposure.observed_s >= FREQUENCY_WINDOW_S:
        return counted, Provenance.DERIVED, [note], []
    doubt = "the pace was counted in less than 15 min, so it may not be that of the job"
    return counted, Provenance.DERIVED, [note], [doubt]


def _list_inputs(
    exposure: Exposure, lifts: Sequence[RiskResult], frequency: float, source: Provenance
) -> tuple[RiskInput, ...]:
    shared = ("load", "duration class", "coupling", "significant control")
    return (
        RiskInput("lifts in the job", float(len(lifts)), "", Provenance.MEASURED),
        RiskInput("frequency, all lifts", frequency, "1/min", source),
        *(item for item in lifts[0].inputs if item.name in shared),
    )


def _explain(found: CompositeIndex, frequency: float, duration: Duration) -> tuple[str, ...]:
    lines = [
        (
            f"{len(found.tasks)} lifts share {frequency:.3g} lifts per minute, {duration} "
            "duration; most demanding first"
        )
    ]
    for k, index in enumerate(found.tasks):
        added = "CLI starts with STLI" if k == 0 else f"adds {index.increment:.3f}"
        lines.append(
            f"{index.task.name.capitalize()}: FIRWL = {index.task.firwl_kg:.2f} kg, "
            f"FM = {index.FM:.3f}, STRWL = {index.STRWL_kg:.2f} kg, FILI = {index.FILI:.2f}, "
            f"STLI = {index.STLI:.2f}; {added}"
        )
    lines.append(f"CLI = {found.value:.2f}")
    level = classify(found.value)
    if level is not None:
        lines.append(f"Band: {level.name} ({level.meaning}); action: {level.action}")
    return tuple(lines)


def _details(
    found: CompositeIndex, lifts: Sequence[RiskResult], frequency: float, duration: Duration
) -> dict[str, Any]:
    return {
        "cli": found.value,
        "frequency_per_min": frequency,
        "duration_class": duration.value,
        "n_lifts": len(lifts),
        "has_many_tasks": len(lifts) > MANY_TASKS,
        "tasks": [
            {
                "name": index.task.name,
                "FIRWL_kg": index.task.firwl_kg,
                "FM": index.FM,
                "STRWL_kg": index.STRWL_kg,
                "FILI": index.FILI,
                "STLI": index.STLI,
                "increment": index.increment,
            }
            for index in found.tasks
        ],
    }


METHOD = RnleJob()
