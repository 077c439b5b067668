"""One posture from several hypotheses (Shan et al. 2023)."""

from __future__ import annotations

from typing import Literal

import numpy as np

from engine.datatypes import Array
from engine.optics import place_on_rays

__all__ = ["Aggregation", "aggregate", "reprojection_errors"]

Aggregation = Literal["jpma", "mean"]
FIT_LIMIT = 0.2
"""Reprojection errors above this share of the stature in the picture mean that the camera is not as
assumed; then the mean is taken."""


def reprojection_errors(hypotheses: Array, rays: Array, confidence: Array) -> Array:
    """Measure how far each joint of each hypothesis lies from what was seen.

    Each hypothesis is put, frame by frame, where it fits the lines of sight best.

    Parameters
    ----------
    hypotheses
        Shape (H, ..., K, 3), camera axes, any unit.
    rays
        Shape (..., K, 3), unit depth.
    confidence
        Shape (..., K), weights of the points.

    Returns
    -------
    Array
        Shape (H, ..., K), at unit depth; infinite where a hypothesis fits nowhere.
    """
    weight = np.broadcast_to(0.1 + 0.9 * confidence, hypotheses.shape[:-1])
    place = place_on_rays(hypotheses, np.broadcast_to(rays, hypotheses.shape), weight)
    points = hypotheses + place[..., None, :]
    with np.errstate(divide="ignore", invalid="ignore"):
        off = np.linalg.norm(points[..., :2] / points[..., 2:] - rays[..., :2], axis=-1)
    return np.where(np.isfinite(off), off, np.inf)


def aggregate(
    hypotheses: Array, rays: Array, confidence: Array, size: Array, how: Aggregation
) -> tuple[Array, Array]:
    """Join hypotheses.

    Parameters
    ----------
    hypotheses
        Shape (H, ..., K, 3).
    rays, confidence
        As in `reprojection_errors`.
    size
        Shape (...), broadcastable to the frames: the stature at unit depth.
    how
        `jpma`: joint by joint the hypothesis nearest to the picture; `mean`: their mean, which is
        also what jpma falls back to where the picture can't decide.

    Returns
    -------
    joints
        Shape (..., K, 3).
    spread
        Shape (..., K): standard deviation of the hypotheses, root mean square over the axes; NaN
        for a single one.
    """
    mean = hypotheses.mean(axis=0)
    if len(hypotheses) == 1:
        return mean, np.full(mean.shape[:-1], np.nan)
    spread = np.sqrt(hypotheses.var(axis=0, ddof=1).mean(axis=-1))
    if how == "mean":
        return mean, spread
    off = reprojection_errors(hypotheses, rays, confidence)
    best = np.take_along_axis(hypotheses, off.argmin(axis=0)[None, ..., None], axis=0)[0]
    trusted = off.min(axis=0) < FIT_LIMIT * np.asarray(size)[..., None]
    return np.where(trusted[..., None], best, mean), spread
