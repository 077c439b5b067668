"""The alarm for frames that are known already: what the nearest neighbour alone achieves."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from engine.datatypes import Array
from engine.errors import ShapeError
from engine.validation.protocol.folds import Fold, TrialFrames

__all__ = ["LeakCheck", "Neighbours", "check_leak", "find_neighbours"]

Features = NDArray[np.float32]

MAX_SHARED = 0.05
"""So large a share of test frames may have their nearest neighbour in the same recording."""
MAX_STEPS = 1.5
"""An error of the nearest neighbour below so many frame-to-frame movements means remembering."""
BLOCK = 512


@dataclass(frozen=True, eq=False)
class Neighbours:
    """The training frame most alike to each test frame of one fold.

    Parameters
    ----------
    error_mm
        Shape (n,), mean distance of the markers of both frames; NaN where none are known.
    is_same_trial
        Shape (n,), whether both are of one recording.
    gap_s
        Shape (n,), the time between both; NaN where they are of different recordings.
    """

    error_mm: Array
    is_same_trial: NDArray[np.bool_]
    gap_s: Array


@dataclass(frozen=True)
class LeakCheck:
    """What the nearest neighbours of all folds say.

    `step_mm` is the mean movement of the markers from one frame to the next.
    """

    n_frames: int
    error_mm: float
    shared: float
    median_gap_s: float
    step_mm: float
    is_raised: bool

    @property
    def sentence(self) -> str:
        """Say in words what was found."""
        alone = (
            f"The most similar training picture alone gives a marker error of "
            f"{self.error_mm:.1f} mm"
        )
        if self.shared > MAX_SHARED:
            return (
                f"Leak: for {self.shared:.0%} of the test frames that picture is of the same "
                f"recording, typically {self.median_gap_s:.2f} s away. {alone}, so errors of these "
                "folds say how well frames are remembered, not how well new lifts are measured."
            )
        if self.is_raised:
            return (
                f"Leak suspected: {alone}, hardly more than the movement from one frame to the "
                f"next ({self.step_mm:.1f} mm). Is one recording in the data set twice?"
            )
        return (
            f"{alone}; the markers move {self.step_mm:.1f} mm from one frame to the next, and "
            "no training picture is of the same recording. No sign of a leak."
            if self.shared == 0
            else f"{alone}; for {self.shared:.1%} of the test frames that picture is of the same "
            "recording. No sign of a leak."
        )


def find_neighbours(
    features: Features, marker_m: Array, trials: Sequence[TrialFrames], fold: Fold
) -> Neighbours:
    """Find the training frame most alike to every test frame.

    Parameters
    ----------
    features
        Shape (N, d), of all frames of the trials.
    marker_m
        Shape (N, M, 3), measured, m.
    trials, fold
        As in `make_folds`.
    """
    n = sum(trial.n_frames for trial in trials)
    if features.shape[0] != n or marker_m.shape[0] != n or fold.test.size != n:
        raise ShapeError(
            f"Expected features, markers and masks of {n} frames, got {features.shape[0]}, "
            f"{marker_m.shape[0]} and {fold.test.size}."
        )
    owner = np.repeat(np.arange(len(trials)), [trial.n_frames for trial in trials])
    time = np.concatenate([trial.time_s for trial in trials])
    known, asked = np.flatnonzero(fold.train), np.flatnonzero(fold.test)
    nearest = known[_search(features, known, asked)]
    distance = np.linalg.norm(marker_m[nearest] - marker_m[asked], axis=-1)
    same = owner[nearest] == owner[asked]
    gap = np.where(same, np.abs(time[nearest] - time[asked]), np.nan)
    return Neighbours(_row_means(1000.0 * distance), same, gap)


def _search(
    features: Features, known: NDArray[np.intp], asked: NDArray[np.intp]
) -> NDArray[np.intp]:
    """Return the number, within `known`, of the frame nearest to each of `asked`."""
    pool = features[known]
    half_square = 0.5 * np.einsum("nd,nd->n", pool, pool)
    found = [
        np.argmin(half_square - features[asked[i : i + BLOCK]] @ pool.T, axis=1)
        for i in range(0, asked.size, BLOCK)
    ]
    return np.concatenate(found)


def check_leak(found: Sequence[Neighbours], markers_m: Sequence[Array]) -> LeakCheck:
    """Judge the nearest neighbours of all folds.

    Parameters
    ----------
    found
        Of every fold.
    markers_m
        Measured markers of every recording, shape (T, M, 3), m.
    """
    error = np.concatenate([n.error_mm for n in found])
    shared = float(np.concatenate([n.is_same_trial for n in found]).mean())
    gap = np.concatenate([n.gap_s for n in found])
    steps = [1000.0 * np.linalg.norm(np.diff(m, axis=0), axis=-1) for m in markers_m]
    step = _mean(np.concatenate([_row_means(s) for s in steps]))
    mean = _mean(error)
    return LeakCheck(
        n_frames=error.size,
        error_mm=mean,
        shared=shared,
        median_gap_s=float(np.nanmedian(gap)) if np.isfinite(gap).any() else math.nan,
        step_mm=step,
        is_raised=shared > MAX_SHARED or mean < MAX_STEPS * step,
    )


def _row_means(values: Array) -> Array:
    known = np.isfinite(values)
    total = np.where(known, values, 0.0).sum(axis=1)
    return np.asarray(total / np.where(known.any(axis=1), known.sum(axis=1), np.nan))


def _mean(values: Array) -> float:
    known = values[np.isfinite(values)]
    return float(known.mean()) if known.size else math.nan
