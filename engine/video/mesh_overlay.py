"""A body surface drawn half transparent into a picture."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from engine.datatypes import Array
from engine.errors import ShapeError

__all__ = ["draw_mesh"]

SURFACE = (238, 196, 120)
"""Colour of the surface in full light, RGB: neither the left's blue nor the right's vermillion."""
SHADE = 0.45
"""Brightness of what is seen edge-on."""
SUBPIXEL_BITS = 4


def draw_mesh(
    image: NDArray[np.uint8], points: Array, faces: NDArray[np.int32], *, opacity: float = 0.6
) -> None:
    """Draw a surface into a picture, in place.

    Parameters
    ----------
    image
        Shape (H, W, 3), RGB, uint8, writeable.
    points
        Shape (V, 3): x and y in px of this image, z away from the camera in the same scale.
        Nothing is drawn if one is NaN.
    faces
        Shape (F, 3), corners counted anticlockwise from outside, in axes where x, y, z are right-
        handed (x right, y down, z away).
    opacity
        0 to 1.

    Raises
    ------
    ShapeError
        If the shapes differ from these.
    """
    if points.ndim != 2 or points.shape[1] != 3 or faces.ndim != 2 or faces.shape[1] != 3:
        raise ShapeError(
            f"A surface needs points (V, 3) and faces (F, 3), got {points.shape} and {faces.shape}."
        )
    if not np.isfinite(points).all():
        return
    corner = points[faces]
    normal = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
    length = np.maximum(np.linalg.norm(normal, axis=1), 1e-12)
    facing = -normal[:, 2] / length
    # Far faces first; those turned away are not seen.
    order = np.argsort(-corner[:, :, 2].mean(axis=1))
    order = order[facing[order] > 0]
    light = SHADE + (1.0 - SHADE) * facing[order]
    colours = np.rint(light[:, None] * SURFACE).astype(int).tolist()
    shift = 1 << SUBPIXEL_BITS
    fixed = np.rint(np.clip(corner[order, :, :2], -4096, 12288) * shift).astype(np.int32)
    layer, mask = image.copy(), np.zeros(image.shape[:2], np.uint8)
    for triangle, colour in zip(fixed, colours, strict=True):
        cv2.fillConvexPoly(layer, triangle, colour, cv2.LINE_8, SUBPIXEL_BITS)
        cv2.fillConvexPoly(mask, triangle, 255, cv2.LINE_8, SUBPIXEL_BITS)
    mixed = cv2.addWeighted(layer, opacity, image, 1.0 - opacity, 0.0)
    image[mask > 0] = mixed[mask > 0]
