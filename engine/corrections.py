"""What a person corrects in a trial's keypoints, before the trial is assessed anew.

A correction never touches the stored result: it gives new keypoints, which are assessed as if an
estimator had seen them so, and is written into their provenance, so that the new result says what
was changed by hand.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from engine.datatypes import PoseTrack, ViewPose
from engine.errors import ConfigError
from engine.skeletons import get_skeleton

__all__ = ["PROVENANCE_KEY", "SideSwap", "apply_corrections"]

PROVENANCE_KEY = "user_corrections"
"""Under this key the image track's provenance lists what was corrected."""


@dataclass(frozen=True)
class SideSwap:
    """Left and right were exchanged by the estimator over a stretch of one video.

    Parameters
    ----------
    start_s, end_s
        In the view's own time; both ends are part of it.
    view
        Number of the view, from 0.
    keypoints
        Which keypoints, by the names of either side; empty for all, the whole body.
    """

    start_s: float
    end_s: float
    view: int = 0
    keypoints: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        if not self.start_s <= self.end_s:
            raise ConfigError(
                "A stretch to correct needs a start before its end, got "
                f"{self.start_s:g} s to {self.end_s:g} s; exchange them or choose others."
            )


def apply_corrections(
    poses: Sequence[ViewPose], corrections: Sequence[SideSwap]
) -> tuple[ViewPose, ...]:
    """Return keypoints with every correction applied, in the order given.

    Parameters
    ----------
    poses
        What an estimator saw in each view; stays as it is.
    corrections
        What a person put right. The same one twice cancels itself.

    Returns
    -------
    tuple of ViewPose
        Positions, confidences, errors and states travel with their keypoints; missing samples stay
        missing.

    Raises
    ------
    ConfigError
        If a correction names a view or keypoint that is not there, or no picture lies in it.
    """
    corrected = list(poses)
    for correction in corrections:
        if not 0 <= correction.view < len(corrected):
            raise ConfigError(
                f"There is no view {correction.view + 1} to correct; the trial has "
                f"{len(corrected)}."
            )
        corrected[correction.view] = _swap_sides(corrected[correction.view], correction)
    return tuple(corrected)


def _swap_sides(pose: ViewPose, swap: SideSwap) -> ViewPose:
    image = _swap_track(pose.image, swap)
    done = [*pose.image.provenance.get(PROVENANCE_KEY, ()), _describe(swap)]
    image = dataclasses.replace(image, provenance={**pose.image.provenance, PROVENANCE_KEY: done})
    body = None if pose.body is None else _swap_track(pose.body, swap)
    return dataclasses.replace(pose, image=image, body=body)


def _describe(swap: SideSwap) -> dict[str, object]:
    return {"kind": "side_swap", **dataclasses.asdict(swap), "keypoints": list(swap.keypoints)}


def _swap_track(track: PoseTrack, swap: SideSwap) -> PoseTrack:
    rows = (track.time_s >= swap.start_s) & (track.time_s <= swap.end_s)
    if not rows.any():
        raise ConfigError(
            f"No picture lies between {swap.start_s:g} s and {swap.end_s:g} s; the video runs from "
            f"{track.time_s[0]:.2f} s to {track.time_s[-1]:.2f} s."
        )
    order = _swapped_order(track.skeleton, swap.keypoints)
    at = np.ix_(rows, order)
    changes = {}
    for name in ("position", "confidence", "sigma", "status"):
        values = getattr(track, name)
        if values is not None:
            changes[name] = values.copy()
            changes[name][rows] = values[at]
    return dataclasses.replace(track, **changes)


def _swapped_order(skeleton: str, keypoints: Sequence[str]) -> NDArray[np.int64]:
    """Return the column order that exchanges both sides of some keypoints, or of all."""
    known = get_skeleton(skeleton)
    strangers = sorted(set(keypoints) - set(known.keypoints))
    if strangers:
        raise ConfigError(f"The skeleton {skeleton!r} has no keypoint {', '.join(strangers)}.")
    chosen = {known.index(name) for name in keypoints}
    order = np.arange(len(known.keypoints))
    for left, right in known.pairs:
        if not keypoints or {left, right} & chosen:
            order[left], order[right] = right, left
    return order
