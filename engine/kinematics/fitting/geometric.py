"""The solver `geometric`: angles straight from keypoints, without a body model.

Standard errors are carried over from the keypoints to first order: every coordinate that
contributes is moved by plus and minus its own standard error, and the changes are added in
quadrature. The coordinates' errors count as independent of each other.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass

import numpy as np

from engine.datatypes import Array, JointAngles, KinematicFit, PoseTrack, Status, Subject
from engine.kinematics import angles as geometry
from engine.kinematics.fitting._common import (
    UNKNOWN_SIGMA_DEG,
    find_worst_status,
    subtract_neutral,
)
from engine.kinematics.fitting.base import SolverInfo, require_world_metres
from engine.skeletons import Skeleton, get_skeleton

__all__ = ["SOLVER", "WITHOUT_PELVIS", "propagate_sigma"]

Points = Mapping[str, Array]
AngleFunction = Callable[[Points], Array]

FRAMES_AT_ONCE = 2048
"""Keeps the memory for the copies below some 20 MB, however long the clip."""

WITHOUT_PELVIS = ("hip_flexion_l", "hip_flexion_r")
"""Measured against the trunk line here, against the pelvis by solvers with a body model."""

_SHOULDERS = ("left_shoulder", "right_shoulder")
_HIPS = ("left_hip", "right_hip")
_EARS = ("left_ear", "right_ear")


@dataclass(frozen=True)
class _Rule:
    """Which angles come from which keypoints; `compute` returns shape (T, len(names))."""

    names: tuple[str, ...]
    keypoints: tuple[str, ...]
    compute: AngleFunction


def _mid(points: Points, pair: tuple[str, str]) -> Array:
    return np.asarray((points[pair[0]] + points[pair[1]]) / 2)


def _trunk(points: Points) -> Array:
    return np.stack(
        geometry.compute_trunk_angles(*(points[k] for k in (*_SHOULDERS, *_HIPS))), axis=1
    )


def _hinge(*chain: str) -> AngleFunction:
    def compute(points: Points) -> Array:
        return geometry.compute_hinge_flexion(*(points[k] for k in chain))[:, None]

    return compute


def _hip(side: str) -> AngleFunction:
    def compute(points: Points) -> Array:
        return geometry.compute_hip_flexion(
            points[f"{side}_hip"],
            points[f"{side}_knee"],
            left_hip=points["left_hip"],
            right_hip=points["right_hip"],
            mid_shoulder=_mid(points, _SHOULDERS),
        )[:, None]

    return compute


def _shoulder(side: str) -> AngleFunction:
    def compute(points: Points) -> Array:
        flexion, adduction = geometry.compute_shoulder_angles(
            points[f"{side}_shoulder"],
            points[f"{side}_elbow"],
            left_shoulder=points["left_shoulder"],
            right_shoulder=points["right_shoulder"],
            mid_hip=_mid(points, _HIPS),
            side="left" if side == "left" else "right",
        )
        return np.stack([flexion, adduction], axis=1)

    return compute


def _neck(points: Points) -> Array:
    return geometry.compute_neck_angle(
        _mid(points, _EARS),
        left_shoulder=points["left_shoulder"],
        right_shoulder=points["right_shoulder"],
        mid_hip=_mid(points, _HIPS),
    )[:, None]


def _rules_of(side: str) -> Iterable[_Rule]:
    s = side[0]
    limb = {part: f"{side}_{part}" for part in ("hip", "knee", "ankle", "elbow", "wrist")}
    shoulder = f"{side}_shoulder"
    yield _Rule((f"hip_flexion_{s}",), (*_HIPS, *_SHOULDERS, limb["knee"]), _hip(side))
    leg = (limb["hip"], limb["knee"], limb["ankle"])
    yield _Rule((f"knee_flexion_{s}",), leg, _hinge(*leg))
    arm = (shoulder, limb["elbow"], limb["wrist"])
    yield _Rule((f"elbow_flexion_{s}",), arm, _hinge(*arm))
    names = (f"shoulder_flexion_{s}", f"shoulder_adduction_{s}")
    yield _Rule(names, (*_HIPS, *_SHOULDERS, limb["elbow"]), _shoulder(side))


_TRUNK_NAMES = ("trunk_inclination", "trunk_flexion", "trunk_lateral_bend", "trunk_twist")
_RULES: tuple[_Rule, ...] = (
    _Rule(_TRUNK_NAMES, (*_SHOULDERS, *_HIPS), _trunk),
    _Rule(("neck_flexion",), (*_EARS, *_SHOULDERS, *_HIPS), _neck),
    *_rules_of("left"),
    *_rules_of("right"),
)
_PROVIDED = {name for rule in _RULES for name in rule.names}


def propagate_sigma(compute: AngleFunction, points: Points, sigma: Points) -> Array:
    """Carry the standard errors of keypoints over to the angles computed from them.

    Parameters
    ----------
    compute
        Turns keypoints into angles of shape (T, A), degrees.
    points
        Shape (T, 3) each, m.
    sigma
        Shape (T,) each: standard error of every coordinate of the keypoint of that name, m.

    Returns
    -------
    Array
        Shape (T, A), degrees; NaN where the angle or one of the errors is unknown. Where moving
        a keypoint makes the angle undefined, and at most, `UNKNOWN_SIGMA_DEG`.

    Notes
    -----
    The root mean square of the change upwards and downwards stands for the derivative. It
    equals the first-order rule where the angle is smooth, and keeps its size at the kinks of
    unsigned angles (a straight knee), where central differences would cancel to zero.
    """
    centre = compute(points)
    is_known = np.all([np.isfinite(sigma[name]) for name in points], axis=0)
    variance = np.empty_like(centre)
    for start in range(0, len(centre), FRAMES_AT_ONCE):
        part = slice(start, start + FRAMES_AT_ONCE)
        # All moved copies one after another in time: the angles of a frame need no other frame.
        copies = _move_each(*({k: v[part] for k, v in each.items()} for each in (points, sigma)))
        change = compute(copies).reshape(-1, *centre[part].shape) - centre[part]
        change = (change + 180.0) % 360.0 - 180.0
        variance[part] = (np.nan_to_num(change, nan=UNKNOWN_SIGMA_DEG) ** 2 / 2).sum(axis=0)
    total = np.minimum(np.sqrt(variance), UNKNOWN_SIGMA_DEG)
    return np.where(is_known[:, None] & np.isfinite(centre), total, np.nan)


def _move_each(points: Points, sigma: Points) -> Points:
    """Return copies of all points, one for each coordinate that moves up or down by its error.

    Shape (6 * len(points) * T, 3) each.
    """
    n_copies = 6 * len(points)
    moved = {name: np.tile(position, (n_copies, 1, 1)) for name, position in points.items()}
    for i, name in enumerate(points):
        for axis in range(3):
            moved[name][6 * i + axis, :, axis] += sigma[name]
            moved[name][6 * i + 3 + axis, :, axis] -= sigma[name]
    return {name: copies.reshape(-1, 3) for name, copies in moved.items()}


class GeometricSolver:
    """Angles between lines through keypoints."""

    info = SolverInfo(
        name="geometric",
        title="Angles from keypoints",
        angles=tuple(name for name in geometry.ANGLE_NAMES if name in _PROVIDED),
        description="Angles between the lines through the keypoints, frame by frame, with "
        "standard errors from those of the keypoints. No body model: segments may change length, "
        "hip flexion includes the lumbar spine, and rotations about a limb are not given.",
    )

    def fit(self, track: PoseTrack, subject: Subject) -> KinematicFit:
        """Compute the angles of every frame.

        Parameters
        ----------
        track
            World metres, Y up; sigma per keypoint, NaN where unknown.
        subject
            Not used: no angle here depends on the body's size.

        Returns
        -------
        KinematicFit
            Without a body model; always the same angles, NaN where a keypoint is missing (or the
            skeleton has none) or the geometry is singular. The status is the worst of the
            contributing keypoints.

        Raises
        ------
        UnitError
            If the track is not in world metres.
        """
        require_world_metres(track)
        skeleton = get_skeleton(track.skeleton)
        shape = (track.n_frames, len(self.info.angles))
        value, sigma = np.full(shape, np.nan), np.full(shape, np.nan)
        status = np.full(shape, Status.MISSING, dtype=np.uint8)
        for rule in _RULES:
            if not all(k in skeleton.keypoints for k in rule.keypoints):
                continue
            columns = [self.info.angles.index(name) for name in rule.names]
            value[:, columns], sigma[:, columns] = _apply(rule, track, skeleton)
            indices = [skeleton.index(k) for k in rule.keypoints]
            worst = find_worst_status(np.asarray(track.status)[:, indices])
            status[:, columns] = worst[:, None]
        subtract_neutral(track.time_s, value, sigma, self.info.angles)
        is_explained = np.isfinite(value) | (status == Status.REJECTED)
        status[~is_explained] = Status.MISSING
        return KinematicFit(
            JointAngles(
                time_s=track.time_s,
                value_deg=value,
                sigma_deg=sigma,
                status=status,
                names=self.info.angles,
            )
        )


def _apply(rule: _Rule, track: PoseTrack, skeleton: Skeleton) -> tuple[Array, Array]:
    points = {k: track.position[:, skeleton.index(k)] for k in rule.keypoints}
    errors = np.asarray(track.sigma)
    sigma = {k: errors[:, skeleton.index(k)] for k in rule.keypoints}
    value = rule.compute(points)
    if any(np.isnan(error).all() for error in sigma.values()):
        # Recordings of a laboratory state no errors: nothing can be carried over.
        return value, np.full(value.shape, np.nan)
    return value, propagate_sigma(rule.compute, points, sigma)


SOLVER = GeometricSolver()
