"""Statistics of paired differences: tests, equivalence, dependence, resampling.

All functions take plain arrays, leave out what is missing (NaN) and say how many samples they
used. A figure that the data can't give (one sample, no spread) is NaN, never 0. Units are those of
the data.

Neighbouring frames of a video are near-copies of each other. A test that counts them as independent
finds "significant" whatever it is given, so everything here that works on frames also states the
effective number of samples.
"""

from __future__ import annotations

import math
from collections.abc import Hashable, Iterable, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.fft import next_fast_len
from scipy.special import ndtr, stdtr, stdtrit

from engine.datatypes import Array
from engine.errors import ConfigError, DataError, ShapeError

__all__ = [
    "DEPENDENCE_WARNING",
    "MIN_CLUSTERS",
    "N_RESAMPLES",
    "BootstrapResult",
    "EquivalenceTest",
    "FrameTest",
    "Interval",
    "PairedTest",
    "adjust_holm",
    "bootstrap_clusters",
    "compute_equivalence",
    "compute_frame_t_test",
    "compute_paired_t_test",
    "effective_sample_size",
    "group_codes",
    "lag_one_correlation",
    "lag_one_sample_size",
    "mean_per_cluster",
    "percentile_interval",
    "require_level",
    "resampling_counts",
]

DEPENDENCE_WARNING = (
    "A t-test on frames treats them as independent, which neighbouring frames are not: its p is "
    "far too small. Use the test on trials or subjects; the corrected test here only counts the "
    "effective number of samples."
)

N_RESAMPLES = 10_000
MIN_CLUSTERS = 5
"""With three, bootstrap intervals of 95 % hold the truth in fewer than 80 % of studies."""


class Interval(NamedTuple):
    """A confidence interval; NaN at both ends where it can't be computed."""

    low: float
    high: float

    @property
    def is_known(self) -> bool:
        """Whether both ends are numbers."""
        return math.isfinite(self.low) and math.isfinite(self.high)

    def contains(self, value: float) -> bool:
        """Whether `value` lies inside; false for an unknown interval."""
        return self.low <= value <= self.high


UNKNOWN = Interval(math.nan, math.nan)


@dataclass(frozen=True)
class PairedTest:
    """A paired t-test.

    `n` samples were used and counted as `n_effective` independent ones; `interval` is the
    confidence interval of the mean difference at `level`.
    """

    n: int
    n_effective: float
    mean: float
    sd: float
    t: float
    df: float
    p: float
    interval: Interval
    level: float = 0.95


@dataclass(frozen=True)
class FrameTest:
    """A paired t-test on frames: as papers report it, and with dependence allowed for.

    `n_lag_one` is the effective number of samples by the lag-one formula, for comparison.
    """

    naive: PairedTest
    corrected: PairedTest
    n_sequences: int
    n_lag_one: float
    warning: str = DEPENDENCE_WARNING


@dataclass(frozen=True)
class EquivalenceTest:
    """Two one-sided tests against ``-margin`` and ``+margin`` (TOST).

    `p` is the larger of both; `interval` has the level ``1 - 2 alpha``, so that it lies within the
    margin exactly when `is_equivalent`.
    """

    n: int
    mean: float
    margin: float
    p_lower: float
    p_upper: float
    p: float
    interval: Interval
    alpha: float = 0.05

    @property
    def is_equivalent(self) -> bool:
        """Whether the mean difference was shown to lie within the margin."""
        return self.p < self.alpha


@dataclass(frozen=True)
class BootstrapResult:
    """A figure with its interval from resampling whole clusters (subjects or trials)."""

    estimate: float
    interval: Interval
    standard_error: float
    n_samples: int
    n_clusters: int
    n_resamples: int
    seed: int
    level: float = 0.95


def require_level(level: float) -> None:
    """Raise `ConfigError` unless a confidence level lies between 0 and 1."""
    if not 0.0 < level < 1.0:
        raise ConfigError(
            f"A confidence level lies between 0 and 1, got {level:g}. Give e.g. 0.95."
        )


def _vector(values: ArrayLike, name: str) -> Array:
    vector = np.asarray(values, dtype=np.float64)
    if vector.ndim != 1:
        raise ShapeError(f"{name} needs one dimension, got shape {vector.shape}.")
    return vector


