import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from scipy import stats
from scipy.ndimage import gaussian_filter1d
from statsmodels.stats.multitest import multipletests
from statsmodels.stats.weightstats import DescrStatsW

from engine.errors import ConfigError, DataError, ShapeError
from engine.validation.statistics import (
    DEPENDENCE_WARNING,
    Interval,
    adjust_holm,
    bootstrap_clusters,
    compute_equivalence,
    compute_frame_t_test,
    compute_paired_t_test,
    effective_sample_size,
    group_codes,
    lag_one_correlation,
    lag_one_sample_size,
    mean_per_cluster,
    resampling_counts,
)

SLEEP = np.array([0.7, -1.6, -0.2, -1.2, -0.1, 3.4, 3.7, 0.8, 0.0, 2.0])
SLEEP_2 = np.array([1.9, 0.8, 1.1, 0.1, -0.1, 4.4, 5.5, 1.6, 4.6, 3.4])
"""Hours of sleep gained under two drugs, Cushny & Peebles, as in Student (1908)."""


def autoregressive(n, correlation, seed=0):
    rng = np.random.default_rng(seed)
    noise = rng.normal(size=n) * np.sqrt(1 - correlation**2)
    noise[0] = rng.normal()
    values = np.empty(n)
    values[0] = noise[0]
    for i in range(1, n):
        values[i] = correlation * values[i - 1] + noise[i]
    return values


# --------------------------------------------------------------------------- t-test


def test_t_test_gives_students_published_example():
    """Student's sleep data: mean 1.58 h, t = 4.06 with 9 degrees of freedom, p = 0.0028."""
    test = compute_paired_t_test(SLEEP_2 - SLEEP)
    assert test.mean == pytest.approx(1.58)
    assert test.t == pytest.approx(4.0621, abs=1e-4)
    assert test.df == 9
    assert test.p == pytest.approx(0.002833, abs=1e-6)
    assert test.interval == pytest.approx((0.7001, 2.4599), abs=1e-4)


def test_t_test_agrees_with_scipy_and_leaves_out_nan():
    rng = np.random.default_rng(3)
    a, b = rng.normal(size=(2, 15))
    expected = stats.ttest_rel(a, b)
    test = compute_paired_t_test(np.r_[a - b, np.nan], level=0.9)
    assert (test.n, test.t, test.p) == pytest.approx((15, expected.statistic, expected.pvalue))
    assert test.interval == pytest.approx(tuple(expected.confidence_interval(0.9)))


def test_effective_number_widens_the_interval_as_fewer_samples_would():
    values = np.tile(SLEEP, 3)
    test = compute_paired_t_test(values, n_effective=7.5)
    error = values.std(ddof=1) / math.sqrt(7.5)
    assert test.p == pytest.approx(2 * stats.t.sf(abs(values.mean()) / error, 6.5))


@pytest.mark.parametrize(
    ("values", "p"),
    [([], math.nan), ([1.0], math.nan), ([0.0, 0.0, 0.0], math.nan), ([2.0, 2.0, 2.0], 0.0)],
    ids=["empty", "one", "all zero", "all the same"],
)
def test_t_test_without_spread_is_a_limit_not_a_crash(values, p):
    assert compute_paired_t_test(values).p == pytest.approx(p, nan_ok=True)


def test_an_impossible_level_is_refused():
    with pytest.raises(ConfigError, match=r"between 0 and 1, got 95"):
        compute_paired_t_test(SLEEP, level=95)


# --------------------------------------------------------------------------- dependence


def smooth(n, length, seed=0):
    """Noise smoothed by a Gaussian, as filtered keypoints are smooth; `length` in frames."""
    rng = np.random.default_rng(seed)
    margin = 10 * length
    return gaussian_filter1d(rng.normal(size=n + 2 * margin), length / math.sqrt(2))[margin:-margin]


