"""Two cameras calibrated from the person who moves before them.

Nobody has to film a board: the same joints seen from two places say how the cameras stand to each
other, bones that keep their length and the stature say how large everything is, and feet on the
floor and upright frames say where up is. What this leaves open is stated: a phone's focal length
above all, which moves the cameras along their lines of sight but hardly changes the person.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from engine.cameras._bundle import (
    FLOOR,
    FOCAL,
    ROTATION,
    SPAN,
    TOE_M,
    TRANSLATION,
    UP,
    Bundle,
    BundlePriors,
    BundleState,
    Solution,
    solve_bundle,
    start_shared,
)
from engine.cameras._person import (
    FEET,
    Evidence,
    choose_frames,
    collect_evidence,
    column,
    shared_joints,
)
from engine.cameras._starts import body_in_camera, list_starts
from engine.cameras._witness import miss_by_shift
from engine.cameras.monocular import FLOOR_SIGMA_M, assumed_camera_matrix
from engine.datatypes import Array, Calibration, Camera, Measurement, ViewPose
from engine.errors import CalibrationError

__all__ = ["calibrate_from_person"]

FRAMES = 60
START_FRAMES = 20
START_STEPS = 12
FEWEST_FRAMES = 12
LIFTED_FOOT_M = 0.08
SAME_VIEW_SHARE = 0.01
"""Pictures of joints closer than this share of the person's height come from the same video."""
LEAST_MOTION = 0.02
"""Share of the height by which joints must move against each other."""
RAY_ANGLE_DEG = (15.0, 150.0)
LARGEST_MISFIT = 0.022
LARGEST_MISS_OVER_TIME = 0.019
"""Typical distance of joints in the pictures, and by how much it changes over time: shares of the
person's height beyond which the views do not show one person at one time."""
LARGEST_ROTATION_SIGMA_DEG = 6.0
CENTRE_SIGMA = 0.01
"""Standard error of an assumed principal point, as a share of the longer side."""
NEVER_UPRIGHT_TILT_DEG = 12.0
NEVER_UPRIGHT_FLOOR_M = 0.05
"""How much worse up and floor are known when the person never stands straight."""
KNOWN_FOCAL_SIGMA = 0.003
KNOWN_CENTRE_SIGMA = 0.001


def calibrate_from_person(
    views: Sequence[ViewPose],
    stature: Measurement,
    *,
    matrices: Sequence[Array | None] | None = None,
    horizontal_fov_deg: float = 58.0,
    fov_sigma_deg: float = 9.0,
    pitch_sigma_deg: float = 8.0,
    roll_sigma_deg: float = 2.0,
) -> Calibration:
    """Find two cameras from what they saw of one moving person.

    Parameters
    ----------
    views
        Two, synchronised: with the same times. Their order does not matter.
    stature
        Metres, with standard error; gives all lengths.
    matrices
        Camera matrix (3, 3) in px of each view, None where it is not known.
    horizontal_fov_deg, fov_sigma_deg
        Assumed field of view along the longer side and its standard error, where no matrix is
        known.
    pitch_sigma_deg, roll_sigma_deg
        How far an ordinary camera is off level.

    Returns
    -------
    Calibration
        In a world with Y up, the floor at y = 0, the origin between the feet and X towards
        the cameras' middle. Errors of the cameras go together here: a focal length that is too
        long comes with a camera too far away, and the person stays the same. So
        `rotation_sigma_deg` and `translation_sigma_m` are what is left of them where they matter,
        in the lines of sight to the person. The errors of the cameras themselves are in the
        provenance: `pose_rotation_sigma_deg`, `pose_translation_sigma_m`, `focal_sigma_percent`;
        `joint_sigma_m` is the error of a joint, per axis, that comes from the cameras.

    Raises
    ------
    CalibrationError
        If the views do not tell: times that differ, one video given twice, too few common frames,
        no movement, cameras nearly side by side or face to face, or different persons.

    References
    ----------
    .. [1] Triggs et al. (2000), Bundle adjustment: a modern synthesis.
    .. [2] Nistér (2004), An efficient solution to the five-point relative pose problem.
    """
    if len(views) != 2:
        raise CalibrationError(f"Calibrating from the person needs two views, got {len(views)}.")
    everything = collect_evidence(views)
    _refuse_same_video(everything)
    evidence = everything.take(_choose(everything))
    known = _known_cameras(views, matrices, horizontal_fov_deg, fov_sigma_deg)
    body, middle = body_in_camera(evidence, known.matrices, stature.value)
    priors = BundlePriors(
        matrices=known.matrices,
        focal_sigma=known.focal_sigma,
        centre_sigma_px=known.centre_sigma_px,
        stature_m=stature.value,
        stature_sigma_m=stature.sigma if np.isfinite(stature.sigma) else 0.0,
        pitch_sigma_deg=pitch_sigma_deg,
        roll_sigma_deg=roll_sigma_deg,
        body=body,
    )
    evidence, solution, name = _solve(evidence, priors, middle)
    _refuse_doubtful(evidence, solution)
    found = _describe(views, evidence, priors, solution, known, name)
    _refuse_other_movement(everything, found)
    return found