def group_codes(clusters: Iterable[Hashable], n: int) -> tuple[NDArray[np.intp], int]:
    """Give every cluster a number, in order of appearance.

    Parameters
    ----------
    clusters
        One label per sample; long ones are numbered fastest as an array.
    n
        Number of samples expected.

    Returns
    -------
    tuple
        Codes 0 to G - 1, shape (n,), and G.

    Raises
    ------
    ShapeError
        If there are not `n` labels.
    """
    if isinstance(clusters, np.ndarray):
        labels, first, codes = np.unique(clusters, return_index=True, return_inverse=True)
        rank = np.empty(labels.size, dtype=np.intp)
        rank[np.argsort(first)] = np.arange(labels.size)
        codes, n_clusters = rank[codes], labels.size
    else:
        number: dict[Hashable, int] = {}
        codes = np.array([number.setdefault(x, len(number)) for x in clusters], dtype=np.intp)
        n_clusters = len(number)
    if codes.shape != (n,):
        raise ShapeError(f"Expected one cluster label per sample ({n}), got {codes.size}.")
    return codes, n_clusters


# --------------------------------------------------------------------------- dependence


def lag_one_correlation(sequence: ArrayLike) -> float:
    """Compute the correlation of a sequence with itself one sample later.

    Parameters
    ----------
    sequence
        Shape (T,), evenly sampled; only neighbours that both exist count.

    Returns
    -------
    float
        -1 to 1; NaN with fewer than three neighbours or without spread.
    """
    values = _vector(sequence, "sequence")
    known = np.isfinite(values)
    if known.sum() < 4:
        return math.nan
    centred = values - values[known].mean()
    both = known[1:] & known[:-1]
    now, later = centred[:-1][both], centred[1:][both]
    scale = math.sqrt(float(now @ now) * float(later @ later))
    # A constant with rounding noise has no correlation to speak of.
    if both.sum() < 3 or scale <= 1e-20 * (1.0 + float(np.square(values[known]).sum())):
        return math.nan
    return float(now @ later) / scale


def lag_one_sample_size(sequence: ArrayLike) -> float:
    """Compute the effective number of samples from the lag-one correlation alone.

    ``n (1 - r1) / (1 + r1)`` holds for a first-order autoregressive sequence. The errors of
    filtered keypoints are smoother than that, and the formula then gives far too few, the fewer the
    higher the frame rate; `effective_sample_size` does not.

    Parameters
    ----------
    sequence
        Shape (T,), evenly sampled; NaN where missing.

    Returns
    -------
    float
        1 to n; 1 where the correlation is undefined, 0 without samples.

    References
    ----------
    .. [1] Bayley & Hammersley (1946), Suppl. J. R. Stat. Soc. 8, 184-197.
    """
    values = _vector(sequence, "sequence")
    n = int(np.isfinite(values).sum())
    r1 = lag_one_correlation(values)
    if n == 0 or math.isnan(r1):
        return float(min(n, 1))
    return float(np.clip(n * (1.0 - r1) / (1.0 + max(r1, 0.0)), 1.0, n))


