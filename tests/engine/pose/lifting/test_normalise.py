"""What networks see does not depend on picture, lens, place or size."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from engine.pose.lifting.normalise import prepare_points, sight_axes, stature_of

BODY = np.random.default_rng(0).uniform(-0.4, 0.4, (5, 17, 3))


@given(st.floats(-1, 1), st.floats(-1, 1), st.floats(0.2, 2))
def test_sight_axes_are_a_rotation_that_looks_along_the_line(x, y, z):
    axes = sight_axes(np.array([x, y, z]))
    assert np.allclose(axes @ axes.T, np.eye(3), atol=1e-9)
    assert np.linalg.det(axes) == pytest.approx(1.0)
    assert np.allclose(axes[:, 2], np.array([x, y, z]) / np.linalg.norm([x, y, z]))
    assert axes[1, 0] == pytest.approx(0.0)  # no roll


def seen_from(centre, stature, distance):
    """Return lines of sight to a body (in statures) that turns with the line of sight."""
    axes = sight_axes(np.asarray(centre, dtype=float))
    away = np.asarray(centre) / np.linalg.norm(centre) * distance
    body = BODY - BODY[:, :1].mean(axis=0, keepdims=True)
    points = (body * stature) @ axes.T + away
    return points / points[..., 2:], axes


@pytest.mark.parametrize("centre", [(0, 0, 1), (0.5, 0.1, 1), (-0.3, 0.4, 1)])
@pytest.mark.parametrize(("stature", "distance"), [(1.0, 4.0), (1.8, 7.2)])
def test_same_person_seen_from_the_same_side_looks_the_same(centre, stature, distance):
    rays, axes = seen_from(centre, stature, distance)
    straight, _ = seen_from((0, 0, 1), 1.0, 4.0)
    points, found = prepare_points(rays[None], np.array([stature / distance]))
    wanted, _ = prepare_points(straight[None], np.array([0.25]))
    # The pelvis sways a little around its mean direction, so the axes agree to a few milliradians.
    assert np.abs(found[0] - axes).max() < 0.02
    assert np.abs(points - wanted).max() < 0.02


def test_points_are_in_statures_around_the_pelvis():
    rays, _ = seen_from((0, 0, 1), 1.7, 50.0)
    points, _ = prepare_points(rays[None], np.array([1.7 / 50.0]))
    assert np.abs(points[0, :, 0].mean(axis=0)).max() < 1e-9
    flat = BODY[..., :2] - BODY[:, 0, :2].mean(axis=0)
    assert np.abs(points[0] - flat).max() < 0.02


def test_stature_follows_the_segments():
    joints = np.zeros((3, 17, 3))
    joints[:, [2, 5], 1], joints[:, [3, 6], 1] = 0.245, 0.245 + 0.246
    joints[:, 8, 1] = -0.288
    assert stature_of(1.8 * joints) == pytest.approx(1.8)
    assert stature_of(np.stack([joints, 2 * joints])).shape == (2,)
