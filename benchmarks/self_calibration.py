"""How well two cameras are calibrated from the moving person, without a board.

Run from the project folder::

    .venv/bin/python benchmarks/self_calibration.py --data ../shared/data/synthetic_lifts
    .venv/bin/python benchmarks/self_calibration.py --real ../shared/data/real_four_view
    .venv/bin/python benchmarks/self_calibration.py --verdict --every 4

Both videos of every synthetic lift are calibrated from keypoints and stature alone and compared
with the exact cameras; joints triangulated with the found cameras are compared with joints
triangulated with the exact ones, each laid over the truth by one rigid motion for the whole clip
(no scaling). On the real clip of four cameras joints are laid over those of the given calibration
in the same way; the person's stature is not known there, so an assumed one gives the lengths.
Keypoints come from the cache that benchmarks/monocular_lifts.py fills. Nothing in the product was
chosen on the persons P07 and P08 or on the real clip.

With ``--verdict`` the checks are tried on exact calibrations, on the found ones, and on
calibrations made wrong in known ways (seed 0): how many are amber or red, and how many red.

Seconds are those of one processor core. A stated standard error holds if the error stays within
1.96 of it: for directions and places the norm over the axes, against the norm of the standard
errors.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import platform
import sys
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from pathlib import Path

import cv2
import numpy as np
import pandas as pd
from monocular_lifts import TEST_PERSONS, load_pose
from threadpoolctl import threadpool_limits
from two_view_data import cut_view, delay_second

from engine import Config
from engine.cameras.files.reading import adapt_to_pictures, read_calibration
from engine.cameras.self_calibration import calibrate_from_person
from engine.cameras.triangulation import triangulate
from engine.cameras.verdict import check_calibration, summarise_checks
from engine.datatypes import (
    Array,
    Calibration,
    Camera,
    CheckLevel,
    Measurement,
    ViewPose,
)
from engine.errors import CalibrationError
from engine.skeletons import MEDIAPIPE_33

CAMERAS = ("cam90", "cam135")
JOINTS = tuple(
    f"{side}_{name}"
    for name in ("shoulder", "elbow", "wrist", "hip", "knee", "ankle")
    for side in ("left", "right")
)
COLUMNS = [MEDIAPIPE_33.index(name) for name in JOINTS]
REAL_STATURE = Measurement(1.75, 0.10)
"""Nobody knows the real person's: an assumed stature with its wide error."""


@dataclass(frozen=True)
class Clip:
    """Both views of one trial with the exact cameras and joints (T, 12, 3), None if unknown."""

    name: str
    views: tuple[ViewPose, ...]
    cameras: tuple[Camera, ...]
    stature: Measurement
    joints: Array | None
    up: Array
    floor_m: float


def read_cameras(person: Path) -> tuple[tuple[Camera, ...], float]:
    """Return the exact cameras of one synthetic person, and the stature."""
    values = json.loads((person / "subject.json").read_text())
    cameras = tuple(
        Camera(
            c["name"],
            (c["width"], c["height"]),
            np.array(c["K"]),
            np.array(c["R"]),
            np.array(c["t"]),
        )
        for c in values["calibration"]
    )
    return cameras, values["height_m"]


def read_joints(folder: Path, time_s: Array) -> Array:
    """Return the exact joints at the video's times, shape (T, 12, 3), m."""
    with np.load(folder / "truth.npz", allow_pickle=False) as data:
        names, stored, joints = list(data["joint_names"]), data["time"], data["joints"]
    rows = []
    for name in JOINTS:
        side, part = name.split("_", 1)
        track = joints[:, names.index(f"{part}_{side[0].upper()}")]
        rows.append(np.stack([np.interp(time_s, stored, axis) for axis in track.T], axis=1))
    return np.stack(rows, axis=1)


def find_clips(data: Path, cache: Path, persons: Sequence[str], every: int = 1) -> Iterator[Clip]:
    """List the synthetic trials with both views."""
    folders = [f for p in persons for f in sorted((data / p).glob(f"{p}_*"))]
    for folder in folders[::every]:
        cameras, stature = read_cameras(folder.parent)
        views = tuple(load_pose(folder / f"{c}.mp4", cache, Config()) for c in CAMERAS)
        joints = read_joints(folder, np.asarray(views[0].image.time_s))
        up = np.array([0.0, 1.0, 0.0])
        yield Clip(folder.name, views, cameras, Measurement(stature, 0.01), joints, up, 0.0)


