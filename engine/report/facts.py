"""What a report needs to know of a stored result; nothing is computed that was not assessed.

Free-form parts of a result (`details` of a method) are read with care: what is missing or of
another kind becomes NaN, which the reports show as "not measured".
"""

from __future__ import annotations

import functools
import hashlib
import json
import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from typing import Any

import numpy as np

from engine.datatypes import Flag, FlagLevel, Lift, Measurement, RiskResult
from engine.ergonomics.base import MethodInfo, list_methods
from engine.storage.results import StoredResult

__all__ = [
    "EQUATION",
    "FACTORS",
    "URGENCY",
    "ChangeFacts",
    "EndFacts",
    "EquationFacts",
    "LiftFacts",
    "MethodFacts",
    "Moment",
    "TrialFacts",
    "choose_index_digits",
    "fingerprint",
    "read_facts",
    "typeset",
]

EQUATION = "rnle"
REPEATS_EQUATION = "rnle_job"
"""With one lift the index of the job is that lift's own index: no row of its own."""
FACTORS = ("HM", "VM", "DM", "AM", "FM", "CM")
URGENCY = (FlagLevel.HIGH, FlagLevel.REVIEW, FlagLevel.OK)
FINGERPRINT_LENGTH = 12
UNITS = re.compile(r"(?<=\d) (kN|N|kg|cm|m/s|s|%)(?!\w)")
"""A line must not break between a number and its unit."""
DEGREES = re.compile(r"(?<=\d) deg(rees)?\b")


@dataclass(frozen=True)
class Moment:
    """When the picture is taken: seconds in the trial, and what is worst then."""

    time_s: float
    what: str


@dataclass(frozen=True)
class MethodFacts:
    """One line of the table of methods; `digits` keep the value on its side of the limits."""

    name: str
    value: float
    unit: str
    digits: int
    interval: tuple[float, float]
    level: FlagLevel | None
    category: str
    is_applicable: bool
    reasons: tuple[str, ...]


@dataclass(frozen=True)
class ChangeFacts:
    """One thing to change, with what it would do by the first of the methods that ask for it.

    Without methods it was tried out on the measured lift (`engine.report.ranking`).
    `lift_number` (from 1) says for which lift, None for the whole trial.
    """

    text: str
    methods: tuple[str, ...]
    lift_number: int | None = None

    @property
    def action(self) -> str:
        """What to do, without its effect: the same for trials that need the same."""
        return self.text.split(":", 1)[0].strip()


@dataclass(frozen=True)
class EndFacts:
    """One end of the lift in the lifting equation."""

    H_cm: Measurement
    V_cm: Measurement
    A_deg: Measurement
    multipliers: Mapping[str, float]
    rwl_kg: float
    lifting_index: float
    is_counted: bool
    governs: bool


@dataclass(frozen=True)
class EquationFacts:
    """The lifting equation of the worst lift; the intervals are about 95 %."""

    lift_number: int
    value: float
    interval: tuple[float, float]
    rwl_kg: float
    rwl_interval_kg: tuple[float, float]
    category: str
    origin: EndFacts
    destination: EndFacts
    D_cm: Measurement
    frequency_per_min: float
    duration_class: str
    coupling: str
    reasons: tuple[str, ...]
    reference: str


@dataclass(frozen=True)
class LiftFacts:
    """One lift: its number from 1, its level (the worst flag about it) and its lifting index."""

    number: int
    level: FlagLevel | None
    lifting_index: float
    interval: tuple[float, float]


@dataclass(frozen=True, eq=False)
class TrialFacts:
    """What reports say of one trial.

    `index` is the lifting index (NaN where there is none, perhaps infinite), `limit_kg` the
    recommended weight limit. `refused` says why the equation must not be used, empty otherwise.
    """

    stored: StoredResult
    label: str
    site: str
    job: str
    person: str
    created: datetime | None
    flags: tuple[Flag, ...]
    level: FlagLevel | None
    index: float
    index_interval: tuple[float, float]
    index_category: str
    limit_kg: float
    limit_interval_kg: tuple[float, float]
    equation: EquationFacts | None
    refused: tuple[str, ...]
    methods: tuple[MethodFacts, ...]
    lifts: tuple[LiftFacts, ...]
    changes: tuple[ChangeFacts, ...]
    moment: Moment | None
    coverage: Mapping[str, float]
    warnings: tuple[str, ...]

    def count(self, level: FlagLevel) -> int:
        """Return how many flags have a level."""
        return sum(flag.level is level for flag in self.flags)


