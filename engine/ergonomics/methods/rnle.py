"""The Revised NIOSH Lifting Equation for single tasks, from measured lifts.

The equation itself is in `engine.ergonomics.lifting_equation`. This file decides which ends
count, what is assumed, where the equation must not be used, and how sure the answer is.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache
from typing import Any

import numpy as np

from engine.datatypes import (
    Array,
    Coupling,
    Lift,
    LiftEnd,
    Measurement,
    Provenance,
    RiskInput,
    RiskResult,
    Subject,
    Task,
)
from engine.ergonomics.base import Exposure, MethodInfo, RiskLevel
from engine.ergonomics.lifting_equation import (
    A_SLOPE,
    MAX_DURATION_H,
    METRIC,
    Duration,
    LiftCase,
    LiftPoint,
    Rwl,
    compute_case,
    compute_frequency_multiplier,
    compute_lifting_index,
    compute_rwl,
    compute_rwl_array,
    find_duration,
    repeat_session,
)
from engine.ergonomics.propagation import compute_interval, compute_shares, draw_inputs

__all__ = [
    "LEVELS",
    "METHOD",
    "NIOSH_LIMITS",
    "classify",
    "compute_rwl",
    "find_child_doubts",
    "read_case",
]

NIOSH_LIMITS = (1.0, 3.0)
"""The only two limits NIOSH itself sets: above the first some, above the second nearly all
workers are at increased risk of low-back pain."""

LEVELS: tuple[RiskLevel, ...] = (
    RiskLevel(
        "very low",
        1.0,
        "within the recommended weight limit",
        "none for healthy working adults",
    ),
    RiskLevel(
        "low",
        1.5,
        "above the recommended weight limit",
        "look at rare heavy loads and extreme postures; aim below 1.0",
    ),
    RiskLevel("moderate", 2.0, "clearly above the limit", "redesign by priority"),
    RiskLevel("high", 3.0, "far above the limit", "redesign with high priority"),
    RiskLevel("very high", math.inf, "nearly all workers at increased risk", "redesign at once"),
)
"""Five-band reading of the lifting index: name, upper bound (included), meaning, action."""

NIOSH_NOTE = (
    "NIOSH itself says only: aim for 1.0 or less; above 1.0 some workers, above 3.0 nearly all "
    "workers are at increased risk. The five bands are a later reading (ISO 11228-1:2021)."
)
HIGH_SPEED_M_S = 0.76
FREQUENCY_WINDOW_S = 15 * 60.0
ASSUMED_FREQUENCY_PER_MIN = 0.2
DEMANDING_WORK = (1.0, Duration.LONG)
"""Lifts per minute and duration used to show what the assumption of rare lifting hides."""

HOURS: Mapping[Duration, str] = {
    Duration.SHORT: "up to 1 h",
    Duration.MODERATE: "1 to 2 h",
    Duration.LONG: "2 to 8 h",
}

REFUSED_CONDITIONS: Mapping[str, str] = {
    "one_handed": "the load is lifted with one hand; the equation is for two-handed lifts",
    "seated": "the person sits; the equation is for standing lifts",
    "kneeling": "the person kneels; the equation is for standing lifts",
    "walking": "the person walks with the load; the equation is not for carrying",
}
"""Keys of `Exposure.conditions` and `Lift.notes` that rule the equation out (manual, 1.1)."""

DOUBTFUL_CONDITIONS: Mapping[str, str] = {
    "pivot": "the feet turn during the lift, so that the asymmetry angle is less certain",
    "high_speed": "the lift is faster than the equation was made for",
    "camera_moved": "the camera moved, so distances and heights are less certain than stated",
    "never_upright": "the person never stands upright in the video, so scale and floor are guesses",
    "ends_at_rest": "the movement ends with hanging arms, so it may be a rise without a load",
}


ADULT_AGE_Y = 18.0
ADULT_STATURE_M = 1.40


def find_child_doubts(subject: Subject) -> list[str]:
    """Say that a method's numbers are those of adults, where the person seems to be a child."""
    is_child = subject.age_y is not None and subject.age_y < ADULT_AGE_Y
    is_small = subject.stature_m is not None and subject.stature_m < ADULT_STATURE_M
    if not (is_child or is_small):
        return []
    return ["the method is made for adults; the person's age or stature is that of a child"]


