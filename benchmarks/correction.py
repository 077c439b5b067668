"""How well wrong keypoints are found and repaired: faults are put into exact motion capture.

Run from the project folder::

    .venv/bin/python benchmarks/correction.py

prints the tables; ``--out benchmarks/results/correction.txt`` keeps them. Settings were chosen
with ``--clips train`` only; the published figures are those of the test clips (persons not in the
training clips) and of the reference recordings, whose recording system and persons are others.
"""

from __future__ import annotations

import argparse
import os
import platform
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import numpy as np
import pandas as pd

from engine.correction.chain import correct_track
from engine.correction.diagnosis import diagnose
from engine.correction.links import find_edges, find_excursions, measure_links
from engine.datatypes import PoseTrack
from engine.kinematics.angles import (
    compute_hinge_flexion,
    compute_hip_flexion,
    compute_shoulder_angles,
    compute_trunk_angles,
)
from engine.skeletons import H36M_17

FPS = 30.0
SIDES = ("left", "right")
GROUPS = {"torso": 3, "sagittal": 8, "coronal": 2}
"""Angles per group. The paper also has hip adduction (coronal) and shoulder rotation
(transversal), two each; keypoints without a body model don't give them."""
PARTS = {
    "upper": ("shoulder", "elbow", "wrist"),
    "lower": ("hip", "knee", "ankle"),
}
MEASURED = [k for k in H36M_17.keypoints if k not in ("nose", "head", "spine")]


@dataclass(frozen=True)
class Clip:
    """Exact positions (T, 17, 3), metres, Y up."""

    name: str
    position: np.ndarray

    @property
    def time_s(self) -> np.ndarray:
        """Frame times."""
        return np.arange(len(self.position)) / FPS


@dataclass
class Faulty:
    """A clip with faults, and where they are.

    `swapped` (T, 2): upper and lower body; `misplaced`, `missing`, `jumping` (T, 17); `lost` (T,).
    """

    position: np.ndarray
    swapped: np.ndarray = field(init=False)
    misplaced: np.ndarray = field(init=False)
    missing: np.ndarray = field(init=False)
    jumping: np.ndarray = field(init=False)
    lost: np.ndarray = field(init=False)

    def __post_init__(self) -> None:
        n = len(self.position)
        self.swapped = np.zeros((n, 2), dtype=bool)
        self.misplaced, self.missing, self.jumping = (np.zeros((n, 17), dtype=bool) for _ in "abc")
        self.lost = np.zeros(n, dtype=bool)


# --- clips -----------------------------------------------------------------------------------


def read_clips(data: Path, which: str, limit: int) -> list[Clip]:
    """Read clips of at least one second: `test`, `reference`, `train` or `val`."""
    name = "reference/reference" if which == "reference" else "mocap/cmu"
    with np.load(data / f"{name}_h36m17_30fps.npz") as arrays:
        pose, root = arrays["pose"].astype(float), arrays["root"].astype(float)
        parts = zip(arrays["name"], arrays["start"], arrays["length"], strict=True)
        chosen = [True] * len(arrays["name"])
        if which != "reference":
            chosen = (arrays["split"] == which).tolist()
    clips = []
    for (label, start, length), is_in in zip(parts, chosen, strict=True):
        if is_in and length >= FPS:
            rows = slice(start, start + min(length, limit))
            world = pose[rows] + root[rows, None]
            clips.append(Clip(str(label), world[..., [0, 2, 1]] * [1.0, 1.0, -1.0]))
    return clips


# --- faults ----------------------------------------------------------------------------------


def _stretches(
    rng: np.random.Generator, n: int, share: float, longest: int
) -> Iterator[tuple[int, int]]:
    """Give stretches of 1 to `longest` frames that never touch, about `share` of all frames."""
    at = int(rng.integers(3, 12))
    mean_gap = (1.0 + longest) / 2.0 * (1.0 / share - 1.0)
    while True:
        at += int(rng.exponential(mean_gap)) + 3
        stop = at + int(rng.integers(1, longest + 1))
        if stop >= n - 3:
            return
        yield at, stop
        at = stop


