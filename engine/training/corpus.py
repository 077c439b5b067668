"""Movements to train on: joints of people in metres, cut into clips.

All clips are in one world (Z up, metres, 30 Hz) with the 17 joints of `H36M_17`. Sources are the
motion-capture corpus and the synthetic lifting trials, both described by the README beside them.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from engine.errors import DataError
from engine.skeletons import H36M_17

__all__ = [
    "BONES",
    "MIRRORED",
    "Clip",
    "read_lift_joints",
    "read_lifts",
    "read_mocap",
    "vary_windows",
]

Floats = NDArray[np.float32]
Floats64 = NDArray[np.float64]

RATE_HZ = 30.0
TRAINING_PERSONS = ("P01", "P02", "P03", "P04", "P06")
TEST_PERSONS = ("P07", "P08")

_INDEX = {name: i for i, name in enumerate(H36M_17.keypoints)}
MIRRORED = np.array(
    [
        _INDEX[
            name.replace("left_", "x_").replace("right_", "left_").replace("x_", "right_")
            if name.startswith(("left_", "right_"))
            else name
        ]
        for name in H36M_17.keypoints
    ]
)
"""Column of the same joint on the other side."""
_CHAINS = (
    ("pelvis", "right_hip", "right_knee", "right_ankle"),
    ("pelvis", "left_hip", "left_knee", "left_ankle"),
    ("pelvis", "spine", "thorax", "nose", "head"),
    ("thorax", "left_shoulder", "left_elbow", "left_wrist"),
    ("thorax", "right_shoulder", "right_elbow", "right_wrist"),
)


BONES = np.array([(_INDEX[a], _INDEX[b]) for c in _CHAINS for a, b in pairwise(c)])
"""Shape (16, 2): parent and child of every bone, parents first."""
_UPPER_BODY = [7, 8, 9, 10, 11, 12, 13, 14, 15, 16]

_LIFT_JOINTS = {
    # column: joints of a lifting trial whose mean it is
    1: ("hip_R",),
    2: ("knee_R",),
    3: ("ankle_R",),
    4: ("hip_L",),
    5: ("knee_L",),
    6: ("ankle_L",),
    9: ("nose",),
    11: ("shoulder_L",),
    12: ("elbow_L",),
    13: ("wrist_L",),
    14: ("shoulder_R",),
    15: ("elbow_R",),
    16: ("wrist_R",),
}


@dataclass(frozen=True, eq=False)
class Clip:
    """One movement.

    Parameters
    ----------
    name, subject, source
        Where it comes from.
    position
        Shape (T, 17, 3), m, Z up.
    split
        `train`, `val` or `test`, by person.
    weight
        How often its windows are drawn, relative to others.
    """

    name: str
    subject: str
    source: str
    position: Floats = field(repr=False)
    split: str = "train"
    weight: float = 1.0


def read_mocap(path: Path, split: str) -> list[Clip]:
    """Read the clips of one split of the motion-capture corpus.

    Clips in which people bend are drawn four times as often as others.

    Raises
    ------
    DataError
        If the file is not that corpus, or has no such split.
    """
    with np.load(path, allow_pickle=False) as data:
        arrays = {key: data[key] for key in data.files}
    if missing := {"pose", "root", "start", "length", "split"} - set(arrays):
        raise DataError(f"{path} is no motion-capture corpus: it lacks {', '.join(missing)}.")
    clips = []
    for row in np.flatnonzero(arrays["split"] == split):
        part = slice(arrays["start"][row], arrays["start"][row] + arrays["length"][row])
        position = arrays["pose"][part].astype(np.float32) + arrays["root"][part, None]
        clips.append(
            Clip(
                name=str(arrays["name"][row]),
                subject=str(arrays["subject"][row]),
                source="mocap",
                position=position,
                split=split,
                weight=4.0 if arrays["bending"][row] else 1.0,
            )
        )
    if not clips:
        raise DataError(f"{path} has no clips in the split {split!r}; use train, val or test.")
    return clips


def read_lifts(folder: Path, persons: tuple[str, ...] = TRAINING_PERSONS) -> list[Clip]:
    """Read the true joints of the synthetic lifting trials of some persons.

    Raises
    ------
    DataError
        If there are none.
    """
    clips = []
    for person in persons:
        for truth in sorted((folder / person).glob("*/truth.npz")):
            x, y, z = np.moveaxis(read_lift_joints(truth), -1, 0)
            # X forward, Y up, Z right becomes X forward, Y left, Z up.
            position = np.stack([x, -z, y], axis=-1)
            clips.append(
                Clip(
                    name=truth.parent.name,
                    subject=person,
                    source="lifts",
                    position=position,
                    split="test" if person in TEST_PERSONS else "train",
                    weight=2.0,
                )
            )
    if not clips:
        raise DataError(f"{folder} holds no lifting trials of {', '.join(persons)}.")
    return clips


def read_lift_joints(truth: Path, *, at_s: NDArray[np.float64] | None = None) -> Floats:
    """Read the 17 joints of one lifting trial, in its own axes (X forward, Y up), m.

    Parameters
    ----------
    truth
        The trial's `truth.npz`.
    at_s
        Times wanted; by default every 1/30 s.

    Returns
    -------
    array
        Shape (T, 17, 3).
    """
    with np.load(truth, allow_pickle=False) as data:
        names, joints = list(data["joint_names"]), data["joints"]
        markers, marker_names = data["markers"], list(data["marker_names"])
        time_s = data["time"]
    out = np.full((len(joints), 17, 3), np.nan)
    for column, parts in _LIFT_JOINTS.items():
        out[:, column] = np.mean([joints[:, names.index(p)] for p in parts], axis=0)
    out[:, 10] = markers[:, marker_names.index("HTOP")]
    out[:, 0] = out[:, [1, 4]].mean(axis=1)
    out[:, 8] = out[:, [11, 14]].mean(axis=1)
    out[:, 7] = 0.5 * (out[:, 0] + out[:, 8])
    at = np.arange(time_s[0], time_s[-1], 1.0 / RATE_HZ) if at_s is None else at_s
    rows = np.clip(np.searchsorted(time_s, at), 0, len(joints) - 1)
    return np.asarray(out[rows], dtype=np.float32)


def vary_windows(
    position: Floats64, may_turn: NDArray[np.bool_], rng: np.random.Generator
) -> Floats64:
    """Vary windows: mirrored or not, other bone lengths, and a twisted or bent trunk.

    The corpora hold few asymmetric lifts; turning the upper body about the trunk while the feet
    stay makes some.

    Parameters
    ----------
    position
        Shape (B, T, 17, 3), m, Z up.
    may_turn
        Shape (B,), whose trunk is always turned; that of the others in three of ten windows.
    rng
        Source of randomness.

    Returns
    -------
    array
        Shape (B, T, 17, 3).
    """
    mirrored = position[:, :, MIRRORED] * np.array([1.0, -1.0, 1.0])
    swap = rng.random(len(position)) < 0.5
    position = np.where(swap[:, None, None, None], mirrored, position)
    position = _resize_bones(position, rng)
    turned = _turn_trunk(position, rng)
    is_turned = may_turn | (rng.random(len(position)) < 0.3)
    return np.where(is_turned[:, None, None, None], turned, position)


def _resize_bones(position: Floats64, rng: np.random.Generator) -> Floats64:
    """Change segment lengths by some per cent, left and right alike."""
    scale = np.exp(rng.normal(0.0, 0.04, (len(position), 17)))
    scale = 0.5 * (scale + scale[:, MIRRORED])
    out = position.copy()
    for parent, child in BONES:
        bone = position[:, :, child] - position[:, :, parent]
        out[:, :, child] = out[:, :, parent] + scale[:, None, child, None] * bone
    return _set_middles(out)


def _set_middles(position: Floats64) -> Floats64:
    """Put thorax and spine back into the middle, in place."""
    position[:, :, 8] = 0.5 * (position[:, :, 11] + position[:, :, 14])
    position[:, :, 7] = 0.5 * (position[:, :, 0] + position[:, :, 8])
    return position


def _turn_trunk(position: Floats64, rng: np.random.Generator) -> Floats64:
    """Twist the upper body about the trunk's line and bend it sideways, slowly over the window."""
    share = np.linspace(0.0, 1.0, position.shape[1])
    ends = np.radians(rng.normal(0.0, [[20.0], [8.0]], (len(position), 2, 2)))
    twist, bend = (ends[:, i, :1] * (1 - share) + ends[:, i, 1:] * share for i in (0, 1))
    root = position[:, :, :1]
    trunk = _unit(position[:, :, 8] - position[:, :, 0])
    forward = _unit(np.cross(position[:, :, 4] - position[:, :, 1], trunk))
    out = position.copy()
    upper = out[:, :, _UPPER_BODY] - root
    out[:, :, _UPPER_BODY] = root + _rotate(_rotate(upper, trunk, twist), forward, bend)
    return out


def _unit(vector: Floats64) -> Floats64:
    return np.asarray(vector / np.maximum(np.linalg.norm(vector, axis=-1, keepdims=True), 1e-6))


def _rotate(points: Floats64, axis: Floats64, angle: Floats64) -> Floats64:
    """Rotate (B, T, K, 3) points about one unit axis a frame (Rodrigues)."""
    k = np.broadcast_to(axis[:, :, None], points.shape)
    c, s = np.cos(angle)[..., None, None], np.sin(angle)[..., None, None]
    along = np.sum(k * points, axis=-1, keepdims=True)
    return np.asarray(points * c + np.cross(k, points) * s + k * along * (1.0 - c))
