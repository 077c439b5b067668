"""How well two cameras measure lifts, on synthetic trials with exact truth and on a real clip.

Run from the project folder::

    python benchmarks/two_view.py main
    python benchmarks/two_view.py calibration
    python benchmarks/two_view.py ablations
    python benchmarks/two_view.py sync
    python benchmarks/two_view.py real
    python benchmarks/two_view.py speed

`main` takes all trials, the others the first repetition of each task. Keypoints come from the
cache of `monocular_lifts.py`. Nothing in the product was chosen on the persons P07 and P08 or on
the real clip. Joint errors are distances from true joint centres in the calibrated world, after a
rigid alignment of the whole clip where the cameras were calibrated from the person. The estimator
means other points than joint centres: `definition` columns move its points by an offset that is
fixed in the segment and was learned on the training persons. The product never does that.

An interrupted run goes on where it stopped; ``--fresh`` starts over.
"""

from __future__ import annotations

import argparse
import platform
import sys
import time
import warnings
from collections.abc import Callable, Iterable, Sequence
from dataclasses import asdict, dataclass, replace
from itertools import combinations
from pathlib import Path

import numpy as np
import pandas as pd
from monocular_lifts import (
    LOAD_KG,
    TEST_PERSONS,
    Truth,
    compare_lift,
    compare_rwl,
    load_pose,
    read_truth,
)
from threadpoolctl import threadpool_limits
from two_view_data import (
    CAMERAS,
    COLUMNS,
    FAR,
    JOINTS,
    NEAR,
    REAL_CAMERAS,
    align_rigidly,
    correct_definition,
    cut_view,
    delay_second,
    learn_definition,
    list_trials,
    make_symmetric,
    read_given_calibration,
    read_pelvic_hip_flexion,
    read_real_calibration,
    read_true_joints,
    true_shoulder_flexion,
)

from engine import Config, Subject, Task
from engine.cameras.triangulation import triangulate
from engine.cameras.two_view import place_in_world
from engine.config import CorrectionConfig
from engine.correction.chain import correct_track
from engine.datatypes import (
    Array,
    Calibration,
    JointAngles,
    Lift,
    PoseTrack,
    ViewPose,
    WorldScene,
)
from engine.ergonomics.assess import assess_risk
from engine.ergonomics.base import Exposure
from engine.errors import EngineError
from engine.kinematics.events import LiftFindings, detect_lifts
from engine.kinematics.fitting.base import add_scene_errors, select_solver
from engine.optics import camera_centre
from engine.skeletons import MEDIAPIPE_33

ANGLES = (
    "trunk_inclination",
    "hip_flexion",
    "knee_flexion",
    "elbow_flexion",
    "shoulder_flexion",
)
TASK = Task(
    load_kg=LOAD_KG,
    coupling="good",
    frequency_per_min=0.2,
    duration_h=1.0,
    destination_control=True,
)
FRAME_S = 1.0 / 30.0


@dataclass(frozen=True)
class Variant:
    """One way to go from two views to a result."""

    name: str
    fusion: str = "triangulate"
    correction: str = "default"
    solver: str = "geometric"
    calibration: str = "given"
    is_weighted: bool = True
    repair_labels: bool = True
    use_body: bool = True
    late_frames: int = 0
    is_sync_repaired: bool = False


PLAIN = {"is_weighted": False, "repair_labels": False, "use_body": False}
SUITES: dict[str, tuple[Variant, ...]] = {
    "main": (
        Variant("plain DLT, raw", correction="none", **PLAIN),
        Variant("plain DLT", **PLAIN),
        Variant("triangulated, raw", correction="none"),
        Variant("triangulated"),
        Variant("triangulated, least squares", solver="least-squares"),
        Variant("model", fusion="model"),
    ),
    "calibration": (
        Variant("triangulated"),
        Variant("self-calibrated", calibration="self"),
        Variant("model", fusion="model"),
        Variant("self-calibrated, model", calibration="self", fusion="model"),
    ),
    "ablations": (
        Variant("triangulated, raw", correction="none"),
        Variant("no weights, raw", correction="none", is_weighted=False),
        Variant("no label repair, raw", correction="none", repair_labels=False),
        Variant("no body, raw", correction="none", use_body=False),
        Variant("neither, raw", correction="none", **PLAIN),
        Variant("triangulated"),
        Variant("no weights", is_weighted=False),
        Variant("no body", use_body=False),
        Variant("neither", **PLAIN),
    ),
    "sync": (
        Variant("synchronous"),
        *(
            Variant(
                f"{n} late{', repaired' if fixed else ''}", late_frames=n, is_sync_repaired=fixed
            )
            for n in (1, 3, 5)
            for fixed in (False, True)
        ),
    ),
}


