"""Curves and tracks at other times, without bridging gaps."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from engine.datatypes import Array, JointAngles, PoseTrack
from engine.validation.curves import unwrap_deg

__all__ = ["resample_angles", "resample_positions", "shift_positions", "swap_sides"]

MAX_GAP_S = 0.1
"""Longer gaps stay gaps when curves are brought to other times."""


def _interpolate(time_s: Array, curve: Array, wanted_s: Array, *, max_gap_s: float) -> Array:
    """Return a curve at other times; NaN outside, and inside gaps longer than `max_gap_s`."""
    known = np.isfinite(curve)
    if not known.any():
        return np.full(wanted_s.shape, np.nan)
    own = time_s[known]
    value = np.asarray(np.interp(wanted_s, own, curve[known], left=np.nan, right=np.nan))
    if own.size < 2 or np.diff(own).max() <= max_gap_s:
        return value
    after = np.searchsorted(own, wanted_s)
    gap = own[np.clip(after, 0, own.size - 1)] - own[np.clip(after - 1, 0, own.size - 1)]
    is_sample = np.isin(wanted_s, own)
    return np.where((gap > max_gap_s) & ~is_sample, np.nan, value)


def _gap_limit(time_s: Array, max_gap_s: float) -> float:
    """Return the longest gap to bridge: at least one and a half frames."""
    usual = float(np.median(np.diff(time_s))) if time_s.size > 1 else 0.0
    return max(max_gap_s, 1.5 * usual)


def resample_angles(
    angles: JointAngles,
    time_s: Array,
    *,
    names: Sequence[str] | None = None,
    max_gap_s: float = MAX_GAP_S,
) -> JointAngles:
    """Return angles at other times, by straight lines between samples.

    Parameters
    ----------
    angles
        Any rate, even or not.
    time_s
        Shape (T,), increasing, s.
    names
        Which angles; by default all.
    max_gap_s
        Longer gaps stay NaN. Jumps of a full turn are undone first.
    """
    limit = _gap_limit(angles.time_s, max_gap_s)
    kept = angles.names if names is None else tuple(names)
    value = [unwrap_deg(angles[name], np.isfinite(angles[name])) for name in kept]
    sigma = [angles.sigma(name) for name in kept]
    value, sigma = (
        [_interpolate(angles.time_s, curve, time_s, max_gap_s=limit) for curve in curves]
        for curves in (value, sigma)
    )
    return JointAngles(
        time_s,
        np.column_stack(value),
        kept,
        np.column_stack(sigma),
        convention=angles.convention,
    )


def resample_positions(
    track: PoseTrack, time_s: Array, *, max_gap_s: float = MAX_GAP_S
) -> PoseTrack:
    """Return a track at other times (T,), by straight lines; longer gaps stay NaN."""
    limit = _gap_limit(track.time_s, max_gap_s)
    flat = track.position.reshape(track.n_frames, -1)
    moved = [_interpolate(track.time_s, column, time_s, max_gap_s=limit) for column in flat.T]
    shape = (len(time_s), *track.position.shape[1:])
    return PoseTrack(
        time_s=time_s,
        position=np.column_stack(moved).reshape(shape),
        unit=track.unit,
        frame_of_reference=track.frame_of_reference,
        skeleton=track.skeleton,
        provenance=track.provenance,
    )


def shift_positions(track: PoseTrack, lag_s: float) -> PoseTrack:
    """Return a track with other times."""
    return replace(track, time_s=track.time_s + lag_s)


def swap_sides(angles: JointAngles) -> JointAngles:
    """Return angles with the names of left and right exchanged."""
    other = {"_l": "_r", "_r": "_l"}
    names = tuple(
        f"{name[:-2]}{other[name[-2:]]}" if name[-2:] in other else name for name in angles.names
    )
    return replace(angles, names=names)
