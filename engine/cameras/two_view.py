"""Two calibrated views in the trial's world.

A calibration has a world of its own: of a board, of a room, or of the first camera. Here the
person is put into the world that all later steps expect: Y up, floor at zero, X where the person
faces when standing, origin between the feet. What the calibration does not tell (the vertical,
the floor) comes from the person.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from engine.cameras.monocular import (
    ANKLE_HEIGHT,
    EAR_HEIGHT,
    FOOT_POINT_M,
    SOLE_M,
    UprightFrames,
    find_upright_frames,
)
from engine.cameras.triangulation import Triangulation, triangulate
from engine.datatypes import (
    Array,
    Calibration,
    Camera,
    Measurement,
    PoseTrack,
    ViewPose,
    WorldScene,
)
from engine.errors import AssessmentError
from engine.optics import camera_centre
from engine.skeletons import Skeleton, get_skeleton

__all__ = ["TwoViewScene", "place_in_world", "reconstruct_two_views"]

BODY_LEAN_DEG = 2.0
BODY_LEAN_SIGMA_DEG = 2.5
"""How far forward the line from ankles to ears of a standing person leans."""
FOOT_SLOPE_SIGMA_DEG = 8.0
"""How far the line from heel to toe keypoints is off level, both feet together."""
UNKNOWN_TILT_SIGMA_DEG = 1.0
UNKNOWN_SCALE_SIGMA = 0.01
"""Standard errors of a calibration that states none."""
FLOOR_SIGMA_M = 0.015
ACROSS_HEADING_SIGMA_DEG = 4.0
FOOT_HEADING_SIGMA_DEG = 8.0
"""How far the lines across hips or shoulders, and a foot turned out or in, are off ahead."""
HEADING_SIGMA_DEG = 4.0
"""Of all of them together."""
HEADING_FRAMES = 30
SURE = 0.8
EQUAL_SHARE = 1.5
"""Up to this ratio errors along and across the first line of sight count as equal."""
HAND_DEFINITION_SHARE = 0.014
"""How far an estimator's knuckles and ankles lie from where hands hold and feet stand, as a share
of stature per axis; what lengths between hands and feet have beyond the joints' own errors."""
MEASURED_PARTS = ("wrist", "ankle", "knee", "elbow")


@dataclass(frozen=True, eq=False)
class TwoViewScene:
    """Two views in the trial's world.

    Parameters
    ----------
    found
        The keypoints with their covariances, reprojection errors and numbers of views.
    scene
        The first camera, and what is not known of the world.
    calibration
        The cameras in the trial's world; `up` is Y and the floor at zero.
    """

    found: Triangulation
    scene: WorldScene
    calibration: Calibration


def reconstruct_two_views(
    views: Sequence[ViewPose],
    calibration: Calibration,
    stature: Measurement,
    *,
    roll_sigma_deg: float = 2.0,
) -> tuple[PoseTrack, WorldScene, Calibration]:
    """Place the keypoints of two synchronised views in the world.

    Parameters
    ----------
    views, calibration
        At the same times; the cameras in the order of the views.
    stature
        Metres, with standard error. The scale is that of the calibration.
    roll_sigma_deg
        How far an ordinary camera is rolled; used only where the calibration does not tell the
        vertical.

    Returns
    -------
    PoseTrack
        World metres, with a standard error per sample (root mean square over the axes).
    WorldScene
        The first camera in the world and the errors of scale, tilt, heading and floor.
    Calibration
        The cameras in that world.

    Raises
    ------
    DataError, CalibrationError
        As `triangulate`.
    AssessmentError
        If the feet or the head are never seen.
    """
    found = triangulate(
        views,
        calibration.cameras,
        stature_m=stature.value,
        rotation_sigma_deg=calibration.rotation_sigma_deg,
        translation_sigma_m=calibration.translation_sigma_m,
    )
    placed = place_in_world(found, calibration, stature, roll_sigma_deg=roll_sigma_deg)
    return placed.found.track, placed.scene, placed.calibration


