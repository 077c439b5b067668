"""Several hypotheses become one posture."""

from __future__ import annotations

import numpy as np
import pytest

from engine.pose.lifting.aggregation import aggregate, reprojection_errors

PLACE = np.array([0.1, -0.05, 3.0])
SIZE = np.array(1 / 3.0)


@pytest.fixture
def truth():
    return np.random.default_rng(0).uniform(-0.4, 0.4, (6, 17, 3))


def see(body):
    points = body + PLACE
    return points / points[..., 2:]


def test_a_true_hypothesis_fits_the_picture_wherever_the_body_is(truth):
    off = reprojection_errors(truth[None], see(truth), np.ones((6, 17)))
    assert np.abs(off).max() < 1e-10


def test_joint_by_joint_the_one_nearest_to_the_picture_is_taken(truth):
    rng = np.random.default_rng(1)
    hypotheses = np.stack([truth] * 4)
    right = rng.integers(0, 4, (6, 17))
    for h in range(4):
        wrong = (right != h)[..., None]
        hypotheses[h] += wrong * rng.normal(0, 0.05, truth.shape)
    joined, spread = aggregate(hypotheses, see(truth), np.ones((6, 17)), SIZE, "jpma")
    mean, _ = aggregate(hypotheses, see(truth), np.ones((6, 17)), SIZE, "mean")
    assert np.allclose(mean, hypotheses.mean(axis=0))
    # Placing is shared, so the choice is not always right, but far better than the mean.
    hit = np.isclose(joined, truth).all(axis=-1).mean()
    assert hit > 0.7
    assert (
        np.linalg.norm(joined - truth, axis=-1).mean()
        < np.linalg.norm(mean - truth, axis=-1).mean()
    )
    assert spread.shape == (6, 17)
    assert (spread > 0).all()


def test_where_the_picture_can_t_decide_the_mean_is_taken(truth):
    hypotheses = truth + np.random.default_rng(2).normal(0, 0.01, (3, *truth.shape))
    rays = see(truth).copy()
    rays[:, 4, :2] += 5.0
    confidence = np.ones((6, 17))
    confidence[:, 4] = 0.0
    joined, _ = aggregate(hypotheses, rays, confidence, SIZE, "jpma")
    assert np.allclose(joined[:, 4], hypotheses.mean(axis=0)[:, 4])


def test_spread_is_the_standard_deviation(truth):
    hypotheses = truth + np.random.default_rng(3).normal(0, 0.02, (400, *truth.shape))
    _, spread = aggregate(hypotheses, see(truth), np.ones((6, 17)), SIZE, "mean")
    assert spread.mean() == pytest.approx(0.02, rel=0.02)


def test_one_hypothesis_has_no_spread(truth):
    joined, spread = aggregate(truth[None], see(truth), np.ones((6, 17)), SIZE, "jpma")
    assert np.array_equal(joined, truth)
    assert np.isnan(spread).all()