def effective_sample_size(sequence: ArrayLike) -> float:
    """Compute how many independent samples a sequence is worth for its mean.

    ``n / (1 + 2 sum r_k)``, the correlations at all lags k summed up to where pairs of them are no
    longer positive and not allowed to rise again on the way (Geyer's initial monotone sequence).
    It needs no model of the dependence.

    Parameters
    ----------
    sequence
        Shape (T,), evenly sampled; NaN where missing.

    Returns
    -------
    float
        1 to n; 1 where there is no spread or fewer than four samples, 0 without samples. Of a
        sequence not much longer than its correlation it is an overestimate by up to a third.

    References
    ----------
    .. [1] Geyer (1992), Stat. Sci. 7, 473-483.
    """
    values = _vector(sequence, "sequence")
    n = int(np.isfinite(values).sum())
    known = np.isfinite(values)
    if n < 4 or np.ptp(values[known]) <= 1e-10 * (1.0 + np.abs(values[known]).max()):
        return float(min(n, 1))
    centred = np.where(known, values - values[known].mean(), 0.0)
    # Products at all lags at once; gaps count as zeros, so that each lag weighs by its pairs.
    spectrum = np.fft.rfft(centred, next_fast_len(2 * centred.size, real=True))
    products = np.fft.irfft(np.square(np.abs(spectrum)))[: centred.size // 2 * 2]
    pairs = (products[0::2] + products[1::2]) / products[0]
    stops = np.flatnonzero(pairs <= 0)
    positive = np.minimum.accumulate(pairs[: stops[0]] if stops.size else pairs)
    return float(np.clip(n / max(2.0 * positive.sum() - 1.0, 1.0), 1.0, n))


# --------------------------------------------------------------------------- tests


def compute_paired_t_test(
    difference: ArrayLike, *, n_effective: float | None = None, level: float = 0.95
) -> PairedTest:
    """Test whether paired differences have a mean of zero.

    A large p is not agreement: a method that scatters enough always passes. Agreement is shown by
    `compute_equivalence`.

    Parameters
    ----------
    difference
        Shape (n,); one value per independent unit, such as a trial or a subject.
    n_effective
        Number of independent samples the differences are worth; by default all of them.
    level
        Confidence level of the interval of the mean.

    Returns
    -------
    PairedTest
        t, p and interval are NaN with fewer than two (effective) samples. Differences that are all
        the same and not zero give p = 0; all zero, NaN.
    """
    require_level(level)
    values = _vector(difference, "difference")
    values = values[np.isfinite(values)]
    n = values.size
    independent = float(n) if n_effective is None else float(n_effective)
    mean = float(values.mean()) if n else math.nan
    sd = _sd(values)
    df = independent - 1.0
    if not df > 0 or math.isnan(sd):
        return PairedTest(n, independent, mean, sd, math.nan, math.nan, math.nan, UNKNOWN, level)
    error = sd / math.sqrt(independent)
    t = _ratio(mean, error)
    half = float(stdtrit(df, 0.5 + level / 2)) * error
    p = 2.0 * float(stdtr(df, -abs(t)))
    return PairedTest(n, independent, mean, sd, t, df, p, Interval(mean - half, mean + half), level)


def compute_frame_t_test(sequences: Sequence[ArrayLike], *, level: float = 0.95) -> FrameTest:
    """Test differences frame by frame, with and without their dependence.

    Parameters
    ----------
    sequences
        One evenly sampled series of differences per trial, shape (T,) each.
    level
        Confidence level of the intervals.

    Returns
    -------
    FrameTest
        The naive test of the papers beside one that counts the effective number of samples, summed
        over the trials; the latter still takes trials of one subject as independent.
    """
    series = [_vector(s, "a sequence of differences") for s in sequences]
    pooled = np.concatenate(series) if series else np.empty(0)
    worth = [effective_sample_size(s) for s in series]
    n_effective = float(sum(worth)) if worth else math.nan
    return FrameTest(
        naive=compute_paired_t_test(pooled, level=level),
        corrected=compute_paired_t_test(pooled, n_effective=n_effective, level=level),
        n_sequences=sum(w > 0 for w in worth),
        n_lag_one=float(sum(lag_one_sample_size(s) for s in series)),
    )


def compute_equivalence(
    difference: ArrayLike, *, margin: float, alpha: float = 0.05
) -> EquivalenceTest:
    """Test whether the mean difference lies within ``-margin`` to ``+margin`` (paired TOST).

    Parameters
    ----------
    difference
        Shape (n,); one value per independent unit.
    margin
        Largest difference that doesn't matter, in the unit of the data.
    alpha
        Level of each one-sided test.

    Returns
    -------
    EquivalenceTest
        p is NaN with fewer than two values.

    Raises
    ------
    ConfigError
        If the margin is not positive.

    References
    ----------
    .. [1] Schuirmann (1987), J. Pharmacokinet. Biopharm. 15, 657-680.
    """
    if not margin > 0:
        raise ConfigError(f"An equivalence margin must be positive, got {margin:g}.")
    require_level(1.0 - 2.0 * alpha)
    test = compute_paired_t_test(difference, level=1.0 - 2.0 * alpha)
    if math.isnan(test.df):
        nan = math.nan
        return EquivalenceTest(test.n, test.mean, margin, nan, nan, nan, UNKNOWN, alpha)
    error = test.sd / math.sqrt(test.n)
    above, below = test.mean + margin, test.mean - margin
    # A mean right on the margin is as likely beyond it, with or without spread.
    p_lower = float(stdtr(test.df, -_ratio(above, error))) if above else 0.5
    p_upper = float(stdtr(test.df, _ratio(below, error))) if below else 0.5
    return EquivalenceTest(
        n=test.n,
        mean=test.mean,
        margin=margin,
        p_lower=p_lower,
        p_upper=p_upper,
        p=max(p_lower, p_upper),
        interval=test.interval,
        alpha=alpha,
    )


def adjust_holm(p_values: ArrayLike) -> Array:
    """Adjust p-values for their number by Holm's step-down procedure.

    Parameters
    ----------
    p_values
        Shape (m,); NaN for tests that could not be done, which don't count.

    Returns
    -------
    Array
        Shape (m,), 0 to 1; NaN stays NaN.

    References
    ----------
    .. [1] Holm (1979), Scand. J. Stat. 6, 65-70.
    """
    p = _vector(p_values, "p_values")
    adjusted = np.full(p.shape, np.nan)
    known = np.flatnonzero(np.isfinite(p))
    if not np.all((p[known] >= 0) & (p[known] <= 1)):
        raise DataError("A p-value lies between 0 and 1, but at least one here does not.")
    order = known[np.argsort(p[known], kind="stable")]
    steps = p[order] * np.arange(order.size, 0, -1)
    adjusted[order] = np.minimum(np.maximum.accumulate(steps), 1.0)
    return adjusted


def _sd(values: Array) -> float:
    return float(values.std(ddof=1)) if values.size > 1 else math.nan


def _ratio(value: float, error: float) -> float:
    """Divide as a limit: infinite without an error, NaN for 0 / 0."""
    if error > 0:
        return value / error
    return math.nan if value == 0 else math.copysign(math.inf, value)


# --------------------------------------------------------------------------- clusters


def mean_per_cluster(values: ArrayLike, clusters: Iterable[Hashable]) -> Array:
    """Average the values of each cluster.

    Parameters
    ----------
    values
        Shape (n,); NaN is left out.
    clusters
        One label per value: a subject, a trial.

    Returns
    -------
    Array
        Shape (G,), in order of first appearance; NaN for a cluster without values.
    """
    vector = _vector(values, "values")
    codes, n_clusters = group_codes(clusters, vector.size)
    known = np.isfinite(vector)
    count = np.bincount(codes[known], minlength=n_clusters)
    total = np.bincount(codes[known], weights=vector[known], minlength=n_clusters)
    return np.asarray(total / np.where(count, count, np.nan))


@lru_cache(maxsize=4)
def resampling_counts(n_clusters: int, *, n_resamples: int, seed: int) -> Array:
    """Draw how often each cluster occurs in each resample, shape (n_resamples, n_clusters)."""
    generator = np.random.default_rng(seed)
    share = np.full(n_clusters, 1.0 / n_clusters)
    counts = generator.multinomial(n_clusters, share, size=n_resamples).astype(np.float64)
    # Every angle of a study is resampled alike, so the counts are shared and must not change.
    counts.setflags(write=False)
    return counts


def bootstrap_clusters(
    values: ArrayLike,
    clusters: Iterable[Hashable],
    *,
    statistic: Literal["mean", "rms"] = "mean",
    weighting: Literal["sample", "cluster"] = "sample",
    level: float = 0.95,
    n_resamples: int = N_RESAMPLES,
    seed: int = 0,
) -> BootstrapResult:
    """Estimate a mean or root mean square with an interval that respects clusters.

    Whole clusters are drawn with replacement, so that dependence inside a subject or trial, of
    whatever form, is kept. The percentiles are widened for few clusters as Hesterberg proposes;
    they can't be widened enough for fewer than five, which get no interval. That of a t-test on the
    clusters' means (`compute_paired_t_test`) holds for any number from two.

    Parameters
    ----------
    values
        Shape (n,); NaN is left out.
    clusters
        One label per value. Use the highest level there is: subjects before trials.
    statistic
        `mean`, or `rms` for the root of the mean square.
    weighting
        Whether every sample counts the same, or every cluster.
    level, n_resamples, seed
        Confidence level, number of bootstrap samples, seed of the generator.

    Returns
    -------
    BootstrapResult
        Interval and standard error are NaN with fewer than `MIN_CLUSTERS` clusters.

    References
    ----------
    .. [1] Field & Welsh (2007), J. R. Stat. Soc. B 69, 369-390.
    .. [2] Hesterberg (2015), Am. Stat. 69, 371-386.
    """
    require_level(level)
    vector = _vector(values, "values")
    codes, n_labels = group_codes(clusters, vector.size)
    known = np.isfinite(vector)
    used = vector[known] ** (1 if statistic == "mean" else 2)
    count: Array = np.bincount(codes[known], minlength=n_labels).astype(np.float64)
    total: Array = np.asarray(np.bincount(codes[known], weights=used, minlength=n_labels), float)
    total, count = total[count > 0], count[count > 0]
    if weighting == "cluster":
        total, count = total / count, np.ones_like(count)
    finish = np.asarray if statistic == "mean" else np.sqrt
    estimate = float(finish(total.sum() / count.sum())) if count.size else math.nan
    interval, error = UNKNOWN, math.nan
    if count.size >= MIN_CLUSTERS:
        drawn = resampling_counts(count.size, n_resamples=n_resamples, seed=seed)
        replicates = np.asarray(finish((drawn @ total) / (drawn @ count)))
        interval = percentile_interval(replicates, n_clusters=count.size, level=level)
        error = float(replicates.std(ddof=1))
    return BootstrapResult(
        estimate, interval, error, used.size, count.size, n_resamples, seed, level
    )


def percentile_interval(replicates: Array, *, n_clusters: int, level: float) -> Interval:
    """Return the bootstrap interval, its percentiles widened for the number of clusters."""
    quantile = float(stdtrit(n_clusters - 1, 0.5 - level / 2))
    tail = float(ndtr(math.sqrt(n_clusters / (n_clusters - 1)) * quantile))
    low, high = np.quantile(replicates, [tail, 1.0 - tail])
    return Interval(float(low), float(high))
