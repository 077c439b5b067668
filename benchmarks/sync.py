"""How well two videos are aligned, on the synthetic lifting trials (both cameras start together).

Run from the project folder, once `benchmarks/monocular_lifts.py` has cached the keypoints::

    .venv/bin/python benchmarks/sync.py --data ../shared/data/synthetic_lifts

True pairs are cut, shifted, sampled at other rates, disturbed and run with other clocks; false
pairs are two lifts. Nothing was chosen on the persons P07 and P08. Sounds are made here: knocks,
hammering by hand and by a machine, and noise like speech, through a random room for each camera.

``--fit`` fits the constants of the evidence (`engine.video.sync.EVIDENCE`) anew, on the training
persons and on figures that move at random, and prints them.
"""

from __future__ import annotations

import argparse
import dataclasses
import itertools
import json
import os
import platform
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pandas as pd
from monocular_lifts import TEST_PERSONS, load_pose
from scipy.interpolate import interp1d
from scipy.optimize import minimize
from scipy.signal import fftconvolve, lfilter

from engine import Config
from engine.datatypes import Camera, CheckLevel, PoseTrack, SubjectState, SyncEstimate, ViewPose
from engine.video import sync
from engine.video._audio import RATE_HZ, AudioTrack, estimate_audio_lag
from engine.video.sync import estimate_offset, refine_offset

FRAME_MS = 1000.0 / 30.0
RIGHT_S = 0.1
CAMERAS = ("cam90", "cam135")
TASKS = ("FK", "KS", "FS")
LEVELS = tuple(level.value for level in CheckLevel)


def pick(pose: ViewPose, keep: np.ndarray, time_s: np.ndarray) -> ViewPose:
    """Return some frames of a view with new times."""
    track = pose.image
    image = PoseTrack(
        time_s, track.position[keep], "px", "image", track.skeleton, track.confidence[keep]
    )
    state = tuple(s for s, k in zip(pose.state, keep, strict=True) if k)
    return dataclasses.replace(pose, image=image, body=None, box=pose.box[keep], state=state)


def cut(pose: ViewPose, start_s: float, stop_s: float) -> ViewPose:
    """Return a part, whose first frame is at zero."""
    time_s = pose.image.time_s
    keep = (time_s >= start_s - 1e-9) & (time_s <= stop_s + 1e-9)
    return pick(pose, keep, time_s[keep] - time_s[keep][0])


def start_of(pose: ViewPose, start_s: float) -> float:
    """Return the time of the first frame from `start_s` on."""
    time_s = pose.image.time_s
    return float(time_s[time_s >= start_s - 1e-9][0])


def at_times(pose: ViewPose, seen_s: np.ndarray, clock_s: np.ndarray) -> ViewPose:
    """Film again: cubic between the frames, at other moments, stamped by another clock."""
    track = pose.image
    known = np.isfinite(pose.box).all(axis=1) & track.is_present.all(axis=1)
    nearest = np.clip(np.searchsorted(track.time_s, seen_s), 0, track.n_frames - 1)
    lost = ~(known[nearest] & known[np.maximum(nearest - 1, 0)])

    def film(values: np.ndarray, kind: str) -> np.ndarray:
        new = interp1d(track.time_s[known], values[known], kind, axis=0, fill_value="extrapolate")(
            seen_s
        )
        new[lost] = np.nan
        return new

    confidence = film(track.confidence, "linear")
    image = PoseTrack(
        clock_s, film(track.position, "cubic"), "px", "image", track.skeleton, confidence
    )
    state = tuple(SubjectState.LOST if gone else SubjectState.TRACKED for gone in lost)
    return dataclasses.replace(
        pose, image=image, body=None, box=film(pose.box, "linear"), state=state
    )


