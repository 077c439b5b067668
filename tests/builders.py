"""Small, plausible engine objects in one line, for every test.

A figure of 1.75 m faces +X, bends, takes a load at shin height, stands up with it and sets
it down at waist height: one smooth movement whose truth is known.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from engine.config import Config
from engine.datatypes import (
    Array,
    BodyFit,
    Calibration,
    CalibrationCheck,
    Camera,
    CheckLevel,
    Flag,
    FlagLevel,
    JointAngles,
    Lift,
    LiftEnd,
    Measurement,
    PersonBox,
    PoseTrack,
    Provenance,
    RiskInput,
    RiskResult,
    Status,
    Subject,
    SubjectState,
    SyncEstimate,
    Task,
    Trial,
    TrialResult,
    View,
    ViewInfo,
    ViewPose,
    WorldScene,
)
from engine.skeletons import get_skeleton

ANGLE_NAMES: tuple[str, ...] = (
    "trunk_inclination",
    "trunk_flexion",
    "trunk_lateral_bend",
    "trunk_twist",
    *(
        f"{name}_{side}"
        for name in ("hip_flexion", "knee_flexion", "shoulder_flexion", "elbow_flexion")
        for side in ("l", "r")
    ),
)

# Upright figure, right side: forward (x), up (y), to the right (z), in metres.
_UPRIGHT: Mapping[str, tuple[float, float, float]] = {
    "ear": (0.00, 1.62, 0.07),
    "eye": (0.08, 1.65, 0.03),
    "eye_inner": (0.09, 1.65, 0.02),
    "eye_outer": (0.07, 1.65, 0.04),
    "mouth": (0.09, 1.57, 0.02),
    "shoulder": (0.00, 1.44, 0.18),
    "elbow": (0.02, 1.12, 0.22),
    "wrist": (0.15, 0.90, 0.20),
    "pinky": (0.22, 0.86, 0.20),
    "index": (0.23, 0.86, 0.18),
    "thumb": (0.20, 0.88, 0.17),
    "hip": (0.00, 0.92, 0.10),
    "knee": (0.02, 0.50, 0.11),
    "ankle": (0.00, 0.09, 0.11),
    "heel": (-0.05, 0.03, 0.11),
    "big_toe": (0.18, 0.03, 0.12),
}
_MIDLINE: Mapping[str, tuple[float, float, float]] = {
    "nose": (0.11, 1.62, 0.0),
    "head": (0.0, 1.75, 0.0),
    "thorax": (0.0, 1.44, 0.0),
    "spine": (0.0, 1.18, 0.0),
    "pelvis": (0.0, 0.92, 0.0),
}
_LOWER = ("hip", "knee", "ankle", "heel", "big_toe", "pelvis")


def _upright(keypoint: str) -> tuple[float, float, float]:
    if keypoint in _MIDLINE:
        return _MIDLINE[keypoint]
    side, name = keypoint.split("_", 1)
    x, y, z = _UPRIGHT[name]
    return x, y, z if side == "right" else -z


def bend_share(time_s: Array) -> Array:
    """Return how far the figure is bent, 1 at the start to 0 at the end; shape (T,)."""
    if time_s.size < 2:
        return np.ones(time_s.size)
    phase = (time_s - time_s[0]) / (time_s[-1] - time_s[0])
    return 0.5 * (1 + np.cos(np.pi * phase))


def make_times(n_frames: int = 30, fps: float = 30.0) -> Array:
    """Return evenly spaced frame times."""
    return np.arange(n_frames) / fps


def make_camera(name: str = "view 1") -> Camera:
    """Make a camera 4 m to the subject's left that looks along +Z (to the right)."""
    return Camera(
        name=name,
        size_px=(1280, 720),
        matrix=np.array([[1150.0, 0.0, 640.0], [0.0, 1150.0, 360.0], [0.0, 0.0, 1.0]]),
        rotation=np.diag([-1.0, -1.0, 1.0]),
        translation=np.array([0.0, 1.0, 4.0]),
    )


