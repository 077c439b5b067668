"""From a fitted clip to joint angles with standard errors.

The standard error has two parts. Errors of keypoints that last longer than the fit smooths over
go through to the angles as if each frame had been fitted by itself; only the quick part is averaged
over neighbouring frames. How much is quick is read off the residuals: how alike they are a tenth
of a second later.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import uniform_filter1d

from engine.datatypes import Array, JointAngles, PoseTrack, Status
from engine.kinematics import angles as geometry
from engine.kinematics.fitting._banded import factorise
from engine.kinematics.fitting._clip import ROOT, ClipFit
from engine.kinematics.fitting._common import (
    UNKNOWN_SIGMA_DEG,
    find_worst_status,
    subtract_neutral,
)
from engine.kinematics.humanoid.readout import (
    SHOULDER_ROWS,
    VARIABLE_OF,
    WORLD_ANGLES,
    read_limb_angles,
    read_world_angles,
    shoulder_from_vectors,
)
from engine.skeletons import Skeleton, get_skeleton

__all__ = ["ANGLES", "REQUIRED", "StateErrors", "find_state_errors", "read_angles"]

ALIKE_AFTER_S = 0.1
SLOW_GAIN = 1.4
"""The fit follows slow errors, so the residuals show less of them than there is."""
ALL_SLOW = 0.9
LOCAL_WINDOW_S = 0.5
PRIOR_FREEDOM = 60.0
"""How many residuals the clip's own scale counts for against those around one frame."""
MAX_BRIDGED_S = 0.15
"""Keypoints missing for no longer than this are bridged by the movement before and after."""
MAX_PRIOR_SHARE = 0.5
"""An angle whose variance is this much of what it was beforehand was not seen."""
OUT_TO_THE_SIDE_DEG = 85.0


def _list_required() -> Iterator[tuple[str, tuple[str, ...]]]:
    hips, shoulders = ("left_hip", "right_hip"), ("left_shoulder", "right_shoulder")
    torso = (*shoulders, *hips)
    for name in (*WORLD_ANGLES, "lumbar_flexion", "lumbar_bending", "lumbar_rotation"):
        yield name, torso
    yield "neck_flexion", (*torso, "left_ear", "right_ear")
    for s, side in (("l", "left"), ("r", "right")):
        knee, ankle, elbow, wrist = (
            f"{side}_{part}" for part in ("knee", "ankle", "elbow", "wrist")
        )
        yield f"hip_flexion_{s}", (*torso, knee)
        yield f"hip_adduction_{s}", (*torso, knee)
        yield f"hip_rotation_{s}", (*torso, knee, ankle)
        yield f"knee_flexion_{s}", (f"{side}_hip", knee, ankle)
        yield f"ankle_dorsiflexion_{s}", (knee, ankle, f"{side}_heel", f"{side}_big_toe")
        yield f"shoulder_flexion_{s}", (*torso, elbow)
        yield f"shoulder_adduction_{s}", (*torso, elbow)
        yield f"shoulder_rotation_{s}", (*torso, elbow, wrist)
        yield f"elbow_flexion_{s}", (f"{side}_shoulder", elbow, wrist)


REQUIRED: Mapping[str, tuple[str, ...]] = dict(_list_required())
"""The keypoints that determine each angle."""
ANGLES: tuple[str, ...] = tuple(name for name in geometry.ANGLE_NAMES if name in REQUIRED)


