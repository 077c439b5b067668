"""Feet that stand: a foot on the floor stays where it is."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import binary_opening

from engine.datatypes import Array

__all__ = ["find_standing_places"]

FOOT_PARTS = ("ankle", "heel", "big_toe")
STEP_S = 0.2
MAX_SPEED_M_S = 0.12
MIN_STANDING_S = 0.3
STANDING_SIGMA_M = 0.01
UP = 2
"""The figure's axis that points upwards."""


def find_standing_places(
    names: tuple[str, ...], placed: Array, time_s: Array
) -> tuple[Array, Array]:
    """Find where and when each point of a foot stands still.

    Parameters
    ----------
    names
        The P points.
    placed
        Shape (P, 3, T), m, in the figure's axes, the floor at height 0.
    time_s
        Shape (T,).

    Returns
    -------
    tuple of Array
        The place, shape (P, 3, T), m, never below the floor, and its weight, shape (P, T), 1/m^2,
        zero while the point moves and for points that are not of a foot.
    """
    place, weight = np.zeros_like(placed), np.zeros((len(names), time_s.size))
    for i, name in enumerate(names):
        if name.partition("_")[2] not in FOOT_PARTS:
            continue
        for run in _find_rests(placed[i], time_s):
            middle = np.median(placed[i][:, run], axis=1)
            middle[UP] = max(middle[UP], 0.0)
            place[i][:, run] = middle[:, None]
            weight[i, run] = STANDING_SIGMA_M**-2
    return place, weight


def _find_rests(position: Array, time_s: Array) -> Iterator[slice]:
    """List the runs of frames in which a point of shape (3, T) hardly moves."""
    if time_s.size < 3:
        return
    step = max(1, round(STEP_S / float(np.median(np.diff(time_s)))))
    before = np.maximum(np.arange(time_s.size) - step, 0)
    after = np.minimum(np.arange(time_s.size) + step, time_s.size - 1)
    travel = np.linalg.norm(position[:, after] - position[:, before], axis=0)
    is_still = travel < MAX_SPEED_M_S * (time_s[after] - time_s[before])
    for start, stop in _runs(binary_opening(is_still)):
        if time_s[stop - 1] - time_s[start] >= MIN_STANDING_S:
            yield slice(start, stop)


def _runs(mask: NDArray[np.bool_]) -> list[tuple[int, int]]:
    edges = np.flatnonzero(np.diff(np.concatenate([[0], mask.astype(np.int8), [0]])))
    return [(int(a), int(b)) for a, b in edges.reshape(-1, 2)]
