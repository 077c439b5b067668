"""Calibration with a printed board that both cameras film.

Lenses come from all views of the board, the place of the cameras from those in which both see it at
the same time, with the board at rest. All of it is found at once, by bundle adjustment. The
world is that of the first camera; a view of the board on the floor tells up and floor too.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Iterable, Sequence
from dataclasses import replace
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from engine.cameras._adjust import Adjusted, Bundle, Lens, LensPrior, Sighting, adjust
from engine.cameras._board_poses import (
    CORNER_SIGMA_PX,
    LEAST_PAIRS,
    Pair,
    Pose,
    agree,
    relate_back,
    reprojection,
    solve_poses,
    turn_view,
)
from engine.cameras._board_timing import find_offset
from engine.cameras._board_views import BoardSpec, BoardView, Sightings, collect_views
from engine.datatypes import Array, Calibration, Camera, Frame, ProgressCallback, ignore_progress
from engine.errors import CalibrationError

__all__ = ["BoardSpec", "calibrate_board"]

MOST_VIEWS = 24
MOST_PAIRS = 20
LEAST_VIEWS = 6
LEAST_COVERAGE = 0.35
"""Share of the picture, in cells of a quarter by a third, that the board must have been in."""
MOST_FOCAL_SIGMA = 0.02
MOST_BLUR_PX = 2.0
"""Pairs in which the board moves farther than this within the uncertainty of time are left out."""
SAME_TIME_S = 0.06
KNOWN_TIME_SIGMA_S = 0.015
FOUND_TIME_SIGMA_S = 0.1
BASELINE_M = (0.4, 25.0)
MOST_RMS_SHARE = 0.0015
"""Largest reprojection error, as a share of the picture's longer side: 3 px of 1920."""
FLOOR_THICKNESS_SIGMA_M = 0.003
BOARD_FLATNESS_SIGMA_DEG = 0.3


def calibrate_board(
    frames_a: Iterable[Frame],
    frames_b: Iterable[Frame],
    board: BoardSpec,
    *,
    names: tuple[str, str] = ("first", "second"),
    lenses: tuple[Camera | None, Camera | None] = (None, None),
    offset_s: float | None = 0.0,
    floor_at_s: float | None = None,
    every_s: float = 0.2,
    are_stills: bool = False,
    progress: ProgressCallback = ignore_progress,
) -> Calibration:
    """Calibrate two cameras that filmed the same board.

    Parameters
    ----------
    frames_a, frames_b
        Pictures of each camera in order of time: of two videos, or stills with their number as
        the time.
    board
        The board, with its measured squares.
    names
        Of the cameras.
    lenses
        Cameras whose matrix and lens are known already; None to find them too.
    offset_s
        Added to the times of the second camera gives those of the first; None to find it from
        the movement of the board.
    floor_at_s
        Time of the first camera at which the board lies on the floor, face up.
    every_s
        Pictures nearer in time than this to the last one are left out.
    are_stills
        Whether the pictures are a few photographs, worth a longer look each.
    progress
        Called with what is done.

    Returns
    -------
    Calibration
        World: the first camera's axes, m.

    Raises
    ------
    CalibrationError
        If the pictures can't tell; the message says what to film.
    """
    look = functools.partial(
        collect_views, board=board, every_s=every_s, is_thorough=are_stills, progress=progress
    )
    both = (look(frames_a, name=names[0]), look(frames_b, name=names[1]))
    progress("calibrating", 0, 0)
    time_sigma_s = KNOWN_TIME_SIGMA_S
    if offset_s is None:
        offset_s, time_sigma_s = find_offset(both), FOUND_TIME_SIGMA_S
    pairs = _pair_views(both, offset_s, time_sigma_s)
    starts = tuple(
        _known_lens(lens, seen) if lens is not None else _find_lens(seen, board)
        for lens, seen in zip(lenses, both, strict=True)
    )
    relative, pairs, poses = agree(pairs, starts, board, names)
    floor = None if floor_at_s is None else _find_floor(both, floor_at_s, offset_s)
    problem = _build_problem(board, both, lenses, starts, relative, pairs, poses, floor)
    solution = _adjust_without_outliers(problem, is_first_held=floor is not None)
    return _finish(solution, both, board, lenses, floor, offset_s)


