"""Which optimiser fits the humanoid best: uDEAS and its alternatives, on the same joints.

Run from the project folder::

    python benchmarks/solvers.py clips --out benchmarks/results/solvers_clips.txt
    python benchmarks/solvers.py frames --out benchmarks/results/solvers_frames.txt
    python benchmarks/solvers.py times --out benchmarks/results/solvers_times.txt

Movement comes from motion capture (test subjects only) and from the reference recordings. Nothing
was chosen on them; the search plans of the product were chosen on training subjects. Three
versions of every frame: `recorded` (the figure fits only so well), `known` (joints of the figure
in postures fitted to the recording, so the true angles are exact) and `known + 20 mm` (the same
with white noise). All solvers have the same segment lengths, ranges and 12 joints. Times are those
of one processor core (CPU seconds), which other work on the machine lengthens somewhat.
"""

from __future__ import annotations

import argparse
import platform
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pandas as pd
from scipy.optimize import differential_evolution
from scipy.stats import wilcoxon
from threadpoolctl import threadpool_limits

from engine.datatypes import PoseTrack, Subject
from engine.kinematics.fitting._dynamic_encoding import draw_codes, search
from engine.kinematics.fitting._humanoid_cost import HumanoidCost
from engine.kinematics.fitting._report import read_angles as read_clip_angles
from engine.kinematics.fitting._udeas_report import ANGLES, share_pitch
from engine.kinematics.fitting._udeas_search import (
    LOWER,
    UPPER,
    SearchPlan,
    descend,
    search_clip,
)
from engine.kinematics.fitting.base import select_solver
from engine.kinematics.fitting.least_squares import FitSettings, fit_track
from engine.kinematics.fitting.udeas import UdeasSolver
from engine.kinematics.humanoid import (
    FITTED_JOINTS,
    SegmentLengths,
    angles_from_model,
    centre_on_pelvis,
    compute_joints,
    estimate_segment_lengths,
    fit_residual,
    to_world_axes,
)
from engine.skeletons import get_skeleton

SEED = 20261122
SUBJECT = Subject()
"""Of unknown stature: segment lengths come from the clip."""
FPS = 30.0
NOISE_M = 0.02
SUCCESS_M = 0.001
TIMED_AT_ONCE = 4000
"""Restarts in lock-step while their time is taken."""
VERSIONS = ("recorded", "known", "known + 20 mm")
GROUPS = {
    "torso": ("lumbar_flexion", "lumbar_bending", "lumbar_rotation"),
    "sagittal": tuple(
        f"{name}_{s}"
        for name in ("hip_flexion", "knee_flexion", "shoulder_flexion", "elbow_flexion")
        for s in ("l", "r")
    ),
    "coronal": tuple(f"{n}_{s}" for n in ("hip_adduction", "shoulder_adduction") for s in "lr"),
    "transversal": ("shoulder_rotation_l", "shoulder_rotation_r"),
}
"""The groups of joint angles that Choi et al. (2024) average over."""


@dataclass(frozen=True, eq=False)
class Clip:
    """A movement: joints (T, 12, 3) around the mid-hip in the figure's axes, m."""

    name: str
    joints: np.ndarray
    lengths: SegmentLengths
    truth: np.ndarray | None = None

    def make_track(self, *, sigma: float = NOISE_M) -> PoseTrack:
        """Return the joints as a track; nothing else of the skeleton is seen."""
        skeleton = get_skeleton("mediapipe_33")
        position = np.full((len(self.joints), len(skeleton.keypoints), 3), np.nan)
        world = to_world_axes(self.joints) + np.array([0.0, 0.95, 0.0])
        for i, name in enumerate(FITTED_JOINTS):
            position[:, skeleton.index(name)] = world[:, i]
        error = np.where(np.isfinite(position[..., 0]), sigma, np.nan)
        time_s = np.arange(len(position)) / FPS
        return PoseTrack(time_s, position, "m", "world", skeleton.name, sigma=error)


# --------------------------------------------------------------------------- movement


