"""How far posture scores from one camera are from those of the true posture, and how sure.

Run from the project folder::

    nice -n 10 .venv/bin/python benchmarks/posture_scores.py --persons P07 P08

REBA, RULA, OWAS and the posture zones judge every picture of the synthetic lifts, once from the
video and once from the true joints, knowing the same load and work. Told are the agreement of the
scores picture by picture and of the headline, whether the stated interval holds the true headline,
and the time of all four methods. Keypoints come from the cache of ``monocular_lifts.py``; they are
estimated where it has none. Nothing in the product was chosen on the persons P07 and P08.
"""

from __future__ import annotations

import argparse
import json
import platform
import time
from pathlib import Path

import numpy as np
import pandas as pd
from monocular_lifts import LOAD_KG, TEST_PERSONS, find_videos, load_pose
from threadpoolctl import threadpool_limits

from engine import Config, Subject, Task, Trial, View
from engine.config import RiskConfig
from engine.datatypes import Lift, PoseTrack, RiskResult
from engine.ergonomics.assess import assess_risk
from engine.ergonomics.base import Exposure
from engine.ergonomics.posture_scores import decode_runs
from engine.kinematics.fitting.base import select_solver
from engine.pipeline import assess_pose
from engine.skeletons import MEDIAPIPE_33

METHODS = ("reba", "rula", "owas", "posture_zones")
CONFIG = Config(risk=RiskConfig(methods=METHODS))
TASK = Task(load_kg=LOAD_KG, coupling="good", frequency_per_min=0.2, duration_h=1.0)
OTHER_NAMES = {"bigtoe": "big_toe"}
SIDES = {"L": "left_", "R": "right_", "": ""}
OUT = Path(__file__).parent / "results" / "posture_scores"


def read_true_track(folder: Path) -> PoseTrack:
    """Read the true joints at the times of the pictures, without error."""
    with np.load(folder / "truth.npz", allow_pickle=False) as data:
        time_s, joints = data["time"].astype(float), data["joints"].astype(float)
        wanted, names = data["video_time"].astype(float), list(map(str, data["joint_names"]))
    position = np.full((wanted.size, len(MEDIAPIPE_33.keypoints), 3), np.nan)
    for k, name in enumerate(names):
        part, _, side = name.partition("_")
        keypoint = SIDES[side] + OTHER_NAMES.get(part, part)
        if keypoint in MEDIAPIPE_33.keypoints:
            curves = [np.interp(wanted, time_s, axis) for axis in joints[:, k].T]
            position[:, MEDIAPIPE_33.index(keypoint)] = np.stack(curves, axis=1)
    sigma = np.zeros(position.shape[:2])
    return PoseTrack(wanted, position, "m", "world", "mediapipe_33", sigma=sigma)


def judge_truth(folder: Path, subject: Subject, lifts: tuple[Lift, ...]) -> dict[str, RiskResult]:
    """Judge the true posture, with the lift-off and set-down that were measured.

    So only the posture differs; errors of the lift's times are in ``monocular_lifts.py``.
    """
    track = read_true_track(folder)
    angles = select_solver("geometric").fit(track, subject).angles
    exposure = Exposure(track, angles, lifts, subject, TASK, float(np.ptp(track.time_s)))
    return assess_risk(exposure, methods=METHODS)


def measure(video: Path, poses: Path) -> list[dict[str, float | str | bool]]:
    """Assess one video and compare every method with itself on the truth; one row a method."""
    person = json.loads((video.parent.parent / "subject.json").read_text())
    subject = Subject(stature_m=person["height_m"])
    trial = Trial(views=(View(video),), subject=subject, task=TASK)
    result = assess_pose(trial, load_pose(video, poses, CONFIG), CONFIG)
    true = judge_truth(video.parent, subject, result.lifts)
    observed_s = float(np.ptp(result.corrected.time_s))
    exposure = Exposure(result.corrected, result.angles, result.lifts, subject, TASK, observed_s)
    cpu_s = []
    with threadpool_limits(limits=1, user_api="blas"):
        for _ in range(2):
            start = time.process_time()
            assess_risk(exposure, methods=METHODS)
            cpu_s.append(time.process_time() - start)
    where = {
        "trial": video.parent.name,
        "camera": video.stem,
        "persons": "test" if video.parent.name[:3] in TEST_PERSONS else "training",
        "seconds": observed_s,
        "cpu_s": min(cpu_s),
    }
    return [{**where, **compare(result.risk[name], true[name])} for name in METHODS]


