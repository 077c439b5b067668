"""Tables 1 to 3 of the lifting paper and what belongs beside them, as data and as printed.

As data (`Table`), every method and every reading of "mean and SD" has its row or column; as printed
(`PrintedTable`), they look as in the paper, for one method.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from engine.validation.agreement import AngleSummary
from engine.validation.protocol.statistics import (
    TABLE3_ROWS,
    DifferenceSpread,
    DistanceSpread,
    MethodComparison,
    MethodResult,
    MethodTrial,
    Study,
    find_columns,
    mean_of_tasks,
    percent,
    summarise_differences,
    summarise_distances,
)
from engine.validation.tables import Table

__all__ = [
    "MODEL_RANGE_DEG",
    "PUBLISHED",
    "ROW_TITLES",
    "PrintedTable",
    "build_study_tables",
    "format_number",
    "print_comparisons",
    "print_methods",
    "print_table1",
    "print_table2",
    "print_table3",
    "print_tests",
]

ROW_TITLES: Final[Mapping[str, str]] = {
    "hip_flexion": "Hip flexion",
    "hip_adduction": "Hip adduction",
    "hip_rotation": "Hip rotation",
    "knee_flexion": "Knee flexion",
    "ankle_dorsiflexion": "Ankle flexion",
    "lumbar_extension": "Lumbar extension",
    "lumbar_bending": "Lumbar bending",
    "lumbar_rotation": "Lumbar rotation",
    "arm_flexion": "Arm flexion",
    "arm_adduction": "Arm adduction",
    "arm_rotation": "Arm rotation",
    "elbow_flexion": "Elbow flexion",
    "forearm_pronation": "Elbow rotation",
}
"""The paper's names of the rows of Table 3."""

MODEL_RANGE_DEG: Final[Mapping[str, float]] = {
    "hip_flexion": 240.0, "hip_adduction": 240.0, "hip_rotation": 240.0, "knee_flexion": 130.0,
    "ankle_dorsiflexion": 180.0, "lumbar_extension": 180.0, "lumbar_bending": 180.0,
    "lumbar_rotation": 180.0, "arm_flexion": 180.0, "arm_adduction": 210.0, "arm_rotation": 180.0,
    "elbow_flexion": 150.0, "forearm_pronation": 90.0,
}  # fmt: skip
"""Ranges of the coordinates of the model of Hamner et al. (2010), which the paper used: its 3.38 %
for the elbow is 5.08 of 150°. They say little about the movement; see the achieved excursion."""


@dataclass(frozen=True)
class _Published:
    """What the lifting paper prints, and what its own cells give."""

    marker_mm: tuple[float, float]
    marker_recomputed_mm: float
    task_mm: Mapping[str, float]
    task_deg: Mapping[str, float]
    angle_deg: tuple[float, float]
    rows_deg: Mapping[str, tuple[float, float]]


PUBLISHED: Final = _Published(
    marker_mm=(9.52, 7.95),
    marker_recomputed_mm=8.65,
    task_mm={"FK": 8.41, "KS": 9.43, "FS": 8.12},
    task_deg={"FK": 2.31, "KS": 2.33, "FS": 2.30},
    angle_deg=(2.31, 4.00),
    rows_deg={
        "hip_flexion": (2.01, 2.86), "hip_adduction": (0.53, 0.67), "hip_rotation": (0.75, 1.07),
        "knee_flexion": (2.55, 4.07), "ankle_dorsiflexion": (1.17, 1.57),
        "lumbar_extension": (1.87, 2.77), "lumbar_bending": (0.57, 0.69),
        "lumbar_rotation": (0.74, 1.02), "arm_flexion": (3.47, 5.39),
        "arm_adduction": (1.91, 2.32), "arm_rotation": (4.66, 6.32), "elbow_flexion": (5.08, 6.38),
        "forearm_pronation": (2.90, 3.20),
    },
)  # fmt: skip
"""Mehrizi et al. (2018), twelve men filmed in a laboratory; not measured by this program."""

