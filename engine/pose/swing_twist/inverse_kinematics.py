"""Rotations of the joints from their positions: analytic inverse kinematics by swing and twist.

A position fixes how a bone swings; only the twist about the bone stays open and must come from
elsewhere. Pelvis and upper spine carry three bones each, so their rotation is the best fit to three
points. Written from the description in the article, for the plain skeleton of this package.

References
----------
.. [1] Li J. et al. (2021), HybrIK: a hybrid analytical-neural inverse kinematics solution for 3D
   human pose and shape estimation. CVPR, section 3.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final, Literal

import numpy as np
from numpy.typing import ArrayLike

from engine.datatypes import Array
from engine.errors import ShapeError
from engine.pose.swing_twist.skeleton29 import (
    BRANCHING,
    CHILDREN,
    N_JOINTS,
    N_TURNING,
    ONLY_CHILD,
    PARENTS,
    RestSkeleton,
)

__all__ = [
    "MAX_DEVIATION_M",
    "PosedSkeleton",
    "compute_swings",
    "compute_twists",
    "fit_rotation",
    "place_joints",
    "rotate_about",
    "solve_posture",
    "twist_about",
]

MAX_DEVIATION_M: Final = 0.015
"""Up to here a bone is aimed from where the bones before it ended, beyond it along the joints that
were seen, so that one wrong joint does not bend everything after it (Li et al. 2021)."""

SMALL: Final = 1e-9
_FLAT: Final = 1e-6
"""Three points whose second principal spread is below this share of the first lie on one line."""


@dataclass(frozen=True, eq=False)
class PosedSkeleton:
    """A skeleton in a posture.

    Parameters
    ----------
    rotation
        Shape (T, 24, 3, 3), each joint's rotation relative to its parent's; the pelvis's relative
        to the axes of the joints seen. NaN where it could not be found.
    joints
        Shape (T, 29, 3), m: where the skeleton's joints are then.
    """

    rotation: Array
    joints: Array


def rotate_about(axis: Array, angle: Array) -> Array:
    """Return rotations (..., 3, 3) about unit axes (..., 3) by radians (...) (Rodrigues)."""
    cosine, sine = np.cos(angle), np.sin(angle)
    return _rodrigues(axis, cosine, sine)


def _rodrigues(axis: Array, cosine: Array, sine: Array) -> Array:
    x, y, z = axis[..., 0], axis[..., 1], axis[..., 2]
    rest = 1.0 - cosine
    matrix = np.empty((*np.broadcast_shapes(x.shape, cosine.shape), 3, 3))
    matrix[..., 0, 0] = cosine + rest * x * x
    matrix[..., 1, 1] = cosine + rest * y * y
    matrix[..., 2, 2] = cosine + rest * z * z
    matrix[..., 0, 1], matrix[..., 1, 0] = rest * x * y - sine * z, rest * x * y + sine * z
    matrix[..., 0, 2], matrix[..., 2, 0] = rest * x * z + sine * y, rest * x * z - sine * y
    matrix[..., 1, 2], matrix[..., 2, 1] = rest * y * z - sine * x, rest * y * z + sine * x
    return matrix


def compute_swings(rest: Array, target: Array) -> Array:
    """Return the smallest rotations that turn one direction into others.

    Parameters
    ----------
    rest
        Shape (3,), not zero.
    target
        Shape (T, 3), any lengths.

    Returns
    -------
    Array
        Shape (T, 3, 3); the identity where the directions agree; half a turn about a fixed axis
        across `rest` where they are opposite, as any such axis would do; NaN where the target is
        NaN or has no length.
    """
    unit = rest / np.linalg.norm(rest)
    length = np.linalg.norm(target, axis=1, keepdims=True)
    aim = np.divide(target, length, out=np.full_like(target, np.nan), where=length > SMALL)
    cosine = np.clip(aim @ unit, -1.0, 1.0)
    normal = np.cross(unit, aim)
    sine = np.linalg.norm(normal, axis=1)
    is_straight = ~(sine > SMALL)  # NaN counts as straight here and is NaN by its cosine
    axis = np.where(
        is_straight[:, None], _across(unit), normal / np.where(is_straight, 1.0, sine)[:, None]
    )
    return _rodrigues(axis, cosine, np.where(is_straight, 0.0, sine))


def _across(unit: Array) -> Array:
    """Return a unit vector at right angles to another one, always the same."""
    other = np.zeros(3)
    other[np.argmin(np.abs(unit))] = 1.0
    normal = np.cross(unit, other)
    return np.asarray(normal / np.linalg.norm(normal))


def place_joints(rest: RestSkeleton, rotation: Array, root: ArrayLike = 0.0) -> PosedSkeleton:
    """Turn the joints and say where they go (forward kinematics).

    Parameters
    ----------
    rest
        The skeleton.
    rotation
        Shape (T, 24, 3, 3), relative to the parent.
    root
        Shape (T, 3) or a constant, m: where the pelvis is.

    Raises
    ------
    ShapeError
        If the rotations have another shape.
    """
    if rotation.ndim != 4 or rotation.shape[1:] != (N_TURNING, 3, 3):
        raise ShapeError(f"Rotations need shape (T, 24, 3, 3), got {rotation.shape}.")
    joints = np.empty((len(rotation), N_JOINTS, 3))
    joints[:, 0] = root
    turned = np.empty_like(rotation)
    turned[:, 0] = rotation[:, 0]
    for joint, parent in enumerate(PARENTS[1:], start=1):
        joints[:, joint] = joints[:, parent] + turned[:, parent] @ rest.offsets[joint]
        if joint < N_TURNING:
            turned[:, joint] = turned[:, parent] @ rotation[:, joint]
    return PosedSkeleton(rotation, joints)


def compute_twists(rest: RestSkeleton, rotation: Array) -> Array:
    """Return the twist that is in each rotation: what its swing leaves over.

    Parameters
    ----------
    rest
        The skeleton, whose bones are the axes.
    rotation
        Shape (T, 24, 3, 3), relative to the parent.

    Returns
    -------
    Array
        Shape (T, 23), radians, of every joint but the pelvis; zero for the upper spine, which has
        three bones and therefore no twist of its own.
    """
    twist = np.zeros((len(rotation), N_TURNING - 1))
    for joint, child in ONLY_CHILD.items():
        twist[:, joint - 1] = twist_about(rest.offsets[child], rotation[:, joint])
    return twist


def twist_about(bone: Array, rotation: Array) -> Array:
    """Return the twist (T,), radians, of rotations (T, 3, 3) about a bone (3,) they swing."""
    swing = compute_swings(bone, rotation @ bone)
    left = np.swapaxes(swing, 1, 2) @ rotation
    skew = np.stack(
        [
            left[:, 2, 1] - left[:, 1, 2],
            left[:, 0, 2] - left[:, 2, 0],
            left[:, 1, 0] - left[:, 0, 1],
        ],
        axis=1,
    )
    axis = bone / np.linalg.norm(bone)
    trace = np.trace(left, axis1=1, axis2=2)
    return np.asarray(np.arctan2(0.5 * skew @ axis, 0.5 * (trace - 1.0)))


def solve_posture(
    rest: RestSkeleton,
    joints: ArrayLike,
    twist: ArrayLike | None = None,
    *,
    ik: Literal["adaptive", "naive"] = "adaptive",
    max_deviation_m: float = MAX_DEVIATION_M,
) -> PosedSkeleton:
    """Find the rotations that bring a skeleton to the joints that were seen.

    Parameters
    ----------
    rest
        The skeleton; its bones keep their lengths whatever was seen.
    joints
        Shape (T, 29, 3), m, any axes; NaN where missing. What hangs on a missing joint is NaN.
    twist
        Shape (T, 23), radians; none if left out.
    ik
        `naive` turns every bone into the direction between the joints seen. `adaptive` aims it
        from where the bones before it really ended, which keeps errors from adding up, unless that
        place is more than `max_deviation_m` off the joint seen.
    max_deviation_m
        Only for `adaptive`.

    Returns
    -------
    PosedSkeleton
        With the pelvis where it was seen.

    Raises
    ------
    ShapeError
        If the shapes differ from these.
    """
    seen = np.asarray(joints, dtype=np.float64)
    if seen.ndim != 3 or seen.shape[1:] != (N_JOINTS, 3):
        raise ShapeError(f"Joints need shape (T, 29, 3), got {seen.shape}.")
    angle = _check_twist(twist, len(seen))
    rotation = np.empty((len(seen), N_TURNING, 3, 3))
    turned, placed = np.empty_like(rotation), np.full_like(seen, np.nan)
    placed[:, 0] = seen[:, 0]
    offsets = rest.offsets
    for joint in range(N_TURNING):
        start = seen[:, joint]
        if ik == "adaptive":
            off = np.linalg.norm(placed[:, joint] - start, axis=1)
            start = np.where((off <= max_deviation_m)[:, None], placed[:, joint], start)
        above = (
            turned[:, PARENTS[joint]] if joint else np.broadcast_to(np.eye(3), (len(seen), 3, 3))
        )
        children = list(CHILDREN[joint])
        # Directions wanted in the axes of the joint's parent.
        wanted = np.einsum("tji,tcj->tci", above, seen[:, children] - start[:, None])
        if joint in BRANCHING:
            rotation[:, joint] = fit_rotation(offsets[children], wanted)
        else:
            bone = offsets[children[0]]
            swing = compute_swings(bone, wanted[:, 0])
            axis = bone / np.linalg.norm(bone)
            rotation[:, joint] = swing @ rotate_about(axis, angle[:, joint - 1])
        turned[:, joint] = above @ rotation[:, joint]
        reach = np.einsum("tij,cj->tci", turned[:, joint], offsets[children])
        placed[:, children] = placed[:, [joint]] + reach
    return PosedSkeleton(rotation, placed)


def _check_twist(twist: ArrayLike | None, n_frames: int) -> Array:
    shape = (n_frames, N_TURNING - 1)
    if twist is None:
        return np.zeros(shape)
    angle = np.asarray(twist, dtype=np.float64)
    if angle.shape != shape:
        raise ShapeError(f"Twists need shape {shape}, got {angle.shape}.")
    return angle


def fit_rotation(rest: Array, target: Array) -> Array:
    """Return the rotations (T, 3, 3) that best turn points (C, 3) into others (T, C, 3).

    Least squares without translation, by singular values; a mirror image is never returned. Where
    the points lie on one line the smallest rotation is taken. NaN where a point is missing.
    """
    is_known = np.asarray(np.isfinite(target).all(axis=(1, 2)))
    safe = np.where(is_known[:, None, None], target, rest)
    u, spread, vt = np.linalg.svd(np.einsum("tci,cj->tij", safe, rest))
    sign = np.where(np.linalg.det(u) * np.linalg.det(vt) < 0, -1.0, 1.0)
    u[:, :, 2] *= sign[:, None]
    rotation = u @ vt
    is_flat = spread[:, 1] <= _FLAT * spread[:, 0]
    if is_flat.any():
        longest = int(np.argmax(np.linalg.norm(rest, axis=1)))
        rotation[is_flat] = compute_swings(rest[longest], safe[is_flat, longest])
    rotation[~is_known] = np.nan
    return np.asarray(rotation)
