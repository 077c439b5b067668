"""First guesses of how the second camera stands to the first.

Two sources that fail in different ways: the essential matrix of the joints' pictures, sharp but
blind to which of two mirrored worlds is true when the person is far away; and the metric landmarks
of each view, coarse but never mirrored.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import pairwise

import cv2
import numpy as np

from engine.cameras._bundle import rotation_from
from engine.cameras._person import Evidence, column, shared_joints
from engine.cameras.monocular import SEGMENT_SUM
from engine.datatypes import Array

__all__ = ["Start", "body_in_camera", "list_starts"]

TWISTS_DEG = (-25.0, 25.0)
RANSAC_SHARE = 0.01
"""Distance from the epipolar line that still fits, as a share of the person's height."""


@dataclass(frozen=True, eq=False)
class Start:
    """Second camera relative to the first (m), and the joints (F, J, 3) in the first's axes."""

    name: str
    rotation: Array
    translation: Array
    points: Array


def body_in_camera(evidence: Evidence, matrices: Array, stature_m: float) -> tuple[Array, Array]:
    """Place each view's metric landmarks before its camera.

    Parameters
    ----------
    evidence
        With body landmarks in the axes of each crop.
    matrices
        Shape (2, 3, 3), px.
    stature_m
        Gives the landmarks their size.

    Returns
    -------
    Array
        Shape (2, F, J, 3): the landmarks around the mid-hip, in the camera's axes, m.
    Array
        Shape (2, F, 3): the mid-hip in the camera's axes, m.
    """
    body, middle = [], []
    for v, metric in enumerate(evidence.body):
        rays = _rays(evidence.pixels[v], matrices[v])
        pelvis = rays[:, _HIPS].mean(axis=1)
        if not np.isfinite(metric).any():
            # Without landmarks the person is as far away as the stature looks small.
            body.append(np.full(metric.shape, np.nan))
            middle.append(pelvis * stature_m * matrices[v, 1, 1] / evidence.height_px[v])
            continue
        turned = _turn_to_camera(metric, pelvis) * _body_scale(metric, stature_m)
        flat = turned[..., :2] - turned[:, _HIPS, :2].mean(axis=1, keepdims=True)
        seen = rays[..., :2] - pelvis[:, None, :2]
        size = np.sqrt(np.nansum(flat**2, axis=(1, 2)) / np.nansum(seen**2, axis=(1, 2)))
        body.append(turned)
        middle.append(pelvis * size[:, None])
    return np.stack(body), np.stack(middle)


_HIPS = [column("left_hip"), column("right_hip")]
_LIMBS = ("shoulder", "hip", "knee", "ankle")


def _rays(pixels: Array, matrix: Array) -> Array:
    rays = np.ones((*pixels.shape[:-1], 3))
    rays[..., :2] = (pixels - matrix[:2, 2]) / matrix[[0, 1], [0, 1]]
    return rays


def _turn_to_camera(metric: Array, pelvis: Array) -> Array:
    """Turn landmarks from a crop's line of sight to the camera's axes."""
    forward = pelvis / np.linalg.norm(pelvis, axis=1, keepdims=True)
    right = np.cross([0.0, 1.0, 0.0], forward)
    right /= np.linalg.norm(right, axis=1, keepdims=True)
    axes = np.stack([right, np.cross(forward, right), forward], axis=2)
    return np.asarray(np.einsum("tij,tkj->tki", axes, metric))


def _body_scale(metric: Array, stature_m: float) -> float:
    """Return metres per unit of body landmarks, from the lengths of leg and trunk."""
    total = np.zeros(len(metric))
    for side in ("left", "right"):
        chain = [metric[:, column(f"{side}_{n}")] for n in _LIMBS]
        for a, b in pairwise(chain):
            total += 0.5 * np.linalg.norm(a - b, axis=1)
    known = total[np.isfinite(total) & (total > 0)]
    return SEGMENT_SUM * stature_m / float(np.median(known)) if known.size else 1.0


def list_starts(evidence: Evidence, matrices: Array, body: Array, middle: Array) -> Iterator[Start]:
    """List first guesses, the likeliest first.

    Parameters
    ----------
    evidence
        Of the chosen frames.
    matrices
        Shape (2, 3, 3), px.
    body, middle
        From `body_in_camera`.
    """
    if np.isfinite(body).any():
        rotation = _rotate_landmarks(body, evidence)
        yield _from_rotation("landmarks", rotation, body, middle)
    yield from _from_essential(evidence, matrices, body, middle)
    if np.isfinite(body).any():
        # The landmarks' turn about the vertical is their weakest side.
        for twist in TWISTS_DEG:
            turned = rotation_from(np.array([0.0, np.radians(twist), 0.0])) @ rotation
            yield _from_rotation(f"landmarks {twist:+.0f} deg", turned, body, middle)


