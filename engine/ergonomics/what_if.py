"""What a change of the work would do: a measured lift, judged again as if it were done otherwise.

A change names new places of the hands, another load, rate, duration, grip. The places enter the
methods as they are given; the posture that goes with them was not filmed and is posed by
`engine.ergonomics.repose`. Everything that no longer comes from the video is marked as assumed.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, fields, replace
from functools import lru_cache
from typing import Any, Literal

from engine.datatypes import (
    Coupling,
    Lift,
    LiftEnd,
    Measurement,
    Provenance,
    RiskInput,
    RiskResult,
    Task,
    parse_coupling,
)
from engine.ergonomics.base import Exposure, RiskMethod, select_methods
from engine.ergonomics.methods.rnle import FREQUENCY_WINDOW_S
from engine.ergonomics.repose import HandShift, repose_lift
from engine.errors import ConfigError

__all__ = ["Change", "Changed", "apply_change", "focus_on_lift", "what_if"]

SET_SIGMA_CM, SET_SIGMA_DEG = 2.0, 5.0
"""Standard error of a place that is arranged instead of measured: people stand as they like."""
PLACE_LIMITS: Mapping[str, tuple[float, float, str]] = {
    "H_cm": (0.0, 150.0, "cm"),
    "V_cm": (0.0, 250.0, "cm"),
    "A_deg": (0.0, 180.0, "degrees"),
}
OUT_OF_REACH_M = 0.05
"""Hands that stay further from their place than this can't reach it from where the feet are."""

PLACES_ONLY = frozenset({"rnle", "rnle_job", "rnle_vli", "iso11228", "acgih", "lm_mmh"})
"""Methods that read where the hands are, but not how the body stands."""
POSTURE_NOTE = (
    "The changed posture was not filmed. It is posed from the measured lift: every frame takes the "
    "posture of the moment when the hands were nearest to their new place, and arms, trunk and "
    "hips share what is left; the feet stay. Times are as measured."
)
AS_MEASURED_NOTE = "What the change does not name is as measured."
NO_DYNAMIC_NOTE = "With accelerations: not told, since the changed movement was not filmed"

Place = Literal["H_cm", "V_cm", "A_deg"]
ENDS: tuple[Literal["origin", "destination"], ...] = ("origin", "destination")
TASK_FIELDS = tuple(f.name for f in fields(Task) if f.name != "notes")
"""What a change can name of the work."""


@dataclass(frozen=True)
class Change:
    """What would be done otherwise; None leaves a thing as it was measured or told.

    `origin_H_cm` and the like are the new horizontal distance mid-ankle to mid-hands, height above
    the floor and asymmetry angle at either end; the vertical travel follows from the heights. The
    others are those of `Task`. `lift_index` (from 0) tells which lift is moved, None: every one.
    """

    origin_H_cm: float | None = None
    origin_V_cm: float | None = None
    origin_A_deg: float | None = None
    destination_H_cm: float | None = None
    destination_V_cm: float | None = None
    destination_A_deg: float | None = None
    load_kg: float | None = None
    hands: Literal[1, 2] | None = None
    coupling: Coupling | None = None
    frequency_per_min: float | None = None
    duration_h: float | None = None
    recovery_h: float | None = None
    destination_control: bool | None = None
    lift_index: int | None = None

    def __post_init__(self) -> None:
        for end in ENDS:
            for place, (low, high, unit) in PLACE_LIMITS.items():
                value = self.place(end, place)
                if value is not None and not low <= value <= high:
                    raise ConfigError(
                        f"{end.capitalize()} {place[0]} must lie between {low:g} and {high:g} "
                        f"{unit}, got {value:g}; correct it."
                    )
        if self.coupling is not None:
            object.__setattr__(self, "coupling", parse_coupling(self.coupling))
        self.apply_to_task(Task())  # checks the rest as a task is checked

    @classmethod
    def at(cls, end: str, **places: float) -> Change:
        """Return a change of the places at one end: ``Change.at("origin", V_cm=76.0)``."""
        values: dict[str, Any] = {f"{end}_{place}": value for place, value in places.items()}
        return cls(**values)

    def place(self, end: str, place: str) -> float | None:
        """Return the new place of the hands at one end; None where it stays."""
        value: float | None = getattr(self, f"{end}_{place}")
        return value

    def apply_to_task(self, task: Task) -> Task:
        """Return the work with what is changed of it."""
        given = {name: getattr(self, name) for name in TASK_FIELDS}
        return replace(task, **{name: v for name, v in given.items() if v is not None})

    @property
    def moves_hands(self) -> bool:
        """Whether distance, height or angle of the hands changes at an end."""
        return any(self.place(end, place) is not None for end in ENDS for place in PLACE_LIMITS)

    @property
    def is_none(self) -> bool:
        """Whether nothing is changed."""
        return all(getattr(self, f.name) is None for f in fields(self) if f.name != "lift_index")

    def merge(self, other: Change) -> Change | None:
        """Return both changes together; None where they change the same thing."""
        values: dict[str, Any] = {}
        for name in (f.name for f in fields(self)):
            one, two = getattr(self, name), getattr(other, name)
            if name != "lift_index" and one is not None and two is not None:
                return None
            values[name] = two if one is None else one
        return Change(**values)


