import math

import numpy as np
import pytest

from engine.datatypes import JointAngles, PoseTrack, Subject
from engine.errors import ConfigError, DataError
from engine.kinematics.fitting.geometric import SOLVER
from engine.validation.compare import (
    Estimate,
    ReferenceFacts,
    ReferenceMovement,
    compare_trial,
    thin_track,
)
from engine.validation.reference.base import Finding
from tests.engine.validation.pairs import (
    KNEE_BIAS_DEG,
    LAG_S,
    true_track,
    video_track,
    with_bias,
)

NAMES = ("trunk_flexion", "knee_flexion_l", "knee_flexion_r")
FACTS = ReferenceFacts(
    name="lab.trc", format="trc", rate_hz=100.0, duration_s=6.0, findings=(), notes=(),
    joint_centres={},
)  # fmt: skip


def curves(time_s):
    """Return three smooth curves at any times."""
    t = np.asarray(time_s)
    bump = np.exp(-((t - 2.5) ** 2))
    return np.column_stack([60 * bump, 80 * np.exp(-((t - 2.2) ** 2) / 0.8), 20 + 70 * bump**2])


def make_estimate(*, lag_s=0.0, bias_deg=(0.0, 0.0, 0.0), noise_deg=0.0, seed=1, **changes):
    time = np.arange(0.0, 6.0, 1 / 30)
    noise = np.random.default_rng(seed).normal(0.0, noise_deg, (time.size, 3))
    value = curves(time - lag_s) + np.array(bias_deg) + noise
    return Estimate("P01", "lift", "", JointAngles(time, value, NAMES), **changes)


def make_reference(source="computed", *, start_s=0.0, stop_s=6.0, rate_hz=100.0):
    time = np.arange(start_s, stop_s, 1 / rate_hz)
    return ReferenceMovement(FACTS, JointAngles(time, curves(time), NAMES), source)


def angle(trial, name):
    return next(a for a in trial.angles if a.name == name)


def test_a_known_lag_offset_and_noise_are_found():
    found = compare_trial(
        make_estimate(lag_s=0.137, bias_deg=(0.0, 5.0, -3.0), noise_deg=1.0), make_reference()
    )
    assert found.alignment.lag_s == pytest.approx(0.137, abs=0.004)
    left, right = angle(found, "knee_flexion_l"), angle(found, "knee_flexion_r")
    assert left.measured.bias_deg == pytest.approx(5.0, abs=0.25)
    assert right.measured.bias_deg == pytest.approx(-3.0, abs=0.25)
    assert left.offset_deg == pytest.approx(5.0, abs=0.25)
    assert left.measured.centred_rmse_deg == pytest.approx(1.0, abs=0.15)
    assert left.without_offset.mae_deg == pytest.approx(math.sqrt(2 / math.pi), abs=0.12)


@pytest.mark.parametrize(
    ("source", "offset", "bias_deg"),
    [
        ("computed", "auto", 5.0),
        ("recorded", "auto", 0.0),
        ("computed", "remove", 0.0),
        ("recorded", "keep", 5.0),
    ],
)
def test_a_constant_difference_counts_as_error_or_as_convention(source, offset, bias_deg):
    found = compare_trial(
        make_estimate(bias_deg=(0.0, 5.0, 0.0)), make_reference(source), offset=offset
    )
    left = angle(found, "knee_flexion_l")
    assert left.offset_deg == pytest.approx(5.0, abs=0.05)
    assert found.judged(left).bias_deg == pytest.approx(bias_deg, abs=0.05)
    column = found.names.index("knee_flexion_l")
    assert np.nanmean(found.difference_deg[:, column]) == pytest.approx(bias_deg, abs=0.05)
    paired = found.as_paired_trial()
    own, other = paired.curves("knee_flexion_l")
    assert np.nanmean(own - other) == pytest.approx(bias_deg, abs=0.05)


def test_an_unknown_rule_for_offsets_is_refused():
    with pytest.raises(ConfigError, match="auto, keep, remove"):
        compare_trial(make_estimate(), make_reference(), offset="some")


def test_a_result_without_any_angle_says_so():
    time = np.arange(0.0, 5.0, 0.1)
    empty = JointAngles(time, np.full((time.size, 3), np.nan), NAMES)
    with pytest.raises(DataError, match="no joint angle"):
        compare_trial(Estimate("P01", "flat", "", empty), make_reference())


