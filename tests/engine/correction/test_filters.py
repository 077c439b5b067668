import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from engine.correction.filters import butterworth_low_pass, noise_gain
from engine.errors import DataError


def sine(time_s, hz, amplitude=1.0):
    return amplitude * np.sin(2 * np.pi * hz * time_s)[:, None]


def test_slow_motion_passes_without_lag():
    time_s = np.arange(0, 6, 1 / 30)
    smoothed = butterworth_low_pass(time_s, sine(time_s, 0.5), cutoff_hz=6.0)
    assert np.abs(smoothed - sine(time_s, 0.5))[10:-10].max() < 1e-3


def test_amplitude_is_3_db_down_at_the_stated_cut_off():
    time_s = np.arange(0, 20, 1 / 100)
    smoothed = butterworth_low_pass(time_s, sine(time_s, 6.0), cutoff_hz=6.0)
    middle = slice(500, 1500)
    gain = smoothed[middle].std() / sine(time_s, 6.0)[middle].std()
    assert gain == pytest.approx(1 / np.sqrt(2), abs=0.005)


def test_fast_noise_is_removed():
    time_s = np.arange(0, 10, 1 / 60)
    smoothed = butterworth_low_pass(time_s, sine(time_s, 25.0), cutoff_hz=6.0)
    assert np.abs(smoothed[60:-60]).max() < 0.01


def test_gaps_stay_gaps_and_sides_do_not_leak():
    time_s = np.arange(0, 4, 1 / 30)
    values = np.where(time_s[:, None] < 2, 0.0, 5.0)
    values[55:65] = np.nan
    smoothed = butterworth_low_pass(time_s, values, cutoff_hz=3.0)
    assert np.isnan(smoothed[55:65]).all()
    assert np.allclose(smoothed[:55], 0.0)
    assert np.allclose(smoothed[65:], 5.0)


def test_unevenly_sampled_series_keeps_its_times():
    rng = np.random.default_rng(1)
    time_s = np.cumsum(rng.uniform(0.02, 0.05, 200))
    smoothed = butterworth_low_pass(time_s, sine(time_s, 0.4), cutoff_hz=6.0)
    assert np.abs(smoothed - sine(time_s, 0.4))[10:-10].max() < 0.01


def test_low_frame_rate_is_left_alone():
    time_s = np.arange(0, 10, 0.2)
    values = np.random.default_rng(0).normal(size=(50, 2))
    assert np.array_equal(butterworth_low_pass(time_s, values, cutoff_hz=6.0), values)


def test_cut_off_must_be_positive():
    with pytest.raises(DataError, match="positive"):
        butterworth_low_pass(np.arange(5.0), np.zeros((5, 1)), cutoff_hz=0.0)


@given(st.integers(1, 40), st.floats(-100, 100))
def test_a_constant_stays_the_same(n, level):
    time_s = np.arange(n) / 30
    smoothed = butterworth_low_pass(time_s, np.full((n, 1), level), cutoff_hz=6.0)
    assert np.allclose(smoothed, level)


def test_noise_gain_agrees_with_filtered_noise():
    time_s = np.arange(0, 300, 1 / 30)
    noise = np.random.default_rng(0).normal(size=(time_s.size, 1))
    measured = butterworth_low_pass(time_s, noise, cutoff_hz=6.0)[50:-50].std()
    assert noise_gain(1 / 30, cutoff_hz=6.0) == pytest.approx(measured, rel=0.03)