@dataclass(frozen=True, eq=False)
class Changed:
    """An exposure after a change.

    `is_posed` tells whether any frame is posed instead of filmed; `notes` say what can't be told
    or reached, `unreached_m` how far the hands stay from their place at the worst.
    """

    exposure: Exposure
    is_posed: bool = False
    unreached_m: float = 0.0
    notes: tuple[str, ...] = ()


def focus_on_lift(exposure: Exposure, index: int) -> Exposure:
    """Return the exposure with one lift only, at the rate of all lifts together.

    Raises
    ------
    ConfigError
        If there is no such lift.
    """
    _check_index(exposure, index)
    task = exposure.task
    if task.frequency_per_min is None and exposure.observed_s >= FREQUENCY_WINDOW_S:
        counted = len(exposure.lifts) / (exposure.observed_s / 60.0)
        task = replace(task, frequency_per_min=counted)
    return replace(exposure, lifts=(exposure.lifts[index],), task=task)


def _check_index(exposure: Exposure, index: int) -> None:
    if not 0 <= index < len(exposure.lifts):
        raise ConfigError(
            f"There are {len(exposure.lifts)} lifts in this trial, but lift {index + 1} was asked "
            "for; choose one of them."
        )


def apply_change(exposure: Exposure, change: Change) -> Changed:
    """Return what the methods would have judged, had the work been done otherwise.

    Parameters
    ----------
    exposure
        As measured.
    change
        What is different.

    Returns
    -------
    Changed
        With the lifts, track and angles of the changed work.

    Raises
    ------
    ConfigError
        If the change names a lift that is not there.
    """
    if change.lift_index is not None:
        _check_index(exposure, change.lift_index)
    changed = replace(exposure, task=change.apply_to_task(exposure.task))
    if not change.moves_hands:
        return Changed(changed)
    lifts = list(exposure.lifts)
    chosen = range(len(lifts)) if change.lift_index is None else (change.lift_index,)
    posed, unreached, notes = False, 0.0, []
    for k in chosen:
        before, lifts[k] = lifts[k], _move_lift(lifts[k], change)
        shifts = [_shift_of(getattr(before, end), getattr(lifts[k], end)) for end in ENDS]
        if None in shifts:
            notes.append(
                f"Lift {k + 1}: hands or feet were not measured where they are moved from, so that "
                "the posture stays as measured."
            )
        origin, destination = (shift or HandShift() for shift in shifts)
        if origin.is_none and destination.is_none:
            continue
        found = repose_lift(
            changed.track, changed.angles, before, origin=origin, destination=destination
        )
        changed = replace(changed, track=found.track, angles=found.angles)
        posed |= bool(found.is_posed.any())
        unreached = max(unreached, found.unreached_m)
    if unreached > OUT_OF_REACH_M:
        notes.append(
            f"The hands stay {100 * unreached:.0f} cm from their new place: it is out of reach "
            "from where the feet are."
        )
    return Changed(replace(changed, lifts=tuple(lifts)), posed, unreached, tuple(notes))


