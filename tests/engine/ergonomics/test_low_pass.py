"""The zero-lag filter: SciPy's numbers, and the gain that Winter states."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.signal import butter, sosfiltfilt

from engine.ergonomics.low_pass import filter_zero_lag


@pytest.mark.parametrize("rate_hz", [25.0, 29.97, 60.0, 240.0])
@pytest.mark.parametrize("cutoff_hz", [2.0, 6.0, 12.0])
@pytest.mark.parametrize("length", [10, 16, 301])
def test_it_is_what_scipy_gives(rate_hz, cutoff_hz, length):
    rng = np.random.default_rng(7)
    values = np.cumsum(rng.normal(size=(length, 4)), axis=0) + 3.0
    corrected = min(cutoff_hz / (2**0.5 - 1) ** 0.25, 0.45 * rate_hz)
    sections = butter(2, corrected, fs=rate_hz, output="sos")
    expected = sosfiltfilt(sections, values, axis=0)
    found = filter_zero_lag(values, rate_hz=rate_hz, cutoff_hz=cutoff_hz)
    assert np.allclose(found, expected, rtol=0, atol=1e-11)


@pytest.mark.parametrize(
    ("frequency_hz", "gain"),
    [(0.5, 1.0), (6.0, 0.5**0.5), (24.0, 0.0)],
    ids=["pass", "edge", "stop"],
)
def test_a_sine_keeps_its_time_and_the_stated_share_of_its_size(frequency_hz, gain):
    time_s = np.arange(4800) / 240.0
    wave = np.sin(2 * np.pi * frequency_hz * time_s)[:, None]
    found = filter_zero_lag(wave, rate_hz=240.0, cutoff_hz=6.0)
    middle = slice(1200, 3600)
    assert found[middle] == pytest.approx(gain * wave[middle], abs=0.01)


def test_a_straight_line_stays_as_it_is():
    line = np.linspace(-2.0, 5.0, 90)[:, None]
    assert np.allclose(filter_zero_lag(line, rate_hz=30.0, cutoff_hz=4.0), line, atol=1e-3)
