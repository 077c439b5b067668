"""Robust statistics of series with gaps; shape (T, C), one column a series."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import binary_closing, label, median_filter

from engine.datatypes import Array

__all__ = [
    "close_gaps",
    "fill_linearly",
    "frame_interval_s",
    "known_median",
    "last_known",
    "mad_sigma",
    "odd_window",
    "running_median",
    "runs_that_touch",
    "widen",
]

_NORMAL = 1.4826
"""Median absolute deviation of a normal distribution times this is its SD."""

_ALONG_TIME = np.array([[0, 1, 0], [0, 1, 0], [0, 1, 0]])


def frame_interval_s(time_s: Array) -> float:
    """Return the median time between frames, s; that of 30 frames/s for a single frame."""
    return float(np.median(np.diff(time_s))) if time_s.size > 1 else 1.0 / 30.0


def odd_window(duration_s: float, interval_s: float) -> int:
    """Return the odd number of frames nearest to a duration, at least 1."""
    return 2 * round((duration_s / interval_s - 1.0) / 2.0) + 1 if duration_s > interval_s else 1


def known_median(values: Array) -> Array:
    """Return the median per column (T, C) -> (C,) without its gaps; NaN without values."""
    if not len(values):
        return np.full(values.shape[1], np.nan)
    ordered = np.sort(values, axis=0)  # NaN last
    count = np.isfinite(values).sum(axis=0)
    columns = np.arange(values.shape[1])
    low, high = np.maximum(count - 1, 0) // 2, np.minimum(count // 2, max(len(values) - 1, 0))
    middle = (ordered[low, columns] + ordered[high, columns]) / 2.0
    return np.where(count > 0, middle, np.nan)


def mad_sigma(values: Array) -> Array:
    """Return a robust SD per column: 1.4826 x median absolute deviation; NaN without values."""
    return _NORMAL * known_median(np.abs(values - known_median(values)))


def fill_linearly(values: Array) -> Array:
    """Fill gaps by straight lines over the frame number and hold the ends; all-NaN stays NaN.

    For statistics that need a value in every frame; never for results.
    """
    filled = np.array(values, dtype=float)
    frames = np.arange(len(values))
    for column in range(filled.shape[1]):
        known = np.isfinite(filled[:, column])
        if known.any() and not known.all():
            filled[~known, column] = np.interp(frames[~known], frames[known], filled[known, column])
    return filled


def running_median(values: Array, window: int) -> Array:
    """Return the median over a centred window of frames; gaps are bridged by straight lines.

    Parameters
    ----------
    values
        Shape (T, C); NaN in gaps.
    window
        Number of frames, odd. Beyond the ends the outermost values count as repeated.

    Returns
    -------
    Array
        Shape (T, C); NaN only in columns without any value.
    """
    filled = fill_linearly(values)
    if window <= 1 or len(filled) < 2:
        return filled
    known = np.isfinite(filled).all(axis=0)
    for column in np.flatnonzero(known):
        filled[:, column] = median_filter(filled[:, column], size=window, mode="nearest")
    return filled


def last_known(is_known: NDArray[np.bool_]) -> NDArray[np.intp]:
    """Return, per sample, the last earlier frame with a value; -1 if there is none.

    Parameters
    ----------
    is_known
        Shape (T, C).

    Returns
    -------
    NDArray[int]
        Shape (T, C).
    """
    frames = np.arange(is_known.shape[0])[:, None]
    latest = np.maximum.accumulate(np.where(is_known, frames, -1), axis=0)
    before = np.full(is_known.shape, -1, dtype=np.intp)
    before[1:] = latest[:-1]
    return before


def runs_that_touch(mask: NDArray[np.bool_], seeds: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Return the runs of `mask` along time that hold at least one of `seeds`; shape (T, C)."""
    labels, _ = label(mask, structure=_ALONG_TIME)
    chosen = np.unique(labels[seeds & mask])
    return np.asarray(mask & np.isin(labels, chosen[chosen > 0]))


def widen(mask: NDArray[np.bool_], frames: int) -> NDArray[np.bool_]:
    """Return a mask (T, C) that is also true up to `frames` before and after every true sample."""
    wide = mask.copy()
    for shift in range(1, min(frames, len(mask) - 1) + 1):
        wide[:-shift] |= mask[shift:]
        wide[shift:] |= mask[:-shift]
    return wide


def close_gaps(mask: NDArray[np.bool_], frames: int) -> NDArray[np.bool_]:
    """Return a mask (T, C) whose runs along time are joined where at most `frames` lie between."""
    joined = np.zeros((len(mask) + 2 * frames, mask.shape[1]), dtype=bool)
    joined[frames : len(mask) + frames] = mask
    joined = binary_closing(joined, structure=np.ones((frames + 1, 1), dtype=bool))
    return np.asarray(joined[frames : len(mask) + frames])