def at_rate(
    pose: ViewPose, rate: float, rng: np.random.Generator, jitter: float = 0.0
) -> tuple[ViewPose, float]:
    """Film at another rate from another moment on; also returns that moment."""
    first, last = pose.image.time_s[[0, -1]]
    start = first + rng.uniform(0.0, 1.0 / rate)
    seen = np.arange(start, last, 1.0 / rate)
    seen = np.sort(seen + rng.uniform(-jitter, jitter, seen.size) / rate)
    seen = seen[(seen >= first) & (seen <= last)]
    return at_times(pose, seen, seen - seen[0]), float(seen[0] - first)


def disturb(pose: ViewPose, rng: np.random.Generator, noise_px: float, gap_s: float) -> ViewPose:
    """Add noise to the keypoints, and lose the person for a while."""
    position = pose.image.position + rng.normal(0.0, noise_px, pose.image.position.shape)
    box = pose.box.copy()
    time_s = pose.image.time_s
    begin = rng.uniform(0.0, max(time_s[-1] - gap_s, 0.01))
    lost = (time_s > begin) & (time_s < begin + gap_s)
    position[lost], box[lost] = np.nan, np.nan
    image = dataclasses.replace(pose.image, position=position, status=None)
    return dataclasses.replace(pose, image=image, box=box)


def join(poses: list[ViewPose]) -> ViewPose:
    """Show clips one after the other."""
    times, start = [], 0.0
    for pose in poses:
        times.append(pose.image.time_s + start)
        start = times[-1][-1] + 1.0 / 30.0
    image = PoseTrack(
        np.concatenate(times),
        np.concatenate([p.image.position for p in poses]),
        "px",
        "image",
        poses[0].image.skeleton,
        np.concatenate([p.image.confidence for p in poses]),
    )
    state = tuple(s for p in poses for s in p.state)
    box = np.concatenate([p.box for p in poses])
    return dataclasses.replace(poses[0], image=image, body=None, box=box, state=state)


def random_parts(length_s: float, least_s: float, rng: np.random.Generator) -> list[tuple]:
    """Return two overlapping parts of a clip, one its start, the other its end."""
    overlap = rng.uniform(least_s, length_s)
    start = rng.uniform(0.0, length_s - overlap)
    parts = [(0.0, start + overlap), (start, length_s)]
    return parts if rng.random() < 0.5 else parts[::-1]


Pair = tuple[str, ViewPose, ViewPose, float, float]
"""Kind, both views, true offset (NaN for false pairs) and true drift."""


def make_true_pairs(first: ViewPose, second: ViewPose, rng: np.random.Generator) -> Iterator[Pair]:
    """Make what users do to one lift filmed twice."""
    length = float(min(first.image.time_s[-1], second.image.time_s[-1]))
    yield "as filmed", first, second, 0.0, 0.0
    for kind, least in (("cut, overlap > 3 s", 3.0), ("cut, overlap 1.5-3 s", 1.5)):
        whole = length if least == 3.0 else 3.0
        parts = random_parts(min(whole, length), least, rng)
        a, b = (cut(v, *p) for v, p in zip((first, second), parts, strict=True))
        offset = start_of(second, parts[1][0]) - start_of(first, parts[0][0])
        yield kind, a, b, offset, 0.0
    parts = random_parts(length, 3.0, rng)
    a, b = (cut(v, *p) for v, p in zip((first, second), parts, strict=True))
    offset = start_of(second, parts[1][0]) - start_of(first, parts[0][0])
    for rate, jitter in ((24.0, 0.0), (25.0, 0.0), (59.94, 0.0), (30.0, 0.4)):
        film, late = at_rate(b, rate, rng, jitter)
        kind = "uneven steps" if jitter else f"{rate:g} against 30 per s"
        yield kind, a, film, offset + late, 0.0
    yield "noise 4 px, lost for 0.5 s", a, disturb(b, rng, 4.0, 0.5), offset, 0.0


