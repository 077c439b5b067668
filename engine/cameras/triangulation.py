"""Joints in metres from calibrated and synchronised views.

Every joint is first put where its lines of sight agree best, each view counting as much as it
deserves. Two views alone leave a joint that one of them hides to chance, so the body then
has its say: links keep their length, and each view's own idea of depth holds softly. A well seen
joint hardly moves by this; one that only one view shows, or that one view shows in a wrong
place, comes to lie where a body can be. Every joint carries its covariance.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2

from engine.cameras._body import (
    BodyTask,
    attach_points,
    body_columns,
    measure_links,
    picture_terms,
    solve_joints,
)
from engine.cameras._labels import exchange, find_labels
from engine.cameras._sight import Sight, collect_sight, compute_flat_sigma
from engine.datatypes import (
    ASSUMED_STATURE_M,
    Array,
    Camera,
    PoseTrack,
    Status,
    ViewPose,
    _FrozenArrays,
    _require_shape,
)
from engine.optics import camera_centre, normalise_points, project, to_camera_axes

__all__ = ["Triangulation", "triangulate", "triangulate_points"]

Mask = NDArray[np.bool_]

NEWTON_STEPS = 5
CONVERGED_M = 1e-4
LONGEST_STEP_M = 0.5
LOOSE_SIGMA_M = 100.0
"""Keeps points on parallel lines of sight finite, with an error that says how little is known."""
MISS_PROBABILITY = 0.9999
"""Lines of sight that miss each other by more than this share ever do are not averaged."""
VIEW_PROBABILITY = 0.999
"""A view is left out that is further from where the body expects the joint."""
HINT_SIGMA_M = 0.03
HINT_SPEED_M_S = 0.6
HINT_REACH_S = 0.3
"""How well a joint is known from its neighbours in time: at once, and per second of distance."""
LARGEST_SIGMA_M = 0.35
"""Beyond this a joint counts as missing: it could be anywhere on the body."""

DEFINITION_SHARE: Mapping[str, float] = {
    "hip": 0.024,
    "shoulder": 0.016,
    "elbow": 0.008,
    "wrist": 0.006,
    "knee": 0.009,
    "ankle": 0.008,
}
"""How far the point an estimator means lies from the joint's centre, as a share of stature
per axis; two views agree on the wrong point, so this does not shrink."""
OTHER_DEFINITION_SHARE = 0.012


@dataclass(frozen=True, eq=False)
class Triangulation(_FrozenArrays):
    """Keypoints in the world of the calibration.

    Parameters
    ----------
    track
        World metres; sigma is the root mean square over the axes. A sample is `repaired` where
        its sides were exchanged or one view was left out as wrong, and `filled` where
        only one view shows it, so that its depth comes from the body.
    covariance
        Shape (T, K, 3, 3), m2; NaN where missing.
    reprojection_px
        Shape (V, T, K): distance of what each view shows from the point, px, under the labels
        used; NaN where the view shows nothing. Views left out are included.
    n_views
        Shape (T, K): how many views the point rests on.
    """

    track: PoseTrack
    covariance: Array
    reprojection_px: Array
    n_views: NDArray[np.uint8]

    def __post_init__(self) -> None:
        samples = self.track.position.shape[:2]
        covariance = self._freeze("covariance", self.covariance)
        _require_shape("covariance", covariance, (*samples, 3, 3))
        distance = self._freeze("reprojection_px", self.reprojection_px)
        _require_shape("reprojection_px", distance, (len(distance), *samples))
        _require_shape("n_views", self._freeze("n_views", self.n_views, np.uint8), samples)


def triangulate(
    views: Sequence[ViewPose],
    cameras: Sequence[Camera],
    *,
    stature_m: float = ASSUMED_STATURE_M,
    rotation_sigma_deg: float = 0.0,
    translation_sigma_m: float = 0.0,
    is_weighted: bool = True,
    repair_labels: bool = True,
    use_body: bool = True,
) -> Triangulation:
    """Find the keypoints of synchronised views in the world.

    Parameters
    ----------
    views
        Two or more, at the same times. Their order is that of the cameras.
    cameras
        Calibrated for the pictures' size, lens distortion included.
    stature_m
        Size of the person: keypoint errors and unseen links are shares of it.
    rotation_sigma_deg, translation_sigma_m
        Standard errors of the cameras relative to each other; NaN counts as none.
    is_weighted
        Whether views count by confidence, kind of keypoint and the side that the body hides.
    repair_labels
        Whether left and right are exchanged back where one of two views mixes them up.
    use_body
        Whether link lengths and the estimator's landmarks help; without them a joint that one
        view only shows is missing.

    Returns
    -------
    Triangulation
        In the world of the cameras.

    Raises
    ------
    DataError
        If the views differ in times or skeleton, or are fewer than two.
    CalibrationError
        If the cameras don't fit the views in number or picture size.
    """
    sight = collect_sight(views, cameras)
    noise = _Noise(
        stature_m=stature_m,
        rotation_rad=float(np.radians(np.nan_to_num(rotation_sigma_deg))),
        translation_m=float(np.nan_to_num(translation_sigma_m)),
        is_weighted=is_weighted,
    )
    sigma = noise.compute(cameras, sight)
    is_exchanged = np.zeros(sight.confidence.shape, dtype=bool)
    if repair_labels and len(views) == 2:
        is_exchanged = find_labels(sight, sigma, _PointFinder(cameras))
        if is_exchanged.any():
            sight = exchange(sight, is_exchanged)
            sigma = noise.compute(cameras, sight)
    if use_body:
        time_s = np.asarray(views[0].image.time_s)
        found = _find_with_body(cameras, sight, sigma, time_s, stature_m)
    else:
        points, covariance, _ = _triangulate(cameras, sight.flat, sigma)
        found = _Found(points, covariance, sight.is_seen)
    return _describe(views, cameras, sight, found, is_exchanged, stature_m)


@dataclass(frozen=True)
class _Noise:
    """What the samples' standard errors depend on besides the samples."""

    stature_m: float
    rotation_rad: float
    translation_m: float
    is_weighted: bool

    def compute(self, cameras: Sequence[Camera], sight: Sight) -> Array:
        """Return the standard errors at unit depth, shape (V, T, K)."""
        points = _start_points(cameras, sight.flat, np.ones(sight.confidence.shape))
        sigma = compute_flat_sigma(
            cameras, sight, points, stature_m=self.stature_m, is_weighted=self.is_weighted
        )
        for v, camera in enumerate(cameras):
            # Each camera takes its half of the error between them.
            depth = np.nanmedian(np.append(to_camera_axes(camera, points)[..., 2], 1.0))
            turned = np.hypot(self.rotation_rad, self.translation_m / max(depth, 0.1))
            sigma[v] = np.hypot(sigma[v], turned / np.sqrt(2.0))
        return sigma


