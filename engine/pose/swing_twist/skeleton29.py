"""A plain skeleton of 29 joints: 24 that turn and five ends.

It holds no body model, only names, parents and where the joints are in the rest posture: standing
with the arms straight out to the sides, in the world's axes (X forward, Y up, Z to the right). The
order is that of the published network, so that its joints can be read; the lengths are shares of
the stature, replaced by those of the person as soon as they are seen.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from engine.datatypes import Array, frozen_array
from engine.errors import ConfigError, ShapeError

__all__ = [
    "BRANCHING",
    "CHILDREN",
    "COLLAR_SHARE",
    "JOINTS",
    "N_JOINTS",
    "N_TURNING",
    "ONLY_CHILD",
    "PARENTS",
    "SPINE_SHARES",
    "RestSkeleton",
    "measure_lengths",
    "mirror_order",
]

JOINTS: Final[tuple[str, ...]] = (
    "pelvis",
    "left_hip",
    "right_hip",
    "spine_low",
    "left_knee",
    "right_knee",
    "spine_mid",
    "left_ankle",
    "right_ankle",
    "spine_high",
    "left_foot",
    "right_foot",
    "neck",
    "left_collar",
    "right_collar",
    "head",
    "left_shoulder",
    "right_shoulder",
    "left_elbow",
    "right_elbow",
    "left_wrist",
    "right_wrist",
    "left_hand",
    "right_hand",
    "head_top",
    "left_fingers",
    "right_fingers",
    "left_big_toe",
    "right_big_toe",
)
"""`foot` is the ball of the foot, `hand` the middle of the knuckles, `head` its middle at ear
height, `fingers` the tip of the middle finger."""

N_JOINTS: Final = len(JOINTS)
N_TURNING: Final = 24

PARENTS: Final[tuple[int, ...]] = (
    *(-1, 0, 0, 0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 9, 9, 12, 13, 14, 16, 17, 18, 19, 20, 21),
    *(15, 22, 23, 10, 11),
)
"""Column of the joint that carries each; -1 for the pelvis. Parents come before their children."""

CHILDREN: Final[tuple[tuple[int, ...], ...]] = tuple(
    tuple(child for child, parent in enumerate(PARENTS) if parent == joint)
    for joint in range(N_JOINTS)
)
ONLY_CHILD: Final[dict[int, int]] = {
    joint: children[0] for joint, children in enumerate(CHILDREN) if len(children) == 1
}
"""The bone a joint turns, as the column of its other end."""
BRANCHING: Final[tuple[int, ...]] = tuple(j for j, c in enumerate(CHILDREN) if len(c) > 1)
"""Pelvis and upper spine: what they turn is fixed by three points, so that no twist is left."""

SPINE_SHARES: Final[dict[str, float]] = {
    "spine_low": 0.24,
    "spine_mid": 0.50,
    "spine_high": 0.76,
    "neck": 1.04,
}
"""Where the joints of the spine lie on the line from the pelvis to the middle of the shoulders. No
landmark shows the spine, so it is divided evenly and stays straight between hips and shoulders."""
COLLAR_SHARE: Final = 0.35
"""Where the collar joint lies from the middle of the shoulders to the shoulder."""

# Shares of stature: forward, up, to the right, from the parent. Legs, arms and trunk after Drillis
# and Contini (Winter 2009); head, hands and feet are round numbers. The pelvis is the middle of the
# hips here, as in the keypoints.
_TRUNK, _HALF_SHOULDERS = 0.288, 0.115
_REST_SHARES: Final[dict[str, tuple[float, float, float]]] = {
    "hip": (0.0, 0.0, 0.050),
    "knee": (0.0, -0.245, 0.0),
    "ankle": (0.0, -0.246, 0.0),
    "foot": (0.065, -0.025, 0.0),
    "big_toe": (0.025, -0.005, 0.0),
    "spine_low": (0.0, 0.24 * _TRUNK, 0.0),
    "spine_mid": (0.0, 0.26 * _TRUNK, 0.0),
    "spine_high": (0.0, 0.26 * _TRUNK, 0.0),
    "neck": (0.0, 0.28 * _TRUNK, 0.0),
    "head": (0.0, 0.085, 0.0),
    "head_top": (0.0, 0.077, 0.0),
    "collar": (0.0, 0.24 * _TRUNK, COLLAR_SHARE * _HALF_SHOULDERS),
    "shoulder": (0.0, 0.0, (1.0 - COLLAR_SHARE) * _HALF_SHOULDERS),
    "elbow": (0.0, 0.0, 0.186),
    "wrist": (0.0, 0.0, 0.146),
    "hand": (0.0, 0.0, 0.055),
    "fingers": (0.0, 0.0, 0.050),
}
ADULT_STATURE_M: Final = (0.5, 2.6)


def _split(name: str) -> tuple[str, float]:
    """Return the part a joint is, and which way its offset to the right counts."""
    side, _, part = name.partition("_")
    return (part, -1.0 if side == "left" else 1.0) if side in ("left", "right") else (name, 1.0)


def mirror_order() -> NDArray[np.intp]:
    """Return the order of the joints that exchanges left and right, shape (29,)."""
    swap = {"left": "right", "right": "left"}
    names = []
    for name in JOINTS:
        side, _, part = name.partition("_")
        names.append(f"{swap[side]}_{part}" if side in swap else name)
    return np.array([JOINTS.index(name) for name in names])


@dataclass(frozen=True, eq=False)
class RestSkeleton:
    """Where the joints are before anything turns.

    Parameters
    ----------
    position
        Shape (29, 3), m, pelvis at the origin, in the order of `JOINTS`.

    Raises
    ------
    ShapeError
        If the shape differs, or a joint lies on its parent.
    """

    position: Array

    def __post_init__(self) -> None:
        position = np.asarray(self.position, dtype=np.float64)
        if position.shape != (N_JOINTS, 3):
            raise ShapeError(f"A rest skeleton needs shape (29, 3), got {position.shape}.")
        object.__setattr__(self, "position", frozen_array(position - position[0]))
        short = self.lengths[1:] < 1e-6
        if short.any() or not np.isfinite(position).all():
            name = JOINTS[1 + int(np.argmax(short))]
            raise ShapeError(
                f"Every bone of a rest skeleton needs a length; {name!r} lies on its parent or "
                "is missing."
            )

    @classmethod
    def from_stature(cls, stature_m: float) -> RestSkeleton:
        """Make the skeleton of an adult of this stature, m.

        Raises
        ------
        ConfigError
            If the stature is not that of a person in metres.
        """
        if not ADULT_STATURE_M[0] <= stature_m <= ADULT_STATURE_M[1]:
            raise ConfigError(
                f"The stature of a skeleton must lie between {ADULT_STATURE_M[0]} and "
                f"{ADULT_STATURE_M[1]} m, got {stature_m:g}."
            )
        position = np.zeros((N_JOINTS, 3))
        for joint, parent in enumerate(PARENTS[1:], start=1):
            part, side = _split(JOINTS[joint])
            offset = np.array(_REST_SHARES[part]) * (1.0, 1.0, side)
            position[joint] = position[parent] + stature_m * offset
        return cls(position)

    @property
    def offsets(self) -> Array:
        """From its parent to each joint, shape (29, 3), m; zero for the pelvis."""
        offsets = self.position - self.position[list(PARENTS)]
        offsets[0] = 0.0
        return offsets

    @property
    def lengths(self) -> Array:
        """Shape (29,), m: distance of each joint from its parent; zero for the pelvis."""
        return np.asarray(np.linalg.norm(self.offsets, axis=1))

    def with_lengths(self, lengths: ArrayLike) -> RestSkeleton:
        """Return the same posture with other bones.

        Parameters
        ----------
        lengths
            Shape (29,), m; where one is not positive and finite the bone stays as it is.
        """
        wanted = np.asarray(lengths, dtype=np.float64)
        if wanted.shape != (N_JOINTS,):
            raise ShapeError(f"Bone lengths need shape (29,), got {wanted.shape}.")
        usable = np.isfinite(wanted) & (wanted > 0)
        factor = np.where(usable, wanted / np.where(self.lengths > 0, self.lengths, 1.0), 1.0)
        position = np.zeros((N_JOINTS, 3))
        for joint, parent in enumerate(PARENTS[1:], start=1):
            position[joint] = position[parent] + factor[joint] * self.offsets[joint]
        return RestSkeleton(position)


def measure_lengths(joints: Array) -> Array:
    """Return the usual length of every bone, left and right alike.

    Parameters
    ----------
    joints
        Shape (T, 29, 3), m; NaN where missing.

    Returns
    -------
    Array
        Shape (29,), m: medians over the frames; NaN where a bone was never seen.
    """
    span = np.linalg.norm(joints - joints[:, list(PARENTS)], axis=2)
    both = np.concatenate([span, span[:, mirror_order()]])
    lengths = np.full(N_JOINTS, np.nan)
    for joint in range(1, N_JOINTS):
        seen = both[np.isfinite(both[:, joint]), joint]
        if seen.size:
            lengths[joint] = np.median(seen)
    lengths[0] = 0.0
    return lengths
