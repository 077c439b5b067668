"""The phases of one lift or one repetition of an exercise, with the error of their bounds.

A lift has the phases reach, lift-off, rise, set-down and return; lift-off and set-down are short
windows around the moments the load starts and stops to move. An exercise goes down to
its deepest posture and up again: descent, bottom, ascent. (For an arm raise "bottom" is the far
end of the movement.)
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from engine.datatypes import Array, Lift
from engine.errors import DataError
from engine.form.performance import Performance

__all__ = [
    "EXERCISE_PHASES",
    "LIFT_PHASES",
    "Phase",
    "movement_speed",
    "phase_bounds",
    "segment_exercise",
    "segment_lift",
]

LIFT_PHASES = ("reach", "lift_off", "rise", "set_down", "return")
EXERCISE_PHASES = ("descent", "bottom", "ascent")

MOMENT_S = 0.1
"""Half the length of the windows lift-off and set-down."""
ONSET_SHARE = 0.10
"""A movement starts and ends at this share of its highest speed; the hands' stops use the same
order (`engine.kinematics.events`)."""
BOTTOM_SHARE = 0.90
EDGE_SHARE = 0.05
MAX_BOUND_SIGMA_S = 0.5
REST_S = 0.3
LONGEST_S = 4.0
"""Reaching for a load, or straightening up after it, takes no longer."""
DEFINITION_SIGMA_S = 0.06
"""Lift-off and set-down as the hands tell them, against the load's true start and stop: so far
apart on the synthetic training persons (`benchmarks/form.py`), root mean square."""
REST_SIGMA_S = 0.06
"""Likewise for where the body leaves and finds its rest: a threshold is passed late or early."""
LEAST_SPEED_DEG_S = 8.0
"""Slower than this, root mean square over the angles, is standing still."""


@dataclass(frozen=True)
class Phase:
    """One part of a movement; times in seconds with the standard errors of both bounds."""

    key: str
    start_s: float
    end_s: float
    start_sigma_s: float = math.nan
    end_sigma_s: float = math.nan

    @property
    def duration_s(self) -> float:
        """Its length."""
        return self.end_s - self.start_s

    @property
    def duration_sigma_s(self) -> float:
        """Standard error of the length; both bounds err on their own."""
        return math.hypot(self.start_sigma_s, self.end_sigma_s)

    @property
    def is_moment(self) -> bool:
        """Whether it is a window around an instant, so that its length says nothing."""
        return self.key in ("lift_off", "set_down")


@dataclass(frozen=True)
class _Bound:
    time_s: float
    sigma_s: float


def movement_speed(performance: Performance) -> Array:
    """Return how fast the posture changes, shape (T,), degrees per second.

    The root mean square of the angles' speeds over those known in a frame; 0 where none is.
    """
    names = performance.form_angles
    time_s = performance.time_s
    if not names or len(time_s) < 3:
        return np.zeros(len(time_s))
    speed = np.gradient(performance.values(names), time_s, axis=0)
    known = np.isfinite(speed)
    total = np.where(known, speed**2, 0.0).sum(axis=1)
    return np.asarray(np.sqrt(total / np.maximum(known.sum(axis=1), 1)))


def segment_lift(
    performance: Performance,
    lift: Lift,
    *,
    earliest_s: float = -math.inf,
    latest_s: float = math.inf,
) -> tuple[Phase, ...]:
    """Split one lift into its five phases.

    Lift-off and set-down are those of the hands (`lift`). The reach starts where the whole
    body begins to move before the lift-off, and the return ends where it comes to rest after the
    set-down: at 10 % of the highest posture speed on that side.

    Parameters
    ----------
    performance
        The clip.
    lift
        One of its lifts.
    earliest_s, latest_s
        The neighbouring lifts' bounds; the movement is not looked for beyond them.

    Returns
    -------
    tuple of Phase
        In order of time, as `LIFT_PHASES`.

    Raises
    ------
    DataError
        If the lift does not lie in the clip.
    """
    time_s = performance.time_s
    if not time_s[0] <= lift.start_s < lift.end_s <= time_s[-1]:
        raise DataError(
            f"The lift from {lift.start_s:.2f} to {lift.end_s:.2f} s is not inside the clip, which "
            f"lasts from {time_s[0]:.2f} to {time_s[-1]:.2f} s."
        )
    speed = movement_speed(performance)
    first = _find_rest(time_s, speed, lift.start_s, max(earliest_s, time_s[0]), backward=True)
    last = _find_rest(time_s, speed, lift.end_s, min(latest_s, time_s[-1]), backward=False)
    step_s = float(np.median(np.diff(time_s)))
    off = _Bound(lift.start_s, _moment_sigma(lift.start_sigma_s, step_s))
    down = _Bound(lift.end_s, _moment_sigma(lift.end_sigma_s, step_s))
    half = min(MOMENT_S, 0.25 * (down.time_s - off.time_s))
    return (
        _phase("reach", first, off),
        Phase("lift_off", max(first.time_s, off.time_s - half), off.time_s + half,
              off.sigma_s, off.sigma_s),
        _phase("rise", off, down),
        Phase("set_down", down.time_s - half, min(last.time_s, down.time_s + half),
              down.sigma_s, down.sigma_s),
        _phase("return", down, last),
    )  # fmt: skip


def _phase(key: str, start: _Bound, end: _Bound) -> Phase:
    return Phase(key, start.time_s, end.time_s, start.sigma_s, end.sigma_s)


def _moment_sigma(sigma_s: float, step_s: float) -> float:
    return math.hypot(DEFINITION_SIGMA_S, step_s if math.isnan(sigma_s) else sigma_s)


def _find_rest(
    time_s: Array, speed: Array, anchor_s: float, limit_s: float, *, backward: bool
) -> _Bound:
    """Return where the movement next to `anchor_s` begins (backward) or ends."""
    low, high = sorted((anchor_s, limit_s))
    low, high = max(low, anchor_s - LONGEST_S), min(high, anchor_s + LONGEST_S)
    part = np.flatnonzero((time_s >= low - 1e-9) & (time_s <= high + 1e-9))
    if part.size < 2:
        return _Bound(anchor_s, MAX_BOUND_SIGMA_S)
    order = part[::-1] if backward else part
    course = speed[order]
    level = max(ONSET_SHARE * float(course.max()), LEAST_SPEED_DEG_S)
    step_s = float(np.median(np.diff(time_s)))
    at = _first_rest(course < level, course, hold=max(1, round(REST_S / step_s)))
    if at is None:
        # Still moving at the end of what may be looked at: the bound is only known to lie beyond.
        return _Bound(float(time_s[order[-1]]), MAX_BOUND_SIGMA_S)
    frame = int(order[at])
    sigma_s = math.hypot(REST_SIGMA_S, crossing_sigma(time_s, speed, frame, level))
    return _Bound(float(time_s[frame]), min(sigma_s, MAX_BOUND_SIGMA_S))


def _first_rest(is_still: NDArray[np.bool_], course: Array, *, hold: int) -> int | None:
    """Return where the first rest starts that follows the main movement; None if none does.

    Gripping and letting go are stops too: a rest lasts `hold` samples (or to the end), and at
    least half of the highest speed comes before it.
    """
    edges = np.diff(np.concatenate(([False], is_still, [False])).astype(int))
    starts, ends = np.flatnonzero(edges == 1), np.flatnonzero(edges == -1)
    for start, end in zip(starts, ends, strict=True):
        is_long = end - start >= hold or end == len(course)
        if start > 0 and is_long and course[:start].max() >= 0.5 * course.max():
            return int(start)
    return None


def crossing_sigma(time_s: Array, signal: Array, at: int, level: float) -> float:
    """Return the standard error of a threshold's crossing: the level's own doubt over the slope.

    The share that defines the level is a convention; half of it either way counts as its doubt.
    """
    step_s = float(np.median(np.diff(time_s)))
    reach = max(1, round(0.15 / step_s))
    near = signal[max(at - reach, 0) : at + reach + 1]
    slope = float(np.ptp(near)) / (step_s * max(len(near) - 1, 1))
    shift = 0.5 * level / slope if slope > 0 else MAX_BOUND_SIGMA_S
    return float(min(math.hypot(shift, step_s / math.sqrt(12)), MAX_BOUND_SIGMA_S))


def segment_exercise(
    time_s: Array, signal: Array, *, start: int, peak: int, end: int
) -> tuple[Phase, ...]:
    """Split one repetition into descent, bottom and ascent.

    Parameters
    ----------
    time_s, signal
        Shape (T,); the principal movement, larger where the body is more bent.
    start, peak, end
        Frames of the least signal before, the largest, and the least after it.

    Returns
    -------
    tuple of Phase
        The descent starts where 5 % of the way down is passed, the ascent ends where 5 % is left;
        the bottom is where at least 90 % of the depth is kept.
    """
    down, up = signal[start : peak + 1], signal[peak : end + 1]
    begin = start + _last_below(down, EDGE_SHARE)
    low = start + _last_below(down, BOTTOM_SHARE)
    high = peak + len(up) - 1 - _last_below(up[::-1], BOTTOM_SHARE)
    finish = peak + len(up) - 1 - _last_below(up[::-1], EDGE_SHARE)
    depth = float(signal[peak] - min(signal[start], signal[end]))
    bounds = [
        _Bound(float(time_s[i]), crossing_sigma(time_s, signal, i, EDGE_SHARE * depth))
        for i in (begin, low, high, finish)
    ]
    pairs = zip(EXERCISE_PHASES, bounds[:-1], bounds[1:], strict=True)
    return tuple(_phase(key, one, two) for key, one, two in pairs)


def _last_below(rising: Array, share: float) -> int:
    """Return the last sample of a rise that is below a share of it."""
    level = rising[0] + share * (rising[-1] - rising[0])
    below = np.flatnonzero(rising <= level)
    return int(below[-1]) if below.size else 0


def phase_bounds(phases: tuple[Phase, ...]) -> list[float]:
    """Return the bounds of the phases that are no moments, in percent of the movement."""
    long = [p for p in phases if not p.is_moment]
    start, end = long[0].start_s, long[-1].end_s
    times = [long[0].start_s, *(p.end_s for p in long)]
    return [100.0 * (t - start) / (end - start) for t in times]