Rows = Mapping[str, Sequence[AngleSummary]]
"""The tests of the 13 angles, by the name of the method."""


@dataclass(frozen=True)
class PrintedTable:
    """A table as text: a title, column heads, rows, and notes below."""

    title: str
    head: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]
    notes: tuple[str, ...] = ()


# --------------------------------------------------------------------------- as data


def build_study_tables(
    study: Study, rows: Rows, comparisons: Sequence[MethodComparison]
) -> tuple[Table, ...]:
    """Return every table of a study; each has a row or more per method."""
    return (
        Table("table1", _TABLE1, tuple(_each(study, _table1_rows))),
        Table("table2", _TABLE2, tuple(_each(study, _table2_rows))),
        Table("table3", _TABLE3, tuple(_table3_rows(study, rows))),
        Table("angles", _ANGLES, tuple(_each(study, _angle_rows))),
        Table("markers", _MARKERS, tuple(_each(study, _marker_rows))),
        Table("trials", _TRIALS, tuple(_each(study, _trial_rows))),
        Table("methods", _METHODS, tuple(_method_row(study, m) for m in study.methods)),
        Table("comparisons", _COMPARISONS, tuple(_comparison_row(c) for c in comparisons)),
    )


def _each(study: Study, make: object) -> Iterator[tuple[str | float | int, ...]]:
    for method in study.methods:
        for row in make(method):  # type: ignore[operator]
            yield (method.name, *row)


_DISTANCE = ("n_trials", "n_frames", "mean_mm", "sd_mm", "median_mm", "p95_mm", "max_mm", "rms_mm",
             "sd_of_trial_means_mm")  # fmt: skip
_DIFFERENCE = ("n_samples", "mean_signed_deg", "sd_signed_deg", "mae_deg", "sd_absolute_deg",
               "rmse_deg", "p95_deg", "max_deg", "excursion_deg",
               "percent_of_excursion")  # fmt: skip
_TABLE1 = ("method", "subject", "task", *_DISTANCE)
_TABLE2 = ("method", "subject", "task", *_DIFFERENCE)
_ANGLES = ("method", "angle", *_DIFFERENCE, *(f"truth_{c}" for c in _DIFFERENCE[:6]),
           "reference_to_truth_mae_deg", "offset_free_truth_mae_deg")  # fmt: skip
_MARKERS = ("method", "marker", "n_samples", "mean_mm", "sd_mm", "p95_mm", "max_mm")
_TRIALS = ("method", "subject", "trial", "task", "repetition", "n_frames", "mean_mm", "sd_mm",
           "p95_mm", "max_mm", "mae_deg", "rmse_deg", "truth_mae_deg")  # fmt: skip
_METHODS = ("method", "n_subjects", "n_trials", "n_frames", "mean_mm", "sd_mm", "median_mm",
            "p95_mm", "max_mm", "mean_of_subjects_mm", "worst_subject_mm", "mean_signed_deg",
            "sd_signed_deg", "mae_deg", "sd_absolute_deg", "rmse_deg", "truth_mae_deg",
            "nearest_neighbour_mm", "leak", "fit_s", "predict_ms")  # fmt: skip
_COMPARISONS = ("first", "second", "unit", "n", "second_minus_first_mm", "low_mm", "high_mm", "p",
                "p_holm", "share_of_trials_second_closer")  # fmt: skip


def _distances(s: DistanceSpread) -> tuple[float, ...]:
    return (s.n_trials, s.n_frames, s.mean_mm, s.sd_mm, s.median_mm, s.p95_mm, s.max_mm, s.rms_mm,
            s.sd_trials_mm)  # fmt: skip


def _differences(s: DifferenceSpread) -> tuple[float, ...]:
    return (s.n_samples, s.mean_deg, s.sd_deg, s.mae_deg, s.sd_absolute_deg, s.rmse_deg, s.p95_deg,
            s.max_deg, s.excursion_deg, s.percent_of_excursion)  # fmt: skip


