"""Everything about the agreement of one angle over several trials, and of all angles.

Trials are pooled by subject. Inference rests on independent units: subjects where there are two or
more, otherwise the trials of the one subject, whose results then hold for that person only.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from engine.datatypes import Array, frozen_array
from engine.errors import DataError, ShapeError
from engine.validation.bland_altman import (
    BlandAltman,
    ProportionalBias,
    compute_bland_altman,
    compute_proportional_bias,
)
from engine.validation.curves import (
    CurveAgreement,
    angle_difference,
    compare_curves,
    compute_cmc,
    unwrap_deg,
    wrap_deg,
)
from engine.validation.curvewise import N_FLIPS, CurveTest, normalise_curve, permute_curves
from engine.validation.reliability import (
    IntraclassCorrelation,
    compute_icc,
    minimal_detectable_change,
)
from engine.validation.statistics import (
    N_RESAMPLES,
    BootstrapResult,
    EquivalenceTest,
    FrameTest,
    PairedTest,
    adjust_holm,
    bootstrap_clusters,
    compute_equivalence,
    compute_frame_t_test,
    compute_paired_t_test,
    group_codes,
    mean_per_cluster,
)

__all__ = [
    "MARGINS_DEG",
    "AngleSummary",
    "PairedTrial",
    "PooledDifference",
    "ScalarAgreement",
    "TrialAgreement",
    "summarise_agreement",
    "summarise_angle",
]

MARGINS_DEG = (2.0, 5.0)
"""Margins of equivalence: strict, and the usual clinical tolerance."""

Quantity = Literal["maximum", "minimum", "range_of_motion"]
Unit = Literal["subject", "trial"]


@dataclass(frozen=True, eq=False)
class PairedTrial:
    """Estimated and reference angles of one trial on one time base.

    `time_s` (T,); `estimated_deg` and `reference_deg` (T, A), degrees, NaN where missing.
    """

    subject: str
    label: str
    time_s: Array
    names: tuple[str, ...]
    estimated_deg: Array
    reference_deg: Array
    task: str = ""

    def __post_init__(self) -> None:
        shape = (np.size(self.time_s), len(self.names))
        for name in ("time_s", "estimated_deg", "reference_deg"):
            object.__setattr__(self, name, frozen_array(getattr(self, name)))
        for name in ("estimated_deg", "reference_deg"):
            if getattr(self, name).shape != shape:
                raise ShapeError(
                    f"{name} of trial {self.label!r} needs shape {shape}, got "
                    f"{getattr(self, name).shape}."
                )

    def curves(self, name: str) -> tuple[Array, Array]:
        """Return estimate and reference of one angle, shape (T,) each."""
        column = self.names.index(name)
        return self.estimated_deg[:, column], self.reference_deg[:, column]


@dataclass(frozen=True)
class TrialAgreement:
    """Agreement of one angle in one trial."""

    subject: str
    label: str
    task: str
    curve: CurveAgreement


@dataclass(frozen=True)
class PooledDifference:
    """The differences of all frames of all trials together, degrees; every frame counts the same.

    `n_samples` frames are worth `n_effective` independent ones.
    """

    n_samples: int
    n_effective: float
    bias_deg: float
    sd_deg: float
    mae_deg: float
    sd_absolute_deg: float
    rmse_deg: float
    centred_rmse_deg: float
    max_deg: float
    p95_deg: float
    cmc: float


@dataclass(frozen=True)
class ScalarAgreement:
    """Agreement of one value per trial, such as the highest angle.

    `mdc_deg` is the smallest change in a subject that is not error, if the reference has none.
    """

    quantity: Quantity
    n_trials: int
    bland_altman: BlandAltman
    icc: IntraclassCorrelation
    mdc_deg: float


@dataclass(frozen=True)
class AngleSummary:
    """Agreement of one angle over all trials.

    Parameters
    ----------
    name, n_trials, n_subjects, unit
        The angle, what it was measured in (trials with a common sample only), and what counts as
        independent.
    trials
        Every trial with this angle, also those without a common sample.
    pooled
        All frames together.
    bias, rmse
        With intervals from resampling units, in degrees.
    bland_altman, proportional_bias
        On frames, within and between units; the latter against the reference.
    per_trial, per_unit, per_frame
        Paired t-tests of the mean difference, degrees.
    equivalence
        One test per margin, on units.
    scalars
        Highest and lowest value and range of motion of each trial.
    curve_test
        Where along the movement (0 to 100 % of the trial) the curves differ, on units.
    p_holm
        `per_unit.p` adjusted for the number of angles tested together.
    """

    name: str
    n_trials: int
    n_subjects: int
    unit: Unit
    trials: tuple[TrialAgreement, ...]
    pooled: PooledDifference
    bias: BootstrapResult
    rmse: BootstrapResult
    bland_altman: BlandAltman
    proportional_bias: ProportionalBias
    per_trial: PairedTest
    per_unit: PairedTest
    per_frame: FrameTest
    equivalence: tuple[EquivalenceTest, ...]
    scalars: tuple[ScalarAgreement, ...]
    curve_test: CurveTest
    p_holm: float = math.nan


@dataclass(frozen=True, eq=False)
class _Paired:
    """One angle's samples: curves per trial, and everything pooled with its labels."""

    trials: tuple[PairedTrial, ...]
    curves: tuple[CurveAgreement, ...]
    estimated: tuple[Array, ...]
    reference: tuple[Array, ...]
    difference: tuple[Array, ...]
    unit: Unit
    units: tuple[str, ...]

    @property
    def frame_units(self) -> NDArray[np.intp]:
        """The number of every frame's unit, in order of appearance."""
        codes, _ = group_codes(self.units, len(self.units))
        return np.repeat(codes, [d.size for d in self.difference])


