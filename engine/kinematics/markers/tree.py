"""The kinematic tree as arrays: where every body is, and how it moves with every coordinate.

Everything works on all frames at once. Motion is written as spatial vectors about the world's
origin, (angular velocity, velocity of the point at the origin), so that the velocity of a point p
is ``v + w x p`` whatever body it is on [1]_.

References
----------
.. [1] Featherstone (2008), Rigid Body Dynamics Algorithms, ch. 2 and 6.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from engine.datatypes import Array
from engine.errors import DataError
from engine.kinematics.markers.functions import scaled
from engine.kinematics.markers.osim import GROUND, Axis, Joint, OsimModel

__all__ = ["BodyPoses", "KinematicTree", "scale_model"]


@dataclass(frozen=True, eq=False)
class BodyPoses:
    """Every body in every frame; frames come last, which keeps each step on unbroken memory.

    `rotation` (B, 3, 3, T) and `origin` (B, 3, T) in the world; `motion` (Q, 6, T) the spatial
    velocity of what hangs on a coordinate per unit of it.
    """

    rotation: Array
    origin: Array
    motion: Array

    def place(self, body: NDArray[np.intp], local: Array) -> Array:
        """Return points fixed in bodies in the world, shape (3, M, T).

        `body` (M,) are columns of bodies, `local` (M, 3) the points in them.
        """
        points = np.empty((3, body.size, self.origin.shape[2]))
        for one in np.unique(body):
            on_it = np.flatnonzero(body == one)
            points[:, on_it] = local[on_it] @ self.rotation[one] + self.origin[one][:, None]
        return points

    def take(self, frames: NDArray[np.bool_]) -> BodyPoses:
        """Return some frames."""
        return BodyPoses(
            self.rotation[..., frames], self.origin[..., frames], self.motion[..., frames]
        )


@dataclass(frozen=True, eq=False)
class KinematicTree:
    """A model ready for computing."""

    model: OsimModel

    @property
    def coordinate_names(self) -> tuple[str, ...]:
        """The Q coordinates, in the order of every array here."""
        return tuple(c.name for c in self.model.coordinates)

    @cached_property
    def column(self) -> Mapping[str, int]:
        """Coordinate name to column."""
        return {name: i for i, name in enumerate(self.coordinate_names)}

    @cached_property
    def body_column(self) -> Mapping[str, int]:
        """Body name to column; bodies come after their parents."""
        return {name: i for i, name in enumerate(self.model.bodies)}

    @cached_property
    def is_translation(self) -> NDArray[np.bool_]:
        """Shape (Q,): whether a coordinate is a length and not an angle."""
        slides = {a.coordinate for j in self.model.joints for a in j.translations}
        turns = {a.coordinate for j in self.model.joints for a in j.rotations}
        return np.array([n in slides and n not in turns for n in self.coordinate_names])

    @cached_property
    def parents(self) -> tuple[int, ...]:
        """Column of every body's parent; -1 for the ground."""
        return tuple(self.body_column.get(j.parent, -1) for j in self.model.joints)

    @cached_property
    def body_of_coordinate(self) -> NDArray[np.intp]:
        """Shape (Q,): the body that each coordinate moves first."""
        found = np.full(len(self.coordinate_names), -1)
        for body, joint in enumerate(self.model.joints):
            for axis in (*joint.rotations, *joint.translations):
                if axis.coordinate:
                    column = self._column_of(axis.coordinate)
                    if found[column] not in (-1, body):
                        raise DataError(
                            f"The coordinate {axis.coordinate} moves two joints, which is not "
                            "supported."
                        )
                    found[column] = body
        return found

    @cached_property
    def is_below(self) -> NDArray[np.bool_]:
        """Shape (B, B): whether body j is body i or hangs on it."""
        n = len(self.parents)
        below = np.eye(n, dtype=bool)
        for body, parent in enumerate(self.parents):
            if parent >= 0:
                below[:, body] |= below[:, parent]
        return below

    def _column_of(self, coordinate: str) -> int:
        self.model.coordinate(coordinate)
        return self.column[coordinate]

    def default_coordinates(self) -> Array:
        """Shape (Q,), radians and metres."""
        return np.array([c.default for c in self.model.coordinates])

    def pose(self, coordinates: Array, *, bodies: NDArray[np.intp] | None = None) -> BodyPoses:
        """Place every body.

        Parameters
        ----------
        coordinates
            Shape (T, Q), radians and metres.
        bodies
            Those needed; others that none of them hangs on are left at zero. All by default.
        """
        n_frames, n_bodies = len(coordinates), len(self.parents)
        rotation = np.zeros((n_bodies, 3, 3, n_frames))
        origin = np.zeros((n_bodies, 3, n_frames))
        motion = np.zeros((len(self.coordinate_names), 6, n_frames))
        leading = np.arange(n_bodies) if bodies is None else bodies
        wanted = np.flatnonzero(self.is_below[:, leading].any(axis=1)).tolist()
        ground = np.broadcast_to(np.eye(3)[..., None], (3, 3, n_frames)), np.zeros((3, n_frames))
        curves = np.ascontiguousarray(coordinates.T)
        for body in wanted:
            parent = self.parents[body]
            above = ground if parent < 0 else (rotation[parent], origin[parent])
            rotation[body], origin[body] = self._move(
                self.model.joints[body], curves, above, motion
            )
        return BodyPoses(rotation, origin, motion)

    def _move(
        self, joint: Joint, curves: Array, above: tuple[Array, Array], motion: Array
    ) -> tuple[Array, Array]:
        """Return rotation (3, 3, T) and origin (3, T) of a joint's child; adds to `motion`."""
        turn = _turned(above[0], joint.parent_rotation)
        centre = above[1] + joint.parent_translation @ above[0]
        frame = turn
        for axis in joint.translations:
            value, slope, column = self._evaluate(axis, curves)
            if column is None and not value.any():
                continue
            direction = axis.axis @ frame
            centre = centre + value * direction
            if column is not None:
                motion[column, 3:] += slope * direction
        for axis in joint.rotations:
            value, slope, column = self._evaluate(axis, curves)
            if column is not None:
                spin = slope * (axis.axis @ turn)
                motion[column, :3] += spin
                motion[column, 3:] += cross(centre, spin)
            elif not value.any():
                continue
            turn = _turned_about(turn, axis.axis, value)
        rotation = _turned(turn, joint.child_rotation.T)
        return rotation, centre - joint.child_translation @ rotation

    def _evaluate(self, axis: Axis, curves: Array) -> tuple[Array, Array, int | None]:
        if not axis.coordinate:
            value, slope = axis.function(np.zeros(1))
            return value, slope, None
        column = self.column[axis.coordinate]
        return *axis.function(curves[column]), column