@pytest.mark.parametrize("correlation", [0.0, 0.5, 0.9, 0.98])
@pytest.mark.parametrize("function", [effective_sample_size, lag_one_sample_size])
def test_effective_sample_size_of_an_autoregressive_sequence(function, correlation):
    n = 20_000
    expected = n * (1 - correlation) / (1 + correlation)
    assert function(autoregressive(n, correlation)) == pytest.approx(expected, rel=0.25)


@pytest.mark.parametrize("length", [5, 20])
def test_effective_sample_size_of_a_smooth_sequence(length):
    """Correlation exp(-k^2 / (2 L^2)) sums to L sqrt(2 pi); the lag-one formula is far off."""
    n = 40_000
    expected = n / (length * math.sqrt(2 * math.pi))
    assert effective_sample_size(smooth(n, length)) == pytest.approx(expected, rel=0.15)
    assert lag_one_sample_size(smooth(n, length)) < 0.3 * expected


@pytest.mark.parametrize("make", [autoregressive, smooth])
def test_effective_sample_size_predicts_the_scatter_of_means(make):
    """What the number is for: the variance of the mean is sd^2 / n_effective."""
    sequences = [make(900, 0.9 if make is autoregressive else 15, seed) for seed in range(300)]
    true = np.mean([s.var() for s in sequences]) / np.var([s.mean() for s in sequences])
    found = np.median([effective_sample_size(s) for s in sequences])
    assert found == pytest.approx(true, rel=0.3)


def test_effective_sample_size_with_gaps():
    """Every second frame of a slow sequence missing: hardly a loss. A half missing: a half lost."""
    sequence = smooth(40_000, 20)
    whole = effective_sample_size(sequence)
    alternate, half = sequence.copy(), sequence.copy()
    alternate[::2] = np.nan
    half[20_000:] = np.nan
    assert effective_sample_size(alternate) == pytest.approx(whole, rel=0.1)
    assert effective_sample_size(half) == pytest.approx(whole / 2, rel=0.2)


def test_effective_sample_size_does_not_depend_on_the_frame_rate():
    sequence = smooth(40_000, 40)
    slow = effective_sample_size(sequence[::4])
    assert slow == pytest.approx(effective_sample_size(sequence), rel=0.05)


def test_lag_one_correlation_ignores_pairs_across_gaps():
    sequence = autoregressive(4000, 0.8)
    with_gaps = sequence.copy()
    with_gaps[::7] = np.nan
    assert lag_one_correlation(with_gaps) == pytest.approx(0.8, abs=0.04)
    squeezed = with_gaps[np.isfinite(with_gaps)]
    assert lag_one_correlation(squeezed) < 0.8 - 0.01


@pytest.mark.parametrize(
    ("sequence", "expected"),
    [([], 0), ([np.nan, np.nan], 0), ([1.0, 2.0], 1), ([5.0] * 50, 1), ([1.0, -1.0] * 20, 40)],
    ids=["empty", "missing", "short", "constant", "alternating"],
)
def test_effective_sample_size_at_its_limits(sequence, expected):
    assert effective_sample_size(sequence) == expected
    assert lag_one_sample_size(sequence) == expected


@given(arrays(float, st.integers(4, 60), elements=st.floats(-50, 50)))
def test_effective_sample_size_lies_between_one_and_n(sequence):
    assert 1.0 <= effective_sample_size(sequence) <= sequence.size
    assert 1.0 <= lag_one_sample_size(sequence) <= sequence.size


def test_frame_test_keeps_its_level_only_with_the_correction():
    """Without any true difference 5 % of tests should find one; naive ones find far more."""
    naive = corrected = 0
    for seed in range(400):
        test = compute_frame_t_test([autoregressive(600, 0.9, seed)])
        naive += test.naive.p < 0.05
        corrected += test.corrected.p < 0.05
    assert naive / 400 > 0.4
    assert 0.02 < corrected / 400 < 0.11