@dataclass(frozen=True, eq=False)
class _KnownCameras:
    """Matrices (2, 3, 3), relative errors of the focal lengths, errors of the centres in px."""

    matrices: Array
    focal_sigma: Array
    centre_sigma_px: Array
    is_given: tuple[bool, ...]


def _known_cameras(
    views: Sequence[ViewPose],
    matrices: Sequence[Array | None] | None,
    horizontal_fov_deg: float,
    fov_sigma_deg: float,
) -> _KnownCameras:
    given = [None] * len(views) if matrices is None else list(matrices)
    if len(given) != len(views):
        raise CalibrationError(
            f"Expected a camera matrix or None for each of {len(views)} views, got {len(given)}."
        )
    found = [
        assumed_camera_matrix(view.info.size_px, horizontal_fov_deg=horizontal_fov_deg)
        if matrix is None
        else np.asarray(matrix, dtype=np.float64)
        for view, matrix in zip(views, given, strict=True)
    ]
    # The focal length is half the side over tan(fov / 2): its relative error is that of the field
    # of view over its sine.
    assumed = np.radians(fov_sigma_deg) / np.sin(np.radians(horizontal_fov_deg))
    is_given = np.array([matrix is not None for matrix in given])
    longer = np.array([max(view.info.size_px) for view in views])
    return _KnownCameras(
        np.stack(found),
        np.where(is_given, KNOWN_FOCAL_SIGMA, assumed),
        np.where(is_given, KNOWN_CENTRE_SIGMA, CENTRE_SIGMA) * longer,
        tuple(bool(g) for g in is_given),
    )


def _refuse_same_video(evidence: Evidence) -> None:
    if evidence.sizes_px[0] != evidence.sizes_px[1]:
        return
    apart = np.linalg.norm(evidence.pixels[0] - evidence.pixels[1], axis=-1)
    apart = apart[np.isfinite(apart)]
    if apart.size and np.median(apart) < SAME_VIEW_SHARE * np.nanmean(evidence.height_px):
        raise CalibrationError(
            "Two different views are needed, but both videos show the person from the same place; "
            "give the video of the other camera as the second one."
        )


def _choose(evidence: Evidence) -> NDArray[np.intp]:
    """Choose the frames to use; refuse where there are not enough or nothing moves."""
    frames = choose_frames(evidence, FRAMES)
    if frames.size < FEWEST_FRAMES or not np.isfinite(evidence.height_px).all():
        raise CalibrationError(
            f"Expected the whole person, from head to feet, in both views at once in at least "
            f"{FEWEST_FRAMES} frames, but that is so in {frames.size}; check that the videos are "
            "synchronised, and film so that both cameras see the whole person."
        )
    motion = _measure_motion(evidence.take(frames))
    if motion < LEAST_MOTION:
        raise CalibrationError(
            f"The person hardly moves (joints by {100 * motion:.1f} % of the height), which leaves "
            "the cameras' places open; film a squat, some steps or a lift, or calibrate with a "
            "board."
        )
    return frames


def _measure_motion(evidence: Evidence) -> float:
    """Return how far joints move against each other, as a share of the height, larger view."""
    relative = evidence.pixels / evidence.height_px[:, None, None, None]
    shown = np.where(shared_joints(evidence)[None, :, :, None], relative, np.nan)
    counts = np.isfinite(shown[0, ..., 0]).sum(axis=0)
    shown = shown[:, :, counts >= FEWEST_FRAMES]
    if not shown.size:
        return 0.0
    spread = np.nanpercentile(shown, 90, axis=1) - np.nanpercentile(shown, 10, axis=1)
    return float(np.mean(np.linalg.norm(spread, axis=-1), axis=1).max())


