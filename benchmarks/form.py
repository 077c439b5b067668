"""How well two performances are compared, on lifts and squats with known truth.

Run from the project folder::

    .venv/bin/python benchmarks/form.py --data ../shared/data

Lifts: the synthetic trials with exact truth, one camera from the side, angles as a user would get
them who states the stature only; keypoints come from the cache of `monocular_lifts.py`, and what is
measured is cached too, so that an interrupted run goes on. Shares of errors and thresholds were
chosen on the training persons; nothing on P07 and P08. Squats: recorded optically, counted by hand
from the height of pelvis and thorax; for testing only.
"""

from __future__ import annotations

import argparse
import itertools
import json
import platform
import sys
import time
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pandas as pd
from fitting import read_clip
from monocular_lifts import TEST_PERSONS, Truth, find_videos, load_pose, read_truth

from engine import Config, Subject, Trial, View
from engine.datatypes import JointAngles, Lift, LiftEnd, Measurement
from engine.errors import EngineError
from engine.form import (
    Comparison,
    Performance,
    compare_performances,
    find_repetitions,
    make_performance,
)
from engine.kinematics.fitting.base import select_solver
from engine.pipeline import assess_pose
from engine.skeletons import get_skeleton

TRAINING_PERSONS = ("P01", "P02", "P03", "P04", "P06")
CAMERA = "cam90"
LIFT_FIELDS = (
    "start_s", "end_s", "reach_start_s", "return_end_s", "start_sigma_s", "end_sigma_s",
)  # fmt: skip
BOUNDS = ("reach starts", "lift-off", "set-down", "return ends")
TRUE_ANGLES = {"trunk_flexion": "trunk_inclination"}
TECHNIQUE_BINS = (0.0, 0.1, 0.2, 0.4, 1.0)
CLIPS = {
    "static1": 0,
    "squats1": 5,
    "STS1": 4,
    "STSAsym1": 4,
    "DLS01": 5,
    "Squat2": 1,
    "gt_squat": 4,
}
"""Whole turns from standing to standing. Sit-to-stand starts and ends seated; `gt_squat` holds two
stoops and two squats, and 13 s of standing with raised arms between."""


@dataclass(frozen=True)
class Known:
    """One lift as measured, and as it truly was."""

    performance: Performance
    truth: Truth
    technique: float
    events_s: dict[str, float]

    @property
    def person(self) -> str:
        """Key of the person."""
        return self.performance.person

    @property
    def task(self) -> str:
        """From where to where was lifted."""
        return self.performance.label[4:6]


# --------------------------------------------------------------------------- reading


def measure_video(video: Path, poses: Path, cache: Path, config: Config) -> Path:
    """Assess one video as a user would; keep what the comparison needs. Return where it lies."""
    file = cache / f"{video.parent.name}_{video.stem}.npz"
    if file.exists():
        return file
    trial = Trial(
        views=(View(video),), subject=Subject(stature_m=read_truth(video.parent).stature_m)
    )
    found = assess_pose(trial, load_pose(video, poses, config), config)
    track = found.corrected
    wrists = get_skeleton(track.skeleton).point(np.asarray(track.position), "mid_wrist")
    lifts = np.array([[getattr(lift, f) for f in LIFT_FIELDS] for lift in found.lifts])
    cache.mkdir(parents=True, exist_ok=True)
    part = file.with_suffix(".part.npz")
    np.savez(
        part,
        time_s=found.angles.time_s,
        value_deg=found.angles.value_deg,
        sigma_deg=found.angles.sigma_deg,
        status=found.angles.status,
        names=np.array(found.angles.names),
        hand_height_m=wrists[:, 1],
        lifts=lifts.reshape(-1, len(LIFT_FIELDS)),
        solver=found.solver,
    )
    part.rename(file)
    return file


