"""The correction as published by Choi et al. (2024), for comparison."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from engine.correction.gaps import fill_by_mean
from engine.correction.links import Links, find_edges, find_excursions
from engine.correction.smoothers import Median, smooth_runs
from engine.datatypes import Array

__all__ = ["PublishedCorrection", "correct_as_published"]

MEDIAN_WINDOW_S = 5.0 / 30.0
"""The paper gives no window; five frames at 30 frames/s."""


@dataclass(frozen=True, eq=False)
class PublishedCorrection:
    """Positions (T, K, D), what was removed (T, K) and which links are wrong mostly (J,)."""

    position: Array
    is_removed: NDArray[np.bool_]
    is_unsteady: NDArray[np.bool_]


def correct_as_published(time_s: Array, position: Array, links: Links) -> PublishedCorrection:
    """Remove joints of outlying links, fill by the mean of both sides, run a median filter.

    Both ends of a link count as wrong where its length jumps or stays off. Gaps of any length
    are filled, and held at the ends of the clip, because the paper does so; an exchange of
    sides is not recognised as such.

    Parameters
    ----------
    time_s
        Shape (T,), s.
    position
        Shape (T, K, D); NaN where missing.
    links
        Lengths measured on `position`.

    Returns
    -------
    PublishedCorrection
        NaN remains only for keypoints that were never right.

    References
    ----------
    .. [1] Choi et al. (2024), the correction by link lengths.
    """
    edges = find_edges(time_s, links.length_cm)
    excursion, _ = find_excursions(time_s, links.length_cm, edges)
    wrong = excursion | edges.is_edge
    removed = np.zeros(position.shape[:2], dtype=bool)
    for j, ends in enumerate(links.ends):
        removed[:, ends] |= wrong[:, [j]]
    kept = np.where(removed[:, :, None], np.nan, position)
    filled = np.stack([fill_by_mean(kept[:, k]) for k in range(kept.shape[1])], axis=1)
    smoothed = smooth_runs(Median(MEDIAN_WINDOW_S), time_s, filled)
    return PublishedCorrection(smoothed, removed, edges.is_unsteady)
