"""Key indicator method for lifting, holding and carrying (KIM-LHC), edition of 2001.

Of the edition of 2019 the ratings of time and load were verified, but not those of body posture,
so that only a lower bound of its score is given beside the result.
"""

from __future__ import annotations

import bisect
import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from engine.datatypes import Lift, LiftEnd, Provenance, RiskInput, RiskResult, Sex
from engine.ergonomics.base import Exposure, MethodInfo, RiskLevel
from engine.ergonomics.work import (
    Repetitions,
    classify,
    combine_lifts,
    list_doubts,
    read_lifts,
    read_repetitions,
    refuse,
)

__all__ = [
    "LEVELS",
    "METHOD",
    "compute_score",
    "rate_load",
    "rate_load_2019",
    "rate_time",
    "rate_time_2019",
]


def _below(limit: float) -> float:
    """Return the largest number below a limit that belongs to the next level."""
    return math.nextafter(limit, 0.0)


LEVELS: tuple[RiskLevel, ...] = (
    RiskLevel("low", _below(10.0), "overload is unlikely", "none from this method"),
    RiskLevel(
        "increased",
        _below(25.0),
        "overload is possible for less resilient persons",
        "redesign for those persons",
    ),
    RiskLevel(
        "highly increased",
        _below(50.0),
        "overload is possible for normally resilient persons",
        "redesign the work",
    ),
    RiskLevel("high", math.inf, "overload is likely", "redesign at once"),
)

# Edition of 2001 [V1]: from how many lifts a day, and from which load, which rating.
TIME_2001: tuple[tuple[float, float], ...] = (
    (0, 1),
    (10, 2),
    (40, 4),
    (200, 6),
    (500, 8),
    (1000, 10),
)
LOAD_2001: dict[Sex, tuple[tuple[float, float], ...]] = {
    "male": ((0, 1), (10, 2), (20, 4), (30, 7), (40, 25)),
    "female": ((0, 1), (5, 2), (10, 4), (15, 7), (25, 25)),
}
POSTURES = {
    1: "upright, load close to the body",
    2: "slightly bent or turned",
    4: "deeply bent or reaching far, or slightly bent with the load away or to the side",
    8: "bent far with the load away or to the side, or hands above the shoulders",
}
CONDITIONS_2001 = {"good": 0.0, "restricted": 1.0, "strongly restricted": 2.0}

# Edition of 2019 [V2]: rating up to so many times per shift, between them interpolated; rating
# above so many kg, from 3 kg.
TIME_2019: tuple[tuple[float, float], ...] = (
    (5, 1),
    (20, 1.5),
    (50, 2),
    (100, 2.5),
    (150, 3),
    (220, 3.5),
    (300, 4),
    (500, 5),
    (750, 6),
    (1000, 7),
    (1500, 8),
    (2000, 9),
    (2500, 10),
)
LOAD_2019_KG: tuple[float, ...] = (5, 10, 15, 20, 25, 30, 35, 40)
LOAD_2019: dict[Sex, tuple[float, ...]] = {
    "male": (4, 6, 8, 11, 15, 25, 35, 75, 100),
    "female": (6, 9, 12, 25, 75, 85, 100, 100, 100),
}
MIN_LOAD_2019_KG = 3.0

# How this product reads the sheet's words.
SLIGHT_BEND_DEG, DEEP_BEND_DEG = 20.0, 60.0
FAR_CM, TURNED_DEG = 50.0, 30.0
SHOULDER_SHARE = 0.818
READING = (
    f"The sheet's words are read so: bent from {SLIGHT_BEND_DEG:g} degrees, deeply from "
    f"{DEEP_BEND_DEG:g}; load away from {FAR_CM:g} cm before the ankles; to the side from "
    f"{TURNED_DEG:g} degrees."
)


def _look_up(rows: Sequence[tuple[float, float]], value: float) -> float:
    return rows[bisect.bisect_right([start for start, _ in rows], value) - 1][1]


def rate_time(lifts_per_day: float) -> float:
    """Return the time rating of 2001 for lifts of less than 5 s."""
    return _look_up(TIME_2001, lifts_per_day)


def rate_load(load_kg: float, sex: Sex) -> float:
    """Return the load rating of 2001."""
    return _look_up(LOAD_2001[sex], load_kg)