def read_angles(
    track: PoseTrack,
    fit: ClipFit,
    seen: NDArray[np.bool_],
    errors: StateErrors | None = None,
) -> tuple[JointAngles, tuple[str, ...]]:
    """Return the joint angles of a fit, and the names of those that no frame shows.

    Parameters
    ----------
    track
        What was fitted.
    fit
        The fit.
    seen
        Shape (P, T): where each point of the figure was seen.
    errors
        Of the fit, where they are known already.
    """
    support, bridged, status = _find_support(track, fit, seen)
    pose = fit.problem.spread(fit.state)
    for side, rows in SHOULDER_ROWS.items():
        pose[list(rows)] = shoulder_from_vectors(pose[list(rows)], side)
    if errors is None:
        errors = find_state_errors(track.time_s, fit, is_bridged=bool(bridged.any()))
    variance, hidden = _find_variance(track.time_s, fit, pose, bridged, errors)
    value = np.array(_named_values(pose)).T
    sigma = np.minimum(np.degrees(np.sqrt(variance)).T, UNKNOWN_SIGMA_DEG)
    is_known = support & ~hidden.T & ~_is_out_to_the_side(value)
    value, sigma = np.where(is_known, value, np.nan), np.where(is_known, sigma, np.nan)
    subtract_neutral(track.time_s, value, sigma, ANGLES)
    is_explained = np.isfinite(value) | (status == Status.REJECTED)
    status = np.where(is_explained, status, Status.MISSING).astype(np.uint8)
    skeleton = get_skeleton(track.skeleton)
    can_be_seen = np.array([_has_keypoints(skeleton, name) for name in ANGLES])
    never = can_be_seen & ~np.asarray(np.isfinite(value).any(axis=0))
    angles = JointAngles(track.time_s, value, ANGLES, sigma, status)
    return angles, tuple(name for name, is_never in zip(ANGLES, never, strict=True) if is_never)


def _has_keypoints(skeleton: Skeleton, angle: str) -> bool:
    return all(k in skeleton.keypoints for k in REQUIRED[angle])


def _named_values(pose: Array) -> list[Array]:
    named = dict(zip(WORLD_ANGLES, read_world_angles(pose[:6]), strict=True))
    named |= read_limb_angles(pose)
    return [named[name] for name in ANGLES]


# --------------------------------------------------------------------------- what was seen


def _find_support(
    track: PoseTrack, fit: ClipFit, seen: NDArray[np.bool_]
) -> tuple[NDArray[np.bool_], NDArray[np.bool_], NDArray[np.uint8]]:
    """Return whether each angle is supported and bridged, and its status; shape (T, A) each."""
    skeleton = get_skeleton(track.skeleton)
    points = fit.problem.tree.points
    shape = (track.n_frames, len(ANGLES))
    support, bridged = np.zeros(shape, dtype=bool), np.zeros(shape, dtype=bool)
    status = np.full(shape, Status.MISSING, dtype=np.uint8)
    short_gap = {name: _is_short_gap(seen[i], track.time_s) for i, name in enumerate(points)}
    for i, angle in enumerate(ANGLES):
        needed = REQUIRED[angle]
        if not _has_keypoints(skeleton, angle):
            continue
        present = np.array([seen[points.index(k)] for k in needed])
        near = present | np.array([short_gap[k] for k in needed])
        support[:, i] = near.all(axis=0)
        bridged[:, i] = support[:, i] & ~present.all(axis=0)
        own = np.asarray(track.status)[:, [skeleton.index(k) for k in needed]]
        own = np.where(near.T & ~present.T, Status.FILLED, own)
        status[:, i] = find_worst_status(own)
    return support, bridged, status


def _is_short_gap(seen: NDArray[np.bool_], time_s: Array) -> NDArray[np.bool_]:
    """Mark the missing frames between two seen ones that are close in time."""
    if not seen.any():
        return np.zeros(seen.size, dtype=bool)
    index = np.arange(seen.size)
    before = np.maximum.accumulate(np.where(seen, index, -1))
    after = np.minimum.accumulate(np.where(seen, index, seen.size)[::-1])[::-1]
    inside = (before >= 0) & (after < seen.size)
    span = time_s[np.minimum(after, seen.size - 1)] - time_s[np.maximum(before, 0)]
    return np.asarray(~seen & inside & (span <= MAX_BRIDGED_S + 1e-9))


def _is_out_to_the_side(value: Array) -> NDArray[np.bool_]:
    """Mark flexion and rotation of an arm that points straight out to the side."""
    mask = np.zeros(value.shape, dtype=bool)
    for s in ("l", "r"):
        across = value[:, ANGLES.index(f"shoulder_adduction_{s}")]
        for motion in ("flexion", "rotation"):
            mask[:, ANGLES.index(f"shoulder_{motion}_{s}")] = np.abs(across) > OUT_TO_THE_SIDE_DEG
    return mask


# --------------------------------------------------------------------------- standard errors


@dataclass(frozen=True, eq=False)
class StateErrors:
    """Covariances of every frame's unknowns, shape (T, n, n).

    `alone` holds if every frame had been fitted by itself, `linked` if all errors were quick
    (None where nothing is quick); `slow` is the share of the errors that lasts.
    """

    alone: Array
    linked: Array | None
    slow: float

    @property
    def total(self) -> Array:
        """The covariance of both kinds of errors together."""
        if self.linked is None:
            return self.alone
        return np.asarray(self.slow * self.alone + (1.0 - self.slow) * self.linked)


