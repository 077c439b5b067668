import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import stats

from engine.errors import ConfigError, DataError, ShapeError
from engine.validation.curves import (
    angle_difference,
    compare_curves,
    compute_cmc,
    wrap_deg,
)

TIME = np.arange(0, 10, 0.02)
MOTION = 50 + 40 * np.sin(2 * np.pi * TIME / 4 + 0.5)


def noise(sd=2.0, seed=0, n=TIME.size):
    return np.random.default_rng(seed).normal(0, sd, n)


# --------------------------------------------------------------------------- differences


@pytest.mark.parametrize(
    ("angle", "expected"),
    [(0, 0), (180, 180), (-180, 180), (181, -179), (-190, 170), (540, 180), (359, -1), (-720, 0)],
)
def test_wrapping_at_the_bounds(angle, expected):
    assert wrap_deg([angle])[0] == expected


@given(st.floats(-2000, 2000), st.integers(-3, 3))
def test_whole_turns_do_not_count(angle, turns):
    wrapped = wrap_deg([angle + 360.0 * turns])[0]
    assert -180 < wrapped <= 180
    separation = abs(wrapped - wrap_deg([angle])[0])
    assert min(separation, 360 - separation) < 1e-9


def test_a_missing_side_is_a_missing_difference():
    difference = angle_difference([1.0, np.nan, 170.0], [0.5, 2.0, -170.0])
    assert difference == pytest.approx([0.5, math.nan, -20.0], nan_ok=True)
    with pytest.raises(ShapeError, match="one time"):
        angle_difference([1.0, 2.0], [1.0])


# --------------------------------------------------------------------------- one trial


def test_an_offset_is_bias_and_nothing_else():
    found = compare_curves(TIME, MOTION - 3.1, MOTION)
    assert found.bias_deg == pytest.approx(-3.1)
    assert (found.mae_deg, found.rmse_deg) == pytest.approx((3.1, 3.1))
    assert (found.max_deg, found.p95_deg) == pytest.approx((3.1, 3.1))
    assert found.sd_deg == pytest.approx(0, abs=1e-9)
    assert found.centred_rmse_deg == pytest.approx(0, abs=1e-9)
    assert found.r == pytest.approx(1)
    fit = found.linear_fit
    assert (fit.slope, fit.offset_deg, fit.r2) == pytest.approx((1, -3.1, 1))
    assert found.rom_error_deg == pytest.approx(0, abs=1e-9)
    assert found.maximum.error_deg == pytest.approx(-3.1)
    assert found.maximum.lag_s == pytest.approx(0, abs=1e-9)
    assert (found.n_samples, found.n_frames) == (TIME.size, TIME.size)


def test_noise_of_known_size_is_found_as_such():
    sd = 2.0
    found = compare_curves(TIME, MOTION + noise(sd), MOTION)
    error = sd / math.sqrt(TIME.size)
    assert found.bias_deg == pytest.approx(0, abs=3 * error)
    assert found.rmse_deg == pytest.approx(sd, rel=0.1)
    assert found.mae_deg == pytest.approx(sd * math.sqrt(2 / math.pi), rel=0.1)
    assert found.sd_absolute_deg == pytest.approx(sd * math.sqrt(1 - 2 / math.pi), rel=0.1)
    assert found.p95_deg == pytest.approx(1.96 * sd, rel=0.1)
    assert found.n_effective > 0.85 * TIME.size


def test_a_lag_of_less_than_a_frame_is_found_at_the_peaks():
    lag_s = 0.013
    late = 50 + 40 * np.sin(2 * np.pi * (TIME - lag_s) / 4 + 0.5)
    found = compare_curves(TIME, late, MOTION)
    assert found.maximum.lag_s == pytest.approx(lag_s, abs=5e-4)
    assert found.minimum.lag_s == pytest.approx(lag_s, abs=5e-4)
    assert found.maximum.reference_deg == pytest.approx(90, abs=1e-3)
    assert found.minimum.reference_deg == pytest.approx(10, abs=1e-3)
    # A lag of a sine is a difference of amplitude 2 A sin(pi lag / period).
    amplitude = 2 * 40 * math.sin(math.pi * lag_s / 4)
    assert found.rmse_deg == pytest.approx(amplitude / math.sqrt(2), rel=0.1)


