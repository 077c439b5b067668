"""From BlazePose's 33 landmarks to the 29 joints, and back."""

from __future__ import annotations

from typing import Final

import numpy as np

from engine.datatypes import Array
from engine.errors import ShapeError
from engine.pose.swing_twist.skeleton29 import (
    COLLAR_SHARE,
    JOINTS,
    N_JOINTS,
    SPINE_SHARES,
)
from engine.skeletons import MEDIAPIPE_33

__all__ = ["body_size", "joints_from_landmarks", "landmarks_from_joints", "picture_scale"]

N_LANDMARKS: Final = len(MEDIAPIPE_33.keypoints)
HEAD_TOP_SHARE: Final = 0.077
"""From ear height to the top of the head, as a share of the stature."""
FACE_SLOPE: Final = 0.25
"""The nose lies lower than the ears by this share of its distance before them."""
BALL_SHARE: Final = 0.72
"""Where the ball of the foot lies from the heel to the big toe."""
FINGER_SHARE: Final = 1.9
"""Where the finger tips lie, in distances from the wrist to the knuckles."""
SEGMENT_SUM: Final = 0.245 + 0.246 + 0.288
"""Thigh, shank and trunk as a share of stature (Drillis and Contini; Winter 2009)."""

_COLUMN: Final = {name: i for i, name in enumerate(JOINTS)}
_DIRECT: Final = ("hip", "knee", "ankle", "shoulder", "elbow", "wrist", "big_toe")


def body_size(joints: Array) -> float:
    """Return the stature that the legs and the trunk of joints (T, 29, 3) mean, in their unit.

    NaN where they were never all seen.
    """
    total = np.linalg.norm(joints[:, _COLUMN["neck"]] - joints[:, 0], axis=1)
    total = total / SPINE_SHARES["neck"]
    for side in ("left", "right"):
        hip, knee, ankle = (
            joints[:, _COLUMN[f"{side}_{part}"]] for part in ("hip", "knee", "ankle")
        )
        total = total + 0.5 * np.linalg.norm(hip - knee, axis=1)
        total = total + 0.5 * np.linalg.norm(knee - ankle, axis=1)
    known = total[np.isfinite(total)]
    return float(np.median(known)) / SEGMENT_SUM if known.size else float("nan")


def joints_from_landmarks(body: Array) -> Array:
    """Place the 29 joints by the 33 landmarks.

    Limbs are taken as they are. The spine, which no landmark shows, is put on the line from the
    middle of the hips to the middle of the shoulders; the top of the head by ears and nose.

    Parameters
    ----------
    body
        Shape (T, 33, 3), m, in right-handed axes; NaN where missing.

    Returns
    -------
    Array
        Shape (T, 29, 3), in the same axes; NaN where a landmark it needs is missing.

    Raises
    ------
    ShapeError
        If the shape differs.
    """
    if body.ndim != 3 or body.shape[1:] != (N_LANDMARKS, 3):
        raise ShapeError(f"Landmarks need shape (T, 33, 3), got {body.shape}.")
    seen = {name: body[:, i] for i, name in enumerate(MEDIAPIPE_33.keypoints)}
    joints = np.full((len(body), N_JOINTS, 3), np.nan)

    def put(name: str, value: Array) -> None:
        joints[:, _COLUMN[name]] = value

    pelvis = 0.5 * (seen["left_hip"] + seen["right_hip"])
    thorax = 0.5 * (seen["left_shoulder"] + seen["right_shoulder"])
    put("pelvis", pelvis)
    for name, share in SPINE_SHARES.items():
        put(name, pelvis + share * (thorax - pelvis))
    for side in ("left", "right"):
        for part in _DIRECT:
            put(f"{side}_{part}", seen[f"{side}_{part}"])
        shoulder, wrist, heel = (seen[f"{side}_{p}"] for p in ("shoulder", "wrist", "heel"))
        knuckles = 0.5 * (seen[f"{side}_index"] + seen[f"{side}_pinky"])
        put(f"{side}_collar", thorax + COLLAR_SHARE * (shoulder - thorax))
        put(f"{side}_hand", knuckles)
        put(f"{side}_fingers", wrist + FINGER_SHARE * (knuckles - wrist))
        put(f"{side}_foot", heel + BALL_SHARE * (seen[f"{side}_big_toe"] - heel))
    head = 0.5 * (seen["left_ear"] + seen["right_ear"])
    put("head", head)
    put("head_top", head + HEAD_TOP_SHARE * body_size(joints) * _head_up(seen, head))
    return joints


def _head_up(seen: dict[str, Array], head: Array) -> Array:
    """Return the head's upward unit vector (T, 3): across the line of the ears and the face."""
    right = seen["right_ear"] - seen["left_ear"]
    face = seen["nose"] - head
    up = _unit(np.cross(right, face))
    return _unit(up - FACE_SLOPE * _unit(face))


def _unit(vector: Array) -> Array:
    length = np.linalg.norm(vector, axis=1, keepdims=True)
    unit = np.divide(vector, length, out=np.full_like(vector, np.nan), where=length > 1e-9)
    return np.asarray(unit)


def landmarks_from_joints(joints: Array, body: Array) -> Array:
    """Put the 33 landmarks where the joints went.

    Landmarks that are joints take their place; those of face, hands and heels keep their offsets
    from head, wrists and ankles.

    Parameters
    ----------
    joints
        Shape (T, 29, 3), m.
    body
        Shape (T, 33, 3), m: the landmarks the joints came from, in the same axes.

    Returns
    -------
    Array
        Shape (T, 33, 3), m, around the middle of the hips.
    """
    moved = np.empty_like(body)
    before = joints_from_landmarks(body)
    for column, name in enumerate(MEDIAPIPE_33.keypoints):
        anchor = _COLUMN[_anchor(name)]
        moved[:, column] = joints[:, anchor] + (body[:, column] - before[:, anchor])
    hips = [MEDIAPIPE_33.index(f"{side}_hip") for side in ("left", "right")]
    return np.asarray(moved - moved[:, hips].mean(axis=1, keepdims=True))


def picture_scale(body: Array, image: Array) -> Array:
    """Return the scale (T,), m per px, at which landmarks agree best with the picture.

    Parameters
    ----------
    body
        Shape (T, 33, 3), m, camera axes.
    image
        Shape (T, 33, 2), px.
    """
    flat = body[..., :2] - body[..., :2].mean(axis=1, keepdims=True)
    seen = image - image.mean(axis=1, keepdims=True)
    return np.asarray(
        (flat * seen).sum(axis=(1, 2)) / np.maximum((seen**2).sum(axis=(1, 2)), 1e-12)
    )


def _anchor(landmark: str) -> str:
    """Return the joint a landmark goes with."""
    if landmark in _COLUMN:
        return landmark
    side, _, part = landmark.partition("_")
    anchor = {"pinky": "hand", "index": "hand", "thumb": "wrist", "heel": "ankle"}.get(part)
    return f"{side}_{anchor}" if anchor else "head"
