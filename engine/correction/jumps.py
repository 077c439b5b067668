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
LONGEST_S = 0.5


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
    step = np.diff(_about_torso(position_m, skeleton), axis=0)
    size = np.linalg.norm(step, axis=2)
    usual = np.nan_to_num(mad_sigma(step.reshape(len(step), -1)))
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


def _about_torso(position: Array, skeleton: Skeleton) -> Array:
    """Return positions about the middle of the torso, which leaves out the person's own way."""
    columns = [skeleton.index(name) for name in TORSO if name in skeleton.keypoints]
    if not columns:
        return position
    return np.asarray(position - position[:, columns].mean(axis=1, keepdims=True))


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
