"""From the figure's variables to the product's joint angles.

Most of the product's angles are one variable of the figure with a sign, because both use the
sequence flexion, abduction, rotation. The angles against the world are computed from the
figure's pelvis and trunk by the definitions of `engine.kinematics.angles`.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import ArrayLike

from engine.datatypes import Array
from engine.errors import ShapeError
from engine.kinematics import angles as geometry
from engine.kinematics.humanoid.forward import body_axes, trunk_axes
from engine.kinematics.humanoid.model import VARIABLES, column, to_world_axes
from engine.kinematics.humanoid.rotation import compute_rotation, compute_vectors

__all__ = [
    "SHOULDER_ROWS",
    "VARIABLE_OF",
    "WORLD_ANGLES",
    "angles_from_model",
    "read_limb_angles",
    "read_world_angles",
    "shoulder_from_vectors",
    "vectors_from_shoulder",
]

WORLD_ANGLES: tuple[str, ...] = (
    "trunk_inclination",
    "trunk_flexion",
    "trunk_lateral_bend",
    "trunk_twist",
    "pelvis_tilt",
    "pelvis_list",
    "pelvis_rotation",
)
"""Angles that depend on several variables: those of the pelvis and the waist."""

_DIRECT: Mapping[str, tuple[str, float]] = {
    "lumbar_flexion": ("theta_ws", 1.0),
    "lumbar_bending": ("phi_ws", 1.0),
    "lumbar_rotation": ("psi_ws", 1.0),
    "neck_flexion": ("theta_nk", 1.0),
    **{
        f"{name}_{s}": (f"{variable}_{s}", sign)
        for s in ("l", "r")
        for name, variable, sign in (
            ("hip_flexion", "theta_hp", 1.0),
            ("hip_adduction", "phi_hp", -1.0),
            ("hip_rotation", "psi_hp", 1.0),
            ("knee_flexion", "theta_kn", 1.0),
            ("ankle_dorsiflexion", "theta_an", 1.0),
            ("shoulder_flexion", "theta_sh", 1.0),
            ("shoulder_adduction", "phi_sh", -1.0),
            ("shoulder_rotation", "psi_sh", 1.0),
            ("elbow_flexion", "theta_el", 1.0),
        )
    },
}
"""Angles that are one variable: its name and the sign."""

VARIABLE_OF: Mapping[str, int] = {name: column(v) for name, (v, _) in _DIRECT.items()}
"""The place in a full pose vector of the variable that is, but for its sign, the angle."""

SHOULDER_ROWS: Mapping[str, tuple[int, int, int]] = {
    s: (column(f"theta_sh_{s}"), column(f"phi_sh_{s}"), column(f"psi_sh_{s}")) for s in ("l", "r")
}
"""The places in a full pose vector of a shoulder's three angles."""


def angles_from_model(values: ArrayLike) -> dict[str, Array]:
    """Return the product's joint angles for values of the 21 variables.

    Parameters
    ----------
    values
        Shape (..., 21): the size factor, then radians, in the order of `VARIABLES`.

    Returns
    -------
    dict
        Name of the angle, as in `engine.kinematics.angles`, to an array of shape (...),
        degrees. Neck, feet and the turn of the thighs are not among the 21 variables, so their
        angles are left out. An arm that is lifted sideways beyond the horizontal is reported
        as lifted forwards and across, as the convention's range of adduction wants it.

    Raises
    ------
    ShapeError
        If the last dimension is not 21.
    """
    given = np.asarray(values, dtype=np.float64)
    if given.ndim == 0 or given.shape[-1] != len(VARIABLES):
        raise ShapeError(f"Values need shape (..., {len(VARIABLES)}), got {given.shape}.")
    flat = given.reshape(-1, len(VARIABLES))[:, 1:].T
    world = read_world_angles(flat[:6])
    named = dict(zip(WORLD_ANGLES, world, strict=True)) | read_limb_angles(flat)
    return {name: value.reshape(given.shape[:-1]) for name, value in named.items()}


