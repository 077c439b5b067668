"""How well one camera measures lifts, on the synthetic lifting trials with exact truth.

Run from the project folder::

    .venv/bin/python benchmarks/monocular_lifts.py --data ../shared/data/synthetic_lifts

Every video is assessed as a user would have it assessed, knowing only the stature. Keypoints are
kept in a cache folder, so that an interrupted run goes on where it stopped; give ``--fresh`` to
start over. Nothing in the product was chosen on the persons P07 and P08.
"""

from __future__ import annotations

import argparse
import json
import platform
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pandas as pd

from engine import Config, Subject, Task, Trial, TrialResult, View
from engine.config import PoseConfig
from engine.datatypes import Lift, PoseTrack, SubjectState, ViewInfo, ViewPose, ignore_progress
from engine.ergonomics.lifting_equation import compute_rwl
from engine.pipeline import assess_pose, estimate_view

TEST_PERSONS = ("P07", "P08")
ANGLES = ("trunk_inclination", "hip_flexion", "knee_flexion", "elbow_flexion")
LOAD_KG = 10.0


@dataclass(frozen=True)
class Truth:
    """What really happened in one trial."""

    stature_m: float
    lift_s: tuple[float, float]
    H_cm: tuple[float, float]
    V_cm: tuple[float, float]
    time_s: np.ndarray
    angles: dict[str, np.ndarray]
    motion_s: tuple[float, float]

    @property
    def travel_cm(self) -> float:
        """Vertical travel."""
        return abs(self.V_cm[1] - self.V_cm[0])

    def rwl_kg(self, end: int) -> float:
        """Recommended weight limit at one end, for a rare lift with a good grip."""
        return compute_rwl(
            H=self.H_cm[end],
            V=self.V_cm[end],
            D=self.travel_cm,
            A=0.0,
            frequency_per_min=0.2,
            duration="short",
            coupling="good",
            V_origin=self.V_cm[0],
        ).RWL


def read_truth(folder: Path) -> Truth:
    """Read one trial's truth; H and V are those of the third knuckles' markers."""
    with np.load(folder / "truth.npz", allow_pickle=False) as data:
        arrays = {key: data[key] for key in data.files}
    events = json.loads((folder / "trial.json").read_text())["events_s"]
    person = json.loads((folder.parent / "subject.json").read_text())
    time_s = arrays["time"]
    marker, joint = list(arrays["marker_names"]), list(arrays["joint_names"])
    hands = np.mean([arrays["markers"][:, marker.index(n)] for n in ("RFIN", "LFIN")], axis=0)
    feet = np.mean([arrays["joints"][:, joint.index(n)] for n in ("ankle_R", "ankle_L")], axis=0)
    at = [int(np.argmin(np.abs(time_s - events[e]))) for e in ("lift_start", "place")]
    offset = hands - feet
    name = list(arrays["angle_names"])
    values = {n: arrays["angles"][:, name.index(n)] for n in name}
    angles = {"trunk_inclination": values["trunk_inclination"]}
    for side in ("l", "r"):
        # The product's hip angle is against the trunk, so it holds the lumbar bend as well.
        bend = values["lumbar_extension"]
        angles[f"hip_flexion_{side}"] = values[f"hip_flexion_{side}"] - bend
        for part in ("knee", "elbow"):
            angles[f"{part}_flexion_{side}"] = values[f"{part}_flexion_{side}"]
    return Truth(
        stature_m=person["height_m"],
        lift_s=(events["lift_start"], events["place"]),
        H_cm=tuple(float(100 * np.hypot(*offset[i, [0, 2]])) for i in at),
        V_cm=tuple(float(100 * hands[i, 1]) for i in at),
        time_s=time_s,
        angles=angles,
        motion_s=(events["reach_start"], events["stand"]),
    )


def load_pose(video: Path, cache: Path, config: Config) -> ViewPose:
    """Return the keypoints of a video, from the cache if they are there."""
    file = cache / f"{video.parent.name}_{video.stem}.npz"
    if not file.exists():
        pose = estimate_view(View(video), config, ignore_progress)
        cache.mkdir(parents=True, exist_ok=True)
        part = file.with_suffix(".part.npz")
        np.savez(
            part,
            time_s=pose.image.time_s,
            image=pose.image.position,
            body=pose.body.position,
            confidence=pose.image.confidence,
            box=pose.box,
            state=np.array([s.value for s in pose.state]),
            size_px=pose.info.size_px,
        )
        part.rename(file)
    with np.load(file, allow_pickle=False) as data:
        return _pose_from(video, data)


