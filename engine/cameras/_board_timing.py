"""The time between two videos, from how the board moves in both."""

from __future__ import annotations

import math

import numpy as np

from engine.cameras._board_views import Sightings
from engine.datatypes import Array
from engine.errors import CalibrationError

__all__ = ["find_offset"]

GRID_S = 0.1
LEAST_OVERLAP_S = 6.0
LEAST_CORRELATION = 0.5
OTHER_PEAK_S = 1.0
OTHER_PEAK_SHARE = 0.9


def find_offset(both: tuple[Sightings, Sightings]) -> float:
    """Find the time between two videos from when the board moves and when it rests.

    Returns
    -------
    float
        Seconds to add to the second video's times, to about 0.1 s.

    Raises
    ------
    CalibrationError
        If the movement does not tell.
    """
    (start_a, one), (start_b, two) = (_movement(seen) for seen in both)
    lags = np.arange(-len(two) + 1, len(one))
    scores = np.array([_correlate(one, two, int(lag)) for lag in lags])
    best = int(np.argmax(scores))
    away = np.abs(lags - lags[best]) * GRID_S > OTHER_PEAK_S
    other = scores[away].max(initial=-1.0)
    if scores[best] < LEAST_CORRELATION or other > OTHER_PEAK_SHARE * scores[best]:
        raise CalibrationError(
            "The board's movement does not tell the time between the videos. Move it briskly and "
            "hold it still in turn while both cameras see it, or give the seconds between them."
        )
    return float(start_a - start_b + lags[best] * GRID_S)


def _movement(seen: Sightings) -> tuple[float, Array]:
    """Return the start and how fast the board moves, on an even grid; NaN where unknown."""
    known = [view for view in seen.views if math.isfinite(view.speed_px_s)]
    if len(known) < 10:
        raise CalibrationError(
            f"Camera {seen.name} shows the board too seldom to tell the time between the videos; "
            "give the seconds between them."
        )
    times = np.array([view.time_s for view in known])
    sizes = np.array([np.linalg.norm(np.ptp(view.pixels, axis=0)) for view in known])
    speed = np.log(np.array([view.speed_px_s for view in known]) / sizes + 0.01)
    grid = np.arange(times[0], times[-1] + 1e-9, GRID_S)
    filled = np.interp(grid, times, speed)
    gap = np.min(np.abs(grid[:, None] - times[None]), axis=1)
    return float(times[0]), np.where(gap > 0.5, np.nan, filled)


def _correlate(one: Array, two: Array, lag: int) -> float:
    start, stop = max(0, lag), min(len(one), len(two) + lag)
    if (stop - start) * GRID_S < LEAST_OVERLAP_S:
        return -1.0
    a, b = one[start:stop], two[start - lag : stop - lag]
    both = np.isfinite(a) & np.isfinite(b)
    if both.sum() * GRID_S < LEAST_OVERLAP_S:
        return -1.0
    a, b = a[both] - a[both].mean(), b[both] - b[both].mean()
    size = float(np.sqrt((a @ a) * (b @ b)))
    return float(a @ b) / size if size > 0 else -1.0
