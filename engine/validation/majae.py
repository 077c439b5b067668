"""Mean absolute joint angle error in the groups of the monocular paper, and improvements of it."""

from __future__ import annotations

import math
from collections.abc import Hashable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType

import numpy as np
from numpy.typing import ArrayLike

from engine.datatypes import Array
from engine.errors import ConfigError, DataError, ShapeError
from engine.validation.curves import angle_difference
from engine.validation.statistics import (
    MIN_CLUSTERS,
    N_RESAMPLES,
    UNKNOWN,
    Interval,
    group_codes,
    percentile_interval,
    require_level,
    resampling_counts,
)

__all__ = [
    "MAJAE_GROUPS",
    "MAJAE_GROUPS_TRUNK",
    "AngleError",
    "GroupError",
    "Improvement",
    "Majae",
    "compute_improvement",
    "compute_majae",
]


def _sides(*names: str) -> tuple[str, ...]:
    return tuple(f"{name}_{side}" for name in names for side in ("l", "r"))


_LIMBS: Mapping[str, tuple[str, ...]] = {
    "sagittal": _sides("hip_flexion", "knee_flexion", "shoulder_flexion", "elbow_flexion"),
    "coronal": _sides("hip_adduction", "shoulder_adduction"),
    "transversal": _sides("shoulder_rotation"),
}

MAJAE_GROUPS: Mapping[str, tuple[str, ...]] = MappingProxyType(
    {"torso": ("lumbar_flexion", "lumbar_bending", "lumbar_rotation"), **_LIMBS}
)
"""The 17 angles of Choi et al. (2024): torso 3, sagittal 8, coronal 4, transversal 2."""

MAJAE_GROUPS_TRUNK: Mapping[str, tuple[str, ...]] = MappingProxyType(
    {"torso": ("trunk_flexion", "trunk_lateral_bend", "trunk_twist"), **_LIMBS}
)
"""The same with the trunk's angles to the vertical, which twelve joints determine; those of the
waist need a body model's assumption about the pelvis."""


@dataclass(frozen=True)
class AngleError:
    """Mean absolute error of one angle; `offset_deg` was subtracted before (0 if nothing was)."""

    name: str
    group: str
    n_samples: int
    mae_deg: float
    offset_deg: float = 0.0


@dataclass(frozen=True)
class GroupError:
    """Mean over the angles of a group that were there, out of `n_expected`."""

    name: str
    n_angles: int
    n_expected: int
    mae_deg: float


@dataclass(frozen=True)
class Majae:
    """MAJAE by angle and by group.

    `overall_deg` weights the groups by their numbers of angles (3, 8, 4, 2 of 17) and is NaN unless
    every angle is there; `mean_available_deg` is the plain mean of those that are. `missing` names
    the angles without a common sample.
    """

    angles: tuple[AngleError, ...]
    groups: tuple[GroupError, ...]
    overall_deg: float
    mean_available_deg: float
    missing: tuple[str, ...]
    offset_window_s: tuple[float, float] | None = None

    def group(self, name: str) -> GroupError:
        """Return one group.

        Raises
        ------
        DataError
            If there is none of that name.
        """
        for group in self.groups:
            if group.name == name:
                return group
        known = ", ".join(group.name for group in self.groups)
        raise DataError(f"There is no group {name!r}; known: {known}.")


@dataclass(frozen=True)
class Improvement:
    """By how many percent a correction lowers an error, in both ways of averaging.

    `mean_of_rows_percent` averages the improvement of every row (motion and estimator), so that a
    row with a small error counts as much as one with a large; `of_mean_percent` is the improvement
    of the mean error. They can differ widely: state which one is quoted.
    """

    n_rows: int
    n_clusters: int
    n_worse: int
    original_mean: float
    corrected_mean: float
    mean_of_rows_percent: float
    mean_of_rows_interval: Interval
    of_mean_percent: float
    of_mean_interval: Interval
    rows_percent: tuple[float, ...]
    seed: int
    level: float = 0.95


def compute_majae(
    time_s: ArrayLike,
    names: Sequence[str],
    estimated_deg: ArrayLike,
    reference_deg: ArrayLike,
    *,
    groups: Mapping[str, tuple[str, ...]] = MAJAE_GROUPS,
    offset_window_s: tuple[float, float] | None = None,
) -> Majae:
    """Compute the mean absolute joint angle error.

    Parameters
    ----------
    time_s
        Shape (T,), s.
    names
        The A angles; those that belong to no group are left out.
    estimated_deg, reference_deg
        Shape (T, A), degrees; NaN where missing. Differences are wrapped to +-180 degrees.
    groups
        Names of the angles in each group.
    offset_window_s
        From and to, s: the median difference in this (static) time is subtracted from each angle,
        which removes an offset between conventions, and with it any true error that is constant.

    Returns
    -------
    Majae
        An angle without samples in the window is missing.

    Raises
    ------
    ShapeError, ConfigError
        If the shapes don't fit, or the window holds no frame.
    """
    time = np.asarray(time_s, dtype=np.float64)
    difference = angle_difference(estimated_deg, reference_deg)
    if difference.shape != (time.size, len(names)):
        raise ShapeError(f"Angles need shape {(time.size, len(names))}, got {difference.shape}.")
    window = _window(time, offset_window_s)
    column = {name: difference[:, i] for i, name in enumerate(names)}
    angles = tuple(
        _angle_error(name, group, column.get(name, np.empty(0)), window)
        for group, members in groups.items()
        for name in members
    )
    group_errors = tuple(_group_error(group, angles) for group in groups)
    weights = np.array([group.n_expected for group in group_errors], dtype=np.float64)
    missing = tuple(angle.name for angle in angles if angle.n_samples == 0)
    means = np.array([group.mae_deg for group in group_errors])
    return Majae(
        angles=angles,
        groups=group_errors,
        overall_deg=math.nan if missing else float(weights @ means / weights.sum()),
        mean_available_deg=_mean_of(angles),
        missing=missing,
        offset_window_s=offset_window_s,
    )


