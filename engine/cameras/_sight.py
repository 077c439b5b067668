"""What calibrated views see of one person, side by side, and how much each sample is worth."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from engine.cameras.monocular import align_with_line_of_sight
from engine.datatypes import Array, Camera, ViewPose
from engine.errors import CalibrationError, DataError
from engine.optics import camera_centre, normalise_points, to_camera_axes
from engine.skeletons import Skeleton, get_skeleton

__all__ = ["Sight", "collect_sight", "compute_flat_sigma", "find_far_side", "point_towards"]

COMMON_TIME_S = 1e-3
PIXEL_FLOOR_PX = 0.5
"""Nothing is located better, however small the person is in the picture."""
UNKNOWN_CONFIDENCE = 0.5


@dataclass(frozen=True)
class PartNoise:
    """How far a kind of keypoint lies from where it should, across the line of sight.

    `share` of stature per axis for a keypoint that is clearly seen; it grows by `far` where the
    body's own side hides it, and by `hidden` where the estimator says that it is not visible.
    """

    share: float
    far: float = 0.0
    hidden: float = 0.0


NOISE = {
    "shoulder": PartNoise(0.0080, far=1.2),
    "elbow": PartNoise(0.0075, far=0.7, hidden=1.7),
    "wrist": PartNoise(0.0055, far=2.7, hidden=1.6),
    "hip": PartNoise(0.0160, far=0.2),
    "knee": PartNoise(0.0080, far=0.3, hidden=0.2),
    "ankle": PartNoise(0.0080),
    "heel": PartNoise(0.0080, hidden=0.5),
    "big_toe": PartNoise(0.0090, far=0.5, hidden=0.5),
    "index": PartNoise(0.0075, far=2.7, hidden=1.15),
    "pinky": PartNoise(0.0075, far=2.7, hidden=1.15),
    "thumb": PartNoise(0.0075, far=2.7, hidden=1.15),
}
OTHER_NOISE = PartNoise(0.0080, far=0.5)


@dataclass(frozen=True, eq=False)
class Sight:
    """Keypoints of all views with a leading view axis; V views, T frames, K keypoints.

    Parameters
    ----------
    pixels
        Shape (V, T, K, 2), px; NaN where a view does not show the keypoint.
    flat
        Shape (V, T, K, 2): the same without camera matrix and distortion, at unit depth.
    confidence
        Shape (V, T, K), 0 to 1.
    body
        Shape (V, T, K, 3): the estimator's landmarks around the mid-hip, in the world's axes and
        the estimator's own metres; NaN where it gave none.
    """

    pixels: Array
    flat: Array
    confidence: Array
    body: Array
    skeleton: Skeleton

    @property
    def is_seen(self) -> NDArray[np.bool_]:
        """Shape (V, T, K)."""
        return np.asarray(np.isfinite(self.flat).all(axis=-1))

    def without(self, hidden: NDArray[np.bool_]) -> Sight:
        """Return the sight with the samples `hidden` (V, T, K) taken out."""
        return replace(self, flat=np.where(hidden[..., None], np.nan, self.flat))

    def cut(self, part: slice | NDArray[np.intp]) -> Sight:
        """Return some of the frames."""
        return replace(
            self,
            pixels=self.pixels[:, part],
            flat=self.flat[:, part],
            confidence=self.confidence[:, part],
            body=self.body[:, part],
        )


def collect_sight(views: Sequence[ViewPose], cameras: Sequence[Camera]) -> Sight:
    """Bring synchronised views together.

    Keypoints outside their picture are left out: an estimator guesses them.

    Raises
    ------
    DataError
        If there are fewer than two views, or they differ in times or skeleton.
    CalibrationError
        If the cameras are not as many as the views, or calibrated for pictures of another size.
    """
    _check_views(views, cameras)
    first = views[0].image
    skeleton = get_skeleton(first.skeleton)
    pixels, flat, body = [], [], []
    for view, camera in zip(views, cameras, strict=True):
        image = np.asarray(view.image.position)
        size = np.array(camera.size_px)
        is_inside = np.asarray(((image >= -0.5) & (image <= size - 0.5)).all(axis=-1))
        pixels.append(np.where(is_inside[..., None], image, np.nan))
        undistorted = normalise_points(camera, image)
        flat.append(np.where(is_inside[..., None], undistorted, np.nan))
        body.append(_body_in_world(view, camera, undistorted, skeleton))
    confidence = np.stack([np.asarray(view.image.confidence) for view in views])
    return Sight(
        pixels=np.stack(pixels),
        flat=np.stack(flat),
        confidence=np.clip(np.nan_to_num(confidence, nan=UNKNOWN_CONFIDENCE), 0.0, 1.0),
        body=np.stack(body),
        skeleton=skeleton,
    )


def _check_views(views: Sequence[ViewPose], cameras: Sequence[Camera]) -> None:
    if len(views) < 2:
        raise DataError(f"Triangulation needs two views or more, got {len(views)}.")
    if len(cameras) != len(views):
        raise CalibrationError(
            f"Every view needs its camera: got {len(views)} views and {len(cameras)} cameras; "
            "give a calibration with one camera for each video, in their order."
        )
    time_s = views[0].image.time_s
    for view in views[1:]:
        other = view.image.time_s
        if other.shape != time_s.shape or np.abs(other - time_s).max(initial=0.0) > COMMON_TIME_S:
            raise DataError(
                "The views must have the same times, but they differ; synchronise and resample "
                "them to common times first."
            )
        if view.image.skeleton != views[0].image.skeleton:
            raise DataError(
                "The views must come from one estimator, but their keypoints are "
                f"{views[0].image.skeleton} and {view.image.skeleton}."
            )
    for view, camera in zip(views, cameras, strict=True):
        if tuple(view.info.size_px) != tuple(camera.size_px):
            raise CalibrationError(
                f"Camera {camera.name!r} is calibrated for pictures of {camera.size_px[0]} x "
                f"{camera.size_px[1]} px, but {view.info.file_name} has {view.info.size_px[0]} x "
                f"{view.info.size_px[1]}; give the calibration made at that size, or adapt it."
            )


def _body_in_world(view: ViewPose, camera: Camera, flat: Array, skeleton: Skeleton) -> Array:
    if view.body is None:
        return np.full((*flat.shape[:2], 3), np.nan)
    rays = np.concatenate([flat, np.ones((*flat.shape[:-1], 1))], axis=-1)
    aligned = align_with_line_of_sight(np.asarray(view.body.position), rays, skeleton)
    return np.asarray(aligned @ camera.rotation)


def point_towards(cameras: Sequence[Camera], points: Array) -> Array:
    """Return the unit directions from each camera to points (T, K, 3), shape (V, T, K, 3)."""
    ways = np.stack([points - camera_centre(camera) for camera in cameras])
    return np.asarray(ways / np.linalg.norm(ways, axis=-1, keepdims=True))


def find_far_side(cameras: Sequence[Camera], points: Array, skeleton: Skeleton) -> Array:
    """Return how much the trunk turns each keypoint's side away from each camera.

    Parameters
    ----------
    cameras
        One per view.
    points
        Shape (T, K, 3), m.

    Returns
    -------
    Array
        Shape (V, T, K): 1 on the side that is straight behind the body, 0 on the near side, for
        keypoints of the middle and where the trunk is unknown.
    """
    towards = point_towards(cameras, points)
    shoulders = _unit(_across(points, skeleton, "shoulder"))
    hips = _unit(_across(points, skeleton, "hip"))
    far = np.zeros(towards.shape[:3])
    for k, name in enumerate(skeleton.keypoints):
        if not name.startswith(("left_", "right_")):
            continue
        is_leg = name.endswith(("hip", "knee", "ankle", "heel", "big_toe"))
        outward = (hips if is_leg else shoulders) * (1.0 if name.startswith("right_") else -1.0)
        far[:, :, k] = (towards[:, :, k] * outward).sum(axis=-1)
    return np.clip(np.nan_to_num(far), 0.0, 1.0)


def _across(points: Array, skeleton: Skeleton, part: str) -> Array:
    if not skeleton.has(f"left_{part}") or not skeleton.has(f"right_{part}"):
        return np.full((len(points), 3), np.nan)
    return skeleton.point(points, f"right_{part}") - skeleton.point(points, f"left_{part}")


def _unit(vector: Array) -> Array:
    length = np.linalg.norm(vector, axis=-1, keepdims=True)
    return np.asarray(vector / np.where(length > 1e-9, length, np.nan))


def compute_flat_sigma(
    cameras: Sequence[Camera],
    sight: Sight,
    points: Array,
    *,
    stature_m: float,
    is_weighted: bool = True,
) -> Array:
    """Return the standard errors of the keypoints in the pictures.

    An estimator's error is a share of the body as the picture shows it, so it is known in
    metres at the person and turned into an angle by the distance. (The person's box would not do:
    it shrinks when the person bends.)

    Parameters
    ----------
    cameras, sight
        The views.
    points
        Shape (T, K, 3), m: roughly where the keypoints are; NaN where unknown.
    stature_m
        Size of the person.
    is_weighted
        If not, every keypoint counts like one of the head.

    Returns
    -------
    Array
        Shape (V, T, K), per axis, at unit depth: pixels divided by the focal length.
    """
    far = find_far_side(cameras, points, sight.skeleton)
    sigma = np.empty(sight.confidence.shape)
    for v, camera in enumerate(cameras):
        depth = to_camera_axes(camera, points)[..., 2]
        # A keypoint that is not placed yet lies about as far away as the others.
        depth = np.where(depth > 0, depth, np.nan)
        depth = np.where(np.isfinite(depth), depth, _median(depth))
        focal = np.sqrt(camera.matrix[0, 0] * camera.matrix[1, 1])
        share: float | Array = OTHER_NOISE.share
        if is_weighted:
            share = _noise_shares(sight.skeleton, sight.confidence[v], far[v])
        sigma[v] = np.hypot(share * stature_m / depth, PIXEL_FLOOR_PX / focal)
    return sigma


def _noise_shares(skeleton: Skeleton, confidence: Array, far: Array) -> Array:
    share = np.empty(confidence.shape)
    for k, name in enumerate(skeleton.keypoints):
        part = name.removeprefix("left_").removeprefix("right_")
        noise = NOISE.get(part, OTHER_NOISE)
        share[:, k] = (
            noise.share
            * (1.0 + noise.far * far[:, k])
            * (1.0 + noise.hidden * (1.0 - confidence[:, k]))
        )
    return share


def _median(values: Array) -> float:
    known = values[np.isfinite(values)]
    return float(np.median(known)) if known.size else 1.0
