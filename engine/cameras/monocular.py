"""One uncalibrated camera in metres.

A single picture has no scale and no vertical. They come from what is known of the
person: the stature gives the scale, standing frames and ordinary camera heights give
the vertical, the feet give the floor, feet and trunk together the forward direction. What
each of these leaves open is carried along as a standard error.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from engine.cameras.body_sight import see_body_again
from engine.cameras.depth import (
    BONES,
    JOINTS,
    DepthProblem,
    DepthSettings,
    bone_rows,
    solve_depths,
)
from engine.datatypes import (
    Array,
    Camera,
    Measurement,
    PoseTrack,
    Provenance,
    ViewPose,
    WorldScene,
)
from engine.errors import AssessmentError
from engine.skeletons import Skeleton, get_skeleton

__all__ = ["assumed_camera_matrix", "find_upright_frames", "reconstruct_single_view"]

EAR_HEIGHT = 0.924
ANKLE_HEIGHT = 0.041
"""Heights of the tragion and the lateral malleolus as fractions of stature, both sexes, rounded
from the means of the US Army anthropometric survey (Gordon et al. 2014)."""
SOLE_M = 0.02
"""Typical thickness of a shoe's sole; lifts everything but the floor."""
SEGMENT_SUM = 0.245 + 0.246 + 0.288
"""Thigh, shank and hip-to-shoulder as fractions of stature (Drillis, Contini; Winter 2009)."""

UPRIGHT_ANGLE_DEG = 30.0
UPRIGHT_SHARE = 0.96
CAMERA_HEIGHT_M = 1.3
CAMERA_HEIGHT_SIGMA_M = 0.4
BODY_ROLL_SIGMA_DEG = 4.0
"""How far the line from ankles to ears of a standing person is off the vertical in the picture."""
HEADING_SIGMA_DEG = 9.0
FLOOR_SIGMA_M = 0.015
FOOT_POINT_M = 0.035
"""Height of heel and toe keypoints above the floor in shoes."""
STAYING_SHARE = 0.12
STEP_M = 0.15
LANDMARK_SCALE_SIGMA = 0.02
"""Share of the ankle-to-ear span by which a network's points may differ from the anatomy."""
NO_UPRIGHT_SCALE_SIGMA = 0.08
PLANE_SIGMA_SHARE = 0.018
"""Standard error of a well visible keypoint across the line of sight, as a share of stature."""
DEPTH_SIGMA_SHARE = 0.05
"""The same along the line of sight, relative to the feet."""

SURE_DEPTHS = DepthSettings(prior_m=0.03, prior_share=0.12)
"""How strictly depths are meant of an estimator that states the errors of its joints. Chosen on the
synthetic lifts of one person (P06), whom the lifting networks were not trained on."""

_LENGTH_RULES: tuple[tuple[tuple[str, str], float, float, str], ...] = (
    # parts, share of stature, relative standard error, where the length comes from
    (("ankle", "knee"), 0.246, 0.02, "standing"),
    (("knee", "hip"), 0.245, 0.02, "standing"),
    (("hip", "shoulder"), 0.288, 0.06, "standing"),
    (("shoulder", "elbow"), 0.186, 0.05, "longest"),
    (("elbow", "wrist"), 0.146, 0.05, "longest"),
    (("wrist", "hand"), 0.055, 0.15, "stature"),
    (("ankle", "heel"), 0.045, 0.15, "stature"),
    (("ankle", "big_toe"), 0.110, 0.15, "stature"),
)
"""Shares after Drillis and Contini (Winter 2009); the trunk bends, so its length is softer."""
_WIDTHS = {"hip": (0.12, 0.2), "shoulder": (0.20, 0.1)}
"""Between the keypoints, not the bones: share of stature and relative standard error."""


def assumed_camera_matrix(size_px: tuple[int, int], *, horizontal_fov_deg: float) -> Array:
    """Return the matrix of a camera of which only the picture size is known.

    Parameters
    ----------
    size_px
        Width and height, px.
    horizontal_fov_deg
        Field of view along the longer side, degrees.

    Returns
    -------
    Array
        Shape (3, 3), px, principal point in the middle (pixel centres are integers).
    """
    focal = 0.5 * max(size_px) / np.tan(np.radians(horizontal_fov_deg) / 2)
    return np.array(
        [
            [focal, 0.0, (size_px[0] - 1) / 2],
            [0.0, focal, (size_px[1] - 1) / 2],
            [0.0, 0.0, 1.0],
        ]
    )


