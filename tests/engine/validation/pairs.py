"""Results whose distance from a reference is known: made from the bundled markers."""

from __future__ import annotations

from functools import lru_cache
from pathlib import Path

import numpy as np

from engine.datatypes import JointAngles, PoseTrack, Subject
from engine.kinematics.fitting.geometric import SOLVER
from engine.storage.results import write_result
from engine.validation.joint_centres import build_pose_track
from engine.validation.reference.files import read_reference
from engine.validation.resampling import resample_positions
from tests.builders import make_trial, make_trial_result

SAMPLES = Path(__file__).parents[3] / "sample_data"
MARKERS = SAMPLES / "floor_to_knuckle" / "markers.trc"
OTHER_MARKERS = SAMPLES / "floor_to_shoulder" / "markers.trc"

LAG_S = 0.25
KNEE_BIAS_DEG = 6.0
RATE_HZ = 30.0


@lru_cache(maxsize=4)
def true_track(markers: Path = MARKERS) -> PoseTrack:
    """Return the joint centres of bundled markers, 100 Hz."""
    return build_pose_track(read_reference(markers), skeleton="mediapipe_33")


def video_track(
    *, markers: Path = MARKERS, lag_s: float = LAG_S, scale: float = 1.0, noise_m: float = 0.0
) -> PoseTrack:
    """Return what a perfect video would show at 30 Hz, shifted in time, moved and scaled."""
    truth = true_track(markers)
    wanted = np.arange(0.2, truth.time_s[-1] - 0.2, 1.0 / RATE_HZ)
    seen = resample_positions(truth, wanted)
    turn = np.radians(20.0)
    rotation = np.array(
        [[np.cos(turn), 0.0, np.sin(turn)], [0.0, 1.0, 0.0], [-np.sin(turn), 0.0, np.cos(turn)]]
    )
    noise = np.random.default_rng(0).normal(0.0, noise_m, seen.position.shape)
    return PoseTrack(
        time_s=wanted + lag_s,
        position=scale * seen.position @ rotation.T + np.array([0.4, 0.0, -0.2]) + noise,
        unit="m",
        frame_of_reference="world",
        skeleton="mediapipe_33",
    )


def with_bias(angles: JointAngles, name: str = "knee_flexion_r") -> JointAngles:
    """Return angles of which one is too high by a constant."""
    value = np.array(angles.value_deg)
    value[:, angles.names.index(name)] += KNEE_BIAS_DEG
    return JointAngles(angles.time_s, value, angles.names, np.full(value.shape, 3.0))


def store_lift(
    folder: Path,
    *,
    subject: str = "P01",
    label: str = "Crate to shelf",
    job: str = "Packing",
    markers: Path = MARKERS,
    lag_s: float = LAG_S,
    scale: float = 1.0,
) -> Path:
    """Write the result of a lift that is 6 degrees off at one knee and late by `lag_s`."""
    track = video_track(markers=markers, lag_s=lag_s, scale=scale)
    person = Subject(label=subject, stature_m=1.725)
    angles = with_bias(SOLVER.fit(track, person).angles)
    result = make_trial_result(
        n_frames=track.n_frames,
        trial=make_trial(subject=person, label=label, job=job),
        raw=track,
        corrected=track,
        angles=angles,
        solver="geometric",
    )
    return write_result(result, folder)
