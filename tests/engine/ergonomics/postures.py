"""Exposures with a posture that is known angle by angle."""

from __future__ import annotations

import math

import numpy as np

from engine.datatypes import JointAngles, PoseTrack, Subject, Task
from engine.ergonomics.base import Exposure
from engine.skeletons import MEDIAPIPE_33

FPS = 30.0
NEUTRAL = {
    "trunk_flexion": 0.0,
    "trunk_lateral_bend": 0.0,
    "trunk_twist": 0.0,
    "neck_flexion": 0.0,
    **{f"knee_flexion_{s}": 0.0 for s in "lr"},
    **{f"shoulder_flexion_{s}": 0.0 for s in "lr"},
    **{f"shoulder_adduction_{s}": 0.0 for s in "lr"},
    **{f"elbow_flexion_{s}": 80.0 for s in "lr"},
}
"""Every part scores 1, except RULA's and REBA's tables ask for more."""
SHORT = {
    "neck": "neck_flexion",
    "knees": "knee_flexion",
    "arms": "shoulder_flexion",
    "adduction": "shoulder_adduction",
    "elbows": "elbow_flexion",
}
UPRIGHT = {
    "ear": (0.0, 1.62, 0.07),
    "shoulder": (0.0, 1.44, 0.18),
    "elbow": (0.0, 1.14, 0.20),
    "wrist": (0.25, 1.1, 0.2),
    "hip": (0.0, 0.92, 0.1),
    "knee": (0.0, 0.5, 0.1),
    "ankle": (0.0, 0.09, 0.1),
}


def build_track(n_frames, *, points=None, travel_m_s=0.0, sigma_m=0.0):
    """Make an upright figure; `points` moves keypoints of both sides or of one."""
    position = np.full((n_frames, len(MEDIAPIPE_33.keypoints), 3), np.nan)
    way = travel_m_s * np.arange(n_frames) / FPS
    given = dict(points or {})
    for part, place in UPRIGHT.items():
        for side, sign in (("left", -1.0), ("right", 1.0)):
            x, y, z = given.get(f"{side}_{part}", given.get(part, place))
            column = MEDIAPIPE_33.index(f"{side}_{part}")
            position[:, column] = np.stack(
                [x + way, np.full(n_frames, y), np.full(n_frames, sign * z)], axis=1
            )
    return PoseTrack(
        time_s=np.arange(n_frames) / FPS,
        position=position,
        unit="m",
        frame_of_reference="world",
        skeleton="mediapipe_33",
        sigma=np.full(position.shape[:2], sigma_m),
    )


def build_posture(
    *lifts, n_frames=60, sigma=0.0, points=None, travel_m_s=0.0, conditions=(), **values
):
    """Make an exposure from angles (numbers or curves; `knees`, `arms` ... for both sides).

    `sigma` is the standard error of all angles, or of some by name.
    """
    angles = {SHORT.get(name, name): v for name, v in values.items()}
    task = {name: angles.pop(name) for name in tuple(angles) if name in Task.__dataclass_fields__}
    curves = {name: np.full(n_frames, v) for name, v in NEUTRAL.items()}
    for name, value in angles.items():
        both = [f"{name}_l", f"{name}_r"] if f"{name}_l" in NEUTRAL else [name]
        for one in both:
            assert one in NEUTRAL or one == "trunk_inclination", f"no angle {one}"
            curves[one] = np.broadcast_to(np.asarray(value, dtype=float), (n_frames,))
    value = np.stack(list(curves.values()), axis=1)
    track = build_track(
        n_frames, points=points, travel_m_s=travel_m_s, sigma_m=math.nan if sigma is None else 0.0
    )
    errors = np.full(value.shape, np.nan if sigma is None else 0.0)
    for k, name in enumerate(curves):
        if sigma is not None:
            errors[:, k] = sigma.get(name, 0.0) if isinstance(sigma, dict) else sigma
    return Exposure(
        track=track,
        angles=JointAngles(track.time_s, value, tuple(curves), errors),
        lifts=lifts,
        subject=Subject(stature_m=1.75),
        task=Task(**task),
        observed_s=n_frames / FPS,
        conditions=conditions,
    )