def _in_frame(world: Array, frame_of_reference: str, names: Sequence[str]) -> Array:
    """Return world positions (T, K, 3) as seen by `make_camera()`."""
    if frame_of_reference == "world":
        return world
    camera = make_camera()
    seen = world @ camera.rotation.T + camera.translation
    if frame_of_reference == "image":
        projected = seen @ camera.matrix.T
        return projected[..., :2] / projected[..., 2:]
    if frame_of_reference == "body":
        hips = [names.index("left_hip"), names.index("right_hip")]
        return seen - seen[:, hips].mean(axis=1, keepdims=True)
    return seen


def make_pose_track(
    *,
    n_frames: int = 30,
    fps: float = 30.0,
    skeleton: str = "mediapipe_33",
    frame_of_reference: str = "world",
    missing: Sequence[tuple[int, str]] = (),
    noise: float = 0.0,
    seed: int = 0,
    time_s: Array | None = None,
) -> PoseTrack:
    """Make the track of a figure that straightens up from an 80 deg bend of the trunk.

    `frame_of_reference` `world` gives metres with Y up; `camera` and `body` metres in the axes of
    `make_camera()`, `body` around the mid-hip; `image` its pixels. `missing` lists (frame,
    keypoint). `noise` is a standard deviation in the track's unit.
    """
    time_s = make_times(n_frames, fps) if time_s is None else time_s
    names = get_skeleton(skeleton).keypoints
    position = np.array([[_upright(name) for name in names]]).repeat(len(time_s), axis=0)
    angle = np.radians(80.0) * bend_share(time_s)
    hip = np.array(_MIDLINE["pelvis"])
    upper = [i for i, name in enumerate(names) if name.split("_", 1)[-1] not in _LOWER]
    x, y = (position[:, upper] - hip)[..., :2].transpose(2, 0, 1)
    sine, cosine = np.sin(angle)[:, None], np.cos(angle)[:, None]
    position[:, upper, 0] = hip[0] + cosine * x + sine * y
    position[:, upper, 1] = hip[1] - sine * x + cosine * y
    unit, sigma = ("px", 4.0) if frame_of_reference == "image" else ("m", 0.02)
    position = _in_frame(position, frame_of_reference, names)
    rng = np.random.default_rng(seed)
    position = position + noise * rng.standard_normal(position.shape)
    status = np.full(position.shape[:2], Status.MEASURED, dtype=np.uint8)
    for frame, keypoint in missing:
        position[frame, names.index(keypoint)] = np.nan
        status[frame, names.index(keypoint)] = Status.MISSING
    return PoseTrack(
        time_s=time_s,
        position=position,
        unit=unit,
        frame_of_reference=frame_of_reference,
        skeleton=skeleton,
        confidence=np.full(status.shape, 0.9),
        sigma=np.full(status.shape, sigma),
        status=status,
        provenance={"made_by": "tests"},
    )


def make_angles(
    *,
    n_frames: int = 30,
    fps: float = 30.0,
    names: Sequence[str] = ANGLE_NAMES,
    sigma_deg: float = 4.0,
    missing: Sequence[tuple[int, str]] = (),
    time_s: Array | None = None,
) -> JointAngles:
    """Make smooth joint angles: the trunk straightens from 80 deg to 0, the knees from 30 to 0."""
    time_s = make_times(n_frames, fps) if time_s is None else time_s
    bend = bend_share(time_s)
    full = {"trunk_inclination": 80.0, "trunk_flexion": 80.0, "hip_flexion": 70.0}
    columns = [bend * full.get(name.removesuffix("_l").removesuffix("_r"), 30.0) for name in names]
    value = np.stack(columns, axis=1) if names else np.empty((time_s.size, 0))
    for frame, name in missing:
        value[frame, list(names).index(name)] = np.nan
    sigma = np.where(np.isfinite(value), sigma_deg, np.nan)
    return JointAngles(time_s=time_s, value_deg=value, sigma_deg=sigma, names=tuple(names))


def make_body_fit(*, n_frames: int = 30, missing: Sequence[int] = ()) -> BodyFit:
    """Make a fitted body model, 2 cm from its keypoints; `missing` frames are unfitted."""
    residual = np.full(n_frames, 0.02)
    residual[list(missing)] = np.nan
    return BodyFit(make_pose_track(n_frames=n_frames), residual, {"thigh": 0.43, "shank": 0.42})


