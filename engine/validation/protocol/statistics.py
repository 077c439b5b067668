"""What a validation study found, and its figures: marker distances, angle differences, tests.

"Mean and SD" of a difference has two readings, and papers mix them: mean and SD of the signed
difference, or of its absolute value. Both are always given.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np

from engine.datatypes import Array, frozen_array
from engine.errors import DataError, ShapeError
from engine.validation.agreement import AngleSummary, PairedTrial, Unit, summarise_agreement
from engine.validation.curves import angle_difference
from engine.validation.protocol.folds import FoldKind
from engine.validation.protocol.leak import LeakCheck
from engine.validation.statistics import (
    PairedTest,
    adjust_holm,
    compute_paired_t_test,
    mean_per_cluster,
)

__all__ = [
    "TABLE3_ROWS",
    "DifferenceSpread",
    "DistanceSpread",
    "MethodComparison",
    "MethodResult",
    "MethodTrial",
    "Study",
    "StudyTrial",
    "compare_methods",
    "mean_of_tasks",
    "select_main",
    "summarise_differences",
    "summarise_distances",
    "summarise_rows",
]

TABLE3_ROWS = (
    "hip_flexion", "hip_adduction", "hip_rotation", "knee_flexion", "ankle_dorsiflexion",
    "lumbar_extension", "lumbar_bending", "lumbar_rotation", "arm_flexion", "arm_adduction",
    "arm_rotation", "elbow_flexion", "forearm_pronation",
)  # fmt: skip
"""The angles of Table 3, in its order. All but the lumbar ones have two sides: 23 angles."""

PAPER_TASKS = ("FK", "KS", "FS")
"""Floor to knuckle, knuckle to shoulder, floor to shoulder."""

MAIN_METHODS = ("tgp-constrained", "tgp", "gp")
"""Which method the printed tables are about, first come; never chosen by its errors."""
SIDES = ("_r", "_l")
FEW_FLIPS = 2000


@dataclass(frozen=True, eq=False)
class StudyTrial:
    """What was measured in one trial, at the times of the video.

    Parameters
    ----------
    subject, label, task, repetition
        Subject and label together tell trials apart.
    time_s
        Shape (T,), s after the first frame.
    marker_names, measured_m
        Names, and shape (T, M, 3), laboratory axes, m; NaN where a marker was not seen.
    angle_names, reference_deg
        Names with their sides, and shape (T, A): inverse kinematics of the measured markers.
    truth_deg
        Shape (T, A), exact angles of computer-generated data; NaN where there are none.
    """

    subject: str
    label: str
    task: str
    repetition: int
    time_s: Array
    marker_names: tuple[str, ...]
    measured_m: Array
    angle_names: tuple[str, ...]
    reference_deg: Array
    truth_deg: Array

    def __post_init__(self) -> None:
        n = np.size(self.time_s)
        shapes = {
            "time_s": (n,),
            "measured_m": (n, len(self.marker_names), 3),
            "reference_deg": (n, len(self.angle_names)),
            "truth_deg": (n, len(self.angle_names)),
        }
        for name, shape in shapes.items():
            array = frozen_array(getattr(self, name))
            object.__setattr__(self, name, array)
            if array.shape != shape:
                raise ShapeError(f"{name} of {self.label} needs shape {shape}, got {array.shape}.")


@dataclass(frozen=True, eq=False)
class MethodTrial:
    """What one method made of a trial: markers (T, M, 3) in m, and angles (T, A) in degrees."""

    trial: StudyTrial
    estimated_m: Array
    estimated_deg: Array

    def __post_init__(self) -> None:
        pairs = (("estimated_m", "measured_m"), ("estimated_deg", "reference_deg"))
        for name, other in pairs:
            array = frozen_array(getattr(self, name))
            object.__setattr__(self, name, array)
            expected = getattr(self.trial, other).shape
            if array.shape != expected:
                raise ShapeError(
                    f"{name} of {self.trial.label} needs shape {expected}, got {array.shape}."
                )

    @cached_property
    def distance_mm(self) -> Array:
        """Distance of every marker from where it was measured, shape (T, M), mm."""
        return np.asarray(
            1000.0 * np.linalg.norm(self.estimated_m - self.trial.measured_m, axis=-1)
        )

    @cached_property
    def frame_mm(self) -> Array:
        """Mean distance over the markers of each frame, shape (T,), mm."""
        known = np.isfinite(self.distance_mm)
        total = np.where(known, self.distance_mm, 0.0).sum(axis=1)
        return np.asarray(total / np.where(known.any(axis=1), known.sum(axis=1), np.nan))

    @cached_property
    def difference_deg(self) -> Array:
        """Angles minus those of the measured markers, shape (T, A), wrapped to ±180°."""
        return _differ(self.estimated_deg, self.trial.reference_deg)

    @cached_property
    def error_deg(self) -> Array:
        """Angles minus the exact ones, shape (T, A); NaN where there are none."""
        return _differ(self.estimated_deg, self.trial.truth_deg)

    def pair_rows(self) -> PairedTrial:
        """Return the 13 angles of Table 3; those of two sides as the mean of both."""
        trial = self.trial
        rows = [row for row in TABLE3_ROWS if find_columns(trial.angle_names, row)]
        estimated, reference = [], []
        for row in rows:
            columns = find_columns(trial.angle_names, row)
            curve = trial.reference_deg[:, columns].mean(axis=1)
            reference.append(curve)
            estimated.append(curve + self.difference_deg[:, columns].mean(axis=1))
        return PairedTrial(
            subject=trial.subject,
            label=trial.label,
            time_s=trial.time_s,
            names=tuple(rows),
            estimated_deg=np.column_stack(estimated),
            reference_deg=np.column_stack(reference),
            task=trial.task,
        )


@dataclass(frozen=True, eq=False)
class MethodResult:
    """One method over all trials, each predicted by an estimator that was not trained on it.

    Parameters
    ----------
    name
        ``features/regressor``, such as ``hog/gp``.
    trials
        In the order of the study.
    fit_s, predict_ms
        Seconds for one fold with its search, and milliseconds per frame.
    settings
        Of each fold, by its name: the hyper-parameters that were found.
    """

    name: str
    trials: tuple[MethodTrial, ...]
    fit_s: float = math.nan
    predict_ms: float = math.nan
    settings: Mapping[str, Any] = field(default_factory=dict)

    @property
    def regressor(self) -> str:
        """The part of the name after the features."""
        return self.name.rpartition("/")[2]

    @property
    def subjects(self) -> tuple[str, ...]:
        """The persons, in order of first appearance."""
        return tuple(dict.fromkeys(one.trial.subject for one in self.trials))

    @property
    def tasks(self) -> tuple[str, ...]:
        """The tasks: the paper's in its order, then others in order of first appearance."""
        found = dict.fromkeys(one.trial.task for one in self.trials)
        return (
            *(t for t in PAPER_TASKS if t in found),
            *(t for t in found if t not in PAPER_TASKS),
        )

    def select(self, subject: str | None = None, task: str | None = None) -> list[MethodTrial]:
        """Return the trials of a person and a task; None for any."""
        return [
            one
            for one in self.trials
            if subject in (None, one.trial.subject) and task in (None, one.trial.task)
        ]


