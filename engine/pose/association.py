"""Whether landmarks belong to the person they should belong to.

A landmark network that follows its own region can slide to somebody else when people cross,
and its probability of a person stays near 1. The boxes of the person detector tell.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Final

import numpy as np
from numpy.typing import NDArray

from engine.datatypes import Array, PersonBox

__all__ = ["agrees_with_box", "bound_landmarks", "compute_box_iou", "interpolate_box"]

MIN_CONFIDENCE: Final = 0.5
"""Landmarks below this are guesses of hidden or missing parts and say nothing of the place."""
MIN_LANDMARKS: Final = 6
STRICT_IOU: Final = 0.3
LOOSE_IOU: Final = 0.1
MIN_SHARE_INSIDE: Final = 0.7
BOX_TOLERANCE: Final = 0.1
"""By this share of its larger side a box may miss limbs, on every side."""


def bound_landmarks(points: Array, confidence: Array) -> Array | None:
    """Return left, top, right, bottom of the confident landmarks; None if they are too few.

    Parameters
    ----------
    points
        Shape (K, 2), px.
    confidence
        Shape (K,), 0 to 1.
    """
    sure = points[_is_sure(points, confidence)]
    if len(sure) < MIN_LANDMARKS:
        return None
    return np.concatenate([sure.min(axis=0), sure.max(axis=0)])


def agrees_with_box(
    points: Array,
    confidence: Array,
    box: PersonBox,
    others: Sequence[PersonBox] = (),
    *,
    is_observed: bool = True,
) -> bool:
    """Whether landmarks fit a person's box, and no other person's box better.

    Parameters
    ----------
    points, confidence
        Shape (K, 2) in px and (K,).
    box
        The person the landmarks should belong to.
    others
        The other persons in the picture.
    is_observed
        Whether `box` was seen in this very frame; a predicted box is checked less strictly.
    """
    hull = bound_landmarks(points, confidence)
    if hull is None:
        return False
    own = compute_box_iou(_as_box(hull), box)
    if own < (STRICT_IOU if is_observed else LOOSE_IOU):
        return False
    if any(compute_box_iou(_as_box(hull), other) > own for other in others):
        return False
    return not is_observed or _share_inside(points, confidence, box) >= MIN_SHARE_INSIDE


def interpolate_box(before: PersonBox, after: PersonBox, share: float) -> PersonBox:
    """Return the box `share` of the way from one to another."""

    def between(a: float, b: float) -> float:
        return (1 - share) * a + share * b

    return PersonBox(
        left=between(before.left, after.left),
        top=between(before.top, after.top),
        right=between(before.right, after.right),
        bottom=between(before.bottom, after.bottom),
    )


def _is_sure(points: Array, confidence: Array) -> NDArray[np.bool_]:
    return np.asarray((confidence >= MIN_CONFIDENCE) & np.isfinite(points).all(axis=1))


def _share_inside(points: Array, confidence: Array, box: PersonBox) -> float:
    sure = points[_is_sure(points, confidence)]
    margin = BOX_TOLERANCE * max(box.size_px)
    low = np.array([box.left, box.top]) - margin
    high = np.array([box.right, box.bottom]) + margin
    return float(((sure >= low) & (sure <= high)).all(axis=1).mean())


def compute_box_iou(a: PersonBox, b: PersonBox) -> float:
    """Return the intersection over union of two boxes, 0 to 1."""
    width = min(a.right, b.right) - max(a.left, b.left)
    height = min(a.bottom, b.bottom) - max(a.top, b.top)
    inter = max(width, 0.0) * max(height, 0.0)
    union = math.prod(a.size_px) + math.prod(b.size_px) - inter
    return inter / union if union > 0 else 0.0


def _as_box(hull: Array) -> PersonBox:
    left, top, right, bottom = hull.tolist()
    return PersonBox(left=left, top=top, right=right, bottom=bottom)
