"""Joints that jump away for a moment and jump back: seen from positions, not from lengths.

A misplaced joint may keep its distance to its neighbour, and noise hides small changes of
length. Between two jumps that undo each other, with calm motion before and after, it is wrong
all the same. A fast movement differs: it speeds up and slows down over several frames.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from engine.correction.robust import mad_sigma
from engine.datatypes import Array
from engine.skeletons import Skeleton

__all__ = ["find_bumps"]

TORSO = ("left_shoulder", "right_shoulder", "left_hip", "right_hip")
LEAST_JUMP_M = 0.08
JUMP_SIGMAS = 6.0
"""A jump is longer than both: this far, and so many robust SD of the joint's steps."""
CALM_SHARE = 0.5
"""Steps just before the first and after the second jump are at most this share of the jump."""
MISMATCH_SHARE = 0.5
"""The two jumps cancel to within this share."""
LONGEST_S = 0.75
LIKE_M = 0.03
"""Steps of the torso's points that differ by this count half."""


def find_bumps(time_s: Array, position_m: Array, skeleton: Skeleton) -> NDArray[np.bool_]:
    """Find samples between two jumps of one joint that cancel each other.

    Parameters
    ----------
    time_s
        Shape (T,), s.
    position_m
        Shape (T, K, D), about metres; NaN where there is no trustworthy position.
    skeleton
        Names of the keypoints.

    Returns
    -------
    NDArray[bool]
        Shape (T, K). Nothing at the ends of the clip, where one of the two jumps is not seen.
    """
    found = np.zeros(position_m.shape[:2], dtype=bool)
    if len(time_s) < 4:
        return found
    step = np.diff(position_m, axis=0)
    step = step - _torso_step(step, skeleton)
    size = np.linalg.norm(step, axis=2)
    usual = np.nan_to_num(mad_sigma(step.reshape(len(step), step[0].size)))
    usual = usual.reshape(step.shape[1:]).max(axis=1)
    is_jump = np.nan_to_num(size) > np.maximum(LEAST_JUMP_M, JUMP_SIGMAS * usual)
    calm = np.nan_to_num(size)
    before, after = np.zeros_like(calm), np.zeros_like(calm)
    before[1:], after[:-1] = calm[:-1], calm[1:]
    is_start = is_jump & (before <= CALM_SHARE * calm)
    is_end = is_jump & (after <= CALM_SHARE * calm)
    for k in np.flatnonzero(is_start.any(axis=0) & is_end.any(axis=0)):
        _mark_pairs(found[:, k], time_s, step[:, k], is_start[:, k], is_end[:, k])
    return found


def _torso_step(step: Array, skeleton: Skeleton) -> Array:
    """Return the person's own way, shape (T - 1, 1, D): the torso's step without its outliers."""
    columns = [skeleton.index(name) for name in TORSO if name in skeleton.keypoints]
    if not columns:
        return np.zeros_like(step[:, :1])
    torso = step[:, columns]
    known = np.asarray(np.isfinite(torso).all(axis=2))
    torso = np.where(known[:, :, None], torso, 0.0)
    both = known[:, :, None] & known[:, None, :]
    apart = np.linalg.norm(torso[:, :, None] - torso[:, None, :], axis=3) * both
    total = np.where(known, apart.sum(axis=2), np.inf)
    # From the point that moves most like the others; a misplaced one then hardly counts.
    centre = total.argmin(axis=1)[:, None, None]
    distance = np.take_along_axis(apart, centre, axis=1)[:, 0]
    weight = known / (1.0 + (distance / LIKE_M) ** 2)
    share = weight.sum(axis=1, keepdims=True)
    weight = np.divide(weight, share, out=np.zeros_like(weight), where=share > 0)
    return np.asarray((weight[:, :, None] * torso).sum(axis=1, keepdims=True))


def _mark_pairs(
    found: NDArray[np.bool_],
    time_s: Array,
    step: Array,
    is_start: NDArray[np.bool_],
    is_end: NDArray[np.bool_],
) -> None:
    """Mark the samples between each jump and the first later one that undoes it, in place."""
    ends = np.flatnonzero(is_end)
    free_from = 0
    for start in np.flatnonzero(is_start):
        if start < free_from:
            continue
        for end in ends[np.searchsorted(ends, start, side="right") :]:
            if time_s[end + 1] - time_s[start] > LONGEST_S:
                break
            left_over = np.linalg.norm(step[start] + step[end])
            sizes = np.linalg.norm(step[start]), np.linalg.norm(step[end])
            if left_over <= MISMATCH_SHARE * max(sizes):
                found[start + 1 : end + 1] = True
                free_from = end + 1
                break