def test_frame_test_sums_over_trials_and_warns():
    series = [autoregressive(200, 0.5, seed) for seed in (1, 2)] + [np.full(30, np.nan)]
    test = compute_frame_t_test(series)
    assert test.n_sequences == 2
    assert test.naive.n == 400
    worth = sum(effective_sample_size(s) for s in series)
    assert test.corrected.n_effective == pytest.approx(worth)
    assert test.corrected.mean == test.naive.mean
    assert test.n_lag_one == pytest.approx(sum(lag_one_sample_size(s) for s in series))
    assert test.warning == DEPENDENCE_WARNING


# --------------------------------------------------------------------------- equivalence, Holm


@given(
    arrays(float, st.integers(3, 30), elements=st.floats(-10, 10, width=32)),
    st.floats(0.5, 8),
)
def test_equivalence_agrees_with_statsmodels(values, margin):
    if values.std() < 1e-3:
        return
    p, low, high = DescrStatsW(values).ttost_mean(-margin, margin)
    test = compute_equivalence(values, margin=margin)
    assert test.p == pytest.approx(p, abs=1e-10)
    assert (test.p_lower, test.p_upper) == pytest.approx((low[1], high[1]), abs=1e-10)


@given(arrays(float, st.integers(2, 12), elements=st.floats(-6, 6, width=32)))
def test_equivalence_is_the_90_percent_interval_inside_the_margin(values):
    test = compute_equivalence(values, margin=5.0)
    inside = test.interval.low > -5.0 and test.interval.high < 5.0
    assert test.is_equivalent == inside


def test_equivalence_of_one_constant_offset_is_a_limit():
    assert compute_equivalence([3.0, 3.0, 3.0], margin=5.0).p == 0.0
    assert compute_equivalence([6.0, 6.0, 6.0], margin=5.0).p == 1.0
    assert compute_equivalence([5.0, 5.0], margin=5.0).p == 0.5


def test_equivalence_needs_two_values_and_a_margin():
    assert not compute_equivalence([0.1], margin=5.0).is_equivalent
    with pytest.raises(ConfigError, match="positive"):
        compute_equivalence([1.0, 2.0], margin=0.0)


@pytest.mark.parametrize("seed", range(8))
def test_holm_agrees_with_statsmodels(seed):
    rng = np.random.default_rng(seed)
    p_values = np.round(rng.random(rng.integers(1, 26)) ** 3, 2)  # small ones, and ties
    expected = multipletests(p_values, method="holm")[1]
    assert adjust_holm(p_values) == pytest.approx(expected)


@given(arrays(float, st.integers(1, 25), elements=st.floats(0, 1)))
def test_holm_keeps_the_order_and_never_lowers(p_values):
    adjusted = adjust_holm(p_values)
    order = np.argsort(p_values, kind="stable")
    assert (np.diff(adjusted[order]) >= 0).all()
    assert (adjusted >= p_values).all()
    assert adjusted.max() <= 1


def test_holm_does_not_count_tests_that_were_not_done():
    adjusted = adjust_holm([0.01, math.nan, 0.04])
    assert adjusted == pytest.approx([0.02, math.nan, 0.04], nan_ok=True)


def test_holm_refuses_what_is_no_probability():
    with pytest.raises(DataError, match="between 0 and 1"):
        adjust_holm([0.5, 1.2])


# --------------------------------------------------------------------------- clusters


def test_group_codes_number_labels_and_arrays_in_order_of_appearance():
    codes, n = group_codes(["b", "a", "b", "c"], 4)
    assert (codes.tolist(), n) == ([0, 1, 0, 2], 3)
    codes, n = group_codes(np.array([7, 2, 7, 9]), 4)
    assert (codes.tolist(), n) == ([0, 1, 0, 2], 3)
    with pytest.raises(ShapeError, match=r"per sample \(3\), got 2"):
        group_codes("ab", 3)


def test_mean_per_cluster_leaves_out_nan():
    means = mean_per_cluster([1.0, 3.0, np.nan, 5.0, np.nan], "aabbc")
    assert means == pytest.approx([2.0, 5.0, math.nan], nan_ok=True)