def _pose_from(video: Path, data: np.lib.npyio.NpzFile) -> ViewPose:
    time_s, confidence = data["time_s"], data["confidence"]
    duration = float(time_s[-1] - time_s[0])
    rate = (len(time_s) - 1) / duration
    size = tuple(int(n) for n in data["size_px"])
    info = ViewInfo(video.name, "", rate, len(time_s), size, duration)
    image = PoseTrack(time_s, data["image"], "px", "image", "mediapipe_33", confidence)
    body = PoseTrack(time_s, data["body"], "m", "body", "mediapipe_33", confidence)
    return ViewPose(image, body, data["box"], tuple(map(SubjectState, data["state"])), info)


def find_videos(data: Path, persons: Iterable[str]) -> Iterator[Path]:
    """List the videos, both cameras of every trial."""
    for person in persons:
        yield from sorted((data / person).glob(f"{person}_*/cam*.mp4"))


def measure(video: Path, cache: Path, config: Config) -> dict[str, float | str]:
    """Assess one video and compare it with the truth."""
    truth = read_truth(video.parent)
    trial = Trial(
        views=(View(video),),
        subject=Subject(stature_m=truth.stature_m),
        task=Task(
            load_kg=LOAD_KG,
            coupling="good",
            frequency_per_min=0.2,
            duration_h=1.0,
            destination_control=True,
        ),
    )
    result = assess_pose(trial, load_pose(video, cache, config), config)
    row: dict[str, float | str] = {
        "trial": video.parent.name,
        "camera": video.stem,
        "persons": "test" if video.parent.name[:3] in TEST_PERSONS else "training",
        "lifts": len(result.lifts),
        "coverage": result.coverage["measured"],
        **compare_angles(result, truth),
    }
    if result.lifts:
        nearest = min(range(len(result.lifts)), key=lambda i: _off(result.lifts[i], truth))
        limit = result.risk["rnle"].per_lift[nearest]
        row |= compare_lift(result.lifts[nearest], truth)
        row["rnle refused"] = not limit.is_applicable
        if limit.is_applicable:
            row |= compare_rwl(limit.details, truth)
    return row


def _off(lift: Lift, truth: Truth) -> float:
    return abs(lift.start_s - truth.lift_s[0]) + abs(lift.end_s - truth.lift_s[1])


def compare_lift(lift: Lift, truth: Truth) -> dict[str, float]:
    """Return signed errors of times and places, and errors in units of their standard error."""
    row = {"start_s": lift.start_s - truth.lift_s[0], "end_s": lift.end_s - truth.lift_s[1]}
    for i, (name, end) in enumerate((("origin", lift.origin), ("set-down", lift.destination))):
        for key, value, true in (
            ("H", end.H_cm, truth.H_cm[i]),
            ("V", end.V_cm, truth.V_cm[i]),
            ("A", end.A_deg, 0.0),
        ):
            row[f"{key} {name}"] = value.value - true
            row[f"z {key} {name}"] = (value.value - true) / value.sigma
    row["D"] = lift.D_cm.value - truth.travel_cm
    return row


def compare_rwl(details: dict, truth: Truth) -> dict[str, float]:
    """Return signed errors of the recommended weight limit, kg."""
    ends = [details[end]["RWL_kg"] for end in ("origin", "destination")]
    return {
        "RWL origin": ends[0] - truth.rwl_kg(0),
        "RWL set-down": ends[1] - truth.rwl_kg(1),
        "RWL smaller": min(ends) - min(truth.rwl_kg(0), truth.rwl_kg(1)),
    }


def compare_angles(result: TrialResult, truth: Truth) -> dict[str, float]:
    """Return mean absolute errors while the person moves, degrees, and the share measured."""
    time_s = result.angles.time_s
    part = (time_s >= truth.motion_s[0]) & (time_s <= truth.motion_s[1])
    errors: dict[str, list[np.ndarray]] = {name: [] for name in ANGLES}
    inside = []
    for name, curve in truth.angles.items():
        true = np.interp(time_s[part], truth.time_s, curve)
        difference = result.angles[name][part] - true
        errors[name.removesuffix("_l").removesuffix("_r")].append(difference)
        inside.append(np.abs(difference) <= 1.96 * result.angles.sigma(name)[part])
    row = {}
    for name, parts in errors.items():
        values = np.concatenate(parts)
        known = np.isfinite(values)
        row[f"{name} deg"] = float(np.abs(values[known]).mean()) if known.any() else np.nan
        row[f"{name} share"] = float(known.mean())
    known = np.isfinite(np.concatenate([e for parts in errors.values() for e in parts]))
    row["angles in 95 %"] = float(np.concatenate(inside)[known].mean())
    return row


