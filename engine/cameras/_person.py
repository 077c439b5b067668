"""What two views of a moving person tell about their cameras: chosen frames, points and weights."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from engine.cameras.monocular import ANKLE_HEIGHT, EAR_HEIGHT
from engine.datatypes import Array, ViewPose
from engine.errors import CalibrationError
from engine.skeletons import get_skeleton

__all__ = [
    "CALIBRATION_JOINTS",
    "FEET",
    "LINKS",
    "LINK_KINDS",
    "Evidence",
    "choose_frames",
    "collect_evidence",
    "column",
]


def _both(*names: str) -> tuple[str, ...]:
    return tuple(f"{side}_{name}" for name in names for side in ("left", "right"))


CALIBRATION_JOINTS: tuple[str, ...] = (
    "nose",
    *_both("ear", "shoulder", "elbow", "wrist", "hip", "knee", "ankle", "heel", "big_toe"),
)
"""Keypoints that networks place well; fingers are left out."""


@dataclass(frozen=True)
class PartNoise:
    """How well a kind of keypoint is placed in a picture, as shares of the person's height.

    `frame` is the error of a clearly seen keypoint in one frame; it grows by the factor ``1 +
    hidden`` where the network is not confident at all, and by ``1 + far`` on the side of the body
    that is turned away. `steady` is how far a view sees it in the wrong place all the time.
    """

    frame: float
    steady: float
    hidden: float = 0.0
    far: float = 0.0


NOISE = {
    "nose": PartNoise(0.010, 0.025, hidden=3.0),
    "ear": PartNoise(0.008, 0.015, hidden=3.0, far=0.5),
    "shoulder": PartNoise(0.010, 0.018, hidden=3.0, far=1.0),
    "elbow": PartNoise(0.008, 0.010, hidden=2.0, far=1.0),
    "wrist": PartNoise(0.008, 0.010, hidden=2.0, far=2.0),
    "hip": PartNoise(0.014, 0.018, hidden=2.0, far=0.2),
    "knee": PartNoise(0.008, 0.009, hidden=0.5, far=0.3),
    "ankle": PartNoise(0.008, 0.009, hidden=0.2),
    "heel": PartNoise(0.008, 0.009, hidden=0.5),
    "big_toe": PartNoise(0.008, 0.009, hidden=0.5, far=0.5),
}

LINK_KINDS: tuple[tuple[str, str, str, float, float, float], ...] = (
    # first and second keypoint, which sides, share of stature, relative standard error of the
    # share, and by how much of the stature the link changes while a person moves
    ("hip", "knee", "same", 0.235, 0.06, 0.010),
    ("knee", "ankle", "same", 0.235, 0.06, 0.010),
    ("shoulder", "elbow", "same", 0.180, 0.07, 0.015),
    ("elbow", "wrist", "same", 0.150, 0.07, 0.015),
    ("shoulder", "hip", "same", 0.300, 0.06, 0.030),
    ("shoulder", "shoulder", "across", 0.225, 0.12, 0.030),
    ("hip", "hip", "across", 0.140, 0.20, 0.020),
    ("ear", "shoulder", "same", 0.150, 0.15, 0.020),
    ("ankle", "heel", "same", 0.042, 0.20, 0.010),
    ("ankle", "big_toe", "same", 0.110, 0.12, 0.010),
    ("heel", "big_toe", "same", 0.125, 0.12, 0.010),
    ("ear", "ear", "across", 0.085, 0.20, 0.010),
)
"""Shares between keypoints, not joint centres; thigh, shank, arm and trunk lie near those of
Drillis and Contini (Winter 2009). Wide errors: networks differ in where they see a joint."""


def column(name: str) -> int:
    """Return the column of a keypoint among `CALIBRATION_JOINTS`."""
    return CALIBRATION_JOINTS.index(name)


def _links() -> tuple[tuple[int, int, int], ...]:
    """Return first and second column of every link, and which kind it is."""
    rows = []
    for kind, (first, second, sides, *_) in enumerate(LINK_KINDS):
        if sides == "across":
            rows.append((column(f"left_{first}"), column(f"right_{second}"), kind))
        else:
            rows += [(column(f"{s}_{first}"), column(f"{s}_{second}"), kind) for s in _SIDES]
    return tuple(rows)


_SIDES = ("left", "right")
LINKS = _links()
FEET = tuple(column(n) for n in _both("heel", "big_toe"))
MIRROR = tuple(
    column(n.replace("left_", "#").replace("right_", "left_").replace("#", "right_"))
    for n in CALIBRATION_JOINTS
)

UPRIGHT_SPAN = 0.96
UPRIGHT_BEND_DEG = 25.0
FEWEST_UPRIGHT = 5
FAR_SIDE_M = 0.05
"""A joint that lies this much behind its partner is on the side turned away."""
PLANTED_SPEED = 0.10
"""Statures per second below which a foot counts as standing."""


@dataclass(frozen=True, eq=False)
class Evidence:
    """Keypoints of V views in F chosen frames, with their weights.

    Parameters
    ----------
    time_s
        Shape (F,).
    pixels, sigma_px
        Shape (V, F, J, 2) and (V, F, J); NaN where missing.
    confidence
        Shape (V, F, J).
    body
        Shape (V, F, J, 3), the estimator's metric landmarks around the mid-hip in the axes
        of each view's crop; NaN where there are none.
    height_px
        Shape (V,), the standing person's height in each picture.
    is_upright
        Shape (F,): the person stands straight, or stands tallest where `has_upright` is false.
    has_upright
        Whether the person was seen standing straight at all.
    is_planted
        Shape (F, 4): left heel, right heel, left and right toe stand on the floor.
    sizes_px
        Picture sizes of the views.
    """

    time_s: Array
    pixels: Array
    sigma_px: Array
    confidence: Array
    body: Array
    height_px: Array
    is_upright: NDArray[np.bool_]
    is_planted: NDArray[np.bool_]
    has_upright: bool
    sizes_px: tuple[tuple[int, int], ...]

    @property
    def n_frames(self) -> int:
        """Number of frames."""
        return int(self.time_s.size)

    def without_floor(self) -> Evidence:
        """Return the same with no foot on the floor."""
        return replace(self, is_planted=np.zeros_like(self.is_planted))

    def take(self, frames: NDArray[np.intp]) -> Evidence:
        """Return the evidence of some of the frames."""
        return Evidence(
            self.time_s[frames],
            self.pixels[:, frames],
            self.sigma_px[:, frames],
            self.confidence[:, frames],
            self.body[:, frames],
            self.height_px,
            self.is_upright[frames],
            self.is_planted[frames],
            self.has_upright,
            self.sizes_px,
        )


def collect_evidence(views: Sequence[ViewPose]) -> Evidence:
    """Gather what both views show of the joints, in every frame.

    Raises
    ------
    CalibrationError
        If the views' times differ, or the estimator has not the joints that are needed.
    """
    times = [view.image.time_s for view in views]
    for other in times[1:]:
        if other.shape != times[0].shape or not np.allclose(other, times[0], atol=1e-6):
            raise CalibrationError(
                "Both views must have the same times, but they differ; synchronise them first."
            )
    for view in views:
        skeleton = get_skeleton(view.image.skeleton)
        missing = [n for n in CALIBRATION_JOINTS if n not in skeleton.keypoints]
        if missing:
            raise CalibrationError(
                f"Calibrating from the person needs ears, heels and toes, but {skeleton.name} "
                f"tracks have no {missing[0]}; choose another estimator or another calibration."
            )
    pixels = np.stack([_columns(v, np.asarray(v.image.position)) for v in views])
    confidence = np.stack([_columns(v, np.asarray(v.image.confidence)) for v in views])
    body = np.stack(
        [
            np.full((*pixels.shape[1:3], 3), np.nan)
            if v.body is None
            else _columns(v, np.asarray(v.body.position))
            for v in views
        ]
    )
    confidence = np.nan_to_num(confidence, nan=0.5)
    height = np.array([_height_px(p) for p in pixels])
    upright = _find_upright(pixels, body)
    has_upright = int(upright.sum()) >= FEWEST_UPRIGHT
    return Evidence(
        time_s=np.asarray(times[0]),
        pixels=pixels,
        sigma_px=height[:, None, None] * _relative_noise(confidence, body),
        confidence=confidence,
        body=body,
        height_px=height,
        is_upright=upright if has_upright else _find_tallest(pixels, height),
        is_planted=_find_planted(pixels, height, times[0]),
        has_upright=has_upright,
        sizes_px=tuple(view.info.size_px for view in views),
    )


def _columns(view: ViewPose, values: Array) -> Array:
    skeleton = get_skeleton(view.image.skeleton)
    return values[:, [skeleton.index(n) for n in CALIBRATION_JOINTS]]


def part_noise() -> tuple[PartNoise, ...]:
    """Return the noise of each of `CALIBRATION_JOINTS`."""
    return tuple(NOISE[n.removeprefix("left_").removeprefix("right_")] for n in CALIBRATION_JOINTS)


def _relative_noise(confidence: Array, body: Array) -> Array:
    frame, hidden, far = (
        np.array([getattr(noise, key) for noise in part_noise()])
        for key in ("frame", "hidden", "far")
    )
    behind = np.nan_to_num(body[..., 2] - body[..., MIRROR, 2]) > FAR_SIDE_M
    doubt = 1.0 + hidden * (1.0 - np.clip(confidence, 0.0, 1.0))
    return np.asarray(frame * doubt * (1.0 + far * behind))


def _middle(values: Array, name: str) -> Array:
    return np.asarray(
        0.5 * (values[..., column(f"left_{name}"), :] + values[..., column(f"right_{name}"), :])
    )


def _span_px(pixels: Array) -> Array:
    return np.asarray(np.linalg.norm(_middle(pixels, "ear") - _middle(pixels, "ankle"), axis=-1))


def _height_px(pixels: Array) -> float:
    """Return the standing height in one picture, px; NaN if head and feet are never seen."""
    span = _span_px(pixels)
    known = span[np.isfinite(span)]
    if not known.size:
        return float("nan")
    return float(np.percentile(known, 95)) / (EAR_HEIGHT - ANKLE_HEIGHT)


def _find_upright(pixels: Array, body: Array) -> NDArray[np.bool_]:
    """Return the frames in which the person stands straight, judged in all views, shape (F,)."""
    upright = np.ones(pixels.shape[1], dtype=np.bool_)
    for image, metric in zip(pixels, body, strict=True):
        span = np.nan_to_num(_span_px(image))
        upright &= span >= UPRIGHT_SPAN * np.percentile(span, 95)
        points = metric if np.isfinite(metric).any() else image
        upright &= np.nan_to_num(_largest_bend_deg(points), nan=180.0) < UPRIGHT_BEND_DEG
    return upright


def _find_tallest(pixels: Array, height_px: Array) -> NDArray[np.bool_]:
    """Return the quarter of the frames in which head and feet are furthest apart, shape (F,)."""
    if not np.isfinite(height_px).all():
        return np.zeros(pixels.shape[1], dtype=np.bool_)
    span = np.min(
        [np.nan_to_num(_span_px(p)) / h for p, h in zip(pixels, height_px, strict=True)], axis=0
    )
    return np.asarray(span >= np.percentile(span, 75))


def _largest_bend_deg(points: Array) -> Array:
    chain = [_middle(points, n) for n in ("shoulder", "hip", "knee", "ankle")]
    parts = [b - a for a, b in pairwise(chain)]
    bends = []
    for a, b in pairwise(parts):
        length = np.linalg.norm(a, axis=-1) * np.linalg.norm(b, axis=-1)
        cosine = (a * b).sum(axis=-1) / np.where(length > 0, length, np.nan)
        bends.append(np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0))))
    return np.asarray(np.max(bends, axis=0))


def _find_planted(pixels: Array, height_px: Array, time_s: Array) -> NDArray[np.bool_]:
    """Return where heels and toes stand still in all views, shape (F, 4)."""
    feet = pixels[:, :, FEET]
    if len(time_s) < 2:
        return np.zeros((len(time_s), len(FEET)), dtype=np.bool_)
    speed = np.linalg.norm(np.gradient(feet, time_s, axis=1), axis=-1) / height_px[:, None, None]
    half = max(1, round(0.15 / float(np.median(np.diff(time_s)))))
    padded = np.pad(np.nan_to_num(speed, nan=np.inf), ((0, 0), (half, half), (0, 0)), mode="edge")
    windows = np.lib.stride_tricks.sliding_window_view(padded, 2 * half + 1, axis=1)
    return np.asarray((np.median(windows, axis=-1) < PLANTED_SPEED).all(axis=0))


def choose_frames(evidence: Evidence, count: int) -> NDArray[np.intp]:
    """Choose frames that differ: evenly along the way the pose travels, and a few upright ones.

    Parameters
    ----------
    evidence
        Of all frames.
    count
        At most how many to choose.

    Returns
    -------
    NDArray
        Increasing indices of frames in which the views share enough joints.
    """
    usable = np.flatnonzero(shared_joints(evidence).sum(axis=1) >= 10)
    if usable.size <= count:
        return usable
    relative = evidence.pixels[:, usable] / evidence.height_px[:, None, None, None]
    step = np.nan_to_num(np.linalg.norm(np.diff(relative, axis=1), axis=-1)).mean(axis=(0, 2))
    # Time counts as well, so that a pause is still looked at: a landmark wanders then too.
    way = np.concatenate([[0.0], np.cumsum(step + 0.5 * step.mean() + 1e-9)])
    wanted = np.linspace(0.0, way[-1], count - count // 6)
    chosen = usable[np.searchsorted(way, wanted).clip(max=usable.size - 1)]
    upright = usable[evidence.is_upright[usable]]
    if upright.size:
        extra = upright[np.linspace(0, upright.size - 1, count // 6).round().astype(int)]
        chosen = np.concatenate([chosen, extra])
    return np.unique(chosen)


def shared_joints(evidence: Evidence, *, confidence: float = 0.3) -> NDArray[np.bool_]:
    """Return which joints every view sees confidently, shape (F, J)."""
    seen = np.isfinite(evidence.pixels).all(axis=-1) & (evidence.confidence >= confidence)
    return np.asarray(seen.all(axis=0))