def add_swaps(faulty: Faulty, rng: np.random.Generator, share: float = 0.06) -> None:
    for start, stop in _stretches(rng, len(faulty.position), share, 20):
        kind = rng.choice(["whole", "upper", "lower"])
        for g, group in enumerate(PARTS):
            if kind in ("whole", group):
                faulty.swapped[start:stop, g] = True
                for part in PARTS[group]:
                    left, right = (H36M_17.index(f"{side}_{part}") for side in SIDES)
                    both = faulty.position[start:stop, [left, right]]
                    faulty.position[start:stop, [right, left]] = both


def add_misdetections(faulty: Faulty, rng: np.random.Generator, share: float = 0.02) -> None:
    for side in SIDES:
        for part in ("wrist", "elbow", "ankle", "knee"):
            column = H36M_17.index(f"{side}_{part}")
            for start, stop in _stretches(rng, len(faulty.position), share, 10):
                direction = rng.standard_normal(3)
                offset = rng.uniform(0.15, 0.5) * direction / np.linalg.norm(direction)
                noise = 0.02 * rng.standard_normal((stop - start, 3))
                faulty.position[start:stop, column] += offset + noise
                faulty.misplaced[start:stop, column] = True


def add_dropouts(faulty: Faulty, rng: np.random.Generator, share: float = 0.02) -> None:
    n = len(faulty.position)
    for column in range(17):
        for start, stop in _stretches(rng, n, share, 12):
            faulty.missing[start:stop, column] = True
    for start, stop in _stretches(rng, n, share, 8):
        faulty.missing[start:stop] = True
    faulty.position[faulty.missing] = np.nan


def add_losses(faulty: Faulty, rng: np.random.Generator, share: float = 0.02) -> None:
    for start, stop in _stretches(rng, len(faulty.position), share, 6):
        faulty.lost[start:stop] = True
        faulty.position[start:stop] += 0.3 * rng.standard_normal((stop - start, 17, 3))


def add_spikes(faulty: Faulty, rng: np.random.Generator, share: float = 0.01) -> None:
    for part in ("wrist", "elbow", "ankle", "knee"):
        for side in SIDES:
            column = H36M_17.index(f"{side}_{part}")
            for start, stop in _stretches(rng, len(faulty.position), share, 1):
                direction = rng.standard_normal(3)
                faulty.position[start:stop, column] += 0.06 * direction / np.linalg.norm(direction)
                faulty.jumping[start:stop, column] = True


def add_white(faulty: Faulty, rng: np.random.Generator, sigma: float = 0.01) -> None:
    faulty.position += sigma * rng.standard_normal(faulty.position.shape)


def add_wander(
    faulty: Faulty, rng: np.random.Generator, sigma: float = 0.015, rho: float = 0.8
) -> None:
    state = sigma * rng.standard_normal(faulty.position.shape[1:])
    for t in range(len(faulty.position)):
        faulty.position[t] += state
        fresh = sigma * np.sqrt(1.0 - rho**2) * rng.standard_normal(state.shape)
        state = rho * state + fresh


def add_everything(faulty: Faulty, rng: np.random.Generator) -> None:
    """Put all faults in; noise first, so that what is exchanged carries its noise along."""
    for add in (add_wander, add_swaps, add_misdetections, add_losses, add_dropouts):
        add(faulty, rng)


FAULTS: dict[str, Callable[[Faulty, np.random.Generator], None]] = {
    "clean": lambda _faulty, _rng: None,
    "swaps": add_swaps,
    "misdetections": add_misdetections,
    "lost": add_losses,
    "dropouts": add_dropouts,
    "spikes": add_spikes,
    "white 1 cm": add_white,
    "AR(1) 1.5 cm": add_wander,
    "everything": add_everything,
}

