"""Dynamic time warping of several joint angles at once, with limited slopes.

The distance is that of `dtaidistance` (multivariate, Euclidean); its path is a staircase, so the
warping that is used is the smooth curve closest to it whose slope stays within limits: no
moment is stretched to a standstill or skipped.

References
----------
.. [1] Sakoe and Chiba (1978), Dynamic programming algorithm optimization for spoken word
   recognition, IEEE Trans. ASSP 26, 43-49: window and slope limits.
.. [2] Müller (2007), Information Retrieval for Music and Motion, ch. 4: subsequence alignment.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from engine.datatypes import Array
from engine.errors import DataError, ShapeError

__all__ = ["Warp", "find_subsequence", "limit_slope", "warp"]

WINDOW_SHARE = 0.2
SLOPES = (1 / 3, 3.0)
PENALTY = 0.1
"""Cost of a step that holds one of the curves; in units of the features (see `warp`)."""
STIFFNESS = 3.0
"""How much a bend of the warping weighs against leaving the staircase."""
COUPLING, MOST_STEPS, STEP_TOLERANCE = 3.0, 300, 1e-4
"""Of the solver of the slope limits: its penalty, and when it stops."""


@dataclass(frozen=True, eq=False)
class Warp:
    """How the samples of two sequences belong together.

    `path` (P, 2) are the pairs of samples of the dynamic programme; `position` (N,) is, for
    every sample of the first sequence, the (fractional) sample of the second; `distance` the root
    mean square over the path, in units of the features.
    """

    path: NDArray[np.int64]
    position: Array
    distance: float


def warp(
    first: Array,
    second: Array,
    *,
    window_share: float = WINDOW_SHARE,
    slopes: tuple[float, float] = SLOPES,
    penalty: float = PENALTY,
) -> Warp:
    """Align two sequences of features from their first to their last samples.

    Parameters
    ----------
    first, second
        Shapes (N, F) and (M, F), finite, scaled so that 1 is a difference that matters.
    window_share
        Half width of the Sakoe-Chiba band, as a share of the longer sequence.
    slopes
        Least and greatest slope of `position` relative to the straight line from end to end.
    penalty
        Cost of holding one sequence for one sample.

    Raises
    ------
    ShapeError
        If the sequences are too short or have different features.
    DataError
        If a value is missing.
    """
    _check(first, second)
    longer = max(len(first), len(second))
    window = max(abs(len(first) - len(second)), round(window_share * longer)) + 1
    path = _find_path(first, second, window=window, penalty=penalty, psi=0)
    position = limit_slope(_mean_position(path, len(first)), slopes=slopes)
    return Warp(path, position, _path_distance(first, second, path))


def find_subsequence(
    first: Array, second: Array, *, penalty: float = PENALTY
) -> tuple[int, int, float]:
    """Find the part of `second` that is most like the whole of `first`.

    Parameters
    ----------
    first, second
        Shapes (N, F) and (M, F), finite, sampled at one rate.
    penalty
        As in `warp`.

    Returns
    -------
    tuple
        First and last sample of the part, and its distance (see `Warp`).
    """
    _check(first, second)
    path = _find_path(first, second, window=None, penalty=penalty, psi=len(second))
    # What is held at both ends of the first sequence is not part of the movement.
    inner = path[(path[:, 0] > 0) & (path[:, 0] < len(first) - 1)]
    part = inner if len(inner) else path
    start = max(int(part[0, 1]) - 1, int(path[0, 1]))
    end = min(int(part[-1, 1]) + 1, int(path[-1, 1]))
    return start, end, _path_distance(first, second, path)


def _check(first: Array, second: Array) -> None:
    if first.ndim != 2 or second.ndim != 2 or first.shape[1] != second.shape[1]:
        raise ShapeError(
            f"Two sequences of the same features are needed, (N, F) and (M, F); got shapes "
            f"{first.shape} and {second.shape}."
        )
    if min(len(first), len(second)) < 3 or not first.shape[1]:
        raise ShapeError(
            f"At least 3 samples of one feature are needed to align; got shapes {first.shape} and "
            f"{second.shape}."
        )
    if not (np.isfinite(first).all() and np.isfinite(second).all()):
        raise DataError("Sequences to align must have no missing values; bridge or drop them.")


def _find_path(
    first: Array, second: Array, *, window: int | None, penalty: float, psi: int
) -> NDArray[np.int64]:
    from dtaidistance import dtw_ndim  # not needed to import the package

    _, costs = dtw_ndim.warping_paths_fast(
        np.ascontiguousarray(first),
        np.ascontiguousarray(second),
        window=window,
        penalty=penalty,
        psi=(0, 0, psi, psi),
        psi_neg=False,
        keep_int_repr=True,
    )
    return _trace(costs, penalty**2, free_ends=psi > 0)


def _trace(costs: Array, penalty: float, *, free_ends: bool) -> NDArray[np.int64]:
    """Follow the least costs backwards; ties go along the diagonal."""
    i, j = costs.shape[0] - 1, costs.shape[1] - 1
    if free_ends:
        j = 1 + int(np.argmin(costs[i, 1:]))
    steps = [(i - 1, j - 1)]
    while i > 1 or (j > 1 and not free_ends):
        options = (
            (costs[i - 1, j - 1], i - 1, j - 1),
            (costs[i - 1, j] + penalty, i - 1, j),
            (costs[i, j - 1] + penalty, i, j - 1),
        )
        # The row and column before the first samples hold infinity (or free starts).
        inside = [one for one in options if one[1] >= 1 and one[2] >= 1]
        _, i, j = min(inside, key=lambda one: one[0])
        steps.append((i - 1, j - 1))
    return np.array(steps[::-1])


def _path_distance(first: Array, second: Array, path: NDArray[np.int64]) -> float:
    apart = first[path[:, 0]] - second[path[:, 1]]
    return float(np.sqrt(np.mean(np.sum(apart**2, axis=1))))


def _mean_position(path: NDArray[np.int64], length: int) -> Array:
    """Return the middle of the samples that belong to each sample of the first sequence."""
    count = np.bincount(path[:, 0], minlength=length)
    mean = np.bincount(path[:, 0], weights=path[:, 1], minlength=length) / np.maximum(count, 1)
    mean[0], mean[-1] = path[0, 1], path[-1, 1]
    return np.asarray(mean)


def limit_slope(
    position: Array,
    *,
    slopes: tuple[float, float] = SLOPES,
    stiffness: float = STIFFNESS,
) -> Array:
    """Return the smooth curve with limited slopes that is closest to a warping.

    Parameters
    ----------
    position
        Shape (N,); both ends are kept.
    slopes
        Bounds of the slope, relative to that from end to end; 1 must lie between them.
    stiffness
        Weight of changes of slope.

    Returns
    -------
    Array
        Shape (N,), increasing.

    Raises
    ------
    DataError
        If no curve from end to end can keep the limits.
    """
    n = len(position) - 1
    total = float(position[-1] - position[0])
    if not (slopes[0] < 1 < slopes[1] and total > 0):
        raise DataError(
            f"A warping must go forward, with slopes around 1; got {total:g} samples in all and "
            f"slopes from {slopes[0]:g} to {slopes[1]:g}."
        )
    course = (position[1:] - position[0]) * n / total
    steps = _solve_steps(course, slopes, stiffness)
    reached = np.concatenate(([0.0], np.cumsum(steps)))
    return np.asarray(position[0] + total * reached / reached[-1])


def _solve_steps(course: Array, slopes: tuple[float, float], stiffness: float) -> Array:
    """Return steps (N,) within the limits, with sum N, whose running sum is closest to `course`.

    Alternating directions (Boyd et al. 2011, section 5.2): a small quadratic programme whose one
    matrix depends on its size only.
    """
    n = len(course)
    inverse = _step_matrix(n, stiffness)
    wanted = np.cumsum(course[::-1])[::-1]
    inside, lag = np.ones(n), np.zeros(n)
    for _ in range(MOST_STEPS):
        steps = (inverse @ np.append(wanted + COUPLING * (inside - lag), n))[:n]
        before, inside = inside, np.clip(steps + lag, *slopes)
        lag += steps - inside
        if max(np.abs(steps - inside).max(), np.abs(inside - before).max()) < STEP_TOLERANCE:
            break
    return _keep_sum(inside, slopes)


@lru_cache(maxsize=4)
def _step_matrix(n: int, stiffness: float) -> Array:
    """Return the inverse of the optimality conditions, shape (N + 1, N + 1)."""
    rows = np.tril(np.ones((n, n)))
    bend = stiffness * np.diff(np.eye(n), axis=0)
    whole = np.zeros((n + 1, n + 1))
    whole[:n, :n] = rows.T @ rows + bend.T @ bend + COUPLING * np.eye(n)
    whole[:n, n] = whole[n, :n] = 1.0
    return np.asarray(np.linalg.inv(whole))


def _keep_sum(steps: Array, slopes: tuple[float, float]) -> Array:
    """Shift steps by one constant, inside the limits, until their sum is their number."""
    low, high = slopes[0] - slopes[1], slopes[1] - slopes[0]
    for _ in range(60):
        middle = 0.5 * (low + high)
        if np.clip(steps + middle, *slopes).sum() < len(steps):
            low = middle
        else:
            high = middle
    return np.asarray(np.clip(steps + high, *slopes))