def make_false_pairs(
    name: str, views: dict[tuple[str, str], ViewPose], rng: np.random.Generator
) -> Iterator[Pair]:
    """Make pairs of two lifts, and of two parts of one lift that do not overlap."""
    first = views[name, CAMERAS[0]]
    persons, tasks = name[:3], name[4:6]
    groups = {
        "same person, same task": [n for n, _ in views if n[:6] == name[:6] and n != name],
        "other person, same task": [n for n, _ in views if n[:3] != persons and n[4:6] == tasks],
        "same person, other task": [n for n, _ in views if n[:3] == persons and n[4:6] != tasks],
    }
    for kind, names in groups.items():
        for other in rng.choice(sorted(set(names)), 2, replace=False):
            yield kind, first, views[other, CAMERAS[1]], np.nan, 0.0
    second = views[name, CAMERAS[1]]
    middle = float(first.image.time_s[-1]) * rng.uniform(0.4, 0.6)
    halves = cut(first, 0.0, middle), cut(second, middle + 0.05, np.inf)
    yield "one lift, no overlap", *halves, np.nan, 0.0


def measure(pair: Pair, cameras: list[Camera] | None = None) -> dict[str, float | str]:
    """Estimate one offset."""
    kind, first, second, offset, drift = pair
    begin = time.perf_counter()
    estimate = estimate_offset(first, second)
    spent = time.perf_counter() - begin
    row = {"kind": kind, **describe(estimate, offset, drift, second), "ms": 1e3 * spent}
    if cameras is not None and not np.isnan(offset):
        begin = time.perf_counter()
        sharper = refine_offset(first, second, cameras, estimate)
        row["refine ms"] = 1e3 * (time.perf_counter() - begin)
        found = describe(sharper, offset, drift, second)
        row |= {f"refined {k}": found[k] for k in ("error_ms", "z", "level")}
    return row


def describe(estimate: SyncEstimate, offset: float, drift: float, second: ViewPose) -> dict:
    """Compare an estimate with the truth in the middle of the second video."""
    middle = float(second.image.time_s.mean())
    error = estimate.offset_s - offset + (estimate.drift - drift) * middle
    return {
        "level": estimate.level.value,
        "confidence": estimate.confidence,
        "error_ms": 1e3 * error,
        "z": error / estimate.sigma_s,
        "drift_ppm": 1e6 * estimate.drift,
    }


def read_cameras(person: Path) -> list[Camera]:
    """Return the true cameras of a person's trials."""
    found = {c["name"]: c for c in json.loads((person / "subject.json").read_text())["calibration"]}
    return [
        Camera(n, (found[n]["width"], found[n]["height"]), *(found[n][k] for k in ("K", "R", "t")))
        for n in CAMERAS
    ]


def run_trials(data: Path, cache: Path, seed: int) -> pd.DataFrame:
    """Measure all pairs of all persons."""
    rows = []
    persons = sorted(p.name for p in data.glob("P*"))
    for group in ("training", "test"):
        inside = [p for p in persons if (p in TEST_PERSONS) == (group == "test")]
        names = [d.name for p in inside for d in sorted((data / p).glob(f"{p}_*"))]
        views = {
            (n, c): load_pose(data / n[:3] / n / f"{c}.mp4", cache, Config())
            for n in names
            for c in CAMERAS
        }
        for i, name in enumerate(names):
            rng = np.random.default_rng([seed, i, len(inside)])
            cameras = read_cameras(data / name[:3])
            both = [views[name, c] for c in CAMERAS]
            rows += [measure(p, cameras) | {"pair": "true"} for p in make_true_pairs(*both, rng)]
            rows += [measure(p) | {"pair": "false"} for p in make_false_pairs(name, views, rng)]
            same = ("one clip twice", both[0], cut(both[0], 0.6, np.inf), np.nan, 0.0)
            rows.append(measure(same) | {"pair": "false"})
            for row in rows:
                row.setdefault("persons", group)
            print(f"{name} done", file=sys.stderr, flush=True)
        rng = np.random.default_rng([seed, len(inside)])
        long = run_long(names, views, rng)
        rows += [row | {"persons": group, "pair": "true"} for row in long]
    return pd.DataFrame(rows)