@dataclass(frozen=True, eq=False)
class Outcome:
    """What one variant says of one trial; `joints` (T, 12, 3) and their errors in true axes."""

    track: PoseTrack
    joints: Array
    sigma: Array
    angles: JointAngles
    scene: WorldScene
    findings: LiftFindings
    shares: dict[str, float]


def run_variant(
    variant: Variant, views: Sequence[ViewPose], given: Calibration, subject: Subject
) -> Outcome:
    """Go from keypoints to lifts, as the product does."""
    views = delay_second(views, variant.late_frames)
    if variant.is_sync_repaired:
        views = repair_sync(views)
    calibration = given
    if variant.calibration == "self":
        from engine.cameras.self_calibration import calibrate_from_person

        calibration = calibrate_from_person(views, subject.stature)
    found = triangulate(
        views,
        calibration.cameras,
        stature_m=subject.stature.value,
        rotation_sigma_deg=calibration.rotation_sigma_deg,
        translation_sigma_m=calibration.translation_sigma_m,
        is_weighted=variant.is_weighted,
        repair_labels=variant.repair_labels,
        use_body=variant.use_body,
    )
    placed = place_in_world(found, calibration, subject.stature)
    raw, scene = placed.found.track, placed.scene
    corrected = correct(raw, subject, preset=variant.correction)
    if variant.fusion == "model":
        from engine.kinematics.fusion import fuse_views

        start = correct(raw, subject, min_confidence=0.0)
        fused = fuse_views(views, placed.calibration.cameras, start, subject)
        corrected, fit = fused.track, fused.fit
    else:
        fit = select_solver(variant.solver).fit(corrected, subject)
    angles = add_scene_errors(fit.angles, scene)
    hands = corrected if variant.fusion == "model" else correct(raw, subject, min_confidence=0.0)
    findings = detect_lifts(
        hands, angles, scene, stature_m=subject.stature.value, **asdict(Config().events)
    )
    return Outcome(
        track=corrected,
        joints=back_to_given(corrected, placed.calibration, calibration),
        sigma=np.asarray(corrected.sigma)[:, COLUMNS],
        angles=angles,
        scene=scene,
        findings=findings,
        shares={"n_views": float((found.n_views[:, COLUMNS] == 2).mean())},
    )


def correct(track: PoseTrack, subject: Subject, **settings: object) -> PoseTrack:
    """Run the product's correction."""
    options = asdict(CorrectionConfig()) | settings
    return correct_track(track, stature_m=subject.stature.value, **options)


def repair_sync(views: Sequence[ViewPose]) -> tuple[ViewPose, ...]:
    """Find the offset from the movement, and bring the views together."""
    from engine.video.sync import estimate_offset, resample_views

    synced = resample_views(views, estimate_offset(*views))
    times = np.asarray(synced.views[0].image.time_s) + synced.start_in_first_s
    return tuple(cut_view(view, slice(None), times) for view in synced.views)


def back_to_given(track: PoseTrack, turned: Calibration, calibration: Calibration) -> Array:
    """Return the 12 joints in the world that the calibration came in."""
    before, after = calibration.cameras[0], turned.cameras[0]
    points = np.asarray(track.position)[:, COLUMNS]
    turn = before.rotation.T @ after.rotation
    return (points - camera_centre(after)) @ turn.T + camera_centre(before)


def measure(outcome: Outcome, folder: Path, truth: Truth, variant: Variant) -> dict:
    """Compare with the truth."""
    true = read_true_joints(folder, np.asarray(outcome.track.time_s))
    joints = outcome.joints
    aligned = align_rigidly(joints, true)
    if variant.calibration == "self":
        joints = aligned
    distance = 1000 * np.linalg.norm(joints - true, axis=2)
    row: dict = {
        "mm": np.nanmean(distance),
        "near mm": np.nanmean(distance[:, NEAR]),
        "far mm": np.nanmean(distance[:, FAR]),
        "aligned mm": 1000 * np.nanmean(np.linalg.norm(aligned - true, axis=2)),
        "joints share": np.isfinite(distance).mean(),
        "joints in 95 %": inside_share(joints, true, outcome.sigma),
        "two views share": outcome.shares["n_views"],
        **{f"mm {n}": np.nanmean(distance[:, j]) for j, n in enumerate(JOINTS)},
        **measure_angles(outcome.angles, truth, true_angles(folder, variant)),
        "lifts": len(outcome.findings.lifts),
    }
    return row | measure_lift(outcome, truth)