def find_state_errors(time_s: Array, fit: ClipFit, *, is_bridged: bool) -> StateErrors:
    """Find how certain the unknowns of a fit are; `is_bridged` where it reaches over gaps."""
    slow = _find_slow_share(time_s, fit)
    linked = _link_frames(fit) if slow < ALL_SLOW or is_bridged else None
    scale = _find_scale(time_s, fit, slow, linked)[:, None, None]
    around = fit.around
    alone = np.linalg.inv(around.data_blocks / scale + around.prior_blocks)
    linked = None if linked is None else linked * scale
    return StateErrors(np.asarray(alone, dtype=np.float64), linked, slow)


def _find_variance(
    time_s: Array, fit: ClipFit, pose: Array, bridged: NDArray[np.bool_], errors: StateErrors
) -> tuple[Array, NDArray[np.bool_]]:
    """Return the variance of every angle, rad^2, and where it was not seen; shape (A, T)."""
    slopes = {side: _slope_of_shoulder(fit, side) for side in SHOULDER_ROWS}
    slopes["world"] = _slope_of_world_angles(pose[:6])
    own, hidden = _variance_of_angles(fit, slopes, errors.alone)
    if errors.linked is None:
        return own, hidden
    smooth, hidden_smooth = _variance_of_angles(fit, slopes, errors.linked)
    total = errors.slow * own + (1.0 - errors.slow) * smooth
    lasting = [ANGLES.index(name) for name in _FROM_ASSUMPTION]
    total[lasting] = own[lasting]
    gap = bridged.T
    total = np.where(gap, _near(own, gap, time_s) + smooth, total)
    return total, np.where(gap, hidden_smooth, hidden)


def _link_frames(fit: ClipFit) -> Array | None:
    """Return the covariance of every frame's unknowns if all errors were quick; (T, n, n)."""
    blocks = fit.around.data_blocks + fit.around.prior_blocks
    factor = factorise(blocks, fit.problem.roughness)
    return None if factor is None else factor.invert_blocks()


_FROM_ASSUMPTION = (
    "pelvis_tilt",
    "lumbar_flexion",
    *(f"hip_{motion}_{side}" for motion in ("flexion", "rotation") for side in ("l", "r")),
)
"""Angles whose error is mostly that of what is assumed of waist and feet, which lasts."""


def _near(own: Array, bridged: NDArray[np.bool_], time_s: Array) -> Array:
    """Return the variance with bridged samples interpolated from those next to them."""
    result = np.array(own)
    for row, gap in zip(result, bridged, strict=True):
        if gap.any() and not gap.all():
            row[gap] = np.interp(time_s[gap], time_s[~gap], row[~gap])
    return result


def _find_scale(time_s: Array, fit: ClipFit, slow: float, linked: Array | None) -> Array:
    """Return by how much the squared residuals exceed what was stated, around every frame.

    Never below one: errors that the whole figure shares can't be seen in the residuals.
    """
    n_samples = fit.problem.count_samples()
    # Every unknown takes its share out of the residuals: all of it from slow errors, less from
    # quick ones, because the unknowns of neighbouring frames hang together.
    data = fit.around.data_blocks
    taken = np.einsum("tij,tji->t", data, np.linalg.inv(fit.around.blocks))
    if linked is not None:
        taken = slow * taken + (1.0 - slow) * np.einsum("tij,tji->t", data, linked)
    freedom = np.maximum(n_samples - taken, n_samples / 12.0)
    misfit = fit.around.misfit
    if freedom.sum() <= 0:
        return np.ones(time_s.size)
    whole = misfit.sum() / freedom.sum()
    window = 1
    if time_s.size > 1:
        window = max(1, round(LOCAL_WINDOW_S / float(np.median(np.diff(time_s)))))
    near_misfit = window * uniform_filter1d(misfit, window, mode="nearest")
    near_freedom = window * uniform_filter1d(freedom, window, mode="nearest")
    local = (near_misfit + PRIOR_FREEDOM * whole) / (near_freedom + PRIOR_FREEDOM)
    return np.asarray(np.maximum(local, 1.0))


