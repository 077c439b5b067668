"""Which of two views has left and right exchanged, and when.

Exchanged sides in one view make the lines of sight of both sides miss each other, or (where both
sides are at one height) meet far from where the estimator's landmarks put them. Which view is
wrong, and whether both are, only the frames before and after can tell.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from engine.cameras._sight import Sight
from engine.datatypes import Array
from engine.skeletons import Skeleton

__all__ = ["exchange", "find_labels"]

GROUPS = (
    ("elbow", "wrist", "index", "pinky", "thumb"),
    ("hip",),
    ("knee", "ankle", "heel", "big_toe"),
)
"""What is exchanged together: arms, hips, legs, and shoulders with the face."""
PLAIN = ("shoulder", "elbow", "wrist", "hip", "knee", "ankle")
"""Joints that are looked at; the rest follows its group."""
MISS_CAP = 16.0
"""The most a joint may say, in squared standard errors: a misplaced one must not decide alone."""
EXCHANGED_COST = 4.0
WIDTH_SIGMA_M = 0.12
"""Of an estimator's landmarks, from the left joint to the right one, per axis."""
CHANGE_COST = 8.0
JUMP_M = 0.08
JUMP_CAP = 9.0
"""How far a joint moves in a frame, and the most a jump may cost."""

Triangulator = Callable[[Array, Array], tuple[Array, Array]]
"""Undistorted pictures (V, T, K, 2) and sigma (V, T, K) to points (T, K, 3) and misses (T, K)."""


def groups_of(skeleton: Skeleton) -> tuple[tuple[tuple[int, int], ...], ...]:
    """Return the left-right pairs of every group, as columns."""
    names = skeleton.keypoints
    groups = [tuple(p for p in skeleton.pairs if names[p[0]].endswith(parts)) for parts in GROUPS]
    rest = tuple(p for p in skeleton.pairs if not any(p in group for group in groups))
    return (*groups, rest)


def exchange(sight: Sight, is_exchanged: NDArray[np.bool_]) -> Sight:
    """Exchange left and right where `is_exchanged` (V, T, K) says so."""
    order = list(sight.skeleton.mirror_order)
    wide = is_exchanged[..., None]
    return replace(
        sight,
        pixels=np.where(wide, sight.pixels[:, :, order], sight.pixels),
        flat=np.where(wide, sight.flat[:, :, order], sight.flat),
        confidence=np.where(is_exchanged, sight.confidence[:, :, order], sight.confidence),
        body=np.where(wide, sight.body[:, :, order], sight.body),
    )


def find_labels(sight: Sight, sigma: Array, triangulator: Triangulator) -> NDArray[np.bool_]:
    """Find the samples of two views whose sides are exchanged.

    For each of `GROUPS`, the four labellings (none, either view, both) of every
    frame are weighed by how well the lines of sight meet and how steadily the joints move; the best
    sequence over the clip is found by dynamic programming. Doubt keeps the labels given.

    Parameters
    ----------
    sight
        Two views.
    sigma
        Shape (2, T, K).
    triangulator
        Puts points where lines of sight meet.

    Returns
    -------
    NDArray[bool]
        Shape (2, T, K): to be exchanged with the other side.
    """
    names = sight.skeleton.keypoints
    groups = groups_of(sight.skeleton)
    plain = [[p for p in group if names[p[0]].endswith(PLAIN)] for group in groups]
    pairs = [pair for group in plain for pair in group]
    found = np.zeros(sight.confidence.shape, dtype=bool)
    if not pairs:
        return found
    costs, joints = _weigh(sight, sigma, triangulator, pairs)
    last = np.cumsum([len(group) for group in plain])
    for group, start, stop in zip(groups, [0, *last[:-1]], last, strict=True):
        if start == stop:
            continue
        count = EXCHANGED_COST * np.array([0.0, 1.0, 1.0, 2.0])
        cost = costs[:, :, start:stop].sum(axis=2) + count[:, None]
        path = _best_path(cost, joints[:, :, 2 * start : 2 * stop])
        everything = np.array([k for pair in group for k in pair])
        for v in (0, 1):
            found[v][np.ix_(np.flatnonzero(path >> v & 1), everything)] = True
    return found


def _weigh(
    sight: Sight, sigma: Array, triangulator: Triangulator, pairs: list[tuple[int, int]]
) -> tuple[Array, Array]:
    """Return cost (4, T, P) and joints (4, T, 2P, 3) of the labellings of pairs.

    Bit v of a labelling's number: view v exchanged.
    """
    # Exchanging both views mirrors the joints and exchanging the other view mirrors those of
    # the one, so two triangulations serve four labellings.
    columns = [k for pair in pairs for k in pair]
    mirrored = [k for pair in pairs for k in pair[::-1]]
    kept = triangulator(sight.flat[:, :, columns], sigma[:, :, columns])
    turned = triangulator(
        np.stack([sight.flat[0][:, mirrored], sight.flat[1][:, columns]]),
        np.stack([sigma[0][:, mirrored], sigma[1][:, columns]]),
    )
    mirror = [columns.index(k) for k in mirrored]
    joints = np.stack([kept[0], turned[0], turned[0][:, mirror], kept[0][:, mirror]])
    told = [body[:, columns[1::2]] - body[:, columns[0::2]] for body in sight.body]
    cost_kept = _disagree(kept, (told[0], told[1]))
    cost_turned = _disagree(turned, (-told[0], told[1]))
    return np.stack([cost_kept, cost_turned, cost_turned, cost_kept]), joints


def _disagree(found: tuple[Array, Array], told: tuple[Array, Array]) -> Array:
    """Return how badly lines of sight and landmarks of each pair go together, shape (T, P)."""
    points, miss = found
    capped = np.nan_to_num(np.minimum(miss, MISS_CAP))
    cost = capped[:, 0::2] + capped[:, 1::2]
    across = points[:, 1::2] - points[:, 0::2]
    for way in told:
        square = ((across - way) ** 2).sum(axis=-1) / WIDTH_SIGMA_M**2
        cost += np.nan_to_num(np.minimum(square, MISS_CAP))
    return np.asarray(cost)


def _best_path(cost: Array, joints: Array) -> NDArray[np.intp]:
    """Return the cheapest sequence of states (Viterbi); cost (S, T), joints (S, T, J, 3)."""
    n_states, n_frames = cost.shape
    best, source = cost[:, 0].copy(), np.zeros((n_frames, n_states), dtype=np.intp)
    steps = np.linalg.norm(joints[:, None, 1:] - joints[None, :, :-1], axis=-1)
    jump = np.nan_to_num(np.minimum((steps / JUMP_M) ** 2, JUMP_CAP)).sum(axis=-1)  # (now, before)
    change = np.array([[(a ^ b).bit_count() for b in range(n_states)] for a in range(n_states)])
    move = jump + CHANGE_COST * change[:, :, None]
    for t in range(1, n_frames):
        reach = best[None, :] + move[:, :, t - 1]
        source[t] = reach.argmin(axis=1)
        best = cost[:, t] + reach.min(axis=1)
    path = np.zeros(n_frames, dtype=np.intp)
    path[-1] = int(best.argmin())
    for t in range(n_frames - 1, 0, -1):
        path[t - 1] = source[t, path[t]]
    return path
