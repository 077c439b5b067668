"""Moments and forces at the joint between the fifth lumbar vertebra and the sacrum (L5/S1).

A top-down model: every body part above the joint and the load push with their weight (and, if
accelerations are given, their inertia). One equivalent extensor muscle balances the forward
bending moment. Nothing here knows about videos.

References
----------
.. [1] Chaffin, Andersson & Martin (2006), Occupational Biomechanics, 4th ed., ch. 6.
.. [2] NIOSH (1981), Work Practices Guide for Manual Lifting, DHHS (NIOSH) 81-122.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from engine.datatypes import Array
from engine.errors import ShapeError

__all__ = [
    "ACTION_LIMIT_N",
    "EXTENSOR_LEVER_M",
    "GRAVITY_M_S2",
    "MAXIMUM_LIMIT_N",
    "SpineForces",
    "TrunkAxes",
    "build_trunk_axes",
    "compute_planar_forces",
    "compute_top_down",
    "resolve_forces",
]

GRAVITY_M_S2 = 9.80665
EXTENSOR_LEVER_M = 0.056
"""Lever arm of the equivalent back extensor."""
EXTENSOR_LEVER_SIGMA_M = 0.003
"""Standard error of the lever arm: published values lie between 0.050 and 0.060 m."""

# Compression limits, [2] [V2].
ACTION_LIMIT_N = 3400.0
MAXIMUM_LIMIT_N = 6400.0


class TrunkAxes(NamedTuple):
    """Unit vectors of the trunk, shape (T, 3): forward, up along the trunk, to the right."""

    forward: Array
    up: Array
    right: Array


@dataclass(frozen=True, eq=False)
class SpineForces:
    """What acts at L5/S1, shape (T,) each.

    Moments (N m): `flexion` that the back extensors must balance, `lateral` bending to the right,
    `twist` about the trunk, of the external weights. Forces (N): `compression` along the trunk
    and `shear`, the forward reaction across it.
    """

    flexion_nm: Array
    lateral_nm: Array
    twist_nm: Array
    compression_n: Array
    shear_n: Array


def build_trunk_axes(hips: Array, shoulders: Array, right: Array) -> TrunkAxes:
    """Build the trunk's axes.

    Parameters
    ----------
    hips, shoulders
        Shape (T, 3), middle of the hips and of the shoulders, m.
    right
        Shape (T, 3), about the subject's right; made perpendicular to the trunk's line.

    Returns
    -------
    TrunkAxes
        NaN where points are missing or coincide.
    """
    up = _unit(shoulders - hips)
    across = _unit(right - np.sum(right * up, axis=-1, keepdims=True) * up)
    return TrunkAxes(np.cross(up, across), up, across)


def _unit(vector: Array) -> Array:
    length = np.linalg.norm(vector, axis=-1, keepdims=True)
    return np.asarray(np.divide(vector, np.where(length > 1e-9, length, np.nan)))


def compute_top_down(
    lever_m: Array, mass_kg: ArrayLike, acceleration_m_s2: Array | None = None
) -> tuple[Array, Array]:
    """Sum moments and forces of everything above the joint.

    Parameters
    ----------
    lever_m
        Shape (T, B, 3), mass centres relative to the joint, Y up.
    mass_kg
        Shape (B,) or (T, B).
    acceleration_m_s2
        Shape (T, B, 3); None for the static sum.

    Returns
    -------
    moment, force
        Shape (T, 3) each: moment of the external weights about the joint (N m), and their sum (N).
        The segments' own rotational inertia is left out.

    Raises
    ------
    ShapeError
        If the shapes don't go together.
    """
    if lever_m.ndim != 3 or lever_m.shape[2] != 3:
        raise ShapeError(f"lever_m needs shape (T, B, 3), got {lever_m.shape}.")
    mass = np.broadcast_to(np.asarray(mass_kg, dtype=np.float64), lever_m.shape[:2])
    pull = np.zeros_like(lever_m) if acceleration_m_s2 is None else -acceleration_m_s2
    pull = pull - np.array([0.0, GRAVITY_M_S2, 0.0])
    forces = mass[..., None] * pull
    # Nothing in the hands weighs nothing, wherever (or not at all) the hands are seen.
    forces = np.where(mass[..., None] > 0, forces, 0.0)
    lever = np.where(mass[..., None] > 0, lever_m, 0.0)
    return np.cross(lever, forces).sum(axis=1), forces.sum(axis=1)


def resolve_forces(
    moment: Array,
    force: Array,
    axes: TrunkAxes,
    *,
    normal: Array | None = None,
    lever_m: float = EXTENSOR_LEVER_M,
) -> SpineForces:
    """Resolve moment and force into what the trunk's muscles and the disc must bear.

    Parameters
    ----------
    moment, force
        Shape (T, 3), from `compute_top_down`.
    axes
        The trunk's axes.
    normal
        Shape (T, 3), unit vector across the disc towards the head; the trunk's axis if None.
    lever_m
        Lever arm of the equivalent extensor.

    Returns
    -------
    SpineForces
        Sideways and twisting moments are reported, but the single muscle doesn't balance them, so
        that compression is too low in asymmetric lifts. Moments that bend backwards add none.
    """
    flexion = -_dot(moment, axes.right)
    upward = axes.up if normal is None else normal
    forward = axes.forward if normal is None else np.cross(upward, axes.right)
    return SpineForces(
        flexion_nm=flexion,
        lateral_nm=_dot(moment, axes.forward),
        twist_nm=_dot(moment, axes.up),
        compression_n=np.maximum(flexion, 0.0) / lever_m - _dot(force, upward),
        shear_n=_dot(force, forward),
    )


def _dot(a: Array, b: Array) -> Array:
    return np.asarray(np.sum(a * b, axis=-1))


def compute_planar_forces(
    moment_nm: ArrayLike,
    weight_n: ArrayLike,
    inclination_deg: ArrayLike,
    *,
    lever_m: float = EXTENSOR_LEVER_M,
) -> tuple[Array, Array]:
    """Compute compression and shear (N) in the sagittal plane.

    Parameters
    ----------
    moment_nm
        Forward bending moment at L5/S1.
    weight_n
        Weight above L5/S1, load included.
    inclination_deg
        Of the trunk from the vertical.
    lever_m
        Lever arm of the equivalent extensor.
    """
    angle = np.radians(np.asarray(inclination_deg, dtype=np.float64))
    moment, weight = np.asarray(moment_nm, dtype=np.float64), np.asarray(weight_n)
    compression = np.maximum(moment, 0.0) / lever_m + weight * np.cos(angle)
    return np.asarray(compression), np.asarray(weight * np.sin(angle))