def _pair_views(
    both: tuple[Sightings, Sightings], offset_s: float, time_sigma_s: float
) -> list[Pair]:
    """Return views of the same moment in which the board rests, the most different ones."""
    second = both[1].views
    times = np.array([view.time_s + offset_s for view in second])
    near, resting = 0, []
    for first in both[0].views:
        index = int(np.argmin(np.abs(times - first.time_s)))
        if abs(times[index] - first.time_s) > SAME_TIME_S:
            continue
        near += 1
        speeds = (first.speed_px_s, second[index].speed_px_s)
        blur = max((s for s in speeds if math.isfinite(s)), default=0.0) * time_sigma_s
        if blur <= MOST_BLUR_PX:
            resting.append(Pair(first, second[index], math.hypot(CORNER_SIGMA_PX, blur)))
    if len(resting) < LEAST_PAIRS:
        what = "at rest in both" if near >= LEAST_PAIRS else "in both"
        raise CalibrationError(
            f"The board is {what} pictures at the same time only {len(resting)} times, expected "
            f"{LEAST_PAIRS} or more. Hold it for 2 s each at several places that both cameras see, "
            "and check the time between the videos."
        )
    features = [
        np.r_[_describe(p.first, both[0].size_px), _describe(p.second, both[1].size_px)]
        for p in resting
    ]
    return [resting[i] for i in _spread(np.array(features), MOST_PAIRS)]


def _describe(view: BoardView, size_px: tuple[int, int]) -> Array:
    """Return place, size and slant of a board in the picture, as shares of the picture."""
    flat = view.pixels / np.array(size_px)
    centred = flat - flat.mean(axis=0)
    slant = 10.0 * np.mean(np.prod(centred, axis=1))
    return np.concatenate([flat.mean(axis=0), np.sqrt(np.mean(centred**2, axis=0)), [slant]])


def _spread(features: Array, most: int) -> list[int]:
    """Return the indices of features far from each other, the first being the most usual one."""
    scaled = features / np.maximum(features.std(axis=0), 1e-3)
    chosen = [int(np.argmin(np.linalg.norm(scaled - np.median(scaled, axis=0), axis=1)))]
    distance = np.linalg.norm(scaled - scaled[chosen[0]], axis=1)
    while len(chosen) < min(most, len(scaled)) and distance.max() > 1e-6:
        chosen.append(int(np.argmax(distance)))
        distance = np.minimum(distance, np.linalg.norm(scaled - scaled[chosen[-1]], axis=1))
    return sorted(chosen)


def _choose_views(seen: Sightings) -> list[BoardView]:
    sharp = [v for v in seen.views if not v.speed_px_s * KNOWN_TIME_SIGMA_S > MOST_BLUR_PX]
    usable = sharp if len(sharp) >= LEAST_VIEWS else list(seen.views)
    features = np.array([_describe(view, seen.size_px) for view in usable])
    return [usable[i] for i in _spread(features, MOST_VIEWS)]


def _known_lens(camera: Camera, seen: Sightings) -> Lens:
    if camera.size_px != seen.size_px:
        raise CalibrationError(
            f"The lens given for {seen.name} is for {camera.size_px[0]} x {camera.size_px[1]} px, "
            f"its pictures have {seen.size_px[0]} x {seen.size_px[1]}; adapt it first."
        )
    return Lens.of(camera)


