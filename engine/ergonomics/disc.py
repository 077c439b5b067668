"""L5/S1 from the pelvis instead of the trunk's line: the experimental refinement of the model.

The place of the joint, the pelvis' rotation and the shear limits below were not confirmed against
their publications.

References
----------
.. [1] Reed, Manary & Schneider (1999), SAE 1999-01-0959, as used by Dumas, Cheze & Verriest (2007),
   J. Biomechanics 40(3), 543-553 [R].
.. [2] Anderson, Chaffin, Herrin & Matthews (1985), J. Biomechanics 18(8), 571-584: pelvis rotation
   by trunk and knee angle [R].
.. [3] McGill, Norman & Cholewicki (1996), Ergonomics 39(9), 1107-1118 [R].
.. [4] Gallagher & Marras (2012), Clinical Biomechanics 27, 973-978: shear limits [R].
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from engine.datatypes import Array, Sex

__all__ = [
    "SHEAR_LIMITS_N",
    "compute_pelvis_rotation",
    "compute_polynomial_compression",
    "compute_sacral_inclination",
    "find_shear_limit",
    "locate_l5s1",
]


class _Offset(NamedTuple):
    """Hip distance over pelvis width; L5/S1 up and back of the hips, in pelvis widths."""

    hips: float
    up: float
    back: float


# Reed's regression by way of the distance between the hip joints, [1].
_OFFSETS: Mapping[Sex, _Offset] = {
    "male": _Offset(0.722, 0.338, 0.240),
    "female": _Offset(0.744, 0.385, 0.201),
}
SACRAL_INCLINATION_DEG = 40.0
"""Inclination of the disc of an upright person."""

# Up to how many loadings a day, which shear (N), [4].
SHEAR_LIMITS_N: tuple[tuple[float, float], ...] = ((100.0, 1000.0), (1000.0, 700.0))


def locate_l5s1(
    hips: Array, hip_distance_m: ArrayLike, up: Array, forward: Array, sex: Sex
) -> Array:
    """Return L5/S1 from the middle of the hips [1].

    Parameters
    ----------
    hips
        Shape (..., 3).
    hip_distance_m
        Shape (...) or one number.
    up, forward
        Shape (..., 3), unit vectors of the pelvis.
    sex
        Selects the regression.
    """
    offset = _OFFSETS[sex]
    width = np.asarray(hip_distance_m, dtype=np.float64)[..., None] / offset.hips
    return np.asarray(hips + width * (offset.up * up - offset.back * forward))


def compute_pelvis_rotation(trunk_deg: ArrayLike, knee_included_deg: ArrayLike) -> Array:
    """Return how far the pelvis is rotated forward, degrees [2].

    Parameters
    ----------
    trunk_deg
        Trunk flexion from the vertical.
    knee_included_deg
        Angle at the knee, straight 180.
    """
    trunk, knee = (np.asarray(x, dtype=np.float64) for x in (trunk_deg, knee_included_deg))
    return np.asarray(
        -17.519
        - 0.11863 * trunk
        + 0.22687 * knee
        + 0.0012 * trunk * knee
        + 0.00499 * trunk**2
        - 0.000753 * knee**2
    )


def compute_sacral_inclination(trunk_deg: ArrayLike, knee_included_deg: ArrayLike) -> Array:
    """Return the inclination of the L5/S1 disc from the horizontal, degrees [2]."""
    return SACRAL_INCLINATION_DEG + compute_pelvis_rotation(trunk_deg, knee_included_deg)


def compute_polynomial_compression(
    flexion_nm: ArrayLike, lateral_nm: ArrayLike, twist_nm: ArrayLike
) -> Array:
    """Return lumbar compression (N) from three moments by McGill's polynomial [3]."""
    f, b, t = (np.abs(np.asarray(x, dtype=np.float64)) for x in (flexion_nm, lateral_nm, twist_nm))
    return np.asarray(
        1067.6
        + 1.219 * f
        + 0.083 * f**2
        - 0.0001 * f**3
        + 3.229 * b
        + 0.119 * b**2
        - 0.0001 * b**3
        + 0.862 * t
        + 0.393 * t**2
    )


def find_shear_limit(loadings_per_day: float) -> float:
    """Return the shear limit (N) for a number of loadings a day [4]; the lowest above 1000."""
    return next(
        (limit for upper, limit in SHEAR_LIMITS_N if loadings_per_day <= upper),
        SHEAR_LIMITS_N[-1][1],
    )
