"""From curves to bands without flicker: hysteresis, shortest stay, held postures.

Values have shape (T, N): T frames, N drawn versions of the same curve. NaN means missing.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

from engine.datatypes import Array

__all__ = ["MISSING_SCORE", "exceeds", "find_holds", "held_maximum", "score_bands"]

BoolArray = NDArray[np.bool_]
IntArray = NDArray[np.int8]
BandRows = Sequence[tuple[float, int]]

MISSING_SCORE = 0
"""Stands for a part that was not seen; every published score starts at 1."""


def score_bands(
    value: Array,
    rows: BandRows,
    time_s: Array,
    *,
    hysteresis: float = 0.0,
    dwell_s: float = 0.0,
) -> IntArray:
    """Look scores up in bands.

    Parameters
    ----------
    value
        Shape (T, N).
    rows
        Upper bound of each band and its score, rising bounds, the last infinite. A bound itself
        belongs to the band with the smaller score, as the sheets print it ("0 to 20", "over 20").
    time_s
        Shape (T,).
    hysteresis
        A worse band is entered at its bound and left this far before it, in the value's unit.
    dwell_s
        Stays in a band that are shorter and come back to where they started are dropped.

    Returns
    -------
    IntArray
        Shape (T, N); 0 where the value is missing.
    """
    scores = np.array([score for _, score in rows], dtype=np.int8)
    index = np.zeros(value.shape, dtype=np.int8)
    for k, (bound, score) in enumerate(rows[:-1]):
        is_worse_above = rows[k + 1][1] > score
        above = exceeds(
            value if is_worse_above else -value,
            bound if is_worse_above else -bound,
            time_s,
            hysteresis=hysteresis,
            dwell_s=dwell_s,
        )
        index += above if is_worse_above else ~above
    return np.where(np.isnan(value), np.int8(MISSING_SCORE), scores[index])


def exceeds(
    value: Array,
    limit: float,
    time_s: Array,
    *,
    hysteresis: float = 0.0,
    dwell_s: float = 0.0,
) -> BoolArray:
    """Tell where a value lies above a limit, without flicker.

    Parameters as in `score_bands`; the result has the shape of `value` and is false where the
    value is missing. After a gap the limit decides alone.
    """
    above = np.asarray(value > limit)
    if hysteresis <= 0 and dwell_s <= 0:
        return above
    is_known = ~np.isnan(value)
    decides = ~is_known | above | (value < limit - hysteresis)
    decides[0] = True
    decides[1:] |= ~is_known[:-1]
    frames = np.arange(value.shape[0], dtype=np.int32)[:, None]
    last = np.maximum.accumulate(np.where(decides, frames, -1), axis=0)
    state = np.take_along_axis(above, last, axis=0)
    if dwell_s <= 0 or value.shape[0] < 3:
        return state
    # Short relief first: a bad posture that flickers is one bad posture.
    for short in (False, True):
        _drop_short_runs(state, is_known, time_s, dwell_s, which=short)
    return state


def _drop_short_runs(
    state: BoolArray, is_known: BoolArray, time_s: Array, dwell_s: float, *, which: bool
) -> None:
    """Turn over runs of one kind that are too short and lie within the other kind, in place."""
    n_frames, n_columns = state.shape
    code = np.where(is_known, state, 2).astype(np.int8).T.ravel()
    is_start = np.ones(code.size, dtype=bool)
    is_start[1:] = code[1:] != code[:-1]
    is_start[::n_frames] = True
    start = np.flatnonzero(is_start)
    frame = start % n_frames
    is_inner = np.zeros(start.size, dtype=bool)
    # Its own column goes on before and after, and both neighbours are of the other kind.
    is_inner[1:-1] = (frame[1:-1] > 0) & (frame[2:] > 0)
    other = 0 if which else 1
    before, after = np.roll(code[start], 1) == other, np.roll(code[start], -1) == other
    is_inner &= before & after & (code[start] == int(which))
    chosen = np.flatnonzero(is_inner)
    if not chosen.size:
        return
    lasts = time_s[frame[chosen + 1]] - time_s[frame[chosen]]
    chosen = chosen[lasts < dwell_s - 1e-9]
    turned = np.zeros(start.size, dtype=bool)
    turned[chosen] = True
    flip = np.repeat(turned, np.diff(np.append(start, code.size)))
    state ^= flip.reshape(n_columns, n_frames).T


def _n_frames(time_s: Array, span_s: float) -> int:
    """Return how many frames a span covers, at least one."""
    if time_s.size < 2:
        return 1
    step_s = float(np.median(np.diff(time_s)))
    return max(1, int(np.ceil(span_s / step_s - 1e-9)))


def held_maximum(score: ArrayLike, time_s: Array, *, hold_s: float = 0.2) -> NDArray[np.int64]:
    """Return the highest score that is kept or exceeded for `hold_s` without a break.

    Parameters
    ----------
    score
        Shape (T, N), 0 where nothing was scored.
    time_s
        Shape (T,).
    hold_s
        Shorter peaks don't count; if no score is held that long, the plain maximum.

    Returns
    -------
    NDArray
        Shape (N,); 0 where nothing was scored.
    """
    from scipy.ndimage import minimum_filter1d

    scores = np.asarray(score)
    width = min(_n_frames(time_s, hold_s), scores.shape[0])
    least = minimum_filter1d(scores, width, axis=0)
    inside = least[width // 2 : scores.shape[0] - (width - 1) // 2]
    held = np.asarray(inside.max(axis=0), dtype=np.int64)
    return np.where(held > 0, held, scores.max(axis=0))


def find_holds(value: Array, time_s: Array, *, half_width: float, hold_s: float) -> BoolArray:
    """Mark frames of postures that are held: within plus or minus `half_width` for `hold_s`.

    Parameters
    ----------
    value
        Shape (T,); a missing value ends a hold.
    time_s
        Shape (T,).
    half_width
        How far the value may wander to either side, in its own unit.
    hold_s
        How long, s.

    Returns
    -------
    BoolArray
        Shape (T,).
    """
    from scipy.ndimage import maximum_filter1d, minimum_filter1d

    n_frames = value.size
    width = _n_frames(time_s, hold_s) + 1
    if n_frames < 2 or width > n_frames:
        return np.zeros(n_frames, dtype=bool)
    inside = slice(width // 2, n_frames - (width - 1) // 2)
    is_known = np.isfinite(value)
    top = maximum_filter1d(np.where(is_known, value, np.inf), width)[inside]
    bottom = minimum_filter1d(np.where(is_known, value, -np.inf), width)[inside]
    holds = np.isfinite(top) & np.isfinite(bottom)
    holds[holds] = (top - bottom)[holds] <= 2 * half_width + 1e-9
    # A window that holds marks all of its frames.
    edges = np.zeros(n_frames + 1, dtype=np.int64)
    edges[: holds.size] += holds
    edges[width : width + holds.size] -= holds
    return np.asarray(np.cumsum(edges[:-1]) > 0)