def _cells(method: MethodResult) -> Iterator[tuple[str, str, list[MethodTrial]]]:
    """Yield subject and task with their trials: each, every task of a subject, and all."""
    for subject in (*method.subjects, None):
        for task in (*method.tasks, None):
            yield subject or "all", task or "all", method.select(subject, task)


def _table1_rows(method: MethodResult) -> Iterator[tuple[str | float, ...]]:
    for subject, task, trials in _cells(method):
        yield (subject, task, *_distances(summarise_distances(trials)))


def _table2_rows(method: MethodResult) -> Iterator[tuple[str | float, ...]]:
    for subject, task, trials in _cells(method):
        yield (subject, task, *_differences(summarise_differences(trials)))


def _angle_rows(method: MethodResult) -> Iterator[tuple[str | float, ...]]:
    for name in method.trials[0].trial.angle_names:
        own = summarise_differences(method.trials, [name])
        truth = summarise_differences(method.trials, [name], of="truth")
        free = summarise_differences(method.trials, [name], of="offset_free")
        yield (name, *_differences(own), *_differences(truth)[:6],
               _reference_to_truth(method, name), free.mae_deg)  # fmt: skip


def _reference_to_truth(method: MethodResult, name: str) -> float:
    """Return how far the measured markers' own angle is from the exact one, mean absolute."""
    errors = []
    for one in method.trials:
        column = one.trial.angle_names.index(name)
        difference = one.trial.reference_deg[:, column] - one.trial.truth_deg[:, column]
        errors.append(np.abs((difference + 180.0) % 360.0 - 180.0))
    known = np.concatenate(errors)
    known = known[np.isfinite(known)]
    return float(known.mean()) if known.size else math.nan


def _marker_rows(method: MethodResult) -> Iterator[tuple[str | float, ...]]:
    pooled = np.concatenate([one.distance_mm for one in method.trials])
    for i, name in enumerate(method.trials[0].trial.marker_names):
        d = pooled[np.isfinite(pooled[:, i]), i]
        if not d.size:
            yield (name, 0, *[math.nan] * 4)
            continue
        sd = float(d.std(ddof=1)) if d.size > 1 else math.nan
        yield name, d.size, float(d.mean()), sd, float(np.percentile(d, 95)), float(d.max())


def _trial_rows(method: MethodResult) -> Iterator[tuple[str | float, ...]]:
    for one in method.trials:
        trial, s = one.trial, summarise_distances([one])
        angle = summarise_differences([one])
        truth = summarise_differences([one], of="truth")
        yield (trial.subject, trial.label, trial.task, trial.repetition, s.n_frames, s.mean_mm,
               s.sd_mm, s.p95_mm, s.max_mm, angle.mae_deg, angle.rmse_deg,
               truth.mae_deg)  # fmt: skip


def _method_row(study: Study, method: MethodResult) -> tuple[str | float | int | bool, ...]:
    s, angle = summarise_distances(method.trials), summarise_differences(method.trials)
    persons = [mean_of_tasks(method, subject) for subject in method.subjects]
    leak = study.leaks.get(method.name.rpartition("/")[0])
    return (
        method.name, len(method.subjects), s.n_trials, s.n_frames, s.mean_mm, s.sd_mm, s.median_mm,
        s.p95_mm, s.max_mm, _mean(persons), max(persons, default=math.nan), angle.mean_deg,
        angle.sd_deg, angle.mae_deg, angle.sd_absolute_deg, angle.rmse_deg,
        summarise_differences(method.trials, of="truth").mae_deg,
        leak.error_mm if leak else math.nan, leak.is_raised if leak else "", method.fit_s,
        method.predict_ms,
    )  # fmt: skip


def _comparison_row(c: MethodComparison) -> tuple[str | float | int, ...]:
    return (c.first, c.second, c.unit, c.test.n, c.test.mean, *c.test.interval, c.test.p, c.p_holm,
            c.share_better)  # fmt: skip