def reconstruct_single_view(
    pose: ViewPose,
    stature: Measurement,
    *,
    matrix: Array | None = None,
    horizontal_fov_deg: float = 58.0,
    fov_sigma_deg: float = 9.0,
    pitch_sigma_deg: float = 8.0,
    roll_sigma_deg: float = 2.0,
) -> tuple[PoseTrack, WorldScene]:
    """Place the keypoints of one view in the world.

    The picture decides what is seen across the line of sight; the estimator's body
    landmarks decide only how far each joint lies behind or before the feet. Where the estimator
    states how well it knows a joint around the hips (a standard error in the body track), the
    body decides across the line of sight as well; see `see_body_again`.

    Parameters
    ----------
    pose
        Image track and body track of one view.
    stature
        Metres, with standard error.
    matrix
        Shape (3, 3), px, when the camera is known; otherwise assumed from the field of view.
    horizontal_fov_deg, fov_sigma_deg
        Assumed field of view along the longer side and its standard error.
    pitch_sigma_deg, roll_sigma_deg
        How far an ordinary camera is off level.

    Returns
    -------
    PoseTrack
        World metres, with a standard error per sample (root mean square over the axes).
    WorldScene
        The camera in the world and the errors of scale, tilt, heading and floor.

    Raises
    ------
    AssessmentError
        If the estimator gives no body landmarks, or the feet or the head are never seen, or not
        enough of the body between them.
    """
    if pose.body is None:
        raise AssessmentError(
            "One camera needs an estimator that gives landmarks in metres, "
            f"but {pose.image.skeleton} tracks came without; choose another estimator."
        )
    skeleton = get_skeleton(pose.image.skeleton)
    is_known = matrix is not None
    if matrix is None:
        matrix = assumed_camera_matrix(pose.info.size_px, horizontal_fov_deg=horizontal_fov_deg)
    rays = compute_rays(np.asarray(pose.image.position), matrix)
    body = align_with_line_of_sight(np.asarray(pose.body.position), rays, skeleton)
    rays = see_body_again(body, pose.body.sigma, rays, pose.image.confidence)
    upright = find_upright_frames(body, rays, skeleton)
    ground = estimate_ground(
        body,
        rays,
        upright,
        skeleton,
        stature_m=stature.value,
        pitch_sigma_deg=pitch_sigma_deg,
        roll_sigma_deg=roll_sigma_deg,
    )
    if not is_known:
        lens = _lens_tilt_sigma_deg(rays, upright, skeleton, horizontal_fov_deg, fov_sigma_deg)
        ground = replace(ground, tilt_sigma_deg=float(np.hypot(ground.tilt_sigma_deg, lens)))
    heading = estimate_heading(rays, upright.frames, ground, skeleton, stature_m=stature.value)
    points = _place_points(pose, rays, body, upright, ground, heading, stature.value)
    frame = _world_frame(points, upright.frames, ground, heading, skeleton, stature.value)
    scene = _describe_scene(
        pose, matrix, frame, ground, heading, upright, stature, is_known, fov_sigma_deg
    )
    return _world_track(pose, points, frame, scene), scene


def compute_rays(image: Array, matrix: Array) -> Array:
    """Return lines of sight with unit depth, shape (T, K, 3), of points (T, K, 2) px."""
    rays = np.ones((*image.shape[:-1], 3))
    rays[..., 0] = (image[..., 0] - matrix[0, 2]) / matrix[0, 0]
    rays[..., 1] = (image[..., 1] - matrix[1, 2]) / matrix[1, 1]
    is_seen = np.asarray(np.isfinite(image).all(axis=-1, keepdims=True))
    return np.where(is_seen, rays, np.nan)