def inside_share(joints: Array, true: Array, sigma: Array) -> float:
    """Return the share of coordinates within 1.96 standard errors."""
    z = np.abs(joints - true) / sigma[..., None]
    return float((z[np.isfinite(z)] <= 1.96).mean())


def true_angles(folder: Path, variant: Variant) -> dict[str, Array]:
    """Return the true curves of `ANGLES`, hips against what the variant measures them against."""
    truth = read_truth(folder)
    curves = truth.angles | true_shoulder_flexion(read_true_joints(folder, truth.time_s))
    if variant.solver != "geometric" or variant.fusion == "model":
        curves |= read_pelvic_hip_flexion(folder)
    return curves


def measure_angles(angles: JointAngles, truth: Truth, curves: dict[str, Array]) -> dict[str, float]:
    """Return mean absolute errors while the person moves and in all frames, degrees."""
    time_s = np.asarray(angles.time_s)
    is_moving = (time_s >= truth.motion_s[0]) & (time_s <= truth.motion_s[1])
    row: dict[str, float] = {}
    for name in ANGLES:
        keys = [k for k in curves if k.startswith(name) and k in angles.names]
        true = np.stack([np.interp(time_s, truth.time_s, curves[k]) for k in keys])
        error = (np.stack([angles[k] for k in keys]) - true + 180.0) % 360.0 - 180.0
        inside = np.abs(error) <= 1.96 * np.stack([angles.sigma(k) for k in keys])
        known = np.isfinite(error)
        moving = known & is_moving
        row[f"{name} deg"] = float(np.abs(error[moving]).mean()) if moving.any() else np.nan
        row[f"{name} all"] = float(np.abs(error[known]).mean()) if known.any() else np.nan
        row[f"{name} share"] = float(moving.sum() / max(is_moving.sum() * len(keys), 1))
        row[f"{name} in 95 %"] = float(inside[moving].mean()) if moving.any() else np.nan
    return row


def measure_joints(joints: Array, time_s: Array, folder: Path) -> dict[str, float]:
    """Return the angle errors of joints (T, 12, 3) in a world with Y up."""
    position = np.full((len(joints), len(MEDIAPIPE_33.keypoints), 3), np.nan)
    position[:, COLUMNS] = joints
    track = PoseTrack(time_s, position, "m", "world", "mediapipe_33")
    angles = select_solver("geometric").fit(track, Subject()).angles
    return measure_angles(angles, read_truth(folder), true_angles(folder, Variant("")))


def measure_lift(outcome: Outcome, truth: Truth) -> dict[str, float]:
    """Return errors of the lift nearest to the true one, and of its weight limit."""
    lifts = outcome.findings.lifts
    if not lifts:
        return {}
    off = [abs(x.start_s - truth.lift_s[0]) + abs(x.end_s - truth.lift_s[1]) for x in lifts]
    nearest = int(np.argmin(off))
    row = compare_lift(lifts[nearest], truth)
    row |= limit_errors(outcome, lifts[nearest], nearest, truth)
    return row


def limit_errors(outcome: Outcome, lift: Lift, index: int, truth: Truth) -> dict[str, float]:
    """Return errors of the recommended weight limit; none where the equation refuses the lift."""
    exposure = Exposure(
        track=outcome.track,
        angles=outcome.angles,
        lifts=outcome.findings.lifts,
        subject=Subject(stature_m=truth.stature_m),
        task=TASK,
        observed_s=float(outcome.track.time_s[-1] - outcome.track.time_s[0]),
        conditions=outcome.findings.conditions,
    )
    limit = assess_risk(exposure, methods=("rnle",))["rnle"].per_lift[index]
    refused = {"refused": float(not limit.is_applicable)}
    return refused | (compare_rwl(limit.details, truth) if limit.is_applicable else {})


