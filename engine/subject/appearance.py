"""What a person looks like: colours of the upper and the lower half of a box.

Enough to tell two persons apart after they covered each other, unless they are dressed alike.
"""

from __future__ import annotations

from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from engine.datatypes import Array, PersonBox

__all__ = ["compare_appearance", "describe_appearance"]

BANDS: Final = ((0.15, 0.5), (0.5, 0.9))
"""Parts of the box's height: trunk, legs."""
CENTRAL: Final = (0.25, 0.75)
"""Part of the box's width that is mostly person."""
PATCH_PX: Final = (16, 24)
N_BINS: Final = 8


def describe_appearance(image: NDArray[np.uint8], box: PersonBox) -> Array:
    """Return the colour histogram of a person.

    Parameters
    ----------
    image
        Shape (H, W, 3), RGB.
    box
        The person; px.

    Returns
    -------
    Array
        Shape (2, 8 * 8 + 8): for trunk and legs the shares of the colours (Lab's a, b) and
        of the brightness, each summing to 1; NaN if the box lies outside the picture.
    """
    return np.stack([_describe_band(image, box, band) for band in BANDS])


def compare_appearance(a: Array, b: Array) -> float:
    """Return how alike two persons look, 0 to 1 (mean Bhattacharyya coefficient)."""
    # Colours and brightness sum to 1 each, so a row's coefficients sum to at most 2.
    return float(np.sqrt(a * b).sum(axis=1).mean() / 2)


def _describe_band(image: NDArray[np.uint8], box: PersonBox, band: tuple[float, float]) -> Array:
    height, width = image.shape[:2]
    box_width, box_height = box.size_px
    left, right = (int(np.clip(box.left + s * box_width, 0, width)) for s in CENTRAL)
    top, bottom = (int(np.clip(box.top + s * box_height, 0, height)) for s in band)
    if right <= left or bottom <= top:
        return np.full(N_BINS**2 + N_BINS, np.nan)
    patch = cv2.resize(image[top:bottom, left:right], PATCH_PX, interpolation=cv2.INTER_AREA)
    lab = cv2.cvtColor(patch, cv2.COLOR_RGB2Lab).reshape(-1, 3)
    # Clothes lie close to grey: the bins cover the middle half of a and b.
    colour = np.clip((lab[:, 1:].astype(np.intp) - 64) * N_BINS // 128, 0, N_BINS - 1)
    light = lab[:, 0].astype(np.intp) * N_BINS // 256
    chroma = np.bincount(colour[:, 0] * N_BINS + colour[:, 1], minlength=N_BINS**2)
    return np.concatenate([chroma, np.bincount(light, minlength=N_BINS)]) / len(lab)
