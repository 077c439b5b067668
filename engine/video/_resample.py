"""Both views at common times."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from engine.datatypes import Array, PoseTrack, Status, SyncEstimate, ViewPose
from engine.errors import DataError, SyncError

__all__ = ["SyncedViews", "resample_views"]

MAX_STEP: Final = 2.5
"""In usual steps: over a longer hole between two pictures nothing is interpolated."""
ON_SAMPLE: Final = 1e-6
"""A moment this near a picture, as a share of the step, is that picture's."""


@dataclass(frozen=True, eq=False)
class SyncedViews:
    """Two views at common times, zero at the first common one.

    A moment at `t` seconds is at ``t + start_in_first_s`` in the first video and at
    ``t * rate_in_second + start_in_second_s`` in the second. `base` tells whose pictures (0 or 1)
    give the times: that view's samples are as they were.
    """

    views: tuple[ViewPose, ViewPose]
    start_in_first_s: float
    start_in_second_s: float
    rate_in_second: float
    base: int


def resample_views(views: Sequence[ViewPose], estimate: SyncEstimate) -> SyncedViews:
    """Bring two views to common times within their overlap.

    Parameters
    ----------
    views
        The first and the second view, each with the times of its video.
    estimate
        How their clocks belong together.

    Returns
    -------
    SyncedViews
        Times run in the first video's seconds. Missing samples stay missing, and so does what
        lies between a missing sample and its neighbour.

    Raises
    ------
    DataError
        If there are not two views, or the offset is not known.
    SyncError
        If fewer than two pictures are common.

    Notes
    -----
    The times are those of the view with fewer pictures per second (the first, if equal). Its
    samples stay untouched and the denser view is interpolated, over the shorter steps: the other
    way round every second sample of the slower view would be made up, look like a measurement and
    be counted as one. Interpolation is linear: at 30 pictures per second a wrist's path bends 1 mm
    between two pictures, and a curve through more samples would pass on more of their noise.
    """
    if len(views) != 2 or not np.isfinite(estimate.offset_s):
        raise DataError(
            f"Expected two views and a known offset, got {len(views)} and {estimate.offset_s} s."
        )
    rate = 1.0 / (1.0 + estimate.drift)
    clocks = (
        views[0].image.time_s,
        views[1].image.time_s * (1.0 + estimate.drift) + estimate.offset_s,
    )
    base = _slower(clocks)
    start, stop = max(c[0] for c in clocks), min(c[-1] for c in clocks)
    tolerance = ON_SAMPLE * float(np.median(np.diff(clocks[base])))
    inside = (clocks[base] >= start - tolerance) & (clocks[base] <= stop + tolerance)
    if np.count_nonzero(inside) < 2:
        raise SyncError(
            f"At an offset of {estimate.offset_s:.3f} s the videos have no two pictures in common. "
            "Check the offset (--sync SECONDS: its sign and unit), or the choice of videos."
        )
    times = clocks[base][inside]
    pair = [_at(view, clock, times) for view, clock in zip(views, clocks, strict=True)]
    return SyncedViews(
        views=(pair[0], pair[1]),
        start_in_first_s=float(times[0]),
        start_in_second_s=float((times[0] - estimate.offset_s) * rate),
        rate_in_second=rate,
        base=base,
    )


def _slower(clocks: Sequence[Array]) -> int:
    if min(len(clock) for clock in clocks) < 2:
        return 0
    step_first, step_second = (float(np.median(np.diff(clock))) for clock in clocks)
    return 1 if step_second > 1.02 * step_first else 0


@dataclass(frozen=True, eq=False)
class _Blend:
    """Which two samples give each moment, and the share of the later one."""

    low: NDArray[np.intp]
    high: NDArray[np.intp]
    share: Array
    is_known: NDArray[np.bool_]

    @classmethod
    def plan(cls, clock: Array, times: Array) -> _Blend:
        high = np.clip(np.searchsorted(clock, times), 1, len(clock) - 1)
        low = high - 1
        step = clock[high] - clock[low]
        share = np.clip((times - clock[low]) / step, 0.0, 1.0)
        on_low, on_high = share < ON_SAMPLE, share > 1.0 - ON_SAMPLE
        # On a sample its neighbour does not matter, be it missing or far away.
        low, high = np.where(on_high, high, low), np.where(on_low, low, high)
        share = np.where(on_low | on_high, 0.0, share)
        usual = float(np.median(np.diff(clock)))
        return cls(low, high, share, (step <= MAX_STEP * usual) | on_low | on_high)

    def mix(self, values: Array) -> Array:
        """Interpolate along the first axis; NaN where a side is missing or too far."""
        shape = (-1, *[1] * (values.ndim - 1))
        share = self.share.reshape(shape)
        mixed = (1.0 - share) * values[self.low] + share * values[self.high]
        return np.asarray(np.where(self.is_known.reshape(shape), mixed, np.nan))

    @property
    def nearest(self) -> NDArray[np.intp]:
        return np.where(self.share > 0.5, self.high, self.low)


def _at(view: ViewPose, clock: Array, times: Array) -> ViewPose:
    """Return the view at moments of the common clock, the first of them at zero."""
    blend = _Blend.plan(clock, times)
    state = tuple(view.state[i] for i in blend.nearest)
    others = tuple(view.others[i] for i in blend.nearest) if view.others else ()
    since = times - times[0]
    return dataclasses.replace(
        view,
        image=_track_at(view.image, blend, since),
        body=None if view.body is None else _track_at(view.body, blend, since),
        box=blend.mix(view.box),
        state=state,
        others=others,
    )


def _track_at(track: PoseTrack, blend: _Blend, times: Array) -> PoseTrack:
    position = blend.mix(track.position)
    # Errors of neighbouring pictures are alike, so a blend is no better than its parts.
    parts = np.stack([track.status[blend.low], track.status[blend.high]])
    # Codes rise from measured to smoothed; where nothing is left, a rejected part is the reason.
    gone = np.where((parts == Status.REJECTED).any(axis=0), Status.REJECTED, Status.MISSING)
    present = np.isfinite(position).all(axis=2)
    return PoseTrack(
        time_s=times,
        position=position,
        unit=track.unit,
        frame_of_reference=track.frame_of_reference,
        skeleton=track.skeleton,
        confidence=blend.mix(track.confidence),
        sigma=blend.mix(track.sigma),
        status=np.where(present, parts.max(axis=0), gone),
        provenance=track.provenance,
    )
