"""A sharper offset where the cameras are known: lines of sight of one joint must meet.

While a joint moves across the epipolar lines, a wrong offset drives its two lines of sight apart,
and it does so with another sign on the way back. That error of the network's keypoints which stays
the same for a joint is left out, and what remains has little to do with the errors of the
comparison of speeds: the mean of both is better than either.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from engine.datatypes import Array, Camera, CheckLevel, SyncEstimate, ViewPose
from engine.errors import DataError
from engine.optics import normalise_points
from engine.skeletons import get_skeleton
from engine.video._motion import GRID_HZ, KEYPOINTS, MIN_OVERLAP_S, fit_lines, sample

__all__ = ["refine_offset"]

STEPS: Final = 4
REWEIGHTINGS: Final = 6
MAX_SHIFT_S: Final = 0.12
"""Straight lines through the paths hold up to about this shift."""
SIGMA_FLOOR_S: Final = 0.004
SHARED_ERROR: Final = 0.3
"""Correlation of the errors of both ways, measured on training lifts."""
HUBER: Final = 1.5


@dataclass(frozen=True, eq=False)
class _Paths:
    """Joints on an even clock: place and speed at unit depth (T, J, 2), weight (T, J)."""

    start_s: float
    place: Array
    speed: Array
    weight: Array


def refine_offset(
    first: ViewPose, second: ViewPose, cameras: Sequence[Camera], estimate: SyncEstimate
) -> SyncEstimate:
    """Sharpen an offset with known cameras.

    Parameters
    ----------
    first, second
        What an estimator saw in each video.
    cameras
        Of the first and the second view, in one world. Only their pose relative to each other and
        their lenses count; the scale does not.
    estimate
        What `estimate_offset` found; red ones and offsets given by the user come back unchanged.

    Returns
    -------
    SyncEstimate
        The mean of both ways, weighted by their errors. Amber where they disagree: the offset or
        the calibration is then wrong, and the offset stays as it was.

    Raises
    ------
    DataError
        If there are not two cameras.
    """
    if len(cameras) != 2:
        raise DataError(f"Expected the cameras of both views, got {len(cameras)}.")
    if estimate.level is CheckLevel.RED or estimate.method == "user":
        return estimate
    essential = _essential(*cameras)
    if essential is None:
        return estimate
    paths = _trace(first, second, cameras)
    offset_s, sigma_s = estimate.offset_s, math.inf
    for _ in range(STEPS):
        found = _step(*paths, essential, offset_s, estimate.drift)
        if found is None:
            return estimate
        offset_s, sigma_s = offset_s + found[0], found[1]
        if abs(offset_s - estimate.offset_s) > MAX_SHIFT_S:
            break
    return _join(estimate, offset_s, sigma_s)


def _join(estimate: SyncEstimate, offset_s: float, sigma_s: float) -> SyncEstimate:
    tolerance_s = 3.0 * math.hypot(estimate.sigma_s, sigma_s)
    if abs(offset_s - estimate.offset_s) > min(tolerance_s, MAX_SHIFT_S):
        return dataclasses.replace(
            estimate,
            level=CheckLevel.AMBER,
            sentence=f"The movement says an offset of {estimate.offset_s:.3f} s, but the lines of "
            "sight do not meet best there: the offset or the calibration is wrong. Check both.",
        )
    share = sigma_s**2 / (estimate.sigma_s**2 + sigma_s**2)
    mean_s = share * estimate.offset_s + (1.0 - share) * offset_s
    parts = share * estimate.sigma_s, (1.0 - share) * sigma_s
    variance = parts[0] ** 2 + parts[1] ** 2 + 2.0 * SHARED_ERROR * parts[0] * parts[1]
    return dataclasses.replace(estimate, offset_s=mean_s, sigma_s=math.sqrt(variance))


def _essential(first: Camera, second: Camera) -> Array | None:
    """Return E with ``x2 @ E @ x1 = 0``, of unit baseline; None where the cameras coincide."""
    rotation = second.rotation @ first.rotation.T
    baseline = second.translation - rotation @ first.translation
    length = float(np.linalg.norm(baseline))
    if length < 1e-6:
        return None
    x, y, z = baseline / length
    return np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]]) @ rotation


def _trace(first: ViewPose, second: ViewPose, cameras: Sequence[Camera]) -> tuple[_Paths, _Paths]:
    skeletons = [get_skeleton(view.image.skeleton) for view in (first, second)]
    shared = [k for k in KEYPOINTS if all(k in s.keypoints for s in skeletons)]
    paths = []
    for view, camera, skeleton in zip((first, second), cameras, skeletons, strict=True):
        columns = [skeleton.index(name) for name in shared]
        track = view.image
        place = normalise_points(camera, track.position[:, columns])
        confidence = np.nan_to_num(track.confidence[:, columns], nan=1.0)
        known = np.isfinite(place).all(axis=2)
        weight = np.where(known, np.clip(confidence, 0.0, 1.0) ** 2, 0.0)
        grid = np.arange(track.time_s[0], track.time_s[-1] + 1e-9, 1.0 / GRID_HZ)
        paths.append(
            _Paths(float(grid[0]), *fit_lines(track.time_s, np.nan_to_num(place), weight, grid))
        )
    return paths[0], paths[1]


def _step(
    first: _Paths, second: _Paths, essential: Array, offset_s: float, drift: float
) -> tuple[float, float] | None:
    """Return the shift that brings lines of sight together, and its standard error."""
    time_s = first.start_s + np.arange(len(first.weight)) / GRID_HZ
    at = ((time_s - offset_s) / (1.0 + drift) - second.start_s) * GRID_HZ
    inside = (at >= 0.0) & (at <= len(second.weight) - 1)
    if np.count_nonzero(inside) < MIN_OVERLAP_S * GRID_HZ:
        return None
    at = at[inside]
    weight = np.minimum(first.weight[inside], sample(second.weight, at))
    miss, slope = _measure_misses(
        (first.place[inside], first.speed[inside]),
        (sample(second.place, at), sample(second.speed, at)),
        essential,
    )
    return _solve(miss, slope, weight)


def _measure_misses(
    first: tuple[Array, Array], second: tuple[Array, Array], essential: Array
) -> tuple[Array, Array]:
    """Return how far lines of sight pass each other (T, J), and by how much more per second."""
    (place_a, speed_a), (place_b, speed_b) = first, second
    line_b, line_a = _homogeneous(place_a) @ essential.T, _homogeneous(place_b) @ essential
    size = np.sqrt(np.sum(line_a[..., :2] ** 2, axis=2) + np.sum(line_b[..., :2] ** 2, axis=2))
    size = np.maximum(size, 1e-9)
    miss = np.sum(_homogeneous(place_b) * line_b, axis=2) / size
    by_a = np.sum(speed_a * line_a[..., :2], axis=2) / size
    by_b = np.sum(speed_b * line_b[..., :2], axis=2) / size
    # A later second view moves b back, or a forward: the mean of both averages their noise.
    return miss, 0.5 * (by_a - by_b)


def _homogeneous(points: Array) -> Array:
    return np.concatenate([points, np.ones((*points.shape[:-1], 1))], axis=-1)


def _solve(miss: Array, slope: Array, weight: Array) -> tuple[float, float] | None:
    """Fit the shift and a constant per joint by least squares, outliers down-weighted."""
    robust = weight.copy()
    shift, joint_shift, strength = 0.0, np.zeros(miss.shape[1]), np.zeros(miss.shape[1])
    for _ in range(REWEIGHTINGS):
        total = np.maximum(robust.sum(axis=0), 1e-9)
        own_miss = miss - np.sum(robust * miss, axis=0) / total
        own_slope = slope - np.sum(robust * slope, axis=0) / total
        strength = np.sum(robust * own_slope**2, axis=0)
        if not strength.sum() > 1e-9:
            return None
        joint_shift = -np.sum(robust * own_slope * own_miss, axis=0) / np.maximum(strength, 1e-12)
        shift = float(np.average(joint_shift, weights=strength))
        left = np.abs(own_miss + shift * own_slope)
        spread = 1.48 * float(np.median(left[weight > 0.3 * weight.max()]))
        robust = weight / np.maximum(1.0, left / max(HUBER * spread, 1e-9))
    scatter = float(np.average((joint_shift - shift) ** 2, weights=strength))
    n_joints = float(strength.sum() ** 2 / np.sum(strength**2))
    return shift, math.sqrt(scatter / n_joints + SIGMA_FLOOR_S**2)
