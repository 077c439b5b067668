"""From 33 landmarks to 17 joints and back."""

from __future__ import annotations

import numpy as np
import pytest

from engine.errors import ShapeError
from engine.pose.lifting.joints import (
    LIFTED_KEYPOINTS,
    attach_to_joints,
    to_h36m,
    to_h36m_confidence,
)
from engine.skeletons import H36M_17, MEDIAPIPE_33


@pytest.fixture
def landmarks():
    return np.random.default_rng(0).normal(size=(4, 33, 3))


def test_joints_keep_their_names(landmarks):
    joints = to_h36m(landmarks)
    for name in ("left_wrist", "right_ankle", "left_hip", "nose"):
        assert np.array_equal(joints[:, H36M_17.index(name)], MEDIAPIPE_33.point(landmarks, name))
    assert np.allclose(joints[:, 0], 0.5 * (joints[:, 1] + joints[:, 4]))
    assert np.allclose(joints[:, 8], 0.5 * (joints[:, 11] + joints[:, 14]))
    assert np.allclose(joints[:, 7], 0.5 * (joints[:, 0] + joints[:, 8]))


def test_the_whole_body_is_lifted_but_face_hands_and_feet():
    assert len(LIFTED_KEYPOINTS) == 12
    assert set(LIFTED_KEYPOINTS) < set(H36M_17.keypoints)


def test_there_and_back_changes_nothing(landmarks):
    around = landmarks - MEDIAPIPE_33.point(landmarks, "pelvis")[:, None]
    assert np.allclose(attach_to_joints(to_h36m(landmarks), landmarks), around)


def test_hands_feet_and_face_go_along(landmarks):
    joints = to_h36m(landmarks)
    moved = joints.copy()
    moved[:, H36M_17.index("left_wrist")] += [0.1, 0.2, 0.3]
    before, after = attach_to_joints(joints, landmarks), attach_to_joints(moved, landmarks)
    shift = after - before
    for name in MEDIAPIPE_33.keypoints:
        goes = name in ("left_wrist", "left_pinky", "left_index", "left_thumb")
        wanted = [0.1, 0.2, 0.3] if goes else [0, 0, 0]
        assert np.allclose(shift[:, MEDIAPIPE_33.index(name)], wanted), name


def test_unknown_joints_stay_unknown(landmarks):
    joints = to_h36m(landmarks)
    joints[1, H36M_17.index("left_ankle")] = np.nan
    body = attach_to_joints(joints, landmarks)
    missing = {n for n in MEDIAPIPE_33.keypoints if np.isnan(body[1, MEDIAPIPE_33.index(n)]).any()}
    assert missing == {"left_ankle", "left_heel", "left_big_toe"}


def test_confidence_of_a_middle_is_that_of_its_parts():
    confidence = np.full((1, 33), 0.8)
    confidence[0, MEDIAPIPE_33.index("left_hip")] = 0.2
    assert to_h36m_confidence(confidence)[0, 0] == pytest.approx(0.5)


def test_other_landmarks_are_refused():
    with pytest.raises(ShapeError, match=r"\(T, 33, D\), got \(2, 17, 3\)"):
        to_h36m(np.zeros((2, 17, 3)))
