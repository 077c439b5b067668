"""From the values uDEAS found to joint angles with standard errors.

The cost of uDEAS leaves one direction open in every frame: pelvis, waist and both hips can pitch
against each other without moving a joint. It is settled afterwards, by a stated share of the waist
in the pitch of the trunk, whose uncertainty enters the standard errors.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from engine.datatypes import Array, JointAngles, PoseTrack, Status
from engine.kinematics import angles as geometry
from engine.kinematics.fitting._common import find_worst_status
from engine.kinematics.fitting._report import REQUIRED
from engine.kinematics.humanoid import (
    FITTED_JOINTS,
    VARIABLES,
    SegmentLengths,
    angles_from_model,
    compute_jacobian,
    compute_joints,
)
from engine.skeletons import Skeleton, get_skeleton

__all__ = ["ANGLES", "estimate_sigma", "read_angles", "share_pitch"]

_COLUMN = {variable.name: i for i, variable in enumerate(VARIABLES)}
_NAMED = angles_from_model(np.ones(len(VARIABLES)))
ANGLES: tuple[str, ...] = tuple(name for name in geometry.ANGLE_NAMES if name in _NAMED)

WAIST_SHARE, WAIST_SIGMA = 0.6, 0.2
"""Share of the waist in the pitch of the trunk, and its standard deviation."""
WAIST_FLOOR_RAD = np.radians(5.0)

UNKNOWN_SIGMA_M = 0.03
"""Standard error of a keypoint whose track states none; scaled by the residuals."""
FIGURE_SIGMA_M = 0.005
"""A body is no figure of rigid rods: no keypoint counts as closer to its joint than this."""
PRIOR_RAD = 1.5
"""Nothing is known of an angle beforehand but that it is a human's."""

MIN_BENT_DEG = 15.0
"""With a straighter elbow the turn of the upper arm can't be seen."""
OUT_TO_THE_SIDE_DEG = 85.0
_SHOULDER_MOTIONS = ("shoulder_flexion", "shoulder_adduction", "shoulder_rotation")
HIDDEN_SIGMA_DEG = 45.0
"""An angle less certain than this was not seen."""


def share_pitch(values: Array, *, waist_share: float = WAIST_SHARE) -> Array:
    """Give the waist its share of the trunk's pitch, without moving any joint.

    Parameters
    ----------
    values
        Shape (T, 21), as in `engine.kinematics.humanoid.compute_joints`.
    waist_share
        Pitch of the waist over that of pelvis and waist together.

    Returns
    -------
    Array
        Shape (T, 21): the pelvis is turned about the hip line, waist and hips are turned back.
    """
    turn = np.zeros(len(values))
    shared = values
    # Exact at once where the pelvis is level; a rolled pelvis pitches a little less than it turns.
    for _ in range(8):
        pitch, waist = shared[:, _COLUMN["theta_bd"]], shared[:, _COLUMN["theta_ws"]]
        turn = turn + waist - waist_share * (waist + pitch)
        shared = _turn_pelvis(values, turn)
    return shared


def _turn_pelvis(values: Array, turn: Array) -> Array:
    """Turn the pelvis forwards about the hip line, and all that it carries back."""
    body = [_COLUMN[name] for name in ("theta_bd", "phi_bd", "psi_bd")]
    (st, sp, ss), (ct, cp, cs) = np.sin(values[:, body].T), np.cos(values[:, body].T)
    forward = np.stack([ct * cs, ct * ss, -st])
    up = np.stack([st * cp * cs + sp * ss, st * cp * ss - sp * cs, ct * cp])
    ahead = forward * np.cos(turn) - up * np.sin(turn)
    above = up * np.cos(turn) + forward * np.sin(turn)
    turned = np.array(values)
    turned[:, body[0]] = np.arctan2(-ahead[2], np.hypot(ahead[0], ahead[1]))
    turned[:, body[1]] = np.arctan2(ct * sp, above[2])
    turned[:, body[2]] = np.arctan2(ahead[1], ahead[0])
    turned[:, _COLUMN["theta_ws"]] -= turn
    for side in ("l", "r"):
        turned[:, _COLUMN[f"theta_hp_{side}"]] += turn
    return turned


