"""Trunk angles against the vertical, from the pelvis and lumbar angles of a body model."""

from __future__ import annotations

from typing import Literal

import numpy as np

from engine.datatypes import Array, JointAngles

__all__ = ["add_trunk_angles"]

_NEEDED = (
    "pelvis_tilt",
    "pelvis_list",
    "pelvis_rotation",
    "lumbar_flexion",
    "lumbar_bending",
    "lumbar_rotation",
)
_ADDED = ("trunk_inclination", "trunk_flexion", "trunk_lateral_bend")


def add_trunk_angles(angles: JointAngles, notes: list[str]) -> JointAngles:
    """Add the angles of the thorax axis with the vertical, where pelvis and lumbar angles exist.

    Pelvis in the world and thorax in the pelvis are both Z-X-Y rotations, as in OpenSim's
    full-body models. The thorax axis of the model is not the line from mid-hip to mid-shoulder, so
    that a constant difference to angles from keypoints remains.

    Parameters
    ----------
    angles
        In our convention.
    notes
        Gains a sentence when angles were added.
    """
    if not all(name in angles.names for name in _NEEDED):
        return angles
    missing = [name for name in _ADDED if name not in angles.names]
    if not missing:
        return angles
    tilt, list_, turn, flexion, bend, twist = (np.radians(angles[name]) for name in _NEEDED)
    pelvis = _rotate("z", tilt) @ _rotate("x", list_) @ _rotate("y", turn)
    thorax = pelvis @ _rotate("z", -flexion) @ _rotate("x", bend) @ _rotate("y", twist)
    computed = _trunk_angles(up=thorax[:, :, 1], right=pelvis[:, :, 2])
    value = np.column_stack([angles.value_deg, *(computed[name] for name in missing)])
    sigma = np.column_stack([angles.sigma_deg, np.full((value.shape[0], len(missing)), np.nan)])
    notes.append(f"Computed from pelvis and lumbar angles: {', '.join(missing)}.")
    names = (*angles.names, *missing)
    return JointAngles(angles.time_s, value, names, sigma_deg=sigma, convention=angles.convention)


def _trunk_angles(*, up: Array, right: Array) -> dict[str, Array]:
    """Return the angles of the trunk's axis (T, 3) with the vertical, degrees."""
    across = right * np.array([1.0, 0.0, 1.0])
    across /= np.linalg.norm(across, axis=1, keepdims=True)
    # Front = up x right, as X = Y x Z; the world's up is (0, 1, 0).
    front = np.column_stack([across[:, 2], np.zeros(len(across)), -across[:, 0]])
    forward, sideways = (up * front).sum(axis=1), (up * across).sum(axis=1)
    horizontal = np.hypot(up[:, 0], up[:, 2])
    return {
        "trunk_inclination": np.degrees(np.arctan2(horizontal, up[:, 1])),
        "trunk_flexion": np.degrees(np.arctan2(forward, up[:, 1])),
        "trunk_lateral_bend": np.degrees(np.arcsin(np.clip(sideways, -1.0, 1.0))),
    }


def _rotate(axis: Literal["x", "y", "z"], angle: Array) -> Array:
    """Return rotation matrices (T, 3, 3) about one axis, by angles (T,) in radians."""
    i, j = {"x": (1, 2), "y": (2, 0), "z": (0, 1)}[axis]
    matrix = np.tile(np.eye(3), (angle.shape[0], 1, 1))
    matrix[:, i, i] = matrix[:, j, j] = np.cos(angle)
    matrix[:, j, i] = np.sin(angle)
    matrix[:, i, j] = -np.sin(angle)
    return matrix
