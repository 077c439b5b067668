"""A person who moves in front of a camera, with the truth."""

from __future__ import annotations

import numpy as np

from engine.config import CameraConfig
from engine.datatypes import PoseTrack, SubjectState, ViewInfo, ViewPose
from engine.skeletons import MEDIAPIPE_33

SIZE_PX = (1280, 720)
FOCAL_PX = 0.5 * 1280 / np.tan(np.radians(CameraConfig().horizontal_fov_deg / 2))
_HEIGHTS = {
    "shoulder": 0.52, "elbow": 0.22, "wrist": 0.0, "pinky": -0.08, "index": -0.09, "thumb": -0.05,
    "hip": 0.0, "knee": -0.43, "ankle": -0.85, "heel": -0.92, "big_toe": -0.93,
}  # fmt: skip
_WIDTHS = {
    "shoulder": 0.18, "elbow": 0.24, "wrist": 0.26, "pinky": 0.27, "index": 0.25, "thumb": 0.22,
    "hip": 0.13, "knee": 0.12, "ankle": 0.11, "heel": 0.11, "big_toe": 0.12,
}  # fmt: skip


def flat_person(bend: float = 0.0) -> np.ndarray:
    """Return 33 landmarks (33, 3) in a plane, m around the hips, facing the camera.

    The subject's left is on the right of the picture; `bend` moves the upper body sideways, rad.
    """
    out = np.zeros((33, 3))
    for i, name in enumerate(MEDIAPIPE_33.keypoints):
        side, _, part = name.partition("_")
        sign = {"left": 1.0, "right": -1.0}.get(side, 0.0)
        out[i, 0] = sign * _WIDTHS.get(part, 0.04)
        out[i, 1] = -_HEIGHTS.get(part, 0.70)
    upper = out[:, 1] < -0.1
    c, s = np.cos(bend), np.sin(bend)
    out[upper, :2] = out[upper, :2] @ np.array([[c, s], [-s, c]])
    return out


def film(
    fps: float,
    *,
    seconds: float = 2.0,
    place=(0.0, 0.0, 4.0),
    axes=None,
    with_body: bool = True,
    confidence: float = 0.95,
) -> tuple[ViewPose, np.ndarray]:
    """Film a person who sways, with true landmarks.

    Returns
    -------
    tuple
        What BlazePose would see, and the landmarks (T, 33, 3) around the hips in camera axes, m.
    """
    time_s = np.arange(round(seconds * fps) + 1) / fps
    axes = np.eye(3) if axes is None else axes
    body = np.stack([flat_person(0.4 * np.sin(2 * np.pi * 0.5 * t)) for t in time_s])
    around = body @ axes.T
    seen = around + np.asarray(place)
    image = seen[..., :2] / seen[..., 2:] * FOCAL_PX + [(SIZE_PX[0] - 1) / 2, (SIZE_PX[1] - 1) / 2]
    sure = np.full(body.shape[:2], confidence)
    info = ViewInfo("fake.mp4", "", fps, len(time_s), SIZE_PX, seconds)
    track = PoseTrack(time_s, image, "px", "image", "mediapipe_33", sure)
    metric = PoseTrack(time_s, body, "m", "body", "mediapipe_33", sure) if with_body else None
    states = (SubjectState.TRACKED,) * len(time_s)
    box = np.tile([100.0, 50.0, 400.0, 700.0], (len(time_s), 1))
    return ViewPose(track, metric, box, states, info), around