def relative_pose(cameras: Sequence[Camera]) -> tuple[Array, Array]:
    """Return rotation and translation of the second camera relative to the first."""
    first, second = cameras
    rotation = second.rotation @ first.rotation.T
    return rotation, second.translation - rotation @ first.translation


def turn_deg(rotation: Array) -> float:
    """Return the angle of a rotation, degrees."""
    return float(np.degrees(np.arccos(np.clip((np.trace(rotation) - 1.0) / 2.0, -1.0, 1.0))))


def between_deg(a: Array, b: Array) -> float:
    """Return the angle between two directions, degrees."""
    cosine = a @ b / (np.linalg.norm(a) * np.linalg.norm(b))
    return float(np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0))))


def fit_similarity(points: Array, target: Array) -> tuple[float, Array, Array]:
    """Return scale, rotation and shift that lay points (N, 3) over a target (N, 3)."""
    middle, aim = points.mean(axis=0), target.mean(axis=0)
    u, s, vt = np.linalg.svd((target - aim).T @ (points - middle))
    flip = np.array([1.0, 1.0, np.linalg.det(u @ vt)])
    rotation = u @ np.diag(flip) @ vt
    scale = float((s * flip).sum() / ((points - middle) ** 2).sum())
    return scale, rotation, aim - rotation @ middle


def joint_errors(track: Array, truth: Array) -> tuple[Array, float, Array]:
    """Return distances (T, 12) in mm after one rigid motion, the scale, and the motion."""
    known = np.isfinite(track).all(axis=-1) & np.isfinite(truth).all(axis=-1)
    scale, rotation, shift = fit_similarity(track[known], truth[known])
    distance = np.linalg.norm(track @ rotation.T + shift - truth, axis=-1)
    return 1000.0 * distance, scale, rotation


def triangulate_joints(clip: Clip, cameras: Sequence[Camera]) -> Array:
    """Return the joints seen by both views, shape (T, 12, 3), m."""
    found = triangulate(clip.views, cameras, stature_m=clip.stature.value)
    return np.asarray(found.track.position)[:, COLUMNS]


def measure(clip: Clip) -> dict[str, float | str]:
    """Calibrate one clip and compare it with the known cameras."""
    row: dict[str, float | str] = {"trial": clip.name, "refused": ""}
    start = time.process_time()
    try:
        found = calibrate_from_person(clip.views, clip.stature)
    except CalibrationError as error:
        return row | {"refused": str(error)}
    row["seconds"] = time.process_time() - start
    row |= compare_cameras(clip, found)
    given = triangulate_joints(clip, clip.cameras)
    own = triangulate_joints(clip, found.cameras)
    reference = given if clip.joints is None else clip.joints
    own_mm, scale, rotation = joint_errors(own, reference)
    given_mm, _, _ = joint_errors(given, reference)
    both = np.isfinite(own_mm) & np.isfinite(given_mm)
    row["given mm"], row["own mm"] = given_mm[both].mean(), own_mm[both].mean()
    row["ratio"] = row["own mm"] / row["given mm"] if clip.joints is not None else np.nan
    row["scale %"] = 100.0 * (1.0 / scale - 1.0)
    row["shape mm"] = joint_errors(own, given)[0][both].mean()
    row["tilt deg"] = between_deg(rotation @ found.up, clip.up)
    row["stated joint mm"] = 1000.0 * found.provenance["joint_sigma_m"]
    row["floor cm"] = 100.0 * floor_error(clip, found, own, given)
    return row | state_coverage(row, found)


def floor_error(clip: Clip, found: Calibration, own: Array, given: Array) -> float:
    """Return how much too high the floor lies below the ankles, m."""
    ankles = [JOINTS.index("left_ankle"), JOINTS.index("right_ankle")]
    below = np.nanmedian(own[:, ankles] @ found.up) - found.floor_m
    return float(np.nanmedian(given[:, ankles] @ clip.up) - clip.floor_m - below)