@dataclass(frozen=True, eq=False)
class Study:
    """Everything a run of the protocol found.

    `settings` holds how it was run, `notes` what makes it less certain.
    """

    title: str
    kind: FoldKind
    is_synthetic: bool
    methods: tuple[MethodResult, ...]
    leaks: Mapping[str, LeakCheck]
    settings: Mapping[str, Any] = field(default_factory=dict)
    notes: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        if not self.methods:
            raise DataError("A study needs at least one method.")

    @property
    def main(self) -> MethodResult:
        """The method that the printed tables are about."""
        return select_main(self.methods)

    def method(self, name: str) -> MethodResult:
        """Return a method by its name."""
        return next(method for method in self.methods if method.name == name)


def select_main(methods: Sequence[MethodResult]) -> MethodResult:
    """Return the method the lifting paper is about, or what comes next to it."""
    for wanted in MAIN_METHODS:
        for method in methods:
            if method.regressor == wanted:
                return method
    return methods[0]


def find_columns(names: Sequence[str], row: str) -> list[int]:
    """Return where the angle of a row of Table 3 stands: once, or right and left."""
    wanted = (row, *(f"{row}{side}" for side in SIDES))
    return [names.index(name) for name in wanted if name in names]


def _differ(estimated: Array, reference: Array) -> Array:
    columns = [angle_difference(a, b) for a, b in zip(estimated.T, reference.T, strict=True)]
    return np.column_stack(columns) if columns else np.empty((len(estimated), 0))


