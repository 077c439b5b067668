"""What the lumbar motion monitor's risk model looks at: five features of the lifting work.

The model's chart scales were not verified, so that no probability is given: the features alone.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass

import numpy as np

from engine.datatypes import Array, JointAngles, Lift, Provenance, RiskInput, RiskResult
from engine.ergonomics.base import Exposure, MethodInfo, RiskLevel
from engine.ergonomics.spine import GRAVITY_M_S2
from engine.ergonomics.upper_body import find_held, measure_load_lever, measure_upper_body
from engine.ergonomics.work import Repetitions, list_doubts, read_lifts, read_repetitions, refuse
from engine.errors import DataError

__all__ = ["METHOD", "LmmFeatures", "compute_features", "compute_probability"]

LEVELS: tuple[RiskLevel, ...] = (
    RiskLevel("features only", math.inf, "no probability is computed", "compare the features"),
)
MIN_REPETITIONS = 3


@dataclass(frozen=True)
class LmmFeatures:
    """The five variables of the model, means over the lifts; NaN where not known."""

    lift_rate_per_h: float
    max_moment_nm: float
    max_sagittal_flexion_deg: float
    mean_twist_velocity_deg_s: float
    max_lateral_velocity_deg_s: float


_NAMES: Mapping[str, str] = {
    "lift_rate_per_h": "lift rate",
    "max_moment_nm": "largest moment of the load",
    "max_sagittal_flexion_deg": "largest forward flexion",
    "mean_twist_velocity_deg_s": "mean twisting velocity",
    "max_lateral_velocity_deg_s": "largest lateral velocity",
}

_SOURCES: Mapping[str, tuple[str, str]] = {
    "flexion": ("lumbar_flexion", "trunk_flexion"),
    "twist": ("lumbar_rotation", "trunk_twist"),
    "lateral": ("lumbar_bending", "trunk_lateral_bend"),
}
"""Angle of the lumbar spine, and of the whole trunk where that is not known."""


def compute_features(
    exposure: Exposure, lifts: Sequence[Lift], work: Repetitions
) -> tuple[LmmFeatures, tuple[str, ...]]:
    """Compute the features, and say what stood in for lumbar angles."""
    angles = exposure.angles
    curves, notes = {}, []
    for feature, names in _SOURCES.items():
        name = next((n for n in names if _is_known(angles, n)), None)
        curves[feature] = np.full(angles.time_s.shape, np.nan) if name is None else angles[name]
        if name == names[1]:
            words = [n.replace("_", " ") for n in names]
            notes.append(f"{words[1]} stands in for {words[0]}, which overstates it")
    rows = [_measure_lift(angles.time_s, curves, lift) for lift in lifts]
    mean = [_mean([row[k] for row in rows]) for k in range(3)]
    return (
        LmmFeatures(60.0 * work.frequency_per_min, _peak_moment(exposure, lifts), *mean),
        tuple(notes),
    )


def _is_known(angles: JointAngles, name: str) -> bool:
    return name in angles.names and bool(np.isfinite(angles[name]).any())


def _mean(values: Sequence[float]) -> float:
    known = [value for value in values if math.isfinite(value)]
    return sum(known) / len(known) if known else math.nan


def _measure_lift(
    time_s: Array, curves: Mapping[str, Array], lift: Lift
) -> tuple[float, float, float]:
    part = find_held(time_s, lift)
    if part.sum() < 3:
        return math.nan, math.nan, math.nan
    flexion = curves["flexion"][part]
    twist, lateral = (
        np.abs(np.gradient(curves[name], time_s))[part] for name in ("twist", "lateral")
    )
    return (
        float(np.nanmax(flexion)) if np.isfinite(flexion).any() else math.nan,
        float(np.nanmean(twist)) if np.isfinite(twist).any() else math.nan,
        float(np.nanmax(lateral)) if np.isfinite(lateral).any() else math.nan,
    )


def _peak_moment(exposure: Exposure, lifts: Sequence[Lift]) -> float:
    """Return the mean over the lifts of the load's largest moment about L5/S1, N m."""
    if exposure.task.load_kg is None:
        return math.nan
    body = measure_upper_body(exposure)
    levers, _ = measure_load_lever(body, lifts, exposure.subject)
    weight = GRAVITY_M_S2 * exposure.task.load_kg
    peaks = []
    for lift in lifts:
        lever = levers[find_held(body.time_s, lift)]
        if np.isfinite(lever).any():
            peaks.append(weight * float(np.nanmax(lever)))
    return _mean(peaks)


def compute_probability(
    features: Mapping[str, float], scales: Mapping[str, Sequence[tuple[float, float]]]
) -> float:
    """Compute the probability of a high-risk job from chart scales given as data.

    Parameters
    ----------
    features
        Value by name.
    scales
        For every feature, points (value, probability from 0 to 1) with rising values.

    Returns
    -------
    float
        The mean of the features' probabilities, interpolated between the points and held beyond
        them; NaN where a feature is not known.

    Raises
    ------
    DataError
        If features and scales have different names.
    """
    if set(features) != set(scales):
        raise DataError(
            f"Expected a scale for each of {', '.join(features)}, got {', '.join(scales)}."
        )
    parts = []
    for name, value in features.items():
        points, probabilities = zip(*scales[name], strict=True)
        parts.append(float(np.interp(value, points, probabilities)))
    return sum(parts) / len(parts)


class Lmm:
    """Features of the lumbar motion monitor risk model."""

    info = MethodInfo(
        name="lmm",
        title="Lumbar motion features",
        reference="Marras et al. (1993), Spine 18(5):617-628; (1995), Ergonomics 38(2):377-410: "
        "the five variables [V2]; chart scales not verified.",
        verification="R",
        levels=LEVELS,
        value_name="load moment",
        decimals=0,
        description="Lift rate, load moment, flexion, twisting and lateral velocity, as the model "
        "defines them; without its scales there is no probability.",
    )

    def assess(self, exposure: Exposure) -> RiskResult:
        """Measure the features; `value` is the load's largest moment (N m)."""
        if not exposure.lifts:
            return refuse(self.info, "no lift was found in the video")
        work, lifts = read_repetitions(exposure), read_lifts(exposure)
        features, notes = compute_features(exposure, lifts, work)
        values = asdict(features)
        if all(math.isnan(value) for value in list(values.values())[1:]):
            return refuse(self.info, "neither trunk nor hands could be measured during a lift")
        doubts = list_doubts(exposure)
        if len(lifts) < MIN_REPETITIONS:
            doubts.append(f"fewer than {MIN_REPETITIONS} repetitions were seen")
        reason = "The chart scales were not verified, so that no probability is given."
        measured, units = Provenance.MEASURED, ("1/h", "N m", "deg", "deg/s", "deg/s")
        inputs = tuple(
            RiskInput(
                name.rsplit("_", 2 if name.endswith(("_per_h", "_deg_s")) else 1)[0].replace(
                    "_", " "
                ),
                value,
                unit,
                work.frequency_from if name == "lift_rate_per_h" else measured,
            )
            for (name, value), unit in zip(values.items(), units, strict=True)
        )
        return RiskResult(
            method=self.info.name,
            value=features.max_moment_nm,
            unit="N m",
            category="features only",
            inputs=inputs,
            steps=tuple(f"{item.name}: {item.value:.1f} {item.unit}" for item in inputs),
            reference=self.info.reference,
            reasons=(reason, *notes, *work.assumptions, *doubts),
            details={
                **values,
                "assumptions": list(work.assumptions),
                "doubts": doubts,
                "notes": list(notes),
            },
        )


METHOD = Lmm()