def test_a_gain_is_the_slope_and_the_range_of_motion():
    found = compare_curves(TIME, 0.8 * MOTION + 5, MOTION)
    assert (found.linear_fit.slope, found.linear_fit.offset_deg) == pytest.approx((0.8, 5))
    assert found.rom_error_deg == pytest.approx(-0.2 * np.ptp(MOTION))
    assert found.maximum.error_deg == pytest.approx(0.8 * 90 + 5 - 90, abs=1e-2)


def test_figures_agree_with_independent_implementations():
    estimated = 0.9 * MOTION + 4 + noise(3.0)
    found, d = compare_curves(TIME, estimated, MOTION), estimated - MOTION
    line = stats.linregress(MOTION, estimated)
    assert found.r == pytest.approx(stats.pearsonr(estimated, MOTION).statistic)
    assert (found.linear_fit.slope, found.linear_fit.offset_deg) == pytest.approx(
        (line.slope, line.intercept)
    )
    assert found.linear_fit.r2 == pytest.approx(line.rvalue**2)
    assert found.sd_deg == pytest.approx(stats.tstd(d))
    assert found.sd_absolute_deg == pytest.approx(stats.tstd(np.abs(d)))
    assert found.centred_rmse_deg**2 + found.bias_deg**2 == pytest.approx(found.rmse_deg**2)


def test_percent_of_range_is_that_of_the_published_table():
    """Mehrizi et al. (2018), Table 3: 5.08 degrees at an elbow of 0 to 150 are 3.38 %."""
    found = compare_curves(TIME, MOTION + 5.08, MOTION, model_range_deg=150)
    assert found.percent_of_model_range == pytest.approx(3.387, abs=1e-3)
    assert found.percent_of_excursion == pytest.approx(100 * 5.08 / np.ptp(MOTION))
    assert math.isnan(compare_curves(TIME, MOTION, MOTION).percent_of_model_range)


def test_gaps_are_left_out_and_counted():
    estimated, reference = MOTION + 2, MOTION.copy()
    estimated[10:60] = np.nan
    reference[100:120] = np.nan
    found = compare_curves(TIME, estimated, reference)
    assert found.n_samples == TIME.size - 70
    assert found.bias_deg == pytest.approx(2)


def test_a_turn_across_180_degrees_is_no_error():
    heading = 170 + 40 * np.sin(2 * np.pi * TIME / 5)
    found = compare_curves(TIME, wrap_deg(heading + 4), wrap_deg(heading))
    assert found.max_deg == pytest.approx(4)
    assert found.rom_reference_deg == pytest.approx(np.ptp(heading))
    assert found.r == pytest.approx(1)


def test_ninety_five_percent_means_at_least_that_many_frames():
    d = np.arange(1.0, 11.0)
    found = compare_curves(np.arange(10.0), d, np.zeros(10))
    assert np.mean(np.abs(d) <= found.p95_deg) >= 0.95


def test_an_extreme_at_the_edge_has_no_time():
    found = compare_curves(TIME, TIME * 9 + 1, TIME * 9)
    assert found.maximum.error_deg == pytest.approx(1)
    assert math.isnan(found.maximum.lag_s)


def test_a_constant_curve_has_no_correlation():
    flat = compare_curves(TIME, noise(), np.full(TIME.size, 3.0))
    assert all(math.isnan(x) for x in (flat.r, flat.linear_fit.slope, flat.percent_of_excursion))
    assert math.isnan(flat.cmc)


@pytest.mark.parametrize("n", [0, 1, 5], ids=["no frame", "one frame", "all missing"])
def test_too_little_is_nan_not_a_crash(n):
    found = compare_curves(np.arange(float(n)), np.full(n, np.nan), np.zeros(n))
    assert found.n_samples == 0
    assert math.isnan(found.rmse_deg)
    assert math.isnan(found.maximum.error_deg)