def run_long(names: list[str], views: dict, rng: np.random.Generator) -> Iterator[dict]:
    """Measure long recordings with other clocks, and ten minutes against ten seconds."""
    for repeat in range(4):
        order = rng.permutation(names)[:24]
        first, second = (join([views[n, c] for n in order]) for c in CAMERAS)
        for ppm in (0.0, 50.0, 100.0, 200.0):
            late, drift = rng.uniform(1.0, 10.0), 1e-6 * ppm * (-1) ** repeat
            seen = second.image.time_s[second.image.time_s > late]
            film = at_times(second, seen, (seen - seen[0]) / (1.0 + drift))
            kind = f"2 min, clocks differ {ppm:.0f} ppm"
            yield measure((kind, first, film, float(seen[0]), drift))
    whole = join([views[n, CAMERAS[0]] for n in (names * 5)[:120]])
    once, start = join([views[n, CAMERAS[0]] for n in names]), 0.0
    for name in names:
        clip = views[name, CAMERAS[1]]
        yield measure(("all trials against one", once, clip, start, 0.0))
        start += clip.image.time_s[-1] + 1.0 / 30.0
    yield measure(("10 min against one, shown repeatedly", whole, clip, np.nan, 0.0))


def speech(length: int, rng: np.random.Generator) -> np.ndarray:
    """Make noise with the rhythm and bands of speech."""
    sound = np.zeros(length)
    position = 0
    while position < length:
        count = int(rng.uniform(0.08, 0.3) * RATE_HZ)
        pole = 0.97 * np.exp(2j * np.pi * rng.uniform(200, 2500) / RATE_HZ)
        part = lfilter([1], np.real(np.poly([pole, pole.conj()])), rng.normal(size=count))
        part *= np.hanning(count) / max(part.std(), 1e-9)
        stop = min(length, position + count)
        sound[position:stop] += part[: stop - position]
        position += count + int(rng.exponential(0.12) * RATE_HZ)
    return sound