def _solve(
    evidence: Evidence, priors: BundlePriors, middle: Array
) -> tuple[Evidence, Solution, str]:
    """Try every first guess on a few frames, then adjust the best on all."""
    few = np.unique(np.linspace(0, evidence.n_frames - 1, START_FRAMES).round().astype(int))
    # Which feet stand on the floor is known once up is: a foot may be held still in the air.
    part, part_priors = evidence.take(few).without_floor(), priors.take(few)
    best: tuple[float, str, BundleState] | None = None
    for start in list_starts(evidence, priors.matrices, priors.body, middle):
        up = _guess_up(part, start.points[few])
        shared = start_shared(priors, start.translation)
        state = BundleState(shared, start.rotation, up, start.points[few])
        found = solve_bundle(part, part_priors, state, max_steps=START_STEPS)
        if best is not None and _agree(found, *best[::2]):
            break
        if best is None or found.cost < best[0]:
            best = (found.cost, start.name, replace(found.state, points=start.points))
    if best is None:
        raise CalibrationError(
            "Calibrating from the person needs joints that both cameras see clearly, but there are "
            "too few; put the cameras so that both see the whole person."
        )
    state = _place_points(evidence.without_floor(), priors, best[2])
    evidence, state = _find_floor(evidence, state)
    return evidence, solve_bundle(evidence, priors, state), best[1]


def _agree(found: Solution, cost: float, state: BundleState) -> bool:
    """Return whether another first guess led to the same cameras."""
    cosine = (np.trace(found.state.rotation @ state.rotation.T) - 1.0) / 2.0
    return bool(abs(found.cost / cost - 1.0) < 0.02 and cosine > np.cos(np.radians(2.0)))


def _guess_up(evidence: Evidence, points: Array) -> Array:
    """Return the direction from feet to head in the frames in which the person stands tallest."""
    ears, feet = ([column(f"{s}_{n}") for s in ("left", "right")] for n in ("ear", "ankle"))
    axis = points[:, ears].mean(axis=1) - points[:, feet].mean(axis=1)
    tall = axis[evidence.is_upright] if evidence.is_upright.any() else axis
    mean = np.median(tall, axis=0)
    return np.asarray(mean / np.linalg.norm(mean))


def _find_floor(evidence: Evidence, state: BundleState) -> tuple[Evidence, BundleState]:
    """Take the lowest resting feet as the floor; feet at rest above it do not stand on it."""
    height = state.points[:, FEET] @ state.up
    resting = np.where(evidence.is_planted, height, np.nan)
    if not evidence.is_planted.any():
        return evidence, state
    lowest = float(np.nanpercentile(resting, 10))
    shared = np.array(state.shared)
    shared[FLOOR] = lowest - TOE_M
    planted = evidence.is_planted & (height < lowest + LIFTED_FOOT_M)
    return replace(evidence, is_planted=planted), replace(state, shared=shared)


def _place_points(evidence: Evidence, priors: BundlePriors, state: BundleState) -> BundleState:
    """Let the joints of all frames find their places while the cameras stay."""
    bundle = Bundle(evidence, priors)
    for _ in range(5):
        state = replace(state, points=state.points + bundle.step_system(state).solve_points())
    return state


def _refuse_doubtful(evidence: Evidence, solution: Solution) -> None:
    """Refuse what the data contradict or do not tell."""
    misfit = _misfit(evidence, solution)
    if misfit > LARGEST_MISFIT:
        raise CalibrationError(_not_the_same(misfit))
    angle = _ray_angle_deg(solution.state)
    if angle < RAY_ANGLE_DEG[0]:
        raise CalibrationError(
            f"The cameras look from nearly the same direction ({angle:.0f} degrees apart), so "
            "depth can't be told; put them 60 to 110 degrees apart around the person."
        )
    if angle > RAY_ANGLE_DEG[1]:
        raise CalibrationError(
            f"The cameras look at each other ({angle:.0f} degrees apart), so depth can't be told; "
            "put them 60 to 110 degrees apart around the person."
        )
    sigma = _rms_sigma(solution.covariance, ROTATION)
    if np.degrees(sigma) > LARGEST_ROTATION_SIGMA_DEG:
        raise CalibrationError(
            f"The movement leaves the cameras' directions open by {np.degrees(sigma):.0f} degrees; "
            "film a larger movement (a squat, some steps), or calibrate with a board."
        )


def _refuse_other_movement(everything: Evidence, found: Calibration) -> None:
    """Refuse views whose lines of sight meet at some times but not at others."""
    miss = float(miss_by_shift(everything, found.cameras, (0,), is_robust=True)[0])
    if miss > LARGEST_MISS_OVER_TIME:
        raise CalibrationError(_not_the_same(miss))


def _not_the_same(miss: float) -> str:
    return (
        "The two videos can't show the same person at the same time: seen together, joints are "
        f"off by {100 * miss:.1f} % of the height; check that both are of the same lift and "
        "synchronised."
    )