def align_with_line_of_sight(body: Array, rays: Array, skeleton: Skeleton) -> Array:
    """Turn body landmarks from the crop's line of sight to the camera's axes.

    A network that sees a crop takes the crop's centre for straight ahead; a person at the
    edge of the picture would come out turned by the angle of that ray.

    Parameters
    ----------
    body
        Shape (T, K, 3), metres, axes of the crop.
    rays
        Shape (T, K, 3), viewing rays with unit depth.

    Returns
    -------
    Array
        Shape (T, K, 3), metres, axes of the camera.
    """
    ray = skeleton.point(rays, "pelvis")
    forward = ray / np.linalg.norm(ray, axis=1, keepdims=True)
    right = np.cross([0.0, 1.0, 0.0], forward)
    right /= np.linalg.norm(right, axis=1, keepdims=True)
    down = np.cross(forward, right)
    axes = np.stack([right, down, forward], axis=2)  # columns: the crop's axes in the camera
    return np.asarray(np.einsum("tij,tkj->tki", axes, body))


@dataclass(frozen=True)
class UprightFrames:
    """Frames in which the person stands, and whether any were truly found."""

    frames: NDArray[np.bool_]
    is_found: bool


def find_upright_frames(body: Array, rays: Array, skeleton: Skeleton) -> UprightFrames:
    """Find the frames in which the person stands straight.

    Legs and trunk are within 30 degrees of one line in the body landmarks and the
    span from ankle to ear reaches 96 % of its largest value (98th percentile) in the picture.
    Fewer than five such frames (or than the clip has) count as none.

    Parameters
    ----------
    body
        Shape (T, K, 3), metres.
    rays
        Shape (T, K, 3), unit depth.

    Returns
    -------
    UprightFrames
        With `is_found` False the frames are those with the largest span, upright or not.

    Raises
    ------
    AssessmentError
        If ankles and ears are never seen together.
    """
    span = np.linalg.norm(
        skeleton.point(rays, "mid_ear") - skeleton.point(rays, "mid_ankle"), axis=1
    )
    if not np.isfinite(span).any():
        raise AssessmentError(
            "Feet and head must be in the picture to find the scale, but they were never seen "
            "together; film the whole person from head to feet."
        )
    largest = np.nanpercentile(span, 98)
    is_tall = np.nan_to_num(span) >= UPRIGHT_SHARE * largest
    bend = _largest_bend_deg(body, skeleton)
    is_straight = np.nan_to_num(bend, nan=180.0) < UPRIGHT_ANGLE_DEG
    both = is_tall & is_straight
    if both.sum() >= min(5, is_tall.size):
        return UprightFrames(both, True)
    return UprightFrames(is_tall, False)


def _largest_bend_deg(body: Array, skeleton: Skeleton) -> Array:
    """Return the larger of knee bend and hip bend, mean of the sides, shape (T,), degrees."""
    point = {n: skeleton.point(body, n) for n in ("pelvis", "thorax")}
    bends = []
    for side in ("left", "right"):
        hip, knee, ankle = (skeleton.point(body, f"{side}_{n}") for n in ("hip", "knee", "ankle"))
        trunk, thigh, shank = point["thorax"] - point["pelvis"], hip - knee, knee - ankle
        bends.append([_angle_deg(trunk, thigh), _angle_deg(thigh, shank)])
    return np.asarray(np.mean(bends, axis=0).max(axis=0))


def _angle_deg(a: Array, b: Array) -> Array:
    cosine = (a * b).sum(axis=-1) / (np.linalg.norm(a, axis=-1) * np.linalg.norm(b, axis=-1))
    return np.asarray(np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0))))


@dataclass(frozen=True)
class Ground:
    """Which way is up, how far away the person stands, and where the floor is.

    `up` in camera axes; `distance_m` depth of the ankles in standing frames; `floor_height`
    of the floor relative to the camera (negative); `scale` metres per unit of the body
    landmarks.
    """

    up: Array
    pitch_deg: float
    roll_deg: float
    tilt_sigma_deg: float
    distance_m: float
    floor_height: float
    scale: float


def up_direction(pitch_deg: float | Array, roll_deg: float) -> Array:
    """Return the upward unit vector in camera axes, shape (..., 3).

    A camera that looks down has positive pitch; with positive roll the vertical leans to the
    right in the picture.
    """
    pitch, roll = np.radians(pitch_deg), np.radians(roll_deg)
    return np.stack(
        [np.sin(roll) * np.cos(pitch), -np.cos(roll) * np.cos(pitch), -np.sin(pitch)], axis=-1
    )


