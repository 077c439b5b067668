"""What every solver does alike with its angles: status, bounds of the errors, the neck's zero."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from engine.datatypes import Array, Status
from engine.kinematics import angles as geometry

__all__ = ["UNKNOWN_SIGMA_DEG", "WORST_FIRST", "find_worst_status", "subtract_neutral"]

UNKNOWN_SIGMA_DEG = 360.0 / np.sqrt(12.0)
"""The standard deviation of an angle of which nothing is known; no error can be larger."""

INDEPENDENT_AFTER_S = 0.1
"""Samples of a track smoothed at some 6 Hz repeat each other's errors within this time."""

WORST_FIRST = (
    Status.MISSING,
    Status.REJECTED,
    Status.FILLED,
    Status.REPAIRED,
    Status.SMOOTHED,
    Status.MEASURED,
)


def find_worst_status(status: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Return the worst status along the last axis."""
    rank = np.empty(len(Status), dtype=np.uint8)
    rank[list(WORST_FIRST)] = np.arange(len(WORST_FIRST))
    worst = np.array(WORST_FIRST, dtype=np.uint8)[rank[status].min(axis=-1)]
    return np.asarray(worst, dtype=np.uint8)


def subtract_neutral(time_s: Array, value: Array, sigma: Array, names: tuple[str, ...]) -> None:
    """Make the neck angle relative to upright standing; NaN if nobody stood upright.

    Parameters
    ----------
    time_s
        Shape (T,), s.
    value, sigma
        Shape (T, A), degrees; changed in place.
    names
        The A angles.
    """
    column = names.index("neck_flexion")
    inclination = value[:, names.index("trunk_inclination")]
    upright = geometry.find_upright(inclination) & np.isfinite(value[:, column])
    neutral = geometry.estimate_neutral_deg(value[:, column], upright)
    value[:, column] -= neutral
    if np.isnan(neutral):
        sigma[:, column] = np.nan
        return
    # The median of n independent samples has 1.25 times the error of their mean.
    interval_s = float(np.median(np.diff(time_s)))
    n_independent = max(1.0, float(upright.sum()) * min(1.0, interval_s / INDEPENDENT_AFTER_S))
    neutral_sigma = 1.2533 * float(np.median(sigma[upright, column])) / np.sqrt(n_independent)
    sigma[:, column] = np.hypot(sigma[:, column], neutral_sigma)
