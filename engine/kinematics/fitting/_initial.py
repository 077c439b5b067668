"""A first guess of the figure's angles in every frame, in closed form.

Every joint is solved from the directions of the lines next to it, as if the keypoints were
exact. The result starts the least-squares fit, so noise in it does no harm; jumps would, and
are taken out.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter1d, median_filter

from engine.datatypes import Array
from engine.kinematics.humanoid.model import ANGLE_COUNT, column
from engine.kinematics.humanoid.readout import SHOULDER_ROWS, vectors_from_shoulder

__all__ = ["find_reversed", "guess_angles", "guess_root", "interpolate_missing"]

MIN_LENGTH_M = 1e-3
BENT_SINE = np.sin(np.radians(20.0))
"""A knee or elbow bent by less hardly shows how the limb above it is turned."""
MAX_TURN = np.radians(75.0)
JUMP_WINDOW_S = 0.5
SMOOTH_S = 0.04
REVERSED_WINDOW_S = 1.0
REVERSED_COSINE = -0.5
MAX_JUMP = np.radians(75.0)


def guess_angles(points: Mapping[str, Array], time_s: Array, *, waist_share: float) -> Array:
    """Guess full pose vectors from points.

    Parameters
    ----------
    points
        Shape (T, 3) each, in the figure's axes, by keypoint name; NaN where missing. Those the
        figure has not are ignored.
    time_s
        Shape (T,).
    waist_share
        Share of the trunk's pitch that is given to the waist, the rest to the pelvis.

    Returns
    -------
    Array
        Shape (29, T), radians, the shoulders by rotation vectors; continuous in time,
        interpolated where a point is missing,
        held at the ends, and zero for angles that are never seen.
    """
    missing = np.full((time_s.size, 3), np.nan)
    seen = {name: points.get(name, missing) for name in _NEEDED} | dict(points)
    angles = np.full((ANGLE_COUNT, time_s.size), np.nan)
    body = _guess_body(seen, angles, waist_share)
    trunk = _guess_waist(seen, body, angles)
    for letter, side, sign in (("l", "left", 1.0), ("r", "right", -1.0)):
        chain = [seen[f"{side}_{part}"] for part in ("hip", "knee", "ankle")]
        leg = _guess_limb(body, *chain, sign=sign, bends_back=True)
        _store(angles, leg, ("hp", "kn"), letter)
        chain = [seen[f"{side}_{part}"] for part in ("shoulder", "elbow", "wrist")]
        _store(
            angles, _guess_limb(trunk, *chain, sign=sign, bends_back=False), ("sh", "el"), letter
        )
        _guess_ankle(seen, angles, body, letter, side, sign)
    _guess_neck(seen, angles, trunk)
    for letter, rows in SHOULDER_ROWS.items():
        shoulder = angles[list(rows)]
        # Without a wrist the turn of the arm is unknown, its direction is not.
        shoulder[2] = np.nan_to_num(shoulder[2])
        seen_arm = np.isfinite(shoulder).all(axis=0)
        shoulder[:, ~seen_arm] = np.nan
        if seen_arm.any():
            shoulder[:, seen_arm] = vectors_from_shoulder(shoulder[:, seen_arm], letter)
        angles[list(rows)] = shoulder
    known = np.isfinite(angles).any(axis=1)
    angles[~known] = 0.0
    facing = int(known[: column("psi_bd")].sum())
    if known[column("psi_bd")]:
        angles[known] = _make_continuous(angles[known], time_s, facing)
    return angles


_NEEDED = tuple(
    f"{side}_{part}"
    for side in ("left", "right")
    for part in ("hip", "knee", "ankle", "shoulder", "elbow", "wrist", "heel", "big_toe", "ear")
)


def find_reversed(points: Mapping[str, Array], time_s: Array) -> NDArray[np.bool_]:
    """Mark frames in which hips and shoulders both face away from where they face around them.

    Nobody turns round and back within a second: left and right were exchanged there.

    Parameters
    ----------
    points
        Shape (T, 3) each, in the figure's axes, by keypoint name.
    time_s
        Shape (T,).
    """
    if time_s.size < 5:
        return np.zeros(time_s.size, dtype=bool)
    window = round(REVERSED_WINDOW_S / float(np.median(np.diff(time_s)))) // 2 * 2 + 1
    window = min(max(window, 5), time_s.size)
    away = np.ones(time_s.size, dtype=bool)
    for part in ("hip", "shoulder"):
        line = (points[f"left_{part}"] - points[f"right_{part}"])[:, :2].T
        line = np.stack([interpolate_missing(row, time_s) for row in line])
        usual = median_filter(line, (1, window), mode="nearest")
        size = np.linalg.norm(line, axis=0) * np.linalg.norm(usual, axis=0)
        away &= np.sum(line * usual, axis=0) < REVERSED_COSINE * size
    return away


def guess_root(points: Mapping[str, Array], time_s: Array) -> Array:
    """Return the mid-hip, shape (3, T), with what is missing interpolated; zero if never seen."""
    middle = (points["left_hip"] + points["right_hip"]) / 2
    return np.stack([interpolate_missing(row, time_s) for row in middle.T])


def interpolate_missing(curve: Array, time_s: Array) -> Array:
    """Fill NaN linearly, hold the ends; zero where nothing is known."""
    known = np.isfinite(curve)
    if not known.any():
        return np.zeros_like(curve)
    return np.asarray(np.interp(time_s, time_s[known], curve[known]))


def _unit(vector: Array) -> Array:
    length = np.linalg.norm(vector, axis=-1, keepdims=True)
    return np.asarray(vector / np.where(length > MIN_LENGTH_M, length, np.nan))


def _into(frame: Array, vector: Array) -> Array:
    """Express vectors (T, 3) in frames (T, 3, 3) whose columns are the axes."""
    return np.asarray(np.einsum("tij,ti->tj", frame, vector))


def _rotation(axis: int, angle: Array) -> Array:
    """Return rotation matrices (T, 3, 3) about a coordinate axis."""
    i, j = (axis + 1) % 3, (axis + 2) % 3
    matrix = np.zeros((angle.size, 3, 3))
    matrix[:, axis, axis] = 1.0
    matrix[:, i, i] = matrix[:, j, j] = np.cos(angle)
    matrix[:, j, i] = np.sin(angle)
    matrix[:, i, j] = -matrix[:, j, i]
    return matrix


def _guess_body(seen: Mapping[str, Array], angles: Array, waist_share: float) -> Array:
    """Solve the pelvis from the hip line and its share of the trunk's pitch."""
    left = _unit(seen["left_hip"] - seen["right_hip"])
    middle = (seen["left_hip"] + seen["right_hip"]) / 2
    trunk = _unit((seen["left_shoulder"] + seen["right_shoulder"]) / 2 - middle)
    ahead = _unit(np.stack([left[:, 1], -left[:, 0], np.zeros(len(left))], axis=1))
    pitch = np.arctan2(np.sum(trunk * ahead, axis=1), trunk[:, 2])
    theta = (1.0 - waist_share) * pitch
    roll = np.arcsin(np.clip(left[:, 2] / np.cos(theta), -1.0, 1.0))
    # The hip line before the heading turns it; what is missing to the seen one is the heading.
    before = np.arctan2(np.cos(roll), np.sin(theta) * np.sin(roll))
    psi = np.arctan2(left[:, 1], left[:, 0]) - before
    angles[[column("theta_bd"), column("phi_bd"), column("psi_bd")]] = theta, roll, psi
    return np.asarray(_rotation(2, psi) @ _rotation(1, theta) @ _rotation(0, roll))