def estimate_ground(
    body: Array,
    rays: Array,
    upright: UprightFrames,
    skeleton: Skeleton,
    *,
    stature_m: float,
    pitch_sigma_deg: float,
    roll_sigma_deg: float,
) -> Ground:
    """Estimate the vertical, the distance and the floor from standing frames.

    Pitch: cameras are held nearly level, and at about chest height; the two statements are
    joined by Bayes' rule on a grid. The second has a soft tail, so that a camera on a wall or on
    the floor is not forced to chest height. What the network's body landmarks say
    of the pitch is left out: standing people come out of it leaning by ten degrees and more.
    Roll: between level and the direction of the standing body in the picture.

    Returns
    -------
    Ground
        With a standard error for the tilt from the spread of the joint statement.
    """
    scale = body_scale(body, upright.frames, skeleton, stature_m=stature_m)
    ankle = np.nanmedian(skeleton.point(rays, "mid_ankle")[upright.frames], axis=0)
    ear = np.nanmedian(skeleton.point(rays, "mid_ear")[upright.frames], axis=0)
    roll = 0.0
    if upright.is_found:
        seen_roll = np.degrees(np.arctan2(ear[0] - ankle[0], ankle[1] - ear[1]))
        trust = roll_sigma_deg**2 / (roll_sigma_deg**2 + BODY_ROLL_SIGMA_DEG**2)
        roll = float(trust * seen_roll)
    pitch, spread = _estimate_pitch(ankle, ear, roll, upright, stature_m, pitch_sigma_deg)
    up = up_direction(pitch, roll)
    if upright.is_found:
        distance, _ = _span_depths(up, ankle, ear, (EAR_HEIGHT - ANKLE_HEIGHT) * stature_m)
    else:
        distance = scale * _distance_by_size(body, rays, upright.frames, skeleton)
    height = ANKLE_HEIGHT * stature_m + SOLE_M
    return Ground(
        up=up,
        pitch_deg=pitch,
        roll_deg=roll,
        tilt_sigma_deg=float(np.hypot(spread, roll_sigma_deg)),
        distance_m=float(distance),
        floor_height=float(distance * ankle @ up) - height,
        scale=scale,
    )


def _lens_tilt_sigma_deg(
    rays: Array,
    upright: UprightFrames,
    skeleton: Skeleton,
    horizontal_fov_deg: float,
    fov_sigma_deg: float,
) -> float:
    """Return by how much an assumed lens may tilt the lines of sight to the feet, degrees.

    A focal length that is wrong by a share turns every line of sight by that share of its angle
    to the camera's axis.
    """
    ankle = np.nanmedian(skeleton.point(rays, "mid_ankle")[upright.frames], axis=0)
    focal_share = np.radians(fov_sigma_deg) / np.sin(np.radians(horizontal_fov_deg))
    return float(focal_share * abs(np.degrees(np.arctan(ankle[1]))))


def _estimate_pitch(
    ankle: Array,
    ear: Array,
    roll_deg: float,
    upright: UprightFrames,
    stature_m: float,
    pitch_sigma_deg: float,
) -> tuple[float, float]:
    """Return the pitch and its standard error, degrees."""
    if not upright.is_found:
        return 0.0, pitch_sigma_deg
    grid = np.arange(-60.0, 60.25, 0.25)
    up = up_direction(grid, roll_deg)
    depth, _ = _span_depths(up, ankle, ear, (EAR_HEIGHT - ANKLE_HEIGHT) * stature_m)
    height = ANKLE_HEIGHT * stature_m + SOLE_M - depth * (up @ ankle)
    excess = (height - CAMERA_HEIGHT_M) / CAMERA_HEIGHT_SIGMA_M
    # The second statement has a soft tail (Student's t), see above.
    cost = (grid / pitch_sigma_deg) ** 2 + 4.0 * np.log1p(excess**2 / 4.0)
    weight = np.exp(-0.5 * (cost - cost.min()))
    weight /= weight.sum()
    mean = float((grid * weight).sum())
    return mean, float(np.sqrt(((grid - mean) ** 2 * weight).sum()))


