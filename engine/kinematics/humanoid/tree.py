"""The whole figure as a tree of joint axes: positions and exact derivatives.

A point below a joint moves, for a small turn about the joint's axis, at right angles to the axis
and to the line from the joint to the point. So the derivative of any position needs only the
axes and origins of the joints above it, and lengths enter linearly. Arrays keep frames last,
which makes every step one pass over contiguous numbers.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from engine.datatypes import Array
from engine.errors import ConfigError, ShapeError
from engine.kinematics.humanoid.lengths import SegmentLengths
from engine.kinematics.humanoid.model import (
    ANGLE_COUNT,
    FITTED_JOINTS,
    VARIABLES,
    column,
)
from engine.kinematics.humanoid.rotation import compute_rotation, compute_slope

__all__ = ["POINTS", "Posture", "Tree", "compute_jacobian"]


Terms = tuple[tuple[int, float, str], ...]
"""Lengths along a joint's axes: (axis, factor, name of the length)."""


@dataclass(frozen=True)
class _Joint:
    """A joint: where it sits in its parent's axes, and the turns made there, in order.

    Turns are (variable, axis, factor): a turn by factor times the variable about the axis as the
    turns before it have left it.
    """

    name: str
    parent: str
    place: Terms
    turns: Terms


def _ball(letter: str, part: str, side: float) -> Terms:
    """Return the turns of a hip or shoulder: flexion, abduction, turn inwards."""
    name = f"{part}_{letter}"
    return ((1, -1.0, f"theta_{name}"), (0, side, f"phi_{name}"), (2, -side, f"psi_{name}"))


def _side_joints(letter: str, side: float) -> Iterator[_Joint]:
    hip, knee, shoulder = f"hip_{letter}", f"knee_{letter}", f"shoulder_{letter}"
    at_hip: Terms = ((1, side, "pelvis_half_width"),)
    at_shoulder: Terms = ((2, 1.0, "trunk"), (1, side, "shoulder_half_width"))
    foot: Terms = ((2, -side, f"psi_an_{letter}"), (1, -1.0, f"theta_an_{letter}"))
    yield _Joint(hip, "pelvis", at_hip, _ball(letter, "hp", side))
    yield _Joint(knee, hip, ((2, -1.0, "thigh"),), ((1, 1.0, f"theta_kn_{letter}"),))
    yield _Joint(f"ankle_{letter}", knee, ((2, -1.0, "shank"),), foot)
    yield _Joint(shoulder, "waist", at_shoulder, _ball(letter, "sh", side))
    bend: Terms = ((1, -1.0, f"theta_el_{letter}"),)
    yield _Joint(f"elbow_{letter}", shoulder, ((2, -1.0, "upper_arm"),), bend)


_JOINTS: tuple[_Joint, ...] = (
    _Joint("pelvis", "", (), ((2, 1.0, "psi_bd"), (1, 1.0, "theta_bd"), (0, 1.0, "phi_bd"))),
    _Joint("waist", "pelvis", (), ((1, 1.0, "theta_ws"), (0, 1.0, "phi_ws"), (2, 1.0, "psi_ws"))),
    # A back that bends as an arc: seen from the pelvis, its middle has turned half as far as its
    # upper end. Its place is the one landmark that tells the bend of the waist from the pelvis.
    _Joint("mid_back", "pelvis", (), ((1, 0.5, "theta_ws"), (0, 0.5, "phi_ws"))),
    _Joint(
        "neck",
        "waist",
        ((2, 1.0, "trunk"),),
        ((1, 1.0, "theta_nk"), (0, 1.0, "phi_nk"), (2, 1.0, "psi_nk")),
    ),
    *_side_joints("l", 1.0),
    *_side_joints("r", -1.0),
)
_JOINT_OF = {joint.name: joint for joint in _JOINTS}


def _side_points(name: str, letter: str, side: float) -> dict[str, tuple[str, Terms]]:
    shoulder: Terms = ((2, 1.0, "trunk"), (1, side, "shoulder_half_width"))
    heel: Terms = ((0, -1.0, "heel_back"), (2, -1.0, "heel_down"))
    toe: Terms = ((0, 1.0, "toe_forward"), (2, -1.0, "toe_down"))
    return {
        f"{name}_hip": ("pelvis", ((1, side, "pelvis_half_width"),)),
        f"{name}_knee": (f"hip_{letter}", ((2, -1.0, "thigh"),)),
        f"{name}_ankle": (f"knee_{letter}", ((2, -1.0, "shank"),)),
        f"{name}_heel": (f"ankle_{letter}", heel),
        f"{name}_big_toe": (f"ankle_{letter}", toe),
        f"{name}_shoulder": ("waist", shoulder),
        f"{name}_elbow": (f"shoulder_{letter}", ((2, -1.0, "upper_arm"),)),
        f"{name}_wrist": (f"elbow_{letter}", ((2, -1.0, "forearm"),)),
        f"{name}_ear": ("neck", ((2, 1.0, "neck"), (1, side, "ear_half_width"))),
    }


