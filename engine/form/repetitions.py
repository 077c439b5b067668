"""Repetitions in a clip: every lift, or every turn of an exercise, with its numbers."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from itertools import pairwise
from typing import Literal

import numpy as np
from scipy.signal import find_peaks

from engine.datatypes import Array, Measurement
from engine.form.performance import Performance, side_of
from engine.form.phases import Phase, segment_exercise, segment_lift

__all__ = ["Kind", "Repetition", "find_repetitions", "principal_movement"]

Kind = Literal["lift", "exercise"]

MIN_PERIOD_S, MAX_PERIOD_S = 0.6, 12.0
MIN_DEPTH_DEG = 15.0
"""Smaller movements, root mean square over the angles, are sway or measuring noise."""
MIN_DEPTH_SHARE = 0.5
"""A repetition goes at least half as deep as the clip's deepest."""
PERIODIC = 0.4
"""Autocorrelation above which a clip counts as periodic."""


@dataclass(frozen=True)
class Repetition:
    """One lift, or one repetition of an exercise.

    `range_of_motion_deg` maps an angle to its range within the repetition; `asymmetry_deg`
    maps a joint to the mean difference left minus right.
    """

    number: int
    kind: Kind
    phases: tuple[Phase, ...]
    range_of_motion_deg: Mapping[str, Measurement] = field(default_factory=dict)
    asymmetry_deg: Mapping[str, Measurement] = field(default_factory=dict)

    @property
    def start_s(self) -> float:
        """Where the whole movement starts."""
        return self.phases[0].start_s

    @property
    def end_s(self) -> float:
        """Where it ends."""
        return self.phases[-1].end_s

    @property
    def duration_s(self) -> Measurement:
        """How long it lasts."""
        sigma = math.hypot(self.phases[0].start_sigma_s, self.phases[-1].end_sigma_s)
        return Measurement(self.end_s - self.start_s, sigma)

    @property
    def tempo_s(self) -> Mapping[str, float]:
        """Length of every phase that is not a moment."""
        return {p.key: p.duration_s for p in self.phases if not p.is_moment}


def find_repetitions(
    performance: Performance, kind: Literal["auto", "lift", "exercise"] = "auto"
) -> tuple[Repetition, ...]:
    """Find the repetitions of a clip.

    Parameters
    ----------
    performance
        The clip.
    kind
        `lift` takes the lifts that were found, `exercise` looks for turns of the principal
        movement; `auto` takes the lifts where there are any.

    Returns
    -------
    tuple of Repetition
        In order of time; empty where nothing repeats or moves far enough.
    """
    if kind == "lift" or (kind == "auto" and performance.lifts):
        parts = list(_split_lifts(performance))
        found: Kind = "lift"
    else:
        parts = list(_split_exercise(performance))
        found = "exercise"
    return tuple(
        _measure(performance, number, found, phases) for number, phases in enumerate(parts)
    )


def _split_lifts(performance: Performance) -> list[tuple[Phase, ...]]:
    lifts = sorted(performance.lifts, key=lambda lift: lift.start_s)
    if not lifts:
        return []
    middles = [0.5 * (a.end_s + b.start_s) for a, b in pairwise(lifts)]
    return [
        segment_lift(performance, lift, earliest_s=low, latest_s=high)
        for lift, low, high in zip(lifts, [-math.inf, *middles], [*middles, math.inf], strict=True)
    ]


def principal_movement(performance: Performance) -> Array:
    """Return the clip's main movement as one signal, shape (T,), degrees; larger is more bent.

    The first principal component of the measured angles, scaled to the root mean square over
    them; NaN where an angle that takes part is missing.
    """
    names = performance.form_angles
    values = performance.values(names)
    known = np.isfinite(values)
    # An angle seen in fewer than nine frames of ten would cut holes into the signal.
    kept = known.mean(axis=0) >= 0.9 if len(values) else np.zeros(0, dtype=bool)
    values = values[:, kept]
    if not values.shape[1]:
        return np.full(len(performance.time_s), np.nan)
    centred = values - np.nanmedian(values, axis=0)
    whole = np.isfinite(centred).all(axis=1)
    if whole.sum() < 3:
        return np.full(len(centred), np.nan)
    scatter = centred[whole] - centred[whole].mean(axis=0)
    loading = np.linalg.svd(scatter, full_matrices=False)[2][0]
    loading *= 1.0 if loading.sum() >= 0 else -1.0
    return np.asarray(centred @ loading / math.sqrt(values.shape[1]))