def test_another_movement_is_refused():
    time = np.arange(0.0, 6.0, 0.01)
    other = np.column_stack([np.sin(7 * time) * 30, np.cos(5 * time) * 20, np.sin(11 * time) * 25])
    reference = ReferenceMovement(FACTS, JointAngles(time, other, NAMES), "computed")
    with pytest.raises(DataError, match="does not fit"):
        compare_trial(make_estimate(), reference)


def test_an_angle_hardly_seen_is_left_out_and_named():
    estimate = make_estimate()
    value = np.array(estimate.angles.value_deg)
    value[5:, 1] = np.nan
    angles = JointAngles(estimate.angles.time_s, value, NAMES)
    found = compare_trial(Estimate("P01", "lift", "", angles), make_reference())
    assert found.names == ("trunk_flexion", "knee_flexion_r")
    assert found.missing == ("knee_flexion_l",)


def test_a_short_reference_is_noted():
    found = compare_trial(make_estimate(), make_reference(start_s=1.0, stop_s=4.5))
    assert any("nothing is said about the rest" in note for note in found.notes)
    assert not compare_trial(make_estimate(), make_reference()).notes


def test_gaps_stay_gaps():
    estimate = make_estimate()
    value = np.array(estimate.angles.value_deg)
    value[60:80, 0] = np.nan
    angles = JointAngles(estimate.angles.time_s, value, NAMES)
    found = compare_trial(Estimate("P01", "lift", "", angles), make_reference())
    inside = (found.pairs.time_s > 59.5 / 30) & (found.pairs.time_s < 79.5 / 30)
    assert inside.sum() == 20
    assert np.isnan(found.difference_deg[inside, 0]).all()
    assert np.isfinite(found.difference_deg[inside, 1]).all()


@pytest.mark.parametrize(("rate_hz", "kept_hz"), [(30.0, 33.3), (45.0, 50.0), (90.0, 100.0)])
def test_a_thinned_track_keeps_at_least_the_rate_asked_for(rate_hz, kept_hz):
    thin = thin_track(true_track(), rate_hz)
    assert 1 / np.diff(thin.time_s).mean() == pytest.approx(kept_hz, rel=0.01)
    assert set(thin.time_s) <= set(true_track().time_s)


def compare_tracks(**changes):
    track = video_track(**changes)
    truth = true_track()
    angles = with_bias(SOLVER.fit(track, Subject()).angles)
    reference = ReferenceMovement(FACTS, SOLVER.fit(truth, Subject()).angles, "computed", truth)
    return compare_trial(Estimate("P01", "lift", "", angles, track), reference)


def test_a_moved_body_has_no_distance_after_one_rigid_move():
    found = compare_tracks()
    by_kind = {p.alignment: p.mpjpe_mm for p in found.positions}
    assert found.alignment.lag_s == pytest.approx(LAG_S, abs=0.003)
    assert by_kind["none"] < 1.5  # the lag is found to a millisecond or two
    assert by_kind["procrustes"] < 1.5
    assert found.spatial.turn_deg == pytest.approx(20.0, abs=0.2)
    assert found.body_size_ratio == pytest.approx(1.0, abs=0.003)
    knee = angle(found, "knee_flexion_r")
    assert knee.measured.bias_deg == pytest.approx(KNEE_BIAS_DEG, abs=0.1)
    assert angle(found, "knee_flexion_l").measured.rmse_deg < 0.5
    assert found.majae.mean_available_deg == pytest.approx(
        KNEE_BIAS_DEG / (17 - len(found.majae.missing)), abs=0.15
    )


def test_a_body_of_another_size_is_noted():
    found = compare_tracks(scale=0.85)
    assert found.body_size_ratio == pytest.approx(1 / 0.85, rel=0.005)
    assert any("15 % shorter" in note for note in found.notes)
    by_kind = {p.alignment: p.mpjpe_mm for p in found.positions}
    assert by_kind["none"] > 30.0
    assert by_kind["procrustes"] < 1.5


def test_two_dimensional_tracks_have_no_positions():
    flat = PoseTrack(np.arange(3) / 30, np.zeros((3, 33, 2)), "px", "image", "mediapipe_33")
    found = compare_trial(make_estimate(track=flat), make_reference())
    assert found.positions == ()
    assert found.spatial is None


def test_unsure_findings_are_to_be_confirmed():
    facts = ReferenceFacts(
        "lab.trc", "trc", 100.0, 1.0,
        (Finding("unit", "mm", 1.0, ""), Finding("axes", "x, y, z", 0.3, "")), (), {},
    )  # fmt: skip
    assert [f.what for f in facts.to_confirm] == ["axes"]
