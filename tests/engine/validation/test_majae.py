import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import stats

from engine.errors import ConfigError, DataError, ShapeError
from engine.validation.majae import (
    MAJAE_GROUPS,
    MAJAE_GROUPS_TRUNK,
    compute_improvement,
    compute_majae,
)

NAMES = tuple(name for members in MAJAE_GROUPS.values() for name in members)
TIME = np.arange(60) / 30
SIZES = {"torso": 3, "sagittal": 8, "coronal": 4, "transversal": 2}


def reference():
    return np.random.default_rng(0).uniform(0, 90, (TIME.size, 17))


def with_errors(per_group):
    """Alternate the sign, so that the mean absolute error is not the bias."""
    size = np.concatenate([np.full(len(MAJAE_GROUPS[g]), e) for g, e in per_group.items()])
    sign = np.where(np.arange(TIME.size) % 2, 1.0, -1.0)[:, None]
    return reference() + sign * size


@pytest.mark.parametrize("groups", [MAJAE_GROUPS, MAJAE_GROUPS_TRUNK])
def test_groups_are_those_of_the_paper(groups):
    assert {name: len(members) for name, members in groups.items()} == SIZES
    assert len({name for members in groups.values() for name in members}) == 17


def test_group_errors_and_the_overall_weighted_by_angles():
    """Choi et al. (2024), Table 4: (3 torso + 8 sagittal + 4 coronal + 2 transversal) / 17."""
    errors = {"torso": 12.0, "sagittal": 20.0, "coronal": 9.0, "transversal": 30.0}
    found = compute_majae(TIME, NAMES, with_errors(errors), reference())
    assert {group.name: group.mae_deg for group in found.groups} == pytest.approx(errors)
    assert found.overall_deg == pytest.approx((3 * 12 + 8 * 20 + 4 * 9 + 2 * 30) / 17)
    assert found.mean_available_deg == pytest.approx(found.overall_deg)
    assert found.group("coronal").n_angles == 4
    assert all(angle.n_samples == TIME.size for angle in found.angles)


def test_a_missing_angle_leaves_the_overall_open():
    estimated = with_errors(dict.fromkeys(SIZES, 5.0))
    estimated[:, NAMES.index("elbow_flexion_l")] = np.nan
    found = compute_majae(TIME, NAMES, estimated, reference())
    assert found.missing == ("elbow_flexion_l",)
    assert math.isnan(found.overall_deg)
    assert found.mean_available_deg == pytest.approx(5)
    assert (found.group("sagittal").n_angles, found.group("sagittal").n_expected) == (7, 8)


def test_angles_of_no_group_are_left_out_and_absent_ones_missing():
    found = compute_majae(TIME, ("neck_flexion",), np.ones((60, 1)), np.zeros((60, 1)))
    assert len(found.missing) == 17
    assert math.isnan(found.mean_available_deg)
    assert found.group("torso").n_angles == 0


def test_an_offset_of_the_static_second_is_removed_and_stated():
    estimated = with_errors(dict.fromkeys(SIZES, 1.0)) + 7.0
    raw = compute_majae(TIME, NAMES, estimated, reference())
    removed = compute_majae(TIME, NAMES, estimated, reference(), offset_window_s=(0.0, 1.0))
    assert raw.overall_deg == pytest.approx(7)
    assert removed.overall_deg == pytest.approx(1)
    assert removed.angles[0].offset_deg == pytest.approx(7)
    assert removed.offset_window_s == (0.0, 1.0)


def test_differences_are_wrapped():
    found = compute_majae(TIME, NAMES, reference() + 358, reference())
    assert found.overall_deg == pytest.approx(2)


def test_wrong_calls_are_refused():
    with pytest.raises(ShapeError, match="need shape"):
        compute_majae(TIME, NAMES[:3], reference(), reference())
    with pytest.raises(ConfigError, match="inside the recording"):
        compute_majae(TIME, NAMES, reference(), reference(), offset_window_s=(5.0, 6.0))
    with pytest.raises(DataError, match="known: torso"):
        compute_majae(TIME, NAMES, reference(), reference()).group("arm")


# --------------------------------------------------------------------------- improvement


def test_both_ways_of_averaging_differ_as_in_the_paper():
    """The published means 24.49 and 17.25 degrees are 29.6 %, whatever the rows say."""
    assert compute_improvement([24.49], [17.25]).of_mean_percent == pytest.approx(29.56, abs=0.01)
    found = compute_improvement([40.0, 10.0], [20.0, 10.0])
    assert found.mean_of_rows_percent == pytest.approx(25)
    assert found.of_mean_percent == pytest.approx(40)
    assert found.rows_percent == pytest.approx((50, 0))


def test_intervals_agree_with_brute_force_resampling():
    rng = np.random.default_rng(1)
    before, clusters = rng.uniform(10, 30, 12), np.repeat(np.arange(6), 2)
    after = before * rng.uniform(0.5, 1.1, 12)
    found = compute_improvement(before, after, clusters=clusters, n_resamples=4000)
    drawn = [
        np.concatenate([np.flatnonzero(clusters == g) for g in rng.integers(0, 6, 6)])
        for _ in range(4000)
    ]
    rows = np.array([np.mean(100 * (1 - after[i] / before[i])) for i in drawn])
    whole = np.array([100 * (1 - after[i].sum() / before[i].sum()) for i in drawn])
    # Hesterberg's widened percentiles for six clusters.
    tail = stats.norm.cdf(np.sqrt(6 / 5) * stats.t.ppf(0.025, 5))
    tails = [tail, 1 - tail]
    assert found.mean_of_rows_interval == pytest.approx(tuple(np.quantile(rows, tails)), abs=1.5)
    assert found.of_mean_interval == pytest.approx(tuple(np.quantile(whole, tails)), abs=1.5)
    assert (found.n_rows, found.n_clusters) == (12, 6)
    assert found.n_worse == np.sum(after > before)


@given(st.integers(0, 1000), st.floats(0.01, 100))
def test_improvement_does_not_depend_on_the_unit(seed, scale):
    rng = np.random.default_rng(seed)
    before, after = rng.uniform(1, 30, (2, 8))
    plain = compute_improvement(before, after, n_resamples=50)
    scaled = compute_improvement(scale * before, scale * after, n_resamples=50)
    assert scaled.of_mean_interval == pytest.approx(plain.of_mean_interval, abs=1e-9)
    assert scaled.mean_of_rows_percent == pytest.approx(plain.mean_of_rows_percent)


def test_missing_rows_and_single_rows():
    found = compute_improvement([10.0, np.nan, 20.0], [5.0, 1.0, np.nan])
    assert found.n_rows == 1
    assert found.of_mean_percent == pytest.approx(50)
    assert not found.of_mean_interval.is_known
    four = compute_improvement([10.0] * 8, np.arange(8.0), clusters="aabbccdd")
    assert not four.of_mean_interval.is_known
    assert math.isnan(compute_improvement([], []).of_mean_percent)


def test_errors_that_cannot_be_are_refused():
    with pytest.raises(DataError, match="positive"):
        compute_improvement([0.0, 1.0], [1.0, 1.0])
    with pytest.raises(ShapeError, match="per row"):
        compute_improvement([1.0], [1.0, 2.0])
