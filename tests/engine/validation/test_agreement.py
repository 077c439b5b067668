import math
import time

import numpy as np
import pytest
from scipy import stats

from engine.errors import DataError, ShapeError
from engine.validation.agreement import PairedTrial, summarise_agreement, summarise_angle
from engine.validation.bland_altman import compute_bland_altman
from engine.validation.curves import compare_curves

NAMES = ("knee_flexion_l", "trunk_flexion")


def movement(n, phase=0.0):
    turn = np.linspace(0, 2 * np.pi, n)
    return np.column_stack([60 - 50 * np.cos(turn + phase), 40 - 40 * np.cos(turn)])


def paired(subject, label, offset=(0.0, 0.0), noise=1.0, n=200, fps=30.0, seed=0):
    rng = np.random.default_rng([seed, n])
    truth = movement(n)
    estimated = truth + np.array(offset) + noise * rng.normal(size=truth.shape)
    return PairedTrial(subject, label, np.arange(n) / fps, NAMES, estimated, truth)


def study(n_subjects=6, n_trials=3, bias=-3.0, between=1.5, seed=0, **options):
    rng = np.random.default_rng(seed)
    offsets = rng.normal(bias, between, n_subjects)
    return [
        paired(f"S{s}", f"T{t}", (offsets[s], 0.0), seed=100 * s + t, **options)
        for s in range(n_subjects)
        for t in range(n_trials)
    ], offsets


def test_known_offsets_and_noise_come_back():
    trials, offsets = study()
    found = summarise_angle("knee_flexion_l", trials)
    assert (found.n_trials, found.n_subjects, found.unit) == (18, 6, "subject")
    assert found.pooled.n_samples == 18 * 200
    assert found.pooled.bias_deg == pytest.approx(offsets.mean(), abs=0.1)
    assert found.bland_altman.within_variance == pytest.approx(1, rel=0.1)
    assert found.bland_altman.between_variance == pytest.approx(offsets.var(ddof=1), rel=0.2)
    assert found.rmse.estimate == pytest.approx(found.pooled.rmse_deg)
    assert found.bias.estimate == pytest.approx(found.pooled.bias_deg)
    assert found.proportional_bias.slope == pytest.approx(0, abs=0.01)


def test_inference_rests_on_subjects():
    trials, _ = study()
    found = summarise_angle("knee_flexion_l", trials)
    biases = np.array([t.curve.bias_deg for t in found.trials]).reshape(6, 3)
    by_subject = stats.ttest_1samp(biases.mean(axis=1), 0)
    assert found.per_unit.p == pytest.approx(by_subject.pvalue)
    assert found.per_unit.n == 6
    assert found.per_trial.p == pytest.approx(stats.ttest_1samp(biases.ravel(), 0).pvalue)
    assert found.per_frame.naive.n == 3600
    assert found.curve_test.n_curves == 6
    assert found.equivalence[0].margin == 2.0
    assert found.equivalence[0].interval.low == pytest.approx(
        by_subject.confidence_interval(0.9).low
    )


def test_trials_of_one_subject_are_the_units():
    trials = [paired("S", f"T{i}", (i, 0.0), seed=i) for i in range(4)]
    found = summarise_angle("knee_flexion_l", trials)
    assert (found.unit, found.n_subjects) == ("trial", 1)
    assert found.bland_altman.n_clusters == 4
    assert found.per_unit.p == found.per_trial.p


def test_one_trial_gives_its_own_figures_and_no_test():
    trial = paired("S", "T", (2.0, 0.0))
    found = summarise_angle("knee_flexion_l", [trial], model_range_deg=130.0)
    curves = trial.curves("knee_flexion_l")
    assert found.trials[0].curve == compare_curves(trial.time_s, *curves, model_range_deg=130.0)
    assert found.bland_altman.is_single_cluster
    assert found.bland_altman.n_effective == pytest.approx(found.pooled.n_effective)
    assert math.isnan(found.per_unit.p)
    assert math.isnan(found.curve_test.p)
    assert not found.equivalence[1].is_equivalent


