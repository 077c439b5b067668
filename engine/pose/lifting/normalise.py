"""The numbers that lifting networks see: points of the picture in units of the person.

Training and use share this module, so that a network meets nothing it has not seen. The camera is
turned so that it looks at the person, points are centred on the pelvis's mean over the window and
divided by the size of the person in the picture: a network then needs neither the size of the
picture, nor the lens, nor where in the picture the person is.
"""

from __future__ import annotations

import numpy as np

from engine.datatypes import Array

__all__ = ["STATURE_SHARE", "prepare_points", "sight_axes", "stature_of"]

PELVIS = 0
_SEGMENTS = ((1, 2), (2, 3), (4, 5), (5, 6))
STATURE_SHARE = 0.245 + 0.246 + 0.288
"""Thigh, shank and trunk as shares of stature (Drillis and Contini), as elsewhere in LiftLens."""


def stature_of(joints: Array) -> Array:
    """Return the stature that the lengths of legs and trunk mean.

    Parameters
    ----------
    joints
        Shape (..., T, 17, 3); NaN where not known.

    Returns
    -------
    Array
        Shape (...), in the unit of the joints: the median over the frames.
    """
    legs = sum(
        0.5 * np.linalg.norm(joints[..., a, :] - joints[..., b, :], axis=-1) for a, b in _SEGMENTS
    )
    trunk = np.linalg.norm(joints[..., 8, :] - joints[..., PELVIS, :], axis=-1)
    return np.asarray(np.nanmedian(legs + trunk, axis=-1) / STATURE_SHARE)


def sight_axes(ray: Array) -> Array:
    """Return the axes of a camera that is turned to look along a line of sight, without roll.

    Parameters
    ----------
    ray
        Shape (..., 3), camera axes (x right, y down, z away).

    Returns
    -------
    Array
        Shape (..., 3, 3); the columns are right, down and forward of the turned camera in the axes
        of the first.
    """
    forward = ray / np.linalg.norm(ray, axis=-1, keepdims=True)
    right = np.stack([forward[..., 2], np.zeros_like(forward[..., 0]), -forward[..., 0]], axis=-1)
    right = right / np.linalg.norm(right, axis=-1, keepdims=True)
    down = np.cross(forward, right)
    return np.stack([right, down, forward], axis=-1)


def prepare_points(rays: Array, size: Array) -> tuple[Array, Array]:
    """Turn the camera to the person and give points in units of the person.

    Parameters
    ----------
    rays
        Shape (..., T, 17, 3), lines of sight in camera axes.
    size
        Shape (...), the stature at unit depth, that is stature divided by distance.

    Returns
    -------
    points
        Shape (..., T, 17, 2), statures; the pelvis's mean over the window is the origin.
    axes
        Shape (..., 3, 3), of the turned camera (see `sight_axes`): joints in its axes times the
        transpose are joints in the first camera's axes.
    """
    middle = np.nanmean(rays[..., PELVIS, :], axis=-2)
    axes = sight_axes(middle)
    turned = np.einsum("...tkj,...ji->...tki", rays, axes)
    points = turned[..., :2] / np.maximum(turned[..., 2:], 1e-3)
    centre = np.nanmean(points[..., PELVIS, :], axis=-2)
    points = (points - centre[..., None, None, :]) / np.asarray(size)[..., None, None, None]
    return np.asarray(points), axes
