"""The figures of a comparison as tables: one row each, units in the column names.

NaN is an empty cell. Numbers have six digits; nothing is rounded for looks.
"""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from engine.validation.agreement import AngleSummary
from engine.validation.compare import TrialComparison
from engine.validation.curves import CurveAgreement
from engine.validation.pooled import Agreement

__all__ = ["Table", "build_tables", "format_csv", "tabulate_angles", "tabulate_trials"]

Cell = str | float | int | bool


@dataclass(frozen=True)
class Table:
    """Column names and rows of equal length."""

    name: str
    columns: tuple[str, ...]
    rows: tuple[tuple[Cell, ...], ...]


def build_tables(agreement: Agreement) -> tuple[Table, ...]:
    """Return every table of a comparison."""
    return (
        tabulate_angles(agreement),
        tabulate_trials(agreement),
        _tabulate_scalars(agreement),
        _tabulate_positions(agreement),
        _tabulate_groups(agreement),
        _tabulate_curves(agreement),
    )


def format_csv(table: Table) -> bytes:
    """Write a table as comma-separated text in UTF-8."""
    buffer = io.StringIO()
    writer = csv.writer(buffer, lineterminator="\n")
    writer.writerow(table.columns)
    writer.writerows([_write_cell(cell) for cell in row] for row in table.rows)
    return buffer.getvalue().encode()


def _write_cell(cell: Cell) -> str:
    # Hundreds of thousands of cells come here, nearly all of them floats.
    if isinstance(cell, float):
        return f"{cell:.6g}" if math.isfinite(cell) else ""
    if isinstance(cell, bool):
        return str(cell).lower()
    # A spreadsheet would run a label that starts so as a formula.
    text = str(cell)
    return f"'{text}" if isinstance(cell, str) and text[:1] in ("=", "+", "-", "@") else text


# --------------------------------------------------------------------------- over all trials

_ANGLE_COLUMNS = (
    "task", "angle", "n_trials", "n_subjects", "unit", "n_frames", "n_effective",
    "offset_removed_deg", "bias_deg", "bias_low_deg", "bias_high_deg", "sd_deg", "mae_deg",
    "sd_absolute_deg", "rmse_deg", "rmse_low_deg", "rmse_high_deg", "centred_rmse_deg", "max_deg",
    "p95_deg", "cmc", "loa_lower_deg", "loa_upper_deg", "loa_lower_outer_deg",
    "loa_upper_outer_deg", "between_sd_deg", "within_sd_deg", "proportional_slope",
    "proportional_p", "t_trial_p", "t_unit_p", "t_unit_p_holm", "t_frame_naive_p",
    "t_frame_corrected_p", "tost_2deg_p", "tost_5deg_p", "curve_test_p", "curve_test_parts",
)  # fmt: skip


def tabulate_angles(agreement: Agreement) -> Table:
    """Return one row per angle over all trials, then one per task and angle."""
    rows = [_angle_row("all", s, agreement.trials) for s in agreement.angles]
    for task, summaries in agreement.tasks.items():
        trials = [t for t in agreement.trials if t.task == task]
        rows += [_angle_row(task or "none given", s, trials) for s in summaries]
    return Table("angles", _ANGLE_COLUMNS, tuple(rows))


def _angle_row(task: str, s: AngleSummary, trials: Sequence[TrialComparison]) -> tuple[Cell, ...]:
    p, limits, slope = s.pooled, s.bland_altman, s.proportional_bias
    parts = "; ".join(f"{d.start_percent:.0f}-{d.end_percent:.0f} %" for d in s.curve_test.parts)
    strict, usual = (next(iter([e.p for e in s.equivalence if e.margin == m]), math.nan)
                     for m in (2.0, 5.0))  # fmt: skip
    return (
        task, s.name, s.n_trials, s.n_subjects, s.unit, p.n_samples, p.n_effective,
        _mean_offset(s.name, trials), p.bias_deg, s.bias.interval.low, s.bias.interval.high,
        p.sd_deg, p.mae_deg, p.sd_absolute_deg, p.rmse_deg, s.rmse.interval.low,
        s.rmse.interval.high, p.centred_rmse_deg, p.max_deg, p.p95_deg, p.cmc, limits.lower,
        limits.upper, limits.outer_limits.low, limits.outer_limits.high,
        math.sqrt(limits.between_variance), math.sqrt(limits.within_variance), slope.slope,
        slope.p, s.per_trial.p, s.per_unit.p, s.p_holm, s.per_frame.naive.p,
        s.per_frame.corrected.p, strict, usual, s.curve_test.p, parts,
    )  # fmt: skip


def _mean_offset(name: str, trials: Sequence[TrialComparison]) -> float:
    """Return the mean of the offsets that were taken out; 0 where none was."""
    offsets = [
        angle.offset_deg if trial.is_offset_removed else 0.0
        for trial in trials
        for angle in trial.angles
        if angle.name == name
    ]
    return float(np.mean(offsets)) if offsets else math.nan


# --------------------------------------------------------------------------- trial by trial

_TRIAL_COLUMNS = (
    "subject", "trial", "task", "reference", "source", "lag_s", "lag_sigma_s", "correlation",
    "angle", "offset_deg", "offset_removed", "n_samples", "n_effective", "bias_deg", "sd_deg",
    "mae_deg", "sd_absolute_deg", "rmse_deg", "centred_rmse_deg", "max_deg", "p95_deg", "r",
    "cmc", "lfm_slope", "lfm_offset_deg", "lfm_r2", "rom_result_deg", "rom_reference_deg",
    "rom_error_deg", "max_error_deg", "max_lag_s", "min_error_deg", "min_lag_s",
    "percent_of_excursion",
)  # fmt: skip