def classify(lifting_index: float) -> RiskLevel | None:
    """Return the band of a lifting index; None where it is not known."""
    return next((level for level in LEVELS if lifting_index <= level.upper), None)


# --------------------------------------------------------------------------- the work


@dataclass(frozen=True)
class _Work:
    """What is known or assumed of the work; the same for every lift of a trial."""

    load_kg: float | None
    frequency_per_min: float
    duration: Duration
    coupling: Coupling
    control: bool | None
    provenance: Mapping[str, Provenance] = field(default_factory=dict)
    assumptions: tuple[str, ...] = ()
    refusals: tuple[str, ...] = ()
    doubts: tuple[str, ...] = ()


def _read_work(exposure: Exposure) -> _Work:
    task = exposure.task
    notes: list[str] = []
    frequency, frequency_from = _read_frequency(exposure, notes)
    duration, duration_from = _read_duration(task, notes)
    if task.coupling is None:
        notes.append("Grip not given: fair coupling assumed.")
    if task.destination_control is None:
        notes.append(
            "Not stated whether the load must be placed with care: control at the destination "
            "assumed, which is the conservative reading; both ends count."
        )
    refusals = [REFUSED_CONDITIONS[c] for c in exposure.conditions if c in REFUSED_CONDITIONS]
    if task.duration_h is not None and task.duration_h > MAX_DURATION_H:
        refusals.append(f"the work lasts {task.duration_h:g} h; the equation covers at most 8 h")
    known = {**REFUSED_CONDITIONS, **DOUBTFUL_CONDITIONS}
    doubts = [DOUBTFUL_CONDITIONS[c] for c in exposure.conditions if c in DOUBTFUL_CONDITIONS]
    doubts += [f"noted while measuring: {c}" for c in exposure.conditions if c not in known]
    doubts += find_child_doubts(exposure.subject)
    user, assumed = Provenance.USER, Provenance.ASSUMED
    return _Work(
        load_kg=task.load_kg,
        frequency_per_min=frequency,
        duration=duration,
        coupling=task.coupling or Coupling.FAIR,
        control=task.destination_control,
        provenance={
            "load": user,
            "frequency": frequency_from,
            "duration": duration_from,
            "coupling": assumed if task.coupling is None else user,
            "control": assumed if task.destination_control is None else user,
        },
        assumptions=tuple(notes),
        refusals=tuple(refusals),
        doubts=tuple(doubts),
    )


def _read_frequency(exposure: Exposure, notes: list[str]) -> tuple[float, Provenance]:
    if exposure.task.frequency_per_min is not None:
        return exposure.task.frequency_per_min, Provenance.USER
    if exposure.observed_s >= FREQUENCY_WINDOW_S:
        return len(exposure.lifts) / (exposure.observed_s / 60.0), Provenance.DERIVED
    notes.append(
        f"Lifting frequency not given: at most {ASSUMED_FREQUENCY_PER_MIN:g} lifts per minute "
        "assumed, the most favourable case."
    )
    return ASSUMED_FREQUENCY_PER_MIN, Provenance.ASSUMED


def _read_duration(task: Task, notes: list[str]) -> tuple[Duration, Provenance]:
    if task.duration_h is None:
        notes.append("Duration not given: at most 1 h of lifting assumed, the most favourable.")
        return Duration.SHORT, Provenance.ASSUMED
    if task.recovery_h is None:
        found = find_duration([(task.duration_h, math.inf)])
        if found in (Duration.SHORT, Duration.MODERATE):
            notes.append(f"Recovery time not given: enough for {found} duration assumed.")
    else:
        found = find_duration(repeat_session(task.duration_h, task.recovery_h))
    return found or Duration.LONG, Provenance.USER


# --------------------------------------------------------------------------- one lift


@dataclass(frozen=True)
class _Evaluation:
    """The equation's answer for one lift; `ends` are those that count."""

    case: LiftCase
    results: Mapping[str, Rwl]
    governing_end: str
    rwl_interval: tuple[float, float]
    shares: Mapping[str, float]

    @property
    def rwl(self) -> Rwl:
        return self.results[self.governing_end]

    @property
    def lifting_index(self) -> float:
        return compute_lifting_index(self.case.load_kg, self.rwl.RWL)

    @property
    def li_interval(self) -> tuple[float, float]:
        return _invert(self.case.load_kg, self.rwl_interval)


