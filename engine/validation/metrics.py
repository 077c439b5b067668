"""How far estimated joint positions are from a reference.

Positions are in metres, results in millimetres, as the field reports them. The name of the
alignment is part of every result: figures under different alignments can't be compared. Only joints
that exist on both sides count, and every result says how many those were.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType
from typing import Literal, get_args

import numpy as np
from numpy.typing import ArrayLike, NDArray

from engine.datatypes import Array
from engine.errors import ConfigError, DataError, ShapeError

__all__ = [
    "ALIGNMENTS",
    "PCK_THRESHOLD_MM",
    "Alignment",
    "JointError",
    "PositionAgreement",
    "align_poses",
    "compare_poses",
]

Alignment = Literal["none", "root", "scale", "procrustes"]
ALIGNMENTS: Mapping[Alignment, str] = MappingProxyType(
    {
        "none": "MPJPE in the common frame of the laboratory",
        "root": "MPJPE after moving the root joints onto each other in every frame",
        "scale": "N-MPJPE: root-aligned, then scaled in every frame",
        "procrustes": "PA-MPJPE: moved, turned and scaled in every frame (similarity Procrustes)",
    }
)

PCK_THRESHOLD_MM = 150.0
AUC_STEP_MM = 5.0


@dataclass(frozen=True)
class JointError:
    """Distance of one joint from its reference over the frames, mm."""

    name: str
    n_samples: int
    mean_mm: float
    sd_mm: float
    rmse_mm: float
    max_mm: float


@dataclass(frozen=True)
class PositionAgreement:
    """Agreement of joint positions under a named alignment.

    Parameters
    ----------
    alignment
        Key of `ALIGNMENTS`.
    n_samples, n_frames
        Joint samples and frames that were used.
    mpjpe_mm
        Mean distance over all samples.
    frame_mean_mm, frame_sd_mm
        Mean and SD over the frames of each frame's mean distance.
    median_mm, p95_mm
        Median and 95th percentile of the distance.
    mpjve_mm_s, n_velocities
        Mean length of the velocity's error, and the samples it rests on. For the figure per frame
        that papers on networks give, divide by the frame rate.
    pck_percent
        Share of samples within `pck_threshold_mm`.
    auc_percent
        Mean of that share over thresholds from 0 to `pck_threshold_mm` in steps of 5 mm.
    joints
        One entry per joint.
    """

    alignment: Alignment
    n_samples: int
    n_frames: int
    mpjpe_mm: float
    frame_mean_mm: float
    frame_sd_mm: float
    median_mm: float
    p95_mm: float
    mpjve_mm_s: float
    n_velocities: int
    pck_percent: float
    auc_percent: float
    joints: tuple[JointError, ...]
    pck_threshold_mm: float = PCK_THRESHOLD_MM

    @property
    def description(self) -> str:
        """The alignment in words."""
        return ALIGNMENTS[self.alignment]


def align_poses(
    estimated_m: ArrayLike,
    reference_m: ArrayLike,
    alignment: Alignment,
    *,
    root: Sequence[int] = (),
) -> Array:
    """Bring estimated poses onto the reference, frame by frame.

    Parameters
    ----------
    estimated_m, reference_m
        Shape (T, K, D), m, with D = 2 or 3; NaN where missing.
    alignment
        One of `ALIGNMENTS`.
    root
        Columns whose mean is the root (such as both hips), for `root` and `scale`.

    Returns
    -------
    Array
        Shape (T, K, D): the estimate in the frame of the reference; NaN where a joint is missing on
        either side. `procrustes` needs D joints that don't coincide, `root` and `scale` the root;
        other frames are NaN.

    Raises
    ------
    ShapeError
        If the shapes don't fit.
    ConfigError
        If the alignment is unknown or lacks its root.

    References
    ----------
    .. [1] Umeyama (1991), IEEE Trans. Pattern Anal. Mach. Intell. 13, 376-380.
    .. [2] Rhodin et al. (2018), ECCV, for the scaled form.
    """
    estimated, reference = _require_poses(estimated_m, reference_m)
    if alignment not in get_args(Alignment):
        raise ConfigError(f"Unknown alignment {alignment!r}; known: {', '.join(ALIGNMENTS)}.")
    both = np.asarray(np.isfinite(estimated).all(axis=2) & np.isfinite(reference).all(axis=2))
    estimated = np.where(both[..., None], estimated, np.nan)
    if alignment == "none":
        return estimated
    if alignment == "procrustes":
        return _align_similarity(estimated, reference, both)
    if not root:
        raise ConfigError(f"Alignment {alignment!r} needs the columns of the root. Give root=...")
    columns = list(root)
    centre = reference[:, columns].mean(axis=1, keepdims=True)
    centred = estimated - estimated[:, columns].mean(axis=1, keepdims=True)
    if alignment == "scale":
        target = np.where(both[..., None], reference - centre, np.nan)
        product, square = (np.nansum(centred * v, axis=(1, 2)) for v in (target, centred))
        # A negative factor would mirror the pose.
        factor = np.maximum(product, 0.0) / np.where(square > 0, square, np.nan)
        centred = centred * factor[:, None, None]
    return np.asarray(centred + centre)


def _require_poses(estimated_m: ArrayLike, reference_m: ArrayLike) -> tuple[Array, Array]:
    estimated = np.asarray(estimated_m, dtype=np.float64)
    reference = np.asarray(reference_m, dtype=np.float64)
    if estimated.shape != reference.shape:
        raise ShapeError(
            f"Estimate and reference need the same shape, got {estimated.shape} and "
            f"{reference.shape}. Bring both to one time base and one order of joints first."
        )
    if estimated.ndim != 3 or estimated.shape[2] not in (2, 3):
        raise ShapeError(f"Positions need shape (T, K, 2 or 3), got {estimated.shape}.")
    return estimated, reference


def _align_similarity(estimated: Array, reference: Array, both: NDArray[np.bool_]) -> Array:
    """Turn, scale and move every frame by least squares; a mirror image is not allowed."""
    count = both.sum(axis=1)
    weight = both[..., None] / np.maximum(count, 1)[:, None, None]
    source, target = (np.where(both[..., None], v, 0.0) for v in (estimated, reference))
    centre = (target * weight).sum(axis=1, keepdims=True)
    x = np.where(both[..., None], source - (source * weight).sum(axis=1, keepdims=True), 0.0)
    y = np.where(both[..., None], target - centre, 0.0)
    u, singular, vt = np.linalg.svd(np.swapaxes(y, 1, 2) @ x)
    # The reflection guard: where the best orthogonal matrix mirrors, take the best rotation.
    flip = np.ones_like(singular)
    flip[:, -1] = np.sign(np.linalg.det(u @ vt))
    rotation = (u * flip[:, None, :]) @ vt
    spread = np.square(x).sum(axis=(1, 2))
    enough = (count >= estimated.shape[2]) & (spread > 0)
    scale = (singular * flip).sum(axis=1) / np.where(enough, spread, np.nan)
    aligned = scale[:, None, None] * (x @ np.swapaxes(rotation, 1, 2)) + centre
    return np.where(both[..., None], aligned, np.nan)


def compare_poses(
    time_s: ArrayLike,
    estimated_m: ArrayLike,
    reference_m: ArrayLike,
    *,
    names: Sequence[str],
    alignment: Alignment,
    root: Sequence[int] = (),
    pck_threshold_mm: float = PCK_THRESHOLD_MM,
) -> PositionAgreement:
    """Compare joint positions with their reference.

    Parameters
    ----------
    time_s
        Shape (T,), s, increasing.
    estimated_m, reference_m
        Shape (T, K, D), m; NaN where missing.
    names
        The K joints.
    alignment, root
        As in `align_poses`.
    pck_threshold_mm
        Distance up to which a joint counts as found.

    Returns
    -------
    PositionAgreement
        NaN where no sample exists on both sides.
    """
    aligned = align_poses(estimated_m, reference_m, alignment, root=root)
    time, reference = np.asarray(time_s, np.float64), np.asarray(reference_m, np.float64)
    if time.shape != aligned.shape[:1] or len(names) != aligned.shape[1]:
        raise ShapeError(
            f"Expected {aligned.shape[0]} times and {aligned.shape[1]} names, got {time.size} and "
            f"{len(names)}."
        )
    if time.size > 1 and not np.all(np.diff(time) > 0):
        raise DataError("time_s must increase from frame to frame, but it does not.")
    if not pck_threshold_mm > 0:
        raise ConfigError(f"The PCK threshold must be positive, got {pck_threshold_mm:g} mm.")
    error = 1000.0 * (aligned - reference)
    distance = np.linalg.norm(error, axis=2)
    known = np.isfinite(distance)
    found = distance[known]
    frames = _row_means(distance, known)
    speed = np.linalg.norm(np.diff(error, axis=0) / np.diff(time)[:, None, None], axis=2)
    speed = speed[np.isfinite(speed)]
    steps = np.arange(0.0, pck_threshold_mm + AUC_STEP_MM / 2, AUC_STEP_MM)
    return PositionAgreement(
        alignment=alignment,
        n_samples=found.size,
        n_frames=frames.size,
        mpjpe_mm=_mean(found),
        frame_mean_mm=_mean(frames),
        frame_sd_mm=_sd(frames),
        median_mm=_quantile(found, 0.5),
        p95_mm=_quantile(found, 0.95),
        mpjve_mm_s=_mean(speed),
        n_velocities=speed.size,
        pck_percent=_percent_within(found, np.array([pck_threshold_mm])),
        auc_percent=_percent_within(found, steps),
        joints=_joint_errors(names, distance, known),
        pck_threshold_mm=pck_threshold_mm,
    )


def _row_means(distance: Array, known: NDArray[np.bool_]) -> Array:
    count = known.sum(axis=1)
    total = np.where(known, distance, 0.0).sum(axis=1)
    return np.asarray(total[count > 0] / count[count > 0])


def _joint_errors(
    names: Sequence[str], distance: Array, known: NDArray[np.bool_]
) -> tuple[JointError, ...]:
    count = known.sum(axis=0)
    n = np.where(count > 0, count, np.nan)
    found = np.where(known, distance, 0.0)
    mean = found.sum(axis=0) / n
    squares = np.where(known, (distance - mean) ** 2, 0.0).sum(axis=0)
    columns = np.column_stack(
        [
            mean,
            np.sqrt(squares / np.where(count > 1, count - 1, np.nan)),
            np.sqrt(np.square(found).sum(axis=0) / n),
            np.where(count > 0, found.max(axis=0, initial=0.0), np.nan),
        ]
    )
    rows = zip(names, count.tolist(), columns.tolist(), strict=True)
    return tuple(JointError(name, size, *figures) for name, size, figures in rows)


def _percent_within(distance: Array, thresholds: Array) -> float:
    """Return the share of distances up to each threshold, averaged over the thresholds."""
    if not distance.size:
        return math.nan
    within = np.searchsorted(np.sort(distance), thresholds, side="right")
    return 100.0 * float(within.mean()) / distance.size


def _mean(values: Array) -> float:
    return float(values.mean()) if values.size else math.nan


def _sd(values: Array) -> float:
    return float(values.std(ddof=1)) if values.size > 1 else math.nan


def _quantile(values: Array, share: float) -> float:
    return float(np.quantile(values, share)) if values.size else math.nan
