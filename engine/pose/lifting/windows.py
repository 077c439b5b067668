"""Clips of any length and rate, cut into the windows of a network and put together again."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from engine.datatypes import Array

__all__ = ["RATE_HZ", "Samples", "WindowPlan", "blend_windows", "plan_windows", "resample_clip"]

RATE_HZ = 30.0
"""What the networks were trained at."""
MAX_GAP_S = 0.3
"""Joints unseen for longer are not made up."""
MIN_JOINTS = 8
"""With fewer joints of the 17 in sight a posture is not lifted."""


@dataclass(frozen=True, eq=False)
class Samples:
    """A clip at the networks' rate.

    Parameters
    ----------
    time_s
        Shape (N,), evenly spaced.
    points
        Shape (N, K, D), without NaN: what is missing is bridged, or held at the ends.
    confidence
        Shape (N, K); 0 where bridged.
    is_known
        Shape (N, K): seen, or within a short gap.
    """

    time_s: Array
    points: Array
    confidence: Array
    is_known: NDArray[np.bool_]


def resample_clip(
    time_s: Array, points: Array, confidence: Array, *, rate_hz: float = RATE_HZ
) -> Samples:
    """Bring a clip to the networks' rate.

    Parameters
    ----------
    time_s
        Shape (T,), increasing.
    points
        Shape (T, K, D); NaN where missing.
    confidence
        Shape (T, K); NaN counts as 0.
    rate_hz
        Wanted.

    Returns
    -------
    Samples
        Linear in time between the pictures. A joint is known where it was seen less than
        `MAX_GAP_S` / 2 ago or will be, and where the frame has at least `MIN_JOINTS` such.
    """
    count = max(1, round((time_s[-1] - time_s[0]) * rate_hz) + 1)
    at = time_s[0] + np.arange(count) / rate_hz
    seen = np.asarray(np.isfinite(points).all(axis=2))
    confidence = np.nan_to_num(confidence)
    out = np.zeros((count, *points.shape[1:]))
    sure, known = np.zeros(out.shape[:2]), np.zeros(out.shape[:2], dtype=bool)
    # Between two pictures in a row nothing is missing, however slow the video.
    step_s = float(np.median(np.diff(time_s))) if len(time_s) > 1 else 0.0
    near_s = 0.75 * max(step_s, 1.0 / rate_hz)
    for joint in range(points.shape[1]):
        rows = np.flatnonzero(seen[:, joint])
        if not rows.size:
            continue
        for axis in range(points.shape[2]):
            out[:, joint, axis] = np.interp(at, time_s[rows], points[rows, joint, axis])
        away = _distance_in_time(at, time_s[rows])
        known[:, joint] = away <= max(MAX_GAP_S / 2, near_s)
        sure[:, joint] = np.where(
            away <= near_s, np.interp(at, time_s[rows], confidence[rows, joint]), 0.0
        )
    known &= (known.sum(axis=1) >= MIN_JOINTS)[:, None]
    return Samples(at, out, sure, known)


def _distance_in_time(at: Array, seen_s: Array) -> Array:
    """Return how far each moment (N,) is from the nearest of `seen_s`, s."""
    if len(seen_s) == 1:
        return np.asarray(np.abs(at - seen_s[0]))
    after = np.clip(np.searchsorted(seen_s, at), 1, len(seen_s) - 1)
    return np.asarray(np.minimum(np.abs(at - seen_s[after - 1]), np.abs(at - seen_s[after])))


@dataclass(frozen=True, eq=False)
class WindowPlan:
    """Which samples each window holds.

    `rows` (W, F): indices; shorter clips repeat their first and last sample. `weight` (F,) is
    how much each place of a window counts where windows overlap: most in the middle.
    """

    rows: NDArray[np.intp]
    weight: Array


def plan_windows(n_samples: int, n_frames: int, hop: int) -> WindowPlan:
    """Cover a clip with windows.

    Parameters
    ----------
    n_samples
        Length of the clip.
    n_frames
        Length of a window.
    hop
        From one window's start to the next.
    """
    if n_samples <= n_frames:
        before = (n_frames - n_samples) // 2
        rows = np.clip(np.arange(n_frames) - before, 0, n_samples - 1)[None]
    else:
        starts = np.unique([*range(0, n_samples - n_frames, hop), n_samples - n_frames])
        rows = starts[:, None] + np.arange(n_frames)
    place = (np.arange(n_frames) + 0.5) / n_frames
    return WindowPlan(rows.astype(np.intp), np.sin(np.pi * place) ** 2 + 1e-3)


def blend_windows(plan: WindowPlan, values: Array, n_samples: int) -> Array:
    """Put what windows say together.

    Parameters
    ----------
    plan
        Which samples they hold.
    values
        Shape (W, F, ...).
    n_samples
        Length of the clip.

    Returns
    -------
    Array
        Shape (N, ...), the weighted mean of the windows that hold a sample.
    """
    total = np.zeros((n_samples, *values.shape[2:]))
    weight = np.zeros(n_samples)
    weights = np.broadcast_to(plan.weight, plan.rows.shape)
    np.add.at(total, plan.rows, values * weights.reshape(*weights.shape, *[1] * (values.ndim - 2)))
    np.add.at(weight, plan.rows, weights)
    return np.asarray(total / weight.reshape(-1, *[1] * (values.ndim - 2)))