def _invert(load_kg: float | None, rwl: tuple[float, float]) -> tuple[float, float]:
    return compute_lifting_index(load_kg, rwl[1]), compute_lifting_index(load_kg, rwl[0])


def _is_measured(end: LiftEnd) -> bool:
    return not (end.H_cm.is_missing or end.V_cm.is_missing or end.A_deg.is_missing)


def _point(end: LiftEnd) -> LiftPoint:
    # A floor error can put the hands a little below the floor: that is the floor.
    return LiftPoint(
        H_cm=max(0.0, end.H_cm.value),
        V_cm=max(0.0, end.V_cm.value),
        A_deg=max(0.0, end.A_deg.value),
    )


def _measurements(lift: Lift, ends: Sequence[str]) -> dict[str, Measurement]:
    """Name what is measured at the given ends, and the travel."""
    items: dict[str, Measurement] = {"D": lift.D_cm}
    for name in ends:
        end: LiftEnd = getattr(lift, name)
        items |= {f"H at {name}": end.H_cm, f"V at {name}": end.V_cm, f"A at {name}": end.A_deg}
    return items


def _build_case(lift: Lift, work: _Work) -> LiftCase:
    has_destination = work.control is not False and _is_measured(lift.destination)
    return LiftCase(
        origin=_point(lift.origin),
        destination=_point(lift.destination) if has_destination else None,
        D_cm=max(0.0, lift.D_cm.value),
        frequency_per_min=work.frequency_per_min,
        duration=work.duration,
        coupling=work.coupling,
        load_kg=work.load_kg,
    )


def _evaluate(lift: Lift, work: _Work) -> _Evaluation:
    case = _build_case(lift, work)
    results = compute_case(case)
    measured = _measurements(lift, tuple(results))
    inputs = {name: replace(item, value=max(0.0, item.value)) for name, item in measured.items()}
    governing = min(results, key=lambda end: results[end].RWL)
    if not all(math.isfinite(item.sigma) for item in inputs.values()):
        unknown = dict.fromkeys(inputs, math.nan)
        return _Evaluation(case, results, governing, (math.nan, math.nan), unknown)

    interval, shares = _propagate(
        tuple(inputs.items()), tuple(results), work.frequency_per_min, work.duration, work.coupling
    )
    return _Evaluation(case, results, governing, interval, dict(shares))


@lru_cache(maxsize=64)  # several methods, and every question of what-if, ask for the same lift
def _propagate(
    inputs: tuple[tuple[str, Measurement], ...],
    ends: tuple[str, ...],
    frequency_per_min: float,
    duration: Duration,
    coupling: Coupling,
) -> tuple[tuple[float, float], tuple[tuple[str, float], ...]]:
    """Return the interval of the smallest RWL of the ends, kg, and each input's share of it."""

    def compute_smallest(drawn: Mapping[str, Array]) -> Array:
        limits = [
            compute_rwl_array(
                H=drawn[f"H at {end}"],
                V=drawn[f"V at {end}"],
                D=drawn["D"],
                A=drawn[f"A at {end}"],
                V_origin=drawn["V at origin"],
                frequency_per_min=frequency_per_min,
                duration=duration,
                coupling=coupling,
            )
            for end in ends
        ]
        return np.asarray(np.min(limits, axis=0))

    given = dict(inputs)
    interval = compute_interval(compute_smallest(draw_inputs(given)))
    return interval, tuple(compute_shares(compute_smallest, given).items())


def _find_refusals(lift: Lift, work: _Work, task: Task) -> list[str]:
    refusals = list(work.refusals)
    refusals += [REFUSED_CONDITIONS[n] for n in lift.notes if n in REFUSED_CONDITIONS]
    hands = lift.hands if task.hands is None else task.hands
    if hands == 1:
        refusals.append(REFUSED_CONDITIONS["one_handed"])
    if not _is_measured(lift.origin) or lift.D_cm.is_missing:
        refusals.append(
            "the position of hands or feet could not be measured where the lift starts, or the "
            "height it ends at"
        )
    return list(dict.fromkeys(refusals))