def _split_exercise(performance: Performance) -> list[tuple[Phase, ...]]:
    time_s = performance.time_s
    signal = principal_movement(performance)
    known = np.isfinite(signal)
    if known.sum() < 5:
        return []
    signal = np.interp(time_s, time_s[known], signal[known])
    step_s = float(np.median(np.diff(time_s)))
    low, high = np.percentile(signal, [2, 98])
    if high - low < MIN_DEPTH_DEG:
        return []
    period_s = _find_period(signal - signal.mean(), step_s)
    distance = max(1, round(0.5 * (period_s or MIN_PERIOD_S) / step_s))
    # The lowest value is put at both ends, so that a turn next to them keeps its prominence.
    padded = np.concatenate(([signal.min()], signal, [signal.min()]))
    peaks, _ = find_peaks(padded, prominence=MIN_DEPTH_SHARE * (high - low), distance=distance)
    turns = []
    for peak, left, right in _neighbours(peaks - 1, len(signal)):
        start = left + int(np.argmin(signal[left : peak + 1]))
        end = peak + int(np.argmin(signal[peak : right + 1]))
        # A turn that is cut off by the clip's ends was not seen whole.
        depth = min(signal[peak] - signal[start], signal[peak] - signal[end])
        if start < peak < end and depth >= MIN_DEPTH_SHARE * (high - low):
            turns.append(segment_exercise(time_s, signal, start=start, peak=peak, end=end))
    return turns


def _neighbours(peaks: Array, length: int) -> list[tuple[int, int, int]]:
    """Return every peak with the peaks (or ends) on both sides."""
    edges = [0, *map(int, peaks), length - 1]
    return [(edges[i], edges[i - 1], edges[i + 1]) for i in range(1, len(edges) - 1)]


def _find_period(signal: Array, step_s: float) -> float | None:
    """Return the period of a repeated movement by its autocorrelation; None if not periodic.

    Fewer than three turns make no period: two alike movements far apart say nothing about those
    between them.
    """
    spectrum = np.fft.rfft(signal, 2 * len(signal))
    correlation = np.fft.irfft(np.abs(spectrum) ** 2)[: len(signal)]
    # Unbiased: fewer samples overlap at longer lags.
    correlation /= np.arange(len(signal), 0, -1)
    correlation /= correlation[0] or 1.0
    last = min(round(MAX_PERIOD_S / step_s), len(signal) // 3)
    peaks, _ = find_peaks(correlation[:last], height=PERIODIC)
    peaks = peaks[peaks * step_s >= MIN_PERIOD_S]
    return float(peaks[0] * step_s) if peaks.size else None


def _measure(
    performance: Performance, number: int, kind: Kind, phases: tuple[Phase, ...]
) -> Repetition:
    names = performance.form_angles
    time_s = performance.time_s
    part = (time_s >= phases[0].start_s - 1e-9) & (time_s <= phases[-1].end_s + 1e-9)
    value, sigma = performance.values(names)[part], performance.sigmas(names)[part]
    return Repetition(
        number=number,
        kind=kind,
        phases=phases,
        range_of_motion_deg={
            name: _range(value[:, i], sigma[:, i]) for i, name in enumerate(names)
        },
        asymmetry_deg=dict(_asymmetry(names, value, sigma)),
    )


def _range(value: Array, sigma: Array) -> Measurement:
    if not np.isfinite(value).any():
        return Measurement(math.nan)
    low, high = int(np.nanargmin(value)), int(np.nanargmax(value))
    return Measurement(float(value[high] - value[low]), float(np.hypot(sigma[low], sigma[high])))


def _asymmetry(names: tuple[str, ...], value: Array, sigma: Array) -> list[tuple[str, Measurement]]:
    found = []
    for i, name in enumerate(names):
        base, side = side_of(name)["base"], side_of(name)["side"]
        if side != "left" or f"{base}_r" not in names:
            continue
        j = names.index(f"{base}_r")
        difference = value[:, i] - value[:, j]
        # A side that was hidden most of the time can't be compared with the other.
        if np.isfinite(difference).mean() < 0.5:
            continue
        doubt = np.hypot(sigma[:, i], sigma[:, j])[np.isfinite(difference)]
        # Errors hardly change within a repetition, so that averaging does not shrink them.
        found.append((base, Measurement(float(np.nanmean(difference)), float(np.mean(doubt)))))
    return found