def compute_score(time: float, load: float, posture: float, conditions: float) -> float:
    """Compute the score of 2001 from its ratings."""
    return time * (load + posture + conditions)


def rate_time_2019(times_per_shift: float) -> float:
    """Return the time rating of 2019; NaN above 2500 times."""
    if times_per_shift > TIME_2019[-1][0]:
        return math.nan
    times, ratings = zip(*TIME_2019, strict=True)
    return float(np.interp(times_per_shift, times, ratings))


def rate_load_2019(load_kg: float, sex: Sex) -> float:
    """Return the load rating of 2019; NaN below 3 kg, where the method doesn't begin."""
    if load_kg < MIN_LOAD_2019_KG:
        return math.nan
    return LOAD_2019[sex][bisect.bisect_left(LOAD_2019_KG, load_kg)]


# --------------------------------------------------------------------------- measured posture


def _rate_end(end: LiftEnd, bend_deg: float, shoulder_cm: float, shift: float = 0.0) -> int:
    """Return the posture rating of one end; `shift` moves every measure by standard errors."""

    def moved(value: float, sigma: float) -> float:
        return value + shift * sigma if math.isfinite(sigma) else value

    away = moved(end.H_cm.value, end.H_cm.sigma) >= FAR_CM
    turned = moved(end.A_deg.value, end.A_deg.sigma) >= TURNED_DEG
    if moved(end.V_cm.value, end.V_cm.sigma) > shoulder_cm:
        return 8
    if bend_deg >= DEEP_BEND_DEG:
        return 8 if away or turned else 4
    if bend_deg >= SLIGHT_BEND_DEG:
        return 4 if away or turned else 2
    return 4 if away else (2 if turned else 1)


class KimLhc:
    """KIM-LHC 2001."""

    info = MethodInfo(
        name="kim_lhc",
        title="Key indicator method, lifting (2001)",
        reference="LASI/BAuA (2001), Leitmerkmalmethode Heben, Halten, Tragen [V1]; BAuA (2019), "
        "KIM-LHC: time and load ratings [V2].",
        verification="V1",
        levels=LEVELS,
        required_angles=("trunk_inclination",),
        value_name="key indicator score",
        decimals=0,
        description="Score of time, load, posture and working conditions; single-source. "
        + READING,
    )

    def assess(self, exposure: Exposure) -> RiskResult:
        """Judge every lift as if it were the day's work; the headline is the worst of them.

        Returns
        -------
        RiskResult
            `value` is the score. Working conditions are not seen: good ones are assumed. The
            interval holds the errors of the posture, and both sexes where the sex is not known.
        """
        if not exposure.lifts:
            return refuse(self.info, "no lift was found in the video")
        if exposure.task.load_kg is None:
            return refuse(self.info, "the load is not given, and this method needs it")
        work = read_repetitions(exposure)
        load_kg = exposure.task.load_kg
        results = [
            self._assess_lift(exposure, lift, k, work, load_kg)
            for k, lift in enumerate(read_lifts(exposure))
        ]
        return combine_lifts(self.info, results)

    def _assess_lift(
        self, exposure: Exposure, lift: Lift, index: int, work: Repetitions, load_kg: float
    ) -> RiskResult:
        postures = [_rate_posture(exposure, lift, shift) for shift in (0.0, -1.96, 1.96)]
        if postures[0] is None:
            reason = "the trunk or the hands could not be measured at either end of the lift"
            return replace(refuse(self.info, reason), lift_index=index)
        sexes: tuple[Sex, ...] = ("female", "male")
        sex = exposure.subject.sex
        chosen: Sex = "female" if sex is None else sex
        time = rate_time(work.per_day)
        low, high = (
            compute_score(time, rate_load(load_kg, other), float(posture or postures[0]), 0.0)
            for posture, other in zip(
                postures[1:], reversed(sexes) if sex is None else (sex, sex), strict=True
            )
        )
        value = compute_score(time, rate_load(load_kg, chosen), postures[0], 0.0)
        level = classify(LEVELS, value)
        assumptions = [*work.assumptions, "Working conditions not seen: good ones assumed."]
        if sex is None:
            assumptions.append("Sex not given: rated as for women; the interval holds both.")
        doubts = _list_doubts(exposure, lift)
        demanding = math.nan
        if not math.isnan(work.demanding_per_day):
            hard = rate_time(work.demanding_per_day)
            demanding = compute_score(hard, rate_load(load_kg, chosen), postures[0], 0.0)
        return RiskResult(
            method=self.info.name,
            value=value,
            category="unknown" if level is None else level.name,
            inputs=_list_inputs(exposure, postures[0], work, chosen),
            steps=_explain(work, load_kg, chosen, postures[0], value),
            interval=(low, high),
            reference=self.info.reference,
            reasons=(*assumptions, *doubts),
            details={
                "time_rating": time,
                "load_rating": rate_load(load_kg, chosen),
                "posture_rating": postures[0],
                "conditions_rating": 0.0,
                "demanding_li": demanding,
                "edition_2019": _edition_2019(work, load_kg, chosen),
                "assumptions": assumptions,
                "doubts": doubts,
                "notes": [READING],
            },
            lift_index=index,
        )