def make_end(
    time_s: float = 0.2, H_cm: float = 45.0, V_cm: float = 35.0, A_deg: float = 0.0
) -> LiftEnd:
    """Make one end of a lift with usual standard errors."""
    return LiftEnd(
        time_s=time_s,
        H_cm=Measurement(H_cm, 4.0),
        V_cm=Measurement(V_cm, 3.0),
        A_deg=Measurement(A_deg, 8.0),
    )


def make_lift(
    start_s: float = 0.2,
    end_s: float = 0.8,
    *,
    origin: LiftEnd | None = None,
    destination: LiftEnd | None = None,
    **changes: Any,
) -> Lift:
    """Make a lift from 35 cm to 90 cm."""
    origin = origin or make_end(start_s)
    destination = destination or make_end(end_s, H_cm=35.0, V_cm=90.0)
    travel = abs(destination.V_cm.value - origin.V_cm.value)
    values: dict[str, Any] = {
        "D_cm": Measurement(travel, math.hypot(origin.V_cm.sigma, destination.V_cm.sigma)),
        "peak_hand_speed_m_s": 1.1,
        "peak_trunk_velocity_deg_s": 95.0,
        "reach_start_s": start_s - 0.15,
        "return_end_s": end_s + 0.15,
        "start_sigma_s": 0.03,
        "end_sigma_s": 0.03,
    }
    return Lift(start_s, end_s, origin, destination, **{**values, **changes})


def make_risk(
    value: float = 1.4, *, method: str = "rnle", lift_index: int | None = None, **changes: Any
) -> RiskResult:
    """Make what a method says of one lift; not applicable where `value` is NaN."""
    values: dict[str, Any] = {
        "category": "not applicable" if math.isnan(value) else "raised",
        "unit": "",
        "interval": (0.8 * value, 1.3 * value),
        "inputs": (
            RiskInput("load", 12.0, "kg", Provenance.USER),
            RiskInput("H at origin", 45.0, "cm", Provenance.MEASURED, 4.0),
            RiskInput("coupling", "fair", "", Provenance.ASSUMED),
            RiskInput("significant control", value=False, unit="", provenance=Provenance.ASSUMED),
        ),
        "steps": ("RWL = 23 x 0.56 x 0.88 x 0.90 x 1.00 x 1.00 x 0.95 = 8.6 kg", "LI = 12 / 8.6"),
        "reference": "Waters et al. (1993), Ergonomics 36(7)",
        "is_applicable": not math.isnan(value),
        "reasons": ("The grip was assumed to be fair.",),
        "details": {"rwl_origin_kg": 8.6, "rwl_destination_kg": 10.9, "multipliers": [0.56, 0.88]},
    }
    return RiskResult(method, value, lift_index=lift_index, **{**values, **changes})


def make_flag(level: FlagLevel = FlagLevel.HIGH, **changes: Any) -> Flag:
    """Make a flag about the first lift."""
    values: dict[str, Any] = {
        "what": "Lifting index above 1",
        "why": "The load is far from the body at the origin.",
        "method": "rnle",
        "start_s": 0.2,
        "end_s": 0.8,
        "change": "Bring the load 15 cm closer.",
        "lift_index": 0,
    }
    return Flag(level=level, **{**values, **changes})


def make_view_info(**changes: Any) -> ViewInfo:
    """Make the facts about a video file."""
    values: dict[str, Any] = {
        "file_name": "lift.mp4",
        "sha256": "ab" * 32,
        "fps": 30.0,
        "n_frames": 30,
        "size_px": (1280, 720),
        "duration_s": 1.0,
        "codec": "h264",
    }
    return ViewInfo(**{**values, **changes})


def make_view_pose(*, n_frames: int = 30, with_body: bool = True, **info: Any) -> ViewPose:
    """Make what an estimator saw: one bystander in the last frame, the person lost in the first."""
    box = np.tile([500.0, 60.0, 900.0, 710.0], (n_frames, 1))
    state = [SubjectState.TRACKED] * n_frames
    if n_frames > 2:
        box[0], state[0] = np.nan, SubjectState.LOST
    return ViewPose(
        image=make_pose_track(n_frames=n_frames, frame_of_reference="image"),
        body=make_pose_track(n_frames=n_frames, frame_of_reference="body") if with_body else None,
        box=box,
        state=tuple(state),
        info=make_view_info(n_frames=n_frames, duration_s=n_frames / 30.0, **info),
        others=(*[()] * (n_frames - 1), (PersonBox(10.0, 20.0, 90.0, 300.0, 0.7),)),
        model_time_s=1.5,
    )


