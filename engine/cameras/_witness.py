"""What the person shows of a calibration: joints where the lines of sight meet, and measures."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from engine.cameras._person import (
    FEET,
    MIRROR,
    Evidence,
    choose_frames,
    collect_evidence,
    column,
    shared_joints,
)
from engine.cameras.monocular import ANKLE_HEIGHT, EAR_HEIGHT
from engine.datatypes import Array, Calibration, Camera, ViewPose
from engine.optics import (
    camera_centre,
    compute_directions,
    normalise_points,
    project,
    to_camera_axes,
)

__all__ = ["Witness", "bear_witness", "find_shift", "miss_by_shift"]

FRAMES = 120
CONFIDENT = 0.5
LEGS_SHARE = 0.47
"""Thigh and shank between keypoints, as a share of stature."""
SHIFTS = tuple(range(-4, 5))
LEGS = (("hip", "knee"), ("knee", "ankle"))
"""Networks place legs well even where they call them hidden; not so arms."""


@dataclass(frozen=True, eq=False)
class Witness:
    """The person as the calibrated cameras see them together.

    `evidence` holds the chosen frames, `points` (F, J, 3) the joints in metres, NaN where not both
    views show them; `seen` (F, J) where both do so confidently; `off_px` (V, F, J) the distances
    in the pictures.
    """

    evidence: Evidence
    cameras: tuple[Camera, ...]
    points: Array
    seen: NDArray[np.bool_]
    off_px: Array

    @property
    def centre(self) -> Array:
        """Where the person is, shape (3,); NaN if never seen."""
        return _median(self.points[:, [column("left_hip"), column("right_hip")]].reshape(-1, 3))

    def in_front_share(self) -> float:
        """Return the share of joints that lie before both cameras."""
        depth = np.stack([to_camera_axes(c, self.points)[..., 2] for c in self.cameras])
        known = np.isfinite(depth).all(axis=0)
        return float(np.all(depth[:, known] > 0, axis=0).mean()) if known.any() else float("nan")

    def miss(self) -> tuple[float, float]:
        """Return the typical distance in the pictures, px and as a share of the person's height."""
        shown = np.where(self.seen, self.off_px, np.nan)
        typical = _typical(shown)
        return typical, _typical(shown / self.evidence.height_px[:, None, None])

    def ray_angle_deg(self) -> float:
        """Return the angle between the directions from the person to the cameras, degrees."""
        arms = [camera_centre(camera) - self.centre for camera in self.cameras]
        cosine = arms[0] @ arms[1] / (np.linalg.norm(arms[0]) * np.linalg.norm(arms[1]))
        return float(np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0))))

    def stature_m(self) -> tuple[float, bool]:
        """Return the stature, and whether it comes from upright frames (else from the legs)."""
        if self.evidence.has_upright:
            stand = self._middle("ear") - self._middle("ankle")
            span = np.linalg.norm(stand, axis=-1)[self.evidence.is_upright]
            if np.isfinite(span).any():
                return float(np.nanmedian(span)) / (EAR_HEIGHT - ANKLE_HEIGHT), True
        legs = [self._length(s, *pair) for s in ("left", "right") for pair in LEGS]
        known = [length for length in legs if np.isfinite(length)]
        return float(np.mean(known)) * 2.0 / LEGS_SHARE if known else float("nan"), False

    def side_difference(self) -> float:
        """Return by how much left and right legs differ in length, as a share, mean over parts."""
        shares = []
        for pair in LEGS:
            left, right = (self._length(side, *pair) for side in ("left", "right"))
            shares.append(abs(left - right) / (0.5 * (left + right)))
        known = [s for s in shares if np.isfinite(s)]
        return float(np.mean(known)) if known else float("nan")

    def length_spread(self) -> float:
        """Return by how much thighs and shanks change over time, as a share of their length."""
        shares = []
        for side in ("left", "right"):
            for pair in LEGS:
                length = self._lengths(side, *pair)
                length = length[np.isfinite(length)]
                if length.size >= 5:
                    low, middle, high = np.percentile(length, [16, 50, 84])
                    shares.append(0.5 * (high - low) / middle)
        return float(np.mean(shares)) if shares else float("nan")

    def upright_axis(self) -> Array:
        """Return the direction from the feet to the head of the standing person, NaN if never."""
        if not self.evidence.has_upright:
            return np.full(3, np.nan)
        axis = self._middle("ear") - self.points[:, FEET].mean(axis=1)
        mean = _median(axis[self.evidence.is_upright])
        return np.asarray(mean / np.linalg.norm(mean))

    def foot_height_m(self, up: Array) -> float:
        """Return the height of planted heels and toes along `up` from the world's origin."""
        height = np.where(self.evidence.is_planted, self.points[:, FEET] @ up, np.nan)
        return float(np.nanmedian(height)) if np.isfinite(height).any() else float("nan")

    def depth_agreement(self) -> float:
        """Return how well depths agree with each view's own idea of them: -1 mirrored, 1 the same.

        Left against right and the body's parts against the hips, the two views together.
        """
        products, sizes = 0.0, 0.0
        for v, camera in enumerate(self.cameras):
            found = self._relative_depth(to_camera_axes(camera, self.points)[..., 2])
            told = self._relative_depth(self.evidence.body[v, ..., 2])
            both = np.isfinite(found) & np.isfinite(told)
            if not both.any():
                continue
            a, b = found[both], told[both]
            products += float(a @ b)
            sizes += float(np.sqrt((a @ a) * (b @ b)))
        return products / sizes if sizes > 0 else float("nan")

    def _relative_depth(self, depth: Array) -> Array:
        return np.asarray(depth - depth[:, MIRROR])[:, _PAIRED]

    def _middle(self, name: str) -> Array:
        left, right = (self.points[:, column(f"{s}_{name}")] for s in ("left", "right"))
        return np.asarray(0.5 * (left + right))

    def _lengths(self, side: str, first: str, second: str) -> Array:
        a, b = column(f"{side}_{first}"), column(f"{side}_{second}")
        return np.asarray(np.linalg.norm(self.points[:, a] - self.points[:, b], axis=-1))

    def _length(self, side: str, first: str, second: str) -> float:
        length = self._lengths(side, first, second)
        known = length[np.isfinite(length)]
        return float(np.median(known)) if known.size >= 5 else float("nan")


