import math
import warnings

import numpy as np
import pytest
import statsmodels.api as sm
from hypothesis import given
from hypothesis import strategies as st
from scipy import stats

from engine.errors import ShapeError
from engine.validation.bland_altman import compute_bland_altman, compute_proportional_bias

CARDIAC = {
    1: ([7.83, 7.42, 7.89, 7.12, 7.88], [6.57, 5.62, 6.90, 6.57, 6.35]),
    2: ([6.16, 7.26, 6.71, 6.54], [4.06, 4.29, 4.26, 4.09]),
    3: ([4.75, 5.24, 4.86, 4.78, 6.05, 5.42], [4.71, 5.50, 5.08, 5.02, 6.01, 5.67]),
    4: ([4.21, 3.61, 3.72, 3.87, 3.92], [4.14, 4.20, 4.61, 4.68, 5.04]),
    5: ([3.13, 2.98, 2.85, 3.17, 3.09, 3.12], [3.03, 2.86, 2.77, 2.46, 2.32, 2.43]),
    6: ([5.92, 6.42, 5.92, 6.27], [5.90, 5.81, 5.70, 5.76]),
    7: ([7.13, 6.62, 6.58, 6.93], [5.09, 4.63, 4.61, 5.09]),
    8: ([4.54, 4.81, 5.11, 5.29, 5.39, 5.57], [4.72, 4.61, 4.36, 4.20, 4.36, 4.20]),
    9: ([4.48, 4.92, 3.97], [3.17, 3.12, 2.96]),
    10: ([4.22, 4.65, 4.74, 4.44, 4.50], [4.35, 4.62, 3.16, 3.53, 3.53]),
    11: ([6.78, 6.07, 6.52, 6.42, 6.41, 5.76], [7.20, 6.09, 7.00, 7.10, 7.40, 6.80]),
    12: ([5.06, 4.72, 4.90, 4.80, 4.90, 5.10], [4.50, 4.20, 3.80, 3.80, 4.20, 4.50]),
}
"""Bland & Altman (2007), Table 1: cardiac output of 12 subjects by two methods, l/min."""
SUBJECT = np.concatenate([np.full(len(a), s) for s, (a, _) in CARDIAC.items()])
RV, IC = (np.concatenate([pair[i] for pair in CARDIAC.values()]) for i in (0, 1))


def test_limits_give_the_published_example():
    """Bland & Altman (2007), section 3: within 0.1707, between subjects (4.2091 - 0.1707) / 4.9818,
    mean 0.60, SD 0.99, limits -1.34 to 2.54."""
    limits = compute_bland_altman(RV - IC, SUBJECT)
    assert (limits.n_samples, limits.n_clusters) == (60, 12)
    assert limits.within_variance == pytest.approx(0.170714, abs=1e-6)
    assert limits.between_variance == pytest.approx((4.2090856 - 0.1707140) / 4.9818182, abs=1e-6)
    assert limits.bias == pytest.approx(0.6021667, abs=1e-6)
    assert limits.sd == pytest.approx(0.990624, abs=1e-6)
    assert (limits.lower, limits.upper) == pytest.approx((-1.3394, 2.5438), abs=1e-3)


def test_ignoring_subjects_gives_the_narrower_limits_the_paper_warns_of():
    limits = compute_bland_altman(RV - IC, range(60))
    assert limits.sd == pytest.approx(0.9610571, abs=1e-6)
    assert (limits.lower, limits.upper) == pytest.approx((-1.2815, 2.4858), abs=1e-3)


def test_variances_are_those_of_a_mixed_model():
    """A balanced layout: the moments are the restricted maximum likelihood estimates."""
    rng = np.random.default_rng(4)
    subject = np.repeat(np.arange(15), 8)
    d = rng.normal(1, 2, 15)[subject] + rng.normal(0, 1, 120)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        model = sm.MixedLM(d, np.ones(120), groups=subject).fit(reml=True)
    limits = compute_bland_altman(d, subject)
    assert limits.bias == pytest.approx(model.params[0], abs=1e-6)
    assert limits.within_variance == pytest.approx(model.scale, rel=1e-3)
    assert limits.between_variance == pytest.approx(float(model.cov_re[0, 0]), rel=1e-3)


@pytest.mark.parametrize(("n_subjects", "between"), [(15, 0.8), (8, 2.0), (30, 0.0)])
def test_intervals_hold_the_truth_as_often_as_they_say(n_subjects, between):
    rng = np.random.default_rng(5)
    truth = 0.3 + stats.norm.ppf(0.975) * math.hypot(between, 0.5)
    bias = upper = 0
    for _ in range(300):
        subject = np.repeat(np.arange(n_subjects), rng.integers(2, 6, n_subjects))
        own = rng.normal(0.3, between, n_subjects)
        limits = compute_bland_altman(own[subject] + rng.normal(0, 0.5, subject.size), subject)
        bias += limits.bias_interval.contains(0.3)
        upper += limits.upper_interval.contains(truth)
    assert 0.91 <= bias / 300 <= 0.99
    assert 0.91 <= upper / 300 <= 1.0


