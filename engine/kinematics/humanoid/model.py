"""The variables of the figure, and the way from the world's axes to the figure's.

Of the 26 degrees of freedom (hips 3 each, knees 1, ankles 2, waist 3, shoulders 3, elbows 1,
neck 3) the published cost uses 17; with three angles of the body's orientation and one size
factor they are the 21 `VARIABLES`. `EXTENSION` holds the other nine, which need more than the
twelve joints to be seen. Turning senses: theta is in the sagittal plane, phi in the coronal, psi
in the transversal; the body pitches forward (theta), rolls to its right (phi) and turns to its
left (psi); limbs flex (theta), abduct (phi) and turn inwards (psi).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike

from engine.datatypes import Array, PoseTrack
from engine.errors import ShapeError
from engine.skeletons import get_skeleton

__all__ = [
    "ANGLE_COUNT",
    "ANGLE_VARIABLES",
    "EXTENSION",
    "FITTED_JOINTS",
    "VARIABLES",
    "Variable",
    "centre_on_pelvis",
    "column",
    "to_model_axes",
    "to_world_axes",
]

VariableGroup = Literal["size", "body", "torso", "sagittal", "coronal", "transversal"]


@dataclass(frozen=True)
class Variable:
    """One unknown of the fit with its range: degrees, or a ratio for the size factor `gamma`."""

    name: str
    group: VariableGroup
    lower: float
    upper: float

    @property
    def is_angle(self) -> bool:
        """Whether the values are angles (all but the size factor)."""
        return self.group != "size"

    @property
    def bounds(self) -> tuple[float, float]:
        """The range in the unit of the computation: radians, or a ratio."""
        if not self.is_angle:
            return self.lower, self.upper
        return math.radians(self.lower), math.radians(self.upper)


VARIABLES: tuple[Variable, ...] = (
    Variable("gamma", "size", 0.7, 1.3),
    Variable("theta_bd", "body", -90.0, 90.0),
    Variable("phi_bd", "body", -60.0, 60.0),
    Variable("psi_bd", "body", -180.0, 180.0),
    Variable("theta_ws", "torso", -45.0, 90.0),
    Variable("phi_ws", "torso", -35.0, 35.0),
    Variable("psi_ws", "torso", -45.0, 45.0),
    Variable("theta_hp_l", "sagittal", -30.0, 120.0),
    Variable("theta_kn_l", "sagittal", 0.0, 140.0),
    Variable("theta_hp_r", "sagittal", -30.0, 120.0),
    Variable("theta_kn_r", "sagittal", 0.0, 140.0),
    Variable("theta_sh_l", "sagittal", -60.0, 180.0),
    Variable("theta_el_l", "sagittal", 0.0, 150.0),
    Variable("theta_sh_r", "sagittal", -60.0, 180.0),
    Variable("theta_el_r", "sagittal", 0.0, 150.0),
    Variable("phi_hp_l", "coronal", -30.0, 45.0),
    Variable("phi_hp_r", "coronal", -30.0, 45.0),
    Variable("phi_sh_l", "coronal", -30.0, 180.0),
    Variable("phi_sh_r", "coronal", -30.0, 180.0),
    Variable("psi_sh_l", "transversal", -90.0, 90.0),
    Variable("psi_sh_r", "transversal", -90.0, 90.0),
)
"""The 21 unknowns of Choi et al. (2024), Eq 7, in that order; ranges are clinical ranges of
motion, rounded outwards."""

EXTENSION: tuple[Variable, ...] = (
    Variable("psi_hp_l", "transversal", -60.0, 60.0),
    Variable("psi_hp_r", "transversal", -60.0, 60.0),
    Variable("theta_an_l", "sagittal", -60.0, 45.0),
    Variable("theta_an_r", "sagittal", -60.0, 45.0),
    Variable("psi_an_l", "transversal", -45.0, 30.0),
    Variable("psi_an_r", "transversal", -45.0, 30.0),
    Variable("theta_nk", "sagittal", -60.0, 90.0),
    Variable("phi_nk", "coronal", -60.0, 60.0),
    Variable("psi_nk", "transversal", -90.0, 90.0),
)
"""Degrees of freedom beyond Eq 7: turn of the thighs, the feet (up, inwards), the neck."""

ANGLE_VARIABLES: tuple[Variable, ...] = (*VARIABLES[1:], *EXTENSION)
"""Every angle of the figure, in the order of a full pose vector."""
ANGLE_COUNT = len(ANGLE_VARIABLES)
_COLUMN_OF: dict[str, int] = {variable.name: i for i, variable in enumerate(ANGLE_VARIABLES)}


def column(name: str) -> int:
    """Return the place of an angle in a full pose vector (the size factor is not in it)."""
    return _COLUMN_OF[name]


FITTED_JOINTS: tuple[str, ...] = (
    "left_shoulder",
    "right_shoulder",
    "left_elbow",
    "right_elbow",
    "left_wrist",
    "right_wrist",
    "left_hip",
    "right_hip",
    "left_knee",
    "right_knee",
    "left_ankle",
    "right_ankle",
)
"""The twelve joints of Choi et al. (2024), Eq 8."""


def to_model_axes(position: ArrayLike) -> Array:
    """Turn points of shape (..., 3) from the world's axes (Y up, Z right) to the figure's."""
    x, y, z = _components(position)
    return np.stack([x, -z, y], axis=-1)


def to_world_axes(position: ArrayLike) -> Array:
    """Turn points of shape (..., 3) from the figure's axes (Y left, Z up) to the world's."""
    x, y, z = _components(position)
    return np.stack([x, z, -y], axis=-1)


def _components(position: ArrayLike) -> tuple[Array, Array, Array]:
    points = np.asarray(position, dtype=np.float64)
    if points.ndim == 0 or points.shape[-1] != 3:
        raise ShapeError(f"Points need shape (..., 3), got {points.shape}.")
    return points[..., 0], points[..., 1], points[..., 2]


def centre_on_pelvis(track: PoseTrack) -> Array:
    """Return the twelve joints of a track around the mid-hip, in the figure's axes.

    Parameters
    ----------
    track
        World metres.

    Returns
    -------
    Array
        Shape (T, 12, 3), m, in the order of `FITTED_JOINTS`; NaN where a joint or a hip is
        missing, or the skeleton has none.
    """
    skeleton = get_skeleton(track.skeleton)
    missing = np.full((track.n_frames, 3), np.nan)
    joints = [
        skeleton.point(track.position, name) if skeleton.has(name) else missing
        for name in FITTED_JOINTS
    ]
    points = to_model_axes(np.stack(joints, axis=1))
    hips = [FITTED_JOINTS.index("left_hip"), FITTED_JOINTS.index("right_hip")]
    return np.asarray(points - points[:, hips].mean(axis=1, keepdims=True))