def _window(time: Array, window_s: tuple[float, float] | None) -> slice | None:
    if window_s is None:
        return None
    first, last = (int(np.searchsorted(time, t)) for t in window_s)
    if last <= first:
        raise ConfigError(
            f"No frame lies between {window_s[0]:g} and {window_s[1]:g} s. Give a window inside "
            "the recording."
        )
    return slice(first, last)


def _angle_error(name: str, group: str, difference: Array, window: slice | None) -> AngleError:
    offset = 0.0
    if window is not None and difference.size:
        static = difference[window]
        static = static[np.isfinite(static)]
        offset = float(np.median(static)) if static.size else math.nan
    rest = np.abs(difference - offset)
    rest = rest[np.isfinite(rest)]
    mae = float(rest.mean()) if rest.size else math.nan
    return AngleError(name, group, rest.size, mae, offset)


def _group_error(name: str, angles: Sequence[AngleError]) -> GroupError:
    members = [angle for angle in angles if angle.group == name]
    present = sum(angle.n_samples > 0 for angle in members)
    return GroupError(name, present, len(members), _mean_of(members))


def _mean_of(angles: Sequence[AngleError]) -> float:
    present = [angle.mae_deg for angle in angles if angle.n_samples]
    return float(np.mean(present)) if present else math.nan


def compute_improvement(
    original: ArrayLike,
    corrected: ArrayLike,
    *,
    clusters: Iterable[Hashable] | None = None,
    level: float = 0.95,
    n_resamples: int = N_RESAMPLES,
    seed: int = 0,
) -> Improvement:
    """Compute by how much a correction lowers an error, with bootstrap intervals.

    Parameters
    ----------
    original, corrected
        Shape (n,): the error of every row before and after; rows with a missing value are left out.
    clusters
        What the rows have in common, such as the motion: whole clusters are resampled. By default
        every row stands for itself.
    level, n_resamples, seed
        Confidence level, number of bootstrap samples, seed of the generator.

    Returns
    -------
    Improvement
        Positive where the correction helps; intervals NaN with fewer than `MIN_CLUSTERS` clusters.

    Raises
    ------
    ShapeError
        If both don't have one value per row.
    DataError
        If an error is negative, or an original one 0, which can't be improved on.
    """
    require_level(level)
    before, after = np.asarray(original, np.float64), np.asarray(corrected, np.float64)
    if before.shape != after.shape or before.ndim != 1:
        raise ShapeError(f"Expected one value per row in both, got {before.shape}, {after.shape}.")
    codes, _ = group_codes(range(before.size) if clusters is None else clusters, before.size)
    known = np.isfinite(before) & np.isfinite(after)
    before, after, codes = before[known], after[known], codes[known]
    if np.any(before <= 0) or np.any(after < 0):
        raise DataError("Errors must be positive (corrected ones may be 0), but one here is not.")
    rows = 100.0 * (1.0 - after / before)
    _, codes = np.unique(codes, return_inverse=True)
    k = int(codes.max()) + 1 if codes.size else 0
    of_rows, of_mean = UNKNOWN, UNKNOWN
    if k >= MIN_CLUSTERS:
        drawn = resampling_counts(k, n_resamples=n_resamples, seed=seed)
        sizes, gains, befores, afters = (
            drawn @ np.bincount(codes, weights=w, minlength=k)
            for w in (np.ones(rows.size), rows, before, after)
        )
        of_rows = percentile_interval(gains / sizes, n_clusters=k, level=level)
        of_mean = percentile_interval(100.0 * (1.0 - afters / befores), n_clusters=k, level=level)
    has_rows = rows.size > 0
    return Improvement(
        n_rows=rows.size,
        n_clusters=k,
        n_worse=int(np.sum(after > before)),
        original_mean=float(before.mean()) if has_rows else math.nan,
        corrected_mean=float(after.mean()) if has_rows else math.nan,
        mean_of_rows_percent=float(rows.mean()) if has_rows else math.nan,
        mean_of_rows_interval=of_rows,
        of_mean_percent=100.0 * (1.0 - float(after.sum() / before.sum())) if has_rows else math.nan,
        of_mean_interval=of_mean,
        rows_percent=tuple(rows.tolist()),
        seed=seed,
        level=level,
    )
