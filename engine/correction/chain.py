"""The correction of one track: reject doubtful samples, fill short gaps, smooth."""

from __future__ import annotations

import dataclasses
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from engine.correction.filters import butterworth_low_pass
from engine.correction.gaps import fill_gaps
from engine.datatypes import Array, PoseTrack, Status
from engine.errors import ConfigError
from engine.skeletons import get_skeleton

__all__ = ["correct_track", "summarise_status"]


def correct_track(
    track: PoseTrack,
    *,
    preset: Literal["default", "paper", "none"] = "default",
    min_confidence: float = 0.3,
    max_gap_s: float = 0.5,
    cutoff_hz: float = 6.0,
) -> PoseTrack:
    """Clean the keypoints of one track.

    Samples with a confidence below `min_confidence` are rejected, gaps up to `max_gap_s`
    filled by a shape-preserving cubic, and everything smoothed by a zero-lag
    4th-order Butterworth filter. Longer gaps stay NaN.

    Parameters
    ----------
    track
        Any track, px or m.
    preset
        `default` as above; `none` returns the track as it is.
    min_confidence
        0 to 1. A sample of unknown confidence is kept.
    max_gap_s
        Longest gap that is filled, s.
    cutoff_hz
        Cut-off frequency after both passes, Hz.

    Returns
    -------
    PoseTrack
        With the status of every sample, wider `sigma` where filled, and a count of what was
        done in `provenance["correction"]`.

    Raises
    ------
    ConfigError
        If the preset is not available.
    """
    if preset == "none":
        return track
    if preset != "default":
        raise ConfigError(
            f"The correction preset {preset!r} is not available in this version; "
            "use 'default' or 'none'."
        )
    rejected = track.is_present & (np.nan_to_num(track.confidence, nan=1.0) < min_confidence)
    kept = np.where(rejected[:, :, None], np.nan, track.position)
    position, sigma, status = kept.copy(), np.array(track.sigma), np.array(track.status)
    status[rejected] = Status.REJECTED
    for k in range(position.shape[1]):
        position[:, k] = fill_gaps(track.time_s, kept[:, k], max_gap_s=max_gap_s)
        is_filled = np.asarray(
            np.isfinite(position[:, k]).all(axis=1) & ~np.isfinite(kept[:, k]).all(axis=1)
        )
        status[is_filled, k] = Status.FILLED
        sigma[:, k] = _widen_filled(track.time_s, kept[:, k], sigma[:, k], is_filled)
    position = _smooth(track.time_s, position, cutoff_hz)
    corrected = dataclasses.replace(track, position=position, sigma=sigma, status=status)
    note = {
        "preset": preset,
        "cutoff_hz": cutoff_hz,
        "max_gap_s": max_gap_s,
        "min_confidence": min_confidence,
        "rejected": int(rejected.sum()),
        **summarise_status(corrected),
    }
    return dataclasses.replace(corrected, provenance={**track.provenance, "correction": note})


def _smooth(time_s: Array, position: Array, cutoff_hz: float) -> Array:
    """Filter all keypoints; those with the same gaps in one call, which is much faster."""
    smoothed = position.copy()
    known = np.isfinite(position).all(axis=2)
    patterns, member = np.unique(known, axis=1, return_inverse=True)
    for i in range(patterns.shape[1]):
        columns = np.flatnonzero(member == i)
        series = position[:, columns].reshape(len(time_s), -1)
        series = butterworth_low_pass(time_s, series, cutoff_hz=cutoff_hz)
        smoothed[:, columns] = series.reshape(len(time_s), len(columns), -1)
    return smoothed


def _widen_filled(time_s: Array, kept: Array, sigma: Array, is_filled: NDArray[np.bool_]) -> Array:
    """Return standard errors that grow into a gap with the point's own typical motion."""
    known = np.isfinite(kept).all(axis=1)
    if not is_filled.any() or known.sum() < 2:
        return sigma
    nearest = np.min(np.abs(time_s[is_filled, None] - time_s[None, known]), axis=1)
    speed = np.linalg.norm(np.diff(kept[known], axis=0), axis=1) / np.diff(time_s[known])
    # Per coordinate; a filled path may leave the true one by about the typical speed x time away.
    drift = nearest * float(np.median(speed)) / np.sqrt(kept.shape[1])
    base = float(np.nanmedian(sigma[known])) if np.isfinite(sigma[known]).any() else 0.0
    widened = sigma.copy()
    widened[is_filled] = np.hypot(base, drift)
    return widened


def summarise_status(
    track: PoseTrack, *, keypoints: tuple[str, ...] | None = None
) -> dict[str, float]:
    """Return the share of joint samples measured, repaired, filled and missing (sum 1).

    A sample that exists after smoothing counts by how it came to be; a rejected sample that
    could not be filled is missing.

    Parameters
    ----------
    track
        Any track.
    keypoints
        Names to count; all if None.
    """
    skeleton = get_skeleton(track.skeleton)
    columns = [skeleton.index(k) for k in keypoints or skeleton.keypoints]
    status = np.asarray(track.status)[:, columns]
    present = track.is_present[:, columns]
    total = max(status.size, 1)
    shares = {
        "measured": (present & np.isin(status, (Status.MEASURED, Status.SMOOTHED))).sum(),
        "repaired": (present & (status == Status.REPAIRED)).sum(),
        "filled": (present & (status == Status.FILLED)).sum(),
    }
    result = {name: float(count) / total for name, count in shares.items()}
    result["missing"] = 1.0 - sum(result.values())
    return result