METHODS: dict[str, dict[str, object]] = {
    "nothing": {"preset": "none"},
    "paper": {"preset": "paper"},
    "default": {},
    "without swap repair": {"repair_swaps": False},
    "without outlier test": {"reject_outliers": False},
    "without both": {"repair_swaps": False, "reject_outliers": False},
    "repair, no smoothing": {"smoother": "none"},
    "kalman with gate": {"gate_probability": 0.999},
    "butterworth": {"smoother": "butterworth"},
    "savitzky_golay": {"smoother": "savitzky_golay"},
    "median": {"smoother": "median", "window_s": 5 / 30},
    "hampel": {"smoother": "hampel", "window_s": 7 / 30},
    "one_euro": {"smoother": "one_euro"},
}


def spoil(clip: Clip, fault: str, seed: int) -> Faulty:
    """Return a clip with faults of one kind; the same seed gives the same faults."""
    faulty = Faulty(clip.position.copy())
    key = [seed, list(FAULTS).index(fault), *clip.name.encode()]
    FAULTS[fault](faulty, np.random.default_rng(key))
    return faulty


def as_track(clip: Clip, position: np.ndarray) -> PoseTrack:
    return PoseTrack(clip.time_s, position, "m", "world", "h36m_17")


# --- angles ----------------------------------------------------------------------------------


def compute_angles(position: np.ndarray) -> dict[str, np.ndarray]:
    """Return the angles per group, shape (T, n), degrees."""
    at = {k: position[:, H36M_17.index(k)] for k in H36M_17.keypoints}
    hips, shoulders = [at[f"{s}_hip"] for s in SIDES], [at[f"{s}_shoulder"] for s in SIDES]
    trunk = {"left_hip": hips[0], "right_hip": hips[1], "mid_shoulder": sum(shoulders) / 2}
    torso = compute_trunk_angles(*shoulders, *hips)[1:4]
    sagittal, coronal = [], []
    for side in SIDES:
        limb = {p: at[f"{side}_{p}"] for g in PARTS.values() for p in g}
        sagittal.append(compute_hip_flexion(limb["hip"], limb["knee"], **trunk))
        sagittal.append(compute_hinge_flexion(limb["hip"], limb["knee"], limb["ankle"]))
        sagittal.append(compute_hinge_flexion(limb["shoulder"], limb["elbow"], limb["wrist"]))
        flexion, adduction = compute_shoulder_angles(
            limb["shoulder"],
            limb["elbow"],
            left_shoulder=shoulders[0],
            right_shoulder=shoulders[1],
            mid_hip=sum(hips) / 2,
            side=side,
        )
        sagittal.append(flexion)
        coronal.append(adduction)
    groups = {"torso": torso, "sagittal": sagittal, "coronal": coronal}
    return {name: np.stack(list(values), axis=1) for name, values in groups.items()}


def angle_errors(truth: dict, position: np.ndarray) -> dict[str, np.ndarray]:
    found = compute_angles(position)
    return {g: np.abs((found[g] - truth[g] + 180.0) % 360.0 - 180.0) for g in truth}


# --- one clip --------------------------------------------------------------------------------


def measure(clip: Clip, fault: str, methods: dict, seed: int) -> Iterator[dict]:
    """Correct one clip by every method; sums and counts, so that clips can be pooled."""
    faulty = spoil(clip, fault, seed)
    raw = as_track(clip, faulty.position)
    truth = compute_angles(clip.position)
    before = angle_errors(truth, faulty.position)
    columns = [H36M_17.index(k) for k in MEASURED]
    for method, settings in methods.items():
        start = time.perf_counter()
        corrected = correct_track(raw, **settings)
        spent = time.perf_counter() - start
        after = angle_errors(truth, corrected.position)
        row = {"fault": fault, "method": method, "clip": clip.name, "frames": len(clip.position)}
        row["ms"] = 1000.0 * spent
        for group in truth:
            both = np.isfinite(before[group]) & np.isfinite(after[group])
            known = np.isfinite(after[group])
            defined = np.isfinite(truth[group])
            row |= {
                f"{group} n": int(both.sum()),
                f"{group} before": float(before[group][both].sum()),
                f"{group} after": float(after[group][both].sum()),
                f"{group} known": int(known.sum()),
                f"{group} all": float(after[group][known].sum()),
                f"{group} defined": int(defined.sum()),
            }
        distance = np.linalg.norm(corrected.position - clip.position, axis=2)[:, columns]
        first = np.linalg.norm(faulty.position - clip.position, axis=2)[:, columns]
        both = np.isfinite(distance) & np.isfinite(first)
        row |= {"joints n": int(both.sum()), "joints before": float(first[both].sum())}
        row |= {"joints after": float(distance[both].sum())}
        row |= {"joints known": int(np.isfinite(distance).sum()), "joints of": distance.size}
        row["joints all"] = float(distance[np.isfinite(distance)].sum())
        yield row


