"""A person's skeleton through a clip: constant bones, turned to what the landmarks show."""

from __future__ import annotations

from typing import Literal

import numpy as np

from engine.datatypes import Array
from engine.errors import NoPersonFound
from engine.pose.swing_twist.inverse_kinematics import PosedSkeleton, solve_posture
from engine.pose.swing_twist.landmarks import (
    body_size,
    joints_from_landmarks,
    landmarks_from_joints,
    picture_scale,
)
from engine.pose.swing_twist.skeleton29 import RestSkeleton, measure_lengths

__all__ = ["follow_picture", "pose_landmarks", "rest_of_person"]


def rest_of_person(joints: Array) -> RestSkeleton:
    """Return the skeleton of the person whose joints (T, 29, 3), m, these are.

    Every bone has its median length in the clip, left and right alike; one that is never seen
    whole has its share of the stature that legs and trunk mean.

    Raises
    ------
    NoPersonFound
        If legs and trunk are never seen together.
    """
    size = body_size(joints)
    if not np.isfinite(size):
        raise NoPersonFound(
            "The size of the skeleton needs shoulders, hips, knees and ankles in one picture, but "
            "they were never seen together; film the whole person from head to feet."
        )
    return RestSkeleton.from_stature(size).with_lengths(measure_lengths(joints))


def follow_picture(body: Array, image: Array, weight: float) -> Array:
    """Move landmarks across the line of sight to where the picture shows them.

    Parameters
    ----------
    body
        Shape (T, 33, 3), m around the hips, camera axes (x right, y down, z away).
    image
        Shape (T, 33, 2), px.
    weight
        0 leaves them, 1 follows the picture.

    Returns
    -------
    Array
        Shape (T, 33, 3). The scale of a frame, m per px, is the one at which picture and landmarks
        agree best; what lies along the line of sight is kept.
    """
    flat = body[..., :2] - body[..., :2].mean(axis=1, keepdims=True)
    seen = image - image.mean(axis=1, keepdims=True)
    moved = body.copy()
    moved[..., :2] += weight * (picture_scale(body, image)[:, None, None] * seen - flat)
    return moved


def pose_landmarks(
    body: Array,
    *,
    image: Array | None = None,
    picture_weight: float = 0.0,
    ik: Literal["adaptive", "naive"] = "adaptive",
) -> tuple[Array, PosedSkeleton]:
    """Pose the person's skeleton by the landmarks of a clip.

    Parameters
    ----------
    body
        Shape (T, 33, 3), m around the hips, camera axes.
    image
        Shape (T, 33, 2), px, needed where `picture_weight` is not 0; see `follow_picture`.
    picture_weight
        How far the skeleton follows the picture across the line of sight.
    ik
        See `solve_posture`.

    Returns
    -------
    tuple
        The landmarks (T, 33, 3) moved with the skeleton, and the skeleton itself.
    """
    target = body if image is None else follow_picture(body, image, picture_weight)
    joints = joints_from_landmarks(target)
    posed = solve_posture(rest_of_person(joints), joints, ik=ik)
    return landmarks_from_joints(posed.joints, target), posed
