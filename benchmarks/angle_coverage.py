"""Errors of joint angles and how often their stated 95 % intervals hold the truth.

Four kinds of data, each for training (settings were chosen there) and test:

- `mocap`: recorded movement of people (17 joints), keypoints with added noise of known size;
- `lifts`: the same for synthetic lifts, with heels, toes and ears, whose true pelvis and lumbar
  angles are known;
- `monocular`: the synthetic lifts as the product sees them in one video (keypoints cached by
  `monocular_lifts.py`; both cameras), while the person moves.

Noise: `white` differs from frame to frame, `slow` is an AR(1) process with time constant 0.3 s,
`mixed` has equal shares of both. Its standard deviation is 1.5 cm at hips and shoulders, 2 cm at
knees and elbows, 3 cm elsewhere, and is stated to the solvers.

Run from the repository: python benchmarks/angle_coverage.py
"""

from __future__ import annotations

import argparse
import dataclasses
import platform
import time
from collections.abc import Iterator, Mapping
from pathlib import Path

import numpy as np
import pandas as pd
from monocular_lifts import find_videos, load_pose, read_truth
from threadpoolctl import threadpool_limits

from engine.cameras.monocular import reconstruct_single_view
from engine.config import Config
from engine.correction.chain import correct_track
from engine.datatypes import JointAngles, Measurement, PoseTrack, Subject
from engine.kinematics.fitting.base import add_scene_errors, select_solver
from engine.skeletons import get_skeleton

SEED = 20261122
SOLVERS = ("geometric", "least-squares")
NOISE_M = {"hip": 0.015, "shoulder": 0.015, "knee": 0.02, "elbow": 0.02}
OTHER_NOISE_M = 0.03
SLOW_SHARE = {"white": 0.0, "mixed": 0.5, "slow": 1.0}
TIME_CONSTANT_S = 0.3
CLIP_S = 10.0
TRAIN_PERSONS = ("P01", "P02", "P03", "P04", "P06")
TEST_PERSONS = ("P07", "P08")
N_TRAIN_CLIPS = 16

TRUTH_BY_GEOMETRY = (
    "trunk_inclination",
    "trunk_flexion",
    "trunk_lateral_bend",
    "trunk_twist",
    *(
        f"{name}_{side}"
        for name in ("knee_flexion", "elbow_flexion", "shoulder_flexion", "shoulder_adduction")
        for side in ("l", "r")
    ),
)
"""Angles that the clean joints define without any model."""

GEOMETRIC = tuple(dict.fromkeys(n.removesuffix("_l").removesuffix("_r") for n in TRUTH_BY_GEOMETRY))

BONES = {
    "lumbar_flexion": ("lumbar_extension", -1.0),
    "lumbar_bending": ("lumbar_bending", 1.0),
    "lumbar_rotation": ("lumbar_rotation", 1.0),
    "pelvis_tilt": ("pelvis_tilt", 1.0),
    **{
        f"{name}_{s}": (f"{name}_{s}", 1.0)
        for name in ("hip_flexion", "hip_adduction", "hip_rotation", "ankle_dorsiflexion")
        for s in ("l", "r")
    },
    **{f"shoulder_rotation_{s}": (f"arm_rotation_{s}", 1.0) for s in ("l", "r")},
}
"""Angles of the synthetic lifts' bones: our name, their name and sign."""


@dataclasses.dataclass(frozen=True)
class Clip:
    """One clip: clean joints or a track as the product makes it, and its true angles."""

    kind: str
    name: str
    track: PoseTrack
    truth: Mapping[str, np.ndarray]
    stature_m: float
    angles: Mapping[str, JointAngles] | None = None


def geometric_truth(track: PoseTrack) -> dict[str, np.ndarray]:
    """Return the angles that the clean joints define."""
    angles = solve("geometric", track, Subject())
    return {name: angles[name] for name in TRUTH_BY_GEOMETRY}


def solve(solver: str, track: PoseTrack, subject: Subject) -> JointAngles:
    return select_solver(solver).fit(track, subject).angles


# --------------------------------------------------------------------------- data


