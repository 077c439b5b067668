"""How far risk results from one or two cameras are from those of the true posture, synthetic lifts.

Run from the project folder::

    nice -n 10 .venv/bin/python benchmarks/risk.py

Every video is assessed knowing what a user tells (stature, body mass, sex, load, work); the same
methods judge the true joints, so that only the measuring differs. Answers are kept per video in a
cache folder and an interrupted run goes on where it stopped; give ``--fresh`` to start over.
Nothing in the product was chosen on the persons P07 and P08.
"""

from __future__ import annotations

import argparse
import itertools
import json
import math
import platform
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pandas as pd
from monocular_lifts import LOAD_KG, TEST_PERSONS, Truth, find_videos, load_pose, read_truth
from threadpoolctl import threadpool_limits
from two_view_data import read_given_calibration

from engine import Config, Subject, Task, Trial, TrialResult, View
from engine.datatypes import Camera, Lift, LiftEnd, Measurement, PoseTrack, RiskResult
from engine.ergonomics.assess import assess_risk
from engine.ergonomics.base import Exposure, select_methods
from engine.ergonomics.methods.rnle import LEVELS, classify
from engine.ergonomics.posture_scores import decode_runs
from engine.ergonomics.upper_body import compute_back_load, measure_upper_body
from engine.errors import EngineError
from engine.kinematics.fitting.base import select_solver
from engine.pipeline import assess_poses
from engine.skeletons import MEDIAPIPE_33

POSTURE = ("reba", "rula")
TASK = Task(
    load_kg=LOAD_KG,
    hands=2,
    coupling="good",
    frequency_per_min=0.2,
    duration_h=1.0,
    recovery_h=1.0,
    destination_control=True,
)
TRUE_NAMES = {"bigtoe": "big_toe"}
VIEWS = {
    "cam90": ("cam90",),
    "cam135": ("cam135",),
    "two": ("cam90", "cam135"),
    "two, cameras given": ("cam90", "cam135"),
}
"""From the right side, from the right rear, and both: cameras found from the person, or given."""
N_BOOTSTRAP = 2000
LOADS_KG = (5.0, 10.0, 15.0, 20.0)
"""Loads over which the classes of the lifting index are compared."""


def read_subject(folder: Path) -> Subject:
    """Read what a user would tell about a person."""
    person = json.loads((folder / "subject.json").read_text())
    return Subject(
        label=person["subject"],
        stature_m=person["height_m"],
        mass_kg=person["mass_kg"],
        sex={"F": "female", "M": "male"}[person["sex"]],
    )


def read_true_track(folder: Path) -> PoseTrack:
    """Read the true joints at the times of the pictures, as an error-free track."""
    with np.load(folder / "truth.npz", allow_pickle=False) as data:
        arrays = {key: data[key] for key in data.files}
    time_s, wanted = arrays["time"].astype(float), arrays["video_time"].astype(float)
    position = np.full((len(wanted), len(MEDIAPIPE_33.keypoints), 3), np.nan)
    for k, name in enumerate(arrays["joint_names"]):
        part, _, side = str(name).partition("_")
        word = {"L": "left_", "R": "right_", "": ""}[side] + TRUE_NAMES.get(part, part)
        if word in MEDIAPIPE_33.keypoints:
            for axis in range(3):
                curve = np.interp(wanted, time_s, arrays["joints"][:, k, axis])
                position[:, MEDIAPIPE_33.index(word), axis] = curve
    sigma = np.zeros(position.shape[:2])
    return PoseTrack(wanted, position, "m", "world", "mediapipe_33", sigma=sigma)


def true_lift(truth: Truth) -> Lift:
    """Return the lift as it was."""
    ends = [
        LiftEnd(
            truth.lift_s[k],
            Measurement(truth.H_cm[k], 0.0),
            Measurement(truth.V_cm[k], 0.0),
            Measurement(0.0, 0.0),
        )
        for k in (0, 1)
    ]
    return Lift(*truth.lift_s, *ends, Measurement(truth.travel_cm, 0.0))


def true_exposure(folder: Path, truth: Truth, subject: Subject) -> Exposure:
    """Return what the methods would judge if everything were measured without error."""
    track = read_true_track(folder)
    angles = select_solver("geometric").fit(track, subject).angles
    observed_s = float(track.time_s[-1] - track.time_s[0])
    return Exposure(track, angles, (true_lift(truth),), subject, TASK, observed_s)


