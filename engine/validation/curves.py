"""How far one joint-angle curve is from another.

Both curves are sampled at the same times (alignment comes before). Differences are estimate minus
reference, wrapped to +-180 degrees. Only frames in which both exist count, and every result says
how many those were.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from engine.datatypes import Array
from engine.errors import ConfigError, DataError, ShapeError
from engine.validation.statistics import effective_sample_size

__all__ = [
    "CurveAgreement",
    "LinearFit",
    "PeakError",
    "angle_difference",
    "compare_curves",
    "compute_cmc",
    "compute_linear_fit",
    "unwrap_deg",
    "wrap_deg",
]

FLAT_DEG = 1e-9
"""A curve that varies less than this is a constant with rounding noise."""


@dataclass(frozen=True)
class LinearFit:
    """The linear fit method (LFM): ``estimate = offset_deg + slope * reference``."""

    slope: float
    offset_deg: float
    r2: float


@dataclass(frozen=True)
class PeakError:
    """Difference at an extreme of the curves.

    `error_deg` compares the values of both extremes, wherever they are; `lag_s` is positive when
    the estimate's comes later. The time of an extreme at the first or last frame, or beside a gap,
    says nothing about the movement: `lag_s` is then NaN.
    """

    error_deg: float
    lag_s: float
    reference_deg: float
    reference_time_s: float


@dataclass(frozen=True)
class CurveAgreement:
    """Agreement of one angle in one trial, degrees.

    Parameters
    ----------
    n_samples, n_frames
        Frames in which both curves exist, and all frames.
    n_effective
        Independent samples the differences are worth.
    bias_deg, sd_deg
        Mean and standard deviation (n - 1) of the signed difference.
    mae_deg, sd_absolute_deg
        Mean and standard deviation (n - 1) of the absolute difference.
    rmse_deg, centred_rmse_deg
        Root mean square of the difference, with and without the bias.
    max_deg, p95_deg
        Largest absolute difference, and the one that at least 95 % of the frames don't exceed.
    r, cmc, linear_fit
        Correlation, coefficient of multiple correlation, linear fit; NaN where undefined.
    rom_estimated_deg, rom_reference_deg
        Range of motion: highest minus lowest value of each curve.
    maximum, minimum
        Errors at the extremes.
    percent_of_excursion, percent_of_model_range
        Mean absolute difference as a share of the reference's range of motion, and of the
        model's coordinate range where that is known.
    """

    n_samples: int
    n_frames: int
    n_effective: float
    bias_deg: float
    sd_deg: float
    mae_deg: float
    sd_absolute_deg: float
    rmse_deg: float
    centred_rmse_deg: float
    max_deg: float
    p95_deg: float
    r: float
    cmc: float
    linear_fit: LinearFit
    rom_estimated_deg: float
    rom_reference_deg: float
    maximum: PeakError
    minimum: PeakError
    percent_of_excursion: float
    percent_of_model_range: float

    @property
    def rom_error_deg(self) -> float:
        """Range of motion of the estimate minus that of the reference."""
        return self.rom_estimated_deg - self.rom_reference_deg


def wrap_deg(angle_deg: ArrayLike) -> Array:
    """Bring angles into -180 (excluded) to 180 degrees; NaN stays NaN."""
    angle = np.asarray(angle_deg, dtype=np.float64)
    wrapped = angle - 360.0 * np.round(angle / 360.0)
    return np.where(wrapped <= -180.0, wrapped + 360.0, wrapped)


def angle_difference(estimated_deg: ArrayLike, reference_deg: ArrayLike) -> Array:
    """Return estimate minus reference, wrapped; NaN where one is missing.

    Raises
    ------
    ShapeError
        If the shapes differ.
    """
    a, b = np.asarray(estimated_deg, np.float64), np.asarray(reference_deg, np.float64)
    if a.shape != b.shape:
        raise ShapeError(
            f"Both curves need the same shape, got {a.shape} and {b.shape}. Bring them to one time "
            "base first."
        )
    return wrap_deg(np.where(np.isfinite(a) & np.isfinite(b), a - b, np.nan))


def compare_curves(
    time_s: ArrayLike,
    estimated_deg: ArrayLike,
    reference_deg: ArrayLike,
    *,
    model_range_deg: float = math.nan,
) -> CurveAgreement:
    """Compare one angle's curve with its reference.

    Parameters
    ----------
    time_s
        Shape (T,), s, increasing.
    estimated_deg, reference_deg
        Shape (T,), degrees; NaN where missing.
    model_range_deg
        Range of the coordinate in the model (the elbow's of 0 to 150 is 150).

    Returns
    -------
    CurveAgreement
        Every figure that the samples can't give is NaN.

    Raises
    ------
    ShapeError
        If the arrays don't fit together.
    DataError
        If the times don't increase.
    ConfigError
        If the model range is not positive.
    """
    time = _require_times(time_s)
    difference = angle_difference(estimated_deg, reference_deg)
    if difference.shape != time.shape:
        raise ShapeError(f"Curves need shape {time.shape} like time_s, got {difference.shape}.")
    if model_range_deg <= 0:
        raise ConfigError(f"A model's range must be positive, got {model_range_deg:g} degrees.")
    known = np.isfinite(difference)
    reference = unwrap_deg(np.asarray(reference_deg, dtype=np.float64), known)
    estimated = reference + difference
    d, absolute = difference[known], np.abs(difference[known])
    maximum, minimum = (_compare_peaks(time, estimated, reference, sign) for sign in (1, -1))
    rom = _range(reference[known])
    mae = _mean(absolute)
    return CurveAgreement(
        n_samples=d.size,
        n_frames=time.size,
        n_effective=effective_sample_size(difference),
        bias_deg=_mean(d),
        sd_deg=_sd(d),
        mae_deg=mae,
        sd_absolute_deg=_sd(absolute),
        rmse_deg=math.sqrt(_mean(d**2)),
        centred_rmse_deg=math.sqrt(_mean((d - _mean(d)) ** 2)),
        max_deg=float(absolute.max()) if d.size else math.nan,
        p95_deg=_p95(absolute),
        r=_correlation(estimated[known], reference[known]),
        cmc=compute_cmc(np.stack([estimated, reference])[None]),
        linear_fit=compute_linear_fit(estimated[known], reference[known]),
        rom_estimated_deg=_range(estimated[known]),
        rom_reference_deg=rom,
        maximum=maximum,
        minimum=minimum,
        percent_of_excursion=100.0 * mae / rom if rom > FLAT_DEG else math.nan,
        percent_of_model_range=100.0 * mae / model_range_deg,
    )


def _require_times(time_s: ArrayLike) -> Array:
    time = np.asarray(time_s, dtype=np.float64)
    if time.ndim != 1:
        raise ShapeError(f"time_s needs one dimension, got shape {time.shape}.")
    if time.size > 1 and not np.all(np.diff(time) > 0):
        raise DataError("time_s must increase from frame to frame, but it does not.")
    return time


def unwrap_deg(curve_deg: Array, known: NDArray[np.bool_]) -> Array:
    """Return a curve (T,) without jumps of a full turn; NaN where not `known`."""
    curve = np.full(curve_deg.shape, np.nan)
    curve[known] = np.unwrap(curve_deg[known], period=360.0)
    return curve


def _mean(values: Array) -> float:
    return float(values.mean()) if values.size else math.nan


def _sd(values: Array) -> float:
    return float(values.std(ddof=1)) if values.size > 1 else math.nan


def _p95(values: Array) -> float:
    # The smallest value that at least 95 % don't exceed; interpolation could fall short of 95 %.
    return float(np.quantile(values, 0.95, method="inverted_cdf")) if values.size else math.nan


def _range(values: Array) -> float:
    return float(np.ptp(values)) if values.size else math.nan


def _is_flat(values: Array) -> bool:
    return values.size < 2 or float(np.ptp(values)) <= FLAT_DEG


def _correlation(a: Array, b: Array) -> float:
    if a.size < 3 or _is_flat(a) or _is_flat(b):
        return math.nan
    x, y = a - a.mean(), b - b.mean()
    r = float(x @ y) / math.sqrt(float(x @ x) * float(y @ y))
    return max(-1.0, min(1.0, r))


def compute_linear_fit(estimated_deg: Array, reference_deg: Array) -> LinearFit:
    """Fit the estimate as a linear function of the reference by least squares.

    Parameters
    ----------
    estimated_deg, reference_deg
        Shape (n,), without gaps.

    Returns
    -------
    LinearFit
        NaN with fewer than three samples or a constant reference; `r2` NaN for a constant estimate.

    References
    ----------
    .. [1] Iosa et al. (2014), BioMed Res. Int. 2014, 214156.
    """
    if estimated_deg.size < 3 or _is_flat(reference_deg):
        return LinearFit(math.nan, math.nan, math.nan)
    x = reference_deg - reference_deg.mean()
    slope = float(x @ estimated_deg) / float(x @ x)
    offset = float(estimated_deg.mean()) - slope * float(reference_deg.mean())
    return LinearFit(slope, offset, _correlation(estimated_deg, reference_deg) ** 2)


def compute_cmc(curves_deg: ArrayLike) -> float:
    """Compute the coefficient of multiple correlation between protocols.

    The form of Ferrari et al. for several protocols over the same movements: how much of the
    variance about each movement's mean the protocols share. An offset between them lowers it.

    Parameters
    ----------
    curves_deg
        Shape (W, P, F): movements, protocols (such as estimate and reference), frames. A frame
        missing in one protocol is left out of its movement.

    Returns
    -------
    float
        0 to 1; NaN where the differences between protocols exceed the movement itself (the root
        would be that of a negative number, usual for angles that hardly move) or nothing moves.

    Raises
    ------
    ShapeError
        If there are not three dimensions and at least two protocols.

    References
    ----------
    .. [1] Kadaba et al. (1989), J. Orthop. Res. 7, 849-860.
    .. [2] Ferrari, Cutti & Cappello (2010), Gait Posture 31, 540-542.
    """
    curves = np.asarray(curves_deg, dtype=np.float64)
    if curves.ndim != 3 or curves.shape[1] < 2:
        raise ShapeError(
            f"curves_deg needs shape (movements, protocols >= 2, frames), got {curves.shape}."
        )
    n_protocols = curves.shape[1]
    between, total, n_frames, n_all = 0.0, 0.0, 0, 0
    for movement in curves:
        kept = movement[:, np.isfinite(movement).all(axis=0)]
        if kept.shape[1] == 0:
            continue
        between += float(np.square(kept - kept.mean(axis=0)).sum())
        total += float(np.square(kept - kept.mean()).sum())
        n_frames += kept.shape[1]
        n_all += kept.size - 1
    if n_frames < 2 or total <= n_all * FLAT_DEG**2:
        return math.nan
    ratio = (between / (n_frames * (n_protocols - 1))) / (total / n_all)
    return math.sqrt(1.0 - ratio) if ratio <= 1.0 else math.nan


def _compare_peaks(time: Array, estimated: Array, reference: Array, sign: int) -> PeakError:
    value, at, is_inside = _find_peak(time, sign * estimated)
    truth, truth_at, truth_is_inside = _find_peak(time, sign * reference)
    lag = at - truth_at if is_inside and truth_is_inside else math.nan
    return PeakError(sign * (value - truth), lag, sign * truth, truth_at)


def _find_peak(time: Array, curve: Array) -> tuple[float, float, bool]:
    """Return the highest value, its time, and whether it is a real extreme of the movement.

    A parabola through the highest frame and its neighbours places it between frames.
    """
    if not np.isfinite(curve).any():
        return math.nan, math.nan, False
    i = int(np.nanargmax(curve))
    value, at = float(curve[i]), float(time[i])
    if i in (0, curve.size - 1) or not np.isfinite(curve[i - 1 : i + 2]).all():
        return value, at, False
    before, after = time[i - 1] - at, time[i + 1] - at
    down, up = curve[i - 1] - value, curve[i + 1] - value
    # value + slope t + bend t^2 through both neighbours
    bend = (up / after - down / before) / (after - before)
    slope = down / before - bend * before
    if not bend < 0:
        return value, at, True
    shift = -slope / (2 * bend)
    return value - slope**2 / (4 * bend), at + float(shift), True
