import math

import numpy as np
import pandas as pd
import pytest
from hypothesis import given
from hypothesis import strategies as st
from statsmodels.formula.api import ols
from statsmodels.stats.anova import anova_lm

from engine.errors import ConfigError, DataError, ShapeError
from engine.validation.reliability import compute_icc, minimal_detectable_change, sem_from_icc

SHROUT_FLEISS = [
    [9, 2, 5, 8],
    [6, 1, 3, 2],
    [8, 4, 6, 8],
    [7, 1, 2, 6],
    [10, 5, 6, 9],
    [6, 2, 4, 7],
]
"""Shrout & Fleiss (1979), Table 2: six targets, four judges."""


def test_icc_gives_the_published_example():
    """ICC(2,1) = .29 and ICC(3,1) = .71 in the paper; intervals as in the R package psych."""
    icc = compute_icc(SHROUT_FLEISS)
    assert (icc.n_targets, icc.n_methods) == (6, 4)
    assert icc.icc_2_1 == pytest.approx(0.290, abs=5e-4)
    assert icc.icc_2_1_interval == pytest.approx((0.019, 0.761), abs=5e-4)
    assert icc.icc_3_1 == pytest.approx(0.715, abs=5e-4)
    assert icc.icc_3_1_interval == pytest.approx((0.342, 0.946), abs=5e-4)
    assert icc.f == pytest.approx(11.03, abs=5e-3)
    assert icc.p == pytest.approx(0.000135, abs=1e-6)


def test_icc_agrees_with_an_analysis_of_variance():
    rng = np.random.default_rng(0)
    table = rng.normal(size=(9, 1)) * 3 + rng.normal(size=(9, 2)) + [0, 2]
    rows, columns = np.indices(table.shape)
    data = pd.DataFrame({"y": table.ravel(), "row": rows.ravel(), "column": columns.ravel()})
    ms = anova_lm(ols("y ~ C(row) + C(column)", data).fit())["mean_sq"]
    row, column, error = ms["C(row)"], ms["C(column)"], ms["Residual"]
    icc = compute_icc(table)
    assert icc.icc_3_1 == pytest.approx((row - error) / (row + error))
    assert icc.icc_2_1 == pytest.approx((row - error) / (row + error + 2 * (column - error) / 9))
    assert icc.sem_consistency == pytest.approx(math.sqrt(error))
    assert icc.sem_consistency == pytest.approx(np.diff(table).std(ddof=1) / math.sqrt(2))
    assert icc.sem_agreement == pytest.approx(math.sqrt(error + (column - error) / 9))


def test_a_constant_offset_lowers_agreement_but_not_consistency():
    values = np.arange(10.0)
    offset = compute_icc(np.column_stack([values, values + 5]))
    same = compute_icc(np.column_stack([values, values]))
    assert offset.icc_3_1 == pytest.approx(1.0)
    assert offset.icc_2_1 < 0.5
    assert (same.icc_2_1, same.icc_3_1) == pytest.approx((1.0, 1.0))
    assert same.icc_2_1_interval == (1.0, 1.0)


@given(st.integers(0, 10_000), st.floats(-50, 50), st.floats(0.1, 20))
def test_icc_does_not_depend_on_unit_or_origin(seed, shift, scale):
    table = np.random.default_rng(seed).normal(size=(7, 3)) + np.arange(7)[:, None]
    plain, moved = compute_icc(table), compute_icc(scale * table + shift)
    assert moved.icc_2_1 == pytest.approx(plain.icc_2_1, abs=1e-9)
    assert moved.icc_3_1_interval == pytest.approx(plain.icc_3_1_interval, abs=1e-9)
    assert moved.sem_agreement == pytest.approx(scale * plain.sem_agreement)


def test_interval_holds_the_truth_as_often_as_it_says():
    rng = np.random.default_rng(2)
    covered_2 = covered_3 = 0
    for _ in range(400):
        targets, methods = rng.normal(size=(12, 1)) * 2, rng.normal(size=(1, 4)) * 0.5
        icc = compute_icc(targets + methods + rng.normal(size=(12, 4)))
        covered_2 += icc.icc_2_1_interval.contains(4 / (4 + 0.25 + 1))
        covered_3 += icc.icc_3_1_interval.contains(4 / 5)
    assert 0.92 <= covered_2 / 400 <= 0.99
    assert 0.92 <= covered_3 / 400 <= 0.98


def test_incomplete_rows_are_left_out():
    table = np.array(SHROUT_FLEISS, dtype=float)
    holed = np.vstack([table, [1.0, np.nan, 2.0, 3.0]])
    assert compute_icc(holed) == compute_icc(table)


@pytest.mark.parametrize("table", [np.empty((0, 2)), [[1.0, 2.0]], np.full((4, 2), 3.0)])
def test_icc_of_nothing_that_varies_is_nan(table):
    icc = compute_icc(table)
    assert math.isnan(icc.icc_2_1)
    assert not icc.icc_3_1_interval.is_known


def test_icc_needs_two_methods():
    with pytest.raises(ShapeError, match="methods >= 2"):
        compute_icc(np.zeros((5, 1)))


def test_minimal_detectable_change():
    """Weir (2005): SEM times 1.96 times the root of two; ICC 0.9 and SD 10 give SEM 3.16."""
    assert sem_from_icc(10.0, 0.9) == pytest.approx(3.1623, abs=1e-4)
    assert sem_from_icc(10.0, -0.2) == 10.0
    assert minimal_detectable_change(1.0) == pytest.approx(2.7719, abs=1e-4)
    assert math.isnan(minimal_detectable_change(math.nan))
    with pytest.raises(DataError):
        sem_from_icc(-1.0, 0.5)
    with pytest.raises(ConfigError):
        minimal_detectable_change(-1.0)


def test_one_change_in_twenty_exceeds_the_minimal_detectable_change_by_chance():
    first, second = np.random.default_rng(0).normal(0, 2.0, size=(2, 20_000))
    share = np.mean(np.abs(first - second) > minimal_detectable_change(2.0))
    assert share == pytest.approx(0.05, abs=0.005)


def test_trials_that_do_not_differ_have_no_reliability():
    found = compute_icc([[30.0, 32.0]] * 5)
    assert math.isnan(found.icc_2_1)
    assert math.isnan(found.icc_3_1)
    assert math.isnan(found.p)