def assess_views(folder: Path, views: str, poses: Path, subject: Subject) -> TrialResult:
    """Assess one trial as one camera or both see it; both with exact cameras or with none known."""
    names = VIEWS[views]
    videos = [folder / f"{name}.mp4" for name in names]
    seen = [load_pose(video, poses, Config()) for video in videos]
    cameras: tuple[Camera | None, ...] = (None,) * len(names)
    if views == "two, cameras given":
        cameras = read_given_calibration(folder.parent).cameras
    files = tuple(View(v, camera=c) for v, c in zip(videos, cameras, strict=True))
    return assess_poses(Trial(views=files, subject=subject, task=TASK), seen, Config())


def measure(folder: Path, views: str, poses: Path) -> dict[str, float | str]:
    """Assess one trial and compare every method with the same method on the truth."""
    truth, subject = read_truth(folder), read_subject(folder.parent)
    group = {
        "trial": folder.name,
        "camera": views,
        "persons": "test" if folder.name[:3] in TEST_PERSONS else "training",
    }
    try:
        result = assess_views(folder, views, poses, subject)
    except EngineError as error:
        return {**group, "lifts": 0, "refused": str(error)}
    true = true_exposure(folder, truth, subject)
    expected = assess_risk(true)
    row: dict[str, float | str] = {
        **group,
        "lifts": len(result.lifts),
        **{f"cpu_s {k}": v for k, v in time_methods(result).items()},
    }
    for name in POSTURE:
        row |= compare_scores(name, result.risk[name], expected[name])
    if not result.lifts:
        return row
    nearest = min(
        range(len(result.lifts)),
        key=lambda k: abs(result.lifts[k].start_s - truth.lift_s[0]),
    )
    lift = result.lifts[nearest]
    row |= {"start_s": lift.start_s - truth.lift_s[0], "end_s": lift.end_s - truth.lift_s[1]}
    for name in ("rnle", "l5s1"):
        mine = result.risk[name].per_lift[nearest]
        row |= (compare_rnle if name == "rnle" else compare_back)(mine, expected[name].per_lift[0])
    return row | compare_moments(result, lift, true)


def time_methods(result: TrialResult) -> dict[str, float]:
    """Return the processor time of each method, s, the smaller of two runs."""
    observed_s = float(result.corrected.time_s[-1] - result.corrected.time_s[0])
    exposure = Exposure(
        result.corrected, result.angles, result.lifts, result.trial.subject, TASK, observed_s
    )
    spent = {}
    with threadpool_limits(limits=1, user_api="blas"):
        for method in select_methods(()):
            spent[method.info.name] = min(_time(method.assess, exposure) for _ in range(2))
    # Of a clip of 10 s: the methods' work grows with the number of frames.
    return {name: seconds * 10.0 / observed_s for name, seconds in spent.items()}


def _time(function: Callable[[Exposure], RiskResult], exposure: Exposure) -> float:
    start = time.process_time()
    function(exposure)
    return time.process_time() - start


def compare_scores(name: str, mine: RiskResult, true: RiskResult) -> dict[str, float]:
    """Compare the headline score, and the scores of all frames."""
    row = {f"{name} mine": mine.value, f"{name} true": true.value}
    if not (mine.is_applicable and true.is_applicable):
        return row
    one, two = (decode_runs(r.details["series"]["score"]) for r in (mine, true))
    n = min(len(one), len(two))
    known = (one[:n] > 0) & (two[:n] > 0)
    off = np.abs(one[:n] - two[:n])[known]
    row |= {f"{name} exact": float((off == 0).mean()), f"{name} within": float((off <= 1).mean())}
    return row


def compare_rnle(mine: RiskResult, true: RiskResult) -> dict[str, float]:
    """Compare weight limit, index and class."""
    row = {
        "LI true": true.value,
        "RWL true": true.details["rwl_kg"],
        "LI origin true": true.details["origin"]["LI"],
    }
    if not mine.is_applicable:
        return row
    low, high = mine.interval
    return row | {
        "LI mine": mine.value,
        "LI origin mine": mine.details["origin"]["LI"],
        "RWL": mine.details["rwl_kg"] - true.details["rwl_kg"],
        "LI held": float(low <= true.value <= high),
    }


def compare_back(mine: RiskResult, true: RiskResult) -> dict[str, float]:
    """Compare peak compression and moment, static and with accelerations."""
    row = {"compression true": true.value}
    if not mine.is_applicable:
        return row
    low, high = mine.interval
    row |= {"compression mine": mine.value, "compression held": float(low <= true.value <= high)}
    for kind in ("static", "dynamic"):
        one, two = (r.details[kind] for r in (mine, true))
        row[f"peak {kind} moment"] = one["flexion_nm"] - two["flexion_nm"]
        row[f"peak {kind} compression"] = one["compression_n"] - two["compression_n"]
    row["static peak below true dynamic"] = (
        mine.details["static"]["compression_n"] - true.details["dynamic"]["compression_n"]
    )
    return row


