"""Markers from two views by Gaussian processes: accuracy, ablations and speed, on synthetic lifts.

Run from the project folder, one study at a time::

    .venv/bin/python benchmarks/twin_gp.py accuracy --data ../shared/data/synthetic_lifts
    .venv/bin/python benchmarks/twin_gp.py ablation --data ../shared/data/synthetic_lifts
    .venv/bin/python benchmarks/twin_gp.py speed --data ../shared/data/synthetic_lifts

Markers are the exact ones of the data set at the times of the pictures; errors are in the
laboratory's axes, without alignment. Settings are chosen inside each training fold. Rows that are
already in the results file are not computed again; give ``--fresh`` to start over. Which features
exist, and their grids, were chosen on the persons P01 and P03; P07 and P08 are for testing only.
"""

from __future__ import annotations

import argparse
import platform
import time
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
import pandas as pd
from scipy.interpolate import CubicSpline
from threadpoolctl import threadpool_limits

from engine.pose.twin_gp import (
    FEATURES,
    REGRESSORS,
    ModelSource,
    combine_features,
    compute_hog,
    describe_landmarks,
    describe_picture,
    describe_video,
    fixed_crop,
    train_model,
)
from engine.video.reader import read_frames

TEST_PERSONS = ("P07", "P08")
PERSONS = ("P01", "P02", "P03", "P04", "P06", *TEST_PERSONS)
CAMERAS = ("cam90", "cam135")
SIZE = (720, 480)
RESULTS = Path("benchmarks/results")
CACHE = Path(".benchmark_cache")
FOLDS = (1, 2, 3, 4)
SEED = 0


@dataclass(frozen=True, eq=False)
class Clip:
    """One trial: exact markers (T, 45, 3), landmarks (T, 33, 2) and boxes of each view."""

    folder: Path
    repetition: int
    markers: np.ndarray
    names: tuple[str, ...]
    landmarks: tuple[np.ndarray, ...]
    boxes: tuple[np.ndarray, ...]


def read_clips(data: Path, person: str) -> list[Clip]:
    """Read a person's trials; landmarks are those `monocular_lifts.py` keeps."""
    clips = []
    for folder in sorted((data / person).glob(f"{person}_*")):
        with np.load(folder / "truth.npz", allow_pickle=False) as truth:
            markers = CubicSpline(truth["time"], truth["markers"])(truth["video_time"])
            names = tuple(map(str, truth["marker_names"]))
        views = []
        for camera in CAMERAS:
            with np.load(CACHE / "monocular_lifts" / f"{folder.name}_{camera}.npz") as seen:
                views.append((seen["image"].astype(float), seen["box"]))
        n = min(len(markers), *(len(image) for image, _ in views))
        clips.append(
            Clip(
                folder,
                int(folder.name[-2:]),
                markers[:n],
                names,
                tuple(image[:n] for image, _ in views),
                tuple(box for _, box in views),
            )
        )
    return clips


def describe(
    clips: list[Clip], features: str, *, views: tuple[int, ...] = (0, 1), noise_px: float = 0.0
) -> tuple[np.ndarray, tuple[int, ...]]:
    """Return the features of all frames of a person, and their blocks."""
    chosen = FEATURES[features]
    rng = np.random.default_rng(SEED)
    rows, blocks = [], ()
    for clip in clips:
        hog = [describe_pictures(clips, clip, v, features) for v in views] if chosen.hog else []
        marks = []
        for view in views if chosen.uses_landmarks else ():
            seen = clip.landmarks[view]
            noisy = seen + noise_px * rng.normal(size=seen.shape)
            marks.append(describe_landmarks(noisy, SIZE, window=chosen.window))
        row, blocks = combine_features(hog=[h[: len(clip.markers)] for h in hog], landmarks=marks)
        rows.append(row)
    return np.concatenate(rows), blocks