def read_world_angles(angles: Array) -> Array:
    """Return the angles `WORLD_ANGLES`, shape (7, T), degrees.

    Parameters
    ----------
    angles
        Shape (6, T), radians: theta, phi, psi of the body, then of the waist.
    """
    body = body_axes(np.sin(angles[:3]), np.cos(angles[:3]))
    trunk = trunk_axes(body, np.sin(angles[3:]), np.cos(angles[3:]))
    left, spine, across = (to_world_axes(axis.T) for axis in (body[1], trunk[2], trunk[1]))
    found = geometry.compute_trunk_angles(spine + across, spine - across, left, -left)
    # Pelvis as Rz(tilt) Rx(list) Ry(rotation) in world axes, from its up, left and forward axes.
    forward, up = to_world_axes(body[0].T), to_world_axes(body[2].T)
    tilt = np.arctan2(-up[:, 0], up[:, 1])
    listing = np.arcsin(np.clip(up[:, 2], -1.0, 1.0))
    level = np.cos(tilt) * left[:, 0] + np.sin(tilt) * left[:, 1]
    ahead = np.cos(tilt) * forward[:, 0] + np.sin(tilt) * forward[:, 1]
    turn = np.arctan2(-level, ahead)
    return np.stack([*found, *np.degrees([tilt, listing, turn])])


def vectors_from_shoulder(angles: Array, side: str) -> Array:
    """Return the rotation vector, as `Tree` takes it, of a shoulder's three angles; (3, T).

    Parameters
    ----------
    angles
        Shape (3, T), radians: theta, phi, psi; no NaN.
    side
        `l` or `r`.
    """
    sign = 1.0 if side == "l" else -1.0
    st, sp, ss = np.sin(angles)
    ct, cp, cs = np.cos(angles)
    sp, ss = sign * sp, sign * ss
    matrix = np.array(
        [
            [ct * cs + st * sp * ss, ct * ss - st * sp * cs, -st * cp],
            [-cp * ss, cp * cs, -sp],
            [st * cs - ct * sp * ss, st * ss + ct * sp * cs, ct * cp],
        ]
    )
    vector = compute_vectors(np.moveaxis(matrix, 2, 0)).T
    return np.stack([-vector[1], sign * vector[0], -sign * vector[2]])


def shoulder_from_vectors(vectors: Array, side: str) -> Array:
    """Return theta, phi, psi, shape (3, T), radians, of a shoulder given by rotation vectors."""
    sign = 1.0 if side == "l" else -1.0
    matrix = compute_rotation(np.stack([sign * vectors[1], -vectors[0], -sign * vectors[2]]))
    theta = np.arctan2(-matrix[0, 2], matrix[2, 2])
    phi = np.arcsin(np.clip(-sign * matrix[1, 2], -1.0, 1.0))
    psi = -sign * np.arctan2(matrix[1, 0], matrix[1, 1])
    return np.stack([theta, phi, psi])


def read_limb_angles(angles: Array) -> dict[str, Array]:
    """Return the angles that are one variable each, shape (T,), degrees.

    Parameters
    ----------
    angles
        Shape (20, T) or (29, T), radians: (the start of) full pose vectors.
    """
    named = {
        name: sign * np.degrees(angles[column(variable)])
        for name, (variable, sign) in _DIRECT.items()
        if column(variable) < len(angles)
    }
    for part in ("hip", "shoulder"):
        for side in ("l", "r"):
            _fold_ball_joint(named, part, side)
    return named


def _fold_ball_joint(named: dict[str, Array], part: str, side: str) -> None:
    """Bring adduction between -90 and 90, and the other two angles to their usual turn."""
    flexion, adduction, rotation = (
        f"{part}_{motion}_{side}" for motion in ("flexion", "adduction", "rotation")
    )
    across = _wrap(named[adduction])
    is_over = np.abs(across) > 90.0
    named[adduction] = np.where(is_over, np.copysign(180.0, across) - across, across)
    flex = np.where(is_over, named[flexion] + 180.0, named[flexion])
    # No limb extends beyond 90 degrees, but it can pass 180 on the way up.
    named[flexion] = _wrap(flex - 90.0) + 90.0
    if rotation in named:
        named[rotation] = _wrap(np.where(is_over, named[rotation] + 180.0, named[rotation]))


def _wrap(angle_deg: Array) -> Array:
    """Bring angles between -180 and 180 degrees."""
    return np.asarray((angle_deg + 180.0) % 360.0 - 180.0)
