"""Finding and filling gaps in one-dimensional series.

All functions work on arrays of shape (T, C): one column a coordinate.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import PchipInterpolator

from engine.datatypes import Array

__all__ = ["fill_by_mean", "fill_gaps", "find_runs", "long_gaps"]


def find_runs(mask: NDArray[np.bool_]) -> list[tuple[int, int]]:
    """Return (start, stop) of every run of True, stop exclusive."""
    padded = np.concatenate([[False], mask, [False]]).astype(np.int8)
    edges = np.flatnonzero(np.diff(padded))
    return [(int(a), int(b)) for a, b in edges.reshape(-1, 2)]


def long_gaps(
    time_s: Array, is_missing: NDArray[np.bool_], *, max_gap_s: float
) -> NDArray[np.bool_]:
    """Mark the samples of gaps that must not be filled.

    A gap lasts from the last sample before it to the first one after it. Gaps at the
    ends of the clip have no second side and count as too long.

    Parameters
    ----------
    time_s
        Shape (T,), s.
    is_missing
        Shape (T,).
    max_gap_s
        Longest gap that may be filled, s.

    Returns
    -------
    NDArray[bool]
        Shape (T,).
    """
    marked = np.zeros_like(is_missing)
    for start, stop in find_runs(is_missing):
        at_edge = start == 0 or stop == is_missing.size
        if at_edge or time_s[stop] - time_s[start - 1] > max_gap_s:
            marked[start:stop] = True
    return marked


def fill_gaps(time_s: Array, values: Array, *, max_gap_s: float) -> Array:
    """Fill short gaps by a shape-preserving cubic (PCHIP); long ones stay NaN.

    Parameters
    ----------
    time_s
        Shape (T,), s, increasing.
    values
        Shape (T, C); a sample is missing when any of its columns is NaN.
    max_gap_s
        Longest gap to fill, s, from the sample before it to the sample after it.

    Returns
    -------
    Array
        Shape (T, C).
    """
    is_missing = np.asarray(~np.isfinite(values).all(axis=1))
    filled = np.where(is_missing[:, None], np.nan, values)
    known = ~is_missing
    if known.sum() < 2 or not is_missing.any():
        return filled
    to_fill = is_missing & ~long_gaps(time_s, is_missing, max_gap_s=max_gap_s)
    if to_fill.any():
        filled[to_fill] = PchipInterpolator(time_s[known], values[known])(time_s[to_fill])
    return filled


def fill_by_mean(values: Array) -> Array:
    """Fill every gap by the mean of the samples just before and just after it.

    As published by Choi et al. (2024): all samples of a gap get one value, whatever its length.
    Gaps at the ends hold the nearest sample.

    Parameters
    ----------
    values
        Shape (T, C); a sample is missing when any of its columns is NaN.

    Returns
    -------
    Array
        Shape (T, C); NaN only if nothing was ever seen.
    """
    is_missing = np.asarray(~np.isfinite(values).all(axis=1))
    filled = np.where(is_missing[:, None], np.nan, values)
    if is_missing.all():
        return filled
    for start, stop in find_runs(is_missing):
        sides = [filled[i] for i in (start - 1, stop) if 0 <= i < len(filled)]
        filled[start:stop] = np.mean(sides, axis=0)
    return filled