def test_scalars_are_compared_trial_by_trial():
    trials, _ = study(noise=0.0)
    found = {s.quantity: s for s in summarise_angle("knee_flexion_l", trials).scalars}
    errors = [t.curve.maximum.error_deg for t in summarise_angle("knee_flexion_l", trials).trials]
    units = np.repeat(np.arange(6), 3)
    assert found["maximum"].bland_altman == compute_bland_altman(errors, units)
    assert found["range_of_motion"].bland_altman.bias == pytest.approx(0, abs=1e-9)
    assert found["maximum"].mdc_deg == pytest.approx(0, abs=1e-6)


def test_the_reference_against_itself_is_perfect():
    trials, _ = study(bias=0.0, between=0.0, noise=0.0)
    found = summarise_angle("trunk_flexion", trials)
    assert found.pooled.max_deg == 0
    assert found.pooled.cmc == 1
    assert found.equivalence[0].is_equivalent
    assert found.bland_altman.outer_limits == (0, 0)


def test_a_turn_across_180_degrees_stays_a_small_difference():
    heading = 160 + 40 * np.sin(np.linspace(0, 9, 300))[:, None]
    wrapped = (heading + 180) % 360 - 180
    estimated = (heading + 5 + 180) % 360 - 180
    trial = PairedTrial("S", "T", np.arange(300) / 30, ("pelvis_rotation",), estimated, wrapped)
    found = summarise_angle("pelvis_rotation", [trial])
    assert found.pooled.max_deg == pytest.approx(5)
    assert found.pooled.cmc > 0.9
    assert found.proportional_bias.slope == pytest.approx(0, abs=1e-9)


def test_holm_counts_all_angles():
    trials, _ = study()
    knee, trunk = summarise_agreement(trials)
    assert knee.p_holm == pytest.approx(2 * knee.per_unit.p)
    assert trunk.p_holm == pytest.approx(max(trunk.per_unit.p, knee.p_holm))


def test_angles_and_trials_without_samples_are_shown_but_not_counted():
    trials, _ = study()
    empty = paired("S9", "T0")
    blank = PairedTrial(
        "S9", "T0", empty.time_s, NAMES, np.full((200, 2), np.nan), empty.reference_deg
    )
    found = summarise_angle("knee_flexion_l", [*trials, blank])
    assert (len(found.trials), found.n_trials, found.n_subjects) == (19, 18, 6)
    alone = summarise_agreement([blank])[0]
    assert (alone.n_trials, alone.pooled.n_samples) == (0, 0)
    assert math.isnan(alone.pooled.rmse_deg)
    assert math.isnan(alone.p_holm)


def test_the_same_call_gives_the_same_result():
    trials, _ = study(n_subjects=16, n_trials=1)
    first, again = (summarise_agreement(trials, n_flips=500, n_resamples=500) for _ in range(2))
    assert first[0].bias == again[0].bias
    assert first[0].curve_test == again[0].curve_test
    assert not first[0].curve_test.is_exact


def test_wrong_calls_are_refused():
    with pytest.raises(DataError, match="at least one"):
        summarise_agreement([])
    with pytest.raises(DataError, match="No trial has the angle"):
        summarise_angle("neck_flexion", [paired("S", "T")])
    with pytest.raises(ShapeError, match="reference_deg of trial 'T'"):
        PairedTrial("S", "T", np.arange(3.0), NAMES, np.zeros((3, 2)), np.zeros((3, 1)))


def test_twenty_trials_of_ten_seconds_take_less_than_two_seconds():
    """Processor time, so that a busy machine does not count; see the benchmark for all angles."""
    trials, _ = study(n_subjects=20, n_trials=1, n=1000, fps=100.0)
    start = time.process_time()
    summarise_agreement(trials)
    assert time.process_time() - start < 2.0