def describe_pictures(clips: list[Clip], clip: Clip, view: int, features: str) -> np.ndarray:
    """Return the HoG of one video, from the cache if it is there.

    The crop is around the boxes of the person in all trials: it needs no markers.
    """
    settings = FEATURES[features].hog
    floor = settings.noise_floor or 0
    kind = f"{settings.size_px and settings.size_px[0]}_{settings.cell_px}_{floor:g}"
    file = CACHE / "twin_gp" / f"{clip.folder.name}_{CAMERAS[view]}_{kind}.npy"
    if not file.exists():
        file.parent.mkdir(parents=True, exist_ok=True)
        crop = fixed_crop(np.concatenate([c.boxes[view] for c in clips]), SIZE)
        frames = read_frames(clip.folder / f"{CAMERAS[view]}.mp4")
        part = file.with_suffix(".part.npy")
        np.save(part, describe_video(frames, crop, settings).astype(np.float16))
        part.rename(file)
    return np.load(file).astype(np.float32)


@dataclass(frozen=True, eq=False)
class Data:
    """All frames of one or more persons."""

    features: np.ndarray
    blocks: tuple[int, ...]
    markers: np.ndarray
    trial: np.ndarray
    repetition: np.ndarray
    names: tuple[str, ...]


def gather(clips: list[Clip], features: str, **options: object) -> Data:
    rows, blocks = describe(clips, features, **options)
    lengths = [len(c.markers) for c in clips]
    return Data(
        rows,
        blocks,
        np.concatenate([c.markers for c in clips]),
        np.repeat([c.folder.name for c in clips], lengths),
        np.repeat([c.repetition for c in clips], lengths),
        clips[0].names,
    )


def measure(data: Data, train: np.ndarray, test: np.ndarray, regressor: str) -> dict[str, float]:
    """Train on some frames, predict the trials of others, and return errors in mm and times."""
    start = time.process_time()
    model = train_model(
        data.features[train],
        data.markers[train],
        data.trial[train],
        marker_names=data.names,
        regressor=regressor,
        blocks=data.blocks,
        source=ModelSource("hog"),
        seed=SEED,
    )
    trained = time.process_time()
    errors, z, lengths = [], [], []
    for trial in np.unique(data.trial[test]):
        rows = test & (data.trial == trial)
        got = model.predict(data.features[rows])
        miss = got.markers_m - data.markers[rows]
        errors.append(1000 * np.linalg.norm(miss, axis=2))
        z.append(np.abs(miss) <= 1.96 * got.sigma_m[..., None])
        lengths.append(1000 * np.abs(got.length_error_m))
    error = np.concatenate(errors)
    return {
        "error_mm": float(error.mean()),
        "sd_mm": float(error.mean(axis=1).std()),
        "p95_mm": float(np.percentile(error, 95)),
        "inner_mm": 1000 * model.inner_error_m,
        "length_mm": float(np.concatenate(lengths).mean()),
        "inside_95": float(np.concatenate(z).mean()),
        "train_cpu_s": trained - start,
        "predict_cpu_ms": 1000 * (time.process_time() - trained) / len(error),
        "frames": int(train.sum()),
    }


class Table:
    """Rows kept in a CSV file as they come, so that an interrupted run goes on."""

    def __init__(self, path: Path, *, fresh: bool) -> None:
        self.path = path
        self.rows = [] if fresh or not path.exists() else pd.read_csv(path).to_dict("records")

    def has(self, **key: object) -> bool:
        """Whether there is a row with these values."""
        return any(all(str(row[k]) == str(v) for k, v in key.items()) for row in self.rows)

    def add(self, **row: object) -> None:
        """Keep a row and write all of them."""
        self.rows.append(row)
        self.path.parent.mkdir(parents=True, exist_ok=True)
        pd.DataFrame(self.rows).round(4).to_csv(self.path, index=False)
        print(*(f"{k}={v:.3g}" if isinstance(v, float) else f"{k}={v}" for k, v in row.items()))


def run_accuracy(options: argparse.Namespace) -> None:
    """Trial-wise folds: three repetitions of each task train, the fourth tests."""
    table = Table(RESULTS / "twin_gp_accuracy.csv", fresh=options.fresh)
    for person in options.persons:
        clips = read_clips(options.data, person)
        for features in options.features:
            data = None
            for regressor in options.regressors:
                for fold in options.folds:
                    key = {"person": person, "features": features, "regressor": regressor}
                    if table.has(**key, fold=fold):
                        continue
                    data = data or gather(clips, features)
                    test = data.repetition == fold
                    table.add(**key, fold=fold, **measure(data, ~test, test, regressor))
    write_accuracy(table)