_PAIRED = [column(f"left_{name}") for name in ("shoulder", "hip", "knee", "ankle", "heel")]


def _median(vectors: Array) -> Array:
    known = vectors[np.isfinite(vectors).all(axis=-1)]
    return np.median(known, axis=0) if len(known) else np.full(3, np.nan)


def _typical(shown: Array) -> float:
    """Return the median over frames, then the mean over views and joints; (V, F, J)."""
    counts = np.isfinite(shown).all(axis=0).sum(axis=0)
    shown = shown[:, :, counts >= 5]
    return float(np.mean(np.nanmedian(shown, axis=1))) if shown.size else float("nan")


def bear_witness(views: Sequence[ViewPose], calibration: Calibration) -> Witness:
    """Put the joints of a sample of frames where the lines of sight meet.

    Raises
    ------
    CalibrationError
        If the views' times differ, or the estimator has not the joints that are needed.
    """
    everything = collect_evidence(views)
    evidence = everything.take(choose_frames(everything, FRAMES))
    cameras = calibration.cameras
    points = _meet(cameras, evidence.pixels)
    off = np.stack(
        [
            np.linalg.norm(project(camera, points) - pixels, axis=-1)
            for camera, pixels in zip(cameras, evidence.pixels, strict=True)
        ]
    )
    # A joint behind a camera can't be seen there at all.
    off = np.where(np.isfinite(points).all(axis=-1) & ~np.isfinite(off), np.inf, off)
    seen = shared_joints(evidence, confidence=CONFIDENT)
    return Witness(evidence, cameras, points, seen, off)


