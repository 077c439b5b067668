import dataclasses
import math
import re

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from engine.validation.agreement import PairedTrial, summarise_angle
from engine.validation.bland_altman import compute_bland_altman
from engine.validation.curves import compare_curves
from engine.validation.curvewise import permute_curves
from engine.validation.majae import compute_improvement
from engine.validation.statistics import compute_equivalence, compute_paired_t_test
from engine.validation.wording import (
    PURPOSES,
    describe_angle,
    describe_curve,
    describe_curve_test,
    describe_equivalence,
    describe_improvement,
    describe_test,
    judge_purposes,
    title_angle,
)


def summary(offsets, noise=1.0, n=400, n_trials=1):
    """One subject per offset, white noise, one angle."""
    trials = []
    for s, offset in enumerate(offsets):
        for t in range(n_trials):
            rng = np.random.default_rng([s, t])
            truth = 60 - 50 * np.cos(np.linspace(0, 2 * np.pi, n))[:, None]
            estimated = truth + offset + noise * rng.normal(size=(n, 1))
            trials.append(
                PairedTrial(
                    f"S{s}", f"T{t}", np.arange(n) / 30, ("knee_flexion_l",), estimated, truth
                )
            )
    return summarise_angle("knee_flexion_l", trials)


@pytest.mark.parametrize(
    ("name", "title"),
    [
        ("knee_flexion_l", "Knee flexion (left)"),
        ("hip_adduction_r", "Hip adduction (right)"),
        ("trunk_lateral_bend", "Trunk lateral bend"),
    ],
)
def test_titles(name, title):
    assert title_angle(name) == title


def test_the_sentence_says_what_the_numbers_say():
    found = summary([-3.0, -3.2, -2.8, -3.1, -3.4, -2.6, -2.9, -3.0])
    text = describe_angle(found)
    assert text.startswith(
        "Knee flexion (left): 3.0° too low on average (95 % interval -3.2 to -2.8°)"
    )
    within = float(re.search(r"within ([\d.]+)° in 95 % of the frames", text)[1])
    assert found.pooled.p95_deg <= within < found.pooled.p95_deg + 0.1
    assert f"(3200 frames, worth {math.floor(found.pooled.n_effective)} independent, " in text
    assert "of 8 trials, 8 persons)." in text
    assert "Good enough for bands 20° wide (such as the trunk's in REBA and RULA)" in text
    assert "not for bands 10° wide" in text


def test_an_offset_that_may_be_chance_is_not_called_one():
    found = summary([-4.0, 5.0, -3.0, 4.0, 0.5])
    assert found.bland_altman.bias_interval.contains(0)
    text = describe_angle(found)
    assert "no clear offset (+0.5° on average" in text
    assert "too high" not in text


def test_one_trial_and_one_person_say_so():
    assert describe_angle(summary([2.0])).endswith(
        "This is one trial of one person and says nothing about others."
    )
    assert describe_angle(summary([2.0], n_trials=3)).endswith(
        "These are trials of one person and say nothing about others."
    )
    assert "nothing about others" not in describe_angle(summary([2.0, 2.1, 1.9]))


def test_two_persons_with_large_scatter_are_too_few_to_judge():
    text = describe_angle(summary([-2.0, 2.0]))
    assert "Good enough" not in text
    assert "oo few data to say" in text


def test_a_trial_without_independent_frames_claims_nothing():
    """A pure offset: every frame says the same, so there is one sample."""
    found = summary([4.0], noise=0.0)
    text = describe_angle(found)
    assert "too few to tell from chance" in text
    assert "worth 1 independent" in text
    assert "Good enough" not in text
    wide = "bands 30° wide (such as the knee's in REBA)"
    assert f". Too few data to say for {wide}, not good enough for" in text


def test_long_tails_do_not_pass_by_their_standard_deviation():
    rng = np.random.default_rng(0)
    d = np.where(rng.random(20_000) < 0.06, 11.0, 0.0)
    limits = compute_bland_altman(d, ["a"] * d.size)
    p95 = float(np.quantile(np.abs(d), 0.95, method="inverted_cdf"))
    twenty = PURPOSES[1]
    assert judge_purposes(limits, (twenty,))[0].answer == "yes"
    assert judge_purposes(limits, (twenty,), p95_deg=p95)[0].answer == "no"


@given(
    st.integers(0, 10_000),
    st.integers(1, 5),
    st.floats(-8, 8),
    st.floats(0.01, 6),
    st.floats(0, 4),
)
def test_no_verdict_claims_more_than_the_limits(seed, n_subjects, bias, noise, between):
    rng = np.random.default_rng(seed)
    subject = np.repeat(np.arange(n_subjects), 12)
    d = rng.normal(bias, between, n_subjects)[subject] + rng.normal(0, noise, subject.size)
    limits = compute_bland_altman(d, subject)
    verdicts = judge_purposes(limits)
    for verdict in verdicts:
        half = verdict.purpose.step_deg / 2
        inside = -half <= limits.lower and limits.upper <= half
        surely = -half <= limits.outer_limits.low and limits.outer_limits.high <= half
        assert (verdict.answer == "yes") == (inside and surely)
        assert (verdict.answer == "no") == (not inside)
    order = ["yes", "unclear", "no"]
    ranks = [order.index(v.answer) for v in verdicts]
    assert ranks == sorted(ranks), "a finer step can't be easier than a coarser one"


