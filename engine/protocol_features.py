"""Features of the pictures for the validation protocol, in a space small enough to learn in."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from engine.datatypes import Array, ProgressCallback, View, ViewPose, ignore_progress
from engine.errors import ConfigError, DataError, ShapeError
from engine.pose.twin_gp import (
    FEATURES,
    Crop,
    FeatureSet,
    combine_features,
    describe_landmarks,
    describe_video,
    fixed_crop,
)
from engine.protocol_inputs import Cache, PersonData, stamp
from engine.storage.atomic import scratch_folder
from engine.validation.protocol.dataset import TrialFiles
from engine.video.reader import read_frames

__all__ = ["Embedding", "Observe", "embed_person", "embed_together", "span_features"]

Features = NDArray[np.float32]
Observe = Callable[[View, ProgressCallback], ViewPose]
"""Follows the person through one video and finds the landmarks: the pipeline's first step."""

BLOCK_NUMBERS = 40_000_000
"""So many numbers of the features are compared at a time: 160 MB."""
SPAN_TOLERANCE = 1e-7
"""Directions with less than this share of the largest variance are rounding."""
MAX_BASIS_FRAMES = 3000
"""Of all persons together: so many frames span the features of a joint training."""


@dataclass(frozen=True, eq=False)
class Embedding:
    """Features of all frames of one or more persons, one trial after the other.

    HoG rows are turned into their own span, which keeps every distance and product between them
    and makes hundreds of thousands of numbers a few thousand. `values` has shape (N, k), `blocks`
    the widths of its parts.
    """

    values: Features
    blocks: tuple[int, ...]
    crops: tuple[Crop, ...] = ()


def embed_person(
    person: PersonData,
    features: str,
    cache: Cache,
    *,
    observe: Observe,
    progress: ProgressCallback,
) -> Embedding:
    """Describe every frame of a person's trials.

    Parameters
    ----------
    person
        Whose videos.
    features
        One of `FEATURES`.
    cache
        Where the result is kept.
    observe
        Finds landmarks, for features that use them.
    progress
        Told of every video; may raise `Cancelled`.
    """
    chosen = _select(features)
    uses_crop = chosen.hog is not None and chosen.hog.size_px is not None
    crops = _crop(person) if uses_crop else ()
    stored = cache.get(
        "features",
        f"{person.label}_{features.replace('+', '_')}",
        _made_from([person], chosen),
        lambda: _embed([person], chosen, cache, observe, progress, basis=None),
    )
    return Embedding(stored["values"], tuple(map(int, stored["blocks"])), crops)


def embed_together(
    persons: Sequence[PersonData],
    features: str,
    cache: Cache,
    *,
    observe: Observe,
    progress: ProgressCallback,
) -> Embedding:
    """Describe every frame of several persons in one space, for joint training.

    HoG rows are projected on the span of at most `MAX_BASIS_FRAMES` of them, evenly spaced over
    all persons.
    """
    chosen = _select(features)
    stored = cache.get(
        "features",
        f"all_{features.replace('+', '_')}",
        _made_from(persons, chosen),
        lambda: _embed(persons, chosen, cache, observe, progress, basis=MAX_BASIS_FRAMES),
    )
    return Embedding(stored["values"], tuple(map(int, stored["blocks"])))


def _select(features: str) -> FeatureSet:
    if features not in FEATURES:
        raise ConfigError(
            f"--features must be among {', '.join(FEATURES)}, got {features!r}; separate several "
            "by commas."
        )
    return FEATURES[features]


def _made_from(persons: Sequence[PersonData], chosen: FeatureSet) -> tuple[object, ...]:
    videos = [stamp(v) for person in persons for trial in person.files.trials for v in trial.videos]
    return chosen, videos, MAX_BASIS_FRAMES


def _crop(person: PersonData) -> tuple[Crop, ...]:
    """Return one crop per view: around the person in all of their trials. It needs no markers."""
    if any(not len(boxes) for boxes in person.boxes):
        raise DataError(
            f"Nobody was found in the videos of {person.label}; use --features hog-paper, which "
            "takes the whole picture, or check the videos."
        )
    pairs = zip(person.boxes, person.picture_px, strict=True)
    return tuple(fixed_crop(boxes, size) for boxes, size in pairs)


def _embed(
    persons: Sequence[PersonData],
    chosen: FeatureSet,
    cache: Cache,
    observe: Observe,
    progress: ProgressCallback,
    *,
    basis: int | None,
) -> dict[str, Any]:
    parts: list[Features] = []
    if chosen.hog is not None:
        with scratch_folder(cache.folder / "raw") as scratch:
            raw = list(_write_hog(persons, chosen, scratch, progress))
            progress(f"{_name(persons)}: comparing pictures", 0, 0)
            parts.append(span_features(raw, basis=basis))
            del raw
    if chosen.uses_landmarks:
        parts.append(
            np.concatenate(list(_find_landmarks(persons, chosen, cache, observe, progress)))
        )
    return {
        "values": np.concatenate(parts, axis=1),
        "blocks": np.array([part.shape[1] for part in parts]),
    }