def _find_lens(seen: Sightings, board: BoardSpec) -> Lens:
    """Find a lens from the views of one camera, without those that don't fit it."""
    views = _choose_views(seen)
    if len(views) < LEAST_VIEWS:
        raise CalibrationError(
            f"Camera {seen.name} shows the board in {len(views)} different poses, expected "
            f"{LEAST_VIEWS} or more. Film it near, held still at many places of the picture, "
            "slanted to each side."
        )
    _require_coverage(seen)
    corners = board.corners
    for _ in range(3):
        _, matrix, distortion, _, _, _, _, errors = cv2.calibrateCameraExtended(
            [corners[v.rows].astype(np.float32) for v in views],
            [v.pixels.astype(np.float32).reshape(-1, 1, 2) for v in views],
            seen.size_px,
            _guess_matrix(seen.size_px),
            np.zeros(5),
            flags=cv2.CALIB_FIX_K3 | cv2.CALIB_USE_INTRINSIC_GUESS,
        )
        errors = np.asarray(errors).ravel()
        fits = errors <= max(3.0 * float(np.median(errors)), 0.5)
        if fits.all() or fits.sum() < LEAST_VIEWS:
            break
        views = [view for view, is_good in zip(views, fits, strict=True) if is_good]
    matrix = np.asarray(matrix, dtype=np.float64)
    centre = np.abs(matrix[:2, 2] / np.array(seen.size_px) - 0.5)
    if (
        not np.isfinite(matrix).all()
        or centre.max() > 0.3
        or matrix[0, 0] < 0.2 * max(seen.size_px)
    ):
        raise CalibrationError(
            f"The views of the board don't tell the lens of {seen.name}. Film it slanted by 30 to "
            "45 degrees to each side, near enough to fill half of the picture."
        )
    return Lens(
        np.r_[matrix[0, 0], matrix[1, 1], matrix[:2, 2], np.asarray(distortion).ravel()[:5]]
    )


def _guess_matrix(size_px: tuple[int, int]) -> Array:
    focal = 0.9 * max(size_px)
    return np.array(
        [[focal, 0.0, (size_px[0] - 1) / 2], [0.0, focal, (size_px[1] - 1) / 2], [0.0, 0.0, 1.0]]
    )


def _coverage(seen: Sightings) -> tuple[float, NDArray[np.bool_]]:
    """Return the share of 4 x 3 cells of the picture with corners, and the cells (3, 4)."""
    pixels = np.concatenate([view.pixels for view in seen.views])
    x, y = np.clip(pixels / np.array(seen.size_px), 0.0, 0.999).T
    is_seen: NDArray[np.bool_] = np.zeros((3, 4), dtype=bool)
    is_seen[(y * 3).astype(int), (x * 4).astype(int)] = True
    return float(is_seen.mean()), is_seen


def _require_coverage(seen: Sightings) -> None:
    share, is_seen = _coverage(seen)
    if share >= LEAST_COVERAGE:
        return
    heights, sides = ("upper", "middle", "lower"), ("left", "left", "right", "right")
    empty = dict.fromkeys(
        f"{heights[row]} {sides[column]}" for row, column in np.argwhere(~is_seen)
    )
    raise CalibrationError(
        f"The board was in {share:.0%} of the picture of {seen.name}, expected "
        f"{LEAST_COVERAGE:.0%} or more; film it near the camera, also {', '.join(empty)}."
    )


def _find_floor(
    both: tuple[Sightings, Sightings], floor_at_s: float, offset_s: float
) -> tuple[int, BoardView]:
    """Return the camera and its view of the board on the floor."""
    nearest = []
    for camera, seen in enumerate(both):
        shift = offset_s if camera else 0.0
        view = min(seen.views, key=lambda v: abs(v.time_s + shift - floor_at_s))
        nearest.append((abs(view.time_s + shift - floor_at_s), camera, view))
    gap_s, camera, view = min(nearest, key=lambda item: item[:2])
    if gap_s > 0.5:
        raise CalibrationError(
            f"The board on the floor was expected at {floor_at_s:g} s, but the nearest picture "
            f"with the board is {gap_s:.1f} s away. Give the time at which it lies in full view."
        )
    return camera, view


