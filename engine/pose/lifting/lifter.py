"""Lifts what was seen of a person in a clip: 17 joints in a picture to metres."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from engine.config import CameraConfig
from engine.datatypes import Array, PoseTrack, ViewPose
from engine.errors import DataError
from engine.pose.lifting.aggregation import Aggregation, aggregate
from engine.pose.lifting.diffusion import CLAMP, sample_postures
from engine.pose.lifting.joints import (
    LIFTED_KEYPOINTS,
    attach_to_joints,
    to_h36m,
    to_h36m_confidence,
)
from engine.pose.lifting.network import LiftingNetwork
from engine.pose.lifting.normalise import prepare_points, sight_axes, stature_of
from engine.pose.lifting.windows import Samples, blend_windows, plan_windows, resample_clip
from engine.skeletons import H36M_17, MEDIAPIPE_33

__all__ = ["DiffusionLifter", "DirectLifter", "Lifter", "Windows"]

MIRRORED = np.array(H36M_17.mirror_order)
USUAL_STATURE_M = 1.7
"""The unit of a body whose size no estimator gave; the camera step brings it to the person's."""
USUAL_SIGMA = 0.02
"""Standard error of a joint per coordinate, in statures, where a network's file states none."""
AT_ONCE = 64
"""Windows that are worked on together, so that memory hardly grows with the clip."""
_FLIP = np.array([-1.0, 1.0, 1.0])


@dataclass(frozen=True, eq=False)
class Windows:
    """What a network sees.

    Parameters
    ----------
    points
        Shape (W, F, 17, 2 or 3), in the network's units.
    rays
        Shape (W, F, 17, 3), lines of sight in the axes the joints will be in, unit depth.
    confidence
        Shape (W, F, 17).
    size
        Shape (W,), the stature at unit depth.
    first
        How many windows of the clip come before these.
    """

    points: Array
    rays: Array
    confidence: Array
    size: Array
    first: int = 0