def run_suite(suite: str, options: argparse.Namespace) -> pd.DataFrame:
    """Run all variants on all trials; finished ones come from the cache."""
    persons = options.persons or sorted(p.name for p in options.data.glob("P*"))
    store = options.cache / "two_view"
    store.mkdir(parents=True, exist_ok=True)
    rows = []
    for folder in list_trials(options.data, persons):
        if suite != "main" and not folder.name.endswith("_01"):
            continue
        views, truth = None, read_truth(folder)
        for variant in SUITES[suite]:
            if options.variants and variant.name not in options.variants:
                continue
            file = store / f"{variant.name.replace(' ', '-').replace(',', '')}_{folder.name}.npz"
            if file.exists() and not options.fresh:
                rows.append(read_row(file))
                continue
            views = views or load_views(folder, options.cache / "monocular_lifts")
            row = run_one(variant, views, folder, truth, file)
            rows.append(row)
        print(folder.name, flush=True, file=sys.stderr)
    return pd.DataFrame(rows)


def load_views(folder: Path, cache: Path) -> tuple[ViewPose, ...]:
    """Return the keypoints of both cameras."""
    return tuple(load_pose(folder / f"{name}.mp4", cache, Config()) for name in CAMERAS)


def run_one(
    variant: Variant, views: Sequence[ViewPose], folder: Path, truth: Truth, file: Path
) -> dict:
    """Run one variant on one trial, and keep row and joints."""
    subject = Subject(stature_m=truth.stature_m)
    row: dict = {
        "variant": variant.name,
        "trial": folder.name,
        "persons": "test" if folder.name[:3] in TEST_PERSONS else "training",
        "error": "",
    }
    joints = true = np.full((1, 12, 3), np.nan)
    time_s = np.zeros(1)
    try:
        outcome = run_variant(variant, views, read_given_calibration(folder.parent), subject)
    except ImportError as error:
        return row | {"error": f"not there: {error.name}"}
    except EngineError as error:
        row["error"] = f"{type(error).__name__}: {error}"
    else:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", RuntimeWarning)  # means of nothing are NaN
            row |= measure(outcome, folder, truth, variant)
        time_s = np.asarray(outcome.track.time_s)
        true = read_true_joints(folder, time_s)
        joints = outcome.joints
        if variant.calibration == "self":
            joints = align_rigidly(joints, true)
    part = file.with_suffix(".part.npz")
    known = {f"row {k}": v for k, v in row.items()}
    np.savez(part, joints=joints, true=true, time_s=time_s, **known)
    part.rename(file)
    return read_row(file)


def read_row(file: Path) -> dict:
    """Read a row, with the joints beside it."""
    with np.load(file, allow_pickle=False) as data:
        row = {k.removeprefix("row "): data[k].item() for k in data.files if k.startswith("row ")}
        return row | {name: data[name] for name in ("joints", "true", "time_s")}


def add_definition(rows: pd.DataFrame, data: Path) -> pd.DataFrame:
    """Add joint errors after moving the points to the joint centres, in two ways."""
    for _variant, part in rows.groupby("variant"):
        known = part[part["error"] == ""]
        training = known[known["persons"] == "training"]
        if not len(training):
            continue
        each = learn_definition(list(zip(training["joints"], training["true"], strict=True)))
        for name, offsets in (("definition mm", each), ("same sides mm", make_symmetric(each))):
            for index, row in known.iterrows():
                moved = correct_definition(row["joints"], offsets)
                distance = 1000 * np.linalg.norm(moved - row["true"], axis=2)
                rows.loc[index, name] = np.nanmean(distance)
                if name == "definition mm":
                    rows.loc[index, "definition near"] = np.nanmean(distance[:, NEAR])
                    rows.loc[index, "definition far"] = np.nanmean(distance[:, FAR])
                    folder = data / row["trial"][:3] / row["trial"]
                    found = measure_joints(moved, row["time_s"], folder)
                    for angle in ANGLES:
                        rows.loc[index, f"definition {angle}"] = found[f"{angle} deg"]
    return rows