def mocap_clips(data: Path, *, test: bool) -> Iterator[Clip]:
    with np.load(data / "mocap/cmu_h36m17_30fps.npz", allow_pickle=False) as file:
        arrays = {key: file[key] for key in file.files}
    wanted = np.isin(arrays["split"], ["test"] if test else ["train", "val"])
    wanted &= arrays["length"] >= 90
    index = np.flatnonzero(wanted)
    if not test:
        bending = index[arrays["bending"][index]]
        other = np.setdiff1d(index, bending)
        rng = np.random.default_rng(SEED)
        index = np.concatenate(
            [rng.choice(part, N_TRAIN_CLIPS // 2, replace=False) for part in (bending, other)]
        )
    for i in np.sort(index):
        start = arrays["start"][i]
        stop = start + min(arrays["length"][i], round(CLIP_S * 30))
        joints = arrays["pose"][start:stop].astype(float) + arrays["root"][start:stop, None]
        world = np.stack([joints[..., 0], joints[..., 2], -joints[..., 1]], axis=-1)
        track = PoseTrack(np.arange(len(world)) / 30.0, world, "m", "world", "h36m_17")
        yield Clip("mocap", str(arrays["name"][i]), track, geometric_truth(track), 1.75)


def lift_clips(data: Path, *, test: bool) -> Iterator[Clip]:
    for person in TEST_PERSONS if test else TRAIN_PERSONS:
        for file in sorted((data / "synthetic_lifts" / person).glob("*/truth.npz")):
            if test or file.parent.name.endswith("_01"):
                yield lift_clip(file)


def lift_clip(file: Path) -> Clip:
    with np.load(file, allow_pickle=False) as arrays:
        at = np.asarray(arrays["video_time"], dtype=float)
        time_s = np.asarray(arrays["time"], dtype=float)
        joints, names = arrays["joints"].astype(float), [str(n) for n in arrays["joint_names"]]
        angles, angle_names = (
            arrays["angles"].astype(float),
            [str(n) for n in arrays["angle_names"]],
        )
    keypoints = get_skeleton("mediapipe_33").keypoints
    position = np.full((at.size, len(keypoints), 3), np.nan)
    for i, keypoint in enumerate(keypoints):
        side, _, part = keypoint.partition("_")
        source = f"{part.replace('big_toe', 'bigtoe')}_{side[0].upper()}" if part else keypoint
        if source in names:
            curve = joints[:, names.index(source)]
            position[:, i] = np.stack([np.interp(at, time_s, c) for c in curve.T], axis=1)
    track = PoseTrack(at, position, "m", "world", "mediapipe_33")
    truth = geometric_truth(track)
    for ours, (theirs, sign) in BONES.items():
        truth[ours] = sign * np.interp(at, time_s, angles[:, angle_names.index(theirs)])
    for s in ("l", "r"):
        truth[f"hip_trunk_{s}"] = truth[f"hip_flexion_{s}"] + truth["lumbar_flexion"]
    return Clip("lifts", file.parent.name, track, truth, read_stature(file.parents[1]))


def read_stature(folder: Path) -> float:
    import json

    return float(json.loads((folder / "subject.json").read_text())["height_m"])


def monocular_clips(options: argparse.Namespace, *, test: bool) -> Iterator[Clip]:
    config, data, cache = Config(), options.data, options.cache
    for video in find_videos(data / "synthetic_lifts", TEST_PERSONS if test else TRAIN_PERSONS):
        if not video.parent.name.endswith(options.repetition):
            continue
        clip = lift_clip(video.parent / "truth.npz")
        subject = Subject(stature_m=clip.stature_m)
        raw, scene = reconstruct_single_view(
            load_pose(video, cache, config),
            Measurement(clip.stature_m, 0.01),
            **dataclasses.asdict(config.camera),
        )
        track = correct_track(raw, **dataclasses.asdict(config.correction))
        track = getattr(track, "track", track)
        found = {name: add_scene_errors(solve(name, track, subject), scene) for name in SOLVERS}
        start_s, stop_s = read_truth(video.parent).motion_s
        moving = (track.time_s >= start_s) & (track.time_s <= stop_s)
        truth = {
            name: np.where(moving, np.interp(track.time_s, clip.track.time_s, curve), np.nan)
            for name, curve in clip.truth.items()
            if name not in ("trunk_flexion",)
        }
        yield Clip(f"monocular {video.stem}", video.parent.name, track, truth, 0.0, found)


# --------------------------------------------------------------------------- noise


def add_noise(track: PoseTrack, slow_share: float, rng: np.random.Generator) -> PoseTrack:
    """Add noise of known size, part of it slow."""
    keypoints = get_skeleton(track.skeleton).keypoints
    size = np.array([NOISE_M.get(name.partition("_")[2], OTHER_NOISE_M) for name in keypoints])
    white = rng.normal(size=track.position.shape)
    slow = rng.normal(size=track.position.shape)
    interval_s = float(np.median(np.diff(track.time_s)))
    keep = np.exp(-interval_s / TIME_CONSTANT_S)
    for i in range(1, len(slow)):
        slow[i] = keep * slow[i - 1] + np.sqrt(1.0 - keep**2) * slow[i]
    noise = np.sqrt(slow_share) * slow + np.sqrt(1.0 - slow_share) * white
    sigma = np.broadcast_to(size, track.position.shape[:2])
    return dataclasses.replace(
        track, position=track.position + size[:, None] * noise, sigma=sigma, status=None
    )


# --------------------------------------------------------------------------- comparison


def compare(clip: Clip, noise: str, angles: Mapping[str, JointAngles]) -> Iterator[dict]:
    """Return one row per angle and solver: sums that add up over clips."""
    for solver, found in angles.items():
        for name, truth in clip.truth.items():
            value, sigma = read_angle(found, solver, name)
            if value is None:
                continue
            error = (value - truth + 180.0) % 360.0 - 180.0
            known = np.isfinite(error)
            yield {
                "kind": clip.kind,
                "noise": noise,
                "solver": solver,
                "angle": name.removesuffix("_l").removesuffix("_r"),
                "samples": int(np.isfinite(truth).sum()),
                "known": int(known.sum()),
                "error": float(np.abs(error[known]).sum()),
                "sigma": float(sigma[known].sum()),
                "judged": int((known & np.isfinite(sigma)).sum()),
                "inside": int((np.abs(error) <= 1.96 * sigma)[known].sum()),
            }


def read_angle(
    found: JointAngles, solver: str, name: str
) -> tuple[np.ndarray | None, np.ndarray | None]:
    """Return an angle with its error; of the hip against pelvis or trunk, like with like."""
    if name.startswith("hip_trunk"):
        hip = name.replace("trunk", "flexion")
        if solver == "geometric":
            return found[hip], found.sigma(hip)
        return found[hip] + found["lumbar_flexion"], np.full(found.time_s.size, np.nan)
    if name not in found.names or (solver == "geometric" and name.startswith("hip_flexion")):
        return None, None
    return found[name], found.sigma(name)


def measure(clips: Iterator[Clip]) -> Iterator[dict]:
    rng = np.random.default_rng(SEED)
    for clip in clips:
        if clip.angles is not None:
            yield from compare(clip, "-", clip.angles)
            continue
        for noise, share in SLOW_SHARE.items():
            track = add_noise(clip.track, share, rng)
            subject = Subject(stature_m=clip.stature_m)
            yield from compare(clip, noise, {s: solve(s, track, subject) for s in SOLVERS})


def summarise(rows: pd.DataFrame) -> pd.DataFrame:
    """Return error, stated error, coverage and share measured, both solvers side by side."""
    keys = ["kind", "noise", "angle", "solver"]
    sums = ["samples", "known", "error", "sigma", "judged", "inside"]
    both = rows.groupby(keys, sort=False)[sums].sum()
    # The sum over angles compares the solvers on those that both give, in the same meaning.
    shared = [angle for angle in GEOMETRIC if angle in both.index.get_level_values("angle")]
    common = both[both.index.get_level_values("angle").isin(shared)]
    everything = common.groupby(["kind", "noise", "solver"], sort=False).sum().reset_index()
    everything["angle"] = "all shared"
    both = pd.concat([both.reset_index(), everything]).set_index(keys)
    table = pd.DataFrame(
        {
            "mae_deg": both["error"] / both["known"],
            "sigma_deg": both["sigma"] / both["known"],
            "in_95": both["inside"] / both["judged"],
            "share": both["known"] / both["samples"],
        }
    ).unstack("solver")
    short = {"geometric": "geo", "least-squares": "fit"}
    table.columns = [f"{value} {short[solver]}" for value, solver in table.columns]
    return table.dropna(axis=0, how="all").round(3)


def main() -> None:
    """Run the comparison and print the tables."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--data", type=Path, default=Path("../shared/data"))
    parser.add_argument("--cache", type=Path, default=Path(".benchmark_cache/monocular_lifts"))
    parser.add_argument("--kinds", nargs="*", default=["mocap", "lifts", "monocular"])
    parser.add_argument("--splits", nargs="*", default=["train", "test"])
    parser.add_argument("--repetition", default="", help="only lifts of this number, e.g. 01")
    parser.add_argument("--out", type=Path, help="write the tables to this file too")
    options = parser.parse_args()
    head = (
        f"Errors of joint angles and coverage of their 95 % intervals. Seed {SEED}, "
        f"{platform.machine()}, Python {platform.python_version()}.\n"
        "Command: python benchmarks/angle_coverage.py. geo: solver geometric; fit: solver "
        "least-squares.\nhip_trunk is the thigh against the trunk, hip_flexion against the pelvis."
    )
    text = [head]
    start = time.perf_counter()
    with threadpool_limits(limits=1, user_api="blas"):
        for split in options.splits:
            for kind in options.kinds:
                clips = {
                    "mocap": lambda t: mocap_clips(options.data, test=t),
                    "lifts": lambda t: lift_clips(options.data, test=t),
                    "monocular": lambda t: monocular_clips(options, test=t),
                }[kind](split == "test")
                table = summarise(pd.DataFrame(measure(clips)))
                text.append(f"\n{kind}, {split}\n{table.to_string()}")
                print(text[-1], flush=True)
    print(f"\n{time.perf_counter() - start:.0f} s")
    if options.out:
        options.out.write_text("\n".join(text) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