def compare_moments(result: TrialResult, lift: Lift, true: Exposure) -> dict[str, float]:
    """Compare the moment in every frame in which both hold the load."""
    curves = []
    for exposure, lifts in (
        (Exposure(result.corrected, result.angles, result.lifts, true.subject, TASK, 0.0), [lift]),
        (true, list(true.lifts)),
    ):
        body = measure_upper_body(exposure)
        load = compute_back_load(body, lifts, subject=true.subject, load_kg=LOAD_KG)
        curves.append((load.time_s, load.static.flexion_nm, load.load_kg, load.flexion_sigma_nm))
    (t, mine, held, sigma), (t2, real, real_held, _) = curves
    n = min(len(t), len(t2))
    both = (held[:n] > 0) & (real_held[:n] > 0) & np.isfinite(mine[:n])
    if not both.any():
        return {}
    error = (mine[:n] - real[:n])[both]
    return {
        "moment MAE": float(np.abs(error).mean()),
        "moment bias": float(error.mean()),
        "moment held": float((np.abs(error) <= 1.96 * sigma[:n][both]).mean()),
        "moment frames": float(both.sum() / max(1.0, (real_held > 0).sum())),
    }


# --------------------------------------------------------------------------- tables


def kappa(one: np.ndarray, two: np.ndarray, n: int, *, weighted: bool = False) -> float:
    """Compute Cohen's kappa of two ratings from 0 to n - 1; weighted by squared distance."""
    table = np.zeros((n, n))
    np.add.at(table, (one, two), 1.0)
    table /= table.sum()
    chance = np.outer(table.sum(axis=1), table.sum(axis=0))
    rows, columns = np.indices((n, n))
    cost = (rows - columns) ** 2.0 if weighted else (rows != columns).astype(float)
    expected = float((cost * chance).sum())
    return 1.0 - float((cost * table).sum()) / expected if expected > 0 else math.nan


def kappa_interval(
    part: pd.DataFrame, seed: int, *, name: str = "LI", weighted: bool = False
) -> str:
    """Return the share of equal classes of an index, and kappa with its 95 % interval.

    The classes are those of several loads, so that one crate doesn't put all lifts into one class;
    the index is proportional to the load. Whole trials are drawn with replacement. Lifts that were
    not found or refused are left out; their number is in the table.
    """
    part = part[part[f"{name} mine"].notna()]
    order = [level.name for level in LEVELS]

    def codes(column: str) -> np.ndarray:
        values = part[column].to_numpy()[:, None] * np.array(LOADS_KG) / LOAD_KG
        return np.vectorize(lambda value: order.index(classify(value).name))(values)

    one, two = codes(f"{name} mine"), codes(f"{name} true")
    rng = np.random.default_rng(seed)
    draws = []
    for _ in range(N_BOOTSTRAP):
        chosen = rng.integers(0, len(part), len(part))
        pair = one[chosen].ravel(), two[chosen].ravel()
        draws.append(kappa(*pair, len(order), weighted=weighted))
    low, high = np.nanpercentile(draws, [2.5, 97.5])
    found = kappa(one.ravel(), two.ravel(), len(order), weighted=weighted)
    return f"{(one == two).mean():.2f}; {found:.2f} [{low:.2f}, {high:.2f}]"


def summarise(rows: pd.DataFrame, seed: int) -> str:
    """Return one table, a column per group of persons and camera."""
    groups = {
        f"{persons} {camera}": part
        for (persons, camera), part in rows.groupby(["persons", "camera"])
    }
    table = pd.DataFrame({name: describe(part, seed) for name, part in groups.items()})
    return table.to_string()