def _name(persons: Sequence[PersonData]) -> str:
    return persons[0].label if len(persons) == 1 else "everybody"


def _write_hog(
    persons: Sequence[PersonData], chosen: FeatureSet, folder: Path, progress: ProgressCallback
) -> Iterator[Features]:
    """Describe every trial by its pictures; the rows stay on disk, they can be gigabytes."""
    assert chosen.hog is not None
    folder.mkdir(parents=True, exist_ok=True)
    for person in persons:
        crops = _crop(person) if chosen.hog.size_px is not None else (None,) * len(person.boxes)
        for done, (files, trial) in enumerate(zip(person.files.trials, person.trials, strict=True)):
            progress(f"{person.label}: describing pictures", done, len(person.trials))
            views = [
                _match(describe_video(read_frames(path), crop, chosen.hog), trial.time_s.size)
                for path, crop in zip(files.videos, crops, strict=True)
            ]
            rows, _ = combine_features(hog=views)
            path = folder / f"{person.label}_{trial.label}.npy"
            np.save(path, rows)
            yield np.load(path, mmap_mode="r")


def _match(rows: Features, n_frames: int) -> Features:
    """Give a view as many rows as the first one has; they may differ by a frame or two."""
    return rows[np.minimum(np.arange(n_frames), len(rows) - 1)]


def span_features(raw: Sequence[Features], *, basis: int | None = None) -> Features:
    """Turn wide rows into their own span, keeping all products between them.

    Parameters
    ----------
    raw
        Shape (T, D) each, with D much larger than their number.
    basis
        Use the span of about so many evenly spaced rows instead of all: what lies outside of it is
        lost, alike for every row of the basis.

    Returns
    -------
    Features
        Shape (N, k), k at most N or `basis`.
    """
    n = sum(len(rows) for rows in raw)
    chosen = np.arange(0, n, 1 if basis is None else max(1, -(-n // basis)))
    width = raw[0].shape[1]
    step = max(256, BLOCK_NUMBERS // n)
    product = np.zeros((n, chosen.size), dtype=np.float32)
    for start in range(0, width, step):
        part = np.concatenate([rows[:, start : start + step] for rows in raw])
        product += part @ part[chosen].T
    value, vector = np.linalg.eigh(product[chosen].astype(np.float64))
    kept = value > SPAN_TOLERANCE * value[-1]
    turned = (vector[:, kept] / np.sqrt(value[kept])).astype(np.float32)
    # Largest first, as principal components are.
    return np.ascontiguousarray((product @ turned)[:, ::-1])


def _find_landmarks(
    persons: Sequence[PersonData],
    chosen: FeatureSet,
    cache: Cache,
    observe: Observe,
    progress: ProgressCallback,
) -> Iterator[Features]:
    for person in persons:
        for done, (files, trial) in enumerate(zip(person.files.trials, person.trials, strict=True)):
            progress(f"{person.label}: following the joints", done, len(person.trials))
            views = []
            for path, size in zip(files.videos, person.picture_px, strict=True):
                time_s, position = _observe_view(files, path, cache, observe)
                at_times = _nearest(time_s, position, trial.time_s)
                views.append(describe_landmarks(at_times, size, window=chosen.window))
            yield combine_features(landmarks=views)[0]


def _observe_view(
    files: TrialFiles, path: Path, cache: Cache, observe: Observe
) -> tuple[Array, Array]:
    """Return times (T,) and landmarks (T, 33, 2) of one video, px."""
    given = cache.folder / "keypoints" / f"{files.label}_{path.stem}.npz"

    def make() -> dict[str, Any]:
        pose = observe(View(path), ignore_progress)
        return {"time_s": pose.image.time_s, "image": pose.image.position}

    if given.is_file():
        with np.load(given, allow_pickle=False) as data:
            return data["time_s"], data["image"]
    label = f"{files.subject}_{files.label}_{path.stem}"
    stored = cache.get("landmarks", label, (stamp(path),), make)
    return stored["time_s"], stored["image"]


def _nearest(time_s: Array, position: Array, wanted_s: Array) -> Array:
    """Return positions (T, K, 2) at other times: those of the nearest frame, NaN without one."""
    if time_s.size < 2:
        raise ShapeError("Landmarks of at least two frames are needed, got fewer.")
    step = float(np.median(np.diff(time_s)))
    after = np.searchsorted(time_s, wanted_s).clip(1, time_s.size - 1)
    before = after - 1
    is_before = wanted_s - time_s[before] <= time_s[after] - wanted_s
    nearest = np.where(is_before, before, after)
    found = np.array(position[nearest], dtype=np.float64)
    found[np.abs(time_s[nearest] - wanted_s) > 0.6 * step] = np.nan
    return found
