"""Exact movements of the sample clips, and exact views of them.

The joints of a computer-generated person are known without error. Seen through a known camera they
are what a perfect estimator would return.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from engine.datatypes import Array, Camera, PoseTrack, SubjectState, ViewInfo, ViewPose
from engine.skeletons import MEDIAPIPE_33

SAMPLES = Path(__file__).parents[3] / "sample_data"
CLIPS = ("floor_to_knuckle", "floor_to_shoulder")
NAMES = MEDIAPIPE_33.keypoints
_OTHER_NAMES = {"big_toe": "bigtoe", "eye_inner": "eye", "eye_outer": "eye", "thumb": "index"}


@dataclass(frozen=True)
class Truth:
    """One movement at the times of the video's frames, in world metres.

    `points` (T, 33, 3) in MediaPipe's order; `knuckles` (T, 3) middle of the markers on both
    third knuckles; `inclination_deg` (T,) of the trunk.
    """

    time_s: Array
    points: Array
    knuckles: Array
    inclination_deg: Array
    stature_m: float
    events_s: dict[str, float]
    cameras: dict[str, Camera]

    def at(self, time_s: float) -> int:
        """Return the frame nearest to a time."""
        return int(np.argmin(np.abs(self.time_s - time_s)))


def read_truth(clip: str) -> Truth:
    """Read the exact movement of one sample clip."""
    folder = SAMPLES / clip
    subject = json.loads((folder / "subject.json").read_text())
    trial = json.loads((folder / "trial.json").read_text())
    with np.load(folder / "truth.npz", allow_pickle=False) as data:
        stored = {name: np.asarray(data[name]) for name in data.files}
    time_s = stored["video_time"]

    def at_frames(values: Array) -> Array:
        flat = values.reshape(len(values), -1)
        columns = [np.interp(time_s, stored["time"], column) for column in flat.T]
        return np.stack(columns, axis=1).reshape(len(time_s), *values.shape[1:])

    joints = list(stored["joint_names"])
    markers = list(stored["marker_names"])
    angles = list(stored["angle_names"])
    column = [joints.index(_joint_name(name)) for name in NAMES]
    knuckles = [markers.index(name) for name in ("RFIN", "LFIN")]
    return Truth(
        time_s=time_s,
        points=at_frames(stored["joints"][:, column].astype(float)),
        knuckles=at_frames(stored["markers"][:, knuckles].astype(float)).mean(axis=1),
        inclination_deg=at_frames(
            stored["angles"][:, [angles.index("trunk_inclination")]].astype(float)
        )[:, 0],
        stature_m=subject["height_m"],
        events_s=trial["events_s"],
        cameras={c["name"]: _read_camera(c) for c in subject["calibration"]},
    )


def _joint_name(keypoint: str) -> str:
    if keypoint in ("nose", "left_mouth", "right_mouth"):
        return "nose"
    side, part = keypoint.split("_", 1)
    return f"{_OTHER_NAMES.get(part, part)}_{side[0].upper()}"


def _read_camera(values: dict) -> Camera:
    return Camera(
        name=values["name"],
        size_px=(values["width"], values["height"]),
        matrix=np.array(values["K"]),
        rotation=np.array(values["R"]),
        translation=np.array(values["t"]),
    )


def place_camera(
    *,
    azimuth_deg: float = 90.0,
    distance_m: float = 4.0,
    height_m: float = 1.3,
    pitch_deg: float = 0.0,
    roll_deg: float = 0.0,
    size_px: tuple[int, int] = (720, 480),
    focal_px: float = 733.0,
) -> Camera:
    """Place a camera that looks towards the world's vertical axis.

    Azimuth counts from the subject's front to the right; a camera that looks down has positive
    pitch; with positive roll the vertical leans to the right in the picture.
    """
    azimuth = np.radians(azimuth_deg)
    centre = np.array([distance_m * np.cos(azimuth), height_m, distance_m * np.sin(azimuth)])
    forward = np.array([-np.cos(azimuth), 0.0, -np.sin(azimuth)])
    down = np.array([0.0, -1.0, 0.0])
    level = np.stack([np.cross(down, forward), down, forward])
    pitch, roll = np.radians(pitch_deg), np.radians(roll_deg)
    about_x = np.array(
        [
            [1, 0, 0],
            [0, np.cos(pitch), -np.sin(pitch)],
            [0, np.sin(pitch), np.cos(pitch)],
        ]
    )
    about_z = np.array(
        [[np.cos(roll), -np.sin(roll), 0], [np.sin(roll), np.cos(roll), 0], [0, 0, 1]]
    )
    rotation = about_z @ about_x @ level
    matrix = np.array(
        [
            [focal_px, 0.0, (size_px[0] - 1) / 2],
            [0.0, focal_px, (size_px[1] - 1) / 2],
            [0.0, 0.0, 1.0],
        ]
    )
    return Camera("placed", size_px, matrix, rotation, -rotation @ centre)


def see(
    points: Array,
    camera: Camera,
    time_s: Array,
    *,
    confidence: float = 0.99,
    noise_px: float = 0.0,
    seed: int = 0,
) -> ViewPose:
    """Return what a perfect estimator sees of world points (T, 33, 3).

    Its body landmarks are exact too, in the axes of a crop around the person, as networks give
    them.
    """
    seen = points @ camera.rotation.T + camera.translation
    image = seen @ camera.matrix.T
    image = image[..., :2] / image[..., 2:]
    image = image + noise_px * np.random.default_rng(seed).standard_normal(image.shape)
    hips = [NAMES.index("left_hip"), NAMES.index("right_hip")]
    pelvis = seen[:, hips].mean(axis=1)
    body = np.einsum("tji,tkj->tki", _crop_axes(pelvis), seen - pelvis[:, None])
    return make_view(image, body, time_s, camera.size_px, confidence=confidence)


def _crop_axes(pelvis: Array) -> Array:
    """Return the axes (columns) of a camera turned towards `pelvis` (T, 3), shape (T, 3, 3)."""
    forward = pelvis / np.linalg.norm(pelvis, axis=1, keepdims=True)
    right = np.stack([forward[:, 2], np.zeros(len(forward)), -forward[:, 0]], axis=1)
    right /= np.linalg.norm(right, axis=1, keepdims=True)
    return np.stack([right, np.cross(forward, right), forward], axis=2)


def make_view(
    image: Array,
    body: Array | None,
    time_s: Array,
    size_px: tuple[int, int],
    *,
    confidence: float | Array = 0.99,
) -> ViewPose:
    """Wrap keypoints (T, 33, 2) px and (T, 33, 3) m as an estimator returns them."""
    certain = np.broadcast_to(confidence, image.shape[:2])
    known = np.isfinite(image).all(axis=(1, 2))
    box = np.full((len(image), 4), np.nan)
    box[known] = np.concatenate([image[known].min(axis=1), image[known].max(axis=1)], axis=1)
    body_track = None
    if body is not None:
        body_track = PoseTrack(time_s, body, "m", "body", "mediapipe_33", confidence=certain)
    step_s = float(np.median(np.diff(time_s))) if len(time_s) > 1 else 1 / 30
    return ViewPose(
        image=PoseTrack(time_s, image, "px", "image", "mediapipe_33", confidence=certain),
        body=body_track,
        box=box,
        state=tuple(SubjectState.TRACKED if k else SubjectState.LOST for k in known),
        info=ViewInfo(
            file_name="exact.mp4",
            sha256="0" * 64,
            fps=1 / step_s,
            n_frames=len(time_s),
            size_px=size_px,
            duration_s=len(time_s) * step_s,
        ),
    )
