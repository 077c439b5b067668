"""What swing-twist inverse kinematics and its twist network are worth, and what they cost.

Run from the project folder::

    .venv/bin/python benchmarks/swing_twist.py --part ik
    .venv/bin/python benchmarks/swing_twist.py --part twist
    .venv/bin/python benchmarks/swing_twist.py --part angles --every 11

`ik`: how far joints, seen with noise, and the joints of the posed skeleton are from the truth,
naive against adaptive, and the time a frame takes. `twist`: mean absolute error of the twists,
against none and against the mean of the training examples, on persons in no training set.
`angles`: joint angles of the synthetic lifts from one camera, BlazePose's body track against the
posed skeleton's, from cached keypoints.
"""

from __future__ import annotations

import argparse
import dataclasses
import platform
import time
from pathlib import Path

import numpy as np
import pandas as pd
from monocular_lifts import ANGLES, compare_angles, find_videos, load_pose, read_truth

from engine.cameras.monocular import reconstruct_single_view
from engine.config import Config, PoseConfig
from engine.correction.chain import correct_track
from engine.datatypes import Subject
from engine.kinematics.fitting.base import select_solver
from engine.pose.backends import hybrik
from engine.pose.swing_twist.inverse_kinematics import (
    compute_twists,
    place_joints,
    solve_posture,
)
from engine.pose.swing_twist.posture import pose_landmarks
from engine.pose.swing_twist.skeleton29 import JOINTS, PARENTS, RestSkeleton
from engine.pose.swing_twist.twist import TwistNetwork
from engine.training.twist import disturb, twist_errors
from engine.training.twist_postures import (
    TwistExamples,
    draw_segments,
    joint_rotations,
    make_examples,
    read_lift_segments,
    read_mocap_segments,
    read_seen_examples,
)

TEST_PERSONS = ("P07", "P08")
TRAINING_PERSONS = ("P01", "P02", "P03", "P04")
GROUPS = {
    "thigh": ("left_hip", "right_hip"),
    "upper arm": ("left_shoulder", "right_shoulder"),
    "forearm": ("left_elbow", "right_elbow"),
    "all known": JOINTS[1:24],
}


def table_ik(seed: int) -> str:
    """Compare both ways on drawn postures with noise of several sizes."""
    rng = np.random.default_rng(seed)
    rest = RestSkeleton.from_stature(1.75)
    world = joint_rotations(draw_segments(2000, rng))
    rotation = world.copy()
    rotation[:, 1:] = np.swapaxes(world[:, list(PARENTS[1:24])], 2, 3) @ world[:, 1:]
    true, twist = place_joints(rest, rotation).joints, compute_twists(rest, rotation)
    rows = []
    for sigma_mm in (0, 5, 10, 20, 40):
        seen = true + rng.normal(0, sigma_mm / 1000, true.shape)
        row: dict[str, float] = {"noise mm": sigma_mm, "seen": _mm(seen, true)}
        for ik in ("naive", "adaptive"):
            start = time.perf_counter()
            found = solve_posture(rest, seen, twist, ik=ik)
            row[f"{ik} ms"] = 1000 * (time.perf_counter() - start) / len(seen)
            row[ik] = _mm(found.joints, true)
            off = np.swapaxes(found.rotation, 2, 3) @ rotation
            trace = np.clip((np.trace(off, axis1=2, axis2=3) - 1) / 2, -1, 1)
            row[f"{ik} deg"] = float(np.degrees(np.arccos(trace)).mean())
        rows.append(row)
    body = np.random.default_rng(seed).normal(0, 0.3, (1000, 33, 3))
    start = time.perf_counter()
    pose_landmarks(body)
    whole = 1000 * (time.perf_counter() - start) / len(body)
    note = f"\nLandmarks to posed skeleton and back, ms a frame: {whole:.2f}"
    return pd.DataFrame(rows).round(2).to_string(index=False) + note


def _mm(joints: np.ndarray, true: np.ndarray) -> float:
    return float(1000 * np.linalg.norm(joints - true, axis=2).mean())