def compare_cameras(clip: Clip, found: Calibration) -> dict[str, float]:
    """Return the errors of the relative pose and of the focal lengths."""
    rotation, translation = relative_pose(found.cameras)
    true_rotation, true_translation = relative_pose(clip.cameras)
    focal = [
        100.0 * (own.matrix[0, 0] / true.matrix[0, 0] - 1.0)
        for own, true in zip(found.cameras, clip.cameras, strict=True)
    ]
    return {
        "rotation deg": turn_deg(rotation @ true_rotation.T),
        "baseline deg": between_deg(translation, true_translation),
        "baseline cm": 100.0 * float(np.linalg.norm(translation - true_translation)),
        "focal 1 %": focal[0],
        "focal 2 %": focal[1],
        "stated rotation deg": np.sqrt(3.0) * found.provenance["pose_rotation_sigma_deg"],
        "stated baseline cm": 100.0 * np.sqrt(3.0) * found.provenance["pose_translation_sigma_m"],
        "stated focal %": found.provenance["focal_sigma_percent"],
        "misfit %": found.provenance["misfit_percent"],
    }


def state_coverage(row: dict[str, float | str], found: Calibration) -> dict[str, bool]:
    """Return which errors stay within 1.96 stated standard errors."""
    stated = {
        "rotation deg": np.sqrt(3.0) * found.provenance["pose_rotation_sigma_deg"],
        "baseline cm": 100.0 * np.sqrt(3.0) * found.provenance["pose_translation_sigma_m"],
        "focal 1 %": found.provenance["focal_sigma_percent"],
        "focal 2 %": found.provenance["focal_sigma_percent"],
        "scale %": 100.0 * found.scale_sigma,
        "tilt deg": np.sqrt(2.0) * found.tilt_sigma_deg,
        "floor cm": 100.0 * found.floor_sigma_m,
    }
    return {f"in {key}": abs(float(row[key])) <= 1.96 * sigma for key, sigma in stated.items()}


def find_real_clips(data: Path, cache: Path) -> Iterator[Clip]:
    """List all pairs of the real clip's four cameras."""
    names = [f"cam0{i}" for i in range(1, 5)]
    views = [load_pose(data / f"{n}.mp4", cache, Config()) for n in names]
    given = read_calibration(data / "Calib.qca.txt", names=names)
    given, _ = adapt_to_pictures(given, [v.info.size_px for v in views])
    for i, j in combinations(range(4), 2):
        yield Clip(
            name=f"{names[i]}-{names[j]}",
            views=(views[i], views[j]),
            cameras=(given.cameras[i], given.cameras[j]),
            stature=REAL_STATURE,
            joints=None,
            up=np.asarray(given.up),
            floor_m=given.floor_m,
        )


def run(clips: Iterator[Clip], rows_file: Path | None) -> pd.DataFrame:
    """Measure all clips, going on where an interrupted run stopped."""
    rows: list[dict] = []
    if rows_file is not None and rows_file.exists():
        rows = pd.read_csv(rows_file, keep_default_na=False, na_values=["nan", "NaN"]).to_dict(
            "records"
        )
    done = {row["trial"] for row in rows}
    for clip in clips:
        if clip.name in done:
            continue
        rows.append(measure(clip))
        print(_line(rows[-1]), file=sys.stderr, flush=True)
        if rows_file is not None:
            pd.DataFrame(rows).to_csv(rows_file, index=False, float_format="%.3f")
    return pd.DataFrame(rows)


def _line(row: dict) -> str:
    if row["refused"]:
        return f"{row['trial']}: refused: {row['refused']}"
    keys = ("rotation deg", "scale %", "tilt deg", "given mm", "own mm", "shape mm", "seconds")
    return f"{row['trial']}: " + ", ".join(f"{k} {row[k]:.2f}" for k in keys)


ERRORS = (
    "rotation deg",
    "baseline deg",
    "baseline cm",
    "focal 1 %",
    "focal 2 %",
    "scale %",
    "tilt deg",
    "floor cm",
)


