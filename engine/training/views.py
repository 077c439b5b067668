"""Windows of movements seen by virtual cameras: what a lifting network is trained on.

Inputs are points in the picture (`engine.pose.lifting.normalise`), outputs joints around the pelvis
in the axes of a camera that looks at the person (x right, y down, z away), in statures.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from engine.pose.lifting.normalise import prepare_points, stature_of
from engine.training.corpus import Clip, vary_windows
from engine.training.detected import Detected
from engine.training.keypoint_noise import KeypointNoise

__all__ = ["HEAD", "Batch", "project_windows", "sample_batches"]

Floats = NDArray[np.float64]

HEAD = 10
NOSE = 9
"""Keypoint networks see no top of the head: its place in the input is taken by the nose."""
SOURCE_SHARES = {"mocap": 0.5, "lifts": 0.25, "simulated": 0.25}
SIZE_JITTER = 0.06
"""Standard error (relative) with which the stature in the picture will be known."""


@dataclass(frozen=True, eq=False)
class Batch:
    """Windows to learn from.

    `points` (B, T, 17, 3): x, y in statures and confidence; `joints` (B, T, 17, 3) in statures.
    """

    points: NDArray[np.float32]
    joints: NDArray[np.float32]


def project_windows(position: Floats, rng: np.random.Generator) -> Floats:
    """See windows through ordinary cameras put anywhere sensible.

    Parameters
    ----------
    position
        Shape (B, T, 17, 3), m, Z up.
    rng
        Draws heading, distance 2.5-7 m, height 0.3-2.5 m, roll, and where the person stands in the
        picture.

    Returns
    -------
    array
        Shape (B, T, 17, 3), m, camera axes (x right, y down, z away).
    """
    batch = len(position)
    centre = position[:, :, 0].mean(axis=1)
    floor = position[..., 2].min(axis=(1, 2))
    azimuth, distance = rng.uniform(0, 2 * np.pi, batch), rng.uniform(2.5, 7.0, batch)
    eye = centre + distance[:, None] * np.stack(
        [np.cos(azimuth), np.sin(azimuth), np.zeros(batch)], axis=1
    )
    eye[:, 2] = floor + rng.uniform(0.3, 2.5, batch)
    # Nobody aims exactly at the middle of a person.
    target = centre + rng.normal(0.0, [0.3, 0.3, 0.2], (batch, 3))
    forward = _unit(target - eye)
    right = _unit(np.cross(forward, [0.0, 0.0, 1.0]))
    down = np.cross(forward, right)
    roll = np.radians(rng.normal(0.0, 2.5, batch))[:, None]
    x = np.cos(roll) * right + np.sin(roll) * down
    axes = np.stack([x, np.cross(forward, x), forward], axis=2)
    return np.asarray(np.einsum("btkj,bji->btki", position - eye[:, None, None], axes))


def _unit(vector: Floats) -> Floats:
    return np.asarray(vector / np.linalg.norm(vector, axis=-1, keepdims=True))


def sample_batches(
    clips: Sequence[Clip],
    *,
    n_frames: int,
    batch_size: int,
    noise: KeypointNoise | None,
    seed: int,
    detected: Sequence[Detected] = (),
    detected_share: float = 0.0,
    is_varied: bool | None = None,
) -> Iterator[Batch]:
    """Give batches without end.

    Parameters
    ----------
    clips
        Movements; drawn by weight and length.
    n_frames
        Frames of a window.
    batch_size
        Windows of a batch.
    noise
        How the keypoint network errs; None for true points of unvaried movements.
    seed
        Of everything random.
    detected
        Videos with what the keypoint network really saw.
    detected_share
        Their share of the windows.
    is_varied
        Whether bodies, tempo and the size in the picture vary; by default with noise only.
    """
    is_varied = noise is not None if is_varied is None else is_varied
    rng = np.random.default_rng(seed)
    clips = [clip for clip in clips if len(clip.position) >= n_frames]
    weight = _draw_weights(clips)
    n_detected = round(detected_share * batch_size)
    while True:
        chosen = rng.choice(len(clips), batch_size - n_detected, p=weight)
        parts = []
        if len(chosen):
            windows = [clips[i] for i in chosen]
            parts.append(_imitate(windows, n_frames, noise, rng, is_varied=is_varied))
        if n_detected:
            rows = rng.integers(0, len(detected), n_detected)
            parts.append(_cut_detected([detected[i] for i in rows], n_frames, rng))
        points = np.concatenate([part[0] for part in parts])
        joints = np.concatenate([part[1] for part in parts])
        points[:, :, HEAD] = points[:, :, NOSE]
        yield Batch(points.astype(np.float32), joints.astype(np.float32))


def _draw_weights(clips: Sequence[Clip]) -> Floats:
    weight = np.array([clip.weight * len(clip.position) for clip in clips])
    # Lifting is what the product is for; elsewhere the corpus decides.
    sources = np.array([clip.source for clip in clips])
    for source, share in SOURCE_SHARES.items():
        if (kind := sources == source).any():
            weight[kind] *= share / weight[kind].sum()
    return np.asarray(weight / weight.sum())


def _imitate(
    clips: Sequence[Clip],
    n_frames: int,
    noise: KeypointNoise | None,
    rng: np.random.Generator,
    *,
    is_varied: bool,
) -> tuple[Floats, Floats]:
    """Cut windows from movements and see them as the keypoint network would."""
    rows = [_choose_rows(len(clip.position), n_frames, is_varied, rng) for clip in clips]
    pairs = zip(clips, rows, strict=True)
    position = np.stack([clip.position[r].astype(np.float64) for clip, r in pairs])
    if is_varied:
        position = vary_windows(position, np.array([c.source == "lifts" for c in clips]), rng)
    seen = project_windows(position, rng)
    stature = stature_of(seen)
    size = stature / seen[:, :, 0, 2].mean(axis=1)
    points = seen if noise is None else noise.displace(seen, stature, rng)
    rays = points / np.maximum(points[..., 2:], 0.3)
    confidence = np.ones(rays.shape[:3])
    if noise is not None:
        rays[..., :2], confidence = noise.blur(rays[..., :2], size, rng)
    if is_varied:
        size = size * np.exp(rng.normal(0.0, SIZE_JITTER, len(size)))
    return _finish(rays, confidence, seen, size, stature)


def _cut_detected(
    videos: Sequence[Detected], n_frames: int, rng: np.random.Generator
) -> tuple[Floats, Floats]:
    rows = [_choose_rows(len(video.rays), n_frames, True, rng) for video in videos]
    pairs = list(zip(videos, rows, strict=True))
    joints = np.stack([v.joints[r] for v, r in pairs])
    rays = np.stack([v.rays[r] for v, r in pairs])
    confidence = np.stack([v.confidence[r] for v, r in pairs])
    stature = stature_of(joints)
    size = stature / joints[:, :, 0, 2].mean(axis=1)
    size = size * np.exp(rng.normal(0.0, SIZE_JITTER, len(size)))
    return _finish(rays, confidence, joints, size, stature)


def _choose_rows(
    length: int, n_frames: int, is_varied: bool, rng: np.random.Generator
) -> NDArray[np.intp]:
    """Choose the frames of a window; at another tempo where it is varied."""
    stride = float(np.exp(rng.normal(0.0, 0.25))) if is_varied else 1.0
    span = min(length - 1, round((n_frames - 1) * stride))
    start = rng.integers(0, length - span)
    return np.linspace(start, start + span, n_frames).round().astype(np.intp)


def _finish(
    rays: Floats, confidence: Floats, seen: Floats, size: Floats, stature: Floats
) -> tuple[Floats, Floats]:
    """Turn the camera to the person, as is done in use."""
    points, axes = prepare_points(rays, size)
    joints = np.einsum("btkj,bji->btki", seen - seen[:, :, :1], axes)
    joints = joints / stature[:, None, None, None]
    return np.concatenate([points, confidence[..., None]], axis=-1), joints