def _find_doubts(lift: Lift, work: _Work, task: Task, evaluation: _Evaluation) -> list[str]:
    doubts = list(work.doubts)
    doubts += [DOUBTFUL_CONDITIONS[n] for n in lift.notes if n in DOUBTFUL_CONDITIONS]
    if lift.peak_hand_speed_m_s > HIGH_SPEED_M_S:
        doubts.append(
            f"the hands reach {lift.peak_hand_speed_m_s:.2f} m/s; the equation is meant for lifts "
            f"up to about {HIGH_SPEED_M_S:g} m/s"
        )
    if task.hands == 2 and lift.hands == 1:
        doubts.append("two hands are stated, but only one seems to move with the load")
    if work.control is not False and "destination" not in evaluation.results:
        doubts.append("the destination could not be measured; the result is for the origin only")
    if math.isnan(evaluation.rwl_interval[0]):
        doubts.append("the measuring error is not known, so that no interval can be given")
    return list(dict.fromkeys(doubts))


# --------------------------------------------------------------------------- wording


def _format_end(name: str, time_s: float, point: LiftPoint) -> str:
    at = "" if math.isnan(time_s) else f" at {time_s:.2f} s"
    return (
        f"{name.capitalize()}{at}: H = {point.H_cm:.1f} cm, V = {point.V_cm:.1f} cm, "
        f"A = {point.A_deg:.0f} deg"
    )


def _explain_multipliers(case: LiftCase, point: LiftPoint, found: Rwl) -> list[str]:
    """Write out how each multiplier follows from its input."""
    k = METRIC
    counts_h = "" if point.H_cm >= k.h_min else f" (H below {k.h_min:g} cm counts as {k.h_min:g})"
    counts_d = "" if case.D_cm >= k.d_min else f" (D below {k.d_min:g} cm counts as {k.d_min:g})"
    h, d = max(point.H_cm, k.h_min), max(case.D_cm, k.d_min)
    side = "below" if point.V_cm < k.v_best else "from"
    origin_side = "below" if case.origin.V_cm < k.v_best else "from"
    lines = {
        "HM": f"{k.h_min:g} / {h:.1f} = {found.HM:.3f}{counts_h}",
        "VM": f"1 - {k.v_slope:g} x |{point.V_cm:.1f} - {k.v_best:g}| = {found.VM:.3f}",
        "DM": f"{k.d_offset:g} + {k.d_scale:g} / {d:.1f} = {found.DM:.3f}{counts_d}",
        "AM": f"1 - {A_SLOPE:g} x {point.A_deg:.1f} = {found.AM:.3f}",
        "FM": f"{found.FM:.3f} (table: {case.frequency_per_min:g} lifts per minute, "
        f"{case.duration} duration, hands {origin_side} {k.v_best:g} cm at the origin)",
        "CM": f"{found.CM:.3f} (table: {case.coupling} coupling, hands {side} {k.v_best:g} cm)",
    }
    zero = {reason[:2]: reason for reason in found.zero_reasons}
    return [zero.get(name, f"{name} = {text}") for name, text in lines.items()]


def _explain(lift: Lift, evaluation: _Evaluation) -> tuple[str, ...]:
    """Write the worked calculation, one line a step."""
    case = evaluation.case
    lines = [f"Load constant LC = {METRIC.load_constant:g} kg; travel D = {case.D_cm:.1f} cm"]
    for name, found in evaluation.results.items():
        point = case.origin if name == "origin" else case.destination
        assert point is not None  # a result exists for ends with a point only
        lines.append(_format_end(name, getattr(lift, name).time_s, point))
        lines += _explain_multipliers(case, point, found)
        factors = (found.HM, found.VM, found.DM, found.AM, found.FM, found.CM)
        product = " x ".join(f"{factor:.3f}" for factor in factors)
        lines.append(f"RWL = {METRIC.load_constant:g} x {product} = {found.RWL:.2f} kg")
        if case.load_kg is not None:
            index = compute_lifting_index(case.load_kg, found.RWL)
            lines.append(f"LI = {case.load_kg:g} kg / {found.RWL:.2f} kg = {index:.2f}")
    if len(evaluation.results) > 1:
        lines.append(f"The {evaluation.governing_end} governs: it allows less")
    level = classify(evaluation.lifting_index)
    if level is not None:
        lines.append(f"Band: {level.name} ({level.meaning}); action: {level.action}")
    return tuple(lines)


