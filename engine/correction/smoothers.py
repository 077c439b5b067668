"""Smoothers behind one protocol, chosen by name.

They work between the gaps of a clip; `OneEuro` uses only the past, as a live display has to. The
Kalman smoother, which needs the gaps, is in `kalman.py`.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline
from scipy.ndimage import median_filter
from scipy.signal import savgol_filter

from engine.correction.filters import butterworth_low_pass
from engine.correction.gaps import find_runs
from engine.correction.robust import frame_interval_s, mad_sigma, odd_window
from engine.datatypes import Array

__all__ = [
    "Butterworth",
    "Hampel",
    "Median",
    "OneEuro",
    "SavitzkyGolay",
    "Smoother",
    "Unsmoothed",
    "smooth_runs",
]


class Smoother(Protocol):
    """Makes a trajectory smooth."""

    @property
    def settings(self) -> dict[str, float]:
        """Return the parameters by name."""
        ...

    def smooth(self, time_s: Array, values: Array) -> Array:
        """Smooth one run without gaps.

        Parameters
        ----------
        time_s
            Shape (T,), s, increasing, not necessarily even.
        values
            Shape (T, C), no NaN.

        Returns
        -------
        Array
            Shape (T, C).
        """
        ...


def smooth_runs(smoother: Smoother, time_s: Array, position: Array) -> Array:
    """Smooth every keypoint between its gaps.

    Parameters
    ----------
    smoother
        Any smoother.
    time_s
        Shape (T,), s.
    position
        Shape (T, K, D); NaN in gaps, which stay.

    Returns
    -------
    Array
        Shape (T, K, D).
    """
    smoothed = position.copy()
    known = np.isfinite(position).all(axis=2)
    # Keypoints with the same gaps go together, which is much faster.
    patterns, member = np.unique(known, axis=1, return_inverse=True)
    for i in range(patterns.shape[1]):
        columns = np.flatnonzero(member.ravel() == i)
        for start, stop in find_runs(patterns[:, i]):
            series = position[start:stop, columns].reshape(stop - start, -1)
            series = smoother.smooth(time_s[start:stop], series)
            smoothed[start:stop, columns] = series.reshape(stop - start, len(columns), -1)
    return smoothed


class _Settings:
    """Gives the parameters of a dataclass by name."""

    @property
    def settings(self) -> dict[str, float]:
        """Return the parameters by name."""
        return dataclasses.asdict(self)  # type: ignore[call-overload,no-any-return]


@dataclass(frozen=True)
class Unsmoothed(_Settings):
    """Leaves everything as it is."""

    def smooth(self, time_s: Array, values: Array) -> Array:
        """Return the values."""
        return values


@dataclass(frozen=True)
class Butterworth(_Settings):
    """Zero-lag low-pass, 4th order in total; see `butterworth_low_pass`."""

    cutoff_hz: float = 6.0

    def smooth(self, time_s: Array, values: Array) -> Array:
        """Smooth one run; runs shorter than four samples stay as they are."""
        return butterworth_low_pass(time_s, values, cutoff_hz=self.cutoff_hz)


@dataclass(frozen=True)
class SavitzkyGolay(_Settings):
    """Local cubic over a centred window (0.3 s are 9 frames at 30 frames/s).

    Unevenly sampled runs are brought to an even grid and back. A run shorter than the window is
    smoothed by the longest window it has room for, and stays as it is below five samples.

    References
    ----------
    .. [1] Savitzky & Golay (1964), Anal. Chem. 36: 1627-1639.
    """

    window_s: float = 0.3
    order: int = 3

    def smooth(self, time_s: Array, values: Array) -> Array:
        """Smooth one run."""
        window = min(odd_window(self.window_s, frame_interval_s(time_s)), _largest_odd(values))
        if window <= self.order:
            return values
        if is_even(time_s):
            return np.asarray(savgol_filter(values, window, self.order, axis=0))
        grid = np.linspace(time_s[0], time_s[-1], len(time_s))
        even = savgol_filter(CubicSpline(time_s, values)(grid), window, self.order, axis=0)
        return np.asarray(CubicSpline(grid, even)(time_s))


@dataclass(frozen=True)
class Median(_Settings):
    """Running median; the ends count as repeated (0.17 s are 5 frames at 30 frames/s)."""

    window_s: float = 5.0 / 30.0

    def smooth(self, time_s: Array, values: Array) -> Array:
        """Smooth one run."""
        window = odd_window(self.window_s, frame_interval_s(time_s))
        return np.asarray(median_filter(values, size=(window, 1), mode="nearest"))


@dataclass(frozen=True)
class Hampel(_Settings):
    """Replaces samples further than `n_sigmas` robust SD from the running median; keeps the rest.

    The spread is that of the whole run about its running median, so that a point at rest is not
    corrected for its own noise.

    References
    ----------
    .. [1] Pearson et al. (2016), Generalized Hampel filters, EURASIP J. Adv. Signal Process. 87.
    """

    window_s: float = 7.0 / 30.0
    n_sigmas: float = 3.0

    def smooth(self, time_s: Array, values: Array) -> Array:
        """Smooth one run."""
        middle = Median(self.window_s).smooth(time_s, values)
        distance = values - middle
        limit = self.n_sigmas * np.nan_to_num(mad_sigma(distance))
        return np.where(np.abs(distance) > limit, middle, values)


@dataclass(frozen=True)
class OneEuro(_Settings):
    """Causal low-pass whose cut-off rises with speed: for live use.

    Parameters
    ----------
    min_cutoff_hz
        Cut-off at rest, Hz.
    beta
        Rise of the cut-off, Hz per unit/s.
    derivative_cutoff_hz
        Cut-off for the speed, Hz.

    References
    ----------
    .. [1] Casiez, Roussel & Vogel (2012), 1€ filter, CHI '12: 2527-2530.
    """

    min_cutoff_hz: float = 3.0
    beta: float = 4.0
    derivative_cutoff_hz: float = 1.0

    def smooth(self, time_s: Array, values: Array) -> Array:
        """Smooth one run; the first sample stays as it is."""
        smoothed = np.array(values, dtype=float)
        speed = np.zeros(values.shape[1])
        for t in range(1, len(values)):
            step = float(time_s[t] - time_s[t - 1])
            raw_speed = (values[t] - smoothed[t - 1]) / step
            speed += _weight(step, self.derivative_cutoff_hz) * (raw_speed - speed)
            weight = _weight(step, self.min_cutoff_hz + self.beta * np.abs(speed))
            smoothed[t] = smoothed[t - 1] + weight * (values[t] - smoothed[t - 1])
        return smoothed


def _weight(step_s: float, cutoff_hz: Array | float) -> Array:
    """Return the weight of a new sample in a first-order low-pass."""
    tau = 1.0 / (2.0 * np.pi * np.asarray(cutoff_hz))
    return np.asarray(1.0 / (1.0 + tau / step_s))


def is_even(time_s: Array) -> bool:
    """Whether the samples are evenly spaced, to 2 %."""
    step = np.diff(time_s)
    return bool(step.size == 0 or np.allclose(step, np.median(step), rtol=0.02, atol=0.0))


def _largest_odd(values: NDArray[np.float64]) -> int:
    return len(values) - (1 - len(values) % 2)
