import itertools
import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import stats

from engine.errors import ConfigError, DataError, ShapeError
from engine.validation.curvewise import normalise_curve, permute_curves


def smooth(n, seed, nodes=101):
    """Curves of zero mean, as smooth as joint angles."""
    rng = np.random.default_rng(seed)
    phase = np.linspace(0, 2 * np.pi, nodes)
    waves = [np.ones(nodes), np.sin(phase), np.cos(phase), np.sin(3 * phase), np.cos(5 * phase)]
    return rng.normal(size=(n, 5)) @ np.array(waves)


# --------------------------------------------------------------------------- normalising


def test_a_straight_line_stays_one_on_101_nodes():
    time = np.array([2.0, 2.5, 3.7, 4.0, 6.0])
    curve = normalise_curve(time, 3 * time - 1)
    assert curve.shape == (101,)
    assert curve == pytest.approx(3 * np.linspace(2, 6, 101) - 1)


def test_gaps_stay_gaps():
    time = np.arange(101.0)
    values = time.copy()
    values[40:50] = np.nan
    curve = normalise_curve(time, values)
    assert np.isnan(curve[40:50]).all()
    assert curve[[39, 50]] == pytest.approx([39, 50])
    between = normalise_curve(time, values, n_nodes=201)
    assert np.isnan(between[79:100]).all()
    assert between[[78, 100]] == pytest.approx([39, 50])


def test_wrong_curves_are_refused():
    with pytest.raises(ShapeError, match="two frames"):
        normalise_curve([0.0], [1.0])
    with pytest.raises(DataError, match="increase"):
        normalise_curve([1.0, 0.0], [1.0, 1.0])
    with pytest.raises(ConfigError, match="two nodes"):
        normalise_curve([0.0, 1.0], [1.0, 1.0], n_nodes=1)


# --------------------------------------------------------------------------- permutation


def brute_force(curves):
    """Every flip by itself, t from SciPy."""
    largest = []
    for signs in itertools.product([1, -1], repeat=len(curves)):
        t = stats.ttest_1samp(np.array(signs)[:, None] * curves, 0).statistic
        largest.append(np.abs(t).max())
    observed = np.abs(stats.ttest_1samp(curves, 0).statistic)
    return np.mean(np.array(largest)[:, None] >= observed * (1 - 1e-9), axis=0)


def test_exact_test_agrees_with_brute_force():
    curves = smooth(7, 3, nodes=21) + 0.8
    test = permute_curves(curves)
    assert test.is_exact
    assert test.n_flips == 2**7
    assert test.t == pytest.approx(stats.ttest_1samp(curves, 0).statistic)
    assert test.p_nodes == pytest.approx(brute_force(curves))
    assert test.p == min(test.p_nodes)


def test_one_node_is_the_classic_randomisation_test():
    """Fisher's test on Darwin's maize (Fisher 1935): 1726 of 2^15 sums reach 314, p = 0.0527."""
    darwin = [49, -67, 8, 16, 6, 23, 28, 41, 14, 29, 56, 24, 75, 60, -48]
    test = permute_curves(np.array(darwin, float)[:, None], n_flips=2**15)
    assert test.is_exact
    assert test.p == pytest.approx(1726 / 2**15)


def test_random_flips_come_close_to_all_flips():
    curves = smooth(12, 1) + 0.5
    exact, drawn = permute_curves(curves), permute_curves(curves, n_flips=4000, seed=2)
    assert not drawn.is_exact
    error = 4 * math.sqrt(0.25 / 4000)
    assert np.abs(np.subtract(exact.p_nodes, drawn.p_nodes)).max() < error
    assert drawn.critical_t == pytest.approx(exact.critical_t, rel=0.05)
    assert drawn == permute_curves(curves, n_flips=4000, seed=2)


def test_false_findings_stay_at_their_level():
    found = sum(permute_curves(smooth(8, seed)).p <= 0.05 for seed in range(400))
    pointwise = sum(
        (stats.ttest_1samp(smooth(8, seed), 0).pvalue <= 0.05).any() for seed in range(400)
    )
    assert found / 400 < 0.05 + 3 * math.sqrt(0.05 * 0.95 / 400)
    assert pointwise / 400 > 0.1


def test_a_local_difference_is_found_where_it_is():
    curves = 0.3 * smooth(12, 4)
    curves[:, 40:61] += 4.0
    test = permute_curves(curves)
    assert len(test.parts) == 1
    part = test.parts[0]
    assert (part.start_percent, part.end_percent) == (40.0, 60.0)
    assert part.p == test.p == pytest.approx(2 / 2**12)
    inside = np.abs(test.t) > test.critical_t
    assert np.flatnonzero(inside).tolist() == list(range(40, 61))


@given(st.integers(0, 300), st.floats(0.01, 100))
def test_sign_and_unit_change_nothing(seed, scale):
    curves = smooth(6, seed, nodes=15) + 0.7
    plain, other = permute_curves(curves), permute_curves(-scale * curves)
    assert other.p_nodes == pytest.approx(plain.p_nodes)
    assert other.t == pytest.approx([-t for t in plain.t], rel=1e-6, abs=1e-9)


@given(st.integers(0, 300))
def test_parts_are_where_t_exceeds_the_critical_value(seed):
    test = permute_curves(smooth(9, seed, nodes=31) + 1.0)
    nodes = np.array(test.p_nodes) <= test.alpha
    assert nodes.tolist() == (np.abs(test.t) > test.critical_t * (1 + 1e-9)).tolist()
    assert bool(test.parts) == bool(nodes.any())


def test_nodes_without_variance_or_with_gaps_are_removed():
    curves = smooth(8, 0)
    curves[:, 0] = 0.0
    curves[:, 1] = 5.0
    curves[3, 2] = np.nan
    test = permute_curves(curves)
    assert test.n_removed == 3
    assert np.isnan(test.t[:3]).all()
    assert test.p_nodes[3:] == permute_curves(curves[:, 3:]).p_nodes


def test_a_missing_curve_is_left_out():
    curves = smooth(7, 0)
    assert permute_curves(np.vstack([curves, np.full(101, np.nan)])) == permute_curves(curves)


def test_few_curves_say_that_they_can_find_nothing():
    test = permute_curves(5 + 0.01 * smooth(5, 0))
    assert test.smallest_p == pytest.approx(2 / 32)
    assert test.p == pytest.approx(test.smallest_p)
    assert not test.can_find_differences
    assert test.critical_t == math.inf
    assert test.parts == ()


@pytest.mark.parametrize("curves", [np.empty((0, 101)), np.ones((1, 101)), np.ones((5, 101))])
def test_nothing_to_test_is_nan(curves):
    test = permute_curves(curves)
    assert math.isnan(test.p)
    assert not test.can_find_differences


def test_wrong_calls_are_refused():
    with pytest.raises(ShapeError, match="curves, nodes"):
        permute_curves(np.zeros(101))
    with pytest.raises(ConfigError, match="alpha"):
        permute_curves(np.zeros((3, 5)), alpha=0)
