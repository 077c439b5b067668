"""Gaps, low-pass filter and resampling of markers."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from engine.errors import ConfigError, DataError, ShapeError
from engine.kinematics.markers import MarkerRecording, filter_markers, resample_markers
from engine.kinematics.markers.recording import fill_short_gaps

RATE = 100.0


def make_sine(frequency_hz, *, n_frames=600, markers=2, rate=RATE):
    time_s = np.arange(n_frames) / rate
    wave = np.sin(2 * np.pi * frequency_hz * time_s)
    position = np.tile(wave[:, None, None], (1, markers, 3))
    names = tuple(f"M{i}" for i in range(markers))
    return MarkerRecording(time_s, position, names, rate)


@pytest.mark.parametrize("cutoff_hz", [4.0, 8.0])
@pytest.mark.parametrize("order", [2, 4])
def test_the_cut_off_loses_three_decibels_and_nothing_is_delayed(cutoff_hz, order):
    recording = make_sine(cutoff_hz)
    filtered = filter_markers(recording, cutoff_hz=cutoff_hz, order=order)
    middle = slice(200, 400)
    before, after = recording.position_m[middle, 0, 0], filtered.position_m[middle, 0, 0]
    gain = (before @ after) / (before @ before)
    assert gain == pytest.approx(np.sqrt(0.5), abs=0.005)
    # What is left is in phase: no component a quarter period later.
    later = np.cos(2 * np.pi * cutoff_hz * recording.time_s[middle])
    assert abs(later @ after) / (later @ later) < 0.005


def test_slow_movement_passes_and_vibration_does_not():
    slow, fast = (filter_markers(make_sine(f)).position_m[100:500, 0, 0] for f in (1.0, 30.0))
    assert np.abs(slow).max() == pytest.approx(1.0, abs=0.01)
    assert np.abs(fast).max() < 0.01


def test_a_gap_stays_a_gap_and_does_not_spoil_its_sides():
    recording = make_sine(1.0)
    position = np.array(recording.position_m)
    position[300:340, 0] = np.nan
    filtered = filter_markers(replace(recording, position_m=position))
    assert np.isnan(filtered.position_m[300:340, 0]).all()
    whole = filter_markers(recording).position_m
    np.testing.assert_array_equal(filtered.position_m[:, 1], whole[:, 1])
    rest = np.isfinite(filtered.position_m[:, 0, 0])
    assert np.abs(filtered.position_m[rest, 0] - whole[rest, 0]).max() < 0.03


@pytest.mark.parametrize("bad", [{"cutoff_hz": 50.0}, {"cutoff_hz": 0.0}, {"order": 3}])
def test_a_filter_that_can_not_be_is_refused(bad):
    with pytest.raises(ConfigError):
        filter_markers(make_sine(1.0), **bad)


def test_a_jump_in_time_is_refused_by_the_filter():
    recording = make_sine(1.0)
    time_s = np.array(recording.time_s)
    time_s[300:] += 1.0
    with pytest.raises(DataError, match="regular rate"):
        filter_markers(replace(recording, time_s=time_s))


@settings(max_examples=25, deadline=None)
@given(
    coefficients=st.lists(st.floats(-2, 2), min_size=4, max_size=4),
    start=st.integers(6, 60),
    length=st.integers(1, 20),
)
def test_a_short_gap_in_a_cubic_is_filled_exactly(coefficients, start, length):
    time_s = np.arange(100) / RATE
    curve = np.polyval(coefficients, time_s)
    position = np.tile(curve[:, None, None], (1, 1, 3))
    position[start : start + length] = np.nan
    filled = fill_short_gaps(time_s, position, max_gap_s=0.2)
    np.testing.assert_allclose(filled[:, 0, 0], curve, atol=1e-9)


def test_gaps_that_are_long_or_at_an_end_stay():
    recording = make_sine(1.0, n_frames=200)
    position = np.array(recording.position_m)
    position[:5, 0] = np.nan
    position[50:71, 0] = np.nan
    position[190:, 1] = np.nan
    filled = fill_short_gaps(recording.time_s, position, max_gap_s=0.2)
    np.testing.assert_array_equal(np.isnan(filled), np.isnan(position))


def test_resampling_gives_the_curve_between_samples_and_nothing_outside():
    recording = make_sine(1.0, n_frames=200)
    position = np.array(recording.position_m)
    position[80:90, 1] = np.nan
    wanted = np.arange(-10, 80) / 30.0 + 0.003
    other = resample_markers(replace(recording, position_m=position), wanted)
    inside = (wanted >= 0) & (wanted <= recording.time_s[-1])
    np.testing.assert_allclose(
        other.position_m[inside, 0, 0], np.sin(2 * np.pi * wanted[inside]), atol=1e-5
    )
    assert np.isnan(other.position_m[~inside]).all()
    in_gap = (wanted > recording.time_s[79]) & (wanted < recording.time_s[90])
    assert in_gap.any()
    assert np.isnan(other.position_m[in_gap, 1]).all()
    assert other.rate_hz == pytest.approx(30.0)


def test_shapes_are_checked():
    with pytest.raises(ShapeError, match=r"\(3, 2, 3\)"):
        MarkerRecording(np.arange(3.0), np.zeros((3, 1, 3)), ("A", "B"), RATE)
