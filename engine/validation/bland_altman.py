"""Limits of agreement with several measurements per subject."""

from __future__ import annotations

import math
from collections.abc import Hashable, Iterable
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.special import chdtri, ndtri, stdtr, stdtrit

from engine.datatypes import Array
from engine.errors import ShapeError
from engine.validation.statistics import UNKNOWN, Interval, group_codes, require_level

__all__ = ["BlandAltman", "ProportionalBias", "compute_bland_altman", "compute_proportional_bias"]


@dataclass(frozen=True)
class BlandAltman:
    """Bias and limits of agreement, in the unit of the data.

    Differences are estimate minus reference. `between_variance` is the variance of the clusters'
    (subjects') true mean differences, `within_variance` that inside a cluster; `sd` is the root of
    their sum. With one cluster the variance between clusters is unknown (NaN), `sd` is that inside
    it, and the limits hold for that cluster only. `n_effective` is the number of independent
    samples that the intervals count.
    """

    n_samples: int
    n_clusters: int
    n_effective: float
    bias: float
    bias_interval: Interval
    between_variance: float
    within_variance: float
    sd: float
    lower: float
    lower_interval: Interval
    upper: float
    upper_interval: Interval
    coverage: float = 0.95
    level: float = 0.95

    @property
    def outer_limits(self) -> Interval:
        """The outer ends of the intervals of both limits: the limits at their worst."""
        return Interval(self.lower_interval.low, self.upper_interval.high)

    @property
    def is_single_cluster(self) -> bool:
        """Whether the limits are those of one cluster, and say nothing about others."""
        return self.n_clusters == 1


@dataclass(frozen=True)
class ProportionalBias:
    """How the difference changes with the size measured.

    ``difference = offset + slope * size``; `against` names what the size is. Standard error and
    interval allow for dependence inside clusters and need at least two of them (NaN otherwise).
    """

    slope: float
    offset: float
    slope_interval: Interval
    p: float
    n_samples: int
    n_clusters: int
    against: Literal["mean", "reference"] = "mean"
    level: float = 0.95


@dataclass(frozen=True)
class _Clusters:
    """Size, mean and sum of squares about the mean of every cluster; n_effective of each."""

    size: Array
    mean: Array
    squares: Array
    worth: Array


def compute_bland_altman(
    difference: ArrayLike,
    clusters: Iterable[Hashable],
    *,
    n_effective: ArrayLike | None = None,
    coverage: float = 0.95,
    level: float = 0.95,
) -> BlandAltman:
    """Compute bias and limits of agreement where a cluster has several pairs.

    The true value may vary inside a cluster, as it does over a movement. The variance is split by a
    one-way analysis of variance of the differences; the intervals are Zou's, with Student's
    quantiles for the mean, since clusters are few.

    Parameters
    ----------
    difference
        Shape (n,), estimate minus reference; NaN is left out.
    clusters
        One label per difference: the subject (or the trial, if there is one subject).
    n_effective
        Shape (G,): how many independent samples each cluster is worth, in order of first
        appearance; by default all of its samples. Frames need it, or the intervals are too narrow.
    coverage
        Share of the differences that the limits should hold.
    level
        Confidence level of the intervals.

    Returns
    -------
    BlandAltman
        NaN where there are too few samples.

    References
    ----------
    .. [1] Bland & Altman (1999), Stat. Methods Med. Res. 8, 135-160.
    .. [2] Bland & Altman (2007), J. Biopharm. Stat. 17, 571-582.
    .. [3] Zou (2013), Stat. Methods Med. Res. 22, 630-642.
    """
    require_level(level)
    require_level(coverage)
    values = np.asarray(difference, dtype=np.float64)
    codes, n_labels = group_codes(clusters, values.size)
    groups = _summarise(values, codes, n_labels, n_effective)
    n, k = int(groups.size.sum()), groups.size.size
    bias = float(values[np.isfinite(values)].mean()) if n else math.nan
    between, within = _variances(groups)
    sd = math.sqrt(float(np.nansum([between, within]))) if n > 1 else math.nan
    z = float(ndtri(0.5 + coverage / 2))
    arm, low, high = _interval_arms(groups, sd, z, level)
    lower, upper = bias - z * sd, bias + z * sd
    return BlandAltman(
        n_samples=n,
        n_clusters=k,
        n_effective=float(groups.worth.sum()),
        bias=bias,
        bias_interval=Interval(bias - arm, bias + arm),
        between_variance=float(between),
        within_variance=within,
        sd=sd,
        lower=lower,
        lower_interval=Interval(lower - high, lower + low),
        upper=upper,
        upper_interval=Interval(upper - low, upper + high),
        coverage=coverage,
        level=level,
    )


def _summarise(
    values: Array, codes: NDArray[np.intp], n_labels: int, n_effective: ArrayLike | None
) -> _Clusters:
    known = np.isfinite(values)
    size: Array = np.bincount(codes[known], minlength=n_labels).astype(np.float64)
    worth = size if n_effective is None else np.asarray(n_effective, dtype=np.float64)
    if worth.shape != (n_labels,):
        raise ShapeError(
            f"n_effective needs one value per cluster ({n_labels}), got {worth.shape}."
        )
    total = np.bincount(codes[known], weights=values[known], minlength=n_labels)
    mean = total / np.where(size > 0, size, np.nan)
    residual = values[known] - mean[codes[known]]
    squares = np.bincount(codes[known], weights=residual**2, minlength=n_labels)
    kept = size > 0
    spread: Array = np.asarray(squares, dtype=np.float64)
    return _Clusters(size[kept], mean[kept], spread[kept], np.minimum(worth, size)[kept])