def _build_problem(
    board: BoardSpec,
    both: tuple[Sightings, Sightings],
    known: Sequence[Camera | None],
    lenses: Sequence[Lens],
    relative: Pose,
    pairs: Sequence[Pair],
    poses: Sequence[Pose],
    floor: tuple[int, BoardView] | None,
) -> Bundle:
    """Gather pairs, single views and the floor; the floor's body comes first."""
    bodies: list[Pose] = []
    sightings: list[Sighting] = []

    def see(camera: int, view: BoardView, sigma_px: float) -> None:
        sightings.append(Sighting(camera, len(bodies), view.rows, view.pixels, sigma_px))

    def place_single(camera: int, view: BoardView) -> None:
        options = solve_poses(view, lenses[camera], board)
        if not options:
            return
        pose = min(options, key=lambda p: reprojection(view, p, lenses[camera], board))
        see(camera, turn_view(view, pose, lenses[camera], board), CORNER_SIGMA_PX)
        bodies.append(pose if camera == 0 else relate_back(pose, relative))

    if floor is not None:
        place_single(*floor)
    for pair, pose in zip(pairs, poses, strict=True):
        see(0, pair.first, pair.sigma_px)
        see(1, pair.second, pair.sigma_px)
        bodies.append(pose)
    used = {id(view) for pair in pairs for view in (pair.first, pair.second)}
    for camera, seen in enumerate(both):
        if known[camera] is None:
            for view in _choose_views(seen):
                if id(view) not in used:
                    place_single(camera, view)
    return Bundle(
        lenses=tuple(lenses),
        lens_priors=tuple(
            LensPrior.exact(lens) if camera is not None else _loose_prior(lens, seen.size_px)
            for camera, lens, seen in zip(known, lenses, both, strict=True)
        ),
        camera_rotation=np.stack([np.eye(3), relative.rotation]),
        camera_translation=np.stack([np.zeros(3), relative.translation]),
        body_rotation=np.stack([pose.rotation for pose in bodies]),
        body_translation=np.stack([pose.translation for pose in bodies]),
        points=board.corners,
        sightings=tuple(sightings),
        is_camera_held=np.array([True, False]),
        is_body_held=np.zeros(len(bodies), dtype=bool),
    )


def _loose_prior(lens: Lens, size_px: tuple[int, int]) -> LensPrior:
    """Return what is true of every phone: an axis near the middle, a lens that bends little."""
    mean = np.r_[lens.values[:2], (np.array(size_px) - 1) / 2, np.zeros(5)]
    off_centre = 0.03 * max(size_px)
    sigma = np.r_[np.inf, np.inf, off_centre, off_centre, 0.3, 0.5, 0.01, 0.01, 0.0]
    return LensPrior(mean, sigma)


def _adjust_without_outliers(problem: Bundle, *, is_first_held: bool) -> Adjusted:
    """Adjust, leave out the board poses that fit far worse than the others, and adjust again.

    `is_first_held` keeps the first one, the board on the floor, whatever it fits like.
    """
    solution = adjust(problem)
    errors = np.array([np.sqrt(np.mean(np.sum(r * r, axis=1))) for r in solution.residual_px])
    bodies = np.array([sighting.body for sighting in problem.sightings])
    is_bad = np.zeros(len(problem.body_rotation), dtype=bool)
    np.logical_or.at(is_bad, bodies, errors > max(4.0 * float(np.median(errors)), 0.5))
    is_bad[0] &= not is_first_held
    n_pairs = int((np.bincount(bodies)[~is_bad] == 2).sum())
    if not is_bad.any() or n_pairs < LEAST_PAIRS:
        return solution
    numbers = np.cumsum(~is_bad) - 1
    found = solution.bundle
    return adjust(
        replace(
            found,
            body_rotation=found.body_rotation[~is_bad],
            body_translation=found.body_translation[~is_bad],
            is_body_held=found.is_body_held[~is_bad],
            sightings=tuple(
                replace(sighting, body=int(numbers[sighting.body]))
                for sighting in problem.sightings
                if not is_bad[sighting.body]
            ),
        )
    )