def read_facts(stored: StoredResult) -> TrialFacts:
    """Collect what reports say of a stored result."""
    document = stored.document
    flags = tuple(sorted(stored.flags, key=lambda flag: URGENCY.index(flag.level)))
    risk = stored.risk.get(EQUATION)
    governing = None if risk is None else _governing_part(risk)
    is_used = risk is not None and risk.is_applicable
    return TrialFacts(
        stored=stored,
        label=_text(document.get("label")),
        site=_text(document.get("site")),
        job=_text(document.get("job")),
        person=stored.subject.label,
        created=parse_time(document.get("created")),
        flags=flags,
        level=_worst_level(flags),
        index=risk.value if risk is not None and is_used else math.nan,
        index_interval=risk.interval if risk is not None and is_used else (math.nan, math.nan),
        index_category=risk.category if risk is not None else "",
        limit_kg=_number(governing.details, "rwl_kg") if governing and is_used else math.nan,
        limit_interval_kg=_pair(governing.details, "rwl_interval_kg")
        if governing and is_used
        else (math.nan, math.nan),
        equation=_read_equation(governing, stored.lifts) if is_used and governing else None,
        refused=() if risk is None or is_used else risk.reasons,
        methods=tuple(_read_methods(stored.risk, flags)),
        lifts=tuple(_read_lifts(stored, flags)),
        changes=_list_changes(flags, governing.lift_index if governing else None),
        moment=_find_moment(stored, flags),
        coverage={
            key: _number(document.get("coverage", {}), key)
            for key in ("measured", "repaired", "filled", "missing")
        },
        warnings=stored.warnings,
    )


def typeset(text: str) -> str:
    """Return the plain arithmetic of stored text with its true signs."""
    text = text.replace(" -> ", " → ").replace(" x ", " × ").replace("(x ", "(×\u00a0")
    text = DEGREES.sub("°", text.replace(" - ", " − "))
    return UNITS.sub("\u00a0\\1", text)


def parse_time(text: Any) -> datetime | None:
    """Return an ISO time; None where it can't be read. Without a zone it counts as UTC."""
    try:
        moment = datetime.fromisoformat(text)
        return moment.replace(tzinfo=moment.tzinfo or UTC).astimezone(UTC)
    except (TypeError, ValueError, OverflowError):
        return None


def fingerprint(values: Any) -> str:
    """Return a short hash of settings, the same for the same values in any order."""
    text = json.dumps(values, sort_keys=True, default=str)
    return hashlib.sha256(text.encode()).hexdigest()[:FINGERPRINT_LENGTH]


def _text(value: Any) -> str:
    return value.strip() if isinstance(value, str) else ""


def _number(values: Any, key: str) -> float:
    """Return a number of free-form values, NaN where there is none."""
    value = values.get(key) if isinstance(values, Mapping) else None
    is_number = isinstance(value, int | float) and not isinstance(value, bool)
    return float(value) if is_number else math.nan  # type: ignore[arg-type]


def _pair(values: Any, key: str) -> tuple[float, float]:
    pair = values.get(key) if isinstance(values, Mapping) else None
    if not isinstance(pair, Sequence) or isinstance(pair, str) or len(pair) != 2:
        return math.nan, math.nan
    low, high = ({"end": end} for end in pair)
    return _number(low, "end"), _number(high, "end")


# --------------------------------------------------------------------------- flags and lifts


def _worst_level(flags: Sequence[Flag]) -> FlagLevel | None:
    return min((flag.level for flag in flags), key=URGENCY.index, default=None)


def _list_changes(flags: Sequence[Flag], worst_lift: int | None) -> tuple[ChangeFacts, ...]:
    """Return what to change, most urgent first; methods that ask for the same are named with it.

    Where several lifts need the same, its effect on the worst one is told.
    """
    changes: dict[str, ChangeFacts] = {}
    for flag in flags:
        if not flag.change.strip() or flag.level is FlagLevel.OK:
            continue
        lift_number = None if flag.lift_index is None else flag.lift_index + 1
        change = ChangeFacts(flag.change.strip(), (flag.method,), lift_number)
        earlier = changes.get(change.action)
        if earlier is None:
            changes[change.action] = change
        elif flag.method not in earlier.methods:
            merged = (*earlier.methods, flag.method)
            changes[change.action] = replace(earlier, methods=merged)
        elif earlier.methods[0] == flag.method and flag.lift_index == worst_lift:
            changes[change.action] = replace(change, methods=earlier.methods)
    return tuple(changes.values())


def _read_lifts(stored: StoredResult, flags: Sequence[Flag]) -> list[LiftFacts]:
    risk = stored.risk.get(EQUATION)
    parts = {} if risk is None else {part.lift_index: part for part in risk.per_lift}
    lifts = []
    for index in range(len(stored.lifts)):
        part = parts.get(index)
        is_used = part is not None and part.is_applicable
        lifts.append(
            LiftFacts(
                number=index + 1,
                level=_worst_level([flag for flag in flags if flag.lift_index == index]),
                lifting_index=part.value if part and is_used else math.nan,
                interval=part.interval if part and is_used else (math.nan, math.nan),
            )
        )
    return lifts


def _find_moment(stored: StoredResult, flags: Sequence[Flag]) -> Moment | None:
    """Return when the most urgent flag that has a time is at its worst."""
    for flag in flags:
        time_s = _find_peak(stored, flag)
        if math.isfinite(time_s):
            return Moment(time_s, typeset(flag.what))
    names = stored.angles.names
    if "trunk_inclination" in names and np.isfinite(stored.angles["trunk_inclination"]).any():
        curve = stored.angles["trunk_inclination"]
        return Moment(float(stored.angles.time_s[np.nanargmax(curve)]), "largest forward bend")
    return None