def cross(a: Array, b: Array) -> Array:
    """Return cross products along the first axis; quicker than numpy's for small arrays."""
    return np.stack(
        [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]
    )


def _turned(turn: Array, by: Array) -> Array:
    """Return ``turn @ by`` for turn (3, 3, T) and a fixed rotation (3, 3)."""
    return turn if np.array_equal(by, np.eye(3)) else by.T @ turn


def _turned_about(turn: Array, axis: Array, angle: Array) -> Array:
    """Return rotations (3, 3, T) followed by those about a fixed unit axis in their own frame."""
    sine, cosine = np.sin(angle), np.cos(angle)
    main = int(np.argmax(np.abs(axis)))
    if abs(axis[main]) == 1.0:
        one, two = (main + 1) % 3, (main + 2) % 3
        sine = sine * axis[main]
        turned = np.empty_like(turn)
        turned[:, main] = turn[:, main]
        turned[:, one] = cosine * turn[:, one] + sine * turn[:, two]
        turned[:, two] = cosine * turn[:, two] - sine * turn[:, one]
        return turned
    skew = np.cross(axis, np.eye(3)).T
    rotation: Array = turn + sine * (skew.T @ turn) + (1.0 - cosine) * ((skew @ skew).T @ turn)
    return rotation


def scale_model(model: OsimModel, factors: Mapping[str, float]) -> OsimModel:
    """Return a model whose bodies are larger or smaller, alike in all directions.

    Joint frames and markers of a body move with its factor, as do the translations of joints with
    that of the parent body: what OpenSim's `ScaleTool` does.

    Parameters
    ----------
    model
        To be scaled.
    factors
        Body name to factor; 1 where absent.
    """

    def grow(axis: Axis, factor: float) -> Axis:
        return replace(axis, function=scaled(axis.function, factor))

    joints = []
    for joint in model.joints:
        above = factors.get(joint.parent, 1.0)
        # The ground is never scaled, so the translations of the root stay metres.
        slides = 1.0 if joint.parent == GROUND else above
        joints.append(
            replace(
                joint,
                parent_translation=above * joint.parent_translation,
                child_translation=factors.get(joint.child, 1.0) * joint.child_translation,
                translations=tuple(grow(a, slides) for a in joint.translations),
            )
        )
    markers = tuple(replace(m, local=factors.get(m.body, 1.0) * m.local) for m in model.markers)
    return replace(model, joints=tuple(joints), markers=markers)