def detect(clip: Clip, fault: str, seed: int) -> Iterator[dict]:
    """Count what the tests of the default chain and of the paper find."""
    faulty = spoil(clip, fault, seed)
    track = as_track(clip, faulty.position)
    found = diagnose(track, min_confidence=0.3)
    present = track.is_present
    exchanged = np.stack(
        [found.swaps.is_exchanged[:, H36M_17.index(f"left_{p[1]}")] for p in PARTS.values()], axis=1
    )
    seen = np.stack(
        [
            present[:, [H36M_17.index(f"{s}_{x}") for s in SIDES for x in p]].any(axis=1)
            for p in PARTS.values()
        ],
        axis=1,
    )
    seen &= ~faulty.lost[:, None]
    base = {"fault": fault, "clip": clip.name}
    yield base | {"class": "swap", **_count(faulty.swapped, exchanged, seen)}
    order = list(H36M_17.mirror_order)
    misplaced = np.where(found.swaps.is_exchanged, faulty.misplaced[:, order], faulty.misplaced)
    outliers = found.outliers
    # The joint beyond a misplaced one goes with it; that is neither right nor wrong.
    beyond = np.zeros_like(misplaced)
    for side in SIDES:
        for near, far in (("elbow", "wrist"), ("knee", "ankle")):
            beyond[:, H36M_17.index(f"{side}_{far}")] |= misplaced[
                :, H36M_17.index(f"{side}_{near}")
            ]
    counted = found.track.is_present & ~(beyond & ~misplaced) & ~faulty.lost[:, None]
    yield base | {
        "class": "misdetection",
        **_count(misplaced, outliers.is_misdetected | outliers.is_lost[:, None], counted),
    }
    yield base | {"class": "lost", **_count(faulty.lost, outliers.is_lost, present.any(axis=1))}
    # A spike is met by smoothing or by rejection; the frame after it holds the way back.
    spikes = faulty.jumping.any(axis=1)
    met = outliers.is_jitter.any(axis=1) | outliers.is_rejected.any(axis=1)
    after = np.append(False, spikes[:-1])
    if fault in ("spikes", "clean"):
        yield base | {"class": "jitter", **_count(spikes, met, spikes | ~after)}
    links = measure_links(track)
    edges = find_edges(track.time_s, links.length_cm)
    wrong = find_excursions(track.time_s, links.length_cm, edges)[0] | edges.is_edge
    any_fault = faulty.swapped.any(axis=1) | faulty.misplaced.any(axis=1) | faulty.lost | spikes
    yield base | {"class": "paper: any fault in the frame", **_count(any_fault, wrong.any(axis=1))}


def _count(true: np.ndarray, found: np.ndarray, where: np.ndarray | None = None) -> dict[str, int]:
    where = np.ones_like(true) if where is None else where
    return {
        "tp": int((true & found & where).sum()),
        "fp": int((~true & found & where).sum()),
        "fn": int((true & ~found & where).sum()),
    }


# --- pictures and other frame rates ----------------------------------------------------------