@dataclass(frozen=True)
class _Demanding:
    """Harder work that an assumption leaves open; `factor` is what it makes of the RWL."""

    frequency_per_min: float
    duration: Duration
    factor: float

    def __str__(self) -> str:
        return (
            f"At a rate of {self.frequency_per_min:g} per minute for {HOURS[self.duration]} a day "
            f"the recommended weight would be {100 * self.factor:.0f} % of this."
        )


def _imagine_demanding(case: LiftCase, work: _Work) -> _Demanding | None:
    """Show what the assumption of rare or short lifting hides; None if neither is assumed."""
    rate, duration = DEMANDING_WORK
    assumed = {k for k, source in work.provenance.items() if source is Provenance.ASSUMED}
    if not assumed & {"frequency", "duration"}:
        return None
    rate = rate if "frequency" in assumed else work.frequency_per_min
    if "duration" not in assumed:
        duration = work.duration
    now, then = (
        float(compute_frequency_multiplier(f, d, case.origin.V_cm))
        for f, d in ((work.frequency_per_min, work.duration), (rate, duration))
    )
    return _Demanding(rate, duration, then / now) if now > 0 else None


# --------------------------------------------------------------------------- results


def _list_inputs(lift: Lift, work: _Work, task: Task) -> tuple[RiskInput, ...]:
    measured = [
        RiskInput(
            name, item.value, "deg" if name[0] == "A" else "cm", Provenance.MEASURED, item.sigma
        )
        for name, item in _measurements(lift, ("origin", "destination")).items()
    ]
    source = work.provenance
    control = True if work.control is None else work.control
    hands_from = Provenance.MEASURED if task.hands is None else Provenance.USER
    return (
        *measured,
        RiskInput("load", work.load_kg, "kg", source["load"]),
        RiskInput("frequency", work.frequency_per_min, "1/min", source["frequency"]),
        RiskInput("duration class", work.duration.value, "", source["duration"]),
        RiskInput("coupling", work.coupling.value, "", source["coupling"]),
        RiskInput("significant control", control, "", source["control"]),
        RiskInput("hands", float(task.hands or lift.hands), "", hands_from),
    )


def _describe_end(point: LiftPoint, found: Rwl, load_kg: float | None) -> dict[str, float]:
    multipliers = {k: getattr(found, k) for k in ("HM", "VM", "DM", "AM", "FM", "CM")}
    return {
        "H_cm": point.H_cm,
        "V_cm": point.V_cm,
        "A_deg": point.A_deg,
        **multipliers,
        "RWL_kg": found.RWL,
        "LI": compute_lifting_index(load_kg, found.RWL),
    }


def _details(lift: Lift, work: _Work, found: _Evaluation, doubts: Sequence[str]) -> dict[str, Any]:
    """Return every number of the worked result as plain values."""
    case = found.case
    # An end that doesn't count is shown all the same, for the record.
    whole = case
    if _is_measured(lift.destination):
        whole = replace(case, destination=_point(lift.destination))
    shown, points = compute_case(whole), {"origin": whole.origin, "destination": whole.destination}
    shares = dict(found.shares)
    demanding = _imagine_demanding(case, work)
    return {
        "rwl_kg": found.rwl.RWL,
        "li": found.lifting_index,
        **{
            end: _describe_end(point, shown[end], case.load_kg)
            for end, point in points.items()
            if point is not None
        },
        "governing_end": found.governing_end,
        "counted_ends": list(found.results),
        "control_assumed": work.control is None,
        "D_cm": case.D_cm,
        "frequency_per_min": case.frequency_per_min,
        "duration_class": case.duration.value,
        "coupling": case.coupling.value,
        "load_kg": math.nan if case.load_kg is None else case.load_kg,
        "rwl_interval_kg": list(found.rwl_interval),
        "li_interval": list(found.li_interval),
        "dominant_input": _find_dominant(shares),
        "uncertainty_shares": shares,
        "demanding_li": math.nan
        if demanding is None
        else compute_lifting_index(case.load_kg, found.rwl.RWL * demanding.factor),
        "assumptions": list(work.assumptions),
        "doubts": list(doubts),
        "notes": [NIOSH_NOTE],
    }


def _find_dominant(shares: Mapping[str, float]) -> str:
    if not shares or not max(shares.values()) > 0:
        return ""
    return max(shares, key=lambda name: shares[name])