def test_bootstrap_agrees_with_brute_force_resampling():
    rng = np.random.default_rng(5)
    values, clusters = rng.normal(2, 1, 40), np.repeat(np.arange(8), [2, 3, 4, 5, 6, 7, 8, 5])
    result = bootstrap_clusters(values, clusters, statistic="rms", n_resamples=500, seed=9)
    counts = resampling_counts(8, n_resamples=500, seed=9).astype(int)
    brute = []
    for row in counts:
        drawn = np.concatenate([values[clusters == g] for g in np.repeat(np.arange(8), row)])
        brute.append(np.sqrt(np.mean(drawn**2)))
    tail = stats.norm.cdf(np.sqrt(8 / 7) * stats.t.ppf(0.025, 7))
    assert result.interval == pytest.approx(tuple(np.quantile(brute, [tail, 1 - tail])))
    assert result.standard_error == pytest.approx(np.std(brute, ddof=1))
    assert result.estimate == pytest.approx(np.sqrt(np.mean(values**2)))


def test_bootstrap_interval_holds_the_truth_as_often_as_it_says():
    """Correlated samples in 12 clusters: 95 % intervals must cover; naive ones cover half."""
    rng = np.random.default_rng(1)
    clusters = np.repeat(np.arange(12), 20)
    covered = naive = 0
    for _ in range(250):
        values = np.repeat(rng.normal(size=12), 20) + 0.5 * rng.normal(size=240)
        result = bootstrap_clusters(values, clusters, n_resamples=600)
        covered += result.interval.contains(0.0)
        naive += compute_paired_t_test(values).interval.contains(0.0)
    assert 0.90 <= covered / 250 <= 0.99
    assert naive / 250 < 0.7


def test_bootstrap_is_repeatable_and_follows_its_seed():
    values, clusters = np.arange(30.0), np.repeat(np.arange(6), 5)
    first, again = (bootstrap_clusters(values, clusters, n_resamples=200) for _ in range(2))
    other = bootstrap_clusters(values, clusters, n_resamples=200, seed=1)
    assert first == again
    assert other.interval != first.interval
    assert (first.n_samples, first.n_clusters) == (30, 6)


def test_bootstrap_weighting_by_cluster_counts_every_cluster_the_same():
    values, clusters = np.array([0.0] * 9 + [10.0]), np.array([0] * 9 + [1])
    assert bootstrap_clusters(values, clusters).estimate == pytest.approx(1.0)
    assert bootstrap_clusters(values, clusters, weighting="cluster").estimate == pytest.approx(5.0)


def test_bootstrap_of_few_clusters_has_no_interval():
    """Resampling three clusters can't tell how other three would scatter."""
    result = bootstrap_clusters([1.0, 2.0, np.nan], "aab")
    assert (result.estimate, result.n_clusters) == (1.5, 1)
    assert not result.interval.is_known
    assert not bootstrap_clusters(np.arange(8.0), "aabbccdd").interval.is_known
    assert bootstrap_clusters(np.arange(10.0), "aabbccddee").interval.is_known


@given(
    arrays(float, 24, elements=st.floats(-100, 100)),
    st.floats(-50, 50),
    st.floats(0.1, 10),
)
def test_bootstrap_moves_and_scales_with_the_data(values, shift, scale):
    clusters = np.repeat(np.arange(6), 4)
    plain = bootstrap_clusters(values, clusters, n_resamples=100)
    moved = bootstrap_clusters(scale * values + shift, clusters, n_resamples=100)
    expected = [scale * end + shift for end in plain.interval]
    assert moved.interval == pytest.approx(expected, abs=1e-9 * (1 + abs(shift) + 100 * scale))


def test_an_unknown_interval_contains_nothing():
    assert not Interval(math.nan, math.nan).contains(0.0)
    assert Interval(-1.0, 1.0).contains(0.0)
