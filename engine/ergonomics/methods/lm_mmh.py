"""Liberty Mutual equations: the share of women and men for whom a lift is acceptable.

They continue the tables of Snook & Ciriello (1991).
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from statistics import NormalDist
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike

from engine.datatypes import (
    Array,
    Coupling,
    Lift,
    Measurement,
    Provenance,
    RiskInput,
    RiskResult,
    Sex,
)
from engine.ergonomics.base import Exposure, MethodInfo, RiskLevel
from engine.ergonomics.methods.rnle import REFUSED_CONDITIONS
from engine.ergonomics.propagation import compute_interval, draw_inputs
from engine.ergonomics.work import (
    Repetitions,
    classify,
    combine_lifts,
    list_doubts,
    read_lifts,
    read_repetitions,
    refuse,
)
from engine.errors import DataError

__all__ = [
    "LEVELS",
    "METHOD",
    "Acceptable",
    "compute_acceptable_carry",
    "compute_acceptable_lift",
    "compute_percent_capable",
]

Direction = Literal["lift", "lower"]

LEVELS: tuple[RiskLevel, ...] = (
    RiskLevel(
        "acceptable",
        25.0,
        "acceptable to at least 75 % of women",
        "none from this method",
    ),
    RiskLevel(
        "too heavy for many",
        50.0,
        "too heavy for more than a quarter of women",
        "lower the load, its distance, the travel or the frequency",
    ),
    RiskLevel(
        "too heavy for most",
        math.inf,
        "too heavy for more than half of women",
        "redesign: a lighter or closer load, or a lifting aid",
    ),
)
Z_75 = 0.675
"""Normal deviate of 75 %, the design criterion, as the publication rounds it."""


@dataclass(frozen=True)
class _Equation:
    """Coefficients of one equation: a - x / b, or with ln or a square, as in the publication."""

    reference_kg: float
    variation: float
    h: tuple[float, float]
    vrm: tuple[float, float, float]
    dv: tuple[float, float]
    f: tuple[float, float, float]


# Potvin, Ciriello, Snook, Maynard & Brogmus (2021), Ergonomics 64(8), 955-970 [V2].
_Shared = tuple[tuple[float, float], tuple[float, float, float], tuple[float, float]]
_H_VRM_DV: Mapping[Sex, _Shared] = {
    "female": ((1.2602, 0.7686), (0.9877, 13.69, 9.221), (0.8199, 7.696)),
    "male": ((1.3532, 0.7079), (0.7746, 1.912, 3.296), (0.8695, 10.62)),
}
EQUATIONS: Mapping[tuple[Direction, Sex], _Equation] = {
    ("lift", "female"): _Equation(34.9, 0.260, *_H_VRM_DV["female"], (0.6767, 12.59, 228.2)),
    ("lift", "male"): _Equation(82.6, 0.276, *_H_VRM_DV["male"], (0.6259, 9.092, 125.0)),
    ("lower", "female"): _Equation(37.0, 0.307, *_H_VRM_DV["female"], (0.6767, 12.59, 228.2)),
    ("lower", "male"): _Equation(95.9, 0.304, *_H_VRM_DV["male"], (0.5773, 10.80, 255.9)),
}
CARRY_KG: Mapping[Sex, tuple[float, float]] = {"female": (28.6, 0.231), "male": (74.9, 0.278)}

# Limits of the inputs: H (m), reach of the median person (m); both sexes: DV (m), F (1/min).
H_LIMITS_M: Mapping[Sex, tuple[float, float]] = {"female": (0.20, 0.68), "male": (0.25, 0.73)}
ARM_REACH_M: Mapping[Sex, float] = {"female": 1.96, "male": 2.14}
MIN_DV_M = 0.25
DAY_H = 8.0
F_LIMITS = (1.0 / 480.0, 20.0)
TRAVEL_RATE = (3.0, 11.0)
"""Vertical travel a minute (m/min) above which care is needed, and above which nothing holds."""

COUPLING_FACTOR: Mapping[Coupling, float] = {
    Coupling.GOOD: 1.0,
    Coupling.FAIR: 0.925,
    Coupling.POOR: 0.84,
}
"""Good handles; poor or slippery ones; none (the publication's factors, for our three words)."""


@dataclass(frozen=True)
class Acceptable:
    """The load acceptable to half of a sex, and its standard deviation between persons (kg).

    `factors` are the scale factors by name.
    """

    median_kg: float
    sd_kg: float
    factors: Mapping[str, float]

    @property
    def for_75_percent_kg(self) -> float:
        """Load that is acceptable to 75 % of the persons, kg."""
        return self.median_kg - Z_75 * self.sd_kg

    def percent_capable(self, load_kg: float) -> float:
        """Return the percentage to whom a load is acceptable."""
        return compute_percent_capable(load_kg, self.median_kg, self.sd_kg)


def compute_percent_capable(load_kg: float, median_kg: float, sd_kg: float) -> float:
    """Compute the percentage of persons to whom a load is acceptable."""
    if math.isnan(load_kg) or math.isnan(median_kg):
        return math.nan
    if not sd_kg > 0:
        return 0.0 if load_kg > 0 else 100.0
    return 100.0 * (1.0 - NormalDist().cdf((load_kg - median_kg) / sd_kg))


def _factor(value: ArrayLike) -> Array:
    """Keep a scale factor between 0 and 1: the fits pass 1 a little at their bounds."""
    return np.clip(np.asarray(value, dtype=np.float64), 0.0, 1.0)


def _scale_factors(
    equation: _Equation, H_m: ArrayLike, VRM_m: ArrayLike, DV_m: ArrayLike, F: ArrayLike
) -> dict[str, Array]:
    h, vrm, dv, f = (np.asarray(x, dtype=np.float64) for x in (H_m, VRM_m, DV_m, F))
    rate = np.log(f)
    return {
        "HSF": _factor(equation.h[0] - h / equation.h[1]),
        "VRMSF": _factor(equation.vrm[0] + vrm / equation.vrm[1] - vrm**2 / equation.vrm[2]),
        "DVSF": _factor(equation.dv[0] - np.log(dv) / equation.dv[1]),
        "FSF": _factor(equation.f[0] - rate / equation.f[1] - rate**2 / equation.f[2]),
    }


def compute_acceptable_lift(
    direction: Direction, sex: Sex, *, H_m: float, VRM_m: float, DV_m: float, F: float
) -> Acceptable:
    """Compute the load acceptable for lifting or lowering through a day of 8 h.

    Parameters
    ----------
    direction, sex
        Which equation.
    H_m
        Horizontal distance mid-ankle to mid-hands, m.
    VRM_m, DV_m
        Middle height and vertical distance of the hands' travel, m.
    F
        Lifts per minute.
    """
    if min(H_m, DV_m, F) <= 0 or VRM_m < 0:
        raise DataError(
            "Distances and the frequency must be above 0, got "
            f"H {H_m:g}, VRM {VRM_m:g}, DV {DV_m:g} m, F {F:g} per minute."
        )
    equation = EQUATIONS[direction, sex]
    factors = _scale_factors(equation, H_m, VRM_m, DV_m, F)
    median = equation.reference_kg * math.prod(float(x) for x in factors.values())
    plain = {name: float(value) for name, value in factors.items()}
    return Acceptable(median, equation.variation * median, plain)


def compute_acceptable_carry(sex: Sex, *, V_m: float, DH_m: float, F: float) -> Acceptable:
    """Compute the load acceptable for carrying through a day of 8 h.

    `V_m` is the height of the hands, `DH_m` the distance (m), `F` carries per minute.
    """
    if min(V_m, DH_m, F) <= 0:
        raise DataError(
            f"Height, distance and frequency must be above 0, got {V_m:g}, {DH_m:g}, {F:g}."
        )
    reference, variation = CARRY_KG[sex]
    rate = math.log(F)
    if sex == "female":
        raw = (1.1645 - V_m / 4.437, 1.0101 - DH_m / 207.8, 0.6224 - rate / 16.33)
    else:
        raw = (
            1.5505 - V_m / 1.417,
            1.1172 - math.log(DH_m) / 6.332,
            0.5149 - rate / 7.958 - rate**2 / 131.1,
        )
    factors = dict(zip(("VSF", "DHSF", "FSF"), (float(_factor(x)) for x in raw), strict=True))
    median = reference * math.prod(factors.values())
    return Acceptable(median, variation * median, factors)


# --------------------------------------------------------------------------- one measured lift


@dataclass(frozen=True)
class _Case:
    """One lift as the equations need it: metres, per minute."""

    direction: Direction
    H: Measurement
    V: tuple[Measurement, Measurement]
    frequency: float
    coupling: float

    def acceptable(self, sex: Sex) -> Acceptable:
        H = max(self.H.value, H_LIMITS_M[sex][0])
        found = compute_acceptable_lift(
            self.direction, sex, H_m=H, VRM_m=self.middle, DV_m=self.travel, F=self.frequency
        )
        return Acceptable(
            self.coupling * found.median_kg, self.coupling * found.sd_kg, found.factors
        )

    @property
    def middle(self) -> float:
        return (self.V[0].value + self.V[1].value) / 2

    @property
    def travel(self) -> float:
        return max(MIN_DV_M, abs(self.V[1].value - self.V[0].value))

    def draw(self, sex: Sex) -> Array:
        """Return the median acceptable load for drawn inputs, kg."""
        drawn = draw_inputs({"H": self.H, "V0": self.V[0], "V1": self.V[1]})
        equation = EQUATIONS[self.direction, sex]
        factors = _scale_factors(
            equation,
            np.maximum(drawn["H"], H_LIMITS_M[sex][0]),
            (drawn["V0"] + drawn["V1"]) / 2,
            np.maximum(np.abs(drawn["V1"] - drawn["V0"]), MIN_DV_M),
            self.frequency,
        )
        return np.asarray(self.coupling * equation.reference_kg * math.prod(factors.values()))


def _in_metres(item: Measurement) -> Measurement:
    return Measurement(max(0.0, item.value) / 100.0, item.sigma / 100.0)


def _build_case(lift: Lift, work: Repetitions, coupling: Coupling) -> _Case:
    ends = (lift.origin, lift.destination)
    H = max((end.H_cm for end in ends), key=lambda item: item.value)
    heights = (_in_metres(lift.origin.V_cm), _in_metres(lift.destination.V_cm))
    return _Case(
        direction="lift" if heights[1].value >= heights[0].value else "lower",
        H=_in_metres(H),
        V=heights,
        frequency=max(F_LIMITS[0], work.frequency_per_min),
        coupling=COUPLING_FACTOR[coupling],
    )


def _find_refusals(exposure: Exposure, lift: Lift, work: Repetitions) -> list[str]:
    keys = (*exposure.conditions, *lift.notes)
    texts = {**REFUSED_CONDITIONS, "one_handed": "the equations are for two-handed lifts"}
    refusals = [
        texts[key].replace("the equation is", "the equations are") for key in keys if key in texts
    ]
    if lift.hands == 1:
        refusals.append(texts["one_handed"])
    places = (lift.origin.H_cm, lift.destination.H_cm, lift.origin.V_cm, lift.destination.V_cm)
    if any(item.is_missing for item in places):
        return [*refusals, "the hands or feet could not be measured at both ends of the lift"]
    distance = max(places[0].value, places[1].value) / 100.0
    top = max(places[2].value, places[3].value) / 100.0
    travel = abs(places[3].value - places[2].value) / 100.0
    if distance > H_LIMITS_M["female"][1]:
        refusals.append(
            f"the hands are {100 * distance:.0f} cm from the ankles; the equations end at "
            f"{100 * H_LIMITS_M['female'][1]:.0f} cm"
        )
    if top > ARM_REACH_M["female"]:
        refusals.append(f"the hands reach {top:.2f} m; the equations end at 1.96 m")
    if work.frequency_per_min > F_LIMITS[1]:
        refusals.append(f"{work.frequency_per_min:g} lifts per minute are more than 20")
    elif travel * work.frequency_per_min > TRAVEL_RATE[1]:
        refusals.append("the load travels more than 11 m up or down a minute")
    return list(dict.fromkeys(refusals))


class LibertyMutual:
    """Liberty Mutual manual materials handling equations, lifting and lowering."""

    info = MethodInfo(
        name="lm_mmh",
        title="Liberty Mutual acceptable load",
        reference="Potvin, Ciriello, Snook, Maynard & Brogmus (2021), Ergonomics 64(8):955-970, "
        "equations for lifting and lowering [V2].",
        verification="V2",
        levels=LEVELS,
        value_name="women for whom the load is too heavy",
        description="Percentage of women for whom the load is too heavy through a day of 8 h; "
        "the design criterion is acceptance by 75 % of women. Men are shown beside it.",
    )

    def assess(self, exposure: Exposure) -> RiskResult:
        """Judge every lift; the headline is the worst of them.

        Returns
        -------
        RiskResult
            `value` is the percentage of women not capable; `details` the acceptable loads.
        """
        if not exposure.lifts:
            return refuse(self.info, "no lift was found in the video")
        work = read_repetitions(exposure)
        results = [
            self._assess_lift(exposure, lift, k, work)
            for k, lift in enumerate(read_lifts(exposure))
        ]
        return combine_lifts(self.info, results)

    def _assess_lift(
        self, exposure: Exposure, lift: Lift, index: int, work: Repetitions
    ) -> RiskResult:
        refusals = _find_refusals(exposure, lift, work)
        if refusals:
            return replace(refuse(self.info, *refusals), lift_index=index)
        case = _build_case(lift, work, exposure.task.coupling or Coupling.FAIR)
        load_kg = exposure.task.load_kg
        women, men = case.acceptable("female"), case.acceptable("male")
        value = math.nan if load_kg is None else 100.0 - women.percent_capable(load_kg)
        level = classify(LEVELS, value)
        assumptions, doubts = _list_notes(exposure, lift, case, work)
        missing = ("The load is not given: acceptable loads, but no percentage.",)
        return RiskResult(
            method=self.info.name,
            value=value,
            unit="%",
            category="load not given" if level is None else level.name,
            inputs=_list_inputs(exposure, case, work),
            steps=_explain(case, women, men, load_kg),
            interval=_find_interval(case, load_kg),
            reference=self.info.reference,
            reasons=(*(missing if load_kg is None else ()), *assumptions, *doubts),
            details={
                **_details(case, women, men, load_kg),
                "assumptions": assumptions,
                "doubts": doubts,
            },
            lift_index=index,
        )


def _list_notes(
    exposure: Exposure, lift: Lift, case: _Case, work: Repetitions
) -> tuple[list[str], list[str]]:
    assumptions = [a for a in work.assumptions if a.startswith("Lifting frequency")]
    assumptions.append("The larger of the two horizontal distances counts, the careful reading.")
    if exposure.task.coupling is None:
        assumptions.append("Grip not given: fair coupling assumed.")
    doubts = list_doubts(exposure, lift)
    angles = (lift.origin.A_deg.value, lift.destination.A_deg.value)
    if max(angles) > 30.0:
        doubts.append("the load is more than 30 degrees to the side, where the equations end")
    hours = exposure.task.duration_h
    if hours is not None and hours > DAY_H:
        doubts.append(f"the work lasts {hours:g} h; the equations are for a day of {DAY_H:g} h")
    if case.travel * case.frequency > TRAVEL_RATE[0]:
        doubts.append("the load travels more than 3 m up or down a minute, where care is advised")
    if not all(math.isfinite(item.sigma) for item in (case.H, *case.V)):
        doubts.append("the measuring error is not known, so that no interval can be given")
    return assumptions, doubts


def _find_interval(case: _Case, load_kg: float | None) -> tuple[float, float]:
    if load_kg is None or not all(math.isfinite(i.sigma) for i in (case.H, *case.V)):
        return math.nan, math.nan
    low, high = compute_interval(case.draw("female"))
    variation = EQUATIONS[case.direction, "female"].variation
    heavy, light = (
        100.0 - compute_percent_capable(load_kg, median, variation * median)
        for median in (low, high)
    )
    return light, heavy


def _list_inputs(exposure: Exposure, case: _Case, work: Repetitions) -> tuple[RiskInput, ...]:
    measured = Provenance.MEASURED
    coupling = exposure.task.coupling
    return (
        RiskInput("H, larger of both ends", 100 * case.H.value, "cm", measured, 100 * case.H.sigma),
        *(
            RiskInput(f"V at {end}", 100 * item.value, "cm", measured, 100 * item.sigma)
            for end, item in zip(("origin", "destination"), case.V, strict=True)
        ),
        RiskInput("load", exposure.task.load_kg, "kg", Provenance.USER),
        RiskInput("frequency", work.frequency_per_min, "1/min", work.frequency_from),
        RiskInput(
            "coupling",
            (coupling or Coupling.FAIR).value,
            "",
            Provenance.ASSUMED if coupling is None else Provenance.USER,
        ),
    )


def _explain(
    case: _Case, women: Acceptable, men: Acceptable, load_kg: float | None
) -> tuple[str, ...]:
    lines = [
        (
            f"{case.direction.capitalize()}: H {case.H.value:.2f} m, middle height "
            f"{case.middle:.2f} m, travel {case.travel:.2f} m, {case.frequency:.3g} per minute, "
            f"grip factor {case.coupling:g}"
        )
    ]
    sexes: tuple[tuple[str, Sex, Acceptable], ...] = (
        ("Women", "female", women),
        ("Men", "male", men),
    )
    for word, sex, found in sexes:
        equation = EQUATIONS[case.direction, sex]
        factors = " x ".join(f"{name} {value:.3f}" for name, value in found.factors.items())
        lines.append(
            f"{word}: {equation.reference_kg:g} kg x {factors} x {case.coupling:g} = "
            f"{found.median_kg:.1f} kg for half, {found.for_75_percent_kg:.1f} kg for 75 %"
        )
    if load_kg is not None:
        lines.append(
            f"{load_kg:g} kg is acceptable to {women.percent_capable(load_kg):.0f} % of women and "
            f"{men.percent_capable(load_kg):.0f} % of men"
        )
    return tuple(lines)


def _details(
    case: _Case, women: Acceptable, men: Acceptable, load_kg: float | None
) -> dict[str, Any]:
    load = math.nan if load_kg is None else load_kg
    return {
        "direction": case.direction,
        **{
            word: {
                "median_kg": found.median_kg,
                "sd_kg": found.sd_kg,
                "acceptable_to_75_percent_kg": found.for_75_percent_kg,
                "percent_capable": found.percent_capable(load),
                **found.factors,
            }
            for word, found in (("women", women), ("men", men))
        },
    }


METHOD = LibertyMutual()