def _guess_waist(seen: Mapping[str, Array], body: Array, angles: Array) -> Array:
    """Solve the waist from the trunk line and the shoulder line; return the trunk's axes."""
    hips = (seen["left_hip"] + seen["right_hip"]) / 2
    shoulders = (seen["left_shoulder"] + seen["right_shoulder"]) / 2
    up = _into(body, _unit(shoulders - hips))
    theta, phi = np.arctan2(up[:, 0], up[:, 2]), -np.arcsin(np.clip(up[:, 1], -1.0, 1.0))
    trunk = np.asarray(body @ _rotation(1, theta) @ _rotation(0, phi))
    across = _into(trunk, _unit(seen["left_shoulder"] - seen["right_shoulder"]))
    psi = np.arctan2(-across[:, 0], across[:, 1])
    angles[[column("theta_ws"), column("phi_ws"), column("psi_ws")]] = theta, phi, psi
    return np.asarray(trunk @ _rotation(2, psi))


def _guess_limb(
    parent: Array, top: Array, middle: Array, end: Array, *, sign: float, bends_back: bool
) -> tuple[Array, Array, Array, Array]:
    """Solve flexion, abduction and turn of a limb and the bend of its hinge."""
    upper = _into(parent, _unit(middle - top))
    theta = np.arctan2(upper[:, 0], -upper[:, 2])
    phi = np.arcsin(np.clip(sign * upper[:, 1], -1.0, 1.0))
    limb = parent @ _rotation(1, -theta) @ _rotation(0, sign * phi)
    lower = _into(limb, _unit(end - middle))
    ahead = -lower[:, 0] if bends_back else lower[:, 0]
    inward = sign * lower[:, 1] if bends_back else -sign * lower[:, 1]
    sine = np.hypot(ahead, inward)
    hinge = np.arctan2(sine, -lower[:, 2])
    turn = np.clip(np.arctan2(inward, ahead), -MAX_TURN, MAX_TURN)
    return theta, phi, turn * np.clip(sine / BENT_SINE, 0.0, 1.0), hinge


