import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from engine.errors import ShapeError
from engine.form.score import HALVING_DEG, angle_weights, compute_score

SIGMA = np.full((50, 3), 4.0)


def test_no_difference_scores_100():
    score = compute_score(np.zeros((50, 3)), SIGMA)
    assert score.value == 100
    assert score.interval[1] == 100
    assert score.is_same


def test_what_lies_within_the_error_scores_100():
    assert compute_score(np.full((50, 3), 1.95 * 4.0), SIGMA).value == 100
    assert compute_score(np.full((50, 3), 1.97 * 4.0), SIGMA).value < 100


def test_the_stated_scale():
    # A constant excess of 15 degrees halves the score: d^2 = 15^2 + (1.96 * 4)^2.
    difference = np.full((50, 3), np.hypot(HALVING_DEG, 1.96 * 4.0))
    score = compute_score(difference, SIGMA)
    assert score.value == pytest.approx(50)
    assert score.difference_deg == pytest.approx(15)


@settings(max_examples=40, deadline=None)
@given(st.integers(0, 10_000), st.floats(1.0, 4.0))
def test_larger_differences_never_score_higher(seed, factor):
    difference = np.random.default_rng(seed).normal(0, 12, (50, 3))
    one, two = (compute_score(k * difference, SIGMA) for k in (1.0, factor))
    assert two.value <= one.value
    assert one.interval[0] <= one.value <= one.interval[1]
    assert 0 <= two.value <= 100


def test_the_interval_covers_the_true_score():
    """Differences measured with one error each; the score without errors lies inside."""
    rng = np.random.default_rng(5)
    shape = 20 * np.sin(np.linspace(0, np.pi, 50))[:, None] * np.array([1.0, 0.8, 1.2])
    truth = compute_score(shape, SIGMA).value
    hits = 0
    for _ in range(200):
        score = compute_score(shape + 4.0 * rng.standard_normal(3), SIGMA)
        hits += score.interval[0] <= truth <= score.interval[1]
    assert 0.90 <= hits / 200 <= 1.0


def test_uncertain_angles_weigh_less():
    weight = angle_weights(np.array([[1.0, 30.0]]))
    assert weight.sum() == pytest.approx(1)
    assert weight[0] > 9 * weight[1]


def test_shapes_are_checked():
    with pytest.raises(ShapeError, match="one shape"):
        compute_score(np.zeros((5, 2)), np.ones((5, 3)))
    with pytest.raises(ShapeError, match="at least one"):
        compute_score(np.zeros((0, 2)), np.ones((0, 2)))
