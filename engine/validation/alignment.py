"""Bringing the angles of a result and a reference onto one time axis.

The lag comes from the cross-correlation of several angles at once and is refused where the curves
don't fit. Then angles are paired sample by sample; a constant offset by convention is kept apart
from error. Positions are brought together by `engine.validation.spatial`.

Times: ``result time = reference time + lag_s``.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Literal, NamedTuple, get_args

import numpy as np
from numpy.typing import NDArray

from engine.datatypes import Array, JointAngles, frozen_array
from engine.errors import ConfigError, DataError, ShapeError, UnitError
from engine.validation.resampling import resample_angles, swap_sides, wrap_deg

__all__ = [
    "OffsetMethod",
    "PairedAngles",
    "TimeAlignment",
    "estimate_lag",
    "pair_angles",
]

OffsetMethod = Literal["none", "median", "start"]

GRID_HZ = 100.0
MIN_CORRELATION = 0.75
"""Unlike movements reach 0.7 by chance, as one of the peaks of any two recordings fits best."""
MIN_OVERLAP_S = 1.0
MIN_OVERLAP_SHARE = 0.4
SWAP_GAIN = 0.15
"""Sides count as exchanged when the correlation gains more than this by exchanging them."""
MIN_EXCURSION_DEG = 5.0
"""A curve that moves less tells nothing about the lag."""
UNIT_FACTOR = 20.0
OPPOSITE = -0.6
PEAK_HALF_WIDTH_S = 0.05
BLOCK_S = 0.5
SMOOTH_S = 0.25
STILL_MARGIN = 0.03


@dataclass(frozen=True)
class TimeAlignment:
    """How far a reference is shifted in time, and how sure that is.

    Parameters
    ----------
    lag_s
        To add to the reference's times.
    lag_sigma_s
        Its standard error, from what is left between the curves.
    correlation
        Of all angles together at that lag, each by its excursion; 1 is perfect.
    correlations
        Of every angle that was used.
    overlap_s
        How long both last together.
    runner_up_s, runner_up_correlation
        The best lag apart from this one; movements that repeat have such.
    opposite
        Angles that run the other way: their sign is likely wrong.
    notes
        What to know, in words.
    """

    lag_s: float
    lag_sigma_s: float
    correlation: float
    correlations: Mapping[str, float]
    overlap_s: float
    runner_up_s: float = float("nan")
    runner_up_correlation: float = float("nan")
    opposite: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()

    @property
    def confidence(self) -> float:
        """Return 0 (another lag fits as well) to 1 (no other lag comes near)."""
        other = self.runner_up_correlation
        if not np.isfinite(other):
            return self.correlation
        # The share of what the runner-up leaves unexplained that the best lag explains.
        gain = (self.correlation - other) / max(1.0 - other, 1e-9)
        return float(np.clip(gain, 0.0, 1.0))


@dataclass(frozen=True, eq=False)
class PairedAngles:
    """Two sets of curves at the same times; shape (T, A), degrees, NaN where either is missing.

    `offset_deg` (A,) is the constant difference, result minus reference, that counts as
    convention; `difference_deg` still holds it, `error_deg` does not.
    """

    time_s: Array
    names: tuple[str, ...]
    result_deg: Array
    reference_deg: Array
    offset_deg: Array
    offset_method: OffsetMethod
    sigma_deg: Array

    def __post_init__(self) -> None:
        shape = (np.asarray(self.time_s).shape[0], len(self.names))
        for name in ("time_s", "result_deg", "reference_deg", "offset_deg", "sigma_deg"):
            object.__setattr__(self, name, frozen_array(getattr(self, name)))
        for name in ("result_deg", "reference_deg", "sigma_deg"):
            if getattr(self, name).shape != shape:
                raise ShapeError(f"{name} needs shape {shape}, got {getattr(self, name).shape}.")

    @property
    def difference_deg(self) -> Array:
        """Result minus reference, -180 to 180, shape (T, A)."""
        return wrap_deg(self.result_deg - self.reference_deg)

    @property
    def error_deg(self) -> Array:
        """The difference without the offset by convention, shape (T, A)."""
        return wrap_deg(self.difference_deg - self.offset_deg)


# --------------------------------------------------------------------------- lag


class _Search(NamedTuple):
    """Correlation at every lag: `pooled` (L,), `single` (A, L), `overlap_s` (L,)."""

    lag_s: Array
    pooled: Array
    single: Array
    overlap_s: Array
    names: tuple[str, ...]


def estimate_lag(
    result: JointAngles,
    reference: JointAngles,
    *,
    names: Sequence[str] | None = None,
    max_lag_s: float | None = None,
    min_correlation: float = MIN_CORRELATION,
) -> TimeAlignment:
    """Find the shift in time that fits the curves best.

    All angles count together, each by its excursion, so that curves that hardly move add
    little. Constant offsets don't matter; rates may differ, and either recording may be the
    shorter one. The peak is interpolated between samples.

    Parameters
    ----------
    result, reference
        Angles in one convention.
    names
        Angles to use; by default all that both have.
    max_lag_s
        Lags to try to either side; by default all that leave enough overlap (1 s and 40 % of the
        shorter recording).
    min_correlation
        Below this the recordings count as different movements.

    Raises
    ------
    DataError
        If no angle is common, the recordings are too short, or they don't fit: another movement
        or person, or left and right exchanged.
    UnitError
        If the reference looks like radians taken for degrees or the reverse.
    """
    common = _common_names(result, reference, names)
    search = _search_lags(result, reference, common, max_lag_s)
    best = _find_peak(search)
    _refuse_swapped_sides(result, reference, names, max_lag_s, float(search.pooled[best]))
    if not search.pooled[best] >= min_correlation:
        raise DataError(
            f"The reference does not fit the result: the best correlation is "
            f"{search.pooled[best]:.2f}, at a lag of {search.lag_s[best]:.2f} s; expected at least "
            f"{min_correlation:g}. Is it the same person and movement?"
        )
    lag = _refine_peak(search, best)
    runner, runner_r = _find_runner_up(search, best)
    single = dict(zip(search.names, map(float, search.single[:, best]), strict=True))
    lag_sigma = _estimate_lag_sigma(result, reference, search.names, lag)
    _refuse_wrong_unit(result, reference, search.names, lag)
    opposite = tuple(name for name, r in single.items() if r < OPPOSITE)
    return TimeAlignment(
        lag_s=lag,
        lag_sigma_s=lag_sigma,
        correlation=float(search.pooled[best]),
        correlations=single,
        overlap_s=float(search.overlap_s[best]),
        runner_up_s=runner,
        runner_up_correlation=runner_r,
        opposite=opposite,
        notes=_lag_notes(float(search.pooled[best]), runner, runner_r, opposite),
    )


def _lag_notes(
    correlation: float, runner_up_s: float, runner_up: float, opposite: tuple[str, ...]
) -> tuple[str, ...]:
    notes = []
    if runner_up > correlation - STILL_MARGIN:
        notes.append(
            f"The movement repeats: a lag of {runner_up_s:.2f} s fits nearly as well. Check that "
            "the right repetitions lie on each other, or limit max_lag_s."
        )
    if opposite:
        notes.append(
            f"These angles run the other way than in the result: {', '.join(opposite)}. Check "
            "their sign in the import profile."
        )
    return tuple(notes)


def _common_names(
    result: JointAngles, reference: JointAngles, names: Sequence[str] | None
) -> tuple[str, ...]:
    wanted = result.names if names is None else tuple(names)
    common = tuple(n for n in wanted if n in result.names and n in reference.names)
    if not common:
        raise DataError(
            "Result and reference have no angle in common; the result has "
            f"{', '.join(result.names[:4])} ..., the reference {', '.join(reference.names[:4])} ..."
        )
    return common


def _search_lags(
    result: JointAngles,
    reference: JointAngles,
    names: tuple[str, ...],
    max_lag_s: float | None,
) -> _Search:
    """Compute the correlation of all angles at every lag on a common grid."""
    step = 1.0 / GRID_HZ
    for angles, word in ((result, "result"), (reference, "reference")):
        if angles.time_s.size < 2 or angles.time_s[-1] - angles.time_s[0] < MIN_OVERLAP_S:
            raise DataError(
                f"The {word} lasts less than {MIN_OVERLAP_S:g} s, which is too short to find the "
                "lag; give a longer recording."
            )
    grids = [np.arange(a.time_s[0], a.time_s[-1] + step / 2, step) for a in (result, reference)]
    curves = [
        _pick(resample_angles(a, np.minimum(grid, a.time_s[-1])), names)
        for a, grid in zip((result, reference), grids, strict=True)
    ]
    kept = [
        i
        for i in range(len(names))
        if min(_excursion(c[:, i]) for c in curves) > 0
        and max(_excursion(c[:, i]) for c in curves) >= MIN_EXCURSION_DEG
    ]
    if not kept:
        raise DataError(
            "No common angle moves, so that the lag can't be found; choose a recording with "
            "movement, or give the lag."
        )
    first, second = (c[:, kept] for c in curves)
    count, cross, single, lags = _correlate(first, second)
    lag = grids[0][0] - grids[1][0] + lags * step
    shortest = min(len(first), len(second)) * step
    needed = max(MIN_OVERLAP_S, MIN_OVERLAP_SHARE * shortest)
    allowed = count * step >= needed
    if max_lag_s is not None:
        allowed &= np.abs(lag) <= max_lag_s
    if not allowed.any():
        raise DataError(
            f"Result and reference overlap less than {needed:.1f} s at every lag that was allowed; "
            "check the times, or raise max_lag_s."
        )
    return _Search(
        lag_s=lag[allowed],
        pooled=cross[allowed],
        single=single[:, allowed],
        overlap_s=count[allowed] * step,
        names=tuple(names[i] for i in kept),
    )


def _pick(angles: JointAngles, names: Sequence[str]) -> Array:
    return np.column_stack([angles[name] for name in names])


def _excursion(curve: Array) -> float:
    known = curve[np.isfinite(curve)]
    return float(np.ptp(known)) if known.size > 1 else 0.0


def _correlate(first: Array, second: Array) -> tuple[Array, Array, Array, NDArray[np.int64]]:
    """Correlate gappy curves at every lag, with the mean of each overlap removed.

    Parameters
    ----------
    first, second
        Shape (T1, A) and (T2, A) at one rate; NaN where missing.

    Returns
    -------
    tuple
        Mean overlap in samples (L,), pooled correlation (L,), correlation of each curve (A, L),
        and lag of `second` in samples (L,).
    """
    n = len(first) + len(second) - 1
    lags = np.arange(n) - (len(second) - 1)
    sums = [_lagged_sums(first[:, i], second[:, i], n) for i in range(first.shape[1])]
    counts, covariances, variances = (np.stack(part) for part in zip(*sums, strict=True))
    with np.errstate(invalid="ignore", divide="ignore"):
        single = covariances / variances
        pooled = np.nansum(covariances, axis=0) / np.nansum(variances, axis=0)
    return counts.mean(axis=0), pooled, np.clip(single, -1.0, 1.0), lags


def _lagged_sums(x: Array, y: Array, n: int) -> tuple[Array, Array, Array]:
    """Return overlap, covariance and root of both variances at every lag, by FFT."""
    x_known, y_known = np.isfinite(x).astype(float), np.isfinite(y).astype(float)
    x = np.where(x_known > 0, x - np.nanmean(x), 0.0)
    y = np.where(y_known > 0, y - np.nanmean(y), 0.0)
    size = 1 << (n - 1).bit_length()

    def correlate(a: Array, b: Array) -> Array:
        spectrum = np.fft.rfft(a, size) * np.fft.rfft(b[::-1], size)
        return np.asarray(np.fft.irfft(spectrum, size)[:n])

    count = np.round(correlate(x_known, y_known))
    safe = np.maximum(count, 1.0)
    sum_x, sum_y = correlate(x, y_known), correlate(x_known, y)
    covariance = correlate(x, y) - sum_x * sum_y / safe
    spread_x = np.maximum(correlate(x**2, y_known) - sum_x**2 / safe, 0.0)
    spread_y = np.maximum(correlate(x_known, y**2) - sum_y**2 / safe, 0.0)
    return count, covariance, np.sqrt(spread_x * spread_y)


def _evidence(search: _Search) -> Array:
    """Return how much speaks for each lag: Fisher's z of the correlation, by root overlap.

    A slightly better correlation over a short overlap is worth less than one over all of it.
    """
    z = np.arctanh(np.clip(np.nan_to_num(search.pooled), -0.9999, 0.9999))
    return np.asarray(z * np.sqrt(search.overlap_s))


def _find_peak(search: _Search) -> int:
    """Return the lag with most evidence, moved to the top of its peak."""
    best, r = int(np.argmax(_evidence(search))), search.pooled
    while best > 0 and r[best - 1] > r[best]:
        best -= 1
    while best < r.size - 1 and r[best + 1] > r[best]:
        best += 1
    return best


def _refine_peak(search: _Search, best: int) -> float:
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


def _find_runner_up(search: _Search, best: int) -> tuple[float, float]:
    """Return the best lag that lies on another peak, and its correlation."""
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


def _paired_at(
    result: JointAngles, reference: JointAngles, names: Sequence[str], lag_s: float
) -> tuple[Array, Array, Array]:
    """Return common times and both sets of curves (T, A) there."""
    moved = replace(reference, time_s=reference.time_s + lag_s)
    start = max(result.time_s[0], moved.time_s[0])
    end = min(result.time_s[-1], moved.time_s[-1])
    time = np.arange(start, end, 1.0 / GRID_HZ)
    return (
        time,
        _pick(resample_angles(result, time), names),
        _pick(resample_angles(moved, time), names),
    )


def _estimate_lag_sigma(
    result: JointAngles, reference: JointAngles, names: Sequence[str], lag_s: float
) -> float:
    """Return the standard error of the lag by the sandwich rule over blocks of half a second.

    A residual e moves the best lag by sum(e dx/dt) / sum((dx/dt)^2). Residuals of neighbouring
    samples go together, so their products are summed per block before they are squared.
    """
    time, own, other = _paired_at(result, reference, names, lag_s)
    if time.size < 3:
        return float("nan")
    # Slopes of noise would look like steepness, so they are taken from smoothed curves.
    middle = np.column_stack([_smooth(column) for column in ((own + other) / 2).T])
    slope = np.gradient(middle, time, axis=0)
    residual = own - other
    known = np.isfinite(residual)
    means = np.where(known, residual, 0.0).sum(axis=0) / np.maximum(known.sum(axis=0), 1)
    residual = residual - means
    product = np.nan_to_num(residual * slope).sum(axis=1)
    steepness = float(np.nansum(slope**2))
    block = max(1, round(BLOCK_S * GRID_HZ))
    sums = np.add.reduceat(product, np.arange(0, product.size, block))
    return float(np.sqrt((sums**2).sum()) / steepness) if steepness > 0 else float("nan")


def _smooth(curve: Array) -> Array:
    """Return the moving mean over `SMOOTH_S`, of the samples that exist."""
    window = np.ones(round(SMOOTH_S * GRID_HZ) | 1)
    window = window[: max(1, curve.size - (curve.size % 2 == 0))]
    known = np.isfinite(curve)
    total = np.convolve(np.where(known, curve, 0.0), window, mode="same")
    count = np.convolve(known.astype(np.float64), window, mode="same")
    return np.where(known, total / np.maximum(count, 1.0), np.nan)


def _refuse_swapped_sides(
    result: JointAngles,
    reference: JointAngles,
    names: Sequence[str] | None,
    max_lag_s: float | None,
    as_labelled: float,
) -> None:
    swapped = swap_sides(reference)
    wanted = result.names if names is None else names
    own = [
        name
        for name in wanted
        if name[-2:] in ("_l", "_r")
        and all(name in angles.names for angles in (result, reference, swapped))
    ]
    if len(own) < 2:
        return
    exchanged = _best(_search_lags(result, swapped, tuple(own), max_lag_s))
    labelled = _best(_search_lags(result, reference, tuple(own), max_lag_s))
    if exchanged > max(labelled, as_labelled) + SWAP_GAIN and exchanged >= MIN_CORRELATION:
        raise DataError(
            "Left and right look exchanged in the reference: the correlation is "
            f"{exchanged:.2f} with sides exchanged and {labelled:.2f} as labelled. Set swap_sides "
            "= true in an import profile, or check that the video is not mirrored."
        )


def _best(search: _Search) -> float:
    return float(search.pooled[_find_peak(search)])


def _refuse_wrong_unit(
    result: JointAngles, reference: JointAngles, names: Sequence[str], lag_s: float
) -> None:
    """Refuse a reference whose curves are some 57 times too small or too large."""
    _, own, other = _paired_at(result, reference, names, lag_s)
    moves = [(_excursion(other[:, i]), _excursion(own[:, i])) for i in range(len(names))]
    ratios = [theirs / ours for theirs, ours in moves if ours > 0]
    if not ratios:
        return
    ratio = float(np.median(ratios))
    if not 1 / UNIT_FACTOR <= ratio <= UNIT_FACTOR:
        word = "radians" if ratio < 1 else "degrees"
        raise UnitError(
            f"The angles of the reference move {ratio:.3g} times as much as those of the result; "
            f"they look like {word}. Set angle_unit = '{word[:3]}' in an import profile."
        )


# --------------------------------------------------------------------------- pairing


def pair_angles(
    result: JointAngles,
    reference: JointAngles,
    *,
    lag_s: float = 0.0,
    names: Sequence[str] | None = None,
    offset: OffsetMethod = "median",
    start_s: float = 1.0,
) -> PairedAngles:
    """Bring two sets of angles together, at the result's times within the overlap.

    Parameters
    ----------
    result, reference
        Angles in one convention.
    lag_s
        To add to the reference's times.
    names
        Angles to compare; by default all that both have.
    offset
        What counts as convention: `median` the median difference over the overlap, `start` over
        its first `start_s` seconds, `none` nothing.
    start_s
        How long the start is.

    Raises
    ------
    DataError
        If there is no common angle or the recordings don't overlap.
    ConfigError
        If the offset method is unknown.
    """
    if offset not in get_args(OffsetMethod):
        raise ConfigError(
            f"offset must be one of {', '.join(get_args(OffsetMethod))}, got {offset!r}."
        )
    common = _common_names(result, reference, names)
    moved = replace(reference, time_s=reference.time_s + lag_s)
    inside = (result.time_s >= moved.time_s[0]) & (result.time_s <= moved.time_s[-1])
    if inside.sum() < 2:
        raise DataError(
            f"Result ({result.time_s[0]:.2f} to {result.time_s[-1]:.2f} s) and reference "
            f"({moved.time_s[0]:.2f} to {moved.time_s[-1]:.2f} s with a lag of {lag_s:.2f} s) do "
            "not overlap; estimate the lag first."
        )
    time = result.time_s[inside]
    own = _pick(result, common)[inside]
    other = _pick(resample_angles(moved, time), common)
    missing = ~(np.isfinite(own) & np.isfinite(other))
    own, other = np.where(missing, np.nan, own), np.where(missing, np.nan, other)
    window = time <= time[0] + start_s if offset == "start" else np.ones(time.size, dtype=bool)
    return PairedAngles(
        time_s=time,
        names=common,
        result_deg=own,
        reference_deg=other,
        offset_deg=_offsets(own - other, window, offset),
        offset_method=offset,
        sigma_deg=np.column_stack([result.sigma(name) for name in common])[inside],
    )


def _offsets(difference: Array, window: NDArray[np.bool_], method: OffsetMethod) -> Array:
    """Return the median difference of every angle in the window; NaN without samples there."""
    offsets = np.zeros(difference.shape[1])
    if method == "none":
        return offsets
    for i, column in enumerate(difference.T):
        known = wrap_deg(column[window & np.isfinite(column)])
        if not known.size:
            offsets[i] = np.nan
            continue
        # The median of angles near +-180 is taken around their own mean direction.
        middle = np.degrees(np.angle(np.exp(1j * np.radians(known)).sum()))
        offsets[i] = wrap_deg(middle + np.median(wrap_deg(known - middle)))
    return offsets