POINTS: Mapping[str, tuple[str, Terms]] = {
    **_side_points("left", "l", 1.0),
    **_side_points("right", "r", -1.0),
    "nose": ("neck", ((2, 1.0, "neck"), (2, 1.0, "nose_up"), (0, 1.0, "nose_forward"))),
    "spine": ("mid_back", ((2, 1.0, "spine"),)),
}
"""The keypoints the figure has: the joint they turn with, and their place in its axes."""


@dataclass(frozen=True, eq=False)
class Posture:
    """The figure in every frame, around the mid-hip, in metres and the figure's axes.

    `points` has shape (P, 3, T). `axes` and `origins`, shape (N, 3, T), belong to the tree's N
    turns; `frames` holds the axes of every joint, shape (3, 3, T), one axis a row.
    """

    points: Array
    axes: Array
    origins: Array
    frames: Mapping[str, Array]


class Tree:
    """The joints that carry a set of points, and the derivatives of those points.

    Parameters
    ----------
    points
        Names from `POINTS`.
    by_vector
        Joints whose three turns are the components of one rotation vector along the joint's axes
        (same signs, same values for small angles), instead of one turn after the other.
    """

    def __init__(self, points: Sequence[str], by_vector: Sequence[str] = ()) -> None:
        self.by_vector = tuple(by_vector)
        unknown = [name for name in points if name not in POINTS]
        if unknown:
            raise ConfigError(f"The figure has no {', '.join(unknown)}; known: {tuple(POINTS)}.")
        self.points = tuple(points)
        needed = {name for point in points for name in _ancestors(POINTS[point][0])}
        self.joints = tuple(joint for joint in _JOINTS if joint.name in needed)
        turns = [(j.name, turn) for j in self.joints for turn in j.turns]
        self._turn_variable = np.array([column(turn[2]) for _, turn in turns], dtype=np.intp)
        self._turn_factor = np.array([turn[1] for _, turn in turns])
        # Every (point, turn above it): one entry of the matrix of derivatives.
        pairs = [
            (p, n)
            for p, point in enumerate(self.points)
            for n, (joint, _) in enumerate(turns)
            if joint in _ancestors(POINTS[point][0])
        ]
        self._pair_point, self._pair_turn = np.array(pairs, dtype=np.intp).T

    @property
    def variables(self) -> tuple[int, ...]:
        """Places, in a full pose vector, of the angles that can move these points."""
        return tuple(sorted(set(self._turn_variable.tolist())))

    def place(self, angles: Array, lengths: Mapping[str, float]) -> Posture:
        """Compute the figure.

        Parameters
        ----------
        angles
            Shape (29, T), radians: full pose vectors, one a column.
        lengths
            Segment lengths in metres, by name.
        """
        n_frames = angles.shape[1]
        sine = np.sin(self._turn_factor[:, None] * angles[self._turn_variable])
        cosine = np.cos(self._turn_factor[:, None] * angles[self._turn_variable])
        axes = np.empty((len(self._turn_variable), 3, n_frames))
        origins = np.empty_like(axes)
        origin_of = {"": np.zeros((3, n_frames))}
        ground = np.broadcast_to(np.eye(3)[..., None], (3, 3, n_frames))
        frames: dict[str, Array] = {"": ground}
        turn = 0
        for joint in self.joints:
            frame = np.array(frames[joint.parent])
            origin = _go(origin_of[joint.parent], frame, joint.place, lengths)
            last = turn + len(joint.turns)
            origins[turn:last] = origin
            if joint.name in self.by_vector:
                # The whole turn at once: the axes are not those of single turns any more.
                vector = self._vector(joint, angles)
                axes[turn:last] = self._vector_axes(joint, frame, vector)
                frame = np.einsum("ikt,ict->kct", compute_rotation(vector), frame)
            else:
                for i, (axis, _, _) in enumerate(joint.turns, start=turn):
                    axes[i] = frame[axis]
                    _rotate(frame, axis, sine[i], cosine[i])
            turn = last
            frames[joint.name], origin_of[joint.name] = frame, origin
        points = np.empty((len(self.points), 3, n_frames))
        for i, name in enumerate(self.points):
            joint_name, place = POINTS[name]
            points[i] = _go(origin_of[joint_name], frames[joint_name], place, lengths)
        axes *= self._turn_factor[:, None, None]
        return Posture(points, axes, origins, frames)

    @staticmethod
    def _vector(joint: _Joint, angles: Array) -> Array:
        vector = np.empty((3, angles.shape[1]))
        for axis, factor, name in joint.turns:
            vector[axis] = factor * angles[column(name)]
        return vector

    @staticmethod
    def _vector_axes(joint: _Joint, frame: Array, vector: Array) -> Array:
        slope = compute_slope(vector)[:, [axis for axis, _, _ in joint.turns]]
        return np.asarray(np.einsum("ikt,ict->kct", slope, frame))

    def differentiate(
        self, posture: Posture, variables: Sequence[int] = tuple(range(ANGLE_COUNT))
    ) -> Array:
        """Compute the derivatives of the points by the angles at these places of a pose vector.

        Returns
        -------
        Array
            Shape (P, 3, len(variables), T), metres per radian.
        """
        place = np.full(ANGLE_COUNT, -1)
        place[list(variables)] = np.arange(len(variables))
        column_of = place[self._turn_variable[self._pair_turn]]
        is_wanted = column_of >= 0
        point, turn, to = (
            index[is_wanted] for index in (self._pair_point, self._pair_turn, column_of)
        )
        axis = posture.axes[turn]
        arm = posture.points[point] - posture.origins[turn]
        jacobian = np.zeros((len(self.points), 3, len(variables), posture.points.shape[2]))
        for i, (j, k) in enumerate(((1, 2), (2, 0), (0, 1))):
            # A point has every variable at most once among its ancestors: nothing is added up.
            jacobian[point, i, to] = axis[:, j] * arm[:, k] - axis[:, k] * arm[:, j]
        return jacobian

    def differentiate_lengths(self, posture: Posture, names: Sequence[str]) -> Array:
        """Compute the derivatives of the points by the named lengths; shape (P, 3, L, T)."""
        result = np.zeros((len(self.points), 3, len(names), posture.points.shape[2]))
        for i, point in enumerate(self.points):
            joint_name, place = POINTS[point]
            self._add_terms(result[i], posture.frames[joint_name], place, names)
            for name in _ancestors(joint_name):
                joint = _JOINT_OF[name]
                self._add_terms(result[i], posture.frames[joint.parent], joint.place, names)
        return result

    @staticmethod
    def _add_terms(target: Array, frame: Array, terms: Terms, names: Sequence[str]) -> None:
        for axis, factor, name in terms:
            if name in names:
                target[:, names.index(name)] += factor * frame[axis]


