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
    """Every body in every frame.

    `rotation` (B, T, 3, 3) and `origin` (B, T, 3) in the world; `motion` (Q, T, 6) the spatial
    velocity of what hangs on a coordinate per unit of it.
    """

    rotation: Array
    origin: Array
    motion: Array

    def place(self, body: NDArray[np.intp], local: Array) -> Array:
        """Return points fixed in bodies in the world, shape (T, M, 3).

        `body` (M,) are columns of bodies, `local` (M, 3) the points in them.
        """
        turned = np.einsum("mtij,mj->tmi", self.rotation[body], local)
        return np.asarray(turned + self.origin[body].transpose(1, 0, 2))


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

    def pose(self, coordinates: Array) -> BodyPoses:
        """Place every body.

        Parameters
        ----------
        coordinates
            Shape (T, Q), radians and metres.
        """
        n_frames, n_bodies = len(coordinates), len(self.parents)
        rotation = np.empty((n_bodies, n_frames, 3, 3))
        origin = np.empty((n_bodies, n_frames, 3))
        motion = np.zeros((len(self.coordinate_names), n_frames, 6))
        for body, (joint, parent) in enumerate(zip(self.model.joints, self.parents, strict=True)):
            above = (
                (np.broadcast_to(np.eye(3), (n_frames, 3, 3)), np.zeros((n_frames, 3)))
                if parent < 0
                else (rotation[parent], origin[parent])
            )
            rotation[body], origin[body] = self._move(joint, coordinates, above, motion)
        return BodyPoses(rotation, origin, motion)

    def _move(
        self, joint: Joint, coordinates: Array, above: tuple[Array, Array], motion: Array
    ) -> tuple[Array, Array]:
        """Return rotation (T, 3, 3) and origin (T, 3) of a joint's child; adds to `motion`."""
        turn = above[0] @ joint.parent_rotation
        centre = above[1] + above[0] @ joint.parent_translation
        frame = turn
        for axis in joint.translations:
            value, slope, column = self._evaluate(axis, coordinates)
            direction = frame @ axis.axis
            centre = centre + value[:, None] * direction
            if column is not None:
                motion[column, :, 3:] += slope[:, None] * direction
        for axis in joint.rotations:
            value, slope, column = self._evaluate(axis, coordinates)
            if column is not None:
                spin = slope[:, None] * (turn @ axis.axis)
                motion[column, :, :3] += spin
                motion[column, :, 3:] += _cross(centre, spin)
            turn = turn @ _rotate_about(axis.axis, value)
        rotation = turn @ joint.child_rotation.T
        return rotation, centre - rotation @ joint.child_translation

    def _evaluate(self, axis: Axis, coordinates: Array) -> tuple[Array, Array, int | None]:
        if not axis.coordinate:
            value, slope = axis.function(np.zeros(len(coordinates)))
            return value, slope, None
        column = self.column[axis.coordinate]
        return *axis.function(coordinates[:, column]), column


def _cross(a: Array, b: Array) -> Array:
    """Return the cross product of (T, 3) arrays; quicker than numpy's for small ones."""
    x, y, z = a[:, 0], a[:, 1], a[:, 2]
    u, v, w = b[:, 0], b[:, 1], b[:, 2]
    return np.stack([y * w - z * v, z * u - x * w, x * v - y * u], axis=1)


def _rotate_about(axis: Array, angle: Array) -> Array:
    """Return rotations (T, 3, 3) about a fixed unit axis (Rodrigues)."""
    cross = np.array([[0.0, -axis[2], axis[1]], [axis[2], 0.0, -axis[0]], [-axis[1], axis[0], 0.0]])
    sine, versine = np.sin(angle), 1.0 - np.cos(angle)
    rotation: Array = (
        np.eye(3) + sine[:, None, None] * cross + versine[:, None, None] * (cross @ cross)
    )
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
