"""Postures for the tests of this package."""

from __future__ import annotations

import numpy as np

from engine.pose.swing_twist.inverse_kinematics import place_joints, rotate_about
from engine.pose.swing_twist.landmarks import BALL_SHARE
from engine.pose.swing_twist.skeleton29 import JOINTS, N_TURNING, RestSkeleton
from engine.skeletons import MEDIAPIPE_33

REST = RestSkeleton.from_stature(1.75)


def random_rotations(n: int, seed: int, largest_deg: float = 170.0) -> np.ndarray:
    """Draw rotations (n, 24, 3, 3) of up to `largest_deg`, the axes anywhere."""
    rng = np.random.default_rng(seed)
    axis = rng.normal(size=(n, N_TURNING, 3))
    axis /= np.linalg.norm(axis, axis=-1, keepdims=True)
    return rotate_about(axis, np.radians(rng.uniform(0, largest_deg, (n, N_TURNING))))


def human_rotations(n: int, seed: int) -> np.ndarray:
    """Draw smaller rotations, as of a moving person, after any turn of the whole body."""
    rotation = random_rotations(n, seed, 60.0)
    rotation[:, 0] = random_rotations(n, seed + 1)[:, 0]
    return rotation


def place(rotation: np.ndarray) -> np.ndarray:
    """Give a posture the 33 landmarks, shape (T, 33, 3), m around the hips."""
    posed = place_joints(REST, rotation)
    at = dict(zip(JOINTS, np.moveaxis(posed.joints, 1, 0), strict=True))
    turned = rotation[:, 0].copy()
    for name in ("spine_low", "spine_mid", "spine_high", "neck", "head"):
        turned = turned @ rotation[:, JOINTS.index(name)]
    points = {}
    for name in MEDIAPIPE_33.keypoints:
        side, _, part = name.partition("_")
        sign = -1.0 if side == "left" else 1.0
        if name in at:
            points[name] = at[name]
        elif part == "heel":
            toe, ball = at[f"{side}_big_toe"], at[f"{side}_foot"]
            points[name] = (ball - BALL_SHARE * toe) / (1.0 - BALL_SHARE)
        elif part in ("pinky", "index", "thumb"):
            points[name] = at[f"{side}_hand"]
        else:
            face = {"ear": (0.0, 0.0, 0.08), "eye": (0.10, 0.0, 0.03), "mouth": (0.1, -0.06, 0.03)}
            offset = np.array(face.get(part.split("_")[0], (0.12, -0.03, 0.0))) * (1, 1, sign)
            points[name] = at["head"] + turned @ offset
    body = np.stack([points[name] for name in MEDIAPIPE_33.keypoints], axis=1)
    hips = [MEDIAPIPE_33.index(f"{side}_hip") for side in ("left", "right")]
    return body - body[:, hips].mean(axis=1, keepdims=True)