def summarise_agreement(
    trials: Iterable[PairedTrial],
    *,
    margins_deg: Sequence[float] = MARGINS_DEG,
    model_range_deg: Mapping[str, float] | None = None,
    n_resamples: int = N_RESAMPLES,
    n_flips: int = N_FLIPS,
    seed: int = 0,
) -> tuple[AngleSummary, ...]:
    """Summarise every angle over all trials and adjust the tests for the number of angles.

    Parameters
    ----------
    trials
        Subject and label together must tell trials apart.
    margins_deg
        Margins of equivalence.
    model_range_deg
        Range of each angle's coordinate in the model, where known.
    n_resamples, n_flips, seed
        Bootstrap samples, sign flips, and the seed of both.

    Returns
    -------
    tuple of AngleSummary
        In order of first appearance; angles without any common sample are included, as NaN.
    """
    kept = tuple(trials)
    if not kept:
        raise DataError("There is no trial to compare. Give at least one.")
    names = dict.fromkeys(name for trial in kept for name in trial.names)
    ranges = model_range_deg or {}
    summaries = [
        summarise_angle(
            name,
            kept,
            margins_deg=margins_deg,
            model_range_deg=ranges.get(name, math.nan),
            n_resamples=n_resamples,
            n_flips=n_flips,
            seed=seed,
        )
        for name in names
    ]
    adjusted = adjust_holm([summary.per_unit.p for summary in summaries])
    return tuple(replace(s, p_holm=float(p)) for s, p in zip(summaries, adjusted, strict=True))


def summarise_angle(
    name: str,
    trials: Iterable[PairedTrial],
    *,
    margins_deg: Sequence[float] = MARGINS_DEG,
    model_range_deg: float = math.nan,
    n_resamples: int = N_RESAMPLES,
    n_flips: int = N_FLIPS,
    seed: int = 0,
) -> AngleSummary:
    """Summarise one angle over all trials that have it; parameters as in `summarise_agreement`."""
    everything, data = _collect(name, tuple(trials), model_range_deg)
    pooled, labels = _concatenate(data.difference), data.frame_units
    means = np.array([curve.bias_deg for curve in data.curves])
    unit_means = mean_per_cluster(means, data.units)
    return AngleSummary(
        name=name,
        n_trials=len(data.trials),
        n_subjects=len({trial.subject for trial in data.trials}),
        unit=data.unit,
        trials=everything,
        pooled=_pool(data, pooled),
        bias=bootstrap_clusters(
            pooled, labels, statistic="mean", n_resamples=n_resamples, seed=seed
        ),
        rmse=bootstrap_clusters(
            pooled, labels, statistic="rms", n_resamples=n_resamples, seed=seed
        ),
        bland_altman=compute_bland_altman(pooled, labels, n_effective=_worth(data)),
        proportional_bias=compute_proportional_bias(
            _concatenate(data.estimated), _concatenate(data.reference), labels, against="reference"
        ),
        per_trial=compute_paired_t_test(means),
        per_unit=compute_paired_t_test(unit_means),
        per_frame=compute_frame_t_test(data.difference),
        equivalence=tuple(compute_equivalence(unit_means, margin=m) for m in margins_deg),
        scalars=_compare_scalars(data),
        curve_test=permute_curves(_unit_curves(data), n_flips=n_flips, seed=seed),
    )