def read_known(video: Path, file: Path) -> Known:
    """Read one lift with its truth."""
    with np.load(file, allow_pickle=False) as data:
        names = tuple(map(str, data["names"]))
        angles = JointAngles(
            data["time_s"], data["value_deg"], names, data["sigma_deg"], data["status"]
        )
        performance = Performance(
            label=video.parent.name,
            angles=angles,
            hand_height_m=data["hand_height_m"],
            lifts=tuple(_lift(row) for row in data["lifts"]),
            person=video.parent.name[:3],
            skeleton="mediapipe_33",
            solver=str(data["solver"]),
        )
    document = json.loads((video.parent / "trial.json").read_text())
    return Known(performance, read_truth(video.parent), document["technique"], document["events_s"])


def _lift(row: np.ndarray) -> Lift:
    known = dict(zip(LIFT_FIELDS, map(float, row), strict=True))
    ends = {
        name: LiftEnd(known[at], *(Measurement(np.nan),) * 3)
        for name, at in (("origin", "start_s"), ("destination", "end_s"))
    }
    return Lift(**known, **ends, D_cm=Measurement(np.nan))


# --------------------------------------------------------------------------- tables


def measure_phases(known: Iterable[Known]) -> pd.DataFrame:
    """Return errors of the phases' bounds, and whether their 95 % intervals hold the truth."""
    rows = []
    for one in known:
        found = find_repetitions(one.performance)
        if len(found) != 1:
            print(f"{one.performance.label}: {len(found)} lifts instead of 1", file=sys.stderr)
            continue
        phase = {p.key: p for p in found[0].phases}
        bounds = (
            (phase["reach"].start_s, phase["reach"].start_sigma_s, "reach_start"),
            (phase["rise"].start_s, phase["rise"].start_sigma_s, "lift_start"),
            (phase["rise"].end_s, phase["rise"].end_sigma_s, "place"),
            (phase["return"].end_s, phase["return"].end_sigma_s, "stand"),
        )
        for name, (at, sigma, event) in zip(BOUNDS, bounds, strict=True):
            error = at - one.events_s[event]
            rows.append((name, error, abs(error) < 1.96 * sigma))
    table = pd.DataFrame(rows, columns=["bound", "error_s", "covered"])
    groups = table.groupby("bound", sort=False)
    return pd.DataFrame(
        {
            "lifts": groups.size(),
            "mean": groups.error_s.mean().round(3),
            "mean absolute": groups.error_s.apply(lambda e: e.abs().mean()).round(3),
            "95th percentile": groups.error_s.apply(lambda e: e.abs().quantile(0.95)).round(3),
            "covered": groups.covered.mean().round(2),
        }
    )


def list_pairs(
    known: list[Known], *, same_person: bool, most: int, seed: int
) -> list[tuple[Known, Known]]:
    """Return pairs of one task, drawn with a fixed seed where there are too many."""
    pairs = [
        (a, b)
        for a, b in itertools.combinations(known, 2)
        if a.task == b.task and (a.person == b.person) is same_person
    ]
    if len(pairs) <= most:
        return pairs
    chosen = np.random.default_rng(seed).choice(len(pairs), most, replace=False)
    return [pairs[i] for i in sorted(chosen)]


def compare_pairs(
    pairs: Iterable[tuple[Known, Known]],
) -> Iterator[tuple[Known, Known, Comparison]]:
    """Compare; say which pairs are refused."""
    for one, two in pairs:
        try:
            yield one, two, compare_performances(one.performance, two.performance)
        except EngineError as error:
            names = f"{one.performance.label}, {two.performance.label}"
            print(f"{names}: {error}", file=sys.stderr)


