"""How well joints of a picture are lifted to metres, and what that does to the angles of lifts.

Run from the project folder::

    .venv/bin/python benchmarks/lifting.py joints --out benchmarks/results/lifting_joints.txt
    .venv/bin/python benchmarks/lifting.py angles --out benchmarks/results/lifting_angles.txt
    .venv/bin/python benchmarks/lifting.py real --out benchmarks/results/lifting_real.txt

`joints`: recorded movements of people in no training set, seen by virtual cameras, with true points
and with BlazePose's errors imitated; beside the networks the mean posture, a single-frame network
(Martinez et al. 2017) and a temporal convolution (after Pavllo et al. 2019), both trained alike.

`angles`: the synthetic lifting trials with BlazePose's real keypoints (kept by
benchmarks/monocular_lifts.py), through reconstruction, correction and angles as in the product. The
persons P07 and P08 were used for nothing else. A run that was interrupted goes on where it stopped.

`real`: one camera of the real clip against pairs of its other cameras.
"""

from __future__ import annotations

import argparse
import dataclasses
import hashlib
import platform
import sys
import time
from collections.abc import Callable, Iterator
from itertools import combinations
from pathlib import Path

import numpy as np
import pandas as pd

sys.path.insert(0, str(Path(__file__).parent))

import two_view
from monocular_lifts import (
    LOAD_KG,
    TEST_PERSONS,
    Truth,
    compare_angles,
    compare_lift,
    find_videos,
    load_pose,
    read_truth,
)

from engine import Config, Subject, Task, Trial, TrialResult, View
from engine.config import KinematicsConfig, PoseConfig
from engine.datatypes import ViewPose
from engine.pipeline import assess_pose
from engine.pose.base import create_backend
from engine.pose.lifting.lifter import DiffusionLifter, DirectLifter, Lifter, Windows
from engine.pose.lifting.network import MODEL_DIR, open_network
from engine.skeletons import MEDIAPIPE_33
from engine.training.corpus import Clip, read_mocap
from engine.training.keypoint_noise import KeypointNoise
from engine.training.measure_blazepose import NOISE_FILE
from engine.training.views import Batch, sample_batches

SEED = 20
STATURE_MM = 1700.0
ANGLES = ("trunk_inclination", "hip_flexion", "knee_flexion")
HEAD_AND_NOSE = (9, 10)
CHAINS = {
    "hip": ((8, 0, (1, 2)), (8, 0, (4, 5))),
    "knee": ((1, 2, (2, 3)), (4, 5, (5, 6))),
    "elbow": ((11, 12, (12, 13)), (14, 15, (15, 16))),
}
"""Angles between two bones, each from its first to its second joint."""


# --- joints -------------------------------------------------------------------------------------


def read_reference(path: Path) -> list[Clip]:
    """Read the reference trials, in which nose and head were not measured."""
    with np.load(path, allow_pickle=False) as data:
        arrays = {key: data[key] for key in data.files}
    clips = []
    for row in range(len(arrays["start"])):
        part = slice(arrays["start"][row], arrays["start"][row] + arrays["length"][row])
        position = arrays["pose"][part].astype(np.float32) + arrays["root"][part, None]
        clips.append(Clip(str(arrays["name"][row]), "reference", "mocap", position, "test"))
    return clips


def procrustes(found: np.ndarray, true: np.ndarray) -> np.ndarray:
    """Return found postures (N, K, 3) turned, moved and scaled onto the true ones."""
    a, b = found - found.mean(axis=1, keepdims=True), true - true.mean(axis=1, keepdims=True)
    u, s, vt = np.linalg.svd(np.einsum("nki,nkj->nij", a, b))
    sign = np.sign(np.linalg.det(u @ vt))
    flip = np.stack([np.ones_like(sign), np.ones_like(sign), sign], axis=1)
    rotation = (u * flip[:, None]) @ vt
    scale = (s * flip).sum(axis=1) / (a**2).sum(axis=(1, 2))
    return scale[:, None, None] * (a @ rotation) + true.mean(axis=1, keepdims=True)


def angle_deg(joints: np.ndarray, chain: tuple) -> np.ndarray:
    """Return the angle between two bones of postures (N, 17, 3)."""
    start, end, (second, third) = chain
    a, b = joints[:, end] - joints[:, start], joints[:, third] - joints[:, second]
    cosine = (a * b).sum(axis=1) / np.linalg.norm(a, axis=1) / np.linalg.norm(b, axis=1)
    return np.degrees(np.arccos(np.clip(cosine, -1, 1)))