def tabulate_trials(agreement: Agreement) -> Table:
    """Return one row per trial and angle."""
    return Table("trials", _TRIAL_COLUMNS, tuple(_trial_rows(agreement.trials)))


def _trial_rows(trials: Iterable[TrialComparison]) -> Iterator[tuple[Cell, ...]]:
    for trial in trials:
        time = trial.alignment
        head = (
            trial.subject, trial.label, trial.task, trial.reference.name, trial.source,
            time.lag_s, time.lag_sigma_s, time.correlation,
        )  # fmt: skip
        for angle in trial.angles:
            offset = (angle.name, angle.offset_deg, trial.is_offset_removed)
            yield (*head, *offset, *_curve_cells(trial.judged(angle)))


def _curve_cells(c: CurveAgreement) -> tuple[Cell, ...]:
    fit = c.linear_fit
    return (
        c.n_samples, c.n_effective, c.bias_deg, c.sd_deg, c.mae_deg, c.sd_absolute_deg,
        c.rmse_deg, c.centred_rmse_deg, c.max_deg, c.p95_deg, c.r, c.cmc, fit.slope,
        fit.offset_deg, fit.r2, c.rom_estimated_deg, c.rom_reference_deg, c.rom_error_deg,
        c.maximum.error_deg, c.maximum.lag_s, c.minimum.error_deg, c.minimum.lag_s,
        c.percent_of_excursion,
    )  # fmt: skip


def _tabulate_scalars(agreement: Agreement) -> Table:
    columns = (
        "angle", "quantity", "n_trials", "bias_deg", "loa_lower_deg", "loa_upper_deg", "icc_2_1",
        "icc_2_1_low", "icc_2_1_high", "icc_3_1", "icc_3_1_low", "icc_3_1_high",
        "sem_agreement_deg", "mdc_deg",
    )  # fmt: skip
    rows = tuple(
        (
            s.name, q.quantity, q.n_trials, q.bland_altman.bias, q.bland_altman.lower,
            q.bland_altman.upper, q.icc.icc_2_1, *q.icc.icc_2_1_interval, q.icc.icc_3_1,
            *q.icc.icc_3_1_interval, q.icc.sem_agreement, q.mdc_deg,
        )
        for s in agreement.angles
        for q in s.scalars
    )  # fmt: skip
    return Table("scalars", columns, rows)


def _tabulate_positions(agreement: Agreement) -> Table:
    columns = (
        "subject", "trial", "alignment", "joint", "n_samples", "mean_mm", "sd_mm", "rmse_mm",
        "max_mm",
    )  # fmt: skip
    rows: list[tuple[Cell, ...]] = []
    for trial in agreement.trials:
        for found in trial.positions:
            kind = "rigid" if found.alignment == "none" else found.alignment
            head = (trial.subject, trial.label, kind)
            every = (found.n_samples, found.mpjpe_mm, math.nan, math.nan, math.nan)
            rows.append((*head, "all", *every))
            rows += [
                (*head, j.name, j.n_samples, j.mean_mm, j.sd_mm, j.rmse_mm, j.max_mm)
                for j in found.joints
            ]
    return Table("positions", columns, tuple(rows))


def _tabulate_groups(agreement: Agreement) -> Table:
    columns = ("subject", "trial", "group", "n_angles", "n_expected", "majae_deg",
               "majae_without_offset_deg")  # fmt: skip
    rows: list[tuple[Cell, ...]] = []
    for trial in agreement.trials:
        both = zip(trial.majae.groups, trial.majae_without_offset.groups, strict=True)
        rows += [
            (trial.subject, trial.label, a.name, a.n_angles, a.n_expected, a.mae_deg, b.mae_deg)
            for a, b in both
        ]
        found = len(trial.majae.angles) - len(trial.majae.missing)
        means = (trial.majae.mean_available_deg, trial.majae_without_offset.mean_available_deg)
        rows.append((trial.subject, trial.label, "available", found, 17, *means))
        overall = (trial.majae.overall_deg, trial.majae_without_offset.overall_deg)
        rows.append((trial.subject, trial.label, "overall", found, 17, *overall))
    return Table("majae", columns, tuple(rows))


def _tabulate_curves(agreement: Agreement) -> Table:
    columns = ("subject", "trial", "angle", "time_s", "result_deg", "reference_deg",
               "difference_deg", "result_sigma_deg")  # fmt: skip
    rows: list[tuple[Cell, ...]] = []
    for trial in agreement.trials:
        pairs = trial.pairs
        time = pairs.time_s.tolist()
        for i, name in enumerate(trial.names):
            values = (trial.estimated_deg, pairs.reference_deg, trial.difference_deg)
            own, other, difference = (v[:, i].tolist() for v in values)
            sigma = pairs.sigma_deg[:, i].tolist()
            head = (trial.subject, trial.label, name)
            rows += [
                (*head, *sample)
                for sample in zip(time, own, other, difference, sigma, strict=True)
                if not math.isnan(sample[3])
            ]
    return Table("curves", columns, tuple(rows))
