"""How points in the world and points in a picture belong together.

OpenCV's camera model: pin-hole with the distortion coefficients k1, k2, p1, p2, k3. All functions
take points of any leading shape; NaN goes through as NaN.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike

from engine.datatypes import Array, Camera

__all__ = [
    "camera_centre",
    "compute_directions",
    "normalise_points",
    "place_on_rays",
    "project",
    "projection_jacobian",
    "to_camera_axes",
    "with_size",
]

_NEWTON_STEPS = 20
_CONVERGED = 1e-12


def to_camera_axes(camera: Camera, points: ArrayLike) -> Array:
    """Return world points in the camera's axes: x right, y down, z forward; shape (..., 3), m."""
    return np.asarray(np.asarray(points, dtype=np.float64) @ camera.rotation.T + camera.translation)


def camera_centre(camera: Camera) -> Array:
    """Return where the camera is in the world, shape (3,), m."""
    return np.asarray(-camera.rotation.T @ camera.translation)


def project(camera: Camera, points: ArrayLike) -> Array:
    """Project world points into the picture.

    Parameters
    ----------
    camera
        With its distortion.
    points
        Shape (..., 3), m.

    Returns
    -------
    Array
        Shape (..., 2), px; NaN for points that are not in front of the camera.
    """
    seen = to_camera_axes(camera, points)
    depth = np.where(seen[..., 2] > 0, seen[..., 2], np.nan)
    flat = _distort(seen[..., :2] / depth[..., None], camera.distortion)
    return np.asarray(flat @ camera.matrix[:2, :2].T + camera.matrix[:2, 2])


def projection_jacobian(camera: Camera, points: ArrayLike) -> Array:
    """Return the derivative of `project` by the world point, shape (..., 2, 3), px per m."""
    seen = to_camera_axes(camera, points)
    depth = np.where(seen[..., 2] > 0, seen[..., 2], np.nan)
    flat = seen[..., :2] / depth[..., None]
    by_flat = camera.matrix[:2, :2] @ _distortion_jacobian(flat, camera.distortion)
    perspective = np.zeros((*flat.shape[:-1], 2, 3))
    perspective[..., 0, 0] = perspective[..., 1, 1] = 1.0 / depth
    perspective[..., 2] = -flat / depth[..., None]
    return np.asarray(by_flat @ perspective @ camera.rotation)


def normalise_points(camera: Camera, pixels: ArrayLike) -> Array:
    """Undo the camera matrix and the distortion.

    Parameters
    ----------
    camera
        Whose picture it is.
    pixels
        Shape (..., 2), px.

    Returns
    -------
    Array
        Shape (..., 2), the line of sight at unit depth; NaN where the lens model can't have
        produced the point.
    """
    offset = np.asarray(pixels, dtype=np.float64) - camera.matrix[:2, 2]
    target = offset @ np.linalg.inv(camera.matrix[:2, :2]).T
    if not np.any(camera.distortion):
        return np.asarray(target)
    flat = target.copy()
    for _ in range(_NEWTON_STEPS):
        miss = _distort(flat, camera.distortion) - target
        if not np.nanmax(np.abs(miss), initial=0.0) > _CONVERGED:
            break
        flat = flat - _solve_2x2(_distortion_jacobian(flat, camera.distortion), miss)
    miss = np.abs(_distort(flat, camera.distortion) - target).max(axis=-1)
    # Beyond the fold of a strong lens model other points project there too, turned inside out.
    unfolded = _determinant(_distortion_jacobian(flat, camera.distortion)) > 0
    same_side = np.sum(flat * target, axis=-1) >= 0
    return np.where(((miss < 1e-6) & unfolded & same_side)[..., None], flat, np.nan)


def compute_directions(camera: Camera, pixels: ArrayLike) -> Array:
    """Return the unit directions of lines of sight in the world, shape (..., 3).

    Parameters
    ----------
    camera
        Whose picture it is; the lines start at `camera_centre`.
    pixels
        Shape (..., 2), px.
    """
    flat = normalise_points(camera, pixels)
    ray = np.concatenate([flat, np.ones((*flat.shape[:-1], 1))], axis=-1) @ camera.rotation
    return np.asarray(ray / np.linalg.norm(ray, axis=-1, keepdims=True))