def summarise(rows: pd.DataFrame) -> str:
    """Return the tables, training and test persons apart."""
    rows = rows.copy()
    rows["persons"] = ["test" if t[:3] in TEST_PERSONS else "training" for t in rows["trial"]]
    found = rows[rows["refused"] == ""]
    groups = found.groupby("persons")
    absolute = groups[list(ERRORS)].agg(lambda v: v.astype(float).abs().mean()).round(2)
    signed = groups[list(ERRORS)].agg(lambda v: v.astype(float).mean()).round(2)
    inside = groups[[c for c in rows if c.startswith("in ")]].agg(
        lambda v: (v.astype(str) == "True").mean()
    )
    joints = groups.agg(
        clips=("trial", "size"),
        given_mm=("given mm", "mean"),
        own_mm=("own mm", "mean"),
        ratio=("ratio", "mean"),
        ratio_p95=("ratio", lambda v: v.quantile(0.95)),
        ratio_max=("ratio", "max"),
        above_1_3=("ratio", lambda v: int((v > 1.3).sum())),
        shape_mm=("shape mm", "mean"),
        stated_joint_mm=("stated joint mm", "mean"),
        seconds=("seconds", "mean"),
        seconds_max=("seconds", "max"),
    )
    stated = groups[["stated rotation deg", "stated baseline cm", "stated focal %"]].mean()
    failing = found[(found["ratio"] > 1.3) | (found["rotation deg"] > 6.0)]
    columns = ["trial", "rotation deg", "scale %", "tilt deg", "given mm", "own mm", "ratio"]
    parts = (
        ("Mean error of 12 joints, one rigid motion a clip", joints.round(2)),
        ("Mean absolute errors of the cameras", absolute),
        ("Mean signed errors", signed),
        ("Stated standard errors (norm over the axes)", stated.round(2)),
        ("Share of errors within 1.96 stated standard errors", inside.round(2)),
        ("Rows beyond 1.3 times the given calibration or 6 degrees", failing[columns].round(2)),
        ("Refused", rows.loc[rows["refused"] != "", ["trial", "refused"]]),
    )
    return "\n\n".join(
        f"{title}\n{table.to_string() if len(table) else 'none'}" for title, table in parts
    )


def turn_camera(camera: Camera, degrees: Array) -> Camera:
    """Turn a camera about its own centre."""
    turn, _ = cv2.Rodrigues(np.radians(degrees))
    return replace(camera, rotation=turn @ camera.rotation, translation=turn @ camera.translation)


def zoom_camera(camera: Camera, factor: float) -> Camera:
    """Make a camera's focal length wrong."""
    matrix = np.array(camera.matrix)
    matrix[[0, 1], [0, 1]] *= factor
    return replace(camera, matrix=matrix)


def list_wrong(clip: Clip, rng: np.random.Generator) -> Iterator[tuple[str, Calibration]]:
    """List the exact calibration of a clip, and wrong ones."""
    first, second = clip.cameras
    exact = exact_calibration(clip)
    yield "exact", exact
    for degrees in (1, 2, 3, 5, 10):
        axis = rng.standard_normal(3)
        turned = turn_camera(second, degrees * axis / np.linalg.norm(axis))
        yield f"one camera turned {degrees} deg", replace(exact, cameras=(first, turned))
    for scale in (0.9, 0.95, 1.05, 1.1):
        moved = [replace(c, translation=scale * c.translation) for c in clip.cameras]
        yield f"lengths x {scale}", replace(exact, cameras=tuple(moved))
    yield "cameras exchanged", replace(exact, cameras=(second, first))
    for factor in (0.7, 0.85, 1.2, 1.4):
        zoomed = tuple(zoom_camera(c, factor) for c in clip.cameras)
        yield f"focal lengths x {factor}", replace(exact, cameras=zoomed)
    for height in (0.03, 0.06, 0.10):
        yield f"floor {100 * height:.0f} cm high", replace(exact, floor_m=height)
    for degrees in (3, 6, 10, 15):
        axis = rng.standard_normal(2)
        axis = np.radians(degrees) * axis / np.linalg.norm(axis)
        turn, _ = cv2.Rodrigues(np.array([axis[0], 0.0, axis[1]]))
        yield f"up {degrees} deg off", replace(exact, up=turn @ clip.up)


def try_verdict(clips: Iterator[Clip]) -> pd.DataFrame:
    """Check right and wrong calibrations of every clip, and join views of different lifts."""
    rng = np.random.default_rng(0)
    rows = []
    every = list(clips)
    for i, clip in enumerate(every):
        persons = "test" if clip.name[:3] in TEST_PERSONS else "training"
        tried = list(list_wrong(clip, rng))
        with contextlib.suppress(CalibrationError):
            tried.append(("found from the person", calibrate_from_person(clip.views, clip.stature)))
        for kind, calibration in tried:
            rows.append(_judge(kind, persons, clip.views, calibration, clip.stature))
        for frames in (1, 2, 3):
            kind = f"second video {frames} frames late"
            late = delay_second(clip.views, frames)
            rows.append(_judge(kind, persons, late, tried[0][1], clip.stature))
        group = [c for c in every if (c.name[:3] in TEST_PERSONS) == (persons == "test")]
        other = group[(group.index(clip) + 1 + i % 2) % len(group)]
        rows.append(
            _judge(OTHER_CAMERAS, persons, clip.views, exact_calibration(other), clip.stature)
        )
        rows.append(_join(clip, other, persons))
        print(clip.name, file=sys.stderr, flush=True)
    return pd.DataFrame(rows)