def _store(
    angles: Array, limb: tuple[Array, Array, Array, Array], parts: tuple[str, str], letter: str
) -> None:
    ball, hinge = parts
    theta, phi, psi, bend = limb
    angles[column(f"theta_{ball}_{letter}")] = theta
    angles[column(f"phi_{ball}_{letter}")] = phi
    angles[column(f"psi_{ball}_{letter}")] = psi
    angles[column(f"theta_{hinge}_{letter}")] = bend


def _guess_ankle(
    seen: Mapping[str, Array], angles: Array, body: Array, letter: str, side: str, sign: float
) -> None:
    """Solve the foot from the line heel to toe in the shank's axes."""
    theta, phi, psi, knee = (
        angles[column(f"{name}_{letter}")] for name in ("theta_hp", "phi_hp", "psi_hp", "theta_kn")
    )
    shank = (
        body
        @ _rotation(1, -theta)
        @ _rotation(0, sign * phi)
        @ _rotation(2, -sign * psi)
        @ _rotation(1, knee)
    )
    sole = _into(shank, _unit(seen[f"{side}_big_toe"] - seen[f"{side}_heel"]))
    angles[column(f"theta_an_{letter}")] = np.arcsin(np.clip(sole[:, 2], -1.0, 1.0))
    turn = -sign * np.arctan2(sole[:, 1], sole[:, 0])
    angles[column(f"psi_an_{letter}")] = np.clip(turn, -MAX_TURN / 2, MAX_TURN / 2)


def _guess_neck(seen: Mapping[str, Array], angles: Array, trunk: Array) -> None:
    ears = (seen["left_ear"] + seen["right_ear"]) / 2
    shoulders = (seen["left_shoulder"] + seen["right_shoulder"]) / 2
    up = _into(trunk, _unit(ears - shoulders))
    theta, phi = np.arctan2(up[:, 0], up[:, 2]), -np.arcsin(np.clip(up[:, 1], -1.0, 1.0))
    head = trunk @ _rotation(1, theta) @ _rotation(0, phi)
    across = _into(head, _unit(seen["left_ear"] - seen["right_ear"]))
    psi = np.clip(np.arctan2(-across[:, 0], across[:, 1]), -MAX_TURN, MAX_TURN)
    angles[[column("theta_nk"), column("phi_nk"), column("psi_nk")]] = theta, phi, psi


def _make_continuous(curves: Array, time_s: Array, facing: int) -> Array:
    """Unwrap every curve over the frames that are known, drop jumps, fill and smooth a little.

    `facing` is the place of the heading among the curves. Where it jumps, somebody was seen back
    to front, and no angle of the frame is worth anything.
    """
    filled = np.stack([_unwrap_known(curve, time_s) for curve in curves])
    if time_s.size < 5:
        return filled
    interval_s = float(np.median(np.diff(time_s)))
    window = min(max(round(JUMP_WINDOW_S / interval_s), 3), time_s.size) // 2 * 2 + 1
    usual = median_filter(filled, (1, window), mode="nearest")
    is_jump = np.abs(filled - usual) > MAX_JUMP
    is_jump |= is_jump[facing]
    if is_jump.any():
        # A jump there and back can wind a curve up by a whole turn: unwrap what is left again.
        rest = np.where(is_jump | ~np.isfinite(curves), np.nan, curves)
        filled = np.stack([_unwrap_known(curve, time_s) for curve in rest])
    # The fit sets out from curves as smooth as it will end with, and needs fewer steps.
    spread = SMOOTH_S / interval_s
    return np.asarray(gaussian_filter1d(filled, spread, mode="nearest") if spread > 0.3 else filled)


def _unwrap_known(curve: Array, time_s: Array) -> Array:
    """Unwrap what is known of a curve, bring it near zero, and fill the rest."""
    known = np.isfinite(curve)
    if not known.any():
        return np.zeros_like(curve)
    smooth = np.unwrap(curve[known])
    turns = 2 * np.pi * np.round(float(smooth.mean()) / (2 * np.pi))
    return np.asarray(np.interp(time_s, time_s[known], smooth - turns))