def test_unknown_limits_never_pass():
    limits = compute_bland_altman([1.0], ["a"])
    assert {v.answer for v in judge_purposes(limits)} == {"unclear"}


def test_one_trial_in_words():
    time_s, truth = np.arange(100) / 30, np.linspace(0, 90, 100)
    truth_with_gap = np.where(np.arange(100) < 20, np.nan, truth)
    text = describe_curve("knee_flexion_r", compare_curves(time_s, truth + 2.04, truth_with_gap))
    assert text == (
        "Knee flexion (right): 2.0° too high on average in this trial, within 2.1° in 95 % of the "
        "80 frames, 20 of 100 frames missing."
    )


def test_nothing_in_common_in_words():
    time_s, none = np.arange(5.0), np.full(5, np.nan)
    for text in (
        describe_curve("trunk_twist", compare_curves(time_s, none, none)),
        describe_angle(
            summarise_angle(
                "trunk_twist",
                [PairedTrial("S", "T", time_s, ("trunk_twist",), none[:, None], none[:, None])],
            )
        ),
    ):
        assert text == (
            "Trunk twist: no frame has both an estimate and a reference, so nothing can be said."
        )


def test_a_large_p_is_not_called_agreement():
    scattered = [-9.0, 8.0, -7.0, 10.0, -1.0]
    text = describe_test(compute_paired_t_test(scattered))
    assert text == (
        "No mean difference was shown (p = 0.96, 5 subjects); that does not show agreement."
    )
    assert "was not shown" in describe_equivalence(compute_equivalence(scattered, margin=5.0))


def test_a_small_p_and_an_equivalence_can_both_hold():
    values = [1.0, 1.2, 0.9, 1.1, 1.0, 0.8]
    assert describe_test(compute_paired_t_test(values), unit="trial") == (
        "The mean difference is not chance alone (p = under 0.001, 6 trials): 1.0° too high on "
        "average."
    )
    assert describe_equivalence(compute_equivalence(values, margin=2.0)).startswith(
        "The mean agrees within ±2° (p = under 0.001, 6 subjects)"
    )


def test_too_few_units_are_not_tested():
    assert "nothing was tested" in describe_test(compute_paired_t_test([1.0]))
    assert "needs two" in describe_equivalence(compute_equivalence([1.0], margin=5.0))
    assert "was not done" in describe_curve_test(permute_curves(np.ones((1, 5))))


def test_curve_tests_in_words():
    rng = np.random.default_rng(0)
    curves = rng.normal(size=(10, 101))
    few = describe_curve_test(permute_curves(curves[:4] + 50))
    assert few == (
        "With 4 subjects no difference between whole curves can be shown: the smallest possible p "
        "is 0.12."
    )
    assert "does not show agreement" in describe_curve_test(permute_curves(curves - curves.mean(0)))
    curves[:, 20:41] += 20
    found = describe_curve_test(permute_curves(curves))
    assert found == "The curves differ at 20–40 % of the movement (p = 0.002, 10 subjects)."


def test_improvements_in_words():
    rng = np.random.default_rng(0)
    before = rng.uniform(15, 30, 12)
    better = compute_improvement(before, before * rng.uniform(0.6, 0.8, 12))
    text = describe_improvement(better)
    assert text.startswith("The correction lowers the mean error from ")
    assert f"by {better.of_mean_percent:.1f} %" in text
    assert f"of the 12 rows is {better.mean_of_rows_percent:.1f} %" in text
    unsure = compute_improvement(before, before * rng.uniform(0.7, 1.3, 12))
    assert describe_improvement(unsure).startswith("The correction was not shown to change")
    assert f"worse in {unsure.n_worse}" in describe_improvement(unsure)
    worse = compute_improvement(before, before * 1.5)
    assert describe_improvement(worse).startswith("The correction raises")
    assert "was not shown" in describe_improvement(compute_improvement([10.0], [1.0]))
    assert "nothing can be said" in describe_improvement(compute_improvement([], []))


def test_negative_zero_is_not_printed():
    found = summary([-3.0, -3.1, -2.9])
    limits = dataclasses.replace(
        found.bland_altman, bias_interval=type(found.bland_altman.bias_interval)(-5.0, -0.01)
    )
    assert "-5.0 to 0.0°" in describe_angle(dataclasses.replace(found, bland_altman=limits))
