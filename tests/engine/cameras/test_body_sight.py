"""Joints that an estimator is sure of are seen again where they are."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from engine.cameras.body_sight import see_body_again
from engine.cameras.monocular import reconstruct_single_view
from engine.datatypes import Measurement
from engine.skeletons import MEDIAPIPE_33
from tests.engine.cameras.truth import read_truth, see

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


class TestReconstruction:
    """A real movement whose keypoints lie beside the joints, as a network's do."""

    hips = tuple(MEDIAPIPE_33.index(f"{side}_hip") for side in ("left", "right"))

    @pytest.fixture
    def lift(self):
        return read_truth("floor_to_knuckle")

    def trunk_error_deg(self, lift, *, states_errors):
        view = see(lift.points, lift.cameras["cam90"], lift.time_s)
        image = np.array(view.image.position)
        image[:, self.hips] += [12.0, 6.0]
        sigma = np.full(image.shape[:2], np.nan)
        if states_errors:
            joints = ("shoulder", "elbow", "wrist", "hip", "knee", "ankle")
            names = [f"{side}_{joint}" for side in ("left", "right") for joint in joints]
            sigma[:, [MEDIAPIPE_33.index(name) for name in names]] = 0.02
        view = dataclasses.replace(
            view,
            image=dataclasses.replace(view.image, position=image),
            body=dataclasses.replace(view.body, sigma=sigma),
        )
        matrix = lift.cameras["cam90"].matrix
        track, _ = reconstruct_single_view(view, Measurement(lift.stature_m, 0.01), matrix=matrix)
        trunks = [
            MEDIAPIPE_33.point(p, "thorax") - MEDIAPIPE_33.point(p, "pelvis")
            for p in (np.asarray(track.position), lift.points)
        ]
        slopes = [np.degrees(np.arctan2(t[:, 0], t[:, 1])) for t in trunks]
        return float(np.mean(np.abs(slopes[0] - slopes[1])))

    def test_joints_with_stated_errors_put_a_displaced_keypoint_right(self, lift):
        believed = self.trunk_error_deg(lift, states_errors=True)
        assert believed < 2.5
        assert self.trunk_error_deg(lift, states_errors=False) > believed + 2.0