def compare(mine: RiskResult, true: RiskResult) -> dict[str, float | str | bool]:
    """Return the agreement of one method's scores."""
    row: dict[str, float | str | bool] = {"method": mine.method, "applicable": mine.is_applicable}
    if not mine.is_applicable:
        return row
    series = [decode_runs(x.details["series"]["score"]) for x in (mine, true)]
    both = (series[0] > 0) & (series[1] > 0)
    error = (series[0] - series[1])[both]
    low, high = mine.interval
    off = mine.value - true.value
    return {
        **row,
        "scored": float(both.mean()),
        "exact": float(np.mean(error == 0)),
        "within_one": float(np.mean(np.abs(error) <= 1)),
        "mean_error": float(error.mean()),
        "headline": mine.value,
        "true_headline": true.value,
        "headline_exact": off == 0,
        "headline_within_one": abs(off) <= 1,
        "in_interval": low <= true.value <= high,
        "interval_width": high - low,
        "same_level": mine.category == true.category,
    }


def summarise(rows: pd.DataFrame) -> str:
    """Return the tables."""
    rows["method"] = pd.Categorical(rows["method"], METHODS)
    groups = rows.groupby(["persons", "camera", "method"], observed=True)
    frames = groups[["scored", "exact", "within_one", "mean_error"]].mean().round(3)
    names = ["headline_exact", "headline_within_one", "same_level", "in_interval"]
    headline = groups[names].agg(lambda v: v.astype(float).mean()).round(3)
    headline["interval_width"] = groups["interval_width"].mean().round(2)
    headline.insert(0, "videos", groups.size())
    refused = int((~rows["applicable"]).sum())
    speed = rows.drop_duplicates(["trial", "camera"])
    per_10_s = 10 * speed["cpu_s"] / speed["seconds"]
    speed_text = (
        "\nProcessor time of all four methods for 10 s of video: median "
        f"{per_10_s.median():.3f} s, largest {per_10_s.max():.3f} s"
    )
    parts = (
        f"Scores picture by picture (share of pictures; {refused} not applicable)",
        frames.to_string(),
        "\nHeadline: the highest score held for 0.2 s (share of videos)",
        headline.to_string(),
        speed_text,
    )
    return "\n".join(parts)


def main() -> None:
    """Run the comparison, print and keep the tables."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--data", type=Path, default=Path("../shared/data/synthetic_lifts"))
    parser.add_argument("--cache", type=Path, default=Path(".benchmark_cache/monocular_lifts"))
    parser.add_argument("--persons", nargs="*", help="for example P01 P07; all if left out")
    options = parser.parse_args()
    persons = options.persons or sorted(p.name for p in options.data.glob("P*"))
    rows: list[dict[str, float | str | bool]] = []
    for video in find_videos(options.data, persons):
        rows += measure(video, options.cache)
        print(f"{video.parent.name} {video.stem}", flush=True)
    table = pd.DataFrame(rows)
    head = (
        "Posture scores of synthetic lifts, one camera, against the same methods on the true "
        f"joints.\nCommand: python benchmarks/posture_scores.py --persons {' '.join(persons)}\n"
        f"Seed: none is used (fixed sequences). Solver {CONFIG.kinematics.solver}. "
        f"{platform.machine()}, Python {platform.python_version()}"
    )
    text = f"{head}\n\n{summarise(table)}\n"
    OUT.parent.mkdir(exist_ok=True)
    OUT.with_suffix(".txt").write_text(text, encoding="utf-8")
    table.to_csv(OUT.with_suffix(".csv"), index=False, float_format="%.3f")
    print(text)


if __name__ == "__main__":
    main()