def _move_lift(lift: Lift, change: Change) -> Lift:
    origin, destination = (_move_end(getattr(lift, end), change, end) for end in ENDS)
    travel = _travel(lift, origin, destination)
    return replace(lift, origin=origin, destination=destination, D_cm=travel)


def _move_end(end: LiftEnd, change: Change, name: str) -> LiftEnd:
    moved: dict[str, Any] = {}
    for place in PLACE_LIMITS:
        value = change.place(name, place)
        if value is not None:
            sigma = SET_SIGMA_DEG if place == "A_deg" else SET_SIGMA_CM
            moved[place] = Measurement(value, sigma)
    return replace(end, **moved)


def _travel(lift: Lift, origin: LiftEnd, destination: LiftEnd) -> Measurement:
    """Return the vertical travel; where it was measured a little off the heights, it stays so."""
    is_same = origin.V_cm == lift.origin.V_cm and destination.V_cm == lift.destination.V_cm
    if is_same or origin.V_cm.is_missing or destination.V_cm.is_missing:
        return lift.D_cm
    measured = lift.D_cm.value - abs(lift.destination.V_cm.value - lift.origin.V_cm.value)
    kept = measured if math.isfinite(measured) else 0.0
    travel = max(0.0, abs(destination.V_cm.value - origin.V_cm.value) + kept)
    return Measurement(travel, math.hypot(origin.V_cm.sigma, destination.V_cm.sigma))


def _shift_of(before: LiftEnd, after: LiftEnd) -> HandShift | None:
    """Return by how much the hands move; None where it is not known from where."""
    if before == after:
        return HandShift()
    away = (after.H_cm.value - before.H_cm.value) / 100.0
    up = (after.V_cm.value - before.V_cm.value) / 100.0
    if before.H_cm.is_missing and after.H_cm.is_missing:
        away = 0.0
    if not (math.isfinite(away) and math.isfinite(up)):
        return None
    return HandShift(away, up)


# --------------------------------------------------------------------------- all methods


def what_if(
    exposure: Exposure,
    change: Change,
    *,
    methods: tuple[str, ...] = (),
    frames: bool = True,
    experimental: bool = False,
) -> dict[str, RiskResult]:
    """Judge a measured exposure as if the work were done otherwise.

    Parameters
    ----------
    exposure
        As measured.
    change
        What would be different.
    methods
        Keys of methods; empty for all that may run.
    frames
        Whether methods that score every frame (REBA, RULA, OWAS, posture zones) run as well; they
        take most of the time.
    experimental
        Whether methods that were not checked against their publication may run.

    Returns
    -------
    dict
        One result per method, by its key. Inputs that no longer come from the video have the
        provenance `assumed`; the first steps and reasons say what was changed and how the
        posture was found.

    Raises
    ------
    ConfigError
        If the change names a lift that is not there, or a method is unknown.
    """
    found = apply_change(exposure, change)
    chosen = select_methods(methods, experimental=experimental)
    return {
        method.info.name: _mark(method.assess(found.exposure), exposure, change, found)
        for method in chosen
        if frames or not scores_frames(method)
    }


def scores_frames(method: RiskMethod) -> bool:
    """Whether a method scores every frame, not lifts."""
    return hasattr(method, "frame_levels")


def _mark(result: RiskResult, exposure: Exposure, change: Change, found: Changed) -> RiskResult:
    """Say in a result what was changed, and what is assumed for it."""
    if change.is_none:
        return result
    reads_posture = found.is_posed and result.method not in PLACES_ONLY
    touched = _changed_inputs(change)
    notes = [POSTURE_NOTE if reads_posture else AS_MEASURED_NOTE, *found.notes]
    steps = (f"What if: {'; '.join(describe_change(exposure, change))}", *result.steps)
    marked = replace(
        result,
        inputs=tuple(_mark_input(item, touched, is_posed=reads_posture) for item in result.inputs),
        steps=steps if result.is_applicable else result.steps,
        reasons=(*notes, *result.reasons),
        details={**result.details, "is_what_if": True},
        per_lift=tuple(_mark(part, exposure, change, found) for part in result.per_lift),
    )
    return _drop_dynamic(marked) if reads_posture and "dynamic" in result.details else marked