def measure_joints(found: np.ndarray, true: np.ndarray) -> dict[str, float]:
    """Return errors of postures (N, 17, 3) in statures."""
    use = [i for i in range(17) if i not in HEAD_AND_NOSE]
    row = {
        "MPJPE mm": STATURE_MM * np.linalg.norm(found - true, axis=2)[:, use].mean(),
        "PA-MPJPE mm": STATURE_MM
        * np.linalg.norm(procrustes(found[:, use], true[:, use]) - true[:, use], axis=2).mean(),
    }
    trunks = [joints[:, 8] - joints[:, 0] for joints in (found, true)]
    trunks = [t / np.linalg.norm(t, axis=1, keepdims=True) for t in trunks]
    cosine = np.clip((trunks[0] * trunks[1]).sum(axis=1), -1, 1)
    row["trunk deg"] = np.degrees(np.arccos(cosine)).mean()
    for name, chains in CHAINS.items():
        off = [np.abs(angle_deg(found, c) - angle_deg(true, c)) for c in chains]
        row[f"{name} deg"] = np.mean(off)
    return row


def lift_batch(lifter: Lifter, batch: Batch) -> np.ndarray:
    """Lift windows as the product does, without cutting and blending."""
    points = batch.points.astype(float)
    size = np.full(len(points), 0.4)
    rays = np.concatenate([points[..., :2] * 0.4, np.ones((*points.shape[:3], 1))], axis=-1)
    joints, _ = lifter.lift_windows(Windows(points, rays, points[..., 2], size))
    return joints - joints[:, :, :1]


def networks(folder: Path, seed: int) -> Iterator[tuple[str, Callable[[Batch], np.ndarray]]]:
    """Give everything that lifts: the mean posture, the baselines, the estimators."""
    for name in ("mlp", "tcn"):
        if (file := folder / f"{name}.onnx").exists():
            lifter = DirectLifter(open_network(file, "lifter"))
            yield name, lambda batch, lifter=lifter: lift_batch(lifter, batch)
    lifter = DirectLifter(open_network(MODEL_DIR / "mhformer_s.onnx", "lifter"))
    yield "mhformer-s", lambda batch: lift_batch(lifter, batch)
    denoiser = open_network(MODEL_DIR / "d3dp_s.onnx", "denoiser")
    for how in ("jpma", "mean"):
        drawn = DiffusionLifter(denoiser, aggregation=how, seed=seed)
        yield f"d3dp-s {how}", lambda batch, drawn=drawn: lift_batch(drawn, batch)


def compare_joints(options: argparse.Namespace) -> str:
    """Return the table of joints."""
    corpus = options.data / "mocap" / "cmu_h36m17_30fps.npz"
    reference = options.data / "reference" / "reference_h36m17_30fps.npz"
    usual = next(_batches(read_mocap(corpus, "train"), None, 512, 1)).joints.mean(axis=(0, 1))
    sets = {
        "CMU, test subjects": read_mocap(corpus, "test"),
        "reference": read_reference(reference),
    }
    rows = []
    for (label, clips), imitated in [(s, n) for s in sets.items() for n in (False, True)]:
        noise = KeypointNoise.read(NOISE_FILE) if imitated else None
        batches = [b for b, _ in zip(_batches(clips, noise, 48, SEED), range(1), strict=False)]
        true = np.concatenate([b.joints for b in batches]).reshape(-1, 17, 3)
        named = [("mean posture", lambda b: np.broadcast_to(usual, b.joints.shape))]
        for name, lift in [*named, *networks(options.cache / "lifting", SEED)]:
            found = np.concatenate([lift(b) for b in batches]).reshape(-1, 17, 3)
            case = {
                "movements": label,
                "points": "imitated" if imitated else "true",
                "lifted": name,
            }
            rows.append(case | measure_joints(found, true))
    table = pd.DataFrame(rows).set_index(["movements", "points", "lifted"]).round(1)
    return f"Joints (15, without nose and head), at a stature of 1.70 m\n{table.to_string()}"


def _batches(
    clips: list[Clip], noise: KeypointNoise | None, size: int, seed: int
) -> Iterator[Batch]:
    return sample_batches(
        clips, n_frames=27, batch_size=size, noise=noise, seed=seed, is_varied=False
    )


# --- angles -------------------------------------------------------------------------------------


def estimators() -> dict[str, Callable[[ViewPose], ViewPose]]:
    """Return what is compared: each takes BlazePose's view and gives its own."""
    made = {name: create_backend(PoseConfig(backend=name)).lift for name in ("mhformer", "d3dp")}
    mean = create_backend(PoseConfig(backend="d3dp", aggregation="mean")).lift
    return {
        "mediapipe": lambda pose: pose,
        **made,
        "d3dp mean": mean,
        "mhformer, depth only": lambda pose: without_errors(made["mhformer"](pose)),
        "mhformer, half its depth": lambda pose: blend_depth(pose, made["mhformer"](pose), 0.5),
        "mhformer, no depth": lambda pose: blend_depth(pose, made["mhformer"](pose), 0.0),
    }


