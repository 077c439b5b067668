"""Intraclass correlation and what follows from it, on one value per trial (peak, range, event)."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike
from scipy.special import fdtr, fdtri

from engine.datatypes import Array
from engine.errors import ConfigError, DataError, ShapeError
from engine.validation.statistics import UNKNOWN, Interval, require_level

__all__ = [
    "IntraclassCorrelation",
    "compute_icc",
    "minimal_detectable_change",
    "sem_from_icc",
]


@dataclass(frozen=True)
class IntraclassCorrelation:
    """Two-way intraclass correlations of single measurements.

    `icc_2_1` is absolute agreement (a constant offset between methods lowers it), `icc_3_1`
    consistency (it does not). `sem_agreement` and `sem_consistency` are the standard errors of
    measurement that belong to them, in the unit of the data. `n_targets` rows were complete and
    used. `p` tests whether there is any correlation at all.
    """

    n_targets: int
    n_methods: int
    icc_2_1: float
    icc_2_1_interval: Interval
    icc_3_1: float
    icc_3_1_interval: Interval
    f: float
    p: float
    sem_agreement: float
    sem_consistency: float
    level: float = 0.95


@dataclass(frozen=True)
class _MeanSquares:
    """Mean squares of a two-way layout with n rows (targets) and k columns (methods)."""

    rows: float
    columns: float
    error: float
    n: int
    k: int


def compute_icc(measurements: ArrayLike, *, level: float = 0.95) -> IntraclassCorrelation:
    """Compute ICC(2,1) and ICC(3,1) with their confidence intervals.

    Parameters
    ----------
    measurements
        Shape (n, k): one row per trial, one column per method. Rows with a missing value are left
        out.
    level
        Confidence level of the intervals.

    Returns
    -------
    IntraclassCorrelation
        NaN with fewer than two complete rows, or where the trials do not differ at all.

    Raises
    ------
    ShapeError
        If there are not two dimensions and at least two methods.

    References
    ----------
    .. [1] Shrout & Fleiss (1979), Psychol. Bull. 86, 420-428.
    .. [2] McGraw & Wong (1996), Psychol. Methods 1, 30-46.
    """
    require_level(level)
    table = np.asarray(measurements, dtype=np.float64)
    if table.ndim != 2 or table.shape[1] < 2:
        raise ShapeError(f"measurements needs shape (trials, methods >= 2), got {table.shape}.")
    table = table[np.isfinite(table).all(axis=1)]
    n, k = table.shape
    spread = float(np.ptp(table)) if n else 0.0
    if n < 2 or spread == 0.0:
        return _unknown(n, k, level)
    ms = _mean_squares(table)
    if max(ms.rows, ms.error) <= 1e-24 * spread**2:
        return _unknown(n, k, level)
    # What rounding leaves of an error of nothing must not become a finite F.
    if ms.error <= 1e-24 * spread**2:
        ms = _MeanSquares(ms.rows, ms.columns, 0.0, n, k)
    f = ms.rows / ms.error if ms.error > 0 else math.inf
    between_methods = max(0.0, (ms.columns - ms.error) / n)
    return IntraclassCorrelation(
        n_targets=n,
        n_methods=k,
        icc_2_1=_agreement(ms),
        icc_2_1_interval=_agreement_interval(ms, level),
        icc_3_1=(ms.rows - ms.error) / (ms.rows + (k - 1) * ms.error),
        icc_3_1_interval=_consistency_interval(ms, level),
        f=f,
        p=1.0 - float(fdtr(n - 1, (n - 1) * (k - 1), f)),
        sem_agreement=math.sqrt(between_methods + ms.error),
        sem_consistency=math.sqrt(ms.error),
        level=level,
    )


def _unknown(n: int, k: int, level: float) -> IntraclassCorrelation:
    nan = math.nan
    return IntraclassCorrelation(n, k, nan, UNKNOWN, nan, UNKNOWN, nan, nan, nan, nan, level)


def _mean_squares(table: Array) -> _MeanSquares:
    n, k = table.shape
    centred = table - table.mean()
    rows, columns = centred.mean(axis=1), centred.mean(axis=0)
    residual = centred - rows[:, None] - columns[None, :]
    return _MeanSquares(
        rows=k * float(rows @ rows) / (n - 1),
        columns=n * float(columns @ columns) / (k - 1),
        error=float(np.square(residual).sum()) / ((n - 1) * (k - 1)),
        n=n,
        k=k,
    )


def _agreement(ms: _MeanSquares) -> float:
    denominator = ms.rows + (ms.k - 1) * ms.error + ms.k * (ms.columns - ms.error) / ms.n
    return (ms.rows - ms.error) / denominator if denominator > 0 else math.nan


def _agreement_interval(ms: _MeanSquares, level: float) -> Interval:
    """Return the interval of ICC(2,1), by Satterthwaite's degrees of freedom."""
    n, k, rho = ms.n, ms.k, _agreement(ms)
    if ms.error == 0.0 and ms.columns <= 1e-24 * ms.rows:
        return Interval(1.0, 1.0)
    if math.isnan(rho) or rho >= 1.0:
        return UNKNOWN
    a = k * rho / (n * (1 - rho))
    b = 1 + k * rho * (n - 1) / (n * (1 - rho))
    total = a * ms.columns + b * ms.error
    parts = (a * ms.columns) ** 2 / (k - 1) + (b * ms.error) ** 2 / ((n - 1) * (k - 1))
    if not parts > 0:
        return UNKNOWN
    df = total**2 / parts
    upper_tail = 0.5 + level / 2
    f_low = float(fdtri(n - 1, df, upper_tail))
    f_high = float(fdtri(df, n - 1, upper_tail))
    rest = k * ms.columns + (k * n - k - n) * ms.error
    low = n * (ms.rows - f_low * ms.error) / (f_low * rest + n * ms.rows)
    high = n * (f_high * ms.rows - ms.error) / (rest + n * f_high * ms.rows)
    return Interval(low, high)


def _consistency_interval(ms: _MeanSquares, level: float) -> Interval:
    if ms.error == 0.0:
        return Interval(1.0, 1.0)
    n, k = ms.n, ms.k
    upper_tail = 0.5 + level / 2
    f = ms.rows / ms.error
    f_low = f / float(fdtri(n - 1, (n - 1) * (k - 1), upper_tail))
    f_high = f * float(fdtri((n - 1) * (k - 1), n - 1, upper_tail))
    return Interval((f_low - 1) / (f_low + k - 1), (f_high - 1) / (f_high + k - 1))


def sem_from_icc(sd: float, icc: float) -> float:
    """Compute the standard error of measurement, ``sd sqrt(1 - icc)``.

    Parameters
    ----------
    sd
        Standard deviation of the measurements over the targets.
    icc
        Their intraclass correlation; a negative estimate counts as 0.
    """
    if sd < 0 or icc > 1:
        raise DataError(f"Expected an SD of at least 0 and an ICC of at most 1, got {sd}, {icc}.")
    return sd * math.sqrt(1.0 - max(icc, 0.0))


def minimal_detectable_change(sem: float, *, coverage_factor: float = 1.96) -> float:
    """Compute the smallest change between two measurements that is not error.

    ``sem * coverage_factor * sqrt(2)``: both measurements carry the error.

    References
    ----------
    .. [1] Weir (2005), J. Strength Cond. Res. 19, 231-240.
    """
    if sem < 0 or coverage_factor <= 0:
        raise ConfigError(
            "A standard error of measurement is at least 0 and its coverage factor positive, "
            f"got {sem:g} and {coverage_factor:g}."
        )
    return sem * coverage_factor * math.sqrt(2.0)