@dataclass(frozen=True, eq=False)
class _Found:
    """Points (T, K, 3), covariances (T, K, 3, 3) and which samples (V, T, K) they rest on."""

    points: Array
    covariance: Array
    is_used: Mask


@dataclass(frozen=True)
class _PointFinder:
    cameras: Sequence[Camera]

    def __call__(self, flat: Array, sigma: Array) -> tuple[Array, Array]:
        points, _, miss = _triangulate(self.cameras, flat, sigma)
        return points, miss


def triangulate_points(
    cameras: Sequence[Camera], pixels: Array, sigma_px: Array
) -> tuple[Array, Array, Array]:
    """Find the points that the pictures tell best, each by itself.

    A linear start, then Gauss-Newton on the weighted distances in the undistorted pictures.

    Parameters
    ----------
    cameras
        V cameras.
    pixels, sigma_px
        Shape (V, ..., 2) and (V, ...), px; NaN where a view does not show the point.

    Returns
    -------
    points, covariance, miss
        Shape (..., 3), (..., 3, 3), (...): m, m2, and the sum of squared distances in units
        of their standard errors. NaN where fewer than two views show the point, or it would lie
        behind a camera.
    """
    flat = np.stack([normalise_points(c, pixels[v]) for v, c in enumerate(cameras)])
    focal = np.array([np.sqrt(c.matrix[0, 0] * c.matrix[1, 1]) for c in cameras])
    return _triangulate(cameras, flat, sigma_px / focal.reshape(-1, *[1] * (sigma_px.ndim - 1)))


