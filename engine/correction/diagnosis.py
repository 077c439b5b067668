"""What is wrong with a track, before anything is deleted: the order of the tests."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from engine.correction.links import measure_links
from engine.correction.outliers import OutlierFindings, find_outliers
from engine.correction.swaps import SwapFindings, exchange_sides, find_swaps, turn_round
from engine.datatypes import PoseTrack, Status
from engine.skeletons import get_skeleton

__all__ = ["Diagnosis", "diagnose"]

Mask = NDArray[np.bool_]
DEPTH_AXIS = {"camera": 2, "body": 2}
"""The axis along which a camera sees nothing, where the frame of reference is the camera's."""


@dataclass(frozen=True, eq=False)
class Diagnosis:
    """A track with its sides put right, and what is wrong with its samples.

    Parameters
    ----------
    track
        Sides exchanged back; nothing deleted yet.
    swaps, outliers
        None if they were not looked for.
    is_doubtful
        Shape (T, K): the estimator itself is not sure.
    """

    track: PoseTrack
    swaps: SwapFindings | None
    outliers: OutlierFindings | None
    is_doubtful: Mask

    @property
    def is_rejected(self) -> Mask:
        """Shape (T, K): samples that exist and must go."""
        wrong = self.is_doubtful
        if self.outliers is not None:
            wrong = wrong | self.outliers.is_rejected
        return np.asarray(wrong & self.track.is_present)


def diagnose(
    track: PoseTrack,
    *,
    min_confidence: float,
    repair_swaps: bool = True,
    reject_outliers: bool = True,
    stature_m: float | None = None,
) -> Diagnosis:
    """Look for exchanged sides and misplaced joints.

    Exchanged sides are looked for twice: misdetected joints, which are only known after the first
    time, stand in the way of seeing where the others were.

    Parameters
    ----------
    track
        Any track.
    min_confidence
        Samples below are doubtful; those of unknown confidence are not.
    repair_swaps, reject_outliers
        Which tests to do.
    stature_m
        For lengths in centimetres; an average adult's if None.

    Returns
    -------
    Diagnosis
        With the sides put right.
    """
    doubtful = track.is_present & (np.nan_to_num(track.confidence, nan=1.0) < min_confidence)
    swaps = _look_for_swaps(track, doubtful, stature_m) if repair_swaps else None
    outliers = _look_for_outliers(track, swaps, doubtful, stature_m) if reject_outliers else None
    if swaps is not None and outliers is not None and outliers.is_rejected.any():
        hidden = doubtful | _relabel(outliers.is_rejected, swaps, track)
        again = _look_for_swaps(track, hidden, stature_m)
        if (again.is_exchanged != swaps.is_exchanged).any():
            outliers = _look_for_outliers(track, again, doubtful, stature_m)
        swaps = again
    return Diagnosis(
        track=_put_right(track, swaps),
        swaps=swaps,
        outliers=outliers,
        is_doubtful=_relabel(doubtful, swaps, track),
    )


def _relabel(mask: Mask, swaps: SwapFindings | None, track: PoseTrack) -> Mask:
    """Return a mask of samples under the labels that they have after (or before) the exchange."""
    if swaps is None:
        return mask
    order = get_skeleton(track.skeleton).mirror_order
    return exchange_sides(mask, swaps.is_exchanged, order)


def _look_for_swaps(track: PoseTrack, hidden: Mask, stature_m: float | None) -> SwapFindings:
    visible = dataclasses.replace(track, position=_without(track, hidden))
    scale = measure_links(visible, stature_m=stature_m).scale_cm / 100.0
    return find_swaps(
        track.time_s,
        np.asarray(visible.position) * scale[:, None, None],
        get_skeleton(track.skeleton),
        depth_axis=DEPTH_AXIS.get(track.frame_of_reference) if track.unit == "m" else None,
    )


def _look_for_outliers(
    track: PoseTrack, swaps: SwapFindings | None, doubtful: Mask, stature_m: float | None
) -> OutlierFindings:
    repaired = _put_right(track, swaps)
    position = _without(repaired, _relabel(doubtful, swaps, track))
    visible = dataclasses.replace(repaired, position=position)
    links = measure_links(visible, stature_m=stature_m)
    return find_outliers(track.time_s, position, links, get_skeleton(track.skeleton))


def _without(track: PoseTrack, hidden: Mask) -> NDArray[np.float64]:
    gone = hidden | ~track.is_present
    return np.where(gone[:, :, None], np.nan, track.position)


def _put_right(track: PoseTrack, swaps: SwapFindings | None) -> PoseTrack:
    """Return the track with the found sides exchanged back; those samples count as repaired."""
    if swaps is None or not (swaps.is_exchanged.any() or swaps.is_reflected.any()):
        return track
    skeleton = get_skeleton(track.skeleton)
    order = skeleton.mirror_order
    position = exchange_sides(track.position, swaps.is_exchanged, order)
    if swaps.is_reflected.any():
        axis = DEPTH_AXIS[track.frame_of_reference]
        position = turn_round(position, swaps.is_reflected, skeleton, axis)
    status = exchange_sides(np.asarray(track.status), swaps.is_exchanged, order)
    touched = swaps.is_exchanged | swaps.is_reflected[:, None]
    is_repaired = touched & np.isfinite(position).all(axis=2)
    return dataclasses.replace(
        track,
        position=position,
        confidence=exchange_sides(track.confidence, swaps.is_exchanged, order),
        sigma=exchange_sides(track.sigma, swaps.is_exchanged, order),
        status=np.where(is_repaired, Status.REPAIRED, status).astype(np.uint8),
    )