def read_angles(
    track: PoseTrack,
    values: Array,
    fitted: NDArray[np.bool_],
    targets: Array,
    lengths: SegmentLengths,
) -> JointAngles:
    """Return the joint angles of a fitted track.

    Parameters
    ----------
    track
        What was fitted; T frames.
    values
        Shape (F, 21): the values of the fitted frames.
    fitted
        Shape (T,), F of them true.
    targets
        Shape (F, 12, 3): the joints that were fitted, m.
    lengths
        Of the figure.

    Returns
    -------
    JointAngles
        NaN where a keypoint that determines the angle is missing or the posture doesn't show it;
        the status is the worst of those keypoints.
    """
    shape = (track.n_frames, len(ANGLES))
    value, sigma = np.full(shape, np.nan), np.full(shape, np.nan)
    if fitted.any():
        sigma_m = _joint_sigma(track)[fitted]
        value[fitted] = _name_angles(values)
        sigma[fitted] = estimate_sigma(values, lengths, targets, sigma_m)
    present, status = _find_support(track)
    hidden = _find_hidden(value) | (sigma > HIDDEN_SIGMA_DEG)
    is_known = present & ~hidden & np.isfinite(value)
    status[~is_known & (status != Status.REJECTED)] = Status.MISSING
    return JointAngles(
        time_s=track.time_s,
        value_deg=np.where(is_known, value, np.nan),
        sigma_deg=np.where(is_known, sigma, np.nan),
        status=status,
        names=ANGLES,
    )


def _name_angles(values: Array) -> Array:
    """Return the angles (..., A) of values (..., 21), degrees."""
    named = angles_from_model(values)
    return np.stack([named[name] for name in ANGLES], axis=-1)


def _find_hidden(value: Array) -> NDArray[np.bool_]:
    """Mark angles that the posture itself doesn't show, shape (T, A)."""
    hidden = np.zeros(value.shape, dtype=bool)
    for s in ("l", "r"):
        flexion, adduction, rotation, elbow = (
            ANGLES.index(f"{name}_{s}") for name in (*_SHOULDER_MOTIONS, "elbow_flexion")
        )
        is_out = np.abs(value[:, adduction]) > OUT_TO_THE_SIDE_DEG
        hidden[:, flexion] = is_out
        hidden[:, rotation] = is_out | (value[:, elbow] < MIN_BENT_DEG)
    return hidden


def _find_support(track: PoseTrack) -> tuple[NDArray[np.bool_], NDArray[np.uint8]]:
    """Return whether the keypoints of each angle are there, and their worst status; (T, A)."""
    skeleton = get_skeleton(track.skeleton)
    shape = (track.n_frames, len(ANGLES))
    present, status = np.zeros(shape, dtype=bool), np.zeros(shape, dtype=np.uint8)
    for i, name in enumerate(ANGLES):
        if all(keypoint in skeleton.keypoints for keypoint in REQUIRED[name]):
            columns = [skeleton.index(keypoint) for keypoint in REQUIRED[name]]
            present[:, i] = track.is_present[:, columns].all(axis=1)
            status[:, i] = find_worst_status(np.asarray(track.status)[:, columns])
    return present, status


def _joint_sigma(track: PoseTrack) -> Array:
    """Return the stated standard error of the twelve joints, shape (T, 12), m."""
    skeleton: Skeleton = get_skeleton(track.skeleton)
    sigma = np.full((track.n_frames, len(FITTED_JOINTS)), np.nan)
    for i, name in enumerate(FITTED_JOINTS):
        if name in skeleton.keypoints:
            sigma[:, i] = np.asarray(track.sigma)[:, skeleton.index(name)]
    is_stated = np.isfinite(sigma) & (sigma > 0)
    return np.hypot(np.where(is_stated, sigma, UNKNOWN_SIGMA_M), FIGURE_SIGMA_M)


