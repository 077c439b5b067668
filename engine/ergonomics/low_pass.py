"""The zero-lag low-pass that movement is filtered with before it is differentiated.

SciPy has it too, but loading its signal processing takes over a second, which is more than all the
rest of a report; the tests hold this one against SciPy's.
"""

from __future__ import annotations

import math

import numpy as np

from engine.datatypes import Array

__all__ = ["filter_zero_lag"]

PAD = 9
"""Samples put before and after the data, as many as SciPy puts for one section."""
HIGHEST_SHARE = 0.45
"""Of the frame rate: a cut-off nearer to half of it can't be told from no filter."""


def filter_zero_lag(values: Array, *, rate_hz: float, cutoff_hz: float) -> Array:
    """Filter columns forwards and backwards with a second-order Butterworth low-pass.

    Parameters
    ----------
    values
        Shape (T, N) with more than 9 rows, evenly sampled, without gaps.
    rate_hz
        Samples per second.
    cutoff_hz
        Where both passes together have 3 dB; lowered to what the rate allows.

    Returns
    -------
    Array
        Shape (T, N). Second order per pass, fourth in total; the ends are padded by odd reflection,
        and each pass starts in the steady state of its first sample.

    References
    ----------
    .. [1] Winter (2009), Biomechanics and Motor Control of Human Movement, 4th ed., sec. 3.4.4.
    """
    # Each pass of a second-order filter is 3 dB down where both together shall be.
    corrected = min(cutoff_hz / (2**0.5 - 1) ** 0.25, HIGHEST_SHARE * rate_hz)
    before = 2 * values[0] - values[PAD:0:-1]
    after = 2 * values[-1] - values[-2 : -PAD - 2 : -1]
    padded = np.concatenate([before, values, after])
    forwards = _filter(padded, corrected / rate_hz)
    backwards = _filter(forwards[::-1], corrected / rate_hz)
    return backwards[::-1][PAD:-PAD]


def _filter(values: Array, share: float) -> Array:
    """Filter once, cut off at a share of the sampling rate, from rest at the first sample."""
    gain, back_1, back_2 = _design(share)
    # With y the output and x the input: y[n] = gain (x[n] + 2 x[n-1] + x[n-2]) - b1 y[n-1] - ...
    lagged = np.concatenate([values[:1], values[:1], values])
    driven = gain * (lagged[2:] + 2 * lagged[1:-1] + lagged[:-2])
    result: Array = np.empty_like(driven)
    last = before_last = values[0]
    for n, drive in enumerate(driven):
        last, before_last = drive - back_1 * last - back_2 * before_last, last
        result[n] = last
    return result


def _design(share: float) -> tuple[float, float, float]:
    """Return gain and feedback of a Butterworth low-pass of second order (bilinear transform)."""
    warped = math.tan(math.pi * share)
    scale = 1 + math.sqrt(2) * warped + warped**2
    gain = warped**2 / scale
    return gain, 2 * (warped**2 - 1) / scale, (1 - math.sqrt(2) * warped + warped**2) / scale
