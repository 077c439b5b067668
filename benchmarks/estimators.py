"""The estimators of posture compared as Choi et al. (2024) compare theirs.

Run from the project folder::

    .venv/bin/python benchmarks/estimators.py --out benchmarks/results/estimators.txt

prints the paper's Table 2 (share of frames with an outlier, per video), Table 3 (seconds a frame),
Table 4 (fit of the humanoid, joint angle error by group, as estimated and corrected, with the
improvement counted in both ways) and draws Figure 21 (joint profiles) beside the text file.
Videos are the synthetic lifts, real clips (outliers only: there is no truth), and reference
recordings of squats and chairs seen by virtual cameras, whose persons are in no training set.
Every estimator runs with our own weights, trained on open data: nothing here tells how good the
published networks are. Keypoints in the picture are kept in a cache.
"""

from __future__ import annotations

import argparse
import dataclasses
import os
import platform
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np
import pandas as pd
from monocular_lifts import TEST_PERSONS, find_videos, load_pose

from engine import Config, Subject, Trial, View
from engine.config import CorrectionConfig, PoseConfig
from engine.datatypes import PoseTrack, SubjectState, ViewInfo, ViewPose
from engine.errors import EngineError
from engine.estimators import lift_keypoints, list_lifters, outlier_ratio
from engine.kinematics.fitting.base import select_solver
from engine.pipeline import assess_pose
from engine.skeletons import H36M_17, MEDIAPIPE_33
from engine.validation.curves import angle_difference
from engine.validation.majae import MAJAE_GROUPS, compute_improvement, compute_majae

ESTIMATORS = tuple(info.name for info in list_lifters() if not info.missing)
PRESETS = {"original": "none", "paper": "paper", "ours": "default"}
"""How the keypoints are corrected: not, as published, or by the product's own chain."""
FPS = 30.0
AZIMUTHS = {"side": 90.0, "oblique": 135.0}
DISTANCE_M, CAMERA_HEIGHT_M, FOCAL_PX, SIZE_PX = 4.0, 1.2, 1100.0, (1280, 960)
PROFILE_ANGLES = ("hip_flexion_r", "knee_flexion_r", "shoulder_flexion_r", "elbow_flexion_r")


@dataclass(frozen=True, eq=False)
class Clip:
    """One video as MediaPipe's landmarks, and the true angles at `truth_s` where there are any."""

    group: str
    name: str
    pose: ViewPose
    stature_m: float
    truth_s: np.ndarray | None = None
    truth: dict[str, np.ndarray] = dataclasses.field(default_factory=dict)
    span_s: tuple[float, float] = (-np.inf, np.inf)
    has_body: bool = True


# --- clips -----------------------------------------------------------------------------------


def read_lift_clips(data: Path, cache: Path, persons: Sequence[str], every: int) -> Iterator[Clip]:
    """Give the synthetic lifts, with the angles of the model's bones."""
    import json

    for video in list(find_videos(data / "synthetic_lifts", persons))[::every]:
        with np.load(video.parent / "truth.npz", allow_pickle=False) as arrays:
            names, values = list(arrays["angle_names"]), arrays["angles"].astype(float)
            time_s = arrays["time"].astype(float)
        events = json.loads((video.parent / "trial.json").read_text())["events_s"]
        person = json.loads((video.parent.parent / "subject.json").read_text())
        yield Clip(
            f"{video.parent.name[4:6]} {video.stem}",
            f"{video.parent.name} {video.stem}",
            load_pose(video, cache, Config()),
            person["height_m"],
            time_s,
            _as_ours(dict(zip(names, values.T, strict=True))),
            (events["reach_start"], events["stand"]),
        )


