"""LiFFT: cumulative damage of the low back by a day of lifting.

The model is in `engine.ergonomics.fatigue`; this file finds the moment of each lift and how often
a day it is done.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from engine.datatypes import Provenance, RiskInput, RiskResult
from engine.ergonomics.base import Exposure, MethodInfo, RiskLevel
from engine.ergonomics.fatigue import compute_back_damage, compute_risk_percent
from engine.ergonomics.spine import GRAVITY_M_S2
from engine.ergonomics.upper_body import find_held, measure_load_lever, measure_upper_body
from engine.ergonomics.work import (
    Repetitions,
    classify,
    list_doubts,
    read_lifts,
    read_repetitions,
    refuse,
)

__all__ = ["LEVELS", "METHOD"]

# The article's low band ends below 25 %, its high one begins above 50 %.
LEVELS: tuple[RiskLevel, ...] = (
    RiskLevel(
        "low",
        math.nextafter(25.0, 0.0),
        "a day of this work rarely belongs to a high-risk job",
        "none from this method",
    ),
    RiskLevel(
        "moderate",
        50.0,
        "a day of this work may belong to a high-risk job",
        "lower the load, its distance or the number of lifts",
    ),
    RiskLevel(
        "high",
        math.inf,
        "a day of this work belongs to a high-risk job more likely than not",
        "redesign: a lighter or closer load, fewer lifts, or a lifting aid",
    ),
)
MAX_MOMENT_NM = 100.0
"""Above this moment of the load the tool's authors advise caution."""


@dataclass(frozen=True)
class _Cycle:
    """One measured lift: the load's largest distance from L5/S1, with its error, in metres."""

    index: int
    lever_m: float
    sigma_m: float

    def moment_nm(self, load_kg: float, shift: float = 0.0) -> float:
        lever = max(0.0, self.lever_m + shift * self.sigma_m)
        return load_kg * GRAVITY_M_S2 * lever


def _measure(exposure: Exposure) -> list[_Cycle]:
    body = measure_upper_body(exposure)
    lifts = read_lifts(exposure)
    lever, sigma = measure_load_lever(body, lifts, exposure.subject)
    cycles = []
    for k, lift in enumerate(lifts):
        frames = np.flatnonzero(find_held(body.time_s, lift))
        if np.isfinite(lever[frames]).any():
            peak = frames[int(np.nanargmax(lever[frames]))]
            cycles.append(_Cycle(k, float(lever[peak]), float(sigma[peak])))
    return cycles


def _sum_damage(
    cycles: Sequence[_Cycle], load_kg: float, per_day: float, shift: float = 0.0
) -> float:
    share = per_day / len(cycles)
    return sum(share * compute_back_damage(c.moment_nm(load_kg, shift)) for c in cycles)


