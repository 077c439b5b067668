"""Error propagation against closed forms."""

from __future__ import annotations

import numpy as np
import pytest

from engine.datatypes import Measurement
from engine.ergonomics.lifting_equation import compute_horizontal_multiplier
from engine.ergonomics.propagation import (
    compute_interval,
    compute_shares,
    draw_inputs,
    standard_normal_points,
)


def test_points_are_standard_normal_and_independent():
    points = standard_normal_points(7)
    assert points.mean(axis=0) == pytest.approx(np.zeros(7), abs=1e-12)
    assert np.cov(points.T) == pytest.approx(np.eye(7), abs=0.05)
    quantiles = np.percentile(points, [2.5, 16, 50, 84, 97.5], axis=0)
    expected = np.array([-1.96, -0.9945, 0, 0.9945, 1.96])[:, None]
    assert np.abs(quantiles - expected).max() < 0.03


def test_points_are_the_same_every_time_and_read_only():
    again = standard_normal_points.__wrapped__(3)
    np.testing.assert_array_equal(standard_normal_points(3), again)
    with pytest.raises(ValueError, match="read-only"):
        again[0, 0] = 1.0


def test_interval_of_a_sum():
    drawn = draw_inputs({"a": Measurement(100.0, 3.0), "b": Measurement(50.0, 4.0)})
    low, high = compute_interval(drawn["a"] + drawn["b"])
    assert (low, high) == pytest.approx((150 - 9.8, 150 + 9.8), abs=0.3)


def test_five_centimetres_at_forty_are_an_eighth_of_the_index():
    drawn = draw_inputs({"H": Measurement(40.0, 5.0)})
    index = 1.0 / compute_horizontal_multiplier(drawn["H"])
    # Draws below 25 cm (three standard errors away) are clamped, which costs next to nothing.
    assert np.std(index) / np.mean(index) == pytest.approx(0.125, abs=0.001)


def test_magnitudes_stay_positive():
    assert draw_inputs({"A": Measurement(1.0, 10.0)})["A"].min() >= 0


def test_no_error_is_no_interval_width():
    drawn = draw_inputs({"a": Measurement(5.0, 0.0)})
    assert compute_interval(drawn["a"]) == (5.0, 5.0)
    assert compute_shares(lambda x: x["a"], {"a": Measurement(5.0, 0.0)}) == {"a": 0.0}


def test_shares_follow_the_variances():
    inputs = {
        "a": Measurement(100.0, 1.0),
        "b": Measurement(100.0, 3.0),
        "c": Measurement(9.0, 1.0),
    }
    shares = compute_shares(lambda x: x["a"] + x["b"], inputs)
    assert shares == pytest.approx({"a": 0.1, "b": 0.9, "c": 0.0}, abs=1e-6)