LIFT_COLUMNS = ("start_s", "end_s", "H origin", "H set-down", "V origin", "V set-down", "D")
RWL_COLUMNS = ("RWL origin", "RWL set-down", "RWL smaller")


def summarise(rows: pd.DataFrame) -> str:
    """Return the tables, per camera and group of persons."""
    groups = rows.groupby(["persons", "camera"])
    columns = [*LIFT_COLUMNS, "A origin", "A set-down", *RWL_COLUMNS]
    absolute = groups[columns].agg(lambda v: v.abs().mean()).round(2)
    signed = groups[columns].mean().round(2)
    angles = groups[[f"{n} {k}" for n in ANGLES for k in ("deg", "share")]].mean().round(2)
    z_columns = [c for c in rows if c.startswith("z ")]
    inside = groups[z_columns].agg(lambda v: (v.abs() <= 1.96).mean()).round(2)
    counts = groups.agg(
        videos=("lifts", "size"),
        one_lift=("lifts", lambda v: int((v == 1).sum())),
        rnle_refused=("rnle refused", "sum"),
        coverage=("coverage", "mean"),
    ).round(3)
    whole = rows[list(columns)].abs().mean().round(2).to_frame("all videos").T
    parts = (
        (
            (
                "Videos, those with exactly one lift found (there is one in each), those of which "
                "the lifting equation refuses that lift, share measured"
            ),
            counts,
        ),
        ("Mean absolute error (s, cm, degrees, kg)", absolute),
        ("The same over all videos", whole),
        ("Mean signed error", signed),
        ("Share of values within 1.96 stated standard errors", inside),
        ("Joint angles while moving: mean absolute error and share of frames measured", angles),
        (
            "Share of angle samples within 1.96 stated standard errors",
            groups[["angles in 95 %"]].mean().round(2),
        ),
        ("Ten largest errors of time or place", worst(rows)),
    )
    return "\n\n".join(f"{title}\n{table.to_string()}" for title, table in parts)


def worst(rows: pd.DataFrame) -> pd.DataFrame:
    """Return the rows with the largest errors, relative to what was aimed at."""
    aims = {"start_s": 0.12, "end_s": 0.12, "H origin": 7, "H set-down": 7}
    aims |= {"V origin": 6, "V set-down": 6}
    score = pd.concat([rows[c].abs() / aim for c, aim in aims.items()], axis=1).max(axis=1)
    chosen = score.fillna(np.inf).sort_values(ascending=False).index[:10]
    return rows.loc[chosen, ["trial", "camera", "lifts", *LIFT_COLUMNS]].round(2)


def main() -> None:
    """Run the comparison and print the tables."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--data", type=Path, default=Path("../shared/data/synthetic_lifts"))
    parser.add_argument("--cache", type=Path, default=Path(".benchmark_cache/monocular_lifts"))
    parser.add_argument("--persons", nargs="*", help="for example P01 P07; all if left out")
    parser.add_argument("--rows", type=Path, help="write one line per video to this CSV file")
    parser.add_argument("--threads", type=int, default=0, help="of inference; 0: all cores")
    parser.add_argument("--fresh", action="store_true", help="forget cached keypoints")
    options = parser.parse_args()
    if options.fresh:
        for file in options.cache.glob("*.npz"):
            file.unlink()
    config = Config(pose=PoseConfig(threads=options.threads))
    persons = options.persons or sorted(p.name for p in options.data.glob("P*"))
    rows = []
    for video in find_videos(options.data, persons):
        rows.append(measure(video, options.cache, config))
        print(f"{rows[-1]['trial']} {rows[-1]['camera']}: {rows[-1]['lifts']} lift(s)", flush=True)
    table = pd.DataFrame(rows)
    if options.rows:
        table.to_csv(options.rows, index=False, float_format="%.3f")
    print(
        f"\nSynthetic lifts, one camera. {platform.machine()}, Python {platform.python_version()}"
    )
    print(summarise(table))


if __name__ == "__main__":
    main()