def _misfit(evidence: Evidence, solution: Solution) -> float:
    """Return the typical distance in the pictures of confident joints, as a share of the height.

    The median over the frames, so that a few with exchanged sides don't count, then the mean
    over the joints.
    """
    share = solution.residual_px / evidence.height_px[:, None, None]
    seen = shared_joints(evidence, confidence=0.5)
    shown = np.where(seen, share, np.nan)[:, :, seen.sum(axis=0) >= 5]
    return float(np.mean(np.nanmedian(shown, axis=1))) if shown.size else 0.0


def _ray_angle_deg(state: BundleState) -> float:
    """Return the angle at the person between the directions to the cameras, degrees."""
    middle = np.median(state.points.reshape(-1, 3), axis=0)
    first, second = -middle, _second_centre(state) - middle
    cosine = first @ second / (np.linalg.norm(first) * np.linalg.norm(second))
    return float(np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0))))


def _second_centre(state: BundleState) -> Array:
    return np.asarray(-state.rotation.T @ state.shared[TRANSLATION])


def _rms_sigma(covariance: Array, where: slice) -> float:
    return float(np.sqrt(np.mean(np.diag(covariance)[where])))


def _world_axes(state: BundleState) -> tuple[Array, Array]:
    """Return the world's axes (rows) and origin in the first camera's axes."""
    up = state.up
    feet = [column(f"{side}_ankle") for side in ("left", "right")]
    foot = np.median(state.points[:, feet].mean(axis=1), axis=0)
    origin = foot + (state.shared[FLOOR] - foot @ up) * up
    towards = 0.5 * _second_centre(state) - origin
    towards -= (towards @ up) * up
    if np.linalg.norm(towards) < 1e-3:
        towards = np.cross(up, [1.0, 0.0, 0.0])
    forward = towards / np.linalg.norm(towards)
    return np.stack([forward, up, np.cross(forward, up)]), origin


def _describe(
    views: Sequence[ViewPose],
    evidence: Evidence,
    priors: BundlePriors,
    solution: Solution,
    known: _KnownCameras,
    start: str,
) -> Calibration:
    state, covariance = solution.state, solution.covariance
    axes, origin = _world_axes(state)
    distance = float(np.median(np.linalg.norm(state.points, axis=-1)))
    # Cameras that are far from level make the prior that they are level doubtful.
    tilt_sigma = float(np.degrees(_rms_sigma(covariance, UP))) * max(1.0, solution.level_misfit)
    floor_sigma = FLOOR_SIGMA_M
    if not evidence.has_upright:
        tilt_sigma = float(np.hypot(tilt_sigma, NEVER_UPRIGHT_TILT_DEG))
        floor_sigma = float(np.hypot(floor_sigma, NEVER_UPRIGHT_FLOOR_M))
    bundle = Bundle(evidence, priors)
    focal, centre = bundle.matrices(state.shared)
    poses = (
        (axes.T, origin),
        (state.rotation @ axes.T, state.rotation @ origin + state.shared[TRANSLATION]),
    )
    cameras = []
    for v, (view, (rotation, translation)) in enumerate(zip(views, poses, strict=True)):
        matrix = np.diag([*focal[v], 1.0])
        matrix[:2, 2] = centre[v]
        name = view.info.file_name or f"camera {v + 1}"
        cameras.append(Camera(name, view.info.size_px, matrix, rotation, translation))
    return Calibration(
        cameras=tuple(cameras),
        source="person",
        up=np.array([0.0, 1.0, 0.0]),
        floor_m=0.0,
        scale_sigma=_rms_sigma(covariance, slice(SPAN, SPAN + 1)),
        # Half of a joint's error is told as a turn and half as a shift of the lines of sight.
        rotation_sigma_deg=float(np.degrees(np.sqrt(0.5) * solution.shape_sigma_m / distance)),
        translation_sigma_m=float(np.sqrt(0.5) * solution.shape_sigma_m),
        tilt_sigma_deg=tilt_sigma,
        floor_sigma_m=floor_sigma,
        provenance={
            "method": "joints of the moving person",
            "frames": evidence.n_frames,
            "upright_frames": int(evidence.is_upright.sum()) if evidence.has_upright else 0,
            "start": start,
            "reprojection_px": round(float(np.nanmedian(solution.residual_px)), 2),
            "misfit_percent": round(100.0 * _misfit(evidence, solution), 2),
            "ray_angle_deg": round(_ray_angle_deg(state), 1),
            "camera_matrix": "given" if all(known.is_given) else "assumed and refined",
            "pose_rotation_sigma_deg": round(
                float(np.degrees(_rms_sigma(covariance, ROTATION))), 3
            ),
            "pose_translation_sigma_m": round(_rms_sigma(covariance, TRANSLATION), 4),
            "focal_sigma_percent": round(100.0 * _rms_sigma(covariance, FOCAL), 2),
            "joint_sigma_m": round(solution.shape_sigma_m, 4),
        },
    )
