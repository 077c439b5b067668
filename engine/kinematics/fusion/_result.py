"""From the fitted figure to a track: where every landmark's joint is, and how certain that is."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from scipy.ndimage import gaussian_filter1d

from engine.datatypes import Array
from engine.kinematics.fitting._clip import ROOT, ClipProblem

__all__ = [
    "DEFINITION_DEG",
    "DEFINITION_M",
    "OTHER_DEFINITION_DEG",
    "OTHER_DEFINITION_M",
    "carry_along",
    "part_of",
    "place_points",
    "point_variance",
]

DEVIATION_M: Mapping[str, float] = {"shoulder": 0.05}
OTHER_DEVIATION_M = 0.01
"""How far a joint may be from that of a figure of rigid segments: shoulders ride on the shoulder
girdle, the others hardly move."""
DEVIATION_SMOOTH_S = 0.1

DEFINITION_M: Mapping[str, float] = {
    "shoulder": 0.020,
    "elbow": 0.012,
    "wrist": 0.008,
    "hip": 0.025,
    "knee": 0.015,
    "heel": 0.030,
    "big_toe": 0.020,
}
OTHER_DEFINITION_M = 0.012
"""How far a landmark sits from the centre of its joint, per coordinate: what no fit can show."""

DEFINITION_DEG: Mapping[str, float] = {
    **dict.fromkeys(("trunk_inclination", "trunk_flexion", "trunk_lateral_bend"), 4.5),
    "knee_flexion": 3.0,
    "ankle_dorsiflexion": 4.5,
    **{f"shoulder_{motion}": 7.0 for motion in ("flexion", "adduction", "rotation")},
}
OTHER_DEFINITION_DEG = 2.0
"""What that costs an angle."""


RIDERS: Mapping[str, str] = {
    **{
        f"{side}_{part}": f"{side}_wrist"
        for side in ("left", "right")
        for part in ("pinky", "index", "thumb")
    },
    **dict.fromkeys(
        (
            *(
                f"{side}_eye{part}"
                for side in ("left", "right")
                for part in ("_inner", "", "_outer")
            ),
            "left_mouth",
            "right_mouth",
        ),
        "nose",
    ),
}
"""Keypoints that the figure has not, and the one each of them goes along with: their landmarks err
together, so what lies between them is better known than either."""
MAX_REACH_M = 0.15
RIDER_SIGMA_M = 0.015


def carry_along(
    keypoints: Sequence[str], start: Array, position: Array, sigma: Array, fitted: Sequence[int]
) -> None:
    """Move keypoints that the figure has not along with those it has, in place.

    Parameters
    ----------
    keypoints
        The K names.
    start
        Shape (T, K, 3), m: where everything was before the fit.
    position, sigma
        Shape (T, K, 3) and (T, K), m, already right for the keypoints at `fitted`.
    fitted
        Places of the figure's points among the keypoints.
    """
    for name, base in RIDERS.items():
        if name not in keypoints or base not in keypoints:
            continue
        own, other = keypoints.index(name), keypoints.index(base)
        if other not in fitted:
            continue
        offset = start[:, own] - start[:, other]
        reach = np.linalg.norm(offset, axis=1, keepdims=True)
        offset = offset * np.minimum(1.0, MAX_REACH_M / np.maximum(reach, 1e-9))
        position[:, own] = position[:, other] + offset
        sigma[:, own] = np.hypot(sigma[:, other], RIDER_SIGMA_M)


def point_variance(problem: ClipProblem, state: Array, covariance: Array) -> Array:
    """Return the variance of the figure's points, mean over the axes, shape (P, T), m^2.

    Parameters
    ----------
    problem, state
        The fit.
    covariance
        Shape (T, n, n), of the unknowns.
    """
    posture = problem.tree.place(problem.spread(state), problem.lengths)
    n_points, _, n_frames = posture.points.shape
    slope = np.zeros((n_points, 3, state.shape[1], n_frames))
    for axis in range(3):
        slope[:, axis, axis] = 1.0
    slope[:, :, ROOT:] = problem.tree.differentiate(posture, problem.variables)
    rows = np.ascontiguousarray(slope.transpose(3, 0, 1, 2)).reshape(n_frames, -1, state.shape[1])
    variance = np.sum((rows @ covariance) * rows, axis=2)
    return np.asarray(variance.reshape(n_frames, n_points, 3).mean(axis=2).T)


def part_of(name: str) -> str:
    """Return a keypoint's name without its side."""
    return name.removeprefix("left_").removeprefix("right_")


def place_points(
    names: Sequence[str], figure: Array, information: Array, gradient: Array, interval_s: float
) -> Array:
    """Let joints deviate from the rigid figure as far as the pictures say and a body allows.

    Parameters
    ----------
    names
        The P points.
    figure
        Shape (P, 3, T), m.
    information, gradient
        Of the pictures around the figure, shape (P, 3, 3, T) and (P, 3, T).
    interval_s
        Between frames.

    Returns
    -------
    Array
        Shape (P, 3, T), m.
    """
    sigma = np.array([DEVIATION_M.get(part_of(name), OTHER_DEVIATION_M) for name in names])
    own = np.eye(3) / sigma[:, None, None, None] ** 2
    shift = -np.linalg.solve(
        np.moveaxis(information, 3, 1) + own, np.moveaxis(gradient, 2, 1)[..., None]
    )[..., 0]
    if shift.shape[1] > 1:
        shift = gaussian_filter1d(shift, DEVIATION_SMOOTH_S / interval_s, axis=1, mode="nearest")
    return np.asarray(figure + np.moveaxis(shift, 1, 2))