_TABLE3 = (
    "method", "angle", "n_sides", *_DIFFERENCE, "percent_of_model_range", "n_frames",
    "n_effective", "t_frames_as_printed_p", "frames_are_independent", "t_frames_corrected_p",
    "n_trials", "t_trials_p", "unit", "n_units", "t_units_p", "t_units_p_holm", "tost_2deg_p",
    "tost_2deg_equivalent", "tost_5deg_p", "tost_5deg_equivalent", "bias_deg", "loa_lower_deg",
    "loa_upper_deg", "loa_lower_outer_deg", "loa_upper_outer_deg", "between_sd_deg",
    "within_sd_deg", "published_mean_deg", "published_sd_deg",
)  # fmt: skip


def _table3_rows(study: Study, rows: Rows) -> Iterator[tuple[str | float | int | bool, ...]]:
    for method in study.methods:
        for s in rows[method.name]:
            columns = find_columns(method.trials[0].trial.angle_names, s.name)
            names = [method.trials[0].trial.angle_names[i] for i in columns]
            spread = summarise_differences(method.trials, names)
            yield (method.name, s.name, len(names), *_differences(spread),
                   percent(spread.mae_deg, MODEL_RANGE_DEG[s.name]), *_test_cells(s),
                   *PUBLISHED.rows_deg[s.name])  # fmt: skip


def _test_cells(s: AngleSummary) -> tuple[str | float | int | bool, ...]:
    frames, limits = s.per_frame, s.bland_altman
    strict, usual = s.equivalence[:2]
    return (
        frames.naive.n, frames.corrected.n_effective, frames.naive.p, are_independent(s),
        frames.corrected.p, s.per_trial.n, s.per_trial.p, s.unit, s.per_unit.n, s.per_unit.p,
        s.p_holm, strict.p, strict.is_equivalent, usual.p, usual.is_equivalent, limits.bias,
        limits.lower, limits.upper, *limits.outer_limits, math.sqrt(limits.between_variance),
        math.sqrt(limits.within_variance),
    )  # fmt: skip


def are_independent(s: AngleSummary) -> bool:
    """Whether frames are worth nearly as many independent samples: hardly ever in a video."""
    return s.per_frame.corrected.n_effective > 0.9 * s.per_frame.naive.n


# --------------------------------------------------------------------------- as printed


def format_number(value: float, digits: int = 2, *, signed: bool = False) -> str:
    """Return a number with a real minus sign; a dash where it is unknown."""
    if not math.isfinite(value):
        return "–"
    return f"{value:{'+' if signed else ''}.{digits}f}".replace("-", "−")


def _plus_minus(mean: float, sd: float, digits: int = 2, *, signed: bool = False) -> str:
    return f"{format_number(mean, digits, signed=signed)} ± {format_number(sd, digits)}"


def print_table1(study: Study, method: MethodResult) -> PrintedTable:
    """Print marker distances, person by task."""
    rows = []
    for subject in method.subjects:
        spreads = [summarise_distances(method.select(subject, task)) for task in method.tasks]
        average = mean_of_tasks(method, subject)
        sd = summarise_distances(method.select(subject)).sd_mm
        rows.append((subject, *(_plus_minus(s.mean_mm, s.sd_mm) for s in spreads),
                     _plus_minus(average, sd)))  # fmt: skip
    tasks = [_mean_over_subjects(method, task) for task in method.tasks]
    persons = _mean(mean_of_tasks(method, subject) for subject in method.subjects)
    rows.append(("Mean", *map(format_number, (*tasks, persons))))
    paper = [PUBLISHED.task_mm.get(task, math.nan) for task in method.tasks]
    rows.append(("Paper*", *map(format_number, paper), (f"{PUBLISHED.marker_mm[0]:.2f} printed, "
                 f"{PUBLISHED.marker_recomputed_mm:.2f} recomputed")))  # fmt: skip
    return PrintedTable(
        _title(study, f"Table 1. Marker error of {method.name} (mm)"),
        ("Person", *method.tasks, "Average"),
        tuple(rows),
        (
            (
                "Mean ± SD over frames of the mean distance of the markers from where they were "
                "measured; the average is that of the tasks."
            ),
            f"*{PAPER_NOTE}",
        ),
    )