def table_twist(data: Path, cache: Path, seed: int) -> str:
    """Compare the network with no twist and with the mean twist on persons it never saw."""
    rng = np.random.default_rng(seed)
    lifts, corpus = data / "synthetic_lifts", data / "mocap" / "cmu_h36m17_30fps.npz"

    def seen_of(persons: tuple[str, ...], every: int) -> TwistExamples:
        files = [f for p in persons for f in sorted(cache.glob(f"{p}_*.npz"))[::every]]
        return TwistExamples.join(
            read_seen_examples(lifts / trial[:3] / trial / "truth.npz", f, camera)
            for f in files
            for trial, camera in [f.stem.rsplit("_", 1)]
        )

    truths = [f for p in TEST_PERSONS for f in sorted((lifts / p).glob("*/truth.npz"))]
    true = TwistExamples.join(make_examples(read_lift_segments(f), rng) for f in truths)
    recorded = make_examples(read_mocap_segments(corpus, "test", every=2), rng)
    drawn = make_examples(draw_segments(5000, rng), rng)
    sets = {
        "lifts of P07, P08 as BlazePose saw them": seen_of(TEST_PERSONS, 1),
        "lifts of P07, P08, true joints": true,
        "recorded people (test), noise": dataclasses.replace(
            recorded, joints=disturb(recorded.joints, rng)
        ),
        "drawn postures, noise": dataclasses.replace(drawn, joints=disturb(drawn.joints, rng)),
    }
    mean = _mean_twist(seen_of(TRAINING_PERSONS, 4))
    network, rows = TwistNetwork(), []
    for name, examples in sets.items():
        guesses = {
            "none": np.zeros_like(examples.twist),
            "mean": np.broadcast_to(mean, examples.twist.shape),
            "network": network.estimate(examples.joints)[0],
        }
        for guess, twist in guesses.items():
            error = twist_errors(twist, examples)
            row: dict[str, float | str] = {"set": name, "twist": guess}
            for group, names in GROUPS.items():
                part = error[[JOINTS.index(n) - 1 for n in names]]
                row[group] = float(np.nanmean(part)) if np.isfinite(part).any() else np.nan
            rows.append(row)
    joints = sets["lifts of P07, P08 as BlazePose saw them"].joints[:2000]
    start = time.perf_counter()
    network.estimate(joints)
    note = f"\nNetwork, ms a frame: {1000 * (time.perf_counter() - start) / len(joints):.3f}"
    return pd.DataFrame(rows).round(1).to_string(index=False) + note


def _mean_twist(examples: TwistExamples) -> np.ndarray:
    """Return the circular mean of each joint's twist, shape (23,), radians."""
    turn = np.where(examples.is_known, np.exp(1j * examples.twist), 0.0).sum(axis=0)
    return np.angle(turn)


def table_angles(data: Path, cache: Path, persons: list[str], every: int) -> str:
    """Compare joint angles from BlazePose's body track and from the posed skeleton's."""
    videos = list(find_videos(data / "synthetic_lifts", persons))[::every]
    backends = {
        ik: hybrik.Backend(PoseConfig(variant="full", ik=ik)) for ik in ("adaptive", "naive")
    }
    rows = []
    for video in videos:
        pose, truth = load_pose(video, cache, Config()), read_truth(video.parent)
        group = "test" if video.parent.name[:3] in TEST_PERSONS else "training"
        for name in ("mediapipe", *backends):
            used = backends[name].lift(pose) if name in backends else pose
            errors = compare_angles(_angles_of(used, truth.stature_m), truth)
            row = {n.removesuffix("_flexion"): errors[f"{n} deg"] for n in ANGLES}
            label = name if name == "mediapipe" else f"hybrik-open, {name}"
            rows.append({"persons": group, "estimator": label, **row})
    table = pd.DataFrame(rows)
    parts = table.groupby(["persons", "estimator"])
    mean = parts.mean(numeric_only=True)
    mean["trunk, hip, knee"] = mean.iloc[:, :3].mean(axis=1)
    mean.insert(0, "videos", parts.size())
    return mean.round(2).to_string()


@dataclasses.dataclass(frozen=True)
class _Angles:
    """What `compare_angles` reads of a result."""

    angles: object


def _angles_of(pose: object, stature_m: float) -> _Angles:
    config, person = Config(), Subject(stature_m=stature_m)
    raw, _ = reconstruct_single_view(pose, person.stature, **dataclasses.asdict(config.camera))
    settings = dataclasses.asdict(config.correction)
    track = correct_track(raw, stature_m=person.stature.value, **settings)
    return _Angles(select_solver(config.kinematics.solver).fit(track, person).angles)


def main() -> None:
    """Print one table and keep it."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--part", choices=["ik", "twist", "angles"], required=True)
    parser.add_argument("--data", type=Path, default=Path("../shared/data"))
    parser.add_argument("--cache", type=Path, default=Path(".benchmark_cache/monocular_lifts"))
    parser.add_argument("--persons", nargs="*", default=["P01", "P02", "P03", "P04", "P06"])
    parser.add_argument("--every", type=int, default=1, help="take every n-th video")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--out", type=Path, default=Path("benchmarks/results"))
    options = parser.parse_args()
    if options.part == "ik":
        text = table_ik(options.seed)
    elif options.part == "twist":
        text = table_twist(options.data, options.cache, options.seed)
    else:
        text = table_angles(options.data, options.cache, options.persons, options.every)
    given = f"--part {options.part} --seed {options.seed}"
    name = f"swing_twist_{options.part}"
    if options.part == "angles":
        given += f" --persons {' '.join(options.persons)} --every {options.every}"
        name += "_test" if set(options.persons) <= set(TEST_PERSONS) else "_training"
    head = (
        f"benchmarks/swing_twist.py {given}\n"
        f"{platform.machine()}, Python {platform.python_version()}, one thread; other work was "
        "running.\n"
    )
    print(head + text)
    options.out.mkdir(parents=True, exist_ok=True)
    (options.out / f"{name}.txt").write_text(f"{head}\n{text}\n", encoding="utf-8")


if __name__ == "__main__":
    main()