def _as_ours(angles: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Name the truth's angles as the product does."""
    ours = {
        "lumbar_flexion": -angles["lumbar_extension"],
        "lumbar_bending": angles["lumbar_bending"],
        "lumbar_rotation": angles["lumbar_rotation"],
        "trunk_inclination": angles["trunk_inclination"],
    }
    for side in ("l", "r"):
        for part in ("flexion", "adduction", "rotation"):
            ours[f"shoulder_{part}_{side}"] = angles[f"arm_{part}_{side}"]
        for name in ("hip_flexion", "hip_adduction", "knee_flexion", "elbow_flexion"):
            ours[f"{name}_{side}"] = angles[f"{name}_{side}"]
    return ours


def read_real_clips(data: Path, cache: Path) -> Iterator[Clip]:
    """Give the real clips; nobody knows their true angles."""
    for video in sorted((data / "real_four_view").glob("cam*.mp4")):
        pose = load_pose(video, cache.with_name("real_four_view_single"), Config())
        yield Clip("real walkway", f"real {video.stem}", pose, 1.75)


def read_reference_clips(data: Path) -> Iterator[Clip]:
    """Give reference recordings as virtual cameras see them, without any error in the picture.

    Feet and head, which the recordings don't hold, are set from the legs and the trunk. MediaPipe
    gives no depth for pictures that don't exist, so it is left out of these rows, and so is what
    starts from its depth.
    """
    with np.load(data / "reference/reference_h36m17_30fps.npz", allow_pickle=False) as arrays:
        world = (arrays["pose"].astype(float) + arrays["root"][:, None])[..., [0, 2, 1]]
        world *= [1.0, 1.0, -1.0]
        rows = list(zip(arrays["name"], arrays["start"], arrays["length"], strict=True))
    for name, start, length in rows:
        joints = world[start : start + length]
        if length < 3 * FPS or "static" in name:
            continue
        stature = _stature(joints)
        truth = _fit_truth(joints, stature)
        for view, azimuth in AZIMUTHS.items():
            pose = _photograph(_as_landmarks(joints, stature), azimuth, f"{name} {view}")
            yield Clip(
                f"reference {view}",
                f"{name} {view}",
                pose,
                stature,
                np.arange(length) / FPS,
                truth,
                has_body=False,
            )


def _stature(joints: np.ndarray) -> float:
    at = {n: joints[:, i] for i, n in enumerate(H36M_17.keypoints)}
    leg = sum(
        np.median(np.linalg.norm(at[f"{s}_{a}"] - at[f"{s}_{b}"], axis=1))
        for s in ("left", "right")
        for a, b in (("hip", "knee"), ("knee", "ankle"))
    )
    return float(leg / 2 / (0.245 + 0.246))


def _as_landmarks(joints: np.ndarray, stature: float) -> np.ndarray:
    """Give MediaPipe's 33 points of 17 joints (T, 17, 3), Y up; hands and feet are short stubs."""
    at = {n: joints[:, i] for i, n in enumerate(H36M_17.keypoints)}
    right = at["right_hip"] - at["left_hip"]
    right[:, 1] = 0
    right /= np.linalg.norm(right, axis=1, keepdims=True)
    up = np.broadcast_to([0.0, 1.0, 0.0], right.shape)
    forward = np.cross(up, right)
    out = np.full((len(joints), 33, 3), np.nan)
    for i, name in enumerate(MEDIAPIPE_33.keypoints):
        side, _, part = name.partition("_")
        sign = -1.0 if side == "left" else 1.0
        if name in at:
            out[:, i] = at[name]
        elif part == "ear":
            out[:, i] = 0.5 * (at["nose"] + at["head"]) + sign * 0.04 * stature * right
        elif part == "heel":
            out[:, i] = at[f"{side}_ankle"] - 0.03 * stature * up - 0.025 * stature * forward
        elif part == "big_toe":
            out[:, i] = at[f"{side}_ankle"] - 0.035 * stature * up + 0.09 * stature * forward
        elif part in ("index", "pinky", "thumb"):
            reach = at[f"{side}_wrist"] - at[f"{side}_elbow"]
            out[:, i] = at[f"{side}_wrist"] + 0.35 * reach
        else:
            out[:, i] = at["nose"]
    return out


def _photograph(points: np.ndarray, azimuth_deg: float, name: str) -> ViewPose:
    """See points (T, 33, 3) through a level camera at an azimuth from the person's front."""
    hips = [MEDIAPIPE_33.index(f"{s}_hip") for s in ("left", "right")]
    centre = points[:, hips].mean(axis=(0, 1))
    line = (points[0, hips[1]] - points[0, hips[0]]) * [1.0, 0.0, 1.0]
    right = line / np.linalg.norm(line)
    front = np.cross([0.0, 1.0, 0.0], right)
    angle = np.radians(azimuth_deg)
    away = np.cos(angle) * front + np.sin(angle) * right
    floor = np.nanmin(points[..., 1])
    eye = centre * [1, 0, 1] + DISTANCE_M * away + [0, floor + CAMERA_HEIGHT_M, 0]
    axes = np.stack([np.cross(-away, [0.0, 1.0, 0.0]), [0.0, -1.0, 0.0], -away])
    seen = (points - eye) @ axes.T
    image = FOCAL_PX * seen[..., :2] / seen[..., 2:] + np.array(SIZE_PX) / 2
    time_s = np.arange(len(points)) / FPS
    confidence = np.full(image.shape[:2], 0.95)
    box = np.concatenate([image.min(axis=1) - 20, image.max(axis=1) + 20], axis=1)
    return ViewPose(
        PoseTrack(time_s, image, "px", "image", MEDIAPIPE_33.name, confidence),
        None,
        box,
        (SubjectState.TRACKED,) * len(time_s),
        ViewInfo(name, "", FPS, len(time_s), SIZE_PX, len(time_s) / FPS),
    )


def _fit_truth(joints: np.ndarray, stature: float) -> dict[str, np.ndarray]:
    """Give the angles of the body that fits the true joints."""
    landmarks = _as_landmarks(joints, stature)
    time_s = np.arange(len(joints)) / FPS
    track = PoseTrack(time_s, landmarks, "m", "world", MEDIAPIPE_33.name)
    angles = select_solver("least-squares").fit(track, Subject(stature_m=stature)).angles
    return {name: angles[name] for name in angles.names}


# --- one estimator on one clip -----------------------------------------------------------------


def measure(clip: Clip, name: str, solver: str) -> tuple[list[dict], dict[str, np.ndarray]]:
    """Lift, correct in every way, fit and compare; rows, and curves of our own correction."""
    settings = PoseConfig(backend=name, threads=1)
    start = time.perf_counter()
    try:
        pose = lift_keypoints(clip.pose, settings)
    except EngineError as error:
        row = {"group": clip.group, "clip": clip.name, "estimator": name, "correction": "original"}
        return [row | {"refused": str(error)}], {}
    per_frame = (time.perf_counter() - start) / clip.pose.image.n_frames
    trial = Trial(views=(View(Path(clip.name)),), subject=Subject(stature_m=clip.stature_m))
    rows, curves = [], {}
    for label, preset in PRESETS.items():
        config = dataclasses.replace(
            Config(),
            pose=settings,
            correction=CorrectionConfig(preset=preset),
            kinematics=dataclasses.replace(Config().kinematics, solver=solver),
        )
        row = {"group": clip.group, "clip": clip.name, "estimator": name, "correction": label}
        try:
            result = assess_pose(trial, pose, config)
        except EngineError as error:
            rows.append(row | {"refused": str(error)})
            continue
        row |= {
            "outliers": outlier_ratio(result.raw, stature_m=clip.stature_m),
            "lifting_s": 0.0 if pose is clip.pose else per_frame,
            "fit_mm": 1000 * float(np.nanmean(result.body.residual_m)) if result.body else np.nan,
        }
        if clip.truth_s is not None:
            row |= _angle_errors(clip, result.angles)
        rows.append(row)
        if label == "ours":
            curves = {n: result.angles[n] for n in PROFILE_ANGLES} | {"s": result.angles.time_s}
    return rows, curves


def _angle_errors(clip: Clip, angles) -> dict[str, float]:
    inside = (angles.time_s >= clip.span_s[0]) & (angles.time_s <= clip.span_s[1])
    time_s = angles.time_s[inside]
    names = [n for g in MAJAE_GROUPS.values() for n in g if n in angles.names and n in clip.truth]
    found = np.stack([angles[n][inside] for n in names], axis=1)
    true = np.stack([np.interp(time_s, clip.truth_s, clip.truth[n]) for n in names], axis=1)
    errors = compute_majae(time_s, names, found, true)
    row = {g.name: g.mae_deg for g in errors.groups}
    main = ["trunk_inclination"] + [f"{p}_flexion_{s}" for p in ("hip", "knee") for s in "lr"]
    off = [
        np.abs(angle_difference(angles[n][inside], np.interp(time_s, clip.truth_s, clip.truth[n])))
        for n in main
    ]
    # Hips against the trunk, as one camera can measure them, hold the bend of the back too.
    row["trunk, hip, knee"] = float(np.nanmean(np.concatenate(off)))
    return row


# --- tables ------------------------------------------------------------------------------------


def summarise(rows: pd.DataFrame, landmarks_s: float) -> str:
    """Return the paper's tables."""
    as_is = rows[rows.correction == "original"]
    order = [n for n in ESTIMATORS if n in set(rows.estimator)]
    table2 = (100 * as_is.pivot_table("outliers", "group", "estimator")[order]).round(1)
    table2.loc["mean of clips"] = (100 * as_is.groupby("estimator").outliers.mean()).round(1)
    lifting = as_is.groupby("estimator").lifting_s.median()[order]
    table3 = pd.DataFrame(
        {
            "landmarks": landmarks_s,
            "lifting": lifting.round(5),
            "together": (lifting + landmarks_s).round(4),
        }
    )
    known = rows.assign(average=_average(rows)).dropna(subset=["average"])
    columns = ["fit_mm", *MAJAE_GROUPS, "average", "trunk, hip, knee"]
    keys = ["group", "estimator", "correction"]
    table4 = known.groupby(keys, sort=True)[columns].mean().round(2)
    parts = [
        ("Table 2: frames with an outlier before correction, %", table2.to_string()),
        (
            f"Table 3: seconds a frame, median; {platform.machine()}, 1 thread, no GPU",
            table3.to_string(),
        ),
        ("Table 4: fit residual (mm) and MAJAE (degrees)", table4.to_string()),
        ("Improvement of the average MAJAE by correction, %", _improvements(known)),
        ("All clips with truth, by estimator and correction", _totals(known, columns)),
    ]
    if "refused" in rows and rows.refused.notna().any():
        refused = rows[rows.refused.notna()][["clip", "estimator", "correction", "refused"]]
        parts.append(("Refused", refused.to_string(index=False)))
    parts.append(("Ten largest errors", _worst(known)))
    return "\n\n".join(f"{title}\n{text}" for title, text in parts)


def _average(rows: pd.DataFrame) -> pd.Series:
    """Weight the groups by their angles, as the paper does; a group never seen is left out."""
    weights = pd.Series({name: len(angles) for name, angles in MAJAE_GROUPS.items()})
    groups = rows[list(MAJAE_GROUPS)]
    return (groups * weights).sum(axis=1) / (groups.notna() * weights).sum(axis=1)


def _improvements(known: pd.DataFrame) -> str:
    means = known.groupby(["group", "estimator", "correction"]).average.mean().unstack()
    lines = []
    for label in ("paper", "ours"):
        pairs = means[["original", label]].dropna()
        gain = compute_improvement(
            pairs["original"], pairs[label], clusters=[g for g, _ in pairs.index]
        )
        low, high = gain.of_mean_interval.low, gain.of_mean_interval.high
        lines.append(
            f"{label:>6}: mean of rows {gain.mean_of_rows_percent:.1f}, of the mean "
            f"{gain.of_mean_percent:.1f} (95 % {low:.1f} to {high:.1f}); {gain.n_worse} of "
            f"{gain.n_rows} rows got worse"
        )
    return "\n".join(lines)


def _totals(known: pd.DataFrame, columns: list[str]) -> str:
    kind = np.where(known.group.str.startswith("reference"), "reference", "lifts")
    return (
        known.assign(kind=kind)
        .groupby(["kind", "estimator", "correction"])[columns]
        .mean()
        .round(2)
        .to_string()
    )


def _worst(known: pd.DataFrame) -> str:
    ours = known[known.correction == "ours"].sort_values("average", ascending=False)
    return ours[["clip", "estimator", "average", "fit_mm"]].head(10).round(2).to_string(index=False)


def draw_profiles(clip: Clip, curves: dict[str, dict[str, np.ndarray]], path: Path) -> None:
    """Draw Figure 21: four joint angles by every estimator beside the truth."""
    figure, axes = plt.subplots(2, 2, figsize=(10, 6), layout="constrained", sharex=True)
    for axis, name in zip(axes.flat, PROFILE_ANGLES, strict=True):
        axis.plot(clip.truth_s, clip.truth[name], color="0.2", linewidth=2.5, label="truth")
        for (estimator, found), dash in zip(curves.items(), ("-", "--", ":", "-."), strict=False):
            axis.plot(found["s"], found[name], dash, label=estimator)
        axis.set_title(name.replace("_", " "))
        axis.grid(alpha=0.3)
    for axis in axes[:, 0]:
        axis.set_ylabel("Angle (degrees)")
    for axis in axes[1]:
        axis.set_xlabel("Time (s)")
    axes[0, 0].legend(fontsize=8)
    figure.suptitle(
        f"Synthetic lift {clip.name}: joint profiles, corrected and fitted", fontsize=11
    )
    figure.savefig(path, dpi=110)
    plt.close(figure)


def time_landmarks(data: Path) -> float:
    """Measure MediaPipe's seconds a frame on one clip, one thread."""
    from engine.datatypes import ignore_progress
    from engine.pipeline import estimate_view

    video = next(iter(find_videos(data / "synthetic_lifts", ("P07",))))
    pose = estimate_view(View(video), Config(pose=PoseConfig(threads=1)), ignore_progress)
    return round(pose.model_time_s / pose.image.n_frames, 4)


def run(options: argparse.Namespace) -> tuple[pd.DataFrame, Clip | None, dict]:
    """Measure every estimator on every clip; rows, and a clip with its curves to draw."""
    rows, profile, curves = [], None, {}
    clips = [
        *read_lift_clips(options.data, options.cache, options.persons, options.every),
        *read_reference_clips(options.data),
        *read_real_clips(options.data, options.cache),
    ]
    for clip in clips:
        for name in options.estimators:
            if name == "mediapipe" and not clip.has_body:
                continue
            found, profiles = measure(clip, name, options.solver)
            rows += found
            if clip.truth_s is not None and clip.has_body and profile in (None, clip):
                profile, curves[name] = clip, profiles
        print(clip.name, flush=True)
    return pd.DataFrame(rows), profile, curves


def main() -> None:
    """Run the comparison and print the tables."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--data", type=Path, default=Path("../shared/data"))
    parser.add_argument("--cache", type=Path, default=Path(".benchmark_cache/monocular_lifts"))
    parser.add_argument("--persons", nargs="*", default=list(TEST_PERSONS))
    parser.add_argument("--estimators", nargs="*", default=list(ESTIMATORS))
    parser.add_argument("--solver", default="least-squares")
    parser.add_argument("--every", type=int, default=1, help="take every n-th synthetic video")
    parser.add_argument("--out", type=Path, help="text file; .csv and .png are put beside it")
    parser.add_argument("--rows", type=Path, help="make the tables from an earlier run's .csv")
    options = parser.parse_args()
    if options.rows:
        table, profile, curves = pd.read_csv(options.rows), None, {}
    else:
        table, profile, curves = run(options)
    head = (
        "Estimators with our own weights (published accuracies belong to other weights). "
        f"Synthetic persons {', '.join(options.persons)} (every {options.every}. video); reference "
        "recordings; real clips. Angles never seen in a clip are left out of its average. "
        f"Solver {options.solver}.\nCommand: benchmarks/estimators.py; {platform.machine()}, "
        f"Python {platform.python_version()}; seeds fixed in the estimators."
    )
    text = f"{head}\n\n{summarise(table, time_landmarks(options.data))}\n"
    print("\n" + text)
    if options.out:
        options.out.write_text(text, encoding="utf-8")
        table.to_csv(options.out.with_suffix(".csv"), index=False, float_format="%.4g")
        if profile is not None:
            draw_profiles(profile, curves, options.out.with_suffix(".png"))


if __name__ == "__main__":
    main()