def summarise(rows: pd.DataFrame, order: Sequence[Variant]) -> str:
    """Return the tables."""
    names = [v.name for v in order if v.name in set(rows["variant"])]
    bad = rows[rows["error"] != ""]
    rows = rows[rows["error"] == ""]
    groups = rows.groupby(["persons", "variant"])

    def table(make: Callable[[pd.DataFrame], object], columns: Iterable[str]) -> pd.DataFrame:
        columns = [c for c in columns if c in rows]
        found = groups[columns].agg(make)
        wanted = [(p, n) for p in ("training", "test") for n in names if (p, n) in found.index]
        return found.loc[wanted].round(2)

    mean = "mean"
    definition = ("definition mm", "definition near", "definition far", "same sides mm")
    shares = ("joints share", "joints in 95 %")
    lift = ("start_s", "end_s", "H origin", "H set-down", "V origin", "V set-down", "D")
    limit = ("A origin", "A set-down", "RWL origin", "RWL set-down", "RWL smaller")
    z_columns = [c for c in rows if c.startswith("z ")]
    parts = [
        (
            (
                "Joint error, mm: mean over 12 joints, near and far side; aligned; with definition "
                "correction (each joint its own offset; same offset on both sides)"
            ),
            table(mean, ("mm", "near mm", "far mm", "aligned mm", *definition, *shares)),
        ),
        ("Joint error by joint, mm", table(mean, [f"mm {n}" for n in JOINTS])),
        (
            "Joint angles while moving: mean absolute error, degrees",
            table(mean, [f"{n} deg" for n in ANGLES]),
        ),
        ("The same in all frames", table(mean, [f"{n} all" for n in ANGLES])),
        (
            "The same while moving, from joints with definition correction (solver geometric)",
            table(mean, [f"definition {n}" for n in ANGLES]),
        ),
        ("Share of frames with the angle", table(mean, [f"{n} share" for n in ANGLES])),
        (
            "Share of angles within 1.96 standard errors",
            table(mean, [f"{n} in 95 %" for n in ANGLES]),
        ),
        (
            "Lifts: mean absolute error (s, cm, degrees, kg)",
            table(lambda v: v.abs().mean(), (*lift, *limit)),
        ),
        ("Lifts: mean signed error", table(mean, (*lift, *limit))),
        ("Share within 1.96 standard errors", table(lambda v: (v.abs() <= 1.96).mean(), z_columns)),
        (
            "Trials, those with exactly one lift found (there is one in each), those refused",
            groups.agg(
                trials=("lifts", "size"),
                one_lift=("lifts", lambda v: int((v == 1).sum())),
                refused=("refused", "sum"),
            ),
        ),
        ("Largest joint errors and RWL errors", worst(rows, names)),
    ]
    text = "\n\n".join(f"{title}\n{body.to_string()}" for title, body in parts)
    if len(bad):
        failed = bad[["variant", "trial", "error"]].drop_duplicates()
        text += f"\n\nNot measured\n{failed.to_string(index=False)}"
    return text


def worst(rows: pd.DataFrame, names: Sequence[str]) -> pd.DataFrame:
    """Return the worst rows of the product's default and of the model."""
    shown = [n for n in ("triangulated", "model", "self-calibrated") if n in names] or names[:1]
    chosen = [
        rows[rows["variant"] == n].assign(score=lambda r: r["mm"]).nlargest(4, "score")
        for n in shown
    ]
    columns = ["variant", "trial", "mm", "far mm", "H origin", "V origin", "RWL smaller"]
    table = pd.concat(chosen)
    return table[[c for c in columns if c in table]].round(2)


def measure_real(options: argparse.Namespace) -> tuple[str, pd.DataFrame]:
    """Compare the two halves of the four cameras with each other."""
    cache = options.cache / "real_four_view"
    views = {n: load_pose(options.real / f"{n}.mp4", cache, Config()) for n in REAL_CAMERAS}
    given = read_real_calibration(options.real)
    subject = Subject()
    rows = []
    for how in options.variants or ("plain DLT", "given", "model", "self"):
        for first in combinations(range(4), 2):
            second = tuple(i for i in range(4) if i not in first)
            if first > second:
                continue
            row: dict = {"cameras": how, "pair": f"{first} {second}".replace(",", "")}
            try:
                halves = [
                    reconstruct_half(how, pair, views, given, subject) for pair in (first, second)
                ]
            except ImportError as error:
                rows.append(row | {"error": f"not there: {error.name}"})
            except EngineError as error:
                rows.append(row | {"error": f"{type(error).__name__}: {error}"})
            else:
                rows.append(row | compare_halves(*halves))
    table = pd.DataFrame(rows)
    text = table.round(2).to_string(index=False)
    numbers = table.drop(columns=["pair", *([] if "error" not in table else ["error"])])
    return (
        f"{text}\n\nMean over pairs\n{numbers.groupby('cameras').mean().round(2).to_string()}",
        table,
    )