def _meet(cameras: Sequence[Camera], pixels: Array) -> Array:
    """Return the points nearest to the lines of sight, shape (F, J, 3), m."""
    matrix, right = np.zeros((3, 3)), np.zeros(3)
    for camera, seen in zip(cameras, pixels, strict=True):
        direction = compute_directions(camera, seen)
        across = np.eye(3) - direction[..., :, None] * direction[..., None, :]
        matrix = matrix + across
        right = right + across @ camera_centre(camera)
    # Parallel lines meet far away instead of nowhere.
    matrix = matrix + 1e-9 * np.eye(3)
    known = np.isfinite(matrix).all(axis=(-2, -1)) & np.isfinite(right).all(axis=-1)
    points = np.full(right.shape, np.nan)
    points[known] = np.linalg.solve(matrix[known], right[known][..., None])[..., 0]
    return points


def find_shift(views: Sequence[ViewPose], cameras: Sequence[Camera]) -> tuple[int, float]:
    """Find whether the views fit better when the second is shifted by some frames.

    Returns
    -------
    int
        By how many frames the second view is late: where the views fit best.
    float
        By which share their lines of sight miss each other less there than without a shift.
    """
    everything = collect_evidence(views)
    misses = miss_by_shift(everything, cameras, SHIFTS)
    if not np.isfinite(misses).all():
        return 0, 0.0
    best, still = int(np.argmin(misses)), float(misses[SHIFTS.index(0)])
    return SHIFTS[best], float(1.0 - misses[best] / still) if still > 0 else 0.0


def miss_by_shift(
    everything: Evidence,
    cameras: Sequence[Camera],
    shifts: Sequence[int],
    *,
    is_robust: bool = False,
) -> Array:
    """Return how much the lines of sight miss each other over time, for each shift (frames).

    Parameters
    ----------
    everything
        Of all frames.
    cameras
        Of the views.
    shifts
        By how many frames the second view is taken later.
    is_robust
        Whether to take the typical frame instead of the mean: blind to short events, good or bad.
    """
    frames = choose_frames(everything, FRAMES)
    inside = (frames >= -min(shifts)) & (frames < everything.n_frames - max(shifts))
    frames = frames[inside]
    if frames.size < 10:
        return np.full(len(shifts), np.nan)
    seen = shared_joints(everything, confidence=CONFIDENT)
    misses = []
    for shift in shifts:
        pair = np.stack([everything.pixels[0, frames], everything.pixels[1, frames + shift]])
        shown = np.asarray(seen[frames] & seen[frames + shift])
        misses.append(_epipolar_miss(cameras, pair, shown, everything.height_px, is_robust))
    return np.array(misses)


def _epipolar_miss(
    cameras: Sequence[Camera],
    pixels: Array,
    seen: NDArray[np.bool_],
    height_px: Array,
    is_robust: bool,
) -> float:
    """Return how much the distances from the epipolar lines vary over time, shares of the height.

    Each joint's own mean is left out: networks see a joint in slightly other places from other
    sides, and that has nothing to do with time.
    """
    first, second = cameras
    rotation = second.rotation @ first.rotation.T
    translation = second.translation - rotation @ first.translation
    cross = np.cross(np.eye(3), translation) @ rotation
    flat = [normalise_points(c, p) for c, p in zip(cameras, pixels, strict=True)]
    ones = np.ones((*flat[0].shape[:-1], 1))
    a, b = (np.concatenate([f, ones], axis=-1) for f in flat)
    line_b, line_a = a @ cross.T, b @ cross
    miss = (b * line_b).sum(axis=-1) / np.sqrt(
        (line_a[..., :2] ** 2).sum(axis=-1) + (line_b[..., :2] ** 2).sum(axis=-1)
    )
    miss = miss * np.mean([c.matrix[0, 0] for c in cameras]) / np.mean(height_px)
    shown = np.where(seen, miss, np.nan)[:, seen.sum(axis=0) >= 10]
    if not shown.size:
        return float("nan")
    spread = np.abs(shown - np.nanmedian(shown, axis=0))
    if is_robust:
        return float(1.4826 * np.mean(np.nanmedian(spread, axis=0)))
    return float(np.mean(np.nanmean(spread, axis=0)))
