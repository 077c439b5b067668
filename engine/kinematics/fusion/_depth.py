"""What a network believes of depth, made usable: its differences, freed of their lasting bias.

A network seeing one picture gets the course of a depth right far better than its size: the far
elbow of someone seen from the side is drawn some 20 cm too near throughout. How much, is read off
the frames in which both cameras see the two points well.
"""

from __future__ import annotations

import numpy as np

from engine.datatypes import Array
from engine.kinematics.fusion._pictures import DepthBeliefs, PictureProblem
from engine.kinematics.fusion._sight import Sight

__all__ = ["believe_depths"]

_BOTH = ("left", "right")
PAIRS: tuple[tuple[str, str, float], ...] = (
    ("left_hip", "right_hip", 0.03),
    ("left_shoulder", "right_shoulder", 0.075),
    *(
        (f"{side}_{a}", f"{side}_{b}", sigma)
        for side in _BOTH
        for a, b, sigma in (
            ("hip", "shoulder", 0.15),
            ("hip", "knee", 0.12),
            ("knee", "ankle", 0.12),
            ("hip", "elbow", 0.09),
            ("shoulder", "wrist", 0.12),
            ("heel", "big_toe", 0.075),
        )
    ),
)
"""Pairs of points, and the standard error of their difference in depth without its bias, m."""
BIAS_SIGMA_M = 0.15
ALIKE_FRAMES = 20.0
"""Errors of neighbouring frames repeat each other: so many count for one."""
TRIANGULATED_WITHIN_M = 0.5


def believe_depths(
    problem: PictureProblem, placed: Array, sight: Sight, axes: Array
) -> DepthBeliefs:
    """Turn the network's depths into statements on the figure.

    Parameters
    ----------
    problem
        With the landmarks in the pictures.
    placed
        Shape (P, 3, T), m: where the figure's points are, roughly.
    sight
        Of the figure's points.
    axes
        Shape (V, 3): the cameras' axes, in the figure's axes.
    """
    names = problem.tree.points
    pairs = [(a, b, sigma) for a, b, sigma in PAIRS if a in names and b in names]
    ends = np.array([(names.index(a), names.index(b)) for a, b, _ in pairs], dtype=np.intp)
    variance = np.array([sigma**2 for _, _, sigma in pairs])[:, None]
    first, last = ends[:, 0], ends[:, 1]
    believed = sight.depth[:, last] - sight.depth[:, first]
    is_known = np.isfinite(believed)
    seen, uncertain = _triangulate(problem, placed, axes)
    weight = is_known / (uncertain[:, last] + uncertain[:, first] + variance) / ALIKE_FRAMES
    off = np.where(is_known, seen[:, last] - seen[:, first] - believed, 0.0)
    bias = (weight * off).sum(axis=2) / (weight.sum(axis=2) + BIAS_SIGMA_M**-2)
    depth = np.where(is_known, believed + bias[..., None], 0.0)
    return DepthBeliefs(ends, axes, depth, is_known / variance)


def _triangulate(problem: PictureProblem, placed: Array, axes: Array) -> tuple[Array, Array]:
    """Return depths of all points by the pictures alone, and their variance; (V, P, T) each."""
    information, gradient = problem.weigh_pictures(placed)
    covariance = np.linalg.inv(
        np.moveaxis(information, 3, 1) + np.eye(3) / TRIANGULATED_WITHIN_M**2
    )
    points = placed - np.einsum("ptij,pjt->pit", covariance, gradient)
    depth = np.einsum("pct,vc->vpt", points, axes)
    return depth, np.einsum("vi,ptij,vj->vpt", axes, covariance, axes, optimize=True)