def describe(part: pd.DataFrame, seed: int) -> dict[str, str]:
    """Return every figure of one group, with its unit in the name."""

    def mae(column: str, digits: int = 2) -> str:
        return f"{part[column].abs().mean():.{digits}f} ({part[column].mean():+.{digits}f})"

    # An infinite index (nothing may be lifted) has no error; how often it occurs is its own line.
    finite = np.isfinite(part["LI mine"]) & np.isfinite(part["LI true"])
    origin = part["LI origin mine"] - part["LI origin true"]
    part = part.assign(LI=(part["LI mine"] - part["LI true"]).where(finite))
    part["LI origin"] = origin.where(np.isfinite(origin))
    out = {
        "trials": str(len(part)),
        "refused": str(int(part["refused"].notna().sum()) if "refused" in part else 0),
        "lift found and judged": str(int(part["LI mine"].notna().sum())),
        "lift-off, MAE (bias), s": mae("start_s"),
        "set-down, MAE (bias), s": mae("end_s"),
        "RWL, MAE (bias), kg": mae("RWL"),
        "LI, MAE (bias)": mae("LI"),
        "LI infinite: measured / true": f"{int(np.isinf(part['LI mine']).sum())} / "
        f"{int(np.isinf(part['LI true']).sum())}",
        "LI in its 95 % interval": f"{part['LI held'].mean():.2f}",
        "LI class, 5-20 kg: equal; kappa": kappa_interval(part, seed),
        "LI class, equal; weighted kappa": kappa_interval(part, seed, weighted=True),
        "LI at the origin, MAE (bias)": mae("LI origin"),
        "LI class at the origin: equal; kappa": kappa_interval(part, seed, name="LI origin"),
        "L5/S1 moment, frames, MAE (bias), N m": f"{part['moment MAE'].mean():.1f} "
        f"({part['moment bias'].mean():+.1f})",
        "L5/S1 moment, frames in 95 % interval": f"{part['moment held'].mean():.2f}",
        "frames of the lift with a moment": f"{part['moment frames'].mean():.2f}",
        "L5/S1 peak static moment, N m": mae("peak static moment", 1),
        "L5/S1 peak dynamic moment, N m": mae("peak dynamic moment", 1),
        "peak static compression, N": mae("peak static compression", 0),
        "peak dynamic compression, N": mae("peak dynamic compression", 0),
        "static peak - true dynamic peak, N": mae("static peak below true dynamic", 0),
        "peak compression in its 95 % interval": f"{part['compression held'].mean():.2f}",
    }
    for name in POSTURE:
        off = (part[f"{name} mine"] - part[f"{name} true"]).abs()
        label = name.upper()
        out[f"{label} worst: exact / within one"] = (
            f"{(off == 0).mean():.2f} / {(off <= 1).mean():.2f}"
        )
        out[f"{label} frames: exact / within one"] = (
            f"{part[f'{name} exact'].mean():.2f} / {part[f'{name} within'].mean():.2f}"
        )
    times = part[[c for c in part if c.startswith("cpu_s ")]].median()
    out["processor time, all methods, 10 s of video, s"] = f"{times.sum():.2f}"
    for name, seconds in times.sort_values(ascending=False).items():
        out[f"  {name.removeprefix('cpu_s ')}"] = f"{seconds:.3f}"
    return out


def main() -> None:
    """Run the comparison and print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--data", type=Path, default=Path("../shared/data/synthetic_lifts"))
    parser.add_argument("--poses", type=Path, default=Path(".benchmark_cache/monocular_lifts"))
    parser.add_argument("--cache", type=Path, default=Path(".benchmark_cache/risk"))
    parser.add_argument("--out", type=Path, default=Path("benchmarks/results/risk"))
    parser.add_argument("--persons", nargs="*", help="for example P01 P07; all if left out")
    parser.add_argument("--views", nargs="*", choices=VIEWS, help="all if left out")
    parser.add_argument("--seed", type=int, default=0, help="of the interval of kappa")
    parser.add_argument("--fresh", action="store_true", help="forget cached answers")
    options = parser.parse_args()
    options.cache.mkdir(parents=True, exist_ok=True)
    persons = options.persons or sorted(p.name for p in options.data.glob("P*"))
    rows = []
    folders = sorted({video.parent for video in find_videos(options.data, persons)})
    for folder, views in itertools.product(folders, options.views or VIEWS):
        file = options.cache / f"{folder.name}_{views.replace(', ', '_').replace(' ', '_')}.json"
        if options.fresh or not file.exists():
            part = file.with_suffix(".part")
            part.write_text(json.dumps(measure(folder, views, options.poses)))
            part.rename(file)
            print(f"{folder.name} {views}", flush=True)
        rows.append(json.loads(file.read_text()))
    table = pd.DataFrame(rows)
    only = f" --persons {' '.join(options.persons)}" if options.persons else ""
    if options.views:
        only += " --views " + " ".join(f'"{name}"' for name in options.views)
    if options.out != Path("benchmarks/results/risk"):
        only += f" --out {options.out}"
    head = (
        "Risk from one or two cameras against the same methods on the true posture, lifts of "
        f"{LOAD_KG:g} kg (synthetic).\n"
        f"Command: python benchmarks/risk.py --seed {options.seed}{only}. "
        f"{platform.machine()}, Python {platform.python_version()}\n"
        "MAE: mean absolute error; in brackets the mean signed error.\n"
    )
    text = f"{head}\n{summarise(table, options.seed)}\n"
    print(text)
    options.out.with_suffix(".txt").write_text(text)
    table.to_csv(options.out.with_suffix(".csv"), index=False, float_format="%.4g")


if __name__ == "__main__":
    main()
