"""Joints that an estimator is sure of are seen again where they are."""

from __future__ import annotations

import numpy as np
import pytest

from engine.cameras.body_sight import see_body_again

PLACE = np.array([0.2, -0.1, 4.0])


@pytest.fixture
def scene():
    """Return a body (5, 14, 3) and lines of sight to points that lie beside its joints."""
    rng = np.random.default_rng(0)
    body = rng.uniform(-0.5, 0.5, (5, 14, 3))
    true = (body + PLACE) / (body + PLACE)[..., 2:]
    off = rng.normal(0, 0.01, true[..., :2].shape)
    off -= off.mean(axis=1, keepdims=True)
    rays = true.copy()
    rays[..., :2] += off
    return body, true, rays


def test_without_stated_errors_the_picture_stays(scene):
    body, _, rays = scene
    sigma = np.full((5, 14), np.nan)
    assert np.array_equal(see_body_again(body, sigma, rays, np.ones((5, 14))), rays)


def test_stated_joints_replace_the_points(scene):
    body, true, rays = scene
    again = see_body_again(body, np.full((5, 14), 0.02), rays, np.ones((5, 14)))
    assert np.allclose(again[..., 2], 1.0)
    before = np.linalg.norm(rays - true, axis=-1).mean()
    assert np.linalg.norm(again - true, axis=-1).mean() < 0.5 * before


def test_a_true_picture_is_not_changed(scene):
    body, true, _ = scene
    again = see_body_again(body, np.full((5, 14), 0.02), true, np.full((5, 14), 0.3))
    assert np.allclose(again, true, atol=1e-9)


def test_joints_without_a_stated_error_stay_as_seen(scene):
    body, _, rays = scene
    sigma = np.full((5, 14), 0.02)
    sigma[:, 10:] = np.nan
    again = see_body_again(body, sigma, rays, np.ones((5, 14)))
    assert np.array_equal(again[:, 10:], rays[:, 10:])
    assert not np.allclose(again[:, :10], rays[:, :10])


def test_a_point_of_no_confidence_hardly_moves_the_body(scene):
    body, true, _ = scene
    rays, confidence = true.copy(), np.ones((5, 14))
    rays[:, 0, 0] += 0.2
    sigma = np.full((5, 14), 0.02)
    sure = see_body_again(body, sigma, rays, confidence)
    confidence[:, 0] = 0.0
    unsure = see_body_again(body, sigma, rays, confidence)
    errors = [np.linalg.norm(found - true, axis=-1).mean() for found in (sure, unsure)]
    assert errors[1] < 0.3 * errors[0]


def test_missing_stays_missing(scene):
    body, _, rays = scene
    rays[2, 3] = np.nan
    body[4] = np.nan
    again = see_body_again(body, np.full((5, 14), 0.02), rays, np.ones((5, 14)))
    assert np.isnan(again[2, 3]).all()
    assert np.array_equal(again[4], rays[4])
    assert np.isfinite(again[[0, 1, 3]]).all()