def with_size(camera: Camera, size_px: tuple[int, int]) -> Camera:
    """Return the camera for its picture scaled to another size, each axis by its own factor."""
    scale = np.array(size_px, dtype=np.float64) / np.array(camera.size_px, dtype=np.float64)
    matrix = np.array(camera.matrix)
    matrix[:2, :2] *= scale[:, None]
    # Integers are pixel centres, so the picture's corner lies at -0.5.
    matrix[:2, 2] = (matrix[:2, 2] + 0.5) * scale - 0.5
    return replace(camera, matrix=matrix, size_px=size_px)


def _distort(flat: Array, coefficients: Array) -> Array:
    k1, k2, p1, p2, k3 = coefficients
    x, y = flat[..., 0], flat[..., 1]
    square = x * x + y * y
    radial = 1.0 + square * (k1 + square * (k2 + square * k3))
    return np.stack(
        [
            x * radial + 2.0 * p1 * x * y + p2 * (square + 2.0 * x * x),
            y * radial + p1 * (square + 2.0 * y * y) + 2.0 * p2 * x * y,
        ],
        axis=-1,
    )


def _distortion_jacobian(flat: Array, coefficients: Array) -> Array:
    k1, k2, p1, p2, k3 = coefficients
    x, y = flat[..., 0], flat[..., 1]
    square = x * x + y * y
    radial = 1.0 + square * (k1 + square * (k2 + square * k3))
    slope = 2.0 * (k1 + square * (2.0 * k2 + 3.0 * square * k3))
    jacobian = np.empty((*flat.shape[:-1], 2, 2))
    jacobian[..., 0, 0] = radial + slope * x * x + 2.0 * p1 * y + 6.0 * p2 * x
    jacobian[..., 1, 1] = radial + slope * y * y + 6.0 * p1 * y + 2.0 * p2 * x
    jacobian[..., 0, 1] = jacobian[..., 1, 0] = slope * x * y + 2.0 * p1 * x + 2.0 * p2 * y
    return jacobian


def _determinant(matrix: Array) -> Array:
    return np.asarray(matrix[..., 0, 0] * matrix[..., 1, 1] - matrix[..., 0, 1] * matrix[..., 1, 0])


def _solve_2x2(matrix: Array, right: Array) -> Array:
    (a, b), (c, d) = np.moveaxis(matrix, (-2, -1), (0, 1))
    with np.errstate(divide="ignore", invalid="ignore"):
        inverse = 1.0 / _determinant(matrix)
    x, y = right[..., 0], right[..., 1]
    return np.stack([(d * x - b * y) * inverse, (a * y - c * x) * inverse], axis=-1)


def place_on_rays(points: ArrayLike, rays: ArrayLike, weight: ArrayLike) -> Array:
    """Find where in front of a camera a body looks most like what was seen of it.

    Weighted linear least squares of ``points + place`` lying on the lines of sight.

    Parameters
    ----------
    points
        Shape (..., K, 3), camera axes; NaN where not known.
    rays
        Shape (..., K, 3), lines of sight with unit depth; NaN where not seen.
    weight
        Shape (..., K), at least 0.

    Returns
    -------
    Array
        Shape (..., 3), in the unit of the points; NaN where fewer than three points are known, or
        where they don't fit into the picture before the camera.
    """
    body, seen = np.asarray(points, dtype=np.float64), np.asarray(rays, dtype=np.float64)
    known = np.isfinite(body).all(axis=-1) & np.isfinite(seen).all(axis=-1)
    use = np.where(known, np.asarray(weight, dtype=np.float64), 0.0)
    known = use > 0
    body, seen = (np.where(known[..., None], values, 0.0) for values in (body, seen))
    x, y = seen[..., 0], seen[..., 1]
    off_x, off_y = x * body[..., 2] - body[..., 0], y * body[..., 2] - body[..., 1]
    one, sx, sy = use.sum(axis=-1), (use * x).sum(axis=-1), (use * y).sum(axis=-1)
    total = (use * (x**2 + y**2)).sum(axis=-1)
    right_x, right_y = (use * off_x).sum(axis=-1), (use * off_y).sum(axis=-1)
    right_z = -(use * (x * off_x + y * off_y)).sum(axis=-1)
    # The normal equations, with the two places across eliminated.
    with np.errstate(divide="ignore", invalid="ignore"):
        away = (right_z * one + sx * right_x + sy * right_y) / (total * one - sx**2 - sy**2)
        place = np.stack([(right_x + sx * away) / one, (right_y + sy * away) / one, away], axis=-1)
    depth = np.where(known, body[..., 2], np.inf).min(axis=-1) + away
    fits = (known.sum(axis=-1) >= 3) & (depth > 0)
    return np.where(fits[..., None], place, np.nan)