def without_errors(pose: ViewPose) -> ViewPose:
    """Take the stated errors away: only depth is then taken from the body, as from BlazePose."""
    return dataclasses.replace(pose, body=dataclasses.replace(pose.body, sigma=None))


def blend_depth(own: ViewPose, lifted: ViewPose, share: float) -> ViewPose:
    """Mix the depths of BlazePose's body and the lifted one, scaled to the same size."""
    a, b = np.asarray(own.body.position), np.array(lifted.body.position)
    chosen = [
        MEDIAPIPE_33.index(f"{s}_{p}") for s in ("left", "right") for p in ("shoulder", "ankle")
    ]
    sizes = [np.nanmedian(np.linalg.norm(np.ptp(v[:, chosen], axis=1), axis=1)) for v in (a, b)]
    b[..., 2] = share * b[..., 2] + (1 - share) * a[..., 2] * sizes[1] / sizes[0]
    return dataclasses.replace(lifted, body=dataclasses.replace(lifted.body, position=b))


def compare_lifts(options: argparse.Namespace) -> str:
    """Return the tables of angles, by camera and group of persons."""
    rows_file = options.cache / "lifting" / f"{options.solver}.csv"
    rows_file.parent.mkdir(parents=True, exist_ok=True)
    done = pd.read_csv(rows_file) if rows_file.exists() and not options.fresh else pd.DataFrame()
    # Rows of other weights don't count.
    weights = {name: _hash(MODEL_DIR / f"{name}_s.onnx") for name in ("mhformer", "d3dp")}
    rows = [
        row
        for row in done.to_dict("records")
        if row["weights"] == weights.get(row["estimator"].split(",")[0].split(" ")[0], "none")
    ]
    known = {(row["trial"], row["camera"], row["estimator"]) for row in rows}
    compared = {n: e for n, e in estimators().items() if not options.only or n in options.only}
    persons = options.persons or sorted(
        p.name for p in (options.data / "synthetic_lifts").glob("P*")
    )
    videos = list(find_videos(options.data / "synthetic_lifts", persons))[:: options.every]
    for video in videos:
        pose = load_pose(video, options.cache / "monocular_lifts", Config())
        for name, estimate in compared.items():
            if (video.parent.name, video.stem, name) in known:
                continue
            used = weights.get(name.split(",")[0].split(" ")[0], "none")
            rows.append(measure_lift(video, name, estimate, pose, options.solver))
            rows[-1]["weights"] = used
            pd.DataFrame(rows).to_csv(rows_file, index=False, float_format="%.4f")
        print(video.parent.name, video.stem, flush=True)
    table = pd.DataFrame(rows)
    wanted = {(v.parent.name, v.stem) for v in videos}
    table = table[[key in wanted for key in zip(table["trial"], table["camera"], strict=True)]]
    return summarise(table[table["estimator"].isin(compared)])


def _hash(path: Path) -> str:
    return hashlib.sha256(path.read_bytes()).hexdigest()[:8]


def measure_lift(
    video: Path, name: str, estimate: Callable[[ViewPose], ViewPose], pose: ViewPose, solver: str
) -> dict[str, float | str]:
    """Assess one video with one estimator and compare its angles with the truth."""
    truth = read_truth(video.parent)
    # Processor time: others may be at work on the machine.
    start = time.process_time()
    seen = estimate(pose)
    spent = time.process_time() - start
    trial = Trial(
        views=(View(video),),
        subject=Subject(stature_m=truth.stature_m),
        task=Task(load_kg=LOAD_KG, coupling="good"),
    )
    config = Config(kinematics=KinematicsConfig(solver=solver))
    result = assess_pose(trial, seen, config)
    return {
        "trial": video.parent.name,
        "camera": video.stem,
        "persons": "test" if video.parent.name[:3] in TEST_PERSONS else "training",
        "estimator": name,
        "ms a frame": 1000 * spent / pose.image.n_frames,
        **compare_angles(result, truth),
        **compare_hands(result, truth),
    }