PAPER_NOTE = (
    "Published by Mehrizi et al. (2018) on twelve men in a laboratory, not measured here; the "
    "paper prints 9.52 ± 7.95 mm, its cells give 8.65 mm. It does not say how frames were "
    "divided between training and test."
)


def _mean_over_subjects(method: MethodResult, task: str) -> float:
    return _mean(
        summarise_distances(method.select(subject, task)).mean_mm for subject in method.subjects
    )


def print_table2(study: Study, method: MethodResult) -> PrintedTable:
    """Print angle differences over all angles, person by task, in both readings."""
    rows = []
    for subject in (*method.subjects, None):
        spreads = [summarise_differences(method.select(subject, t)) for t in (*method.tasks, None)]
        rows.append((subject or "All", *(_both_readings(s) for s in spreads)))
    paper = [PUBLISHED.task_deg.get(task, math.nan) for task in method.tasks]
    rows.append(("Paper*", *map(format_number, paper), _plus_minus(*PUBLISHED.angle_deg)))
    return PrintedTable(
        _title(study, f"Table 2. Joint-angle difference of {method.name} (°)"),
        ("Person", *method.tasks, "All"),
        tuple(rows),
        (
            (
                "Mean ± SD of the absolute difference | of the signed difference, all angles and "
                "frames; the reference is inverse kinematics of the measured markers."
            ),
            "*Mehrizi et al. (2018); which reading its SDs follow is not stated.",
        ),
    )


def _both_readings(s: DifferenceSpread) -> str:
    absolute = _plus_minus(s.mae_deg, s.sd_absolute_deg)
    return f"{absolute} | {_plus_minus(s.mean_deg, s.sd_deg, signed=True)}"


def print_table3(study: Study, method: MethodResult, rows: Sequence[AngleSummary]) -> PrintedTable:
    """Print the 13 angles with the paired t-test as in the paper, flagged, and the sound one."""
    printed = []
    for s in rows:
        names = method.trials[0].trial.angle_names
        spread = summarise_differences(
            method.trials, [names[i] for i in find_columns(names, s.name)]
        )
        flag = "" if are_independent(s) else "†"
        printed.append(
            (
                ROW_TITLES[s.name],
                _plus_minus(spread.mae_deg, spread.sd_absolute_deg),
                _plus_minus(spread.mean_deg, spread.sd_deg, signed=True),
                format_number(spread.rmse_deg),
                f"{format_number(percent(spread.mae_deg, MODEL_RANGE_DEG[s.name]), 1)} %",
                f"{format_number(spread.percent_of_excursion, 1)} %",
                f"{format_p(s.per_frame.naive.p)}{flag}",
                format_p(s.p_holm),
                _plus_minus(*PUBLISHED.rows_deg[s.name]),
            )
        )
    worth = [s.per_frame.corrected.n_effective for s in rows] or [math.nan]
    frames = max((s.per_frame.naive.n for s in rows), default=0)
    return PrintedTable(
        _title(study, f"Table 3. Angle by angle, {method.name} (°)"),
        ("Angle", "Absolute", "Signed", "RMSE", "Of model range", "Of excursion", "p, frames",
         "p, units (Holm)", "Paper*"),
        tuple(printed),
        (
            (f"† As papers print it, and invalid: {frames} frames are worth only "
            f"{format_number(min(worth), 0)} to {format_number(max(worth), 0)} independent "
            "samples, so p is far too small."),
            (f"p, units: one mean difference per {rows[0].unit if rows else 'trial'}, adjusted for "
            "13 angles. A large p is not agreement; see the equivalence tests."),
            "Angles of two sides pool both. *Mehrizi et al. (2018), mean ± SD as printed.",
        ),
    )  # fmt: skip