def detect_swaps_elsewhere(clip: Clip, seed: int) -> Iterator[dict]:
    """Count exchanged sides found in pictures of the clip and at other frame rates.

    Pictures are taken from 4 m by a camera at hip height, 1000 px focal length, with 4 px noise.
    A swap that moves no joint by more than 10 px can't be seen and counts as neither.
    """
    swaps = spoil(clip, "swaps", seed).swapped
    rng = np.random.default_rng([seed, *clip.name.encode()])
    order = list(H36M_17.mirror_order)
    marked = np.zeros(clip.position.shape[:2], dtype=bool)
    for g, group in enumerate(PARTS.values()):
        marked[:, [H36M_17.index(f"{s}_{p}") for p in group for s in SIDES]] = swaps[:, [g]]
    for azimuth in (0, 30, 60, 90):
        exact = _photograph(clip.position, azimuth)
        seen = exact + 4.0 * rng.standard_normal(exact.shape)
        faulty = np.where(marked[:, :, None], seen[:, order], seen)
        track = PoseTrack(clip.time_s, faulty, "px", "image", "h36m_17")
        yield _compare_swaps(f"picture, {azimuth} deg", clip, track, swaps, exact, 10.0)
    noisy = clip.position + 0.01 * rng.standard_normal(clip.position.shape)
    faulty = np.where(marked[:, :, None], noisy[:, order], noisy)
    for every in (2, 3, 6):
        part = slice(None, None, every)
        track = PoseTrack(clip.time_s[part], faulty[part], "m", "world", "h36m_17")
        name = f"m, {FPS / every:g} frames/s"
        yield _compare_swaps(name, clip, track, swaps[part], clip.position[part], 0.1)
    uneven = np.sort(rng.choice(len(faulty), max(4, int(0.7 * len(faulty))), replace=False))
    track = PoseTrack(clip.time_s[uneven], faulty[uneven], "m", "world", "h36m_17")
    yield _compare_swaps(
        "m, 30 % of frames left out", clip, track, swaps[uneven], clip.position[uneven], 0.1
    )


def _photograph(position: np.ndarray, azimuth_deg: float) -> np.ndarray:
    """Return pixels (T, 17, 2); 0 degrees looks at the person's front in the first frame."""
    centre = position[:, H36M_17.index("pelvis")].mean(axis=0)
    line = position[0, H36M_17.index("left_hip")] - position[0, H36M_17.index("right_hip")]
    front = np.arctan2(line[2], line[0]) + np.pi / 2 + np.radians(azimuth_deg)
    right, ahead = (
        np.array([-np.sin(front), 0.0, np.cos(front)]),
        np.array([np.cos(front), 0.0, np.sin(front)]),
    )
    about = position - centre
    distance = np.maximum(4.0 - about @ ahead, 1.0)
    return 1000.0 * np.stack([about @ right, -about[..., 1]], axis=-1) / distance[..., None]


def _compare_swaps(
    case: str,
    clip: Clip,
    track: PoseTrack,
    swapped: np.ndarray,
    exact: np.ndarray,
    visible: float,
) -> dict:
    found = diagnose(track, min_confidence=0.3).swaps.is_exchanged
    columns = [[H36M_17.index(f"{s}_{p}") for s in SIDES] for p in ("shoulder", "hip")]
    exchanged = np.stack([found[:, left] for left, _ in columns], axis=1)
    apart = []
    for group in PARTS.values():
        pairs = [[H36M_17.index(f"{s}_{p}") for s in SIDES] for p in group]
        ways = [np.linalg.norm(exact[:, a] - exact[:, b], axis=1) for a, b in pairs]
        apart.append(np.max(ways, axis=0) > visible)
    return {
        "fault": "swaps",
        "class": case,
        "clip": clip.name,
        **_count(swapped, exchanged, np.stack(apart, axis=1)),
    }


# --- tables ----------------------------------------------------------------------------------


def majae(rows: pd.DataFrame, when: str) -> float:
    """Return the mean over groups weighted by their number of angles, degrees."""
    over = "known" if when == "all" else "n"
    total = sum(
        n * rows[f"{g} {when}"].sum() / max(rows[f"{g} {over}"].sum(), 1) for g, n in GROUPS.items()
    )
    return total / sum(GROUPS.values())