def _triangulate(
    cameras: Sequence[Camera], flat: Array, sigma: Array
) -> tuple[Array, Array, Array]:
    points = _start_points(cameras, flat, sigma)
    for _ in range(NEWTON_STEPS):
        normal, right, _ = picture_terms(cameras, flat, sigma, points)
        step = np.linalg.solve(_loosely(normal), right[..., None])[..., 0]
        length = np.linalg.norm(step, axis=-1, keepdims=True)
        points = points + step * np.minimum(1.0, LONGEST_STEP_M / np.maximum(length, 1e-12))
        if not np.nanmax(length, initial=0.0) > CONVERGED_M:
            break
    normal, _, miss = picture_terms(cameras, flat, sigma, points)
    is_known = _is_before_all(cameras, flat, points)
    covariance = np.where(is_known[..., None, None], np.linalg.inv(_loosely(normal)), np.nan)
    return (
        np.where(is_known[..., None], points, np.nan),
        covariance,
        np.where(is_known, miss, np.nan),
    )


def _loosely(normal: Array) -> Array:
    return np.asarray(normal + LOOSE_SIGMA_M**-2 * np.eye(3))


def _start_points(cameras: Sequence[Camera], flat: Array, sigma: Array) -> Array:
    """Return the points nearest to their lines of sight; NaN with fewer than two of them."""
    normal = np.zeros((*flat.shape[1:-1], 3, 3))
    right = np.zeros((*flat.shape[1:-1], 3))
    n_lines = np.zeros(flat.shape[1:-1], dtype=int)
    for v, camera in enumerate(cameras):
        way = _directions(camera, flat[v])
        is_known = np.asarray(np.isfinite(way).all(axis=-1))
        way = np.where(is_known[..., None], way, 0.0)
        # What is left of a vector without its part along the line of sight.
        across = is_known[..., None, None] * np.eye(3) - way[..., :, None] * way[..., None, :]
        across = across / np.where(is_known, sigma[v], 1.0)[..., None, None] ** 2
        normal += across
        right += across @ camera_centre(camera)
        n_lines += is_known
    normal += 1e-9 * np.trace(normal, axis1=-2, axis2=-1)[..., None, None] * np.eye(3)
    is_enough = n_lines >= 2
    normal = np.where(is_enough[..., None, None], normal, np.eye(3))
    points = np.linalg.solve(normal, right[..., None])[..., 0]
    return np.where(is_enough[..., None], points, np.nan)


def _directions(camera: Camera, flat: Array) -> Array:
    """Return unit directions in the world of lines of sight (..., 2) at unit depth."""
    ray = np.concatenate([flat, np.ones((*flat.shape[:-1], 1))], axis=-1) @ camera.rotation
    return np.asarray(ray / np.linalg.norm(ray, axis=-1, keepdims=True))


def _is_before_all(cameras: Sequence[Camera], flat: Array, points: Array) -> Mask:
    """Return whether points are finite and before every camera that shows them."""
    is_before = np.isfinite(points).all(axis=-1)
    for v, camera in enumerate(cameras):
        is_seen = np.isfinite(flat[v]).all(axis=-1)
        is_before &= ~is_seen | (to_camera_axes(camera, points)[..., 2] > 0)
    return np.asarray(is_before)


def _find_with_body(
    cameras: Sequence[Camera], sight: Sight, sigma: Array, time_s: Array, stature_m: float
) -> _Found:
    points, covariance, miss = _triangulate(cameras, sight.flat, sigma)
    n_free = 2 * sight.is_seen.sum(axis=0) - 3
    limit = chi2.ppf(MISS_PROBABILITY, np.maximum(n_free, 1))
    is_doubtful = np.asarray(np.nan_to_num(miss) > limit) & np.isfinite(miss)
    sure = np.where(is_doubtful[..., None], np.nan, points)
    task = BodyTask(
        cameras=cameras,
        sight=sight,
        sigma=sigma,
        start=_fill_start(cameras, sight, sure, time_s),
        links=measure_links(sure, covariance, sight.skeleton, stature_m=stature_m),
        depth_scale=_measure_depth_scale(sight, sure, covariance),
        hint=points,
        hint_sigma=np.full(miss.shape, np.inf),
    )
    is_wrong = np.zeros(sight.confidence.shape, dtype=bool)
    if is_doubtful.any():
        is_wrong = _find_wrong_views(task, sure, is_doubtful, time_s)
        task = replace(task, sight=sight.without(is_wrong))
    return _solve_all(task)