def _find_slow_share(time_s: Array, fit: ClipFit) -> float:
    """Return how alike the residuals are a tenth of a second later, 0 to 1; 1 if unknown."""
    if time_s.size < 10:
        return 1.0
    lag = max(1, round(ALIKE_AFTER_S / float(np.median(np.diff(time_s)))))
    if time_s.size <= 3 * lag:
        return 1.0
    residual = fit.problem.compare(fit.state)
    power = float(np.sum(residual[..., :-lag] ** 2 + residual[..., lag:] ** 2)) / 2
    if power <= 0.0:
        return 1.0
    alike = float(np.sum(residual[..., :-lag] * residual[..., lag:])) / power
    return float(np.clip(SLOW_GAIN * alike, 0.0, 1.0))


def _variance_of_angles(
    fit: ClipFit, slopes: Mapping[str, Array], covariance: Array
) -> tuple[Array, NDArray[np.bool_]]:
    """Return the variance of every angle from that of the unknowns; shape (A, T), rad^2."""
    problem = fit.problem
    n_frames = len(covariance)
    variance = np.full((len(ANGLES), n_frames), np.nan)
    hidden = np.zeros((len(ANGLES), n_frames), dtype=bool)
    places = {place: i for i, place in enumerate(problem.variables, start=ROOT)}
    for i, name in enumerate(ANGLES):
        place = places.get(VARIABLE_OF.get(name, -1))
        if place is not None:
            variance[i] = covariance[:, place, place]
            hidden[i] = variance[i] * problem.prior_weight[place] > MAX_PRIOR_SHARE
    for side, rows in SHOULDER_ROWS.items():
        if all(row in places for row in rows):
            names = [f"shoulder_{motion}_{side}" for motion in _BALL_MOTIONS]
            at = [ANGLES.index(name) for name in names]
            own = [places[row] for row in rows]
            variance[at] = _carry_over(slopes[side], covariance, own)
            weight = problem.prior_weight[places[rows[2]]]
            hidden[at[2]] = variance[at[2]] * weight > MAX_PRIOR_SHARE
    if all(place in places for place in range(6)):
        first = [places[place] for place in range(6)]
        world = [ANGLES.index(name) for name in WORLD_ANGLES]
        variance[world] = _carry_over(slopes["world"], covariance, first)
    return variance, hidden


_BALL_MOTIONS = ("flexion", "adduction", "rotation")


def _carry_over(slope: Array, covariance: Array, at: list[int]) -> Array:
    """Return the variance of angles from that of the unknowns at these places; shape (A, T)."""
    part = np.moveaxis(covariance[:, at][:, :, at], 0, 2)
    half = np.einsum("abt,bwt->awt", part, slope)
    return np.asarray(np.einsum("awt,awt->wt", slope, half))


def _slope_of_shoulder(fit: ClipFit, side: str, step: float = 1e-4) -> Array:
    """Return the derivatives of a shoulder's angles by its rotation vector; shape (3, 3, T)."""
    at = [ROOT + fit.problem.variables.index(row) for row in SHOULDER_ROWS[side]]
    vectors = fit.state[:, at].T
    shifts = step * np.concatenate([np.eye(3), -np.eye(3)])
    moved = (vectors[:, None] + shifts.T[:, :, None]).reshape(3, -1)
    read = shoulder_from_vectors(moved, side).reshape(3, 6, -1)
    change = read[:, :3] - read[:, 3:]
    change = (change + np.pi) % (2 * np.pi) - np.pi
    return np.asarray(np.moveaxis(change, 1, 0) / (2 * step))


def _slope_of_world_angles(angles: Array, step: float = 1e-4) -> Array:
    """Return the derivatives of `WORLD_ANGLES` by the first six angles; shape (6, 7, T)."""
    n_frames = angles.shape[1]
    shifts = step * np.concatenate([np.eye(6), -np.eye(6)])
    moved = (angles[:, None] + shifts.T[:, :, None]).reshape(6, -1)
    read = np.radians(read_world_angles(moved)).reshape(len(WORLD_ANGLES), 12, n_frames)
    change = read[:, :6] - read[:, 6:]
    change = (change + np.pi) % (2 * np.pi) - np.pi
    return np.asarray(np.moveaxis(change, 1, 0) / (2 * step))
