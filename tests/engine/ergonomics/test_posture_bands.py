"""Bands without flicker, held scores and held postures."""

from __future__ import annotations

import math
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from engine.ergonomics.posture_bands import exceeds, find_holds, held_maximum, score_bands
from engine.ergonomics.posture_scores import decode_runs, encode_runs, find_moments

ROWS = ((-20.0, 3), (-5.0, 2), (5.0, 1), (20.0, 2), (60.0, 3), (math.inf, 4))


def times(n, fps=30.0):
    return np.arange(n) / fps


def column(values):
    return np.asarray(values, dtype=float)[:, None]


@pytest.mark.parametrize(
    ("angle", "score"),
    [
        (-20.1, 3), (-20.0, 2), (-5.1, 2), (-5.0, 1), (0.0, 1), (5.0, 1), (5.1, 2), (20.0, 2),
        (20.1, 3), (60.0, 3), (60.1, 4), (math.nan, 0),
    ],
)  # fmt: skip
@pytest.mark.parametrize("calm", [{}, {"hysteresis": 2.0, "dwell_s": 0.2}])
def test_a_bound_belongs_to_the_better_band(angle, score, calm):
    found = score_bands(column([angle] * 12), ROWS, times(12), **calm)
    assert set(found.ravel()) == {score}


def test_hysteresis_enters_at_the_bound_and_leaves_two_degrees_before():
    curve = [19.0] * 10 + [20.5] * 10 + [18.5] * 10 + [17.5] * 10
    state = exceeds(column(curve), 20.0, times(40), hysteresis=2.0)[:, 0]
    assert state.tolist() == [False] * 10 + [True] * 20 + [False] * 10


def test_after_a_gap_the_limit_decides_alone():
    curve = [25.0] * 5 + [math.nan] * 3 + [19.0] * 5
    state = exceeds(column(curve), 20.0, times(13), hysteresis=2.0)[:, 0]
    assert state.tolist() == [True] * 5 + [False] * 8


def test_short_stays_are_dropped_and_long_ones_kept():
    curve = np.zeros(60)
    curve[10:14] = 50.0  # 0.13 s
    curve[30:36] = 50.0  # 0.2 s
    state = exceeds(column(curve), 20.0, times(60), dwell_s=0.2)[:, 0]
    assert np.flatnonzero(state).tolist() == list(range(30, 36))


def test_a_short_relief_is_dropped_before_a_short_strain():
    curve = np.zeros(30)
    curve[10:14], curve[16:20] = 50.0, 50.0
    state = exceeds(column(curve), 20.0, times(30), dwell_s=0.2)[:, 0]
    assert np.flatnonzero(state).tolist() == list(range(10, 20))


def test_a_stay_next_to_a_gap_or_an_end_is_kept():
    curve = np.zeros(30)
    curve[:2], curve[13:15], curve[15:20], curve[29] = 50.0, 50.0, np.nan, 50.0
    state = exceeds(column(curve), 20.0, times(30), dwell_s=0.2)[:, 0]
    assert np.flatnonzero(state).tolist() == [0, 1, 13, 14, 29]


@given(
    st.lists(st.lists(st.floats(0, 40), min_size=20, max_size=20), min_size=2, max_size=4),
    st.sampled_from([{}, {"hysteresis": 2.0}, {"hysteresis": 2.0, "dwell_s": 0.2}]),
)
def test_columns_do_not_touch_each_other(curves, calm):
    together = np.array(curves).T
    found = exceeds(together, 20.0, times(20), **calm)
    for k in range(together.shape[1]):
        alone = exceeds(together[:, k : k + 1], 20.0, times(20), **calm)
        assert (found[:, k] == alone[:, 0]).all()


@given(st.lists(st.floats(-90, 90), min_size=30, max_size=30))
def test_no_stay_within_the_clip_is_shorter_than_the_dwell(curve):
    state = exceeds(column(curve), 20.0, times(30), hysteresis=2.0, dwell_s=0.2)[:, 0]
    edges = np.flatnonzero(np.diff(state.astype(int)))
    inner = [b - a for a, b in pairwise(edges)]
    strain = [n for n, a in zip(inner, edges, strict=False) if state[a + 1]]
    assert all(n >= 6 for n in strain)


def test_the_held_maximum_is_kept_for_so_long():
    score = np.full((60, 3), 3)
    score[20:25, 0] = 9  # 5 frames: too short
    score[20:26, 1] = 9  # 6 frames of 1/30 s
    score[20:23, 2], score[23:26, 2] = 9, 8
    assert held_maximum(score, times(60)).tolist() == [3, 9, 8]


def test_a_held_maximum_does_not_bridge_gaps():
    score = np.array([9, 9, 9, 0, 9, 9, 9] + [4] * 8)[:, None]
    assert held_maximum(score, times(15))[0] == 4
    assert held_maximum(score[:7], times(7))[0] == 9, "too short for any hold: the plain maximum"


@pytest.mark.parametrize(("seconds", "is_hold"), [(3.9, False), (4.0, True), (6.0, True)])
def test_holds_last_as_long_as_asked(seconds, is_hold):
    n = round(30 * seconds) + 1
    curve = np.concatenate([np.zeros(30), np.linspace(40, 50, n), np.full(30, 80.0)])
    held = find_holds(curve, times(curve.size), half_width=5.0, hold_s=4.0)
    assert held.any() == is_hold
    assert not held[:30].any()
    if is_hold:
        assert held[30 : 30 + n].all()


def test_a_gap_or_a_larger_range_ends_a_hold():
    steady = np.full(200, 30.0)
    assert find_holds(steady, times(200), half_width=5.0, hold_s=4.0).all()
    gap = steady.copy()
    gap[100] = np.nan
    assert not find_holds(gap, times(200), half_width=5.0, hold_s=4.0).any()
    wide = np.linspace(0, 30, 200)
    assert not find_holds(wide, times(200), half_width=5.0, hold_s=4.0).any()


@given(st.lists(st.integers(0, 15), min_size=1, max_size=50))
def test_runs_give_the_series_back(series):
    runs = encode_runs(series)
    assert decode_runs(runs).tolist() == series
    assert all(a != b for a, b in pairwise(runs["value"]))


def test_worst_moments_are_ranked_and_apart():
    score = np.full(300, 2)
    score[30:40], score[45:50], score[150:170], score[250:255] = 8, 8, 8, 5
    found = list(find_moments(score, times(300), least=4))
    assert [(m.start, m.stop, m.score) for m in found] == [
        (150, 170, 8),
        (30, 40, 8),
        (250, 255, 5),
    ]
    assert all(m.start <= m.frame < m.stop for m in found)
    assert list(find_moments(score, times(300), least=9)) == []