def _ancestors(joint: str) -> tuple[str, ...]:
    """Return a joint and all above it."""
    return (joint, *_ancestors(_JOINT_OF[joint].parent)) if joint else ()


def _go(origin: Array, frame: Array, terms: Terms, lengths: Mapping[str, float]) -> Array:
    """Return the point that lies `terms` away from `origin` along the axes of `frame`."""
    point = origin
    for axis, factor, name in terms:
        point = point + (factor * lengths[name]) * frame[axis]
    return point


def _rotate(frame: Array, axis: int, sine: Array, cosine: Array) -> None:
    """Turn the axes of a frame, shape (3, 3, T), about one of them, in place."""
    i, j = (axis + 1) % 3, (axis + 2) % 3
    first = cosine * frame[i] + sine * frame[j]
    frame[j] = cosine * frame[j] - sine * frame[i]
    frame[i] = first


_PAPER_TREE = Tree(FITTED_JOINTS)


def compute_jacobian(values: ArrayLike, lengths: SegmentLengths) -> Array:
    """Compute the exact derivatives of the twelve joints by the 21 variables.

    Parameters
    ----------
    values
        Shape (..., 21): the size factor, then radians, in the order of `VARIABLES`.
    lengths
        Segment lengths, metres.

    Returns
    -------
    Array
        Shape (..., 36, 21), metres per radian (metres per one for the size factor); rows are
        the X, Y and Z of each joint in the order of `FITTED_JOINTS`.

    Raises
    ------
    ShapeError
        If the last dimension is not 21.
    """
    given = np.asarray(values, dtype=np.float64)
    if given.ndim == 0 or given.shape[-1] != len(VARIABLES):
        raise ShapeError(f"Values need shape (..., {len(VARIABLES)}), got {given.shape}.")
    flat = given.reshape(-1, len(VARIABLES)).T
    angles = np.zeros((ANGLE_COUNT, flat.shape[1]))
    angles[: len(VARIABLES) - 1] = flat[1:]
    posture = _PAPER_TREE.place(angles, lengths.as_dict())
    by_angle = _PAPER_TREE.differentiate(posture, range(len(VARIABLES) - 1)) * flat[0]
    jacobian = np.concatenate([posture.points[:, :, None], by_angle], axis=2)
    rows = jacobian.reshape(-1, len(VARIABLES), flat.shape[1])
    return np.moveaxis(rows, -1, 0).reshape(*given.shape[:-1], -1, len(VARIABLES))