def compare_hands(result: TrialResult, truth: Truth) -> dict[str, float]:
    """Return mean absolute errors of where the hands are at both ends of the lift, cm."""
    if not result.lifts:
        return {"H cm": np.nan, "V cm": np.nan, "lifts": 0}
    off = compare_lift(max(result.lifts, key=lambda lift: lift.end_s - lift.start_s), truth)
    ends = ("origin", "set-down")
    places = {f"{k} cm": float(np.mean([abs(off[f"{k} {end}"]) for end in ends])) for k in "HV"}
    return places | {"lifts": len(result.lifts)}


def summarise(rows: pd.DataFrame) -> str:
    """Return mean absolute errors, and the change against BlazePose's own landmarks."""
    columns = [f"{name} deg" for name in ANGLES]
    rows = rows.assign(**{"mean deg": rows[columns].mean(axis=1)})
    columns = [*columns, "mean deg"]
    parts = []
    for keys, title in (
        (["persons", "camera", "estimator"], "Mean absolute error while moving, degrees"),
        (["persons", "estimator"], "Both cameras together"),
    ):
        table = rows.groupby(keys, sort=False)[columns].mean()
        usual = table.xs("mediapipe", level="estimator")["mean deg"]
        index = table.index.droplevel("estimator")
        table["change %"] = 100 * (table["mean deg"].to_numpy() / usual.loc[index].to_numpy() - 1)
        table["share"] = rows.groupby(keys, sort=False)["hip_flexion share"].mean()
        if len(keys) == 2:
            for name in ("angles in 95 %", "H cm", "V cm"):
                table[name] = rows.groupby(keys, sort=False)[name].mean()
            table["elbow_flexion deg"] = rows.groupby(keys, sort=False)["elbow_flexion deg"].mean()
            table["lifting ms a frame"] = rows.groupby(keys, sort=False)["ms a frame"].median()
        parts.append(f"{title}\n{table.round(2).to_string()}")
    return "\n\n".join(parts)


# --- real ---------------------------------------------------------------------------------------


def compare_real(options: argparse.Namespace) -> str:
    """Hold one camera against pairs of the others, on one real clip with four cameras.

    The reference is made of BlazePose's points too, so it has BlazePose's joints: an estimator that
    gives other joint centres can only lose here. It shows whether it fails on a real person.
    """
    cache = options.cache / "real_four_view"
    views = {
        name: load_pose(options.data / "real_four_view" / f"{name}.mp4", cache, Config())
        for name in two_view.REAL_CAMERAS
    }
    given = two_view.read_real_calibration(options.data / "real_four_view")
    rows = []
    for number, (name, pose) in enumerate(views.items()):
        others = [pair for pair in combinations(range(4), 2) if number not in pair]
        halves = [
            two_view.reconstruct_half("given", pair, views, given, Subject())[1] for pair in others
        ]
        for label, estimate in estimators().items():
            trial = Trial(views=(View(options.data / "real_four_view" / f"{name}.mp4"),))
            angles = assess_pose(trial, estimate(pose), Config()).angles
            row: dict[str, float | str] = {"camera": name, "estimator": label}
            for part in ("trunk_inclination", "hip_flexion", "knee_flexion", "elbow_flexion"):
                keys = [k for k in angles.names if k.startswith(part)]
                off = [np.abs(angles[k] - half[k]) for half in halves for k in keys]
                row[f"{part} deg"] = float(np.nanmean(off))
            rows.append(row)
    table = pd.DataFrame(rows)
    mean = table.groupby("estimator", sort=False).mean(numeric_only=True).round(2)
    title = "One camera against pairs of the three others (real, no truth), degrees"
    return f"{title}\n{mean.to_string()}"


def main() -> None:
    """Run one of the comparisons and print its table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("what", choices=("joints", "angles", "real"))
    parser.add_argument("--data", type=Path, default=Path("../shared/data"))
    parser.add_argument("--cache", type=Path, default=Path(".benchmark_cache"))
    parser.add_argument("--out", type=Path, required=True, help="write the table to this file")
    parser.add_argument("--persons", nargs="*", help="for example P01 P07; all if left out")
    parser.add_argument("--only", nargs="*", help="estimators; all if left out")
    parser.add_argument("--every", type=int, default=1, help="every n-th video only")
    parser.add_argument("--solver", default="geometric")
    parser.add_argument("--fresh", action="store_true", help="forget what was measured before")
    options = parser.parse_args()
    compare = {"joints": compare_joints, "angles": compare_lifts, "real": compare_real}
    table = compare[options.what](options)
    command = " ".join(["benchmarks/lifting.py", *sys.argv[1:]])
    head = f"{command}\nseed {SEED}; {platform.machine()}, Python {platform.python_version()}"
    options.out.write_text(f"{head}\n\n{table}\n", encoding="utf-8")
    print(f"\n{head}\n\n{table}")


if __name__ == "__main__":
    main()