def read_joints(file: Path, only: str | None) -> dict[str, np.ndarray]:
    """Return the twelve joints of every clip (T, 12, 3), Z up; of one split only, if named."""
    with np.load(file, allow_pickle=False) as data:
        arrays = {key: data[key] for key in data.files}
    names = [str(name) for name in arrays["joints"]]
    short = [n.replace("left_", "l_").replace("right_", "r_") for n in FITTED_JOINTS]
    columns = [names.index(name) for name in short]
    found = {}
    for i, name in enumerate(arrays["name"]):
        if only is None or str(arrays["split"][i]) == only:
            rows = slice(arrays["start"][i], arrays["start"][i] + arrays["length"][i])
            found[str(name)] = arrays["pose"][rows][:, columns].astype(np.float64)
    return found


def make_clip(name: str, joints: np.ndarray, truth: np.ndarray | None = None) -> Clip:
    """Centre the joints, and estimate the segment lengths as every solver does."""
    typical = SegmentLengths.from_stature(SUBJECT.stature.value)
    track = Clip(name, joints, typical).make_track()
    lengths = estimate_segment_lengths(track, SUBJECT.stature)
    return Clip(name, centre_on_pelvis(track), lengths, truth)


def cut(joints: np.ndarray, n_frames: int) -> np.ndarray:
    """Return the part of a movement with most change of posture."""
    if len(joints) <= n_frames:
        return joints
    speed = np.r_[0.0, np.linalg.norm(np.diff(joints, axis=0), axis=2).mean(axis=1)]
    total = np.cumsum(speed)
    start = int(np.argmax(total[n_frames - 1 :] - total[: len(total) - n_frames + 1]))
    return joints[start : start + n_frames]


def make_known(clip: Clip, rng: np.random.Generator) -> tuple[Clip, Clip]:
    """Return the movement as the figure makes it: exact, and with noise."""
    plan = select_solver("udeas+polish").plan
    found = search_clip(clip.joints, clip.lengths, plan)
    values = share_pitch(found.values)
    exact = np.asarray(compute_joints(values, clip.lengths), dtype=np.float64)
    noisy = exact + NOISE_M * rng.standard_normal(exact.shape)
    return make_clip(clip.name, exact, values), make_clip(clip.name, noisy, values)


# --------------------------------------------------------------------------- whole clips

Answer = tuple[np.ndarray, np.ndarray, np.ndarray]
"""Residual (T,), angles (T, A) and their standard errors (T, A)."""


def solve_by_search(solver: UdeasSolver) -> Callable[[Clip], Answer]:
    """Return a function that runs a solver of the product with the clip's lengths."""

    def run(clip: Clip) -> Answer:
        fit = solver.fit(clip.make_track(), SUBJECT)
        return np.asarray(fit.body.residual_m), fit.angles.value_deg, fit.angles.sigma_deg

    return run


def solve_by_least_squares(settings: FitSettings) -> Callable[[Clip], Answer]:
    """Return a function that fits least squares, frame by frame or the whole clip."""

    def run(clip: Clip) -> Answer:
        track = clip.make_track()
        found = fit_track(track, SUBJECT.stature, settings)
        angles, _ = read_clip_angles(track, found.clip, found.seen)
        places = found.clip.problem.place(found.clip.state)
        order = [found.clip.problem.tree.points.index(name) for name in FITTED_JOINTS]
        joints = np.moveaxis(places[order], 2, 0)
        hips = [FITTED_JOINTS.index(f"{side}_hip") for side in ("left", "right")]
        joints = joints - joints[:, hips].mean(axis=1, keepdims=True)
        residual = np.linalg.norm(joints - clip.joints, axis=2).mean(axis=1)
        columns = [angles.names.index(name) for name in ANGLES]
        return residual, angles.value_deg[:, columns], angles.sigma_deg[:, columns]

    return run


def list_solvers() -> dict[str, Callable[[Clip], Answer]]:
    """Return the solvers that are compared on whole clips."""
    udeas, polish = select_solver("udeas"), select_solver("udeas+polish")
    plain = replace(udeas, plan=SearchPlan(restarts=20, n_passes=0, full_bits=(3, 10), huber_m=0))
    fixed = FitSettings(refine_lengths=False)
    return {
        "uDEAS, each frame by itself, 20 restarts": solve_by_search(plain),
        "uDEAS (solver udeas)": solve_by_search(udeas),
        "uDEAS + polish (solver udeas+polish)": solve_by_search(polish),
        "least squares, each frame by itself": solve_by_least_squares(
            replace(fixed, is_smooth=False)
        ),
        "least squares, whole clip": solve_by_least_squares(fixed),
    }