def measure_differences(
    compared: Iterable[tuple[Known, Known, Comparison]],
) -> pd.DataFrame:
    """Return differences per phase beside the true ones at the same moments."""
    rows = []
    for one, two, found in compared:
        for d in found.differences:
            name = TRUE_ANGLES.get(d.angle, d.angle)
            if name not in one.truth.angles:
                continue
            phase = next(p for p in found.phases if p.key == d.phase)
            part = (found.reference_time_s >= phase.start_s) & (
                found.reference_time_s <= phase.end_s
            )
            first = np.interp(
                found.reference_time_s[part], one.truth.time_s, one.truth.angles[name]
            )
            second = np.interp(found.attempt_time_s[part], two.truth.time_s, two.truth.angles[name])
            true = float(np.mean(second - first))
            rows.append((d.angle, d.mean.value, d.mean.sigma, true, d.is_beyond_error))
    return pd.DataFrame(rows, columns=["angle", "value", "sigma", "true", "named"])


def summarise_differences(table: pd.DataFrame) -> pd.DataFrame:
    """Return errors of differences by angle; `wrong way` are named ones with another true sign."""
    table = table.assign(error=table.value - table.true)
    table["covered"] = table.error.abs() < 1.96 * table.sigma
    table["ratio"] = table.error / table.sigma
    table["wrong"] = table.named & (np.sign(table.value) != np.sign(table.true))
    groups = [*table.groupby("angle"), ("all", table)]
    return pd.DataFrame(
        {
            name: {
                "differences": len(part),
                "RMSE": round(_rms(part.error), 1),
                "stated": round(_rms(part.sigma), 1),
                "RMS of error/stated": round(_rms(part.ratio), 2),
                "covered": round(part.covered.mean(), 3),
                "named": int(part.named.sum()),
                "named the wrong way": int(part.wrong.sum()),
            }
            for name, part in groups
        }
    ).T


def _rms(values: pd.Series) -> float:
    return float(np.sqrt(np.mean(values**2)))


def summarise_scores(compared: Iterable[tuple[Known, Known, Comparison]]) -> pd.DataFrame:
    """Return scores by the difference of technique (0 stoop, 1 squat).

    `attrs` holds rank correlations of the score with that difference, and with the true
    difference of posture.
    """
    rows = [
        (
            abs(a.technique - b.technique),
            c.score.value,
            c.score.difference_deg,
            c.likeness,
            true_difference(a, b, c),
        )
        for a, b, c in compared
    ]
    columns = ["technique", "score", "excess", "likeness", "posture"]
    table = pd.DataFrame(rows, columns=columns)
    groups = table.groupby(pd.cut(table.technique, TECHNIQUE_BINS, right=False), observed=True)
    result = pd.DataFrame(
        {
            "pairs": groups.size(),
            "mean score": groups.score.mean().round(1),
            "lowest": groups.score.min().round(1),
            "highest": groups.score.max().round(1),
            "mean excess deg": groups.excess.mean().round(1),
            "true difference deg": groups.posture.mean().round(1),
            "least likeness": groups.likeness.min().round(2),
        }
    )
    rank = table.rank().corr().loc["score"]
    result.attrs |= {"technique": float(rank["technique"]), "posture": float(rank["posture"])}
    return result


def true_difference(one: Known, two: Known, found: Comparison) -> float:
    """Return the root mean square of the true differences of the angles that were compared."""
    squares = []
    for angle in found.names:
        name = TRUE_ANGLES.get(angle, angle)
        if name in one.truth.angles:
            first = np.interp(found.reference_time_s, one.truth.time_s, one.truth.angles[name])
            second = np.interp(found.attempt_time_s, two.truth.time_s, two.truth.angles[name])
            squares.append(np.mean((second - first) ** 2))
    return float(np.sqrt(np.mean(squares)))


def read_reference(data: Path, clip: str) -> Performance:
    """Return an optically recorded clip, solved from its joint centres."""
    track = read_clip(data, clip)
    angles = select_solver("geometric").fit(track, Subject()).angles
    return make_performance(angles, track, label=clip, solver="geometric", person=clip)


