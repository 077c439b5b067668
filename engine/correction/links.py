"""Lengths of the ten body links, in centimetres of a person of known stature.

Bones don't change their length, so a link that does shows a wrong joint (Choi et al. 2024).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from engine.correction.robust import (
    close_gaps,
    frame_interval_s,
    known_median,
    last_known,
    mad_sigma,
    odd_window,
    running_median,
    runs_that_touch,
    widen,
)
from engine.datatypes import Array, PoseTrack
from engine.skeletons import BODY_SEGMENTS, Skeleton, get_skeleton

__all__ = [
    "ADULT_STATURE_M",
    "EdgeTest",
    "Links",
    "find_edges",
    "find_excursions",
    "measure_links",
]

ADULT_STATURE_M = 1.675
"""Stands for an unknown stature: half way between the 1.60 m and 1.75 m of Choi et al. (2024)."""

LINK_SHARES = {
    "shoulder_width": 0.23,
    "pelvis_width": 0.10,
    "thigh": 0.245,
    "shank": 0.246,
    "upper_arm": 0.186,
    "forearm": 0.146,
}
"""Length as a share of stature: Drillis & Contini (1966); the widths between joint centres."""

SLOW_SCALE_S = 2.0
"""How quickly the scale of a picture may follow the distance to the camera."""
BASELINE_S = 1.0
"""Window of the running median that stands for a link's usual length."""

HIGH_FLOOR_CM, HIGH_SIGMAS = 2.0, 6.0
LOW_FLOOR_CM, LOW_SIGMAS = 1.0, 3.5
LEVEL_FLOOR_CM, LEVEL_SIGMAS = 3.0, 4.0
"""Thresholds; the derivative's are per 1/30 s. Two centimetres are generous: bones don't change."""


@dataclass(frozen=True, eq=False)
class Links:
    """Lengths of the links that a skeleton has.

    Parameters
    ----------
    names
        Names of `BODY_SEGMENTS`.
    ends
        Shape (J, 2): columns of the proximal and distal keypoint.
    length_cm
        Shape (T, J); NaN where an end is missing.
    scale_cm
        Shape (T,): centimetres per unit of the track; NaN if no link was ever seen.
    """

    names: tuple[str, ...]
    ends: NDArray[np.intp]
    length_cm: Array
    scale_cm: Array


@dataclass(frozen=True, eq=False)
class EdgeTest:
    """What the derivative test found.

    Parameters
    ----------
    change_cm
        Shape (T, J): signed change of length since the last known frame, cm per 1/30 s.
    is_edge
        Shape (T, J): the length changed faster than a bone can.
    is_unsteady
        Shape (J,): most of the frames are bad, so the spread says nothing and fixed thresholds
        were used.
    """

    change_cm: Array
    is_edge: NDArray[np.bool_]
    is_unsteady: NDArray[np.bool_]


def link_ends(skeleton: Skeleton) -> tuple[tuple[str, ...], NDArray[np.intp]]:
    """Return names and end columns of the links that a skeleton has."""
    found = [
        (name, skeleton.index(a), skeleton.index(b))
        for name, a, b in BODY_SEGMENTS
        if a in skeleton.keypoints and b in skeleton.keypoints
    ]
    ends = np.array([columns for _, *columns in found], dtype=np.intp).reshape(-1, 2)
    return tuple(name for name, *_ in found), ends


def measure_links(track: PoseTrack, *, stature_m: float | None = None) -> Links:
    """Measure the links in centimetres by stature normalisation.

    The scale makes the sum of the links' median lengths that of a person of the given stature.
    Tracks in pixels get a scale that follows the running median of the visible size over 2 s,
    because the distance to the camera changes.

    Parameters
    ----------
    track
        Any track.
    stature_m
        Stature, m; `ADULT_STATURE_M` if None.

    Returns
    -------
    Links
        No links if the skeleton has none.
    """
    names, ends = link_ends(get_skeleton(track.skeleton))
    position = np.where(track.is_present[:, :, None], track.position, np.nan)
    length = np.linalg.norm(position[:, ends[:, 0]] - position[:, ends[:, 1]], axis=2)
    seen = np.isfinite(length).any(axis=0)
    if not seen.any():
        return Links(names, ends, length, np.full(track.n_frames, np.nan))
    usual = np.nan_to_num(known_median(length))
    shares = np.array([_share(name) for name in names])
    stature_cm = 100.0 * (stature_m or ADULT_STATURE_M)
    if usual.sum() <= 0.0:
        return Links(names, ends, length, np.full(track.n_frames, np.nan))
    scale = np.full(track.n_frames, stature_cm * shares[seen].sum() / usual.sum())
    if track.unit == "px":
        scale = scale / _relative_size(length, usual, track.time_s)
    return Links(names, ends, length * scale[:, None], scale)