def accuracy_table(rows: pd.DataFrame, *, draws: int, seed: int) -> pd.DataFrame:
    """Return, per fault and method, MAJAE before and after with the 95 % interval of the cut."""
    table = []
    for (fault, method), part in rows.groupby(["fault", "method"], sort=False):
        n_joints = max(part["joints n"].sum(), 1)
        before, after = majae(part, "before"), majae(part, "after")
        per_group = [
            1.0 - part[f"{g} after"].sum() / part[f"{g} before"].sum()
            for g in GROUPS
            if part[f"{g} before"].sum() > 1e-6
        ]
        interval = bootstrap_cut(part, draws, seed) if before > 1e-6 else [np.nan] * 2
        table.append(
            {
                "fault": fault,
                "method": method,
                "MAJAE before": before,
                "after": after,
                "filled too": majae(part, "all"),
                **{g: part[f"{g} after"].sum() / max(part[f"{g} n"].sum(), 1) for g in GROUPS},
                "cut %": 100.0 * (1.0 - after / before) if before > 1e-6 else np.nan,
                "low": interval[0],
                "high": interval[1],
                "mean of rows %": 100.0 * float(np.mean(per_group)) if per_group else np.nan,
                "joint cm before": 100
                * part["joints before"].sum()
                / max(part["joints n"].sum(), 1),
                "joint cm": 100 * part["joints after"].sum() / n_joints,
                "known %": 100 * part["joints known"].sum() / part["joints of"].sum(),
            }
        )
    return pd.DataFrame(table)


def bootstrap_cut(rows: pd.DataFrame, draws: int, seed: int) -> np.ndarray:
    """Return the 95 % interval of the cut in MAJAE, %, with clips drawn with replacement."""
    rng = np.random.default_rng(seed)
    times = rng.multinomial(len(rows), np.full(len(rows), 1.0 / len(rows)), size=draws)
    drawn = {c: times @ rows[c].to_numpy() for c in rows if c.endswith((" n", "before", "after"))}
    error = {
        when: sum(
            n * drawn[f"{g} {when}"] / np.maximum(drawn[f"{g} n"], 1) for g, n in GROUPS.items()
        )
        for when in ("before", "after")
    }
    return np.percentile(100.0 * (1.0 - error["after"] / error["before"]), [2.5, 97.5])


def detection_table(rows: pd.DataFrame) -> pd.DataFrame:
    sums = rows.groupby(["fault", "class"], sort=False)[["tp", "fp", "fn"]].sum()
    tp, fp, fn = sums["tp"], sums["fp"], sums["fn"]
    sums["precision %"] = 100 * tp / (tp + fp)
    sums["recall %"] = 100 * tp / (tp + fn)
    sums["F1 %"] = 200 * tp / (2 * tp + fp + fn)
    return sums[(sums[["tp", "fp", "fn"]].sum(axis=1) > 0)]


def harm_table(table: pd.DataFrame) -> pd.DataFrame:
    """Return the error put into clean clips over the error taken out of the faulty ones, %."""
    wide = table.set_index(["method", "fault"])
    lines = []
    for method in table["method"].unique():
        harm = wide.loc[(method, "clean"), "after"]
        line = {"method": method, "clean clips, deg": harm}
        for fault in ("swaps", "misdetections", "everything"):
            if (method, fault) in wide.index:
                row = wide.loc[(method, fault)]
                gain = row["MAJAE before"] - row["after"]
                line[f"% of the gain: {fault}"] = 100 * harm / gain if gain > 0 else np.inf
        lines.append(line)
    return pd.DataFrame(lines)


