"""Clips of any length and rate in windows of one length."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from engine.pose.lifting.windows import blend_windows, plan_windows, resample_clip


def moving(time_s):
    """Return 17 points (T, 17, 2) on straight lines."""
    start, speed = np.arange(34).reshape(17, 2), np.linspace(-1, 1, 34).reshape(17, 2)
    return start + speed * np.asarray(time_s)[:, None, None]


@given(st.integers(1, 200), st.integers(2, 40), st.integers(1, 40))
def test_windows_cover_every_sample_and_blend_back(n_samples, n_frames, hop):
    plan = plan_windows(n_samples, n_frames, min(hop, n_frames))
    assert plan.rows.shape[1] == n_frames
    assert set(plan.rows.ravel()) == set(range(n_samples))
    values = np.arange(n_samples, dtype=float)
    assert np.allclose(blend_windows(plan, values[plan.rows], n_samples), values)


def test_short_clip_stands_in_the_middle_of_its_window():
    rows = plan_windows(3, 9, 4).rows
    assert rows.tolist() == [[0, 0, 0, 0, 1, 2, 2, 2, 2]]


def test_the_middle_of_a_window_counts_most():
    plan = plan_windows(40, 9, 4)
    assert plan.weight.argmax() == 4
    assert plan.weight[0] < 0.2 * plan.weight[4]


@pytest.mark.parametrize("fps", [12.5, 24.0, 29.97, 30.0, 50.0, 120.0])
def test_resampling_follows_time_not_frames(fps):
    time_s = 3.0 + np.arange(round(2 * fps)) / fps
    samples = resample_clip(time_s, moving(time_s), np.ones((len(time_s), 17)))
    assert np.allclose(np.diff(samples.time_s), 1 / 30)
    inside = samples.time_s <= time_s[-1]
    assert np.allclose(samples.points[inside], moving(samples.time_s[inside]))
    assert samples.is_known.all()
    assert np.allclose(samples.confidence, 1.0)


def test_uneven_frames_are_taken_at_their_times():
    time_s = np.cumsum(np.random.default_rng(1).uniform(0.02, 0.05, 60))
    samples = resample_clip(time_s, moving(time_s), np.ones((60, 17)))
    inside = samples.time_s <= time_s[-1]
    assert np.allclose(samples.points[inside], moving(samples.time_s[inside]))


def test_short_gaps_are_bridged_without_confidence_and_long_ones_are_not_made_up():
    time_s = np.arange(90) / 30
    points = moving(time_s)
    points[10:14, 3] = np.nan  # 0.13 s
    points[40:70, 5] = np.nan  # 1 s
    samples = resample_clip(time_s, points, np.ones((90, 17)))
    assert np.isfinite(samples.points).all()
    assert np.allclose(samples.points[11:13, 3], moving(time_s)[11:13, 3])
    assert (samples.confidence[11:13, 3] == 0).all()
    assert samples.is_known[:, 3].all()
    assert not samples.is_known[46:64, 5].any()
    assert samples.is_known[:40, 5].all()
    assert samples.is_known[46:64, 6].all()


def test_a_frame_with_few_joints_is_not_known():
    time_s = np.arange(60) / 30
    points = moving(time_s)
    points[20:50, :10] = np.nan
    samples = resample_clip(time_s, points, np.ones((60, 17)))
    assert not samples.is_known[26:44].any()


def test_joint_that_was_never_seen():
    time_s = np.arange(30) / 30
    points = moving(time_s)
    points[:, 16] = np.nan
    samples = resample_clip(time_s, points, np.ones((30, 17)))
    assert not samples.is_known[:, 16].any()
    assert np.isfinite(samples.points).all()


def test_single_picture():
    samples = resample_clip(np.array([0.4]), moving([0.4]), np.ones((1, 17)))
    assert samples.points.shape == (1, 17, 2)
    assert samples.is_known.all()