def _distance_by_size(
    body: Array, rays: Array, frames: NDArray[np.bool_], skeleton: Skeleton
) -> Array:
    """Return the distance in units of the body landmarks, from their size in the picture."""
    chosen = [skeleton.index(f"{s}_{n}") for s in ("left", "right") for n in ("shoulder", "hip")]
    chosen += [skeleton.index(f"{s}_{n}") for s in ("left", "right") for n in ("knee", "ankle")]
    flat, seen = body[frames][:, chosen, :2], rays[frames][:, chosen, :2]
    flat = flat - flat.mean(axis=1, keepdims=True)
    seen = seen - seen.mean(axis=1, keepdims=True)
    size = np.sqrt((flat**2).sum(axis=(1, 2)) / (seen**2).sum(axis=(1, 2)))
    return np.asarray(np.nanmedian(size))


def _span_depths(up: Array, lower: Array, upper: Array, span_m: float) -> tuple[Array, Array]:
    """Return the depths of two lines of sight at which points stand `span_m` above each other.

    Least squares of ``b * upper - a * lower = span * up``, for one or many `up` (..., 3).
    """
    ll, uu, lu = lower @ lower, upper @ upper, lower @ upper
    wanted_l, wanted_u = -span_m * (up @ lower), span_m * (up @ upper)
    determinant = ll * uu - lu**2
    a = (uu * wanted_l + lu * wanted_u) / determinant
    b = (lu * wanted_l + ll * wanted_u) / determinant
    return np.asarray(a), np.asarray(b)


def body_scale(
    body: Array, frames: NDArray[np.bool_], skeleton: Skeleton, *, stature_m: float
) -> float:
    """Return metres per unit of the body landmarks, from the lengths of leg and trunk.

    Raises
    ------
    AssessmentError
        If shoulders, hips, knees and ankles are never seen together in these frames.
    """
    total = np.zeros(body.shape[0])
    for side in ("left", "right"):
        hip, knee, ankle, shoulder = (
            skeleton.point(body, f"{side}_{n}") for n in ("hip", "knee", "ankle", "shoulder")
        )
        for a, b in ((hip, knee), (knee, ankle), (shoulder, hip)):
            total += 0.5 * np.linalg.norm(a - b, axis=1)
    known = total[frames][np.isfinite(total[frames])]
    if not known.size:
        raise AssessmentError(
            "The size of the body needs shoulders, hips, knees and ankles, but they were never "
            "seen together; film the whole person from head to feet with nothing in front."
        )
    return float(SEGMENT_SUM * stature_m / np.median(known))


def feet_depth(rays: Array, ground: Ground, skeleton: Skeleton, *, stature_m: float) -> Array:
    """Return the depth of the feet in every frame, shape (T,), m.

    One depth for a person who stays; for one who walks, where the ankles' lines of sight
    reach ankle height above the floor.
    """
    height = ground.floor_height + ANKLE_HEIGHT * stature_m + SOLE_M
    below = skeleton.point(rays, "mid_ankle") @ ground.up
    # A camera near the floor sees it edge-on: where the feet stand then says nothing of depth.
    if height > -0.3:
        return np.full(len(rays), ground.distance_m)
    depth = np.where(below < -0.02, height / np.where(below < -0.02, below, -1.0), np.nan)
    depth = np.where(np.abs(depth / ground.distance_m - 1.0) < 0.6, depth, np.nan)
    known = np.isfinite(depth)
    if not known.any():
        return np.full(len(rays), ground.distance_m)
    low, high = np.percentile(depth[known], [5, 95])
    if high - low < STAYING_SHARE * ground.distance_m:
        return np.full(len(rays), ground.distance_m)
    index = np.arange(depth.size)
    padded = np.pad(np.interp(index, index[known], depth[known]), 7, mode="edge")
    windows = np.lib.stride_tricks.sliding_window_view(padded, 15)
    return np.asarray(np.median(windows, axis=1))