def _collect(
    name: str, trials: tuple[PairedTrial, ...], model_range_deg: float
) -> tuple[tuple[TrialAgreement, ...], _Paired]:
    """Return every trial's agreement, and the samples of the trials that have any."""
    having = [trial for trial in trials if name in trial.names]
    if not having:
        raise DataError(f"No trial has the angle {name!r}.")
    everything, kept, curves = [], [], []
    pairs: list[tuple[Array, Array]] = []
    for trial in having:
        estimated, reference = trial.curves(name)
        curve = compare_curves(trial.time_s, estimated, reference, model_range_deg=model_range_deg)
        everything.append(TrialAgreement(trial.subject, trial.label, trial.task, curve))
        if curve.n_samples:
            kept.append(trial)
            curves.append(curve)
            difference = angle_difference(estimated, reference)
            pairs.append((unwrap_deg(reference, np.isfinite(difference)), difference))
    unit: Unit = "subject" if len({trial.subject for trial in kept}) > 1 else "trial"
    units = tuple(t.subject if unit == "subject" else f"{i}:{t.label}" for i, t in enumerate(kept))
    return tuple(everything), _Paired(
        trials=tuple(kept),
        curves=tuple(curves),
        # The wrapped difference, not the raw one, must separate the two.
        estimated=tuple(reference + difference for reference, difference in pairs),
        reference=tuple(reference for reference, _ in pairs),
        difference=tuple(difference for _, difference in pairs),
        unit=unit,
        units=units,
    )


def _concatenate(curves: Sequence[Array]) -> Array:
    return np.concatenate(curves) if curves else np.empty(0)


def _pool(data: _Paired, pooled: Array) -> PooledDifference:
    d = pooled[np.isfinite(pooled)]
    if not d.size:
        return PooledDifference(0, 0.0, *[math.nan] * 9)
    absolute = np.abs(d)
    return PooledDifference(
        n_samples=d.size,
        n_effective=sum(curve.n_effective for curve in data.curves),
        bias_deg=float(d.mean()),
        sd_deg=float(d.std(ddof=1)) if d.size > 1 else math.nan,
        mae_deg=float(absolute.mean()),
        sd_absolute_deg=float(absolute.std(ddof=1)) if d.size > 1 else math.nan,
        rmse_deg=math.sqrt(float(np.square(d).mean())),
        centred_rmse_deg=float(d.std()),
        max_deg=float(absolute.max()),
        p95_deg=float(np.quantile(absolute, 0.95, method="inverted_cdf")),
        cmc=compute_cmc(_movements(data)),
    )


def _movements(data: _Paired) -> Array:
    """Return all trials as (W, 2, F), the shorter ones filled up with NaN."""
    longest = max(d.size for d in data.difference)
    curves = np.full((len(data.trials), 2, longest), np.nan)
    for i, (a, b) in enumerate(zip(data.estimated, data.reference, strict=True)):
        curves[i, :, : a.size] = a, b
    return curves


def _worth(data: _Paired) -> Array:
    """Return how many independent samples each unit has, in order of appearance."""
    total: dict[str, float] = {}
    for unit, curve in zip(data.units, data.curves, strict=True):
        total[unit] = total.get(unit, 0.0) + curve.n_effective
    return np.array(list(total.values()))


def _compare_scalars(data: _Paired) -> tuple[ScalarAgreement, ...]:
    references = {
        "maximum": [c.maximum.reference_deg for c in data.curves],
        "minimum": [c.minimum.reference_deg for c in data.curves],
        "range_of_motion": [c.rom_reference_deg for c in data.curves],
    }
    errors = {
        "maximum": [c.maximum.error_deg for c in data.curves],
        "minimum": [c.minimum.error_deg for c in data.curves],
        "range_of_motion": [c.rom_error_deg for c in data.curves],
    }
    return tuple(
        _compare_scalar(quantity, np.array(references[quantity]), np.array(errors[quantity]), data)
        for quantity in ("maximum", "minimum", "range_of_motion")
    )


def _compare_scalar(
    quantity: Quantity, reference: Array, error: Array, data: _Paired
) -> ScalarAgreement:
    limits = compute_bland_altman(error, data.units)
    # A subject's constant error cancels in a change; with one trial each it can't be told apart.
    within = limits.within_variance
    sem = limits.sd if math.isnan(within) else math.sqrt(within)
    return ScalarAgreement(
        quantity=quantity,
        n_trials=error.size,
        bland_altman=limits,
        icc=compute_icc(np.column_stack([reference + error, reference])),
        mdc_deg=minimal_detectable_change(sem),
    )


def _unit_curves(data: _Paired) -> Array:
    """Return one curve of differences per unit, (n, 101): trials of a subject are averaged."""
    curves: dict[str, list[Array]] = {}
    for unit, trial, difference in zip(data.units, data.trials, data.difference, strict=True):
        if difference.size > 1:
            curves.setdefault(unit, []).append(normalise_curve(trial.time_s, difference))
    means = [wrap_deg(np.mean(rows, axis=0)) for rows in curves.values()]
    return np.array(means) if means else np.empty((0, 101))
