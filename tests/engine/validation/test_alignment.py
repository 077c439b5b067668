from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from engine.datatypes import JointAngles
from engine.errors import ConfigError, DataError, UnitError
from engine.validation.alignment import estimate_lag, pair_angles
from engine.validation.resampling import swap_sides

NAMES = ("trunk_flexion", "knee_flexion_l", "knee_flexion_r", "elbow_flexion_l", "elbow_flexion_r")


def movement(time):
    """Return a lift that is not symmetric and does not repeat, shape (T, 5), degrees."""

    def bump(middle, width, height):
        return height * np.exp(-0.5 * ((time - middle) / width) ** 2)

    return np.column_stack(
        [
            bump(2.0, 0.6, 60) + bump(5.5, 0.9, 35),
            bump(2.1, 0.5, 90) + bump(7.0, 0.4, 20),
            bump(2.0, 0.5, 70) + bump(5.0, 0.4, 50),
            10 + bump(3.0, 0.7, 80) + bump(6.0, 0.5, 30),
            12 + bump(3.4, 0.5, 40) + bump(4.6, 0.5, 70),
        ]
    )


def record(start=0.0, end=9.0, rate_hz=30.0, *, lag_s=0.0, names=NAMES, change=None):
    """Sample the movement; a recording with lag 0.5 has its clock 0.5 s behind."""
    time = np.arange(start, end, 1.0 / rate_hz)
    value = movement(time)
    return JointAngles(time - lag_s, value if change is None else change(value), names)


# --------------------------------------------------------------------------- lag


@settings(max_examples=40, deadline=None)
@given(
    lag_s=st.floats(-3.0, 3.0),
    rate_hz=st.sampled_from([24.0, 50.0, 100.0, 120.0, 250.0]),
)
def test_the_lag_is_found_between_samples_at_any_rate(lag_s, rate_hz):
    found = estimate_lag(record(), record(rate_hz=rate_hz, lag_s=lag_s))
    assert found.lag_s == pytest.approx(lag_s, abs=0.002)
    assert found.correlation > 0.999
    assert found.confidence > 0.9


def test_offsets_and_scale_do_not_move_the_lag():
    changed = record(rate_hz=100, lag_s=0.4, change=lambda v: 0.8 * v + np.arange(5) * 7.0)
    found = estimate_lag(record(), changed)
    assert found.lag_s == pytest.approx(0.4, abs=0.002)


@pytest.mark.parametrize(("start", "end"), [(1.0, 6.0), (0.0, 4.0), (3.0, 12.0)])
def test_a_shorter_or_later_reference_is_placed(start, end):
    found = estimate_lag(record(), record(start, end, 100.0, lag_s=-1.3))
    assert found.lag_s == pytest.approx(-1.3, abs=0.005)


def test_noise_widens_the_error_of_the_lag_as_stated():
    """The stated standard error must be right to within a third over repetitions."""
    rng = np.random.default_rng(5)
    clean, errors, stated = record(), [], []
    for _ in range(60):
        noisy = record(rate_hz=60.0, lag_s=0.7, change=lambda v: v + rng.normal(0.0, 6.0, v.shape))
        found = estimate_lag(clean, noisy)
        errors.append(found.lag_s - 0.7)
        stated.append(found.lag_sigma_s)
    assert abs(np.mean(errors)) < 0.004
    assert np.median(stated) / np.std(errors) == pytest.approx(1.0, abs=0.34)


def test_gaps_and_jumps_in_time_are_not_bridged():
    reference = record(rate_hz=100, lag_s=0.25)
    value = np.array(reference.value_deg)
    value[150:200, :3] = np.nan
    keep = np.r_[0:400, 480:900]
    broken = JointAngles(reference.time_s[keep], value[keep], NAMES)
    found = estimate_lag(record(), broken)
    assert found.lag_s == pytest.approx(0.25, abs=0.003)


def test_a_repeated_movement_is_named():
    time = np.arange(0.0, 12.0, 0.02)
    curve = 45 * (1 - np.cos(2 * np.pi * time / 2.0))
    angles = JointAngles(time, curve[:, None], ("knee_flexion_l",))
    found = estimate_lag(angles, angles)
    assert found.lag_s == pytest.approx(0.0, abs=1e-3)
    assert abs(found.runner_up_s) == pytest.approx(2.0, abs=0.05)
    assert found.confidence < 0.5
    assert "repeats" in found.notes[0]


def test_a_wrong_sign_is_named_and_does_not_hide_the_lag():
    turned = record(rate_hz=100, lag_s=0.3, change=lambda v: v * [-1, 1, 1, 1, 1])
    found = estimate_lag(record(), turned)
    assert found.lag_s == pytest.approx(0.3, abs=0.01)
    assert found.opposite == ("trunk_flexion",)
    assert "trunk_flexion" in found.notes[-1]


def test_another_movement_is_refused():
    rng = np.random.default_rng(1)
    time = np.arange(0.0, 9.0, 0.01)
    steps = rng.normal(0, 1, (time.size, 5)).cumsum(axis=0)
    with pytest.raises(DataError, match="does not fit the result: the best correlation is"):
        estimate_lag(record(), JointAngles(time, steps, NAMES))