def _find_standing(
    rays: Array, depth: Array, skeleton: Skeleton, step_s: float
) -> NDArray[np.bool_]:
    """Return the frames in which the feet stay in place, within half a second."""
    ankle = skeleton.point(rays, "mid_ankle") * depth[:, None]
    half = max(1, round(0.25 / step_s))
    padded = np.pad(ankle[:, :2], ((half, half), (0, 0)), mode="edge")
    travelled = np.linalg.norm(padded[2 * half :] - padded[: -2 * half], axis=1)
    return np.asarray(np.nan_to_num(travelled, nan=np.inf) < STEP_M)


def _joint_positions(position: Array, skeleton: Skeleton) -> Array:
    """Return the depth solver's joints, shape (T, J, D); a hand is the middle of its knuckles."""
    columns = []
    for name in JOINTS:
        if name.endswith("_hand"):
            side = name.split("_", 1)[0]
            knuckles = [skeleton.point(position, f"{side}_{n}") for n in ("index", "pinky")]
            columns.append(0.5 * (knuckles[0] + knuckles[1]))
        else:
            columns.append(skeleton.point(position, name))
    return np.stack(columns, axis=1)


def _place_points(
    pose: ViewPose,
    rays: Array,
    body: Array,
    upright: UprightFrames,
    ground: Ground,
    heading: Heading,
    stature_m: float,
) -> Array:
    """Return the keypoints in camera axes, shape (T, K, 3), m."""
    skeleton = get_skeleton(pose.image.skeleton)
    step_s = float(np.median(np.diff(pose.image.time_s))) if len(rays) > 1 else 1.0
    depth = feet_depth(rays, ground, skeleton, stature_m=stature_m)
    told = ground.scale * body[:, :, 2]
    feet = skeleton.point(told[:, :, None], "mid_ankle")
    # Only differences within a frame count later; the typical offset serves where an ankle is
    # missing.
    told = told - np.where(np.isfinite(feet), feet, np.nanmedian(feet))
    confidence = np.repeat(np.asarray(pose.image.confidence)[:, :, None], 2, axis=2)
    joint_rays = _joint_positions(rays, skeleton)
    lengths, sigma = bone_lengths(joint_rays, ground, upright, stature_m=stature_m)
    heights = [
        ANKLE_HEIGHT * stature_m + SOLE_M if n.endswith("ankle") else FOOT_POINT_M
        for n in JOINTS
        if n.endswith(("ankle", "heel", "big_toe"))
    ]
    problem = DepthProblem(
        rays=joint_rays,
        prior=_joint_positions(told[:, :, None], skeleton)[:, :, 0],
        confidence=_joint_positions(confidence, skeleton)[:, :, 0],
        feet_depth=depth,
        lengths=lengths,
        length_sigma=sigma,
        up=ground.up,
        right=np.cross(heading.direction, ground.up),
        floor_height=ground.floor_height,
        joint_heights=np.array(heights),
        is_standing=_find_standing(rays, depth, skeleton, step_s),
        step_s=step_s,
    )
    states_errors = pose.body is not None and np.isfinite(pose.body.sigma).any()
    solved = solve_depths(problem, SURE_DEPTHS) if states_errors else solve_depths(problem)
    return np.asarray(rays * _spread_depths(solved, told, skeleton)[:, :, None])


def _spread_depths(solved: Array, told: Array, skeleton: Skeleton) -> Array:
    """Return the depths of all keypoints: the solved joints, the rest relative to them."""
    column = {name: i for i, name in enumerate(JOINTS)}
    depth = np.full(told.shape, np.nan)
    for k, name in enumerate(skeleton.keypoints):
        if name in column:
            depth[:, k] = solved[:, column[name]]
            continue
        side = name.split("_", 1)[0]
        if name.endswith(("_index", "_pinky", "_thumb")):
            anchor = solved[:, column[f"{side}_hand"]]
            base = np.mean(
                [told[:, skeleton.index(f"{side}_{n}")] for n in ("index", "pinky")], axis=0
            )
        else:
            anchor = 0.5 * (
                solved[:, column["left_shoulder"]] + solved[:, column["right_shoulder"]]
            )
            base = skeleton.point(told[:, :, None], "thorax")[:, 0]
        depth[:, k] = anchor + told[:, k] - base
    return depth