def _solve_all(task: BodyTask) -> _Found:
    """Return all keypoints, those of the body first and the rest relative to them."""
    body = body_columns(task.sight.skeleton)
    rest = [k for k in range(task.start.shape[1]) if k not in body]
    points = np.full(task.start.shape, np.nan)
    covariance = np.full((*task.start.shape, 3), np.nan)
    joints, joint_covariance = solve_joints(task)
    points[:, body], covariance[:, body] = joints, joint_covariance
    if rest:
        points[:, rest], covariance[:, rest] = attach_points(task, joints, joint_covariance, rest)
    return _Found(points, covariance, task.sight.is_seen)


def _find_wrong_views(task: BodyTask, sure: Array, is_doubtful: Mask, time_s: Array) -> Mask:
    """Return the samples (V, T, K) of doubtful points that the rest of the body speaks against.

    The doubtful points are left out of all views; what their neighbours on the body and in time
    say of them is then compared with each view.
    """
    hint, hint_sigma = _interpolate(sure, time_s)
    blind = replace(
        task,
        sight=task.sight.without(np.broadcast_to(is_doubtful, task.sight.confidence.shape)),
        hint=hint,
        hint_sigma=np.where(is_doubtful, hint_sigma, np.inf),
    )
    frames = np.flatnonzero(is_doubtful.any(axis=1))
    expected = _solve_all(blind.cut(frames))
    is_wrong = np.zeros(task.sight.confidence.shape, dtype=bool)
    limit = float(chi2.ppf(VIEW_PROBABILITY, 2))
    for v, camera in enumerate(task.cameras):
        distance = _squared_distance(
            camera,
            task.sight.flat[v][frames],
            task.sigma[v][frames],
            expected.points,
            expected.covariance,
        )
        is_far = np.nan_to_num(distance, nan=np.inf) > limit
        is_wrong[v, frames] = is_doubtful[frames] & is_far
    return is_wrong


def _squared_distance(
    camera: Camera, flat: Array, sigma: Array, points: Array, covariance: Array
) -> Array:
    """Return how far a view lies from where points are expected, in squared standard errors."""
    seen = to_camera_axes(camera, points)
    at = seen[..., :2] / seen[..., 2:]
    jacobian = camera.rotation[:2] - at[..., None] * camera.rotation[2]
    jacobian = jacobian / seen[..., 2, None, None]
    spread = jacobian @ covariance @ np.swapaxes(jacobian, -1, -2)
    spread = spread + sigma[..., None, None] ** 2 * np.eye(2)
    error = flat - at
    is_known = np.isfinite(error).all(axis=-1) & np.isfinite(spread).all(axis=(-1, -2))
    spread = np.where(is_known[..., None, None], spread, np.eye(2))
    error = np.where(is_known[..., None], error, 0.0)
    square = (error * np.linalg.solve(spread, error[..., None])[..., 0]).sum(axis=-1)
    return np.where(is_known, square, np.nan)


def _interpolate(points: Array, time_s: Array) -> tuple[Array, Array]:
    """Return each point between its neighbours in time, and its standard error (T, K), m.

    Infinite where the nearest neighbour is too far away.
    """
    filled, sigma = points.copy(), np.full(points.shape[:2], np.inf)
    for k in range(points.shape[1]):
        known = np.isfinite(points[:, k]).all(axis=1)
        if not known.any():
            continue
        known_s = time_s[known]
        for axis in range(3):
            filled[:, k, axis] = np.interp(time_s, known_s, points[known, k, axis])
        after = np.clip(np.searchsorted(known_s, time_s), 1, max(known_s.size - 1, 1))
        after = np.minimum(after, known_s.size - 1)
        nearest = np.minimum(
            np.abs(time_s - known_s[after]), np.abs(time_s - known_s[np.maximum(after - 1, 0)])
        )
        is_near = nearest <= HINT_REACH_S
        sigma[is_near, k] = HINT_SIGMA_M + HINT_SPEED_M_S * nearest[is_near]
    return filled, sigma


def _fill_start(cameras: Sequence[Camera], sight: Sight, sure: Array, time_s: Array) -> Array:
    """Return a start for every point: itself, its neighbours in time, its line, or the body."""
    start, sigma = _interpolate(sure, time_s)
    start[~np.isfinite(sigma)] = np.nan
    middle = _interpolate(_middle(sure)[:, None], time_s)[0]
    for v, camera in enumerate(cameras):
        way = _directions(camera, sight.flat[v])
        centre = camera_centre(camera)
        along = np.linalg.norm(middle - centre, axis=-1, keepdims=True)
        on_ray = centre + way * along
        start = np.where(np.isfinite(start).all(axis=-1, keepdims=True), start, on_ray)
    start = np.where(np.isfinite(start), start, middle)
    return np.where(np.isfinite(start), start, 0.0)