def _share(link: str) -> float:
    return LINK_SHARES[link.removeprefix("left_").removeprefix("right_")]


def _relative_size(length: Array, usual: Array, time_s: Array) -> Array:
    """Return the size in the picture relative to the clip's usual size; shape (T,)."""
    known = np.isfinite(length)
    expected = np.where(known, usual, 0.0).sum(axis=1)
    size = np.where(known, length, 0.0).sum(axis=1) / np.where(expected > 0, expected, np.nan)
    slow = running_median(size[:, None], odd_window(SLOW_SCALE_S, frame_interval_s(time_s)))[:, 0]
    # A person folded to a point has no size; the clip's own scale is the better guess.
    return np.where(slow > 0.05, slow, 1.0)


def find_edges(time_s: Array, length_cm: Array) -> EdgeTest:
    """Find the frames in which a link's length jumps.

    Thresholds per link are robust: with m the median and s the scaled MAD of the absolute
    change, a run of edges starts above max(2 cm, m + 6 s) and goes on above max(1 cm, m + 3.5 s).
    Where more than half of the changes exceed 2 cm the spread only describes the faults, and
    the fixed values alone are used.

    Parameters
    ----------
    time_s
        Shape (T,), s.
    length_cm
        Shape (T, J); NaN in gaps, over which the change is spread evenly.

    Returns
    -------
    EdgeTest
        With signed changes.
    """
    known = np.isfinite(length_cm)
    before = last_known(known)
    usable = known & (before >= 0)
    earlier = np.maximum(before, 0)
    step_s = time_s[:, None] - time_s[earlier]
    change = np.full(length_cm.shape, np.nan)
    difference = length_cm - np.take_along_axis(length_cm, earlier, axis=0)
    change[usable] = difference[usable] / (30.0 * step_s[usable])
    size = np.abs(change)
    middle = np.nan_to_num(known_median(size))
    spread = np.nan_to_num(mad_sigma(size))
    is_unsteady = middle > HIGH_FLOOR_CM
    middle, spread = np.where(is_unsteady, 0.0, middle), np.where(is_unsteady, 0.0, spread)
    high = np.maximum(HIGH_FLOOR_CM, middle + HIGH_SIGMAS * spread)
    low = np.maximum(LOW_FLOOR_CM, middle + LOW_SIGMAS * spread)
    size = np.nan_to_num(size)
    return EdgeTest(change, runs_that_touch(size > low, size > high), is_unsteady)


def find_excursions(
    time_s: Array, length_cm: Array, edges: EdgeTest
) -> tuple[NDArray[np.bool_], Array]:
    """Find the segments in which a link has a wrong length, between the jumps in and out.

    Parameters
    ----------
    time_s
        Shape (T,), s.
    length_cm
        Shape (T, J).
    edges
        From the derivative test.

    Returns
    -------
    is_excursion
        Shape (T, J): further than max(3 cm, 4 robust SD) from the running median of 1 s over
        the other frames, in a run that a jump begins or ends. A slow change is no excursion.
        Excursions less than three frames (at 30 frames/s) apart are one.
    level_cm
        Shape (T, J): that distance, signed.
    """
    interval_s = frame_interval_s(time_s)
    window = odd_window(BASELINE_S, interval_s)
    reach = max(1, round(1.0 / (30.0 * interval_s)))
    near_edge = widen(edges.is_edge, reach)
    usual = np.array(length_cm)
    found = np.zeros(length_cm.shape, dtype=bool)
    level = np.full(length_cm.shape, np.nan)
    # Twice: the first time the bad frames still pull the baseline towards them.
    for _ in range(2):
        level = length_cm - running_median(usual, window)
        threshold = np.maximum(LEVEL_FLOOR_CM, LEVEL_SIGMAS * np.nan_to_num(mad_sigma(level)))
        found = runs_that_touch(np.nan_to_num(np.abs(level)) > threshold, near_edge)
        found = close_gaps(found, 2 * reach)
        usual = np.where(found, np.nan, length_cm)
        # A link that is never right has no baseline of its own; keep the first one.
        never = ~np.isfinite(usual).any(axis=0)
        usual[:, never] = length_cm[:, never]
    return found, level