def write_accuracy(table: Table) -> None:
    rows = pd.DataFrame(table.rows)
    rows["persons"] = np.where(rows.person.isin(TEST_PERSONS), "test", "training")
    per_person = rows.pivot_table(
        index=["features", "regressor"], columns="person", values="error_mm", aggfunc="mean"
    )
    columns = ["error_mm", "p95_mm", "length_mm", "inside_95", "train_cpu_s", "predict_cpu_ms"]
    groups = rows.groupby(["features", "regressor", "persons"])
    text = "\n\n".join(
        f"{title}\n{frame.round(2).to_string()}"
        for title, frame in (
            ("Mean marker error, mm, per person (mean over the folds done)", per_person),
            ("Means over persons and folds", groups[columns].mean()),
            ("Folds done", groups.size().to_frame("folds")),
        )
    )
    write(RESULTS / "twin_gp_accuracy.txt", "accuracy", text)


def list_ablations(clips: list[Clip]) -> Iterator[tuple[str, str, Data, np.ndarray, np.ndarray]]:
    """Yield study, level, data and the frames to train and to test on; repetition 4 tests."""
    features = "landmarks"
    data = gather(clips, features)
    test = data.repetition == 4
    for count in (1, 2, 3):
        yield "training repetitions", str(count), data, data.repetition <= count, test
    for noise in (2.0, 5.0, 10.0):
        yield "noise, px", f"{noise:g}", gather(clips, features, noise_px=noise), ~test, test
    for name, view in (("first only", 0), ("second only", 1)):
        yield "views", name, gather(clips, features, views=(view,)), ~test, test
    rng = np.random.default_rng(SEED)
    chance = rng.integers(0, 4, len(data.trial)) == 3
    yield "folds", "random frames (leaky)", data, ~chance, chance


def run_ablation(options: argparse.Namespace) -> None:
    """One change at a time, landmarks as features, repetition 4 as test."""
    table = Table(RESULTS / "twin_gp_ablation.csv", fresh=options.fresh)
    for person in options.persons:
        for study, level, data, train, test in list_ablations(read_clips(options.data, person)):
            for regressor in options.regressors:
                key = {"person": person, "study": study, "level": level, "regressor": regressor}
                if not table.has(**key):
                    table.add(**key, **measure(data, train, test, regressor))
    run_subjects(options, table)
    rows = pd.DataFrame(table.rows)
    means = rows.pivot_table(
        index=["study", "level"], columns="regressor", values="error_mm", aggfunc="mean"
    )
    lengths = rows.pivot_table(
        index=["study", "level"], columns="regressor", values="length_mm", aggfunc="mean"
    )
    text = (
        f"Persons {', '.join(sorted(set(rows.person)))}\n\n"
        f"Mean marker error, mm\n{means.round(2).to_string()}\n\n"
        f"Mean error of upper-limb lengths, mm\n{lengths.round(2).to_string()}"
    )
    write(RESULTS / "twin_gp_ablation.txt", "ablation", text)


def run_subjects(options: argparse.Namespace, table: Table) -> None:
    """Leave one subject out: all other training persons together."""
    person = options.persons[0]
    open_rows = [
        r
        for r in options.regressors
        if not table.has(person=person, study="folds", level="subject left out", regressor=r)
    ]
    if not open_rows:
        return
    everybody = sorted({person, *(p for p in PERSONS if p not in TEST_PERSONS)})
    parts = {p: gather(read_clips(options.data, p), "landmarks") for p in everybody}
    joined = replace(
        parts[person],
        features=np.concatenate([d.features for d in parts.values()]),
        markers=np.concatenate([d.markers for d in parts.values()]),
        trial=np.concatenate([d.trial for d in parts.values()]),
    )
    test = np.char.startswith(joined.trial.astype(str), person)
    for regressor in open_rows:
        key = {"person": person, "study": "folds", "level": "subject left out"}
        table.add(**key, regressor=regressor, **measure(joined, ~test, test, regressor))