def compare_on_clips(clips: dict[str, list[Clip]]) -> pd.DataFrame:
    """Return one row per version, solver and clip."""
    rows = []
    effort = SearchPlan(restarts=8, n_passes=12, polish_steps=20, seed=SEED)
    for version, several in clips.items():
        for clip in several:
            answers, seconds = {}, {}
            for name, solve in list_solvers().items():
                start = time.process_time()
                answers[name] = solve(clip)
                seconds[name] = time.process_time() - start
            # Everybody's best, and a search with more effort than any.
            best = search_clip(clip.joints, clip.lengths, effort).residual_m
            for name, (residual, _, _) in answers.items():
                if "least" not in name:
                    best = np.minimum(best, np.where(np.isfinite(residual), residual, np.inf))
            for name, answer in answers.items():
                rows.append(
                    {
                        "version": version,
                        "solver": name,
                        "clip": clip.name,
                        "frames": len(best),
                        "ms": 1e3 * seconds[name] / len(best),
                        **judge(clip, answer, best),
                    }
                )
            print(f"{version} {clip.name} done", file=sys.stderr, flush=True)
    return pd.DataFrame(rows)


def judge(clip: Clip, answer: Answer, best: np.ndarray) -> dict[str, float]:
    """Return residual, success and, where the truth is known, errors and coverage."""
    residual, value, sigma = answer
    missed = ~np.isfinite(residual)
    row = {
        "residual mm": 1e3 * float(np.mean(np.where(missed, 0.15, residual))),
        "above best mm": 1e3 * float(np.mean(np.where(missed, 0.15, residual) - best)),
        "success": float(np.mean(residual < best + SUCCESS_M)),
    }
    if clip.truth is None:
        return row
    named = angles_from_model(clip.truth)
    truth = np.stack([named[name] for name in ANGLES], axis=1)
    error = (value - truth + 180.0) % 360.0 - 180.0
    size = np.abs(error)
    for group, names in GROUPS.items():
        row[group] = float(np.nanmean(size[:, [ANGLES.index(name) for name in names]]))
    counts = {group: len(names) for group, names in GROUPS.items()}
    row["all 17"] = sum(row[g] * n for g, n in counts.items()) / sum(counts.values())
    row["median"] = float(np.nanmedian(size))
    known = np.isfinite(error) & np.isfinite(sigma)
    row["in 95 %"] = float(np.mean(size[known] <= 1.96 * sigma[known]))
    return row


# --------------------------------------------------------------------------- single frames


@dataclass(frozen=True, eq=False)
class Restarts:
    """Independent restarts of one method: cost (F, R), m; effort of one restart."""

    cost: np.ndarray
    evaluations: float
    ms: float


def restart_udeas(frames: Sequence[Clip], restarts: int, *, by_sensitivity: bool) -> Restarts:
    """Run uDEAS over the full ranges, 3 to 10 bits, many restarts in every frame."""
    joints = np.concatenate([clip.joints for clip in frames])
    people = [clip.lengths for clip in frames for _ in clip.joints]
    start = draw_codes(np.random.default_rng(SEED), restarts * len(joints), len(LOWER))
    owner = np.repeat(np.arange(len(joints)), restarts)
    began = time.process_time()
    along = HumanoidCost(joints, people, owner)
    found = search(along, LOWER, UPPER, start, by_sensitivity=by_sensitivity)
    spent = 1e3 * (time.process_time() - began) / len(start)
    return Restarts(found.cost.reshape(-1, restarts), float(found.n_evaluations.mean()), spent)


