"""From BlazePose's landmarks to 29 joints and back."""

from __future__ import annotations

import numpy as np
import pytest

from engine.errors import NoPersonFound, ShapeError
from engine.pose.swing_twist.inverse_kinematics import rotate_about
from engine.pose.swing_twist.landmarks import (
    body_size,
    joints_from_landmarks,
    landmarks_from_joints,
    picture_scale,
)
from engine.pose.swing_twist.posture import follow_picture, pose_landmarks
from engine.pose.swing_twist.skeleton29 import JOINTS, PARENTS
from engine.skeletons import MEDIAPIPE_33

from .builders import REST, human_rotations, place

TURN = rotate_about(np.array([0.6, 0.0, 0.8]), np.array(1.1))


def test_a_body_that_is_the_skeleton_gives_it_back():
    rotation = human_rotations(6, seed=1)
    stiff = ["spine_low", "spine_mid", "spine_high", "left_collar", "right_collar"]
    rotation[:, [JOINTS.index(name) for name in stiff]] = np.eye(3)
    body = place(rotation)
    joints = joints_from_landmarks(body)
    assert body_size(joints) == pytest.approx(1.75, rel=1e-6)
    np.testing.assert_allclose(landmarks_from_joints(joints, body), body, atol=1e-12)
    moved, posed = pose_landmarks(body)
    limbs = [MEDIAPIPE_33.index(f"left_{p}") for p in ("knee", "ankle", "elbow", "wrist")]
    np.testing.assert_allclose(moved[:, limbs], body[:, limbs], atol=1e-6)
    assert posed.rotation.shape == (6, 24, 3, 3)


def test_joints_turn_with_the_landmarks():
    body = place(human_rotations(6, seed=2))
    np.testing.assert_allclose(
        joints_from_landmarks(body @ TURN.T), joints_from_landmarks(body) @ TURN.T, atol=1e-12
    )


def test_the_head_is_above_the_ears():
    joints = joints_from_landmarks(place(np.tile(np.eye(3), (1, 24, 1, 1))))[0]
    up = joints[JOINTS.index("head_top")] - joints[JOINTS.index("head")]
    np.testing.assert_allclose(up / np.linalg.norm(up), [0.0, 1.0, 0.0], atol=0.1)


def test_bones_keep_one_length_through_a_clip():
    rng = np.random.default_rng(3)
    body = place(human_rotations(60, seed=3))
    noisy = body + rng.normal(0, 0.02, body.shape)
    noisy[7] = np.nan
    moved, posed = pose_landmarks(noisy)
    span = np.linalg.norm(posed.joints[:, 1:] - posed.joints[:, list(PARENTS[1:])], axis=2)
    seen = np.isfinite(noisy).all(axis=(1, 2))
    assert np.isnan(moved[~seen]).all()
    assert np.ptp(span[seen], axis=0).max() < 1e-9
    thigh, shin = (JOINTS.index(f"left_{p}") - 1 for p in ("knee", "ankle"))
    assert span[0, thigh] == pytest.approx(REST.lengths[thigh + 1], rel=0.03)
    assert span[0, shin] == pytest.approx(span[0, JOINTS.index("right_ankle") - 1])


def test_the_picture_can_lead_across_the_line_of_sight():
    body = place(human_rotations(4, seed=4))
    image = 300.0 * body[..., :2] + (360.0, 240.0)
    np.testing.assert_allclose(picture_scale(body, image), 1 / 300.0)
    off = body + np.random.default_rng(5).normal(0, 0.02, body.shape)
    np.testing.assert_array_equal(follow_picture(off, image, 0.0), off)
    led = follow_picture(off, image, 1.0)
    np.testing.assert_array_equal(led[..., 2], off[..., 2])

    def shape(points):
        return points[..., :2] - points[..., :2].mean(axis=1, keepdims=True)

    assert np.abs(shape(led) - shape(body)).mean() < 0.3 * np.abs(shape(off - body)).mean()


def test_a_person_never_seen_whole():
    body = place(human_rotations(3, seed=6))
    body[:, MEDIAPIPE_33.index("left_ankle")] = np.nan
    with pytest.raises(NoPersonFound, match="from head to feet"):
        pose_landmarks(body)
    with pytest.raises(ShapeError, match=r"\(T, 33, 3\)"):
        pose_landmarks(body[:, :17])