# --------------------------------------------------------------------------- spreads


@dataclass(frozen=True)
class DistanceSpread:
    """Mean marker distances of frames, mm; SDs with n - 1."""

    n_trials: int
    n_frames: int
    mean_mm: float
    sd_mm: float
    median_mm: float
    p95_mm: float
    max_mm: float
    rms_mm: float
    sd_trials_mm: float


@dataclass(frozen=True)
class DifferenceSpread:
    """Angle differences of frames in every reading, degrees; SDs with n - 1.

    `mean_deg` and `sd_deg` are of the signed difference, `mae_deg` and `sd_absolute_deg` of its
    absolute value.
    """

    n_samples: int
    mean_deg: float
    sd_deg: float
    mae_deg: float
    sd_absolute_deg: float
    rmse_deg: float
    p95_deg: float
    max_deg: float
    excursion_deg: float

    @property
    def percent_of_excursion(self) -> float:
        """Mean absolute difference in percent of the achieved excursion."""
        return percent(self.mae_deg, self.excursion_deg)


def percent(value: float, whole: float) -> float:
    """Return `value` in percent of `whole`; NaN without a whole."""
    return 100.0 * value / whole if whole > 0 else math.nan


def summarise_distances(trials: Iterable[MethodTrial]) -> DistanceSpread:
    """Summarise the marker distances of all frames of some trials."""
    frames = [one.frame_mm[np.isfinite(one.frame_mm)] for one in trials]
    frames = [one for one in frames if one.size]
    if not frames:
        return DistanceSpread(0, 0, *[math.nan] * 7)
    pooled = np.concatenate(frames)
    return DistanceSpread(
        n_trials=len(frames),
        n_frames=pooled.size,
        mean_mm=float(pooled.mean()),
        sd_mm=_sd(pooled),
        median_mm=float(np.median(pooled)),
        p95_mm=float(np.percentile(pooled, 95)),
        max_mm=float(pooled.max()),
        rms_mm=math.sqrt(float(np.square(pooled).mean())),
        sd_trials_mm=_sd(np.array([one.mean() for one in frames])),
    )


def summarise_differences(
    trials: Iterable[MethodTrial], names: Sequence[str] | None = None, *, of: str = "reference"
) -> DifferenceSpread:
    """Summarise the differences of some angles over all frames of some trials.

    Parameters
    ----------
    trials
        Of one method.
    names
        Angles with their sides; None for all. Sides are pooled, not averaged: errors in opposite
        directions must not cancel.
    of
        `reference`: against the angles of the measured markers; `truth`: against exact ones;
        `offset_free`: as `truth`, without the mean difference of each angle, which two definitions
        of one angle differ by.
    """
    parts, excursions = [], []
    for one in trials:
        kept = [one.trial.angle_names.index(n) for n in (names or one.trial.angle_names)]
        curves = one.trial.reference_deg if of == "reference" else one.trial.truth_deg
        difference = (one.difference_deg if of == "reference" else one.error_deg)[:, kept]
        parts.append(difference)
        excursions += [_range(curves[:, column]) for column in kept]
    pooled = np.concatenate(parts) if parts else np.empty((0, 0))
    if of == "offset_free" and pooled.size:
        pooled = pooled - _column_means(pooled)
    d = pooled[np.isfinite(pooled)]
    if not d.size:
        return DifferenceSpread(0, *[math.nan] * 8)
    absolute = np.abs(d)
    reached = [value for value in excursions if math.isfinite(value)]
    return DifferenceSpread(
        n_samples=d.size,
        mean_deg=float(d.mean()),
        sd_deg=_sd(d),
        mae_deg=float(absolute.mean()),
        sd_absolute_deg=_sd(absolute),
        rmse_deg=math.sqrt(float(np.square(d).mean())),
        p95_deg=float(np.percentile(absolute, 95)),
        max_deg=float(absolute.max()),
        excursion_deg=float(np.mean(reached)) if reached else math.nan,
    )


