"""A figure that lifts with a timing of its own, filmed by cameras whose clocks are known."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from scipy.interpolate import PchipInterpolator

from engine import optics
from engine.datatypes import Array, Camera, PoseTrack, SubjectState, ViewInfo, ViewPose
from engine.skeletons import MEDIAPIPE_33
from tests.builders import make_pose_track

World = Callable[[Array], Array]
"""Moments (T,) to keypoints (T, 33, 3), m."""

STANDING = make_pose_track(n_frames=2).position[-1]
UPPER = STANDING[:, 1] > 1.2
MIDDLE = (STANDING[:, 1] > 0.8) & ~UPPER
HANDS = np.array([any(w in n for w in ("wrist", "index", "thumb", "pinky", "elbow"))
                  for n in MEDIAPIPE_33.keypoints])  # fmt: skip


def make_lift(seed: int, length_s: float = 8.0) -> World:
    """Bend and reach at random times; no two seeds move alike."""
    rng = np.random.default_rng(seed)

    def curve(step_s: float) -> PchipInterpolator:
        count = int(length_s / step_s) + 4
        times = np.cumsum(rng.uniform(0.5, 1.5, count) * step_s) - 2 * step_s
        return PchipInterpolator(times, rng.uniform(0.0, 1.0, count), extrapolate=True)

    bend, forward, left, right = curve(1.0), curve(1.0), curve(0.7), curve(0.7)

    def world(time_s: Array) -> Array:
        places = np.tile(STANDING, (len(time_s), 1, 1))
        down, ahead = bend(time_s)[:, None], forward(time_s)[:, None]
        places[:, UPPER, 1] -= 0.6 * down
        places[:, MIDDLE, 1] -= 0.3 * down
        places[:, UPPER, 0] += 0.4 * ahead
        for side, lift in (("left", left), ("right", right)):
            own = HANDS & np.array([n.startswith(side) for n in MEDIAPIPE_33.keypoints])
            places[:, own, 1] += 0.5 * lift(time_s)[:, None]
        return places

    return world


def stand_still(time_s: Array) -> Array:
    return np.tile(STANDING, (len(time_s), 1, 1))


def look_from(azimuth_deg: float, height_m: float = 1.2, distance_m: float = 4.0) -> Camera:
    """Make a camera that looks at the figure's middle."""
    angle = np.radians(azimuth_deg)
    centre = np.array([distance_m * np.cos(angle), height_m, distance_m * np.sin(angle)])
    forward = np.array([0.0, 0.9, 0.0]) - centre
    forward /= np.linalg.norm(forward)
    side = np.cross(forward, [0.0, 1.0, 0.0])
    side /= np.linalg.norm(side)
    rotation = np.stack([side, np.cross(forward, side), forward])
    matrix = [[1000.0, 0.0, 640.0], [0.0, 1000.0, 360.0], [0.0, 0.0, 1.0]]
    return Camera(f"at {azimuth_deg:g}", (1280, 720), matrix, rotation, -rotation @ centre)


def film(
    world: World,
    camera: Camera,
    seen_s: Array,
    *,
    clock_s: Array | None = None,
    noise_px: float = 1.0,
    seed: int = 0,
) -> ViewPose:
    """Film at moments `seen_s`; the video's own clock starts at zero unless `clock_s` is given."""
    seen_s = np.asarray(seen_s)
    clock = seen_s - seen_s[0] if clock_s is None else clock_s
    image = optics.project(camera, world(seen_s))
    image += np.random.default_rng(seed).normal(0.0, noise_px, image.shape)
    confidence = np.full(image.shape[:2], 0.9)
    track = PoseTrack(clock, image, "px", "image", "mediapipe_33", confidence)
    box = np.concatenate([image.min(axis=1), image.max(axis=1)], axis=1)
    rate = (len(clock) - 1) / (clock[-1] - clock[0])
    info = ViewInfo("clip.mp4", "", rate, len(clock), (1280, 720), len(clock) / rate)
    return ViewPose(track, None, box, (SubjectState.TRACKED,) * len(clock), info)


def frames(start_s: float, stop_s: float, rate: float = 30.0) -> Array:
    return np.arange(start_s, stop_s, 1.0 / rate)