class Lifter(ABC):
    """What all lifting estimators have in common.

    Parameters
    ----------
    network
        Opened.
    hop_share
        From one window to the next, as a share of a window.
    """

    def __init__(self, network: LiftingNetwork, *, hop_share: float = 0.5) -> None:
        self.network = network
        self._hop = 1 if network.n_out == 1 else max(1, round(hop_share * network.n_frames))

    @abstractmethod
    def lift_windows(self, windows: Windows) -> tuple[Array, Array]:
        """Return joints (W, F or 1, 17, 3) in the network's units, and their spread (W, F, 17)."""

    def lift(self, pose: ViewPose, provenance: dict[str, Any]) -> ViewPose:
        """Return the pose with a body track of lifted joints.

        Parameters
        ----------
        pose
            With MediaPipe's 33 landmarks in the picture, and around the hips where they are known.
        provenance
            Of the new body track.

        Returns
        -------
        ViewPose
            The image track is the given one. The body's joints are joint centres as the
            network gives them, with its standard errors; hands, feet and face go along as
            MediaPipe has them, without. Joints that were not seen for long are NaN.

        Raises
        ------
        DataError
            If the landmarks are not MediaPipe's.
        """
        if pose.image.skeleton != MEDIAPIPE_33.name:
            raise DataError(
                f"Lifting needs MediaPipe's 33 landmarks, got {pose.image.skeleton} keypoints; "
                "choose the estimator they are from."
            )
        rays = _assumed_rays(pose)
        joints, sigma = self._lift_clip(pose, rays)
        landmarks = pose.body.position if pose.body is not None else np.full_like(rays, np.nan)
        body = attach_to_joints(joints, np.asarray(landmarks))
        errors = np.full(body.shape[:2], np.nan)
        for name in LIFTED_KEYPOINTS:
            errors[:, MEDIAPIPE_33.index(name)] = sigma[:, H36M_17.index(name)]
        track = PoseTrack(
            time_s=pose.image.time_s,
            position=body,
            unit="m",
            frame_of_reference="body",
            skeleton=MEDIAPIPE_33.name,
            confidence=pose.image.confidence,
            sigma=np.where(np.isfinite(body).all(axis=2), errors, np.nan),
            provenance=provenance,
        )
        image = replace(pose.image, provenance={**pose.image.provenance, **provenance})
        return replace(pose, image=image, body=track)

    def _lift_clip(self, pose: ViewPose, rays: Array) -> tuple[Array, Array]:
        """Return joints (T, 17, 3) in metres and the axes of BlazePose's body, and their errors."""
        time_s = np.asarray(pose.image.time_s)
        seen = to_h36m(rays)
        size, unit_m = _person_size(pose, rays)
        confidence = to_h36m_confidence(np.asarray(pose.image.confidence))
        samples = resample_clip(time_s, seen, confidence)
        joints, spread = self._lift_samples(pose, samples, np.interp(samples.time_s, time_s, size))
        joints = np.where(samples.is_known[..., None], joints, np.nan)
        joints, spread = (_at_times(samples.time_s, v, time_s) for v in (joints, spread))
        joints = np.einsum("tkj,tji->tki", joints, sight_axes(_steady(seen[:, 0])))
        return joints * (unit_m if self.network.is_ours else 1.0), self._sigma(spread) * unit_m

    def _lift_samples(self, pose: ViewPose, samples: Samples, size: Array) -> tuple[Array, Array]:
        """Return joints (N, 17, 3) in camera axes and the network's unit, and their spread."""
        plan = plan_windows(len(samples.time_s), self.network.n_frames, self._hop)
        parts = []
        for first in range(0, len(plan.rows), AT_ONCE):
            rows = plan.rows[first : first + AT_ONCE]
            windows, turned = self._make_windows(
                pose, samples.points[rows], samples.confidence[rows], size[rows], first
            )
            parts.append((*self.lift_windows(windows), turned))
        joints, spread, axes = (np.concatenate(part) for part in zip(*parts, strict=True))
        joints = np.einsum("wtkj,wij->wtki", joints - joints[:, :, :1], axes)
        if joints.shape[1] == 1:
            # Only the middle frame of each window is told; the ends of the clip repeat the nearest.
            middles = plan.rows[:, self.network.n_frames // 2]
            joints, spread = (_spread_middles(v, middles, len(size)) for v in (joints, spread))
        else:
            joints, spread = (blend_windows(plan, v, len(size)) for v in (joints, spread))
        return joints, spread

    def _make_windows(
        self, pose: ViewPose, rays: Array, confidence: Array, size: Array, first: int
    ) -> tuple[Windows, Array]:
        size = np.median(size, axis=1)
        if self.network.is_ours:
            points, axes = prepare_points(rays, size)
            turned = np.concatenate(
                [points * size[:, None, None, None], np.ones((*points.shape[:-1], 1))], axis=-1
            )
            points = np.concatenate([points, confidence[..., None]], axis=-1)
            return Windows(points, turned, confidence, size, first), axes
        width, height = pose.info.size_px
        focal = _assumed_focal_px(pose)
        pixels = rays[..., :2] * focal + [(width - 1) / 2, (height - 1) / 2]
        points = 2.0 * pixels / width - [1.0, height / width]
        axes = np.tile(np.eye(3), (len(rays), 1, 1))
        return Windows(points, rays, confidence, size, first), axes

    def _sigma(self, spread: Array) -> Array:
        """Return standard errors (T, 17) in statures."""
        usual = np.array(self.network.facts.get("sigma", [USUAL_SIGMA] * 17))
        if "spread" not in self.network.facts or not np.isfinite(spread).any():
            return np.broadcast_to(usual, spread.shape)
        # Hypotheses that differ by more than usual mean an error larger than usual.
        share = spread / np.array(self.network.facts["spread"])
        return np.asarray(usual * np.clip(share, 0.5, 3.0))


class DirectLifter(Lifter):
    """Lifts by a network that is asked once, and once for the mirrored person."""

    def lift_windows(self, windows: Windows) -> tuple[Array, Array]:
        """Return the mean of what the network says of the person and of its mirror image."""
        joints = 0.5 * (
            self.network.run(windows.points) + _mirror(self.network.run(_mirror(windows.points)))
        )
        return joints, np.full(joints.shape[:-1], np.nan)


class DiffusionLifter(Lifter):
    """Lifts by drawing several hypotheses and joining them (D3DP).

    Parameters
    ----------
    network
        A denoiser.
    hypotheses, steps
        How many postures are drawn, in how many steps each.
    seed
        Of the noise: the same clip and seed give the same joints.
    aggregation
        How the hypotheses are joined.
    hop_share
        As for `Lifter`.
    """

    def __init__(
        self,
        network: LiftingNetwork,
        *,
        hypotheses: int = 5,
        steps: int = 3,
        seed: int = 0,
        aggregation: Aggregation = "jpma",
        hop_share: float = 0.5,
    ) -> None:
        super().__init__(network, hop_share=hop_share)
        self._hypotheses, self._steps = hypotheses, steps
        self._seed, self._aggregation = seed, aggregation

    def lift_windows(self, windows: Windows) -> tuple[Array, Array]:
        """Return the joined hypotheses and how much they differ."""
        count, (n, frames) = self._hypotheses, windows.points.shape[:2]
        points = np.tile(windows.points, (count, 1, 1, 1))
        mirrored = _mirror(points)

        def denoise(noisy: Array, step: int) -> Array:
            if not self.network.is_ours:
                # The published network never saw noise beyond this (metres).
                noisy = np.clip(noisy, -CLAMP, CLAMP)
            straight = self.network.run(points, noisy, step)
            turned = self.network.run(mirrored, _mirror(noisy), step)
            return 0.5 * (straight + _mirror(turned))

        drawn = sample_postures(
            denoise,
            (count * n, frames, 17, 3),
            steps=self._steps,
            rng=np.random.default_rng([self._seed, windows.first]),
        )
        drawn = drawn.reshape(count, n, frames, 17, 3)
        size = np.broadcast_to(windows.size[:, None], (n, frames))
        return aggregate(
            drawn - drawn[..., :1, :], windows.rays, windows.confidence, size, self._aggregation
        )


def _mirror(values: Array) -> Array:
    """Mirror points or joints (..., 17, 2 or 3)."""
    return np.asarray(values[..., MIRRORED, :] * _FLIP[: values.shape[-1]])


def _assumed_focal_px(pose: ViewPose) -> float:
    half = np.radians(CameraConfig().horizontal_fov_deg) / 2
    return float(0.5 * max(pose.info.size_px) / np.tan(half))


def _assumed_rays(pose: ViewPose) -> Array:
    """Return lines of sight (T, 33, 3) through the lens that is assumed of an unknown camera.

    The turned camera and the person's size make up for most of what is wrong with that.
    """
    width, height = pose.info.size_px
    middle = np.array([(width - 1) / 2, (height - 1) / 2])
    flat = (np.asarray(pose.image.position) - middle) / _assumed_focal_px(pose)
    seen = np.isfinite(flat).all(axis=-1, keepdims=True)
    return np.where(seen, np.concatenate([flat, np.ones((*flat.shape[:2], 1))], axis=-1), np.nan)


def _person_size(pose: ViewPose, rays: Array) -> tuple[Array, float]:
    """Return the stature at unit depth (T,), and the stature in the unit of the body track.

    How large the body's landmarks look in the picture tells how far away it is, however it bends;
    without such landmarks the longest view of legs and trunk has to do.
    """
    joints = to_h36m(rays)
    # Beside the middle of the picture everything is stretched; the turned camera sees it as it is.
    joints = np.einsum("tkj,tji->tki", joints, sight_axes(_steady(joints[:, 0])))
    joints = joints / joints[..., 2:]
    if pose.body is None:
        size = float(np.nanpercentile([stature_of(j[None]) for j in joints], 95))
        return np.full(len(rays), size), USUAL_STATURE_M
    body = to_h36m(np.asarray(pose.body.position))
    stature = float(stature_of(body))
    chosen = [H36M_17.index(n) for n in H36M_17.keypoints if n in LIFTED_KEYPOINTS]
    flat, seen = body[:, chosen, :2], joints[:, chosen, :2]
    flat = flat - flat.mean(axis=1, keepdims=True)
    seen = seen - seen.mean(axis=1, keepdims=True)
    ratio = np.sqrt((seen**2).sum(axis=(1, 2)) / (flat**2).sum(axis=(1, 2)))
    return _steady(stature * ratio[:, None])[:, 0], stature


def _steady(values: Array) -> Array:
    """Bridge missing rows of (T, D) by the values before and after them."""
    known = np.flatnonzero(np.isfinite(values).all(axis=1))
    if not known.size:
        raise DataError(
            "Lifting needs keypoints of a person, but there are none in the clip; film the whole "
            "body in good light."
        )
    rows = np.arange(len(values))
    return np.stack([np.interp(rows, known, column[known]) for column in values.T], axis=1)


def _at_times(sample_s: Array, values: Array, time_s: Array) -> Array:
    """Interpolate values (N, ...) at other times; a missing neighbour in use gives NaN."""
    if len(sample_s) == 1:
        return np.repeat(values, len(time_s), axis=0)
    place = np.clip((time_s - sample_s[0]) / (sample_s[1] - sample_s[0]), 0, len(sample_s) - 1)
    low = np.minimum(np.floor(place + 1e-6).astype(int), len(sample_s) - 1)
    share = np.clip(place - low, 0.0, 1.0).reshape(-1, *[1] * (values.ndim - 1))
    high = np.minimum(low + 1, len(sample_s) - 1)
    mixed = (1 - share) * values[low] + share * values[high]
    return np.asarray(np.where(share < 1e-6, values[low], mixed))


def _spread_middles(values: Array, middles: NDArray[np.intp], count: int) -> Array:
    """Give every sample the answer of the window whose middle is nearest."""
    nearest = np.abs(np.arange(count)[:, None] - middles[None]).argmin(axis=1)
    return np.asarray(values[nearest, 0])