def place_in_world(
    found: Triangulation,
    calibration: Calibration,
    stature: Measurement,
    *,
    roll_sigma_deg: float = 2.0,
) -> TwoViewScene:
    """Turn triangulated keypoints and their cameras into the trial's world.

    Parameters
    ----------
    found
        In the world of `calibration`.
    calibration, stature, roll_sigma_deg
        As in `reconstruct_two_views`.

    Raises
    ------
    AssessmentError
        If the feet or the head are never seen.
    """
    skeleton = get_skeleton(found.track.skeleton)
    points = np.asarray(found.track.position)
    # In metres the person's height is the span that shows who stands upright.
    upright = find_upright_frames(points, points, skeleton)
    up = _find_up(points, upright, calibration, skeleton, roll_sigma_deg)
    floor = _find_floor(points, upright, up.direction, calibration, skeleton, stature.value)
    forward = _find_forward(points, upright, up.direction, skeleton)
    axes = np.stack([forward, up.direction, np.cross(forward, up.direction)])
    feet = _known_median(skeleton.point(points, "mid_ankle")[upright.frames])
    origin = feet + (floor.value - feet @ up.direction) * up.direction
    return _turn(found, calibration, stature, axes, origin, upright, up, floor)


@dataclass(frozen=True, eq=False)
class _Up:
    direction: Array
    sigma_deg: float
    source: str


def _find_up(
    points: Array,
    upright: UprightFrames,
    calibration: Calibration,
    skeleton: Skeleton,
    roll_sigma_deg: float,
) -> _Up:
    """Return the direction against gravity in the calibration's world.

    If the calibration does not tell it: least squares between the standing body, which is nearly
    vertical, the feet, and the cameras' horizontal axes, which are nearly level.
    """
    if np.isfinite(calibration.up).all():
        sigma = calibration.tilt_sigma_deg
        sigma = UNKNOWN_TILT_SIGMA_DEG if np.isnan(sigma) else sigma
        return _Up(_unit(np.asarray(calibration.up)), float(sigma), "calibration")
    standing = points[upright.frames]
    body = skeleton.point(standing, "mid_ear") - skeleton.point(standing, "mid_ankle")
    lean = BODY_LEAN_SIGMA_DEG if upright.is_found else 5.0 * BODY_LEAN_SIGMA_DEG
    direction = _unit(_known_median(body))
    feet = _foot_directions(points, np.flatnonzero(upright.frames), skeleton)
    if feet:
        # Ears stand a little before the ankles.
        direction = _unit(direction - np.radians(BODY_LEAN_DEG) * _unit(np.mean(feet, axis=0)))
    rows = [(camera.rotation[0], np.radians(roll_sigma_deg)) for camera in calibration.cameras]
    rows += [(foot, np.radians(FOOT_SLOPE_SIGMA_DEG)) for foot in feet]
    normal = np.eye(3) / np.radians(lean) ** 2
    right = direction / np.radians(lean) ** 2
    for row, sigma in rows:
        normal += np.outer(row, row) / sigma**2
    solved = _unit(np.linalg.solve(normal, right))
    spread = np.trace(np.linalg.inv(normal)) - solved @ np.linalg.inv(normal) @ solved
    return _Up(solved, float(np.degrees(np.sqrt(spread / 2.0))), "person and cameras")


def _find_floor(
    points: Array,
    upright: UprightFrames,
    up: Array,
    calibration: Calibration,
    skeleton: Skeleton,
    stature_m: float,
) -> Measurement:
    """Return the floor's height along `up` in the calibration's world."""
    if np.isfinite(calibration.floor_m) and np.isfinite(calibration.up).all():
        sigma = calibration.floor_sigma_m
        return Measurement(calibration.floor_m, FLOOR_SIGMA_M if np.isnan(sigma) else float(sigma))
    standing = points[upright.frames] @ up
    heights = []
    for part, above in (
        ("ankle", ANKLE_HEIGHT * stature_m + SOLE_M),
        ("heel", FOOT_POINT_M),
        ("big_toe", FOOT_POINT_M),
    ):
        columns = [skeleton.index(f"{s}_{part}") for s in ("left", "right") if _has(skeleton, part)]
        known = standing[:, columns][np.isfinite(standing[:, columns])]
        if known.size:
            heights.append(float(np.median(known)) - above)
    # Ankles count as much as heels and toes together.
    weight = np.array([2.0, 1.0, 1.0])[: len(heights)]
    return Measurement(float(np.average(heights, weights=weight)), FLOOR_SIGMA_M)


