"""How long two views take after the landmarks, as a share of the landmarks of one view.

Run from the project folder::

    python benchmarks/two_view_speed.py

The same clip is used for all: the bundled two-camera sample. Landmarks are timed on its pictures by
the shipped network in the same run, so that the ratio holds on any machine. Everything after them
is the time on the clock of one thread; the best of several rounds counts.
"""

from __future__ import annotations

import argparse
import platform
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
from threadpoolctl import threadpool_limits

from engine import Config, Subject, Trial, View
from engine.cameras.self_calibration import calibrate_from_person
from engine.cameras.two_view import reconstruct_two_views
from engine.cameras.verdict import check_calibration
from engine.config import TwoViewConfig
from engine.kinematics.fusion import fuse_views
from engine.pipeline import assess_poses, estimate_view
from engine.two_view import synchronise
from engine.video.sync import refine_offset, resample_views

SAMPLE = Path(__file__).parents[1] / "sample_data" / "floor_to_shoulder"
STATURE_M = 1.738
LIMIT = 0.5
CALIBRATION_LIMIT_S = 5.0


def time_best(work: Callable[[], object], rounds: int) -> float:
    """Return the shortest time of some rounds, s."""
    best = np.inf
    for _ in range(rounds):
        start = time.perf_counter()
        work()
        best = min(best, time.perf_counter() - start)
    return float(best)


def report(name: str, seconds: float, one_view_s: float) -> str:
    """Return a line: what, how long, and as a share of the landmarks of one view."""
    return f"{name:32s} {seconds:7.2f} s  {seconds / one_view_s:5.2f}"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--out", type=Path, default=Path("benchmarks/results/two_view_speed.txt"))
    options = parser.parse_args()
    views = tuple(View(SAMPLE / f"{name}.mp4") for name in ("cam90", "cam135"))
    poses = [estimate_view(view, Config(), lambda *_: None) for view in views]
    landmarks_s = [pose.model_time_s for pose in poses]
    subject = Subject(stature_m=STATURE_M)
    settings = TwoViewConfig()
    trial = Trial(views=views, subject=subject)
    with threadpool_limits(limits=1, user_api="blas"):
        sync = synchronise(views, poses, settings)
        seen = resample_views(poses, sync).views
        calibration = calibrate_from_person(seen, subject.stature)
        track, _, placed = reconstruct_two_views(seen, calibration, subject.stature)
        parts = {
            "synchronisation": lambda: synchronise(views, poses, settings),
            "self-calibration": lambda: calibrate_from_person(seen, subject.stature),
            "sharper synchronisation": lambda: refine_offset(*poses, calibration.cameras, sync),
            "checks of the cameras": lambda: check_calibration(seen, calibration, subject.stature),
            "triangulation": lambda: reconstruct_two_views(seen, calibration, subject.stature),
            "fit to both pictures": lambda: fuse_views(seen, placed.cameras, track, subject),
        }
        spent = {name: time_best(work, options.rounds) for name, work in parts.items()}
    whole_s = time_best(lambda: assess_poses(trial, poses, Config()), options.rounds)
    one_view_s = float(np.mean(landmarks_s))
    frames = poses[0].image.n_frames
    lines = [
        "Two views after the landmarks. Command: python benchmarks/two_view_speed.py",
        f"{platform.machine()}, Python {platform.python_version()}; nothing in it is random.",
        f"Clip of {frames} pictures a view; best of {options.rounds} rounds.",
        "",
        f"{'landmarks of one view':32s} {one_view_s:7.2f} s",
        *(report(name, seconds, one_view_s) for name, seconds in spent.items()),
        report("these together", sum(spent.values()), one_view_s) + f" (limit {LIMIT})",
        report("whole assessment after landmarks", whole_s, one_view_s),
        f"self-calibration: limit {CALIBRATION_LIMIT_S:g} s for a clip of 10 s; it takes a fixed",
        "number of pictures, so that longer clips take hardly longer.",
    ]
    text = "\n".join(lines) + "\n"
    print(text)
    options.out.write_text(text)


if __name__ == "__main__":
    main()
