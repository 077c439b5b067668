"""Marker trajectories over time: gaps, low-pass filter, other time stamps."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.interpolate import CubicSpline
from scipy.signal import butter, sosfiltfilt

from engine.datatypes import Array, PoseTrack, Status, frozen_array
from engine.errors import ConfigError, DataError, ShapeError

__all__ = ["MarkerRecording", "fill_short_gaps", "filter_markers", "resample_markers"]

MIN_RUN = 4
"""A cubic needs four samples."""
SPLINE_REACH = 12
"""Samples on either side of a gap that shape the spline across it."""
MAX_JITTER = 0.2
"""Share of an interval by which regular time stamps may be off (rounding)."""


@dataclass(frozen=True, eq=False)
class MarkerRecording:
    """Markers of one person over time.

    Parameters
    ----------
    time_s
        Shape (T,), increasing.
    position_m
        Shape (T, M, 3), metres, Y up; NaN where missing.
    names
        The M markers, as in the marker set.
    rate_hz
        Frames a second.
    marker_set
        Name of the set in `engine.skeletons`; empty for any other markers.
    is_filled
        Shape (T, M): whether a short gap was filled.
    notes
        What was odd about the recording, in words.
    """

    time_s: Array
    position_m: Array
    names: tuple[str, ...]
    rate_hz: float
    marker_set: str = ""
    is_filled: NDArray[np.bool_] = None  # type: ignore[assignment]
    notes: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        object.__setattr__(self, "time_s", frozen_array(self.time_s))
        object.__setattr__(self, "position_m", frozen_array(self.position_m))
        object.__setattr__(self, "names", tuple(self.names))
        shape = (self.time_s.size, len(self.names))
        if self.position_m.shape != (*shape, 3):
            raise ShapeError(f"position_m needs shape {(*shape, 3)}, got {self.position_m.shape}.")
        filled = np.zeros(shape, dtype=bool) if self.is_filled is None else self.is_filled
        object.__setattr__(self, "is_filled", frozen_array(filled, np.bool_))
        if self.is_filled.shape != shape:
            raise ShapeError(f"is_filled needs shape {shape}, got {self.is_filled.shape}.")

    @property
    def is_present(self) -> NDArray[np.bool_]:
        """Shape (T, M): whether a position exists."""
        return np.asarray(np.isfinite(self.position_m).all(axis=2))

    def as_track(self) -> PoseTrack:
        """Return the markers as a track in the world frame, for solvers and exports.

        Raises
        ------
        DataError
            If the markers are of no known set.
        """
        if not self.marker_set:
            raise DataError("Only a recording of a known marker set can be used as a track.")
        status = np.where(self.is_present, Status.MEASURED, Status.MISSING)
        status = np.where(self.is_filled & self.is_present, Status.FILLED, status)
        return PoseTrack(
            time_s=self.time_s,
            position=self.position_m,
            unit="m",
            frame_of_reference="world",
            skeleton=self.marker_set,
            status=status,
            provenance={"source": "markers"},
        )


def _runs(present: NDArray[np.bool_]) -> Iterator[slice]:
    """Yield the unbroken runs of True along one axis."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], present, [False]]).astype(np.int8)))
    for start, stop in zip(edges[::2], edges[1::2], strict=True):
        yield slice(int(start), int(stop))


def _alike(present: NDArray[np.bool_]) -> Iterator[tuple[NDArray[np.bool_], NDArray[np.intp]]]:
    """Yield every pattern of presence over time (T,), with the columns that share it."""
    patterns, inverse = np.unique(present, axis=1, return_inverse=True)
    for i in range(patterns.shape[1]):
        yield patterns[:, i], np.flatnonzero(inverse.ravel() == i)


def fill_short_gaps(time_s: Array, position: Array, *, max_gap_s: float) -> Array:
    """Fill short gaps of every marker by a cubic spline through its neighbours.

    Parameters
    ----------
    time_s
        Shape (T,), s.
    position
        Shape (T, M, 3); NaN where missing.
    max_gap_s
        The longest time between the last sample before and the first one after a gap, less one
        interval, that is filled. Gaps at either end are never filled.

    Returns
    -------
    Array
        Shape (T, M, 3).
    """
    filled = position.copy()
    present = np.asarray(np.isfinite(position).all(axis=2))
    interval = float(np.median(np.diff(time_s))) if time_s.size > 1 else 0.0
    for pattern, columns in _alike(present):
        known = np.flatnonzero(pattern)
        for left in np.flatnonzero(np.diff(known) > 1):
            start, stop = known[left], known[left + 1]
            near = known[max(0, left + 1 - SPLINE_REACH) : left + 1 + SPLINE_REACH]
            # A spline across a second, long gap would swing freely.
            near = near[np.abs(time_s[near] - time_s[start]) <= max_gap_s + SPLINE_REACH * interval]
            if time_s[stop] - time_s[start] - interval > max_gap_s + 1e-9 or near.size < MIN_RUN:
                continue
            spline = CubicSpline(time_s[near], position[near][:, columns])
            filled[start + 1 : stop, columns] = spline(time_s[start + 1 : stop])
    return filled