def _has(skeleton: Skeleton, part: str) -> bool:
    return f"left_{part}" in skeleton.keypoints and f"right_{part}" in skeleton.keypoints


def _find_forward(points: Array, upright: UprightFrames, up: Array, skeleton: Skeleton) -> Array:
    """Return the horizontal direction the person faces at the start, from feet, hips, shoulders.

    Raises
    ------
    AssessmentError
        If neither feet nor hips nor shoulders tell it.
    """
    frames = np.flatnonzero(upright.frames)[:HEADING_FRAMES]
    hints = [
        _flat(foot, up) / FOOT_HEADING_SIGMA_DEG**2
        for foot in _foot_directions(points, frames, skeleton)
    ]
    for part in ("hip", "shoulder"):
        across = _known_median(_across(points[frames], skeleton, part))
        hints.append(_flat(np.cross(up, across), up) / ACROSS_HEADING_SIGMA_DEG**2)
    known = [h for h in hints if np.isfinite(h).all()]
    forward = _flat(np.sum(known, axis=0), up) if known else np.full(3, np.nan)
    if not np.isfinite(forward).all():
        raise AssessmentError(
            "The forward direction needs the feet, hips or shoulders of the standing person, but "
            "they were not seen; film the whole person from head to feet."
        )
    return forward


def _foot_directions(points: Array, frames: NDArray[np.intp], skeleton: Skeleton) -> list[Array]:
    """Return the unit directions from heel to toe of the feet that are seen, (3,) each."""
    if not (_has(skeleton, "heel") and _has(skeleton, "big_toe")):
        return []
    found = []
    for side in ("left", "right"):
        heel, toe = (skeleton.point(points[frames], f"{side}_{n}") for n in ("heel", "big_toe"))
        direction = _unit(_known_median(toe - heel))
        if np.isfinite(direction).all():
            found.append(direction)
    return found


def _across(points: Array, skeleton: Skeleton, part: str) -> Array:
    """Return the way from the left to the right joint, shape (T, 3)."""
    return skeleton.point(points, f"right_{part}") - skeleton.point(points, f"left_{part}")


def _known_median(vectors: Array) -> Array:
    """Return the median over frames, NaN where there is none."""
    known = vectors[np.isfinite(vectors).all(axis=1)]
    return np.median(known, axis=0) if len(known) else np.full(3, np.nan)


def _unit(vector: Array) -> Array:
    length = np.linalg.norm(vector)
    return np.asarray(vector / length if length > 1e-6 else np.full(3, np.nan))


def _flat(vector: Array, up: Array) -> Array:
    """Return the horizontal direction of a vector."""
    return _unit(vector - (vector @ up) * up)


def _turn(
    found: Triangulation,
    calibration: Calibration,
    stature: Measurement,
    axes: Array,
    origin: Array,
    upright: UprightFrames,
    up: _Up,
    floor: Measurement,
) -> TwoViewScene:
    """Express everything in the world whose axes are the rows of `axes`, around `origin`."""
    cameras = tuple(_turn_camera(camera, axes, origin) for camera in calibration.cameras)
    covariance = axes @ np.asarray(found.covariance) @ axes.T
    points = (np.asarray(found.track.position) - origin) @ axes.T
    scale_sigma = calibration.scale_sigma
    turned = replace(
        calibration,
        cameras=cameras,
        up=np.array([0.0, 1.0, 0.0]),
        floor_m=0.0,
        scale_sigma=UNKNOWN_SCALE_SIGMA if np.isnan(scale_sigma) else scale_sigma,
        tilt_sigma_deg=up.sigma_deg,
        floor_sigma_m=floor.sigma,
    )
    scene = _describe_scene(turned, points, covariance, found, stature, upright, up)
    track = replace(
        found.track,
        position=points,
        provenance={**found.track.provenance, "scene": dict(scene.provenance)},
    )
    return TwoViewScene(replace(found, track=track, covariance=covariance), scene, turned)