def bone_lengths(
    joint_rays: Array, ground: Ground, upright: UprightFrames, *, stature_m: float
) -> tuple[Array, Array]:
    """Estimate the lengths of the bones and how well they are known, shape (B,) each, m.

    A standing person's legs and trunk are seen at full length, so these come from the
    picture itself (and fit the estimator's own idea of where a hip is). Arms are rarely
    seen so; they are at least as long as the longest view of them, and else a share of the stature.
    """
    projected = np.linalg.norm(
        np.stack(
            [joint_rays[:, JOINTS.index(a)] - joint_rays[:, JOINTS.index(b)] for a, b in BONES], 1
        )
        * ground.distance_m,
        axis=2,
    )
    lengths, sigma = np.zeros(len(BONES)), np.zeros(len(BONES))
    for parts, share, error, rule in _LENGTH_RULES:
        rows = bone_rows(parts)
        known = share * stature_m
        if rule == "standing" and upright.is_found:
            known = float(np.nanmedian(projected[upright.frames][:, rows]))
        elif rule == "longest":
            views = projected[:, rows][np.isfinite(projected[:, rows])]
            known = max(known, float(np.percentile(views, 95)) if views.size else 0.0)
        lengths[rows], sigma[rows] = known, error * known
    for i, (a, b) in enumerate(BONES):
        if a.split("_", 1)[1] == b.split("_", 1)[1]:
            share, error = _WIDTHS[a.split("_", 1)[1]]
            lengths[i], sigma[i] = share * stature_m, error * share * stature_m
        elif lengths[i] == 0.0:
            lengths[i], sigma[i] = _diagonal(lengths, stature_m)
    return lengths, sigma


def _diagonal(lengths: Array, stature_m: float) -> tuple[float, float]:
    """Return the length of hip to opposite shoulder, from the trunk's length and widths."""
    trunk = float(lengths[bone_rows(("hip", "shoulder"))[0]])
    half_widths = 0.5 * (_WIDTHS["hip"][0] + _WIDTHS["shoulder"][0]) * stature_m
    length = float(np.hypot(trunk, half_widths))
    return length, 0.1 * length


@dataclass(frozen=True)
class Heading:
    """The subject's forward direction in camera axes and its standard error."""

    direction: Array
    sigma_deg: float


def estimate_heading(
    rays: Array,
    frames: NDArray[np.bool_],
    ground: Ground,
    skeleton: Skeleton,
    *,
    stature_m: float,
) -> Heading:
    """Estimate the forward direction from where heels and toes stand on the floor.

    Parameters
    ----------
    rays
        Shape (T, K, 3), lines of sight with unit depth.
    frames
        Standing frames; the first thirty of them in which a foot is seen are used.
    ground
        Upward direction and floor.

    Returns
    -------
    Heading
        A horizontal unit vector, the mean of both feet. Its standard error is a typical one: how
        much people turn their toes out and how much a foot's keypoints are worth.

    Raises
    ------
    AssessmentError
        If no foot was seen in the standing frames.
    """
    parts = [skeleton.index(f"{s}_{n}") for s in ("left", "right") for n in ("heel", "big_toe")]
    seen = np.asarray(np.isfinite(rays[:, parts]).all(axis=2))
    has_foot = (seen[:, 0] & seen[:, 1]) | (seen[:, 2] & seen[:, 3])
    first = np.flatnonzero(frames & has_foot)[:30]
    height = ground.floor_height + FOOT_POINT_M

    def on_floor(name: str) -> Array:
        ray = rays[first][:, skeleton.index(name)]
        # A foot above the horizon can't be on the floor; the limit keeps it before the camera.
        below = np.minimum(ray @ ground.up, -0.02)
        return np.asarray(ray * (height / below)[:, None])

    feet = [on_floor(f"{side}_big_toe") - on_floor(f"{side}_heel") for side in ("left", "right")]
    units = [_horizontal_unit(_median(foot), ground.up) for foot in feet]
    units = [u for u in units if np.isfinite(u).all()]
    if not units:
        raise AssessmentError(
            "The forward direction needs heel and toes of a foot in standing frames, but they were "
            "not seen; film the whole person from head to feet."
        )
    mean = _horizontal_unit(np.mean(units, axis=0), ground.up)
    return Heading(mean, HEADING_SIGMA_DEG)