def estimate_sigma(values: Array, lengths: SegmentLengths, targets: Array, sigma_m: Array) -> Array:
    """Estimate the standard errors of the angles, each frame by itself.

    Parameters
    ----------
    values
        Shape (F, 21).
    lengths
        Of the figure.
    targets
        Shape (F, 12, 3), m; NaN where missing.
    sigma_m
        Shape (F, 12): standard error of each coordinate of the joints, m. Where the residuals
        of the clip are larger than these explain, they are scaled up.

    Returns
    -------
    Array
        Shape (F, A), degrees.

    Notes
    -----
    To first order, around the point found. The joints count alike, as in Eq 8, whatever their
    standard errors; those of the hips reach all joints, because the figure is centred between them.
    """
    known = np.asarray(np.isfinite(targets).all(axis=2))
    n_frames, n = values.shape
    slopes = compute_jacobian(values, lengths).reshape(n_frames, len(FITTED_JOINTS), 3, n)
    slopes = slopes * known[:, :, None, None]
    sigma = sigma_m * np.sqrt(_excess(values, lengths, targets, sigma_m))
    weight = 1.0 / np.mean(sigma**2, axis=1)
    middle = np.array([0.5 if name.endswith("_hip") else 0.0 for name in FITTED_JOINTS])
    reached = slopes - middle[:, None, None] * slopes.sum(axis=1, keepdims=True)
    reached = (reached * (sigma * weight[:, None])[:, :, None, None]).reshape(n_frames, -1, n)
    flat = slopes.reshape(n_frames, -1, n)
    prior = _prior(values)
    inverse = np.linalg.inv(flat.transpose(0, 2, 1) @ flat * weight[:, None, None] + prior)
    covariance = inverse @ (reached.transpose(0, 2, 1) @ reached + prior) @ inverse
    gradient = _angle_gradient(values)
    variance = np.einsum("fan,fnm,fam->fa", gradient, covariance, gradient)
    return np.asarray(np.sqrt(np.maximum(variance, 0.0)))


def _excess(values: Array, lengths: SegmentLengths, targets: Array, sigma_m: Array) -> float:
    """Return by how much the squared residuals of a clip exceed what was stated, at least 1."""
    offset = compute_joints(values, lengths) - targets
    known = np.asarray(np.isfinite(offset).all(axis=2))
    squared = np.where(known, np.sum(offset**2, axis=2) / sigma_m**2, 0.0)
    # One direction of the 21 moves nothing.
    freedom = np.maximum(3 * known.sum(axis=1) - 3 - (len(VARIABLES) - 1), 1)
    return max(1.0, float(squared.sum() / freedom.sum()))


def _prior(values: Array) -> Array:
    """Return the precision of what is known beforehand, shape (F, 21, 21)."""
    prior = np.tile(np.eye(values.shape[1]) / PRIOR_RAD**2, (len(values), 1, 1))
    body, waist = _COLUMN["theta_bd"], _COLUMN["theta_ws"]
    pitch = values[:, body] + values[:, waist]
    precision = 1.0 / (WAIST_FLOOR_RAD**2 + (WAIST_SIGMA * pitch) ** 2)
    slope = np.zeros(values.shape[1])
    slope[body], slope[waist] = -WAIST_SHARE, 1.0 - WAIST_SHARE
    return np.asarray(prior + precision[:, None, None] * np.outer(slope, slope))


def _angle_gradient(values: Array, step: float = 1e-4) -> Array:
    """Return the derivatives of the angles by the variables, shape (F, A, 21), degrees."""
    shift = step * np.eye(values.shape[1])
    change = _name_angles(values[:, None] + shift) - _name_angles(values[:, None] - shift)
    change = (change + 180.0) % 360.0 - 180.0
    return np.asarray(np.moveaxis(change / (2 * step), 1, 2))