def test_wrong_calls_are_refused():
    with pytest.raises(DataError, match="increase"):
        compare_curves([0.0, 0.0], [1.0, 1.0], [1.0, 1.0])
    with pytest.raises(ShapeError, match="like time_s"):
        compare_curves([0.0, 1.0, 2.0], [1.0, 1.0], [1.0, 1.0])
    with pytest.raises(ConfigError, match="positive"):
        compare_curves(TIME, MOTION, MOTION, model_range_deg=0)


@given(st.integers(0, 1000), st.floats(-90, 90), st.integers(-2, 2))
def test_a_common_offset_and_whole_turns_change_nothing(seed, shift, turns):
    estimated = MOTION + noise(seed=seed)
    plain = compare_curves(TIME, estimated, MOTION)
    moved = compare_curves(TIME, estimated + shift + 360 * turns, MOTION + shift)
    for name in ("bias_deg", "sd_deg", "mae_deg", "rmse_deg", "p95_deg", "r", "cmc"):
        assert getattr(moved, name) == pytest.approx(getattr(plain, name), abs=1e-6), name
    assert moved.maximum.lag_s == pytest.approx(plain.maximum.lag_s, abs=1e-9)


@given(st.integers(0, 1000))
def test_exchanging_both_mirrors_the_signed_figures(seed):
    estimated = MOTION + 2 + noise(seed=seed)
    one, other = compare_curves(TIME, estimated, MOTION), compare_curves(TIME, MOTION, estimated)
    assert other.bias_deg == pytest.approx(-one.bias_deg)
    assert other.rom_error_deg == pytest.approx(-one.rom_error_deg)
    assert (other.rmse_deg, other.r, other.cmc) == pytest.approx((one.rmse_deg, one.r, one.cmc))


# --------------------------------------------------------------------------- CMC


def cmc_by_loops(curves):
    """Ferrari, Cutti & Cappello (2010), equation 1, written out term by term."""
    W, P, F = curves.shape
    above = below = 0.0
    for w in range(W):
        for f in range(F):
            for p in range(P):
                above += (curves[w, p, f] - curves[w, :, f].mean()) ** 2 / (W * F * (P - 1))
                below += (curves[w, p, f] - curves[w].mean()) ** 2 / (W * (P * F - 1))
    return math.sqrt(1 - above / below)


def test_cmc_is_the_published_formula():
    rng = np.random.default_rng(1)
    base = 30 * np.sin(np.linspace(0, 2 * np.pi, 40)) + rng.normal(0, 5, (4, 1, 1))
    curves = base + rng.normal(0, 4, (4, 3, 40))
    assert compute_cmc(curves) == pytest.approx(cmc_by_loops(curves))


def test_cmc_of_the_same_curves_is_one_and_an_offset_lowers_it():
    assert compute_cmc([[MOTION, MOTION]]) == 1.0
    assert compute_cmc([[MOTION, MOTION + 10]]) < compute_cmc([[MOTION, MOTION + 5]]) < 1.0


def test_cmc_of_an_angle_that_hardly_moves_is_nan_not_zero():
    assert math.isnan(compute_cmc([[noise(0.1), noise(0.1, seed=1) + 5]]))
    assert math.isnan(compute_cmc(np.zeros((1, 2, 10))))
    assert math.isnan(compute_cmc(np.full((2, 2, 5), np.nan)))


def test_cmc_leaves_out_missing_frames_per_movement():
    rng = np.random.default_rng(2)
    curves = MOTION[:80] + rng.normal(0, 3, (1, 2, 80))
    holed = np.concatenate([curves, curves], axis=0)
    holed[1, 0, 40:] = np.nan
    alone = compute_cmc(np.concatenate([curves, curves], axis=0))
    assert compute_cmc(curves) == pytest.approx(alone, abs=2e-4)
    assert compute_cmc(holed) != pytest.approx(alone, abs=1e-6)
    with pytest.raises(ShapeError, match="protocols >= 2"):
        compute_cmc(curves[:, :1])