def count_repetitions(data: Path) -> pd.DataFrame:
    """Return repetitions found and true."""
    rows = {
        clip: {"true": true, "found": len(find_repetitions(read_reference(data, clip)))}
        for clip, true in CLIPS.items()
    }
    return pd.DataFrame(rows).T


def compare_movements(data: Path) -> pd.DataFrame:
    """Return the likeness of squats with other movements; refusals as a dash."""
    reference = read_reference(data, "squats1")
    rows = {}
    for clip in ("squats1", "DLS01", "Squat2", "STS1", "DJ1", "walking1"):
        try:
            found = compare_performances(reference, read_reference(data, clip))
            rows[clip] = {
                "likeness": f"{found.likeness:.2f}",
                "score": f"{found.score.value:.0f}",
                "outcome": "compared",
            }
        except EngineError as error:
            rows[clip] = {"likeness": "-", "score": "-", "outcome": str(error).split(";")[0]}
    return pd.DataFrame(rows).T


def measure_speed(data: Path, *, repeats: int) -> tuple[float, float]:
    """Return the median and longest time to compare two clips of 10 s, seconds."""
    clips = [read_reference(data, name) for name in ("squats1", "DLS01")]
    spent = []
    for _ in range(repeats):
        start = time.perf_counter()
        compare_performances(*clips)
        spent.append(time.perf_counter() - start)
    return float(np.median(spent)), max(spent)


# --------------------------------------------------------------------------- command


def report(options: argparse.Namespace) -> Iterator[str]:
    """Yield the tables."""
    yield f"Comparing form. {platform.machine()}, Python {platform.python_version()}"
    yield f"Command: python benchmarks/form.py --data DATA --seed {options.seed}"
    lifts = options.data / "synthetic_lifts"
    for title, persons in (("training persons", TRAINING_PERSONS), ("test persons", TEST_PERSONS)):
        videos = [v for v in find_videos(lifts, persons) if v.stem == CAMERA]
        known = [
            read_known(v, measure_video(v, options.poses, options.cache, Config())) for v in videos
        ]
        yield f"\nSynthetic lifts, {title}: errors of the phases' bounds, s"
        yield measure_phases(known).to_string()
        for same in (True, False):
            pairs = list_pairs(known, same_person=same, most=options.most, seed=options.seed)
            compared = list(compare_pairs(pairs))
            who = "one person" if same else "two persons"
            yield f"\n{title}, {who}: differences per phase against the truth, deg"
            yield summarise_differences(measure_differences(compared)).to_string()
            yield f"\n{title}, {who}: score by difference of technique"
            scores = summarise_scores(compared)
            yield scores.to_string()
            yield (
                f"Rank correlation of the score with the difference of technique "
                f"{scores.attrs['technique']:.2f}, with the true difference of posture "
                f"{scores.attrs['posture']:.2f}"
            )
    yield "\nRepetitions in optically recorded clips"
    yield count_repetitions(options.data).to_string()
    yield "\nSquats of one person beside other movements"
    yield compare_movements(options.data).to_string()
    median, longest = measure_speed(options.data, repeats=20)
    yield (
        f"\nTwo clips of 13 and 11 s compared in {1000 * median:.0f} ms (longest of 20: "
        f"{1000 * longest:.0f} ms)"
    )


def main() -> None:
    """Print the tables and keep them."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--data", type=Path, default=Path("../shared/data"))
    parser.add_argument("--poses", type=Path, default=Path(".benchmark_cache/monocular_lifts"))
    parser.add_argument("--cache", type=Path, default=Path(".benchmark_cache/form"))
    parser.add_argument("--most", type=int, default=150, help="most pairs per table")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--out", type=Path, default=Path("benchmarks/results/form.txt"))
    options = parser.parse_args()
    lines = []
    for line in report(options):
        print(line, flush=True)
        lines.append(line)
    options.out.parent.mkdir(parents=True, exist_ok=True)
    options.out.write_text("\n".join(lines) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
