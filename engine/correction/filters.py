"""Smoothing of keypoint trajectories."""

from __future__ import annotations

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.signal import butter, sosfiltfilt

from engine.correction.gaps import find_runs
from engine.datatypes import Array
from engine.errors import DataError

__all__ = ["PASSES_CORRECTION", "butterworth_low_pass", "noise_gain"]

PASSES_CORRECTION = 0.802
"""Two passes of a 2nd-order Butterworth filter lower the cut-off by (sqrt(2) - 1)**0.25."""

SHORTEST_RUN = 4
"""Shorter pieces between gaps carry too little to be filtered and stay as they are."""


def butterworth_low_pass(time_s: Array, values: Array, *, cutoff_hz: float) -> Array:
    """Smooth by a zero-lag Butterworth filter, 4th order in total.

    Two passes (forward and backward) of a 2nd-order filter whose design cut-off is raised so
    that the result has its -3 dB point at `cutoff_hz` after both passes. Every run
    between gaps is filtered by itself; its ends are extended by odd reflection. Unevenly
    sampled series are brought to an even grid by a cubic spline and back.

    Parameters
    ----------
    time_s
        Shape (T,), s, increasing.
    values
        Shape (T, C); NaN in gaps.
    cutoff_hz
        Cut-off frequency of the result, Hz.

    Returns
    -------
    Array
        Shape (T, C). Unchanged where the sampling rate is too low for the cut-off, and in runs
        shorter than four samples.

    Raises
    ------
    DataError
        If the cut-off is not positive.

    References
    ----------
    .. [1] Winter (2009), Biomechanics and Motor Control of Human Movement, 4th ed., ch. 3.
    """
    if not cutoff_hz > 0:
        raise DataError(f"The cut-off frequency must be positive, got {cutoff_hz:g} Hz.")
    smoothed = np.array(values, dtype=float)
    known = np.asarray(np.isfinite(values).all(axis=1))
    for start, stop in find_runs(known):
        if stop - start >= SHORTEST_RUN:
            run = slice(start, stop)
            smoothed[run] = _filter_run(time_s[run], values[run], cutoff_hz)
    return smoothed


def _filter_run(time_s: Array, values: Array, cutoff_hz: float) -> Array:
    step_s = float(np.median(np.diff(time_s)))
    design = _design_cutoff(step_s, cutoff_hz)
    if design is None:
        return values
    sos = butter(2, design, output="sos")
    # Long enough for the filter's transient, never longer than the run allows.
    pad = min(len(values) - 1, int(np.ceil(6.0 / design)) + 6)
    if np.allclose(np.diff(time_s), step_s, rtol=0.02, atol=0.0):
        return np.asarray(sosfiltfilt(sos, values, axis=0, padtype="odd", padlen=pad))
    grid = np.arange(time_s[0], time_s[-1] + 0.5 * step_s, step_s)
    even = CubicSpline(time_s, values)(np.clip(grid, time_s[0], time_s[-1]))
    pad = min(pad, len(even) - 1)
    filtered = sosfiltfilt(sos, even, axis=0, padtype="odd", padlen=pad)
    return np.asarray(CubicSpline(grid, filtered)(time_s))


def _design_cutoff(step_s: float, cutoff_hz: float) -> float | None:
    """Return the design cut-off of one pass as a share of the Nyquist frequency; None if above.

    The raise by 1/0.802 holds for the analogue filter, so it is applied to the frequency as
    the bilinear transform warps it; at 6 Hz and 30 frames/s the difference is 3 %.
    """
    share = cutoff_hz * 2.0 * step_s
    if share >= 1.0:
        return None
    return float(2.0 / np.pi * np.arctan(np.tan(np.pi / 2.0 * share) / PASSES_CORRECTION))


def noise_gain(step_s: float, *, cutoff_hz: float) -> float:
    """Return by how much the filter shrinks the SD of white noise (1 = not at all).

    Computed from the power gain of the filter over the band up to the Nyquist frequency.
    """
    design = _design_cutoff(step_s, cutoff_hz)
    if design is None:
        return 1.0
    warped = np.tan(np.pi * np.linspace(1e-4, 0.9999, 4000) / 2) / np.tan(np.pi * design / 2)
    amplitude = 1.0 / (1.0 + warped**4)
    return float(np.sqrt(np.mean(amplitude**2)))
