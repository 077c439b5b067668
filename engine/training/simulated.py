"""Movements of the jointed figure: lifts and postures that the recordings hold too few of.

A lift goes through key postures between stooping and squatting, with the hands reaching to some
place and the trunk turned or bent sideways; other clips wander through postures drawn within the
joints' ranges. Between key postures every angle eases from one value to the next.
"""

from __future__ import annotations

from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from engine.kinematics.humanoid import FITTED_JOINTS, VARIABLES, SegmentLengths, compute_joints
from engine.skeletons import H36M_17
from engine.training.corpus import RATE_HZ, Clip

__all__ = ["simulate_clips"]

Floats = NDArray[np.float64]

_NAMES = tuple(v.name for v in VARIABLES)
_LOWER, _UPPER = (np.array([v.bounds[i] for v in VARIABLES]) for i in (0, 1))
_COLUMNS = [H36M_17.keypoints.index(name) for name in FITTED_JOINTS]
_HEAD_LIFT, _HEAD_FORWARD = 0.10, 0.075
"""From the middle of the shoulders to the nose, statures; the top of the head is twice as high."""
_ANKLE_HEIGHT_M = 0.08


def simulate_clips(n_clips: int, seed: int) -> list[Clip]:
    """Move the figure through lifts (two of three clips) and through random postures.

    Parameters
    ----------
    n_clips
        How many movements, of 4-9 s each.
    seed
        Of everything random.

    Returns
    -------
    list of Clip
        Joints in metres, Z up, 30 Hz.
    """
    rng = np.random.default_rng(seed)
    clips = []
    for i in range(n_clips):
        is_lift = i % 3 != 2
        keys = _lift_keys(rng) if is_lift else _wandering_keys(rng)
        values = _ease(keys, rng)
        stature = rng.uniform(1.45, 1.95)
        position = _place(values, stature, rng)
        kind = "lift" if is_lift else "postures"
        clips.append(Clip(f"simulated-{kind}-{i}", f"simulated-{i}", "simulated", position))
    return clips


def _posture(**degrees: float) -> Floats:
    """Give a row of the figure's values: zero but for the angles named."""
    values = np.zeros(len(_NAMES))
    values[0] = 1.0
    for name, value in degrees.items():
        values[_NAMES.index(name)] = np.radians(value)
    return values


def _lift_keys(rng: np.random.Generator) -> Floats:
    """Draw the key postures of a lift: standing, bent, and on to other places."""
    keys = [_standing(rng)]
    for _ in range(rng.integers(1, 4)):
        keys += [_reaching(rng), _reaching(rng) if rng.random() < 0.4 else _standing(rng)]
    return np.stack([*keys, _standing(rng)])


def _standing(rng: np.random.Generator) -> Floats:
    return _arrange(rng, squat=rng.uniform(0, 12), trunk=rng.normal(3, 5), turn=0.3)


def _reaching(rng: np.random.Generator) -> Floats:
    technique, depth = rng.uniform(), rng.beta(2.0, 1.5)
    return _arrange(
        rng, squat=75 * depth * technique, trunk=depth * (110 - 65 * technique), turn=1.0
    )


def _arrange(rng: np.random.Generator, *, squat: float, trunk: float, turn: float) -> Floats:
    """Set legs and trunk (degrees from the vertical), and reach with both arms."""
    waist = trunk * rng.uniform(0.2, 0.6)
    shank = squat * rng.uniform(0.3, 0.7)
    reach, bend = rng.uniform(-10, 100), rng.gamma(2.0, 20.0)
    angles = {
        "theta_bd": trunk - waist,
        "phi_bd": turn * rng.normal(0, 4),
        "psi_bd": turn * rng.normal(0, 12),
        "theta_ws": waist,
        "phi_ws": turn * rng.normal(0, 9),
        "psi_ws": turn * rng.normal(0, 16),
    }
    for side in ("l", "r"):
        angles[f"theta_hp_{side}"] = squat + trunk - waist + rng.normal(0, 6)
        angles[f"theta_kn_{side}"] = squat + shank + abs(rng.normal(0, 5))
        angles[f"phi_hp_{side}"] = rng.normal(8, 6)
        angles[f"theta_sh_{side}"] = trunk + reach + rng.normal(0, 8)
        angles[f"theta_el_{side}"] = bend + rng.normal(0, 8)
        angles[f"phi_sh_{side}"] = rng.normal(8, 12)
        angles[f"psi_sh_{side}"] = rng.normal(20, 25)
    return np.clip(_posture(**angles), _LOWER, _UPPER)


def _wandering_keys(rng: np.random.Generator) -> Floats:
    """Draw postures within the ranges, most of them nearer to standing than to the limits."""
    middle = _posture()
    share = rng.beta(1.2, 2.0, (rng.integers(4, 9), len(_NAMES)))
    limit = np.where(rng.random(share.shape) < 0.5, _LOWER, _UPPER)
    keys = middle + share * (limit - middle)
    keys[:, 0] = 1.0
    keys[:, _NAMES.index("psi_bd")] = np.cumsum(rng.normal(0, 0.5, len(keys)))
    return np.asarray(keys)


def _ease(keys: Floats, rng: np.random.Generator) -> Floats:
    """Pass through key postures (N, 21), each change with a bell-shaped speed; give (T, 21)."""
    parts = []
    for a, b in pairwise(keys):
        # The parts of the body start one after another.
        late = rng.uniform(0.0, 0.25, len(a))
        time = np.linspace(0, 1, int(RATE_HZ * rng.uniform(0.6, 2.2)), endpoint=False)[:, None]
        share = np.clip((time - late) / (0.75), 0.0, 1.0)
        ease = share**3 * (10 - 15 * share + 6 * share**2)
        parts.append(a + ease * (b - a))
    return np.concatenate([*parts, np.repeat(keys[-1:], 10, axis=0)])


def _place(values: Floats, stature: float, rng: np.random.Generator) -> NDArray[np.float32]:
    """Give the 17 joints, with the lower ankle on the ground and a head on the trunk."""
    lengths = SegmentLengths.from_stature(stature)
    joints = compute_joints(values, lengths)
    out = np.zeros((len(values), 17, 3))
    out[:, _COLUMNS] = joints
    out[:, 8] = out[:, [11, 14]].mean(axis=1)
    out[:, 7] = 0.5 * (out[:, 0] + out[:, 8])
    up = out[:, 8] / np.linalg.norm(out[:, 8], axis=1, keepdims=True)
    forward = np.cross(out[:, 11] - out[:, 14], up)
    forward /= np.linalg.norm(forward, axis=1, keepdims=True)
    nod = np.radians(rng.normal(0, 18) + np.linspace(0, 1, len(values)) * rng.normal(0, 15))
    up, forward = (
        np.cos(nod)[:, None] * up + np.sin(nod)[:, None] * forward,
        np.cos(nod)[:, None] * forward - np.sin(nod)[:, None] * up,
    )
    out[:, 9] = out[:, 8] + stature * (_HEAD_LIFT * up + _HEAD_FORWARD * forward)
    out[:, 10] = out[:, 8] + stature * 2 * _HEAD_LIFT * up
    ground = np.minimum(out[:, 3, 2], out[:, 6, 2])
    out[:, :, 2] += (_ANKLE_HEIGHT_M - ground)[:, None]
    return out.astype(np.float32)