def _median(vectors: Array) -> Array:
    """Return the median over frames, NaN without a warning where there is none."""
    known = vectors[np.isfinite(vectors).all(axis=1)]
    return np.median(known, axis=0) if len(known) else np.full(3, np.nan)


def _horizontal_unit(vector: Array, up: Array) -> Array:
    flat = vector - (vector @ up) * up
    length = np.linalg.norm(flat)
    return np.asarray(flat / length if length > 1e-6 else np.full(3, np.nan))


@dataclass(frozen=True)
class _WorldFrame:
    """World axes (rows, in camera axes) and the camera-axes position of the world's origin."""

    axes: Array
    origin: Array

    def apply(self, points: Array) -> Array:
        return np.asarray((points - self.origin) @ self.axes.T)


def _world_frame(
    points: Array,
    frames: NDArray[np.bool_],
    ground: Ground,
    heading: Heading,
    skeleton: Skeleton,
    stature_m: float,
) -> _WorldFrame:
    up = ground.up
    axes = np.stack([heading.direction, up, np.cross(heading.direction, up)])
    ankle = _median(skeleton.point(points, "mid_ankle")[frames])
    return _WorldFrame(axes, ankle - (ANKLE_HEIGHT * stature_m + SOLE_M) * up)


def _describe_scene(
    pose: ViewPose,
    matrix: Array,
    frame: _WorldFrame,
    ground: Ground,
    heading: Heading,
    upright: UprightFrames,
    stature: Measurement,
    is_known: bool,
    fov_sigma_deg: float,
) -> WorldScene:
    rotation = frame.axes.T
    camera = Camera(pose.info.file_name, pose.info.size_px, matrix, rotation, frame.origin)
    centre = -rotation.T @ frame.origin
    landmark = LANDMARK_SCALE_SIGMA if upright.is_found else NO_UPRIGHT_SCALE_SIGMA
    provenance: Mapping[str, Any] = {
        "camera_matrix": str(Provenance.USER if is_known else Provenance.ASSUMED),
        "scale": "stature in standing frames" if upright.is_found else "stature, no standing frame",
        "upright_frames": int(upright.frames.sum()) if upright.is_found else 0,
        "pitch_deg": round(ground.pitch_deg, 2),
        "roll_deg": round(ground.roll_deg, 2),
        "camera_height_m": round(float(centre[1]), 3),
        "camera_distance_m": round(float(np.hypot(centre[0], centre[2])), 3),
        "fov_sigma_deg": 0.0 if is_known else fov_sigma_deg,
    }
    return WorldScene(
        camera=camera,
        scale_sigma=float(np.hypot(stature.sigma / stature.value, landmark)),
        tilt_sigma_deg=ground.tilt_sigma_deg,
        heading_sigma_deg=heading.sigma_deg,
        floor_sigma_m=FLOOR_SIGMA_M,
        view_azimuth_deg=float(np.degrees(np.arctan2(centre[2], centre[0]))),
        plane_sigma_m=PLANE_SIGMA_SHARE * stature.value,
        depth_sigma_m=DEPTH_SIGMA_SHARE * stature.value,
        provenance=provenance,
    )


def _world_track(pose: ViewPose, points: Array, frame: _WorldFrame, scene: WorldScene) -> PoseTrack:
    position = frame.apply(points)
    per_axis = np.sqrt((2 * scene.plane_sigma_m**2 + scene.depth_sigma_m**2) / 3)
    # A point the network calls hidden is guessed from the rest of the body.
    doubt = 1.0 + 2.0 * (1.0 - np.nan_to_num(pose.image.confidence, nan=0.5))
    sigma = np.where(np.isfinite(position).all(axis=2), per_axis * doubt, np.nan)
    return PoseTrack(
        time_s=pose.image.time_s,
        position=position,
        unit="m",
        frame_of_reference="world",
        skeleton=pose.image.skeleton,
        confidence=pose.image.confidence,
        sigma=sigma,
        provenance={**pose.image.provenance, "scene": dict(scene.provenance)},
    )