def test_intervals_of_one_trial_need_the_effective_number_of_frames():
    """Correlated frames: the interval with n_effective covers, the naive one doesn't."""
    rng = np.random.default_rng(6)
    covered = naive = 0
    for _ in range(300):
        d = np.repeat(rng.normal(size=20), 10)
        covered += compute_bland_altman(d, ["a"] * 200, n_effective=[20]).upper_interval.contains(
            stats.norm.ppf(0.975)
        )
        naive += compute_bland_altman(d, ["a"] * 200).upper_interval.contains(stats.norm.ppf(0.975))
    assert covered / 300 > 0.9
    assert naive / 300 < 0.6


def test_one_cluster_has_limits_for_itself_only():
    limits = compute_bland_altman([1.0, 2.0, 3.0, np.nan], ["a"] * 4)
    assert limits.is_single_cluster
    assert math.isnan(limits.between_variance)
    assert limits.sd == pytest.approx(1.0)
    t = stats.t.ppf(0.975, 2) / math.sqrt(3)
    assert limits.bias_interval == pytest.approx((2 - t, 2 + t))


def test_single_pairs_give_the_classic_limits():
    d = np.array([1.0, 4.0, 2.0, 6.0, 3.0])
    limits = compute_bland_altman(d, range(5))
    assert limits.sd == pytest.approx(d.std(ddof=1))
    assert math.isnan(limits.within_variance)
    t = stats.t.ppf(0.975, 4) * d.std(ddof=1) / math.sqrt(5)
    assert limits.bias_interval == pytest.approx((d.mean() - t, d.mean() + t))


@given(st.integers(0, 10_000), st.floats(-20, 20), st.floats(0.1, 10))
def test_limits_move_and_scale_with_the_data(seed, shift, scale):
    rng = np.random.default_rng(seed)
    subject = np.repeat(np.arange(4), 5)
    d = rng.normal(size=20) + rng.normal(size=4)[subject]
    plain = compute_bland_altman(d, subject)
    moved = compute_bland_altman(scale * d + shift, subject)
    assert moved.sd == pytest.approx(scale * plain.sd)
    assert moved.outer_limits == pytest.approx(
        [scale * end + shift for end in plain.outer_limits], abs=1e-8
    )
    mirrored = compute_bland_altman(-d, subject)
    assert mirrored.outer_limits == pytest.approx(
        (-plain.outer_limits.high, -plain.outer_limits.low)
    )


@given(st.integers(0, 10_000))
def test_limits_lie_inside_their_intervals_and_hold_the_bias(seed):
    rng = np.random.default_rng(seed)
    subject = rng.integers(0, 5, 40)
    limits = compute_bland_altman(rng.normal(size=40), subject)
    assert limits.lower_interval.contains(limits.lower)
    assert limits.upper_interval.contains(limits.upper)
    assert limits.lower < limits.bias < limits.upper


@pytest.mark.parametrize("d", [[], [np.nan, np.nan], [1.0]], ids=["empty", "missing", "one"])
def test_too_few_differences_give_nan(d):
    limits = compute_bland_altman(d, range(len(d)))
    assert math.isnan(limits.lower)
    assert not limits.outer_limits.is_known


def test_effective_numbers_must_fit_the_clusters():
    with pytest.raises(ShapeError, match=r"per cluster \(2\)"):
        compute_bland_altman([1.0, 2.0], "ab", n_effective=[1.0])


@pytest.mark.parametrize("against", ["mean", "reference"])
def test_proportional_bias_agrees_with_clustered_least_squares(against):
    size = IC if against == "reference" else (RV + IC) / 2
    fit = sm.OLS(RV - IC, sm.add_constant(size)).fit(
        cov_type="cluster", cov_kwds={"groups": SUBJECT}, use_t=True
    )
    bias = compute_proportional_bias(RV, IC, SUBJECT, against=against)
    assert (bias.offset, bias.slope) == pytest.approx(tuple(fit.params))
    assert bias.p == pytest.approx(fit.pvalues[1])
    assert bias.slope_interval == pytest.approx(tuple(fit.conf_int()[1]))


def test_a_gain_error_is_found_against_the_reference():
    reference = np.linspace(0, 90, 50)
    bias = compute_proportional_bias(
        0.9 * reference + 2, reference, ["a"] * 50, against="reference"
    )
    assert (bias.slope, bias.offset) == pytest.approx((-0.1, 2.0))
    assert not bias.slope_interval.is_known


def test_proportional_bias_of_a_constant_is_nan():
    assert math.isnan(compute_proportional_bias([5.0] * 4, [4.0] * 4, "aabb").slope)
    with pytest.raises(ShapeError, match="one length"):
        compute_proportional_bias([1.0], [1.0, 2.0], "a")
