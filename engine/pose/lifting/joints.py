"""From BlazePose's 33 landmarks to the 17 joints of the lifting networks, and back."""

from __future__ import annotations

import numpy as np

from engine.datatypes import Array
from engine.errors import ShapeError
from engine.skeletons import H36M_17, MEDIAPIPE_33

__all__ = ["LIFTED_KEYPOINTS", "attach_to_joints", "to_h36m", "to_h36m_confidence"]

_H36M = {name: i for i, name in enumerate(H36M_17.keypoints)}
_LANDMARK = {name: i for i, name in enumerate(MEDIAPIPE_33.keypoints)}

LIFTED_KEYPOINTS: tuple[str, ...] = tuple(
    name for name in H36M_17.keypoints if name in _LANDMARK and name != "nose"
)
"""Landmarks that a lifting network places itself; the others go along with one of them. The nose
goes with the rest of the face."""

_HAND, _FOOT = ("pinky", "index", "thumb"), ("heel", "big_toe")
_GOES_WITH = {
    **{f"{s}_{p}": (f"{s}_wrist",) for s in ("left", "right") for p in _HAND},
    **{f"{s}_{p}": (f"{s}_ankle",) for s in ("left", "right") for p in _FOOT},
}
_SHOULDERS = ("left_shoulder", "right_shoulder")


def to_h36m(points: Array) -> Array:
    """Return BlazePose's points as the 17 joints.

    Parameters
    ----------
    points
        Shape (T, 33, D).

    Returns
    -------
    Array
        Shape (T, 17, D). Pelvis, thorax and spine are means of hips and shoulders; the
        top of the head, which the network does not give, is the nose again.

    Raises
    ------
    ShapeError
        If there are not 33 points.
    """
    if points.ndim != 3 or points.shape[1] != len(_LANDMARK):
        raise ShapeError(f"Landmarks need shape (T, 33, D), got {points.shape}.")
    out = np.full((len(points), len(_H36M), points.shape[2]), np.nan)
    for name, column in _H36M.items():
        if name in _LANDMARK:
            out[:, column] = points[:, _LANDMARK[name]]
    pelvis, thorax = (MEDIAPIPE_33.point(points, name) for name in ("pelvis", "thorax"))
    out[:, _H36M["pelvis"]], out[:, _H36M["thorax"]] = pelvis, thorax
    out[:, _H36M["spine"]] = 0.5 * (pelvis + thorax)
    out[:, _H36M["head"]] = out[:, _H36M["nose"]]
    return out


def to_h36m_confidence(confidence: Array) -> Array:
    """Return the confidence (T, 33) of the landmarks for the 17 joints, shape (T, 17)."""
    return to_h36m(confidence[:, :, None])[:, :, 0]


def attach_to_joints(joints: Array, landmarks: Array) -> Array:
    """Give all 33 landmarks, with the lifted joints in their places.

    Hands go with their wrist, feet with their ankle and the face with the middle of the
    shoulders, each as the landmarks have it.

    Parameters
    ----------
    joints
        Shape (T, 17, 3), m; NaN where not known.
    landmarks
        Shape (T, 33, 3), m, the same axes.

    Returns
    -------
    Array
        Shape (T, 33, 3), m, around the middle of the lifted hips.
    """
    out = np.full(landmarks.shape, np.nan)
    for name in LIFTED_KEYPOINTS:
        out[:, _LANDMARK[name]] = joints[:, _H36M[name]]
    for name, column in _LANDMARK.items():
        if name not in LIFTED_KEYPOINTS:
            anchors = [_LANDMARK[a] for a in _GOES_WITH.get(name, _SHOULDERS)]
            away = landmarks[:, column] - landmarks[:, anchors].mean(axis=1)
            out[:, column] = out[:, anchors].mean(axis=1) + away
    return np.asarray(out - MEDIAPIPE_33.point(out, "pelvis")[:, None])
