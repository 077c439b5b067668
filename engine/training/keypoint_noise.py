"""How a keypoint network errs in the picture, measured and imitated.

A network's idea of a hip is no joint centre: it lies elsewhere in the body, always in about the
same direction. That part is imitated in three dimensions, in the axes of the segments that meet at
the joint, so that it is right from every side; the rest is noise in the picture. All errors are in
units of the person's stature.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from engine.training.corpus import MIRRORED
from engine.training.detected import Detected

__all__ = ["KeypointNoise", "landmark_axes", "measure_noise"]

Floats = NDArray[np.float64]

_LEFT = np.array([4, 5, 6, 11, 12, 13])
_SEGMENTS = {
    # joint: the two segments at it, each from its far to its near end (downwards to upwards)
    0: ((0, 8), (0, 8)),
    1: ((0, 8), (2, 1)),
    2: ((2, 1), (3, 2)),
    3: ((3, 2), (3, 2)),
    4: ((0, 8), (5, 4)),
    5: ((5, 4), (6, 5)),
    6: ((6, 5), (6, 5)),
    7: ((0, 8), (0, 8)),
    8: ((0, 8), (0, 8)),
    9: ((0, 8), (0, 8)),
    10: ((0, 8), (0, 8)),
    11: ((0, 8), (12, 11)),
    12: ((12, 11), (13, 12)),
    13: ((13, 12), (13, 12)),
    14: ((0, 8), (15, 14)),
    15: ((15, 14), (16, 15)),
    16: ((16, 15), (16, 15)),
}
_MEASURED = (1, 2, 3, 4, 5, 6, 11, 12, 13, 14, 15, 16)
"""Joints with an offset of their own; the others follow from them or count as noise."""


@dataclass(frozen=True)
class KeypointNoise:
    """Errors of the 17 joints, in statures.

    Parameters
    ----------
    offset
        Shape (17, 2, 3): forward, outward and up in the axes of each of the two segments that
        meet at a joint.
    bias
        Standard deviation, in the picture, of what else stays for a whole clip.
    slow, fast
        Standard deviations of the part that changes slowly (AR(1) with `memory`), and from frame
        to frame.
    memory
        Correlation of the slow part from frame to frame at 30 Hz.
    swap_rate, drop_rate
        Shares of frames with exchanged sides, and of joints that are lost.
    hidden_rate, hidden_factor
        Share of the windows with a hidden side, and by how much its noise is larger.
    """

    offset: tuple[tuple[tuple[float, ...], ...], ...]
    bias: tuple[float, ...]
    slow: tuple[float, ...]
    fast: tuple[float, ...]
    memory: float = 0.9
    swap_rate: float = 0.01
    drop_rate: float = 0.01
    hidden_rate: float = 0.5
    hidden_factor: float = 2.0

    @classmethod
    def read(cls, path: Path) -> KeypointNoise:
        """Read the values that `write` kept."""
        values: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
        values["offset"] = tuple(tuple(tuple(o) for o in joint) for joint in values["offset"])
        plain: dict[str, Any] = {
            key: tuple(value) if isinstance(value, list) else value for key, value in values.items()
        }
        return cls(**plain)

    def write(self, path: Path) -> None:
        """Write the values as JSON."""
        path.write_text(json.dumps(asdict(self)) + "\n", encoding="utf-8")

    def displace(self, joints: Floats, stature: Floats, rng: np.random.Generator) -> Floats:
        """Move joints to where the network would see them.

        Parameters
        ----------
        joints
            Shape (B, T, 17, 3), m.
        stature
            Shape (B,), m.
        rng
            Draws for every window how strong the offsets are (0.5 to 1.3 of the usual) and how this
            person's differ.

        Returns
        -------
        array
            Shape (B, T, 17, 3).
        """
        batch = len(joints)
        offset = np.array(self.offset) * rng.uniform(0.5, 1.3, (batch, 1, 1, 1))
        own = rng.normal(0.0, 1.0, offset.shape) * (np.array(self.bias) / 2)[:, None, None]
        # Both sides of a person differ from the usual alike, for the most part.
        own = 0.5 * own + 0.5 * own[:, MIRRORED] + rng.normal(0.0, 0.3, own.shape) * own
        out = joints.copy()
        for joint in _MEASURED:
            for i, axes in enumerate(landmark_axes(joints, joint)):
                away = (offset + own)[:, joint, i] * stature[:, None]
                out[:, :, joint] += np.einsum("btij,bj->bti", axes, away)
        out[:, :, 0] = 0.5 * (out[:, :, 1] + out[:, :, 4])
        out[:, :, 8] = 0.5 * (out[:, :, 11] + out[:, :, 14])
        out[:, :, 7] = 0.5 * (out[:, :, 0] + out[:, :, 8])
        return out

    def blur(self, points: Floats, size: Floats, rng: np.random.Generator) -> tuple[Floats, Floats]:
        """Disturb points in the picture.

        Parameters
        ----------
        points
            Shape (B, T, 17, 2), in any unit.
        size
            Shape (B,), the stature in that unit.
        rng
            Source of randomness.

        Returns
        -------
        tuple of array
            The disturbed points, and a confidence of each (B, T, 17) that is low on a hidden side
            and where a joint was lost.
        """
        shape = points.shape[:3]
        confidence, factor = self._hide(shape, rng)
        strength = rng.uniform(0.5, 1.5, (shape[0], 1, 1, 1)) * factor[..., None]
        bias = rng.normal(0.0, 1.0, (shape[0], 1, 17, 2)) * 0.5 * np.array(self.bias)[:, None]
        slow = _autoregressive(shape, self.memory, rng) * np.array(self.slow)[:, None]
        fast = rng.normal(0.0, 1.0, (*shape, 2)) * np.array(self.fast)[:, None]
        unit = size[:, None, None, None]
        noisy = points + unit * strength * (bias + slow + fast)
        for middle, (left, right) in ((0, (4, 1)), (8, (11, 14)), (7, (0, 8))):
            noisy[:, :, middle] = 0.5 * (noisy[:, :, left] + noisy[:, :, right])
            confidence[:, :, middle] = 0.5 * (confidence[:, :, left] + confidence[:, :, right])
        noisy = self._swap(noisy, rng)
        return self._lose(noisy, confidence, unit, rng)

    def _hide(self, shape: tuple[int, int, int], rng: np.random.Generator) -> tuple[Floats, Floats]:
        """Choose windows with a hidden side: low confidence and more noise there."""
        confidence = 1.0 - rng.uniform(0.0, 0.1, shape)
        hidden = rng.random(shape[0]) < self.hidden_rate
        doubt = rng.uniform(0.1, 0.9, (shape[0], 1, 6)) * hidden[:, None, None]
        sides = np.where((rng.random(shape[0]) < 0.5)[:, None], _LEFT, MIRRORED[_LEFT])
        doubts = np.zeros(shape)
        np.put_along_axis(doubts, np.broadcast_to(sides[:, None], (*shape[:2], 6)), doubt, axis=2)
        return confidence * (1.0 - doubts), 1.0 + (self.hidden_factor - 1.0) * doubts

    def _swap(self, points: Floats, rng: np.random.Generator) -> Floats:
        swapped = rng.random(points.shape[:2]) < self.swap_rate
        # Exchanged sides last for some frames.
        for _ in range(3):
            swapped[:, 1:] |= swapped[:, :-1] & (rng.random(swapped[:, 1:].shape) < 0.5)
        return np.where(swapped[..., None, None], points[:, :, MIRRORED], points)

    def _lose(
        self, points: Floats, confidence: Floats, unit: Floats, rng: np.random.Generator
    ) -> tuple[Floats, Floats]:
        lost = rng.random(points.shape[:3]) < self.drop_rate
        away = points + unit * rng.normal(0.0, 0.08, points.shape)
        confidence = np.where(lost, rng.uniform(0.0, 0.2, lost.shape), confidence)
        return np.where(lost[..., None], away, points), confidence


def landmark_axes(joints: Floats, joint: int) -> tuple[Floats, Floats]:
    """Return the axes of the two segments that meet at a joint.

    Parameters
    ----------
    joints
        Shape (..., 17, 3).
    joint
        Which.

    Returns
    -------
    tuple of array
        Shape (..., 3, 3) each; columns forward, outward (from the body's middle to that side) and
        up along the segment.
    """
    sign = 1.0 if joint in _LEFT else -1.0
    pair = (1, 4) if joint < 7 else (14, 11)
    to_left = joints[..., pair[1], :] - joints[..., pair[0], :]
    axes = []
    for far, near in _SEGMENTS[joint]:
        up = _unit(joints[..., near, :] - joints[..., far, :])
        forward = _unit(np.cross(to_left, up))
        axes.append(np.stack([forward, sign * np.cross(up, forward), up], axis=-1))
    return axes[0], axes[1]


def _unit(vector: Floats) -> Floats:
    return np.asarray(vector / np.maximum(np.linalg.norm(vector, axis=-1, keepdims=True), 1e-6))


def _autoregressive(shape: tuple[int, int, int], memory: float, rng: np.random.Generator) -> Floats:
    steps = rng.normal(0.0, 1.0, (*shape, 2))
    steps[:, 1:] *= np.sqrt(1.0 - memory**2)
    for t in range(1, shape[1]):
        steps[:, t] += memory * steps[:, t - 1]
    return np.asarray(steps)


def measure_noise(videos: Sequence[Detected], *, ridge: float = 0.05) -> KeypointNoise:
    """Measure the errors of seen against true points.

    Parameters
    ----------
    videos
        What was seen, and the truth.
    ridge
        Keeps the two segments' shares of an offset apart where both are nearly parallel; relative
        to the mean square of the design.

    Returns
    -------
    KeypointNoise
        Least-squares offsets, robust (median-based) noise, the same for both sides. Swaps, losses
        and hidden sides keep their defaults.
    """
    offset = np.zeros((17, 2, 3))
    biases, slow, fast = np.zeros(17), np.zeros(17), np.zeros(17)
    for joint in range(17):
        if joint not in _MEASURED:
            rows = [_rows(video, joint) for video in videos]
            offs = [off for _, off in rows]
        else:
            # Both sides together: outward is the same word for both.
            rows = [_rows(video, j) for video in videos for j in (joint, int(MIRRORED[joint]))]
            design = np.concatenate([d.reshape(-1, 6) for d, _ in rows])
            wanted = np.concatenate([off.reshape(-1) for _, off in rows])
            known = np.isfinite(wanted)
            normal = design[known].T @ design[known]
            normal += ridge * np.trace(normal) / 6 * np.eye(6)
            value = np.linalg.solve(normal, design[known].T @ wanted[known])
            offset[joint] = value.reshape(2, 3)
            offs = [off - d @ value for d, off in rows]
        middles = [np.nanmedian(off, axis=0) for off in offs]
        total = np.median([_robust_sd(o - m) for o, m in zip(offs, middles, strict=True)])
        fast[joint] = np.median([_robust_sd(np.diff(off, axis=0)) for off in offs]) / np.sqrt(2.0)
        slow[joint] = np.sqrt(max(total**2 - fast[joint] ** 2, 0.0))
        biases[joint] = np.sqrt(np.mean(np.square(middles)))
    return KeypointNoise(
        offset=tuple(tuple(_plain(o) for o in joint) for joint in offset),
        bias=_plain(biases),
        slow=_plain(slow),
        fast=_plain(fast),
    )


def _rows(video: Detected, joint: int) -> tuple[Floats, Floats]:
    """Return what moves a point per unit of offset (T, 2, 6), and how far it is off (T, 2)."""
    true = video.joints[:, joint]
    depth = true[:, 2:]
    size = video.stature_m / np.mean(video.joints[:, 0, 2])
    off = (video.rays[:, joint, :2] - true[:, :2] / depth) / size
    to_picture = np.zeros((len(true), 2, 3))
    to_picture[:, 0, 0] = to_picture[:, 1, 1] = 1.0
    to_picture[:, :, 2] = -true[:, :2] / depth
    to_picture *= (video.stature_m / depth / size)[:, :, None]
    axes = landmark_axes(video.joints, joint)
    return np.concatenate([to_picture @ a for a in axes], axis=2), off


def _robust_sd(values: Floats) -> float:
    """Return the SD from the median absolute deviation over frames and axes."""
    return float(1.4826 * np.nanmedian(np.abs(values)))


def _plain(values: Floats) -> tuple[float, ...]:
    return tuple(round(float(v), 5) for v in values)