def _rotate_landmarks(body: Array, evidence: Evidence) -> Array:
    """Return the rotation that takes all frames' landmarks of view 1 to those of view 2."""
    known = np.isfinite(body).all(axis=(0, 3))
    weight = np.where(known, evidence.confidence.min(axis=0), 0.0)
    first, second = np.nan_to_num(body)
    robust = np.ones_like(weight)
    rotation = np.eye(3)
    for _ in range(6):
        spread = np.einsum("tj,tja,tjb->ab", weight * robust, second, first)
        u, _, vt = np.linalg.svd(spread)
        rotation = u @ np.diag([1.0, 1.0, np.linalg.det(u @ vt)]) @ vt
        miss = np.linalg.norm(second - first @ rotation.T, axis=-1)
        robust = 1.0 / np.maximum(miss, 0.05)
    return np.asarray(rotation)


def _from_rotation(name: str, rotation: Array, body: Array, middle: Array) -> Start:
    translation = np.nanmedian(middle[1] - middle[0] @ rotation.T, axis=0)
    first = body[0] + middle[0][:, None]
    second = (body[1] + middle[1][:, None] - translation) @ rotation
    return Start(name, rotation, translation, _fill(0.5 * (first + second)))


def _fill(points: Array) -> Array:
    """Put missing joints at the middle of the frame's others; the bundle pulls them to place."""
    middle = np.nanmean(points, axis=1, keepdims=True)
    return np.where(np.isfinite(points), points, middle)


def _from_essential(
    evidence: Evidence, matrices: Array, body: Array, middle: Array
) -> Iterator[Start]:
    """Guess from the essential matrix (five points, RANSAC) of confident joints."""
    chosen = shared_joints(evidence, confidence=0.5)
    if chosen.sum() < 30:
        return
    first, second = (_rays(evidence.pixels[v], matrices[v])[chosen][:, :2] for v in (0, 1))
    limit = RANSAC_SHARE * float(np.mean(evidence.height_px / matrices[:, 0, 0]))
    essential, _ = cv2.findEssentialMat(
        first, second, np.eye(3), method=cv2.RANSAC, prob=0.999, threshold=limit
    )
    if essential is None or essential.shape != (3, 3):
        return
    _, rotation, direction, _ = cv2.recoverPose(essential, first, second, np.eye(3))
    yield from _scale_essential(
        np.asarray(rotation, dtype=np.float64),
        np.asarray(direction[:, 0], dtype=np.float64),
        evidence,
        matrices,
        body,
        middle,
    )


def _scale_essential(
    rotation: Array,
    direction: Array,
    evidence: Evidence,
    matrices: Array,
    body: Array,
    middle: Array,
) -> Iterator[Start]:
    """Give the baseline a length: that which puts the mid-hip as far away as it looks."""
    pixels = np.nan_to_num(evidence.pixels)
    rays = [_rays(pixels[v], matrices[v]) for v in (0, 1)]
    points = _meet(rays[0], rays[1] @ rotation, -direction @ rotation)
    hips = points[:, _HIPS].mean(axis=1)
    ratio = np.median(np.linalg.norm(middle[0], axis=1) / np.linalg.norm(hips, axis=1))
    if not np.isfinite(ratio):
        return
    points = points * ratio
    shape = body[0] + middle[0][:, None]
    is_far = np.linalg.norm(points - shape, axis=-1, keepdims=True) > 0.6
    points = np.where(is_far & np.isfinite(shape), shape, points)
    yield Start("essential matrix", rotation, ratio * direction, _fill(points))


def _meet(first: Array, second: Array, centre: Array) -> Array:
    """Return the middle of the shortest segment between rays from the origin and from `centre`."""
    a, b = (first**2).sum(-1), (second**2).sum(-1)
    c = (first * second).sum(-1)
    d, e = first @ centre, second @ centre
    bottom = np.maximum(a * b - c * c, 1e-9)
    near, far = (b * d - c * e) / bottom, (c * d - a * e) / bottom
    return np.asarray(0.5 * (first * near[..., None] + centre + second * far[..., None]))