def _middle(points: Array) -> Array:
    """Return the median of the points of each frame (T, 3), NaN where there are none."""
    middle = np.full((len(points), 3), np.nan)
    known = np.asarray(np.isfinite(points).all(axis=2)).any(axis=1)
    middle[known] = np.nanmedian(points[known], axis=1)
    return middle


def _measure_depth_scale(sight: Sight, points: Array, covariance: Array) -> Array:
    """Return metres per unit of each view's landmarks (V,), from legs and trunk.

    One where too little is known.
    """
    skeleton = sight.skeleton
    pairs = [
        (f"{side}_{a}", f"{side}_{b}")
        for side in ("left", "right")
        for a, b in (("hip", "knee"), ("knee", "ankle"), ("shoulder", "hip"))
    ]
    a, b = (
        [skeleton.index(pair[i]) for pair in pairs if set(pair) <= set(skeleton.keypoints)]
        for i in (0, 1)
    )
    true = np.linalg.norm(points[:, a] - points[:, b], axis=-1)
    scale = np.ones(len(sight.pixels))
    for v in range(len(scale)):
        told = np.linalg.norm(sight.body[v][:, a] - sight.body[v][:, b], axis=-1)
        with np.errstate(divide="ignore", invalid="ignore"):
            ratio = true / told
        known = ratio[np.isfinite(ratio)]
        if known.size:
            scale[v] = np.clip(np.median(known), 0.5, 2.0)
    return scale


def _describe(
    views: Sequence[ViewPose],
    cameras: Sequence[Camera],
    sight: Sight,
    found: _Found,
    is_exchanged: Mask,
    stature_m: float,
) -> Triangulation:
    """Put points, errors and what was done together."""
    n_views = found.is_used.sum(axis=0)
    covariance = found.covariance + _definition_variance(sight, stature_m)[:, None, None] * np.eye(
        3
    )
    sigma = np.sqrt(np.trace(covariance, axis1=2, axis2=3) / 3.0)
    is_there = (n_views > 0) & np.isfinite(found.points).all(axis=2) & (sigma < LARGEST_SIGMA_M)
    points = np.where(is_there[..., None], found.points, np.nan)
    is_left_out = sight.is_seen & ~found.is_used
    status = np.full(n_views.shape, Status.MEASURED, dtype=np.uint8)
    status[n_views == 1] = Status.FILLED
    status[is_exchanged.any(axis=0) | is_left_out.any(axis=0)] = Status.REPAIRED
    status[~is_there] = Status.MISSING
    status[is_left_out.any(axis=0) & ~is_there] = Status.REJECTED
    confidence = np.where(found.is_used, sight.confidence, 0.0).max(axis=0)
    distance = np.stack(
        [
            np.linalg.norm(sight.pixels[v] - project(camera, points), axis=-1)
            for v, camera in enumerate(cameras)
        ]
    )
    first = views[0].image
    note = {
        "views": len(views),
        "exchanged": int(is_exchanged.sum()),
        "left_out": int(is_left_out.sum()),
        "one_view": int((is_there & (n_views == 1)).sum()),
    }
    track = PoseTrack(
        time_s=first.time_s,
        position=points,
        unit="m",
        frame_of_reference="world",
        skeleton=first.skeleton,
        confidence=np.where(is_there, confidence, np.nan),
        sigma=np.where(is_there, sigma, np.nan),
        status=status,
        provenance={**first.provenance, "triangulation": note},
    )
    return Triangulation(
        track=track,
        covariance=np.where(is_there[..., None, None], covariance, np.nan),
        reprojection_px=distance,
        n_views=np.where(is_there, n_views, 0),
    )


def _definition_variance(sight: Sight, stature_m: float) -> Array:
    parts = (n.removeprefix("left_").removeprefix("right_") for n in sight.skeleton.keypoints)
    shares = [DEFINITION_SHARE.get(part, OTHER_DEFINITION_SHARE) for part in parts]
    return np.asarray((np.array(shares) * stature_m) ** 2)