def time_table(methods: dict) -> pd.DataFrame:
    """Return ms per frame for one long track of 33 keypoints and one of twice the length."""
    lines = []
    for method, settings in methods.items():
        line = {"method": method}
        for copies in (1, 2, 4):
            track = long_track(copies)
            best = np.inf
            for _ in range(3):
                start = time.process_time()
                correct_track(track, **settings)
                best = min(best, time.process_time() - start)
            line[f"{track.n_frames} frames"] = 1000.0 * best / track.n_frames
        lines.append(line)
    return pd.DataFrame(lines)


def long_track(copies: int) -> PoseTrack:
    """Return 33 keypoints that swing, with noise and faults, 900 frames a copy."""
    rng = np.random.default_rng(1)
    n = 900 * copies
    time_s = np.arange(n) / FPS
    rest = rng.uniform(-0.5, 0.5, (33, 3))
    swing = 0.2 * np.sin(2 * np.pi * 0.5 * time_s)[:, None, None] * rng.standard_normal((33, 3))
    position = rest + swing + 0.01 * rng.standard_normal((n, 33, 3))
    gone = rng.random((n, 33)) < 0.01
    position[gone] = np.nan
    return PoseTrack(time_s, position, "m", "world", "mediapipe_33")


def run(clips: list[Clip], faults: list[str], methods: dict, seed: int) -> tuple:
    accuracy, detection = [], []
    for fault in faults:
        for clip in clips:
            accuracy += measure(clip, fault, methods, seed)
            detection += detect(clip, fault, seed)
        print(f"{fault}: {len(clips)} clips", file=sys.stderr, flush=True)
    return pd.DataFrame(accuracy), pd.DataFrame(detection)


def main() -> None:
    """Run the comparison and print the tables."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--data", type=Path, default=Path("../shared/data"))
    parser.add_argument("--clips", nargs="*", default=["test", "reference"])
    parser.add_argument("--faults", nargs="*", default=list(FAULTS), choices=list(FAULTS))
    parser.add_argument("--methods", nargs="*", default=list(METHODS), choices=list(METHODS))
    parser.add_argument("--limit", type=int, default=600, help="frames of a clip that are used")
    parser.add_argument("--every", type=int, default=1, help="use every n-th clip")
    parser.add_argument("--draws", type=int, default=1000, help="of the bootstrap over clips")
    parser.add_argument("--seed", type=int, default=20240)
    parser.add_argument("--out", type=Path, help="write the tables to this file")
    options = parser.parse_args()
    methods = {m: METHODS[m] for m in options.methods}
    parts = [
        (
            f"Correction of keypoints. {platform.machine()}, Python {platform.python_version()}, "
            f"one thread.\nbenchmarks/correction.py {' '.join(sys.argv[1:])}   seed {options.seed}"
        )
    ]
    for which in options.clips:
        clips = read_clips(options.data, which, options.limit)[:: options.every]
        frames = sum(len(c.position) for c in clips)
        rows, found = run(clips, options.faults, methods, options.seed)
        table = accuracy_table(rows, draws=options.draws, seed=options.seed)
        parts += [
            f"== {which}: {len(clips)} clips, {frames} frames",
            "Detection\n" + detection_table(found).round(2).to_string(),
            "Mean absolute joint-angle error, degrees (weighted 3 torso, 8 sagittal, 2 coronal), "
            "on samples known before and after ('filled too': on all known after); low and high: "
            "95 % of the cut, clips drawn anew\n" + table.round(2).to_string(index=False),
        ]
        elsewhere = pd.DataFrame(
            [row for clip in clips for row in detect_swaps_elsewhere(clip, options.seed)]
        )
        parts.append(
            "Exchanged sides in pictures and at other frame rates\n"
            + detection_table(elsewhere).round(2).to_string()
        )
        if "clean" in options.faults:
            parts.append("Harm\n" + harm_table(table).round(2).to_string(index=False))
    parts.append(
        "Processor time, ms per frame of 33 keypoints\n"
        + time_table(methods).round(3).to_string(index=False)
    )
    text = "\n\n".join(parts)
    print(text)
    if options.out:
        options.out.write_text(text + "\n")


if __name__ == "__main__":
    main()