def restart_descent(frames: Sequence[Clip], restarts: int, steps: int = 30) -> Restarts:
    """Run damped least-squares steps on the same cost from the same kind of random starts.

    A step takes one evaluation of the joints and one of their derivatives, which count as 1 + 21.
    """
    rng = np.random.default_rng(SEED)
    cost = []

    def run(one: Clip, n_each: int) -> np.ndarray:
        joints = np.repeat(one.joints, n_each, axis=0)
        start = LOWER + (UPPER - LOWER) * rng.random((len(joints), len(LOWER)))
        values, _ = descend(start, joints, np.ones(joints.shape[:2]), one.lengths, steps)
        return fit_residual(values, one.lengths, joints)

    for one in frames:
        cost.append(run(one, restarts).reshape(len(one.joints), restarts))
    began = time.process_time()
    n_timed = run(frames[0], TIMED_AT_ONCE // len(frames[0].joints)).size
    spent = time.process_time() - began
    return Restarts(np.concatenate(cost), steps * 22.0, 1e3 * spent / n_timed)


def run_differential_evolution(one: Clip, frame: int, budget: int) -> tuple[float, float, int]:
    """Return residual (m), CPU time (ms) and evaluations of SciPy's global optimiser."""
    target = one.joints[frame]
    began = time.process_time()
    found = differential_evolution(
        lambda x: fit_residual(x.T, one.lengths, target),
        list(zip(LOWER, UPPER, strict=True)),
        popsize=5,
        maxiter=budget // (5 * len(LOWER)) - 1,
        tol=0.0,
        polish=False,
        rng=SEED + frame,
        vectorized=True,
        updating="deferred",
    )
    spent = 1e3 * (time.process_time() - began)
    return float(found.fun), spent, budget


def best_within(run: Restarts, limit: float, effort: float) -> np.ndarray:
    """Return the best cost of every frame within a limit of effort, shape (F, groups).

    Restarts are independent, so those made are cut into as many groups of that effort as fit.
    """
    count = int(limit // effort)
    if not 1 <= count <= run.cost.shape[1]:
        return np.full((len(run.cost), 1), np.nan)
    groups = run.cost.shape[1] // count
    parts = run.cost[:, : groups * count].reshape(len(run.cost), groups, count)
    return parts.min(axis=2)


def compare_on_frames(clips: list[Clip], restarts: int, n_evolved: int) -> tuple[str, pd.DataFrame]:
    """Return tables of equal budget and equal time, and the paired costs of both orders."""
    natural = restart_udeas(clips, restarts, by_sensitivity=False)
    print("natural order done", file=sys.stderr, flush=True)
    ordered = restart_udeas(clips, restarts, by_sensitivity=True)
    print("order by sensitivity done", file=sys.stderr, flush=True)
    descent = restart_descent(clips, restarts)
    print("random-restart descent done", file=sys.stderr, flush=True)
    best = np.minimum(descent.cost.min(axis=1), natural.cost.min(axis=1))
    best = np.minimum(best, ordered.cost.min(axis=1))
    runs = {
        "uDEAS, natural order": natural,
        "uDEAS, order by sensitivity": ordered,
        "random-restart least squares": descent,
    }
    effort = pd.DataFrame(
        {n: {"evaluations": r.evaluations, "ms": r.ms} for n, r in runs.items()}
    ).T.round(3)
    budget = {
        f"{limit} evaluations": {
            n: describe(best_within(r, limit, r.evaluations), best) for n, r in runs.items()
        }
        for limit in (1000, 2000, 4000, 8000, 16000, 32000)
    }
    clock = {
        f"{limit} ms": {n: describe(best_within(r, limit, r.ms), best) for n, r in runs.items()}
        for limit in (1, 2, 4, 8, 16, 32)
    }
    evolved = evolve(clips, best, n_evolved)
    text = (
        f"One restart, {len(best)} frames of {len(clips)} clips\n{effort.to_string()}\n\n"
        "Equal number of evaluations a frame: mean residual in mm (share within 1 mm of the best "
        f"known)\n{pd.DataFrame(budget).to_string()}\n\n"
        "Equal processor time a frame: mean residual in mm (share within 1 mm of the best known)\n"
        f"{pd.DataFrame(clock).to_string()}\n\n{evolved}"
    )
    sizes = [len(clip.joints) for clip in clips]
    name = np.repeat([clip.name for clip in clips], sizes)
    pairs = pd.DataFrame({"clip": name})
    for count in (c for c in (1, 5, 20) if c <= restarts):
        pairs[f"{count} restarts"] = 1e3 * (
            best_within(ordered, count, 1.0).mean(axis=1)
            - best_within(natural, count, 1.0).mean(axis=1)
        )
    return text, pairs


def evolve(clips: list[Clip], best: np.ndarray, n_frames: int) -> str:
    """Return the table of differential evolution on a small sample of frames."""
    rng = np.random.default_rng(SEED)
    offsets = np.cumsum([0, *(len(clip.joints) for clip in clips)])
    chosen = rng.choice(len(clips), size=n_frames, replace=False)
    rows = {}
    for budget in (4000, 16000, 64000):
        cost, known, spent = [], [], []
        for i in chosen:
            frame = int(rng.integers(len(clips[i].joints)))
            found, ms, _ = run_differential_evolution(clips[i], frame, budget)
            cost.append(found)
            known.append(best[offsets[i] + frame])
            spent.append(ms)
        known = np.minimum(known, cost)
        rows[f"{budget} evaluations"] = {
            "residual mm": f"{1e3 * np.mean(cost):.1f}",
            "best known mm": f"{1e3 * np.mean(known):.1f}",
            "success": f"{np.mean(np.array(cost) < known + SUCCESS_M):.2f}",
            "ms a frame": f"{np.mean(spent):.0f}",
        }
        print(f"differential evolution {budget} done", file=sys.stderr, flush=True)
    table = pd.DataFrame(rows).T
    return (
        f"Differential evolution (SciPy), {n_frames} frames of as many clips\n{table.to_string()}"
    )


def describe(found: np.ndarray, best: np.ndarray) -> str:
    """Return mean residual and success, or a dash where there was no result."""
    if np.isnan(found).any():
        return "-"
    best = best[:, None]
    return f"{1e3 * found.mean():.1f} ({np.mean(found < best + SUCCESS_M):.2f})"


def compare_pairs(pairs: pd.DataFrame, column: str) -> dict[str, str]:
    """Return what the order by sensitivity changes, in mm: negative is better.

    Frames of a clip are alike, so the clip is the unit: bootstrap and Wilcoxon over clips.
    """
    per_clip = pairs.groupby("clip")[column].mean().to_numpy()
    rng = np.random.default_rng(SEED)
    drawn = rng.choice(per_clip, size=(10_000, per_clip.size)).mean(axis=1)
    low, high = np.percentile(drawn, [2.5, 97.5])
    return {
        "clips": str(per_clip.size),
        "mean mm": f"{per_clip.mean():+.2f}",
        "95 % interval": f"{low:+.2f} to {high:+.2f}",
        "better clips": f"{np.mean(per_clip < 0):.2f}",
        "p (Wilcoxon)": f"{wilcoxon(per_clip).pvalue:.1g}",
    }


# --------------------------------------------------------------------------- report


def summarise_clips(rows: pd.DataFrame) -> str:
    """Return one table per version, frames weighted alike."""
    parts = []
    for version in VERSIONS:
        part = rows[rows["version"] == version]
        columns = [c for c in part if c not in ("version", "solver", "clip", "frames")]
        weighted = {
            solver: {c: np.average(g[c], weights=g["frames"]) for c in columns}
            for solver, g in part.groupby("solver", sort=False)
        }
        n_clips, n_frames = part["clip"].nunique(), part.groupby("clip")["frames"].first().sum()
        table = pd.DataFrame(weighted).T.dropna(axis=1, how="all").round(2)
        parts.append(f"{version}: {n_clips} clips, {n_frames} frames\n{table.to_string()}")
    return "\n\n".join(parts)


LEGEND = """\
residual: Eq 8, mean distance of 12 joints. above best: over the best residual any search of the
same figure reached. success: share of frames within 1 mm of it. ms: CPU time a frame, angles and
standard errors included. Angles: mean absolute error in degrees by group (torso 3, sagittal 8,
coronal 4, transversal 2) and over all 17; median over all 24. in 95 %: share of errors within 1.96
stated standard errors (joints stated with 20 mm). Least squares has another cost (squared
distances in units of the standard error, free pelvis, no size factor), so its residual here is
only for orientation. In `known` the waist's share of the pitch is as the solvers assume; what the
assumption costs on people can't be seen here. The standard errors of least squares are meant for
the fit of a whole clip: do not read `in 95 %` of the fit of each frame by itself."""


def read_moves(data: Path) -> list[Clip]:
    """Return the movements to test on."""
    moves = read_joints(data / "mocap/cmu_h36m17_30fps.npz", "test")
    moves |= read_joints(data / "reference/reference_h36m17_30fps.npz", None)
    return [make_clip(name, joints) for name, joints in moves.items()]


def report_clips(moves: list[Clip], n_clips: int, n_frames: int) -> str:
    """Compare the solvers on parts of clips."""
    rng = np.random.default_rng(SEED)
    chosen = sorted(rng.choice(len(moves), size=n_clips, replace=False))
    # Lengths again from the part itself: that is all the solvers see.
    recorded = [make_clip(moves[i].name, cut(moves[i].joints, n_frames)) for i in chosen]
    known = [make_known(clip, rng) for clip in recorded]
    versions = dict(zip(VERSIONS, [recorded, *map(list, zip(*known, strict=True))], strict=True))
    return f"{LEGEND}\n\n{summarise_clips(compare_on_clips(versions))}"


def report_frames(moves: list[Clip], n_each: int, restarts: int, n_evolved: int) -> str:
    """Compare independent restarts on single frames of every clip."""
    rng = np.random.default_rng(SEED)
    singles = []
    for clip in moves:
        at = rng.choice(len(clip.joints), size=min(n_each, len(clip.joints)), replace=False)
        singles.append(replace(clip, joints=clip.joints[np.sort(at)]))
    text, pairs = compare_on_frames(singles, restarts, n_evolved)
    order = {c: compare_pairs(pairs, c) for c in pairs if c != "clip"}
    return (
        f"{text}\n\nOrder by sensitivity (Eq 6) minus natural order, same random starts: change of "
        f"the best residual\n{pd.DataFrame(order).T.to_string()}"
    )


def report_times(moves: list[Clip]) -> str:
    """Time the solvers on clips of growing length."""
    longest = max(moves, key=lambda clip: len(clip.joints))
    rows = {}
    for n_frames in (30, 100, 300):
        track = make_clip(longest.name, cut(longest.joints, n_frames)).make_track()
        spent = {}
        for name in ("udeas", "udeas+polish", "least-squares"):
            start = time.process_time()
            select_solver(name).fit(track, SUBJECT)
            spent[name] = 1e3 * (time.process_time() - start) / track.n_frames
        rows[f"{track.n_frames} frames"] = spent
    return f"CPU time a frame, ms, clip {longest.name}\n{pd.DataFrame(rows).T.round(2).to_string()}"


def main() -> None:
    """Run the comparison and print the tables."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("part", choices=("clips", "frames", "times"))
    parser.add_argument("--data", type=Path, default=Path("../shared/data"))
    parser.add_argument("--out", type=Path, help="also write the tables to this file")
    parser.add_argument("--clips", type=int, default=5, help="parts of clips to fit")
    parser.add_argument("--frames", type=int, default=40, help="length of those")
    parser.add_argument("--single", type=int, default=4, help="single frames of every clip")
    parser.add_argument("--restarts", type=int, default=60, help="for single frames")
    parser.add_argument("--evolved", type=int, default=10, help="frames for differential evolution")
    options = parser.parse_args()
    moves = read_moves(options.data)
    with threadpool_limits(1):
        if options.part == "clips":
            text = report_clips(moves, options.clips, options.frames)
        elif options.part == "times":
            text = report_times(moves)
        else:
            text = report_frames(moves, options.single, options.restarts, options.evolved)
    command = " ".join(["python benchmarks/solvers.py", *sys.argv[1:]])
    head = (
        f"Fit of the humanoid: solvers compared. {platform.machine()}, Python "
        f"{platform.python_version()}, NumPy {np.__version__}, one core\n"
        f"Command: {command}\nSeed: {SEED}"
    )
    report = f"{head}\n\n{text}"
    print(report)
    if options.out:
        options.out.write_text(report + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