OTHER_CAMERAS = "another clip's cameras (nearly the same places)"
DIFFERENT_LIFTS = "calibrating from videos of different lifts"


def exact_calibration(clip: Clip) -> Calibration:
    """Return the exact calibration of a clip."""
    return Calibration(clip.cameras, "file", clip.up, clip.floor_m)


def _join(clip: Clip, other: Clip, persons: str) -> dict[str, object]:
    """Try to calibrate from two videos of different lifts, which must be refused."""
    count = min(clip.views[0].image.n_frames, other.views[1].image.n_frames)
    time_s = np.asarray(clip.views[0].image.time_s)[:count]
    views = tuple(
        cut_view(view, slice(0, count), time_s) for view in (clip.views[0], other.views[1])
    )
    try:
        found = calibrate_from_person(views, clip.stature)
    except CalibrationError:
        row = {"doubted": True, "red": True, "named": "refused"}
        return {"kind": DIFFERENT_LIFTS, "persons": persons, **row}
    return _judge(DIFFERENT_LIFTS, persons, views, found, clip.stature)


def _judge(
    kind: str,
    persons: str,
    views: Sequence[ViewPose],
    calibration: Calibration,
    stature: Measurement,
) -> dict[str, object]:
    checks = check_calibration(views, calibration, stature)
    worst = summarise_checks(checks)
    named = [c.key for c in checks if c.level is worst.level] if worst.level != "green" else []
    return {
        "kind": kind,
        "persons": persons,
        "doubted": worst.level is not CheckLevel.GREEN,
        "red": worst.level is CheckLevel.RED,
        "named": named[0] if named else "",
    }


def show_verdict(rows: pd.DataFrame) -> str:
    """Return per kind the share doubted (amber or red), the share red, and what is named first."""
    groups = rows.groupby(["kind", "persons"], sort=False)
    table = groups.agg(
        clips=("red", "size"),
        doubted=("doubted", "mean"),
        red=("red", "mean"),
        named_most=("named", lambda v: v.mode().iloc[0]),
    )
    return table.unstack("persons").round(2).to_string()


def show_real(rows: pd.DataFrame) -> str:
    """Return one column a pair; nobody knows the true joints, so only differences are shown."""
    hidden = ["given mm", "own mm", "ratio"]
    hidden += ["refused"] if (rows["refused"] == "").all() else []
    shown = rows.drop(columns=[c for c in hidden if c in rows])
    return shown.set_index("trial").T.to_string(float_format=lambda v: f"{v:.2f}")


def main() -> None:
    """Run the comparison and print the tables."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--data", type=Path, default=Path("../shared/data/synthetic_lifts"))
    parser.add_argument("--real", type=Path, help="measure on this real clip instead")
    parser.add_argument("--verdict", action="store_true", help="try the checks instead")
    parser.add_argument("--cache", type=Path, default=Path(".benchmark_cache"))
    parser.add_argument("--persons", nargs="*", help="for example P01 P07; all if left out")
    parser.add_argument("--every", type=int, default=1, help="only every n-th trial")
    parser.add_argument("--rows", type=Path, help="one line a trial; a run goes on from there")
    options = parser.parse_args()
    persons = options.persons or sorted(p.name for p in options.data.glob("P*"))
    with threadpool_limits(limits=1, user_api="blas"):
        if options.real:
            clips = find_real_clips(options.real, options.cache / "real_four_view")
        else:
            cache = options.cache / "monocular_lifts"
            clips = find_clips(options.data, cache, persons, options.every)
        rows = try_verdict(clips) if options.verdict else run(clips, options.rows)
    print(
        f"Self-calibration of two views. {platform.machine()}, "
        f"Python {platform.python_version()}, one thread; seed 0 for "
        "the wrong calibrations, else no random numbers.\n"
        f"{' '.join(['benchmarks/self_calibration.py', *sys.argv[1:]])}\n"
    )
    if options.verdict:
        print(show_verdict(rows))
    else:
        print(show_real(rows) if options.real else summarise(rows))


if __name__ == "__main__":
    main()