def knocks(length: int, times: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Make short dull knocks at given times."""
    sound = np.zeros(length)
    for at in times:
        begin = int(at * RATE_HZ)
        count = min(length - begin, int(0.08 * RATE_HZ))
        if count > 0:
            decay = np.exp(-np.arange(count) / (0.012 * RATE_HZ))
            sound[begin : begin + count] += rng.uniform(3, 9) * decay * rng.normal(size=count)
    return sound


def make_sound(kind: str, seconds: float, rng: np.random.Generator) -> np.ndarray:
    length = int(seconds * RATE_HZ)
    if kind == "claps":
        return knocks(length, rng.uniform(0.5, seconds - 0.5, 3), rng)
    if kind == "hammering by hand":
        return knocks(length, np.cumsum(rng.normal(0.6, 0.05, int(seconds / 0.6) + 1)), rng)
    if kind == "hammering by machine":
        return knocks(length, np.arange(0.2, seconds, 0.5), np.random.default_rng(5)) * 1.0
    return speech(length, rng)


def hear(
    sound: np.ndarray, start_s: float, stop_s: float, noise_db: float, rng: np.random.Generator
) -> AudioTrack:
    """Record a part through a room of its own, with noise so many dB below the sound."""
    decay = np.exp(-np.arange(int(0.35 * RATE_HZ)) / (rng.uniform(0.04, 0.1) * RATE_HZ))
    room = 0.25 * decay * rng.normal(size=decay.size)
    room[0] = 1.0
    heard = fftconvolve(sound, room)[: len(sound)]
    heard = heard[round(start_s * RATE_HZ) : round(stop_s * RATE_HZ)] * rng.uniform(0.2, 1.0)
    noise = lfilter([1], [1, -0.7], rng.normal(size=heard.size))
    noise *= heard.std() * 10 ** (-noise_db / 20) / noise.std()
    heard = heard + noise
    return AudioTrack((0.3 * heard / np.abs(heard).max()).astype(np.float32))


def run_sounds(seed: int, n: int) -> pd.DataFrame:
    """Measure lags of made sounds, and of sounds of two scenes."""
    rows = []
    for kind in ("claps", "hammering by hand", "hammering by machine", "speech"):
        for noise_db in (20.0, 6.0, 0.0):
            for i in range(n):
                rng = np.random.default_rng([seed, i, len(kind), int(noise_db)])
                length = 14.0
                sound, other = (make_sound(kind, length, rng) for _ in range(2))
                late, early = rng.uniform(0.0, 5.0), rng.uniform(9.0, length)
                a = hear(sound, 0.0, early, noise_db, rng)
                late = round(late * RATE_HZ) / RATE_HZ
                for pair, source in (("true", sound), ("false", other)):
                    found = estimate_audio_lag(a, hear(source, late, length, noise_db, rng))
                    error = found.offset_s - late
                    rows.append(
                        {
                            "kind": kind,
                            "noise dB": -noise_db,
                            "pair": pair,
                            "error_ms": 1e3 * error,
                            "z": error / found.sigma_s,
                            "confidence": found.confidence,
                        }
                    )
    return pd.DataFrame(rows)


def describe_candidates(first: ViewPose, second: ViewPose, offset: float) -> Iterator[tuple]:
    """Return of every candidate what its evidence is made of, and whether it is right."""
    for candidate in sync._find_candidates(*sync._compute_motions(first, second)):
        found = candidate.comparison
        yield (
            np.log(found.timing_rms_s + sync.SCATTER_FLOOR_S),
            np.log(min(found.n_parts, sync.MAX_PARTS)),
            max(0.0, sync.USUAL_CORRELATION - found.correlation),
            abs(found.offset_s - offset) < RIGHT_S,
        )


def make_figures(seed: int) -> Iterator[tuple[ViewPose, ViewPose, float]]:
    """Make true and false pairs of figures that move at random, with 1 to 4 px of noise."""
    sys.path.insert(0, str(Path(__file__).parents[1]))
    from tests.engine.video.sync_scenes import film, frames, look_from, make_lift

    side, oblique = look_from(90.0), look_from(130.0, height_m=1.5)
    for i in range(5000, 5110):
        rng = np.random.default_rng([seed, i])
        lift, other, noise = make_lift(i), make_lift(i + 100_000), rng.uniform(1.0, 4.0)
        first = film(lift, side, frames(0.0, 7.0), noise_px=noise)
        seen = frames(0.0, rng.uniform(2.0, 8.0))
        yield first, film(other, oblique, seen, noise_px=noise, seed=2), np.nan
        start = 7.0 - rng.uniform(1.2, 5.0)
        yield first, film(lift, oblique, frames(start, 8.0), noise_px=noise, seed=2), start


def fit_evidence(data: Path, cache: Path, seed: int) -> np.ndarray:
    """Fit the log-odds by logistic regression; true and false candidates weigh the same in sum."""
    persons = [p.name for p in sorted(data.glob("P*")) if p.name not in TEST_PERSONS]
    names = [d.name for p in persons for d in sorted((data / p).glob(f"{p}_*"))]
    views = {
        (n, c): load_pose(data / n[:3] / n / f"{c}.mp4", cache, Config())
        for n in names
        for c in CAMERAS
    }
    rows: list[tuple] = []
    for i, name in enumerate(names):
        rng = np.random.default_rng([seed, 77, i])
        for kind, *views_and_truth in make_true_pairs(*(views[name, c] for c in CAMERAS), rng):
            if not kind.startswith(("25", "59", "uneven")):  # as the others, so they add little
                rows += describe_candidates(*views_and_truth[:3])
        for _, first, second, offset, _ in make_false_pairs(name, views, rng):
            rows += describe_candidates(first, second, offset)
            length = float(min(first.image.time_s[-1], second.image.time_s[-1]))
            parts = random_parts(length, 1.5, rng)
            rows += describe_candidates(cut(first, *parts[0]), cut(second, *parts[1]), offset)
    for pair in make_figures(seed):
        rows += describe_candidates(*pair)
    table = np.array(rows, dtype=float)
    right = table[:, 3] > 0.5
    design = np.column_stack([np.ones(len(table)), table[:, :3]])
    weight = np.where(right, 0.5 / right.mean(), 0.5 / (1.0 - right.mean()))
    sign = np.where(right, -1.0, 1.0)

    def loss(constants: np.ndarray) -> float:
        return float(np.mean(weight * np.logaddexp(0.0, sign * (design @ constants))))

    found = minimize(loss, np.zeros(4))
    print(f"{right.sum()} true and {(~right).sum()} false candidates, log loss {found.fun:.4f}")
    return found.x


def run_real(data: Path, cache: Path) -> pd.DataFrame:
    """Measure all pairs of the real cameras, which ran in step."""
    views = {v.stem: load_pose(v, cache, Config()) for v in sorted(data.glob("cam*.mp4"))}
    rows = []
    for a, b in itertools.combinations(views, 2):
        row = measure(("real", views[a], views[b], 0.0, 0.0))
        rows.append({"cameras": f"{a}, {b}", **row})
    return pd.DataFrame(rows)[["cameras", "level", "confidence", "error_ms", "z", "ms"]].round(2)


def tabulate_true(rows: pd.DataFrame) -> pd.DataFrame:
    """Summarise true pairs; errors are of those that were not refused."""

    def line(part: pd.DataFrame) -> pd.Series:
        used = part[part.level != "red"]
        error = used.error_ms.abs()
        values = {
            "n": len(part),
            **{level: int((part.level == level).sum()) for level in LEVELS},
            "wrong": int((error > 1e3 * RIGHT_S).sum()),
            "median ms": error.median(),
            "p95 ms": error.quantile(0.95),
            "p95 frames": error.quantile(0.95) / FRAME_MS,
            "in 95 %": (used.z.abs() <= 1.96).mean(),
        }
        if "refined error_ms" in used and used["refined error_ms"].notna().any():
            sharper = used["refined error_ms"].abs()
            values |= {
                "cams median ms": sharper.median(),
                "cams p95 ms": sharper.quantile(0.95),
                "cams p95 frames": sharper.quantile(0.95) / FRAME_MS,
                "cams in 95 %": (used["refined z"].dropna().abs() <= 1.96).mean(),
            }
        return pd.Series(values)

    return _by_kind(rows, line)


def tabulate_false(rows: pd.DataFrame) -> pd.DataFrame:
    """Summarise false pairs."""

    def line(part: pd.DataFrame) -> pd.Series:
        return pd.Series(
            {
                "n": len(part),
                **{level: int((part.level == level).sum()) for level in LEVELS},
                "green share": (part.level == "green").mean(),
                "not refused share": (part.level != "red").mean(),
            }
        )

    return _by_kind(rows, line)


def tabulate_sound(rows: pd.DataFrame) -> pd.DataFrame:
    """Summarise sounds: how often sure (0.5 and 0.9), and errors of the sure ones."""

    def line(part: pd.DataFrame) -> pd.Series:
        sure = part[part.confidence >= 0.5]
        error = sure.error_ms.abs()
        return pd.Series(
            {
                "n": len(part),
                "sure 0.5": len(sure),
                "sure 0.9": int((part.confidence >= 0.9).sum()),
                "wrong": int((error > 50.0).sum()),
                "median ms": error.median(),
                "p95 ms": error.quantile(0.95),
            }
        )

    lines = {k: line(g) for k, g in rows.groupby(["pair", "kind", "noise dB"], sort=False)}
    return pd.DataFrame(lines).T.round(2)


def _by_kind(rows: pd.DataFrame, line) -> pd.DataFrame:
    lines = {}
    for persons in ("training", "test"):
        group = rows[rows.persons == persons]
        for kind, part in group.groupby("kind", sort=False):
            lines[persons, kind] = line(part)
        lines[persons, "ALL"] = line(group)
    table = pd.concat(lines, axis=1).T
    order = list(dict.fromkeys(key for part in lines.values() for key in part.index))
    table = table[order].round(2)
    whole = [c for c in ("n", *LEVELS, "wrong") if c in table]
    return table.astype(dict.fromkeys(whole, int))


def summarise(rows: pd.DataFrame, sounds: pd.DataFrame, real: pd.DataFrame) -> str:
    """Return the tables."""
    true, false = rows[rows.pair == "true"], rows[rows.pair == "false"]
    shown = false[~false.kind.eq("one clip twice")]
    same = false[false.kind.eq("one clip twice")]
    long = true[true.kind.str.startswith("2 min")]
    drift = long.groupby("kind").drift_ppm.agg(["min", "median", "max"]).round(1)
    again = true.kind.str.contains("repeatedly")
    parts = (
        ("True pairs: level, |error| where not refused, without and with cameras", true[~again]),
        ("False pairs: two lifts, or two parts of one lift", shown),
        ("One clip twice (the second starts 0.6 s later)", same),
    )
    tables = [f"{parts[0][0]}\n{tabulate_true(parts[0][1]).to_string()}"]
    tables += [f"{title}\n{tabulate_false(part).to_string()}" for title, part in parts[1:]]
    tables.append(f"Fitted drift, ppm (clocks differ by + or - that much)\n{drift.to_string()}")
    tables.append(
        "A clip that is shown repeatedly in 10 min must not be green\n"
        f"{true[again][['persons', 'level', 'confidence', 'ms']].round(3).to_string(index=False)}"
    )
    tables.append(
        "Real cameras in step, 1.7 s at 60 per s (a picture is 17 ms), not used to choose anything"
        f"\n{real.to_string(index=False)}"
    )
    tables.append(f"Sound alone\n{tabulate_sound(sounds).to_string()}")
    speed = rows.groupby("kind")[["ms", "refine ms"]].median().round(0)
    tables.append(f"Time, median ms\n{speed.to_string()}")
    return "\n\n".join(tables)


def main() -> None:
    """Run the comparison and print the tables."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--data", type=Path, default=Path("../shared/data/synthetic_lifts"))
    parser.add_argument("--cache", type=Path, default=Path(".benchmark_cache/monocular_lifts"))
    parser.add_argument("--real", type=Path, default=Path("../shared/data/real_four_view"))
    parser.add_argument("--seed", type=int, default=4)
    parser.add_argument("--sounds", type=int, default=20, help="of each kind and loudness")
    parser.add_argument("--out", type=Path, default=Path("benchmarks/results/sync.txt"))
    parser.add_argument("--fit", action="store_true", help="fit the evidence and stop")
    options = parser.parse_args()
    if options.fit:
        print(np.round(fit_evidence(options.data, options.cache, options.seed), 2))
        return
    rows = run_trials(options.data, options.cache, options.seed)
    sounds = run_sounds(options.seed, options.sounds)
    real = run_real(options.real, options.cache.parent / "real_four_view")
    head = (
        f"Two videos aligned, synthetic lifts and made sounds. Command: python benchmarks/sync.py "
        f"--seed {options.seed} --sounds {options.sounds}\n{platform.machine()}, "
        f"{os.cpu_count()} cores, Python {platform.python_version()}"
    )
    text = f"{head}\n\n{summarise(rows, sounds, real)}\n"
    options.out.write_text(text)
    rows.round(3).to_csv(options.out.with_suffix(".csv"), index=False)
    print(text)


if __name__ == "__main__":
    main()