def make_scene(**changes: Any) -> WorldScene:
    """Make an uncalibrated side view with usual errors."""
    values: dict[str, Any] = {
        "camera": make_camera(),
        "scale_sigma": 0.02,
        "tilt_sigma_deg": 2.0,
        "heading_sigma_deg": 5.0,
        "floor_sigma_m": 0.02,
        "view_azimuth_deg": 90.0,
        "plane_sigma_m": 0.03,
        "depth_sigma_m": 0.08,
        "provenance": {"scale": "stature", "gravity": "upright frames"},
    }
    return WorldScene(**{**values, **changes})


def make_trial(**changes: Any) -> Trial:
    """Make a trial of one view."""
    values: dict[str, Any] = {
        "views": (View(Path("lift.mp4")),),
        "subject": Subject(label="P01", stature_m=1.75, mass_kg=72.0, sex="female"),
        "task": Task(load_kg=12.0, coupling="fair", frequency_per_min=1.0, duration_h=1.0),
        "label": "Crate to shelf",
        "site": "Hall 3",
        "job": "Packing",
    }
    return Trial(**{**values, **changes})


def make_calibration(**changes: Any) -> Calibration:
    """Make two cameras three metres from the person, to the right and to the front right."""
    values: dict[str, Any] = {
        "cameras": (make_camera(), dataclasses.replace(make_camera(), name="front")),
        "source": "person",
        "up": (0.0, 1.0, 0.0),
        "floor_m": 0.0,
        "scale_sigma": 0.012,
        "rotation_sigma_deg": 0.8,
        "tilt_sigma_deg": 0.5,
        "floor_sigma_m": 0.01,
        "provenance": {"reprojection_px": 3.2},
    }
    return Calibration(**{**values, **changes})


def make_two_views(**changes: Any) -> dict[str, Any]:
    """Make what a result of two views has that one of a single view has not."""
    return {
        "views": (make_view_pose(), make_view_pose(file_name="b.mp4", with_body=False)),
        "calibration": make_calibration(),
        "checks": (
            CalibrationCheck("floor", CheckLevel.GREEN, "The feet stand on the floor.", "", 4.0),
            CalibrationCheck("angle", CheckLevel.AMBER, "The cameras look alike.", "Move one."),
        ),
        "sync": SyncEstimate(0.35, 0.004, confidence=0.9, method="motion", sentence="Sure."),
        **changes,
    }


def make_trial_result(
    *, n_frames: int = 30, lis: Sequence[float] = (1.4,), **changes: Any
) -> TrialResult:
    """Make a whole result with one lift per lifting index in `lis` (NaN and infinity allowed)."""
    known = [li for li in lis if not math.isnan(li)]
    worst = max(known, default=math.nan)
    per_lift = tuple(make_risk(li, lift_index=i) for i, li in enumerate(lis))
    values: dict[str, Any] = {
        "trial": make_trial(),
        "views": (make_view_pose(n_frames=n_frames),),
        "raw": make_pose_track(n_frames=n_frames, noise=0.01, missing=[(0, "left_wrist")]),
        "corrected": make_pose_track(n_frames=n_frames, missing=[(0, "left_wrist")]),
        "scene": make_scene(),
        "angles": make_angles(n_frames=n_frames, missing=[(0, "elbow_flexion_l")]),
        "lifts": tuple(make_lift(0.2 + i, 0.8 + i) for i in range(len(lis))),
        "risk": {"rnle": dataclasses.replace(make_risk(worst), per_lift=per_lift)},
        "flags": (make_flag(FlagLevel.HIGH if worst > 1 else FlagLevel.OK),) if known else (),
        "warnings": ("The grip was not given; fair is assumed.",),
        "config": Config().as_dict(),
        "backend": "mediapipe",
        "solver": "geometric",
        "versions": {"liftlens": "0.1.0", "numpy": "2.0.0"},
        "timings_s": {"pose": 2.5, "kinematics": 0.1},
        "coverage": {"measured": 0.95, "repaired": 0.0, "filled": 0.03, "missing": 0.02},
    }
    return TrialResult(**{**values, **changes})