def reconstruct_half(
    how: str,
    pair: tuple[int, int],
    views: dict[str, ViewPose],
    given: Calibration,
    subject: Subject,
) -> tuple[Array, JointAngles]:
    """Return joints (T, 12, 3) and angles from two of the four cameras."""
    seen = [views[REAL_CAMERAS[i]] for i in pair]
    calibration = replace(given, cameras=tuple(given.cameras[i] for i in pair))
    variant = Variant(
        how,
        calibration="self" if how == "self" else "given",
        fusion="model" if how == "model" else "triangulate",
        **(PLAIN if how == "plain DLT" else {}),
    )
    outcome = run_variant(variant, seen, calibration, subject)
    return outcome.joints, outcome.angles


def compare_halves(
    first: tuple[Array, JointAngles], second: tuple[Array, JointAngles]
) -> dict[str, float]:
    """Return the mean distance of joints after alignment, mm, and of angles, degrees."""
    aligned = align_rigidly(first[0], second[0])
    row = {"mm": 1000 * float(np.nanmean(np.linalg.norm(aligned - second[0], axis=2)))}
    every = []
    for name in ("trunk_inclination", "hip", "knee", "elbow", "shoulder_flexion"):
        keys = [k for k in first[1].names if k.startswith(name)]
        error = np.concatenate([np.abs(first[1][k] - second[1][k]) for k in keys])
        row[f"{name} deg"] = float(np.nanmean(np.minimum(error, 360.0 - error)))
        every.append(row[f"{name} deg"])
    return row | {"mean deg": float(np.mean(every))}


def measure_speed(options: argparse.Namespace) -> str:
    """Time triangulation of 300 frames of 33 keypoints, processor seconds."""
    folder = next(list_trials(options.data, ["P01"]))
    views = load_views(folder, options.cache / "monocular_lifts")
    given = read_given_calibration(folder.parent)
    count = 300
    order = np.resize(
        np.r_[0 : views[0].image.n_frames, views[0].image.n_frames - 1 : 0 : -1], count
    )
    time_s = np.arange(count) * FRAME_S
    long = [
        replace(
            v,
            image=replace_frames(v.image, order, time_s),
            body=replace_frames(v.body, order, time_s),
            box=v.box[order],
            state=tuple(v.state[i] for i in order),
        )
        for v in views
    ]
    times = []
    for _ in range(7):
        start = time.process_time()
        triangulate(long, given.cameras, stature_m=1.75)
        times.append(time.process_time() - start)
    return f"300 frames x 33 keypoints: {min(times):.2f} s at best, {np.median(times):.2f} s median"


def replace_frames(track: PoseTrack, order: Array, time_s: Array) -> PoseTrack:
    """Return the frames of a track in another order."""
    return PoseTrack(
        time_s,
        track.position[order],
        track.unit,
        track.frame_of_reference,
        track.skeleton,
        track.confidence[order],
    )


def main() -> None:
    """Run one part and print its tables."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("part", choices=(*SUITES, "real", "speed"))
    parser.add_argument("--data", type=Path, default=Path("../shared/data/synthetic_lifts"))
    parser.add_argument("--real", type=Path, default=Path("../shared/data/real_four_view"))
    parser.add_argument("--cache", type=Path, default=Path(".benchmark_cache"))
    parser.add_argument("--persons", nargs="*", help="for example P01 P07; all if left out")
    parser.add_argument("--variants", nargs="*", help="names; all if left out")
    parser.add_argument("--out", type=Path, help="write the tables here, and rows beside as CSV")
    parser.add_argument("--fresh", action="store_true", help="forget cached results")
    options = parser.parse_args()
    rows = pd.DataFrame()
    with threadpool_limits(limits=1, user_api="blas"):
        if options.part == "real":
            text, rows = measure_real(options)
        elif options.part == "speed":
            text = measure_speed(options)
        else:
            rows = add_definition(run_suite(options.part, options), options.data)
            text = summarise(rows, SUITES[options.part])
            rows = rows.drop(columns=["joints", "true", "time_s"])
    head = (
        f"Two cameras ({options.part}). python benchmarks/two_view.py {options.part}\n"
        f"No random numbers. {platform.machine()}, Python {platform.python_version()}\n"
    )
    print(f"{head}\n{text}")
    if options.out:
        options.out.write_text(f"{head}\n{text}\n")
        if len(rows):
            rows.to_csv(options.out.with_suffix(".csv"), index=False, float_format="%.3f")


if __name__ == "__main__":
    main()
