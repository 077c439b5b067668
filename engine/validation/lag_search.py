"""The correlation of two sets of curves at every lag, gaps and partial overlap included."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from engine.datatypes import Array, JointAngles
from engine.errors import DataError
from engine.validation.resampling import resample_angles

__all__ = [
    "GRID_HZ",
    "EvenCurves",
    "LagSearch",
    "excursion",
    "find_peak",
    "find_runner_up",
    "refine_peak",
    "resample_evenly",
    "search_lags",
]

GRID_HZ = 100.0
MIN_OVERLAP_S = 1.0
MIN_OVERLAP_SHARE = 0.4
MIN_EXCURSION_DEG = 5.0
"""A curve that moves less tells nothing about the lag."""
PEAK_HALF_WIDTH_S = 0.05

Spectrum = NDArray[np.complex128]


@dataclass(frozen=True, eq=False)
class EvenCurves:
    """Curves by name, shape (T,) each, at `GRID_HZ` from `start_s` on."""

    start_s: float
    curves: Mapping[str, Array]

    @property
    def n_frames(self) -> int:
        """Number of samples."""
        return len(next(iter(self.curves.values())))


@dataclass(frozen=True, eq=False)
class LagSearch:
    """Correlation at every lag that leaves enough overlap.

    `lag_s` (L,); `pooled` (L,) of all curves together, each by its excursion; `single` (A, L)
    of each curve in `names`; `overlap_s` (L,).
    """

    lag_s: Array
    pooled: Array
    single: Array
    overlap_s: Array
    names: tuple[str, ...]


def resample_evenly(angles: JointAngles, names: Sequence[str], *, word: str) -> EvenCurves:
    """Bring angles to an even grid; `word` names the recording in messages.

    Raises
    ------
    DataError
        If the recording is too short.
    """
    if angles.time_s.size < 2 or angles.time_s[-1] - angles.time_s[0] < MIN_OVERLAP_S:
        raise DataError(
            f"The {word} lasts less than {MIN_OVERLAP_S:g} s, which is too short to find the lag; "
            "give a longer recording."
        )
    start, end = float(angles.time_s[0]), float(angles.time_s[-1])
    grid = np.arange(start, end + 0.5 / GRID_HZ, 1.0 / GRID_HZ)
    even = resample_angles(angles, np.minimum(grid, end), names=names)
    return EvenCurves(start, {name: even[name] for name in names})


def excursion(curve: Array) -> float:
    """Return how far a curve moves; 0 without samples."""
    known = curve[np.isfinite(curve)]
    return float(np.ptp(known)) if known.size > 1 else 0.0


def search_lags(
    result: EvenCurves,
    reference: EvenCurves,
    pairs: Sequence[tuple[str, str]],
    *,
    max_lag_s: float | None = None,
) -> LagSearch:
    """Compute the correlation of pairs of curves at every lag.

    Parameters
    ----------
    result, reference
        On one grid.
    pairs
        Name in the result, name in the reference.
    max_lag_s
        Lags to try to either side; by default all that leave enough overlap.

    Raises
    ------
    DataError
        If no curve moves or no lag leaves enough overlap.
    """
    moves = {p: (excursion(result.curves[p[0]]), excursion(reference.curves[p[1]])) for p in pairs}
    kept = [p for p in pairs if min(moves[p]) > 0 and max(moves[p]) >= MIN_EXCURSION_DEG]
    if not kept:
        raise DataError(
            "No common angle moves, so that the lag can't be found; choose a recording with "
            "movement, or give the lag."
        )
    count, pooled, single = _correlate(
        np.stack([result.curves[own] for own, _ in kept]),
        np.stack([reference.curves[other] for _, other in kept]),
    )
    first_lag = result.start_s - reference.start_s - (reference.n_frames - 1) / GRID_HZ
    lag = first_lag + np.arange(count.size) / GRID_HZ
    shortest = min(result.n_frames, reference.n_frames) / GRID_HZ
    needed = max(MIN_OVERLAP_S, MIN_OVERLAP_SHARE * shortest)
    allowed = (count / GRID_HZ >= needed) & np.isfinite(pooled)
    if max_lag_s is not None:
        allowed &= np.abs(lag) <= max_lag_s
    if not allowed.any():
        raise DataError(
            f"Result and reference overlap less than {needed:.1f} s at every lag that was allowed; "
            "check the times, or raise max_lag_s."
        )
    names = tuple(own for own, _ in kept)
    return LagSearch(
        lag[allowed], pooled[allowed], single[:, allowed], count[allowed] / GRID_HZ, names
    )


def _correlate(first: Array, second: Array) -> tuple[Array, Array, Array]:
    """Correlate gappy curves at every lag, with the mean of each overlap removed, by FFT.

    Parameters
    ----------
    first, second
        Shape (A, T1) and (A, T2) at one rate; NaN where missing.

    Returns
    -------
    tuple
        Mean overlap in samples (L,), pooled correlation (L,) and that of each curve (A, L), with
        L = T1 + T2 - 1; at index i, `second` is moved by i - (T2 - 1) samples.
    """
    n = first.shape[1] + second.shape[1] - 1
    size = 1 << (n - 1).bit_length()
    x_known, x, xx = _spectra(first, size)
    y_known, y, yy = _spectra(second[:, ::-1], size)

    def back(spectrum: Spectrum) -> Array:
        return np.asarray(np.fft.irfft(spectrum, size, axis=1)[:, :n])

    count = np.round(back(x_known * y_known))
    safe = np.maximum(count, 1.0)
    sum_x, sum_y = back(x * y_known), back(x_known * y)
    covariance = back(x * y) - sum_x * sum_y / safe
    spread_x = np.maximum(back(xx * y_known) - sum_x**2 / safe, 0.0)
    spread_y = np.maximum(back(x_known * yy) - sum_y**2 / safe, 0.0)
    spread = np.sqrt(spread_x * spread_y)
    with np.errstate(invalid="ignore", divide="ignore"):
        single = np.clip(covariance / spread, -1.0, 1.0)
        pooled = np.clip(covariance.sum(axis=0) / spread.sum(axis=0), -1.0, 1.0)
    return count.mean(axis=0), pooled, single


def _spectra(curves: Array, size: int) -> tuple[Spectrum, Spectrum, Spectrum]:
    """Return the spectra of presence, values and squared values of curves (A, T)."""
    known = np.isfinite(curves)
    mean = np.where(known, curves, 0.0).sum(axis=1) / np.maximum(known.sum(axis=1), 1)
    centred = np.where(known, curves - mean[:, None], 0.0)
    parts = (known.astype(np.float64), centred, centred**2)
    presence, values, squares = (np.fft.rfft(part, size, axis=1) for part in parts)
    return presence, values, squares


def _evidence(search: LagSearch) -> Array:
    """Return how much speaks for each lag: Fisher's z of the correlation, by root overlap.

    A slightly better correlation over a short overlap is worth less than one over all of it.
    """
    z = np.arctanh(np.clip(search.pooled, -0.9999, 0.9999))
    return np.asarray(z * np.sqrt(search.overlap_s))


def find_peak(search: LagSearch) -> int:
    """Return the lag with most evidence, moved to the top of its peak."""
    best, r = int(np.argmax(_evidence(search))), search.pooled
    while best > 0 and r[best - 1] > r[best]:
        best -= 1
    while best < r.size - 1 and r[best + 1] > r[best]:
        best += 1
    return best


def refine_peak(search: LagSearch, best: int) -> float:
    """Return the top of a parabola through the lags around the best one, s.

    Noise moves the top of three points more than that of many.
    """
    near = np.flatnonzero(np.abs(search.lag_s - search.lag_s[best]) < PEAK_HALF_WIDTH_S + 1e-9)
    if not near[0] < best < near[-1]:
        return float(search.lag_s[best])
    shift = search.lag_s[near] - search.lag_s[best]
    curvature, slope, _ = np.polyfit(shift, search.pooled[near], 2)
    top = -slope / (2 * curvature) if curvature < 0 else 0.0
    return float(search.lag_s[best] + np.clip(top, shift[0], shift[-1]))


def find_runner_up(search: LagSearch, best: int) -> tuple[float, float]:
    """Return the best lag that lies on another peak, and its correlation; NaN without one."""
    r = search.pooled
    low = high = best
    while low > 0 and r[low - 1] <= r[low]:
        low -= 1
    while high < r.size - 1 and r[high + 1] <= r[high]:
        high += 1
    others = _evidence(search)
    others[low : high + 1] = -np.inf
    second = int(np.argmax(others))
    if not np.isfinite(others[second]):
        return float("nan"), float("nan")
    return float(search.lag_s[second]), float(r[second])