class Lifft:
    """Lifting Fatigue Failure Tool."""

    info = MethodInfo(
        name="lifft",
        title="LiFFT, cumulative low-back damage",
        reference="Gallagher, Sesek, Schall & Huangfu (2017), Applied Ergonomics 63:142-150; "
        "LiFFT workbook v1.4.0 (2018) [V2].",
        verification="V2",
        levels=LEVELS,
        value_name="low-back damage, probability of a high-risk job",
        description="Probability that a day of these lifts belongs to a job with many low-back "
        "injuries, from the load's moment about L5/S1 and the number of lifts a day. The bending "
        "of the trunk is not part of the tool.",
    )

    def assess(self, exposure: Exposure) -> RiskResult:
        """Judge a day of the observed lifts.

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
        cycles = _measure(exposure)
        if not cycles:
            reason = "trunk or hands could not be seen while the load was held"
            return refuse(self.info, reason)
        return self._judge(exposure, cycles, read_repetitions(exposure), load_kg)

    def _judge(
        self, exposure: Exposure, cycles: Sequence[_Cycle], work: Repetitions, load_kg: float
    ) -> RiskResult:
        damage = _sum_damage(cycles, load_kg, work.per_day)
        value = compute_risk_percent(damage, "lifft")
        low, high = (
            compute_risk_percent(_sum_damage(cycles, load_kg, work.per_day, shift), "lifft")
            for shift in (-1.96, 1.96)
        )
        level = classify(LEVELS, value)
        doubts = _list_doubts(exposure, cycles, load_kg)
        return RiskResult(
            method=self.info.name,
            value=value,
            unit="%",
            category="unknown" if level is None else level.name,
            inputs=_list_inputs(cycles, load_kg, work),
            steps=_explain(cycles, load_kg, work, damage, value),
            interval=(low, high),
            reference=self.info.reference,
            reasons=(*work.assumptions, *doubts),
            details={
                **_details(cycles, load_kg, work, damage),
                "assumptions": list(work.assumptions),
                "doubts": doubts,
            },
        )


def _worst(cycles: Sequence[_Cycle]) -> _Cycle:
    return max(cycles, key=lambda cycle: cycle.lever_m)


def _list_doubts(exposure: Exposure, cycles: Sequence[_Cycle], load_kg: float) -> list[str]:
    doubts = list_doubts(exposure)
    for lift in exposure.lifts:
        doubts += [d for d in list_doubts(exposure, lift) if d not in doubts]
    moment = _worst(cycles).moment_nm(load_kg)
    if moment > MAX_MOMENT_NM:
        doubts.append(
            f"the load's moment is {moment:.0f} N m; above {MAX_MOMENT_NM:.0f} N m the tool's "
            "authors advise caution"
        )
    unseen = len(exposure.lifts) - len(cycles)
    if unseen:
        doubts.append(f"{unseen} of {len(exposure.lifts)} lifts could not be seen well enough")
    if any(math.isnan(cycle.sigma_m) for cycle in cycles):
        doubts.append("the measuring error is not known, so that no interval can be given")
    return doubts


def _list_inputs(
    cycles: Sequence[_Cycle], load_kg: float, work: Repetitions
) -> tuple[RiskInput, ...]:
    worst = _worst(cycles)
    return (
        RiskInput(
            "largest distance load to L5/S1",
            100 * worst.lever_m,
            "cm",
            Provenance.MEASURED,
            100 * worst.sigma_m,
        ),
        RiskInput("load", load_kg, "kg", Provenance.USER),
        RiskInput("frequency", work.frequency_per_min, "1/min", work.frequency_from),
        RiskInput("duration", work.duration_h, "h", work.duration_from),
    )


def _explain(
    cycles: Sequence[_Cycle], load_kg: float, work: Repetitions, damage: float, value: float
) -> tuple[str, ...]:
    share = work.per_day / len(cycles)
    lines = [
        (
            f"{work.frequency_per_min:g} lifts per minute for {work.duration_h:g} h are "
            f"{work.per_day:.0f} lifts a day"
        )
    ]
    for cycle in cycles:
        moment = cycle.moment_nm(load_kg)
        one = compute_back_damage(moment)
        lines.append(
            f"Lift {cycle.index + 1}: {load_kg:g} kg x {GRAVITY_M_S2:.3f} m/s2 x "
            f"{cycle.lever_m:.3f} m = {moment:.1f} N m; damage per lift {one:.3g}, "
            f"{share:.0f} a day: {share * one:.3g}"
        )
    lines.append(f"Damage of the day {damage:.3g}")
    lines.append(f"Probability of a high-risk job {value:.1f} %")
    return tuple(lines)


def _details(
    cycles: Sequence[_Cycle], load_kg: float, work: Repetitions, damage: float
) -> dict[str, Any]:
    hard = work.demanding_per_day
    demanding = math.nan
    if not math.isnan(hard):
        demanding = compute_risk_percent(_sum_damage(cycles, load_kg, hard), "lifft")
    return {
        "damage_per_day": damage,
        "lifts_per_day": work.per_day,
        "peak_moment_nm": _worst(cycles).moment_nm(load_kg),
        "demanding_li": demanding,
        "demanding_per_day": hard,
        "lifts": [
            {
                "lift": cycle.index,
                "lever_cm": 100 * cycle.lever_m,
                "moment_nm": cycle.moment_nm(load_kg),
                "damage_per_lift": compute_back_damage(cycle.moment_nm(load_kg)),
            }
            for cycle in cycles
        ],
    }


METHOD = Lifft()