def filter_markers(
    recording: MarkerRecording, cutoff_hz: float = 8.0, order: int = 4
) -> MarkerRecording:
    """Low-pass the markers without delay.

    A Butterworth filter of half the order runs forwards and backwards, so that `order` is that of
    both passes together; its own cut-off is raised so that the two passes damp `cutoff_hz` by 3 dB
    (Winter's correction). Every unbroken stretch of a marker is filtered on its own, with its
    ends extended by point reflection; stretches of fewer than four samples are left as they are.

    Parameters
    ----------
    recording
        At a regular rate.
    cutoff_hz
        Frequency at which the result has 3 dB less, Hz.
    order
        Even.

    Raises
    ------
    ConfigError
        If the cut-off is not between 0 and half the rate, or the order is odd.
    DataError
        If the time stamps are not regular.

    References
    ----------
    .. [1] Winter (2009), Biomechanics and Motor Control of Human Movement, 4th ed., sec. 3.4.4.2.
    """
    rate = recording.rate_hz
    if not 0 < cutoff_hz < rate / 2:
        raise ConfigError(
            f"The cut-off must lie between 0 and half the rate of {rate:g} Hz, got "
            f"{cutoff_hz:g} Hz."
        )
    if order < 2 or order % 2:
        raise ConfigError(f"The order of a filter without delay is even, got {order}.")
    _require_regular(recording)
    half = order // 2
    # Each pass damps the cut-off by the square root of 1/2 only.
    raised = np.tan(np.pi * cutoff_hz / rate) / (np.sqrt(2.0) - 1.0) ** (1.0 / (2 * half))
    sections = butter(half, np.arctan(raised) / np.pi * 2.0, output="sos")
    position = np.array(recording.position_m)
    for pattern, columns in _alike(recording.is_present):
        for run in _runs(pattern):
            n = run.stop - run.start
            if n < MIN_RUN:
                continue
            stretch = position[run][:, columns]
            reach = min(n - 1, round(rate / cutoff_hz) * 3)
            position[run.start : run.stop, columns] = sosfiltfilt(
                sections, stretch, axis=0, padlen=reach
            )
    return replace(recording, position_m=position)


def _require_regular(recording: MarkerRecording) -> None:
    steps = np.diff(recording.time_s) * recording.rate_hz
    if steps.size and np.abs(steps - 1.0).max() > MAX_JITTER:
        worst = int(np.argmax(np.abs(steps - 1.0)))
        raise DataError(
            f"A filter needs a regular rate, but the step after {recording.time_s[worst]:g} s is "
            f"{steps[worst] / recording.rate_hz:.4g} s instead of {1 / recording.rate_hz:.4g} s; "
            "resample the recording first."
        )


def resample_markers(recording: MarkerRecording, time_s: ArrayLike) -> MarkerRecording:
    """Give the markers at other times, such as those of video frames, by cubic splines.

    Nothing is extrapolated: times before, after or inside a gap of a marker are NaN. Filter
    first where the new rate is lower: this does not.

    Parameters
    ----------
    recording
        At any rate.
    time_s
        Shape (F,), increasing, s on the clock of the recording.
    """
    wanted = np.asarray(time_s, dtype=np.float64)
    position = np.full((wanted.size, len(recording.names), 3), np.nan)
    is_filled = np.zeros(position.shape[:2], dtype=bool)
    edge = 1e-9
    for pattern, columns in _alike(recording.is_present):
        for run in _runs(pattern):
            own = recording.time_s[run]
            inside = (wanted >= own[0] - edge) & (wanted <= own[-1] + edge)
            if own.size < MIN_RUN or not inside.any():
                continue
            rows = np.flatnonzero(inside)[:, None]
            spline = CubicSpline(own, recording.position_m[run][:, columns])
            position[rows, columns] = spline(wanted[inside])
            nearest = np.clip(np.searchsorted(own, wanted[inside]), 0, own.size - 1)
            is_filled[rows, columns] = recording.is_filled[run][nearest][:, columns]
    rate = float(1.0 / np.median(np.diff(wanted))) if wanted.size > 1 else recording.rate_hz
    return replace(recording, time_s=wanted, position_m=position, rate_hz=rate, is_filled=is_filled)