def _rate_posture(exposure: Exposure, lift: Lift, shift: float) -> int | None:
    """Return the worse rating of the two ends; None where neither was measured."""
    shoulder_cm = 100 * SHOULDER_SHARE * exposure.subject.stature.value
    ratings = []
    for end in (lift.origin, lift.destination):
        bend = _bend_at(exposure, end.time_s, shift)
        if not (math.isnan(bend) or end.H_cm.is_missing or end.V_cm.is_missing):
            ratings.append(_rate_end(end, bend, shoulder_cm, shift))
    return max(ratings, default=None)


def _bend_at(exposure: Exposure, time_s: float, shift: float) -> float:
    """Return the trunk's inclination at a moment, degrees; NaN where it was not seen."""
    angles = exposure.angles
    if "trunk_inclination" not in angles.names or math.isnan(time_s):
        return math.nan
    frame = int(np.argmin(np.abs(angles.time_s - time_s)))
    step = float(np.max(np.diff(angles.time_s), initial=0.0))
    if abs(float(angles.time_s[frame]) - time_s) > max(step, 0.1):
        return math.nan
    sigma = float(angles.sigma("trunk_inclination")[frame])
    bend = float(angles["trunk_inclination"][frame])
    return bend + shift * sigma if math.isfinite(sigma) else bend


def _list_doubts(exposure: Exposure, lift: Lift) -> list[str]:
    doubts = list_doubts(exposure, lift)
    if lift.hands == 1:
        doubts.append("one hand lifts, which this edition does not rate")
    if "walking" in (*exposure.conditions, *lift.notes):
        doubts.append("the load is carried; only its lifts are counted here")
    return doubts


def _edition_2019(work: Repetitions, load_kg: float, sex: Sex) -> dict[str, float]:
    time, load = rate_time_2019(work.per_day), rate_load_2019(load_kg, sex)
    return {"time_rating": time, "load_rating": load, "score_at_least": time * load}


def _list_inputs(
    exposure: Exposure, posture: int, work: Repetitions, sex: Sex
) -> tuple[RiskInput, ...]:
    user, assumed = Provenance.USER, Provenance.ASSUMED
    return (
        RiskInput("posture rating", float(posture), "", Provenance.DERIVED),
        RiskInput("load", exposure.task.load_kg, "kg", user),
        RiskInput("sex", sex, "", assumed if exposure.subject.sex is None else user),
        RiskInput("frequency", work.frequency_per_min, "1/min", work.frequency_from),
        RiskInput("duration", work.duration_h, "h", work.duration_from),
        RiskInput("working conditions", "good", "", assumed),
    )


def _explain(
    work: Repetitions, load_kg: float, sex: Sex, posture: int, value: float
) -> tuple[str, ...]:
    time, load = rate_time(work.per_day), rate_load(load_kg, sex)
    return (
        f"{work.per_day:.0f} lifts a day: time rating {time:g}",
        f"{load_kg:g} kg, {'women' if sex == 'female' else 'men'}: load rating {load:g}",
        f"Posture rating {posture}: {POSTURES[posture]}",
        "Working conditions: good, rating 0",
        f"Score = {time:g} x ({load:g} + {posture} + 0) = {value:g}",
    )


METHOD = KimLhc()
