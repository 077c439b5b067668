import numpy as np
import pytest
from dtaidistance import dtw_ndim
from hypothesis import given, settings
from hypothesis import strategies as st

from engine.errors import DataError, ShapeError
from engine.form.warping import find_subsequence, limit_slope, warp

X = np.linspace(0, 1, 101)


def movement(u):
    return np.column_stack(
        [8 * np.sin(np.pi * u) ** 2, 6 * np.sin(np.pi * u) ** 4, 4 * np.sin(2 * np.pi * u)]
    )


@settings(max_examples=20, deadline=None)
@given(st.floats(-0.12, 0.12), st.integers(1, 2))
def test_a_known_warp_is_recovered(size, waves):
    moved = X + size / waves * np.sin(2 * np.pi * waves * X)
    found = warp(movement(X), movement(moved))
    true = 100 * np.interp(X, moved, X)
    assert np.abs(found.position - true).mean() < 0.7
    assert np.abs(found.position - true).max() < 2.5


def test_noise_moves_the_warp_little():
    rng = np.random.default_rng(0)
    moved = X + 0.08 * np.sin(2 * np.pi * X)
    found = warp(movement(X), movement(moved) + rng.normal(0, 0.2, (101, 3)))
    assert np.abs(found.position - 100 * np.interp(X, moved, X)).mean() < 1.0


def test_the_same_sequence_lies_on_the_diagonal():
    found = warp(movement(X), movement(X))
    assert np.allclose(found.position, np.arange(101), atol=1e-6)
    assert found.distance == 0
    assert np.array_equal(found.path[:, 0], found.path[:, 1])


def test_a_textbook_case():
    # Cost matrix by hand: 0 1 2 against 0 0 1 2 costs nothing; the zero is held once.
    found = warp(np.array([[0.0], [1], [2]]), np.array([[0.0], [0], [1], [2]]), penalty=0.0)
    assert found.path.tolist() == [[0, 0], [0, 1], [1, 2], [2, 3]]
    assert found.distance == 0


def test_the_path_costs_what_the_library_says():
    rng = np.random.default_rng(3)
    one, two = rng.normal(size=(30, 2)), rng.normal(size=(40, 2))
    path = warp(one, two, penalty=0.0).path
    cost = np.sqrt(((one[path[:, 0]] - two[path[:, 1]]) ** 2).sum())
    assert cost == pytest.approx(dtw_ndim.distance(one, two, window=11))


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 10_000))
def test_slopes_stay_within_their_limits(seed):
    steps = np.random.default_rng(seed).exponential(1, 60) ** 3 + 1e-6
    limited = limit_slope(np.concatenate(([0.0], np.cumsum(steps))))
    even = (limited[-1] - limited[0]) / 60
    slopes = np.diff(limited) / even
    assert slopes.min() > 1 / 3 - 1e-6
    assert slopes.max() < 3 + 1e-6
    assert limited[-1] == pytest.approx(steps.sum())


def test_a_movement_is_found_inside_a_longer_one():
    around = np.zeros((150, 3))
    longer = np.vstack([around, movement(np.linspace(0, 1, 140)), around])
    start, end, distance = find_subsequence(movement(X), longer)
    assert abs(start - 150) <= 3
    assert abs(end - 289) <= 3
    assert distance < 0.3


def test_what_cannot_be_aligned_is_refused():
    with pytest.raises(ShapeError, match="same features"):
        warp(np.zeros((5, 2)), np.zeros((5, 3)))
    with pytest.raises(ShapeError, match="At least 3 samples"):
        warp(np.zeros((2, 1)), np.zeros((5, 1)))
    with pytest.raises(DataError, match="missing values"):
        warp(np.full((5, 1), np.nan), np.zeros((5, 1)))
    with pytest.raises(DataError, match="go forward"):
        limit_slope(np.zeros(5))
