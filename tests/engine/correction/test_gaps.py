import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from engine.correction.gaps import fill_gaps, find_runs, long_gaps


def test_runs():
    assert find_runs(np.array([1, 1, 0, 1, 0, 0, 1], dtype=bool)) == [(0, 2), (3, 4), (6, 7)]
    assert find_runs(np.zeros(3, dtype=bool)) == []


@given(st.lists(st.booleans(), max_size=40))
def test_runs_cover_exactly_the_true_samples(flags):
    mask = np.array(flags, dtype=bool)
    covered = np.zeros_like(mask)
    for start, stop in find_runs(mask):
        covered[start:stop] = True
    assert np.array_equal(covered, mask)


def test_short_gap_on_a_line_is_filled_exactly():
    time_s = np.arange(20) / 30
    values = np.stack([time_s, 3 - 2 * time_s], axis=1)
    broken = values.copy()
    broken[5:9] = np.nan
    assert np.allclose(fill_gaps(time_s, broken, max_gap_s=0.5), values)


def test_long_gap_and_ends_stay_missing():
    time_s = np.arange(60) / 30
    values = np.ones((60, 3))
    values[:4] = values[20:45] = values[-2:] = np.nan
    filled = fill_gaps(time_s, values, max_gap_s=0.5)
    assert np.isnan(filled).all(axis=1).tolist() == np.isnan(values).all(axis=1).tolist()


def test_gap_length_counts_from_sample_to_sample():
    time_s = np.array([0.0, 0.1, 0.2, 0.6, 0.7])
    missing = np.array([False, False, True, False, False])
    assert not long_gaps(time_s, missing, max_gap_s=0.51)[2]
    assert long_gaps(time_s, missing, max_gap_s=0.49)[2]


def test_one_missing_coordinate_makes_the_sample_missing():
    values = np.ones((9, 2))
    values[4, 0] = np.nan
    values[4, 1] = 99.0
    assert np.allclose(fill_gaps(np.arange(9) / 30, values, max_gap_s=1.0), 1.0)


def test_nothing_known_stays_nothing():
    assert np.isnan(fill_gaps(np.arange(4.0), np.full((4, 2), np.nan), max_gap_s=9.0)).all()
