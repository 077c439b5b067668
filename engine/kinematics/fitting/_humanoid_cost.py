"""The cost of the humanoid fit along one variable at a time.

One angle turns everything beyond its joint about one axis: the squared distance of a joint to
its target is then ``c0 + c1 cos(d) + c2 sin(d)`` in the change ``d`` of the angle (and quadratic in
the size factor). With the three numbers of each joint at hand, a value of the cost takes twelve
square roots instead of the whole chain, whichever variable it is.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from engine.datatypes import Array
from engine.kinematics.fitting._dynamic_encoding import Line, Rows
from engine.kinematics.humanoid import FITTED_JOINTS, VARIABLES, SegmentLengths, compute_joints

__all__ = ["HumanoidCost"]

_JOINTS = (
    "left_hip",
    "right_hip",
    "left_knee",
    "left_ankle",
    "right_knee",
    "right_ankle",
    "left_shoulder",
    "right_shoulder",
    "left_elbow",
    "left_wrist",
    "right_elbow",
    "right_wrist",
)
"""The twelve joints so ordered that what one angle moves stands together."""
_COLUMNS = [FITTED_JOINTS.index(name) for name in _JOINTS]

_FORWARD, _LEFT, _UP = np.eye(3)
_ALL_JOINTS, _UPPER_BODY = slice(0, 12), slice(6, 12)
_N_AXES = 20


@dataclass(frozen=True)
class _Hinge:
    """One angle: its axis in the neutral pose, where it passes, and what it moves.

    `origin` is a row of `_JOINTS`, None for the middle of the pelvis; `joints` and `axes` are what
    lies beyond, the latter rows of the list of all hinges.
    """

    name: str
    axis: Array
    origin: int | None
    joints: slice
    axes: slice


def _leg(side: str, place: int, hip: int, knee: int) -> tuple[_Hinge, ...]:
    """Return the hinges of one leg; `place` is that of the first in the list of all hinges."""
    outward = 1.0 if side == "l" else -1.0
    beyond = slice(knee, knee + 2)
    ankle, end = slice(knee + 1, knee + 2), place + 3
    return (
        _Hinge(f"theta_hp_{side}", -_LEFT, hip, beyond, slice(place + 1, end)),
        _Hinge(f"phi_hp_{side}", outward * _FORWARD, hip, beyond, slice(place + 2, end)),
        _Hinge(f"theta_kn_{side}", _LEFT, knee, ankle, slice(end, end)),
    )


def _arm(side: str, place: int, shoulder: int, elbow: int) -> tuple[_Hinge, ...]:
    outward = 1.0 if side == "l" else -1.0
    beyond = slice(elbow, elbow + 2)
    wrist, end = slice(elbow + 1, elbow + 2), place + 4
    return (
        _Hinge(f"theta_sh_{side}", -_LEFT, shoulder, beyond, slice(place + 1, end)),
        _Hinge(f"phi_sh_{side}", outward * _FORWARD, shoulder, beyond, slice(place + 2, end)),
        _Hinge(f"psi_sh_{side}", -outward * _UP, shoulder, beyond, slice(place + 3, end)),
        _Hinge(f"theta_el_{side}", -_LEFT, elbow, wrist, slice(end, end)),
    )


_HINGES: tuple[_Hinge, ...] = (
    _Hinge("psi_bd", _UP, None, _ALL_JOINTS, slice(1, _N_AXES)),
    _Hinge("theta_bd", _LEFT, None, _ALL_JOINTS, slice(2, _N_AXES)),
    _Hinge("phi_bd", _FORWARD, None, _ALL_JOINTS, slice(3, _N_AXES)),
    *_leg("l", 3, hip=0, knee=2),
    *_leg("r", 6, hip=1, knee=4),
    _Hinge("theta_ws", _LEFT, None, _UPPER_BODY, slice(10, _N_AXES)),
    _Hinge("phi_ws", _FORWARD, None, _UPPER_BODY, slice(11, _N_AXES)),
    _Hinge("psi_ws", _UP, None, _UPPER_BODY, slice(12, _N_AXES)),
    *_arm("l", 12, shoulder=6, elbow=8),
    *_arm("r", 16, shoulder=7, elbow=10),
)
"""Every angle, each after those that carry it."""
_HINGE_OF = {hinge.name: place for place, hinge in enumerate(_HINGES)}
_PLACES = tuple(_HINGE_OF.get(variable.name) for variable in VARIABLES)
"""For every variable its place among the hinges; None for the size factor."""
_SIZE = _PLACES.index(None)
_FROM_THE_ROOT = sorted(range(len(VARIABLES)), key=lambda v: _HINGE_OF.get(VARIABLES[v].name, -1))


class HumanoidCost:
    """Eq 8 of many searches at once: the mean distance of the twelve joints to their targets.

    Parameters
    ----------
    targets
        Shape (T, 12, 3): the joints to fit, centred on the pelvis, in the figure's axes, m.
        NaN where missing: such a joint counts nothing.
    weights
        Shape (T, 12), not negative; None weighs every joint alike.
    lengths
        Of the figure's segments: of one person, or of the person in each frame.
    frames
        Shape (B,): the frame every search belongs to.
    huber_m
        Distances below it count by their square; 0 is the plain mean distance.
    """

    look_ahead = 64

    def __init__(
        self,
        targets: Array,
        lengths: SegmentLengths | Sequence[SegmentLengths],
        frames: NDArray[np.intp],
        *,
        weights: Array | None = None,
        huber_m: float = 0.0,
    ) -> None:
        present = np.asarray(np.isfinite(targets).all(axis=2))
        weight = np.where(present, 1.0 if weights is None else weights, 0.0)
        total = weight.sum(axis=1, keepdims=True)
        weight = weight / np.where(total > 0, total, 1.0)
        known = np.where(present[..., None], targets, 0.0)
        self._target = np.ascontiguousarray(known[frames][:, _COLUMNS].transpose(1, 2, 0))
        self._weight = np.ascontiguousarray(weight[frames][:, _COLUMNS].T)
        self._huber_m = huber_m
        neutral = np.zeros(len(VARIABLES))
        neutral[_SIZE] = 1.0
        if isinstance(lengths, SegmentLengths):
            self._neutral = compute_joints(neutral, lengths)[_COLUMNS, :, None]
        else:
            each = np.stack([compute_joints(neutral, person) for person in lengths])
            self._neutral = each[frames][:, _COLUMNS].transpose(1, 2, 0)
        self._values = np.empty((len(VARIABLES), 0))
        self._joints = self._axes = np.empty((0, 3, 0))
        self._share = np.empty((0, 0))

    def place(self, values: Array) -> None:
        """Put every search at its point, shape (B, 21)."""
        n_searches = len(values)
        axes = np.stack([hinge.axis for hinge in _HINGES])
        self._joints = np.array(np.broadcast_to(self._neutral, (12, 3, n_searches)), order="C")
        self._axes = np.repeat(axes[..., None], n_searches, axis=2)
        self._values = np.zeros((len(VARIABLES), n_searches))
        self._values[_SIZE] = 1.0
        self._share = np.zeros(self._joints.shape[::2])
        for variable in _FROM_THE_ROOT:
            self.move(variable, slice(None), values[:, variable])

    def aim(self, variable: int, rows: Rows | slice) -> Line:
        """Return the cost of the searches `rows` as a function of one variable."""
        place, now = _PLACES[variable], self._values[variable, rows]
        moved = _ALL_JOINTS if place is None else _HINGES[place].joints
        joints, target = self._joints[moved][..., rows], self._target[moved][..., rows]
        weight, share = self._weight[moved][..., rows], self._share[..., rows]
        unmoved = share[: moved.start].sum(axis=0) + share[moved.stop :].sum(axis=0)
        if place is None:
            terms = (_dot(target, target), _dot(joints, joints), -2 * _dot(joints, target))
        else:
            origin = self._origin(place, rows)
            terms = _turning_terms(self._axes[place][:, rows], joints - origin, target - origin)

        def line(x: Array, members: Rows | slice) -> Array:
            if place is None:
                second = x / now[members]
                first = second**2
            else:
                change = x - now[members]
                first, second = np.cos(change), np.sin(change)
            fixed, along, across = (term[:, members] for term in terms)
            squared = fixed + along * first[..., None, :] + across * second[..., None, :]
            moving = self._penalise(squared) * weight[:, members]
            return np.asarray(moving.sum(axis=-2) + unmoved[members])

        return line

    def move(self, variable: int, rows: Rows | slice, values: Array) -> None:
        """Set one variable of the searches `rows` to `values`, shape (b,)."""
        place, now = _PLACES[variable], self._values[variable, rows]
        moved = _ALL_JOINTS if place is None else _HINGES[place].joints
        joints = self._joints[moved][..., rows]
        if place is None:
            joints = joints * (values / now)
        else:
            turn = _rotation(self._axes[place][:, rows], values - now)
            origin = self._origin(place, rows)
            joints = _apply(turn, joints - origin) + origin
            beyond = _HINGES[place].axes
            self._axes[beyond][..., rows] = _apply(turn, self._axes[beyond][..., rows])
        self._joints[moved][..., rows] = joints
        self._values[variable, rows] = values
        offset = joints - self._target[moved][..., rows]
        weight = self._weight[moved][..., rows]
        self._share[moved][..., rows] = self._penalise(_dot(offset, offset)) * weight

    def total(self) -> Array:
        """Return the cost of every search where it is, shape (B,)."""
        return np.asarray(self._share.sum(axis=0))

    def _origin(self, place: int, rows: Rows | slice) -> Array | float:
        origin = _HINGES[place].origin
        return 0.0 if origin is None else self._joints[origin][:, rows]

    def _penalise(self, squared: Array) -> Array:
        distance = np.sqrt(np.maximum(squared, 0.0))
        if self._huber_m <= 0:
            return np.asarray(distance)
        inside = squared / (2 * self._huber_m)
        outside = distance - self._huber_m / 2
        return np.where(distance < self._huber_m, inside, outside)


def _dot(a: Array, b: Array) -> Array:
    """Multiply vectors of shape (..., 3, b)."""
    return np.asarray(
        a[..., 0, :] * b[..., 0, :] + a[..., 1, :] * b[..., 1, :] + a[..., 2, :] * b[..., 2, :]
    )


def _cross(a: Array, b: Array) -> Array:
    result = np.empty(np.broadcast_shapes(a.shape, b.shape))
    for i, (j, k) in enumerate(((1, 2), (2, 0), (0, 1))):
        result[..., i, :] = a[..., j, :] * b[..., k, :] - a[..., k, :] * b[..., j, :]
    return result


def _turning_terms(axis: Array, arm: Array, goal: Array) -> tuple[Array, Array, Array]:
    """Return c0, c1, c2 of the squared distance between `arm`, turned about `axis`, and `goal`.

    Shapes (3, b), (J, 3, b), (J, 3, b); each result (J, b).
    """
    along = _dot(axis, arm) * _dot(axis, goal)
    fixed = _dot(arm, arm) + _dot(goal, goal) - 2 * along
    return fixed, -2 * (_dot(arm, goal) - along), -2 * _dot(axis, _cross(arm, goal))


def _rotation(axis: Array, angle: Array) -> Array:
    """Return rotation matrices of shape (3, 3, b) about unit vectors (3, b), by Rodrigues."""
    c, s = np.cos(angle), np.sin(angle)
    part, turn = (1.0 - c) * axis, s * axis
    matrix = part[:, None] * axis
    for i, (j, k) in enumerate(((1, 2), (2, 0), (0, 1))):
        matrix[i, i] += c
        matrix[j, k] -= turn[i]
        matrix[k, j] += turn[i]
    return matrix


def _apply(turn: Array, vectors: Array) -> Array:
    """Turn vectors of shape (J, 3, b) by matrices (3, 3, b)."""
    return np.asarray(
        turn[:, 0] * vectors[:, None, 0]
        + turn[:, 1] * vectors[:, None, 1]
        + turn[:, 2] * vectors[:, None, 2]
    )
