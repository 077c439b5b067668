"""Fatigue-failure models: damage of a tissue by repeated loading, and the odds that follow.

Plain functions. A task's damage is its repetitions a day times the damage of one cycle; the damage
of all tasks of a day adds up.

References
----------
.. [1] Gallagher, Sesek, Schall & Huangfu (2017), Applied Ergonomics 63, 142-150; LiFFT workbook
   v1.4.0 (2018) [V2].
.. [2] Gallagher, Schall, Sesek & Huangfu (2018), Human Factors 60(8), 1146-1162; DUET workbook
   v1.3.0 [V2].
.. [3] Bani Hani et al. (2021), Ergonomics 64(1), 39-54; Shoulder Tool workbook v1.0.0 [V2].
"""

from __future__ import annotations

import math
from typing import Literal

from engine.errors import DataError

__all__ = [
    "compute_back_damage",
    "compute_damage",
    "compute_duet_damage",
    "compute_risk_percent",
    "compute_shoulder_damage",
    "compute_shoulder_moment",
]

NEWTON_METRES_PER_FOOT_POUND = 1.3558179483
INCHES_PER_METRE = 1.0 / 0.0254
POUNDS_PER_KG = 1.0 / 0.45359237

# Odds of a high-risk job: intercept and slope on log10 of the daily damage.
Tool = Literal["lifft", "duet", "shoulder"]
_ODDS: dict[Tool, tuple[float, float]] = {
    "lifft": (1.7229, 1.0239),
    "duet": (0.573, 0.747),
    "shoulder": (0.864, 0.928),
}

# Damage of one exertion by perceived effort 0 to 10 (OMNI-RES), [2].
DUET_DAMAGE: tuple[float, ...] = (
    2.6e-7,
    4.5e-7,
    1.37e-6,
    4.13e-6,
    1.262e-5,
    3.801e-5,
    1.1625e-4,
    3.5014e-4,
    1.05374e-3,
    3.22581e-3,
    9.70874e-3,
)


def compute_risk_percent(damage: float, tool: Tool) -> float:
    """Compute the probability (%) that a job of this daily damage is a high-risk job.

    0 where there is no damage; NaN where it is not known.
    """
    if damage < 0:
        raise DataError(f"Damage can't be negative, got {damage:g}.")
    if damage == 0:
        return 0.0
    if math.isinf(damage):
        return 100.0
    intercept, slope = _ODDS[tool]
    return 100.0 / (1.0 + math.exp(-(intercept + slope * math.log10(damage))))


def compute_damage(percent: float, tool: Tool) -> float:
    """Compute the daily damage that has a given probability (%): undoes `compute_risk_percent`.

    0 where the probability is 0, infinite where it is 100; NaN where it is not known.
    """
    if not 0.0 <= percent <= 100.0:
        if math.isnan(percent):
            return math.nan
        raise DataError(f"A probability must lie between 0 and 100 %, got {percent:g} %.")
    if percent in (0.0, 100.0):
        return 0.0 if percent == 0.0 else math.inf
    intercept, slope = _ODDS[tool]
    return float(10.0 ** ((math.log(percent / (100.0 - percent)) - intercept) / slope))


def compute_back_damage(moment_nm: float) -> float:
    """Compute the damage of one lift from the load's peak moment about L5/S1 [1]."""
    foot_pounds = moment_nm / NEWTON_METRES_PER_FOOT_POUND
    return float(10.0 ** (-5.81636221052493 + 0.0222878437409416 * foot_pounds))


def compute_duet_damage(omni: int) -> float:
    """Compute the damage of one hand exertion from its perceived effort, 0 to 10 [2]."""
    if omni not in range(len(DUET_DAMAGE)):
        raise DataError(f"The effort must be a whole number from 0 to 10, got {omni}.")
    return DUET_DAMAGE[omni]


def compute_shoulder_moment(
    load_lb: float, reach_in: float, *, kind: Literal["handle", "push", "push down"] = "handle"
) -> float:
    """Compute the moment about a shoulder in foot-pounds [3].

    Parameters
    ----------
    load_lb
        Weight or force at one hand, lb.
    reach_in
        Horizontal distance from the acromion to the load, in.
    kind
        Handling a weight, pushing or pulling level, or pushing down.
    """
    if reach_in < 1.715:
        arm = 0.0
    else:
        arm = (-8.27 + 4.8223 * reach_in) / 12.0 if reach_in < 27.0 else 121.9 / 12.0
    load = reach_in / 12.0 * load_lb
    return {"handle": load + arm, "push": load, "push down": load - arm}[kind]


def compute_shoulder_damage(moment_ft_lb: float) -> float:
    """Compute the damage of one exertion of a shoulder from its moment (ft lb) [3]."""
    strength_percent = 100.0 * 12.0 * moment_ft_lb / 681.0
    return float(10.0 ** (-(101.25 - strength_percent) / 14.83))