def print_tests(study: Study, method: MethodResult, rows: Sequence[AngleSummary]) -> PrintedTable:
    """Print bias, limits of agreement and equivalence of the 13 angles."""
    printed = tuple(
        (
            ROW_TITLES[s.name],
            format_number(s.bland_altman.bias, signed=True),
            _span(s.bland_altman.lower, s.bland_altman.upper),
            _span(*s.bland_altman.outer_limits),
            *(f"{'yes' if e.is_equivalent else 'not shown'} ({format_p(e.p)})"
              for e in s.equivalence[:2]),
        )
        for s in rows
    )  # fmt: skip
    unit = rows[0].unit if rows else "trial"
    return PrintedTable(
        _title(study, f"Agreement of {method.name} with the measured markers (°)"),
        ("Angle", "Bias", "95 % limits of agreement", "At their worst", "Within ±2°?",
         "Within ±5°?"),
        printed,
        (
            ("Bland and Altman with repeated measures: variance between and within "
            f"{unit}s; at their worst: outer ends of the limits' 95 % intervals."),
            (f"Equivalence of the mean difference: two one-sided tests, one value per {unit}, p in "
            "brackets. Angles of two sides as the mean of both."),
        ),
    )  # fmt: skip


def print_methods(study: Study) -> PrintedTable:
    """Print every method, also those that did worse."""
    rows = []
    for method in study.methods:
        s, angle = summarise_distances(method.trials), summarise_differences(method.trials)
        persons = [mean_of_tasks(method, subject) for subject in method.subjects]
        rows.append((method.name, _plus_minus(s.mean_mm, s.sd_mm), format_number(s.p95_mm),
                     format_number(max(persons, default=math.nan)),
                     _plus_minus(angle.mae_deg, angle.sd_absolute_deg),
                     format_number(angle.rmse_deg), format_number(method.fit_s, 1),
                     format_number(method.predict_ms)))  # fmt: skip
    return PrintedTable(
        _title(study, "All methods under the same protocol"),
        ("Method", "Markers (mm)", "95 % below (mm)", "Worst person (mm)", "Angles, absolute (°)",
         "Angles, RMSE (°)", "Training (s a fold)", "Estimating (ms a frame)"),
        tuple(rows),
        ("Mean ± SD over frames. Features are computed apart from the times given.",),
    )  # fmt: skip


def print_comparisons(
    study: Study, comparisons: Sequence[MethodComparison], limit: int = 12
) -> PrintedTable:
    """Print the paired comparisons, largest differences first."""
    ranked = sorted(comparisons, key=lambda c: -abs(c.test.mean) if c.test.n else 0.0)
    rows = [
        (f"{c.second} − {c.first}", format_number(c.test.mean, signed=True),
         _span(*c.test.interval), format_p(c.p_holm), f"{100 * c.share_better:.0f} %")
        for c in ranked[:limit]
    ]  # fmt: skip
    unit = comparisons[0].unit if comparisons else "trial"
    return PrintedTable(
        _title(study, "Methods against each other, marker error (mm)"),
        ("Pair", "Difference", "95 % interval", "p (Holm)", "Closer in"),
        tuple(rows),
        (
            (
                f"One mean per {unit}; closer in: share of trials in which the first named is "
                "closer. "
                f"{len(comparisons)} pairs, the largest differences are shown."
            ),
        ),
    )


def format_p(p: float) -> str:
    """Return a p-value with three digits."""
    if not math.isfinite(p):
        return "–"
    return "< 0.001" if p < 0.001 else f"{p:.3f}"


def _span(low: float, high: float) -> str:
    return f"{format_number(low, signed=True)} to {format_number(high, signed=True)}"


def _title(study: Study, text: str) -> str:
    return f"{text}, synthetic data" if study.is_synthetic else text


def _mean(values: Iterable[float]) -> float:
    known = [value for value in values if math.isfinite(value)]
    return float(np.mean(known)) if known else math.nan


def list_angles(study: Study) -> tuple[str, ...]:
    """Return the rows of Table 3 that the study has."""
    names = study.methods[0].trials[0].trial.angle_names
    return tuple(row for row in TABLE3_ROWS if find_columns(names, row))