def _find_peak(stored: StoredResult, flag: Flag) -> float:
    risk = stored.risk.get(flag.method)
    if risk is None:
        return flag.start_s
    part = next((p for p in risk.per_lift if p.lift_index == flag.lift_index), risk)
    moments = part.details.get("worst_moments")
    if isinstance(moments, Sequence) and not isinstance(moments, str) and moments:
        return _number(moments[0], "peak_s")
    index = flag.lift_index
    if index is None or not 0 <= index < len(stored.lifts):
        return flag.start_s
    peak_s = _number(part.details, "peak_s")
    if math.isfinite(peak_s):
        return peak_s
    lift = stored.lifts[index]
    is_end = part.details.get("governing_end") == "destination"
    return (lift.destination if is_end else lift.origin).time_s


# --------------------------------------------------------------------------- methods


@functools.cache
def _method_infos() -> Mapping[str, MethodInfo]:
    return {method.info.name: method.info for method in list_methods()}


def _read_methods(risk: Mapping[str, RiskResult], flags: Sequence[Flag]) -> list[MethodFacts]:
    """Return every method but the lifting equation, most urgent first, unusable ones last."""
    equation = risk.get(EQUATION)
    rows = [
        _read_method(name, result, flags)
        for name, result in risk.items()
        if name != EQUATION
        and not (name == REPEATS_EQUATION and equation and _same(equation.value, result.value))
    ]
    order: dict[FlagLevel | None, int] = {level: i for i, level in enumerate(URGENCY)}
    return sorted(rows, key=lambda row: (not row.is_applicable, order.get(row.level, 3), row.name))


def _same(a: float, b: float) -> bool:
    # The same factors in another order differ in the last bit.
    return math.isclose(a, b, rel_tol=1e-9) or (math.isnan(a) and math.isnan(b))


def _read_method(name: str, result: RiskResult, flags: Sequence[Flag]) -> MethodFacts:
    info = _method_infos().get(name)
    level = _worst_level([flag for flag in flags if flag.method == name])
    return MethodFacts(
        name=name,
        value=result.value,
        unit=result.unit,
        digits=_choose_digits(result.value, info),
        interval=result.interval,
        level=level if result.is_applicable else None,
        category=result.category,
        is_applicable=result.is_applicable,
        reasons=result.reasons,
    )


def _choose_digits(value: float, info: MethodInfo | None) -> int:
    """Return as few decimals as keep the value in its band."""
    if info is not None and info.decimals is not None:
        return info.decimals
    if not math.isfinite(value):
        return 1
    bounds = [level.upper for level in info.levels[:-1]] if info is not None else []
    for digits in (1, 2, 3):
        shown = float(f"{value:.{digits}f}")
        if all((shown > bound) == (value > bound) for bound in bounds):
            return digits
    return 4


def choose_index_digits(value: float) -> int:
    """Return the decimals of a lifting index: one, more where it lies close to a limit."""
    return _choose_digits(value, _method_infos().get(EQUATION))


# --------------------------------------------------------------------------- lifting equation


def _governing_part(risk: RiskResult) -> RiskResult:
    """Return the lift that the headline is about."""
    number = _number(risk.details, "governing_lift")
    if math.isfinite(number):
        for part in risk.per_lift:
            if part.lift_index == int(number):
                return part
    for part in risk.per_lift:
        if _same(part.value, risk.value):
            return part
    return risk


def _read_equation(part: RiskResult, lifts: Sequence[Lift]) -> EquationFacts | None:
    index = part.lift_index if part.lift_index is not None else 0
    if not 0 <= index < len(lifts):
        return None
    lift, details = lifts[index], part.details
    return EquationFacts(
        lift_number=index + 1,
        value=part.value,
        interval=part.interval,
        rwl_kg=_number(details, "rwl_kg"),
        rwl_interval_kg=_pair(details, "rwl_interval_kg"),
        category=part.category,
        origin=_read_end(lift, details, "origin"),
        destination=_read_end(lift, details, "destination"),
        D_cm=lift.D_cm,
        frequency_per_min=_number(details, "frequency_per_min"),
        duration_class=_text(details.get("duration_class")),
        coupling=_text(details.get("coupling")),
        reasons=part.reasons,
        reference=part.reference,
    )


def _read_end(lift: Lift, details: Mapping[str, Any], name: str) -> EndFacts:
    end = lift.origin if name == "origin" else lift.destination
    values = details.get(name, {})
    counted = details.get("counted_ends", ())
    return EndFacts(
        H_cm=end.H_cm,
        V_cm=end.V_cm,
        A_deg=end.A_deg,
        multipliers={factor: _number(values, factor) for factor in FACTORS},
        rwl_kg=_number(values, "RWL_kg"),
        lifting_index=_number(values, "LI"),
        is_counted=isinstance(counted, Sequence) and name in counted,
        governs=details.get("governing_end") == name,
    )