def read_case(details: Mapping[str, Any]) -> LiftCase:
    """Rebuild the evaluated case from a result's `details`, to ask what a change would do.

    Only the ends that counted are in it.
    """
    points = {
        end: LiftPoint(**{key: float(details[end][key]) for key in ("H_cm", "V_cm", "A_deg")})
        for end in details["counted_ends"]
    }
    load = details["load_kg"]
    return LiftCase(
        origin=points["origin"],
        destination=points.get("destination"),
        D_cm=float(details["D_cm"]),
        frequency_per_min=float(details["frequency_per_min"]),
        duration=Duration(details["duration_class"]),
        coupling=Coupling(details["coupling"]),
        load_kg=None if load is None or math.isnan(load) else float(load),
    )


class Rnle:
    """The Revised NIOSH Lifting Equation."""

    info = MethodInfo(
        name="rnle",
        title="Revised NIOSH Lifting Equation",
        reference="Waters, Putz-Anderson, Garg & Fine (1993), Ergonomics 36(7):749-776; "
        "Applications Manual, DHHS (NIOSH) 94-110, revised September 2021, tables 1, 5 and 7 [V2]. "
        "Five bands: ISO 11228-1:2021 reading, cut points [V2].",
        verification="V2",
        levels=LEVELS,
        description="Recommended weight limit and lifting index of two-handed lifts, at the origin "
        "and, where the load must be placed with care, at the destination. " + NIOSH_NOTE,
    )

    def assess(self, exposure: Exposure) -> RiskResult:
        """Judge every lift; the headline is the worst of them.

        Returns
        -------
        RiskResult
            `value` is the largest lifting index (NaN if the load is not known), `interval` its
            interval of about 95 % from the errors of H, V, D and A, taken as independent and
            normal. `details` has RWL, multipliers of both ends and what drives the error.
        """
        if not exposure.lifts:
            return self._refuse(("no lift was found in the video",))
        work = _read_work(exposure)
        results = tuple(
            self._assess_lift(lift, k, work, exposure.task) for k, lift in enumerate(exposure.lifts)
        )
        assessed = [r for r in results if r.is_applicable]
        if not assessed:
            reasons = dict.fromkeys(reason for r in results for reason in r.reasons)
            return replace(self._refuse(tuple(reasons)), per_lift=results)
        worst = min(assessed, key=lambda r: float(r.details["rwl_kg"]))
        skipped = tuple(
            f"Lift {r.lift_index + 1} was not assessed: {'; '.join(r.reasons)}."
            for r in results
            if not r.is_applicable and r.lift_index is not None
        )
        summary = {"governing_lift": worst.lift_index, "n_lifts": len(results)}
        return replace(
            worst,
            lift_index=None,
            per_lift=results,
            reasons=(*worst.reasons, *skipped),
            details={**worst.details, **summary, "n_assessed": len(assessed)},
        )

    def _assess_lift(self, lift: Lift, index: int, work: _Work, task: Task) -> RiskResult:
        refusals = _find_refusals(lift, work, task)
        inputs = _list_inputs(lift, work, task)
        if refusals:
            return replace(self._refuse(tuple(refusals)), lift_index=index, inputs=inputs)
        found = _evaluate(lift, work)
        doubts = _find_doubts(lift, work, task, found)
        level = classify(found.lifting_index)
        reasons = [*found.rwl.zero_reasons, *work.assumptions]
        if work.load_kg is None:
            reasons.insert(0, "The load is not given: the recommended weight limit, but no index.")
        demanding = _imagine_demanding(found.case, work)
        reasons += [] if demanding is None else [str(demanding)]
        return RiskResult(
            method=self.info.name,
            value=found.lifting_index,
            category="load not given" if level is None else level.name,
            inputs=inputs,
            steps=_explain(lift, found),
            interval=found.li_interval,
            reference=self.info.reference,
            reasons=(*reasons, *doubts),
            details=_details(lift, work, found, doubts),
            lift_index=index,
        )

    def _refuse(self, reasons: tuple[str, ...]) -> RiskResult:
        return RiskResult(
            method=self.info.name,
            value=math.nan,
            category="not applicable",
            reference=self.info.reference,
            is_applicable=False,
            reasons=reasons,
        )


METHOD = Rnle()