def _variances(groups: _Clusters) -> tuple[float, float]:
    """Return the variance between and within clusters by analysis of variance; NaN if unknown."""
    n, k = float(groups.size.sum()), groups.size.size
    within = float(groups.squares.sum()) / (n - k) if n > k else math.nan
    if k < 2:
        return math.nan, within
    grand = float(groups.size @ groups.mean) / n
    mean_square = float(groups.size @ (groups.mean - grand) ** 2) / (k - 1)
    divisor = (n**2 - float(groups.size @ groups.size)) / ((k - 1) * n)
    return max(0.0, (mean_square - np.nan_to_num(within)) / divisor), within


def _interval_arms(
    groups: _Clusters, sd: float, z: float, level: float
) -> tuple[float, float, float]:
    """Return half the width of the bias's interval, and how far a limit's reaches in and out."""
    k = groups.size.size
    df_within = float(groups.worth.sum()) - k
    n = float(groups.size.sum())
    within = float(groups.squares.sum()) / (n - k) if n > k else 0.0
    if k > 1:
        means = float(groups.mean.var(ddof=1))
        rest = (1.0 - float(np.mean(1.0 / groups.worth))) * within
        arm = float(stdtrit(k - 1, 0.5 + level / 2)) * math.sqrt(means / k)
        parts = ((means, float(k - 1)), (rest, df_within))
    elif df_within > 0:
        arm = float(stdtrit(df_within, 0.5 + level / 2)) * sd / math.sqrt(df_within + 1.0)
        parts = ((0.0, 1.0), (within, df_within))
    else:
        return math.nan, math.nan, math.nan
    total = math.sqrt(sum(part for part, _ in parts))
    inner, outer = _variance_interval(parts, level)
    return arm, math.hypot(arm, z * (total - inner)), math.hypot(arm, z * (outer - total))


def _variance_interval(parts: tuple[tuple[float, float], ...], level: float) -> tuple[float, float]:
    """Return the interval of the root of a sum of variances, each with its degrees of freedom."""
    total, down, up = 0.0, 0.0, 0.0
    for variance, df in parts:
        if variance <= 0.0:
            continue
        if not df > 0:
            return math.nan, math.nan
        total += variance
        down += (variance * (1.0 - df / float(chdtri(df, 0.5 - level / 2)))) ** 2
        up += (variance * (df / float(chdtri(df, 0.5 + level / 2)) - 1.0)) ** 2
    return math.sqrt(max(0.0, total - math.sqrt(down))), math.sqrt(total + math.sqrt(up))


def compute_proportional_bias(
    estimated: ArrayLike,
    reference: ArrayLike,
    clusters: Iterable[Hashable],
    *,
    against: Literal["mean", "reference"] = "mean",
    level: float = 0.95,
) -> ProportionalBias:
    """Regress the difference on the size of what is measured.

    Against the mean of both, as Bland and Altman plot it, two methods of unequal spread give a
    slope though neither is biased; against the reference, errors of the reference do. Take the
    reference where it is far better than the estimate.

    Parameters
    ----------
    estimated, reference
        Shape (n,); pairs with a missing value are left out.
    clusters
        One label per pair.
    against
        What the difference is regressed on.
    level
        Confidence level of the slope's interval.

    Returns
    -------
    ProportionalBias
        NaN where the size doesn't vary.
    """
    a, b = np.asarray(estimated, dtype=np.float64), np.asarray(reference, dtype=np.float64)
    if a.shape != b.shape or a.ndim != 1:
        raise ShapeError(f"Expected two arrays of one length, got {a.shape} and {b.shape}.")
    codes, n_labels = group_codes(clusters, a.size)
    known = np.isfinite(a) & np.isfinite(b)
    a, b, codes = a[known], b[known], codes[known]
    n, k = a.size, np.unique(codes).size
    size = b if against == "reference" else (a + b) / 2
    x = size - size.mean() if n else size
    sxx = float(x @ x)
    if n < 3 or sxx <= 1e-20 * (1.0 + float(size @ size)):
        return ProportionalBias(math.nan, math.nan, UNKNOWN, math.nan, n, k, against, level)
    slope = float(x @ (a - b)) / sxx
    offset = float((a - b).mean()) - slope * float(size.mean())
    score = np.bincount(codes, weights=x * (a - b - offset - slope * size), minlength=n_labels)
    interval, p = UNKNOWN, math.nan
    if k > 1:
        # The sandwich with the usual small-sample factor ("CR1").
        factor = k / (k - 1) * (n - 1) / (n - 2)
        error = math.sqrt(factor * float(score @ score)) / sxx
        half = float(stdtrit(k - 1, 0.5 + level / 2)) * error
        interval = Interval(slope - half, slope + half)
        p = 2.0 * float(stdtr(k - 1, -abs(slope) / error)) if error > 0 else math.nan
    return ProportionalBias(slope, offset, interval, p, n, k, against, level)