def mean_of_tasks(
    method: MethodResult, subject: str, measure: Mapping[str, float] | None = None
) -> float:
    """Return the mean over tasks of a person's mean marker distance, as the paper averages."""
    values = measure or {
        task: summarise_distances(method.select(subject, task)).mean_mm for task in method.tasks
    }
    known = [value for value in values.values() if math.isfinite(value)]
    return float(np.mean(known)) if known else math.nan


def _sd(values: Array) -> float:
    return float(values.std(ddof=1)) if values.size > 1 else math.nan


def _range(curve: Array) -> float:
    known = curve[np.isfinite(curve)]
    return float(np.ptp(known)) if known.size else math.nan


def _column_means(values: Array) -> Array:
    known = np.isfinite(values)
    total = np.where(known, values, 0.0).sum(axis=0)
    return np.asarray(total / np.where(known.any(axis=0), known.sum(axis=0), np.nan))


# --------------------------------------------------------------------------- tests


def summarise_rows(method: MethodResult, *, seed: int = 0) -> tuple[AngleSummary, ...]:
    """Test the 13 angles of Table 3: per frame as printed, per trial and person, equivalence.

    Independent units are persons where there are two or more, otherwise the trials of the one.
    """
    return summarise_agreement(
        [one.pair_rows() for one in method.trials], n_flips=FEW_FLIPS, seed=seed
    )


@dataclass(frozen=True)
class MethodComparison:
    """Two methods on the same trials: the second's mean marker distance minus the first's, mm.

    Units are persons where there are two or more, otherwise trials; `p_holm` is adjusted for the
    number of pairs. `share_better` is the share of trials in which the second is closer.
    """

    first: str
    second: str
    unit: Unit
    test: PairedTest
    share_better: float
    p_holm: float = math.nan


def compare_methods(methods: Sequence[MethodResult]) -> tuple[MethodComparison, ...]:
    """Compare every pair of methods by their trials' mean marker distances."""
    found = [_compare(a, b) for a, b in itertools.combinations(methods, 2)]
    adjusted = adjust_holm([one.test.p for one in found])
    return tuple(replace(one, p_holm=float(p)) for one, p in zip(found, adjusted, strict=True))


def _compare(first: MethodResult, second: MethodResult) -> MethodComparison:
    pairs = list(zip(first.trials, second.trials, strict=True))
    both = [_mean_of_frames(b) - _mean_of_frames(a) for a, b in pairs]
    difference = np.array(both)
    unit: Unit = "subject" if len(first.subjects) > 1 else "trial"
    labels = [a.trial.subject if unit == "subject" else a.trial.label for a, _ in pairs]
    known = difference[np.isfinite(difference)]
    return MethodComparison(
        first=first.name,
        second=second.name,
        unit=unit,
        test=compute_paired_t_test(mean_per_cluster(difference, labels)),
        share_better=float((known < 0).mean()) if known.size else math.nan,
    )


def _mean_of_frames(one: MethodTrial) -> float:
    known = one.frame_mm[np.isfinite(one.frame_mm)]
    return float(known.mean()) if known.size else math.nan