def _finish(
    solution: Adjusted,
    both: tuple[Sightings, Sightings],
    board: BoardSpec,
    known: Sequence[Camera | None],
    floor: tuple[int, BoardView] | None,
    offset_s: float,
) -> Calibration:
    bundle = solution.bundle
    _require_sharp(solution, both, known)
    cameras = tuple(
        Camera(
            seen.name,
            seen.size_px,
            bundle.lenses[index].matrix,
            bundle.camera_rotation[index],
            bundle.camera_translation[index],
            bundle.lenses[index].distortion,
        )
        for index, seen in enumerate(both)
    )
    baseline_m = float(np.linalg.norm(bundle.camera_translation[1]))
    if not BASELINE_M[0] <= baseline_m <= BASELINE_M[1]:
        raise CalibrationError(
            f"By squares of {board.square_m * 1000:g} mm the cameras are {baseline_m:.2f} m apart; "
            f"expected {BASELINE_M[0]:g} to {BASELINE_M[1]:g} m. Measure the squares on the print."
        )
    rotation_sigma_deg, translation_sigma_m = solution.relative_sigmas(0, 1)
    scale_sigma = board.size_sigma
    calibration = Calibration(
        cameras=cameras,
        source="board",
        scale_sigma=scale_sigma,
        rotation_sigma_deg=rotation_sigma_deg,
        translation_sigma_m=math.hypot(
            translation_sigma_m, scale_sigma * baseline_m / math.sqrt(3)
        ),
        provenance=_describe_solution(solution, both, board, offset_s),
    )
    return calibration if floor is None else _with_floor(calibration, solution)


def _require_sharp(
    solution: Adjusted, both: tuple[Sightings, Sightings], known: Sequence[Camera | None]
) -> None:
    longest = max(max(seen.size_px) for seen in both)
    if solution.rms_px > MOST_RMS_SHARE * longest:
        raise CalibrationError(
            f"The board's corners are off by {solution.rms_px:.1f} px, expected less than "
            f"{MOST_RMS_SHARE * longest:.1f}. Fix the print to something flat and stiff, hold it "
            "still, and film again."
        )
    for index, seen in enumerate(both):
        lens = solution.bundle.lenses[index]
        share = solution.lens_sigma(index)[0] / lens.values[0]
        if known[index] is None and share > MOST_FOCAL_SIGMA:
            raise CalibrationError(
                f"The focal length of {seen.name} is known to {share:.1%} only, expected "
                f"{MOST_FOCAL_SIGMA:.0%} or better. Film the board near the camera and slanted by "
                "30 to 45 degrees to each side."
            )


def _describe_solution(
    solution: Adjusted, both: tuple[Sightings, Sightings], board: BoardSpec, offset_s: float
) -> dict[str, Any]:
    seen_twice = np.bincount([s.body for s in solution.bundle.sightings]) == 2
    return {
        "method": f"{board.kind} of {board.columns} x {board.rows} squares of "
        f"{board.square_m * 1000:g} mm",
        "reprojection_px": round(solution.rms_px, 3),
        "views": [len([s for s in solution.bundle.sightings if s.camera == c]) for c in (0, 1)],
        "pairs": int(seen_twice.sum()),
        "coverage": [round(_coverage(seen)[0], 2) for seen in both],
        "focal_sigma_px": [round(float(solution.lens_sigma(c)[0]), 2) for c in (0, 1)],
        "offset_s": round(float(offset_s), 3),
        "notes": [],
    }


def _with_floor(calibration: Calibration, solution: Adjusted) -> Calibration:
    """Take up and floor from the first body, the board that lies on the floor."""
    bundle = solution.bundle
    normal = bundle.body_rotation[0][:, 2]
    place = bundle.body_translation[0] + bundle.body_rotation[0] @ bundle.points.mean(axis=0)
    up = normal if normal @ place < 0 else -normal
    centres = [-c.rotation.T @ c.translation for c in calibration.cameras]
    if min(float(up @ (centre - place)) for centre in centres) < 0:
        raise CalibrationError(
            "A camera would lie below the board on the floor; choose the moment at which the board "
            "lies on the floor with its face up."
        )
    covariance = solution.body_covariance(0)
    across = np.eye(3) - np.outer(up, up)
    tilt = math.sqrt(np.trace(across @ covariance[:3, :3] @ across) / 2)
    height = math.sqrt(up @ covariance[3:, 3:] @ up)
    return replace(
        calibration,
        up=up,
        floor_m=float(up @ place),
        tilt_sigma_deg=math.hypot(math.degrees(tilt), BOARD_FLATNESS_SIGMA_DEG),
        floor_sigma_m=math.hypot(height, FLOOR_THICKNESS_SIGMA_M),
    )