def run_speed(options: argparse.Namespace) -> None:
    """CPU time of one thread, beside peers in the same run."""
    from skimage.feature import hog

    cv2.setNumThreads(1)
    person = options.persons[0]
    clips = read_clips(options.data, person)
    frames = list(read_frames(clips[0].folder / "cam90.mp4"))[:60]
    crop = fixed_crop(clips[0].boxes[0], SIZE)
    grey = cv2.cvtColor(frames[0].image, cv2.COLOR_RGB2GRAY)
    small = cv2.resize(grey, (128, 256))
    peer = cv2.HOGDescriptor((128, 256), (16, 16), (8, 8), (8, 8), 9)
    cells = {"pixels_per_cell": (8, 8), "cells_per_block": (2, 2), "block_norm": "L2-Hys"}
    whole = FEATURES["hog-paper"].hog
    rows = [
        ("scikit-image, 128 x 256", lambda: hog(small, 9, **cells)),
        ("OpenCV, 128 x 256 (other numbers)", lambda: peer.compute(small)),
        ("compute_hog, 128 x 256", lambda: compute_hog(small)),
        ("scikit-image, 720 x 480", lambda: hog(grey, 9, **cells)),
        ("compute_hog, 720 x 480", lambda: compute_hog(grey)),
    ]
    for name in ("hog", "hog-soft"):
        settings = FEATURES[name].hog
        rows.append(
            (
                f"features {name}: crop, grey, resize and describe, one view",
                lambda s=settings: describe_picture(frames[0].image, crop, s),
            )
        )
    rows.append(
        ("features hog-paper, one view", lambda: describe_picture(frames[0].image, None, whole))
    )
    lines = [f"{name:66s} {time_ms(call):8.2f} ms" for name, call in rows]
    lines += list(time_estimators(clips, options.regressors))
    write(RESULTS / "twin_gp_speed.txt", "speed", "\n".join(lines))


def time_ms(call: object, repeats: int = 15) -> float:
    """Return the median CPU time of a call, ms."""
    call()
    times = []
    for _ in range(repeats):
        start = time.process_time()
        call()
        times.append(1000 * (time.process_time() - start))
    return float(np.median(times))


def time_estimators(clips: list[Clip], names: list[str]) -> Iterator[str]:
    """Time training of a subject (all trials) and prediction with 900 training frames."""
    data = gather(clips, "landmarks")
    train = data.repetition != 4
    few = np.flatnonzero(train)[np.linspace(0, train.sum() - 1, 900).astype(int)]
    rows = data.features[~train][:300]
    for name in names:
        start = time.process_time()
        whole = train_model(
            data.features, data.markers, data.trial, marker_names=data.names, regressor=name
        )
        searched = time.process_time() - start
        model = train_model(
            data.features[few],
            data.markers[few],
            data.trial[few],
            marker_names=data.names,
            regressor=name,
            hyper=whole.hyper,
        )
        model.predict(rows[:2])
        each = time_ms(lambda m=model: m.predict(rows), 3) / len(rows)
        yield (
            f"{name:16s} training on {len(data.markers)} frames, search included: "
            f"{searched:6.1f} s; prediction with {len(few)} training frames: {each:6.2f} ms a frame"
        )


def write(path: Path, study: str, text: str) -> None:
    """Write a result with what made it."""
    head = (
        f"Synthetic lifts. seed {SEED}; command: .venv/bin/python benchmarks/twin_gp.py {study}\n"
        f"{platform.machine()}, Python {platform.python_version()}, one thread, CPU times\n\n"
    )
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(head + text + "\n")
    print(head + text)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("study", choices=("accuracy", "ablation", "speed"))
    parser.add_argument("--data", type=Path, required=True)
    parser.add_argument("--persons", nargs="+", default=list(PERSONS))
    parser.add_argument("--features", nargs="+", default=[*FEATURES])
    parser.add_argument("--regressors", nargs="+", default=[*REGRESSORS])
    parser.add_argument("--folds", nargs="+", type=int, default=list(FOLDS))
    parser.add_argument("--fresh", action="store_true", help="forget earlier rows")
    options = parser.parse_args()
    studies = {"accuracy": run_accuracy, "ablation": run_ablation, "speed": run_speed}
    with threadpool_limits(limits=1, user_api="blas"):
        studies[options.study](options)


if __name__ == "__main__":
    main()