def test_a_movement_of_like_shape_but_other_size_is_refused():
    # A squat bends the knees where a stoop bends the trunk: the curves correlate, no more.
    other = record(rate_hz=100, change=lambda v: v * [0.3, 0.3, 0.3, 0.8, 0.8])
    with pytest.raises(DataError, match=r"explain only \d+ % of the reference's movement"):
        estimate_lag(record(), other)
    assert estimate_lag(record(), other, min_explained=-9.0).correlation > 0.9


def test_exchanged_sides_are_refused_with_the_remedy():
    swapped = swap_sides(record(rate_hz=100, lag_s=0.2))
    with pytest.raises(DataError, match=r"Left and right look exchanged.*swap_sides"):
        estimate_lag(record(), swapped)
    assert estimate_lag(record(), swap_sides(swapped)).lag_s == pytest.approx(0.2, abs=0.002)


def test_a_symmetric_lift_is_not_called_exchanged():
    def symmetric(value):
        return np.column_stack([value[:, 0], value[:, 1], value[:, 1], value[:, 3], value[:, 3]])

    result = record(change=symmetric)
    assert estimate_lag(result, swap_sides(result)).lag_s == pytest.approx(0.0, abs=1e-3)


@pytest.mark.parametrize("word", ["radians", "degrees"])
def test_a_wrong_angle_unit_is_refused(word):
    factor = np.pi / 180 if word == "radians" else 180 / np.pi
    wrong = record(rate_hz=100, change=lambda v: v * factor)
    with pytest.raises(UnitError, match=f"look like {word}"):
        estimate_lag(record(), wrong)


@pytest.mark.parametrize(
    ("reference", "options", "message"),
    [
        (record(names=tuple("abcde")), {}, "no angle in common"),
        (record(0.0, 0.5), {}, "lasts less than 1 s"),
        (record(change=lambda v: v * 0 + 20.0), {}, "No common angle moves"),
        (record(lag_s=50.0), {"max_lag_s": 2.0}, "overlap less than"),
        (record(change=lambda v: v * np.nan), {}, "No common angle moves"),
    ],
    ids=["names", "short", "still", "apart", "empty"],
)
def test_what_can_not_be_aligned_is_one_plain_sentence(reference, options, message):
    with pytest.raises(DataError, match=message):
        estimate_lag(record(), reference, **options)


# --------------------------------------------------------------------------- pairs


def test_pairs_stand_at_the_result_s_times_within_the_overlap():
    pairs = pair_angles(record(), record(2.0, 5.0, 100.0, lag_s=0.5), lag_s=0.5, offset="none")
    assert pairs.time_s[0] >= 2.0
    assert pairs.time_s[-1] <= 5.0
    np.testing.assert_allclose(pairs.difference_deg, 0.0, atol=0.05)
    assert np.isin(pairs.time_s, record().time_s).all()


@settings(max_examples=30, deadline=None)
@given(offset=st.floats(-170.0, 170.0))
def test_a_constant_offset_is_kept_apart_from_error(offset):
    reference = record(rate_hz=100, change=lambda v: v - offset)
    pairs = pair_angles(record(), reference, offset="median")
    np.testing.assert_allclose(pairs.offset_deg, offset, atol=0.05)
    np.testing.assert_allclose(pairs.difference_deg, offset, atol=0.1)
    np.testing.assert_allclose(pairs.error_deg, 0.0, atol=0.1)


def test_the_offset_of_the_start_leaves_later_drift_to_be_seen():
    reference = record(change=lambda v: v + np.linspace(0, 9, len(v))[:, None])
    pairs = pair_angles(record(), reference, offset="start")
    assert np.abs(pairs.offset_deg).max() < 1.0
    assert np.abs(pairs.error_deg[-1]).min() > 8.0


def test_angles_across_the_turn_differ_by_little():
    time = np.arange(0.0, 3.0, 0.02)
    curve = 170.0 + 20.0 * time / 3.0
    wrapped = (curve + 180.0) % 360.0 - 180.0
    result = JointAngles(time, wrapped[:, None], ("pelvis_rotation",))
    reference = JointAngles(time[::3] + 0.005, curve[::3, None], ("pelvis_rotation",))
    pairs = pair_angles(result, reference, offset="none")
    assert np.abs(pairs.difference_deg).max() < 0.1


def test_a_gap_in_the_reference_stays_a_gap():
    reference = record(rate_hz=100.0)
    keep = np.r_[0:300, 400:900]
    broken = JointAngles(reference.time_s[keep], reference.value_deg[keep], NAMES)
    pairs = pair_angles(record(), broken)
    inside = (pairs.time_s > 2.995) & (pairs.time_s < 3.995)
    assert np.isnan(pairs.error_deg[inside]).all()
    assert np.isnan(pairs.estimated_deg[inside]).all()
    assert np.isfinite(pairs.error_deg[~inside]).all()


def test_wrong_calls_are_one_plain_sentence():
    with pytest.raises(ConfigError, match="offset must be one of"):
        pair_angles(record(), record(), offset="mean")
    with pytest.raises(DataError, match="do not overlap"):
        pair_angles(record(), record(lag_s=60.0))