def _mark_input(item: RiskInput, touched: frozenset[str], *, is_posed: bool) -> RiskInput:
    is_seen = item.provenance in (Provenance.MEASURED, Provenance.DERIVED)
    if item.name in touched or (is_posed and is_seen):
        return replace(item, provenance=Provenance.ASSUMED)
    return item


@lru_cache(maxsize=8)
def _changed_inputs(change: Change) -> frozenset[str]:
    """Return what the methods call the inputs that a change touches."""
    names = {
        f"{place[0]} at {end}"
        for end in ENDS
        for place in PLACE_LIMITS
        if change.place(end, place) is not None
    }
    if any(name.startswith("V") for name in names):
        names.add("D")
    if any(name.startswith("H") for name in names):
        names.add("H, larger of both ends")
    called = {
        "load_kg": ("load", "load on this arm"),
        "hands": ("hands",),
        "coupling": ("coupling",),
        "frequency_per_min": ("frequency", "frequency, all lifts"),
        "duration_h": ("duration", "duration class"),
        "recovery_h": ("duration class",),
        "destination_control": ("significant control",),
    }
    names |= {n for f, given in called.items() if getattr(change, f) is not None for n in given}
    return frozenset(names)


def _drop_dynamic(result: RiskResult) -> RiskResult:
    """Take out what needs accelerations: those of a posed movement mean nothing."""
    details = dict(result.details)
    details["dynamic"] = dict.fromkeys(details["dynamic"], math.nan)
    details["dynamic_peak_s"] = math.nan
    said = [d for d in details.get("doubts", ()) if not d.startswith("with accelerations")]
    dropped = set(details.get("doubts", ())) - set(said)
    details["doubts"] = said
    return replace(
        result,
        details=details,
        steps=tuple(
            NO_DYNAMIC_NOTE if step.startswith("With accelerations") else step
            for step in result.steps
        ),
        reasons=tuple(reason for reason in result.reasons if reason not in dropped),
    )


# --------------------------------------------------------------------------- words

_PLACE_WORDS: Mapping[str, tuple[str, str]] = {
    "H_cm": ("distance", "cm"),
    "V_cm": ("height", "cm"),
    "A_deg": ("angle to the side", "deg"),
}
_TASK_WORDS: Mapping[str, tuple[str, str]] = {
    "load_kg": ("load", "kg"),
    "hands": ("hands", ""),
    "coupling": ("grip", ""),
    "frequency_per_min": ("frequency", "per minute"),
    "duration_h": ("duration", "h"),
    "recovery_h": ("recovery", "h"),
    "destination_control": ("placed with care", ""),
}


def describe_change(exposure: Exposure, change: Change) -> tuple[str, ...]:
    """Say what a change replaces, one phrase a thing: `origin height 76 cm instead of 19 cm`."""
    return (*_describe_places(exposure, change), *_describe_task(exposure.task, change))


def _describe_places(exposure: Exposure, change: Change) -> Iterator[str]:
    index = change.lift_index
    lift = None
    if len(exposure.lifts) == 1:
        lift = exposure.lifts[0]
    elif index is not None:
        lift = exposure.lifts[index]
    for end in ENDS:
        for place, (word, unit) in _PLACE_WORDS.items():
            value = change.place(end, place)
            if value is None:
                continue
            before = math.nan if lift is None else getattr(getattr(lift, end), place).value
            instead = "" if math.isnan(before) else f" instead of {before:.0f} {unit}"
            which = f"lift {index + 1}, " if index is not None and len(exposure.lifts) > 1 else ""
            yield f"{which}{end} {word} {value:.0f} {unit}{instead}"


def _describe_task(task: Task, change: Change) -> Iterator[str]:
    for name, (word, unit) in _TASK_WORDS.items():
        value = getattr(change, name)
        if value is not None:
            before = getattr(task, name)
            instead = "" if before is None else f" instead of {_write(before, unit)}"
            yield f"{word} {_write(value, unit)}{instead}"


def _write(value: float | bool | Coupling, unit: str) -> str:
    if isinstance(value, bool):
        return "yes" if value else "no"
    text = str(value) if isinstance(value, str) else f"{value:.3g}"
    return f"{text} {unit}".strip()
