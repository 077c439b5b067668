"""Results as a real assessment leaves them, for the pages to show."""

from __future__ import annotations

import math
from pathlib import Path

import av
import numpy as np

from engine.datatypes import FlagLevel, JointAngles, Status, Task, TrialResult
from engine.ergonomics.base import Exposure
from engine.ergonomics.methods.rnle import METHOD
from engine.storage.library import Library
from engine.storage.results import write_result
from tests.builders import (
    make_angles,
    make_end,
    make_flag,
    make_lift,
    make_pose_track,
    make_times,
    make_trial,
    make_trial_result,
)

APP = Path(__file__).parents[2] / "dashboard" / "app.py"


def make_shown_result(
    *, label: str = "Crate to shelf", load_kg: float | None = 12.0
) -> TrialResult:
    """Make a result with two lifts, a gap, filled samples and the true lifting equation."""
    trial = make_trial(label=label, task=Task(load_kg=load_kg, frequency_per_min=2, duration_h=2))
    lifts = (
        make_lift(1.0, 2.2, peak_hand_speed_m_s=0.7),
        make_lift(4.0, 5.1, origin=make_end(4.0, H_cm=58.0, V_cm=22.0, A_deg=32.0)),
    )
    angles = _make_angles()
    exposure = Exposure(
        make_pose_track(n_frames=180), angles, lifts, trial.subject, trial.task, observed_s=6.0
    )
    return make_trial_result(
        n_frames=180,
        trial=trial,
        lifts=lifts,
        angles=angles,
        risk={"rnle": METHOD.assess(exposure)},
        flags=(
            make_flag(
                FlagLevel.REVIEW,
                what="The grip was assumed",
                why="No grip was entered, so a fair one was assumed.",
                change="",
                start_s=math.nan,
                end_s=math.nan,
                lift_index=None,
            ),
            make_flag(
                FlagLevel.HIGH,
                what="Lift 2 is far above the recommended limit",
                why="Lifting index 3.1: the load is 58 cm in front of the ankles at the start.",
                change="Bring the load 20 cm closer: the index falls to 2.0.",
                start_s=4.0,
                end_s=5.1,
                lift_index=1,
            ),
            make_flag(
                FlagLevel.OK,
                what="Trunk posture",
                why="The forward bend stays below 60° for 90 % of the time.",
                change="",
            ),
        ),
    )


def _make_angles() -> JointAngles:
    time_s = make_times(180)
    made = make_angles(time_s=time_s)
    bend = 0.5 - 0.5 * np.cos(2 * np.pi * (time_s - 0.2) / 3.0)
    size = np.linspace(75, 12, len(made.names))
    value = bend[:, None] * size + np.sin(time_s)[:, None] * 3
    status = np.full(value.shape, Status.SMOOTHED, dtype=np.uint8)
    value[70:88], status[70:88] = np.nan, Status.MISSING
    status[120:128] = Status.FILLED
    sigma = np.where(np.isfinite(value), 3.0 + 3.0 * bend[:, None], np.nan)
    return JointAngles(time_s, value, made.names, sigma, status)


def write_clip(path: Path, *, seconds: float = 1.0) -> Path:
    """Write a small video that browsers play."""
    with av.open(str(path), "w", options={"movflags": "+faststart"}) as container:
        stream = container.add_stream("libx264", rate=15)
        stream.width, stream.height, stream.pix_fmt = 320, 180, "yuv420p"
        for number in range(round(15 * seconds)):
            image = np.full((180, 320, 3), 60 + number % 60, dtype=np.uint8)
            container.mux(stream.encode(av.VideoFrame.from_ndarray(image, format="rgb24")))
        container.mux(stream.encode())
    return path


def add_trial(library: Library, scratch: Path, **changes: object) -> str:
    """Put a trial with its video and still picture into a library."""
    trial_id = library.new_id()
    overlay = write_clip(scratch / f"{trial_id}.mp4")
    write_result(make_shown_result(**changes), library.folder(trial_id), overlay=overlay)  # type: ignore[arg-type]
    return trial_id