def _turn_camera(camera: Camera, axes: Array, origin: Array) -> Camera:
    return replace(
        camera,
        rotation=camera.rotation @ axes.T,
        translation=camera.translation + camera.rotation @ origin,
    )


def _describe_scene(
    calibration: Calibration,
    points: Array,
    covariance: Array,
    found: Triangulation,
    stature: Measurement,
    upright: UprightFrames,
    up: _Up,
) -> WorldScene:
    camera = calibration.cameras[0]
    centre = camera_centre(camera)
    errors = _typical_errors(found, covariance, points, centre)
    definition = HAND_DEFINITION_SHARE * stature.value
    plane, depth = (float(np.hypot(error, definition)) for error in errors)
    measured = _measure_stature(points, upright, get_skeleton(found.track.skeleton))
    angle = _ray_angle_deg(calibration.cameras, points)
    provenance: dict[str, Any] = {
        "camera_matrix": calibration.source,
        "scale": f"calibration ({calibration.source})",
        "up": up.source,
        "upright_frames": int(upright.frames.sum()) if upright.is_found else 0,
        "camera_height_m": round(float(centre[1]), 3),
        "camera_distance_m": round(float(np.hypot(centre[0], centre[2])), 3),
        "ray_angle_deg": round(angle, 1),
        "stature_ratio": round(measured / stature.value, 4),
        "fov_sigma_deg": 0.0,
    }
    return WorldScene(
        camera=camera,
        scale_sigma=float(calibration.scale_sigma),
        tilt_sigma_deg=up.sigma_deg,
        heading_sigma_deg=HEADING_SIGMA_DEG,
        floor_sigma_m=float(calibration.floor_sigma_m),
        view_azimuth_deg=float(np.degrees(np.arctan2(centre[2], centre[0]))),
        plane_sigma_m=plane,
        depth_sigma_m=depth,
        provenance=provenance,
    )


def _typical_errors(
    found: Triangulation, covariance: Array, points: Array, centre: Array
) -> tuple[float, float]:
    """Return the errors of a well seen joint across and along the first line of sight, m.

    Both are the same where two views look from different enough sides.
    """
    skeleton = get_skeleton(found.track.skeleton)
    columns = [
        skeleton.index(f"{side}_{part}")
        for part in MEASURED_PARTS
        if _has(skeleton, part)
        for side in ("left", "right")
    ]
    sure = (found.n_views[:, columns] >= 2) & (found.track.confidence[:, columns] >= SURE)
    chosen = covariance[:, columns][sure]
    if not len(chosen):
        return float("nan"), float("nan")
    look = points[:, columns][sure] - centre
    look /= np.linalg.norm(look, axis=1, keepdims=True)
    along = np.einsum("ni,nij,nj->n", look, chosen, look)
    across = (np.trace(chosen, axis1=1, axis2=2) - along) / 2.0
    depth, plane = (float(np.sqrt(np.median(variance))) for variance in (along, across))
    if max(depth, plane) <= EQUAL_SHARE * min(depth, plane):
        depth = plane = float(np.sqrt((2.0 * plane**2 + depth**2) / 3.0))
    return plane, depth


def _measure_stature(points: Array, upright: UprightFrames, skeleton: Skeleton) -> float:
    """Return the stature that goes with the height from ankles to ears, m."""
    span = skeleton.point(points, "mid_ear") - skeleton.point(points, "mid_ankle")
    height = _known_median(span[upright.frames])[1]
    return float(height / (EAR_HEIGHT - ANKLE_HEIGHT))


def _ray_angle_deg(cameras: Sequence[Camera], points: Array) -> float:
    """Return the median angle at which the lines of sight of two cameras meet, degrees."""
    middle = points[np.isfinite(points).all(axis=2)]
    ways = [middle - camera_centre(camera) for camera in cameras[:2]]
    ways = [way / np.linalg.norm(way, axis=1, keepdims=True) for way in ways]
    cosine = np.clip((ways[0] * ways[1]).sum(axis=1), -1.0, 1.0)
    return float(np.degrees(np.median(np.arccos(cosine)))) if len(middle) else float("nan")
