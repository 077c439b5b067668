"""The Shoulder Tool: cumulative damage of the shoulders by a day of lifting.

The model is in `engine.ergonomics.fatigue`; this file finds how far each hand's load is from the
shoulder and how often a day it is lifted.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from engine.datatypes import Provenance, RiskInput, RiskResult
from engine.ergonomics.base import Exposure, MethodInfo, RiskLevel
from engine.ergonomics.fatigue import (
    INCHES_PER_METRE,
    POUNDS_PER_KG,
    compute_risk_percent,
    compute_shoulder_damage,
    compute_shoulder_moment,
)
from engine.ergonomics.upper_body import UpperBody, find_held, measure_upper_body
from engine.ergonomics.work import (
    Repetitions,
    classify,
    list_doubts,
    read_lifts,
    read_repetitions,
    refuse,
)

__all__ = ["LEVELS", "METHOD"]

LEVELS: tuple[RiskLevel, ...] = (
    RiskLevel(
        "low",
        math.nextafter(25.0, 0.0),
        "a day of this work rarely belongs to a job that harms shoulders",
        "none from this method",
    ),
    RiskLevel(
        "moderate",
        50.0,
        "a day of this work may belong to a job that harms shoulders",
        "bring the load closer to the shoulders, or lift less or less often",
    ),
    RiskLevel(
        "high",
        math.inf,
        "a day of this work belongs to a job that harms shoulders more likely than not",
        "redesign: a lighter or closer load, fewer lifts, or a lifting aid",
    ),
)
BANDS_NOTE = "The tool gives a probability; the bands are those of LiFFT, by the same authors."


@dataclass(frozen=True)
class _Reach:
    """One lift with one arm: largest horizontal distance shoulder to hand, its error, its load."""

    index: int
    side: str
    reach_m: float
    sigma_m: float
    load_kg: float

    def damage(self, shift: float = 0.0) -> float:
        return compute_shoulder_damage(self.moment_ft_lb(shift))

    def moment_ft_lb(self, shift: float = 0.0) -> float:
        reach = max(0.0, self.reach_m + shift * self.sigma_m)
        return compute_shoulder_moment(POUNDS_PER_KG * self.load_kg, INCHES_PER_METRE * reach)


def _measure(exposure: Exposure, load_kg: float) -> list[_Reach]:
    body = measure_upper_body(exposure)
    found = []
    for k, lift in enumerate(read_lifts(exposure)):
        frames = np.flatnonzero(find_held(body.time_s, lift))
        for hand, share in body.grip(lift).items():
            reach = _find_reach(body, frames, k, hand.removesuffix("_knuckle"), share * load_kg)
            if reach is not None:
                found.append(reach)
    return found


def _find_reach(
    body: UpperBody, frames: np.ndarray[Any, Any], index: int, side: str, load_kg: float
) -> _Reach | None:
    shoulder, hand = f"{side}_shoulder", f"{side}_knuckle"
    offset = (body.points[hand] - body.points[shoulder])[frames][:, [0, 2]]
    distance = np.linalg.norm(offset, axis=1)
    if not np.isfinite(distance).any():
        return None
    peak = int(np.nanargmax(distance))
    sigma = np.hypot(body.sigma[shoulder], body.sigma[hand])[frames[peak]]
    return _Reach(index, side, float(distance[peak]), float(sigma), load_kg)


def _sum_damage(arms: Sequence[_Reach], per_lift: float, shift: float = 0.0) -> float:
    """Return the damage of the day to the worse shoulder."""
    sides = {arm.side for arm in arms}
    return max(
        sum(per_lift * arm.damage(shift) for arm in arms if arm.side == side) for side in sides
    )


class ShoulderTool:
    """The Shoulder Tool."""

    info = MethodInfo(
        name="shoulder_tool",
        title="Shoulder Tool, cumulative shoulder damage",
        reference="Bani Hani et al. (2021), Ergonomics 64(1):39-54; Shoulder Tool workbook v1.0.0 "
        "[V2].",
        verification="V2",
        levels=LEVELS,
        value_name="shoulder damage, probability of a harmful job",
        description="Probability that a day of these lifts belongs to a job that harms shoulders, "
        "from the horizontal distance shoulder to load and the number of lifts a day. "
        + BANDS_NOTE,
    )

    def assess(self, exposure: Exposure) -> RiskResult:
        """Judge a day of the observed lifts by the worse shoulder.

        Returns
        -------
        RiskResult
            `value` in per cent. Its interval takes the errors of all lifts as common.
        """
        if not exposure.lifts:
            return refuse(self.info, "no lift was found in the video")
        load_kg = exposure.task.load_kg
        if load_kg is None:
            return refuse(self.info, "the load is not given, and this tool needs it")
        arms = _measure(exposure, load_kg)
        if not arms:
            return refuse(self.info, "no arm could be seen while the load was held")
        return self._judge(exposure, arms, read_repetitions(exposure))

    def _judge(self, exposure: Exposure, arms: Sequence[_Reach], work: Repetitions) -> RiskResult:
        per_lift = work.per_day / len({arm.index for arm in arms})
        damage = _sum_damage(arms, per_lift)
        value = compute_risk_percent(damage, "shoulder")
        low, high = (
            compute_risk_percent(_sum_damage(arms, per_lift, shift), "shoulder")
            for shift in (-1.96, 1.96)
        )
        level = classify(LEVELS, value)
        doubts = _list_doubts(exposure, arms)
        demanding = math.nan
        if not math.isnan(work.demanding_per_day):
            hard = work.demanding_per_day / len({arm.index for arm in arms})
            demanding = compute_risk_percent(_sum_damage(arms, hard), "shoulder")
        return RiskResult(
            method=self.info.name,
            value=value,
            unit="%",
            category="unknown" if level is None else level.name,
            inputs=_list_inputs(arms, work),
            steps=_explain(arms, work, per_lift, damage, value),
            interval=(low, high),
            reference=self.info.reference,
            reasons=(*work.assumptions, *doubts),
            details={
                "damage_per_day": damage,
                "lifts_per_day": work.per_day,
                "demanding_li": demanding,
                "side": _worst(arms).side,
                "reach_cm": 100 * _worst(arms).reach_m,
                "assumptions": list(work.assumptions),
                "doubts": doubts,
                "notes": [BANDS_NOTE],
            },
        )


def _worst(arms: Sequence[_Reach]) -> _Reach:
    return max(arms, key=lambda arm: arm.damage())


def _list_doubts(exposure: Exposure, arms: Sequence[_Reach]) -> list[str]:
    doubts = list_doubts(exposure)
    for lift in exposure.lifts:
        doubts += [d for d in list_doubts(exposure, lift) if d not in doubts]
    unseen = len(exposure.lifts) - len({arm.index for arm in arms})
    if unseen:
        doubts.append(f"{unseen} of {len(exposure.lifts)} lifts could not be seen well enough")
    if any(math.isnan(arm.sigma_m) for arm in arms):
        doubts.append("the measuring error is not known, so that no interval can be given")
    return doubts


def _list_inputs(arms: Sequence[_Reach], work: Repetitions) -> tuple[RiskInput, ...]:
    worst = _worst(arms)
    return (
        RiskInput(
            f"largest distance {worst.side} shoulder to load",
            100 * worst.reach_m,
            "cm",
            Provenance.MEASURED,
            100 * worst.sigma_m,
        ),
        RiskInput("load on this arm", worst.load_kg, "kg", Provenance.DERIVED),
        RiskInput("frequency", work.frequency_per_min, "1/min", work.frequency_from),
        RiskInput("duration", work.duration_h, "h", work.duration_from),
    )


def _explain(
    arms: Sequence[_Reach], work: Repetitions, per_lift: float, damage: float, value: float
) -> tuple[str, ...]:
    lines = [
        (
            f"{work.frequency_per_min:g} lifts per minute for {work.duration_h:g} h are "
            f"{work.per_day:.0f} lifts a day"
        )
    ]
    for arm in arms:
        lines.append(
            f"Lift {arm.index + 1}, {arm.side} arm: {arm.load_kg:g} kg at {100 * arm.reach_m:.0f} "
            f"cm from the shoulder, moment {arm.moment_ft_lb():.1f} ft lb with the arm's own "
            f"weight; damage {arm.damage():.3g}, {per_lift:.0f} a day"
        )
    lines.append(f"Damage of the day to the worse shoulder {damage:.3g}")
    lines.append(f"Probability of a harmful job {value:.1f} %")
    return tuple(lines)


METHOD = ShoulderTool()
