"""Before and after: who was repeated, how sure the difference is, and what it amounts to."""

import dataclasses
import math

import numpy as np
import pytest
from scipy import stats

from engine.datatypes import Measurement, Task
from engine.ergonomics.assess import assess_risk
from engine.ergonomics.before_after import (
    TrialMeasures,
    Verdict,
    compare_before_after,
    measure_trial,
)
from engine.errors import DataError
from tests.engine.ergonomics.bending import build_bending


def build_trial(li, *, person="A", sigma=0.1, task=None, settings=None, **values):
    known = {name: Measurement(value, sigma) for name, value in values.items()}
    return TrialMeasures(
        "trial",
        person,
        task or Task(load_kg=10.0),
        {"li": Measurement(li, sigma), **known},
        settings or {},
    )


def build_set(values, *, person="A", **kwargs):
    return [build_trial(value, person=person, **kwargs) for value in values]


def of(found, key="li"):
    return next(change for change in found.changes if change.measure.key == key)


def test_trials_of_one_person_are_compared_by_welch():
    one, two = [2.1, 2.3, 2.2, 2.4], [1.4, 1.5, 1.2]
    change = of(compare_before_after(build_set(one), build_set(two)))
    expected = stats.ttest_ind(two, one, equal_var=False).confidence_interval(0.95)
    assert change.interval == pytest.approx((expected.low, expected.high))
    assert change.unit_of_analysis == "trials"
    assert change.n == (4, 3)
    exact = stats.permutation_test(
        (one, two),
        lambda a, b: abs(np.mean(a) - np.mean(b)),
        n_resamples=np.inf,
        alternative="greater",
    )
    assert change.p == pytest.approx(exact.pvalue)
    assert change.verdict is Verdict.IMPROVED


def test_persons_filmed_both_times_are_paired():
    before = {"A": [2.0, 2.2], "B": [1.5, 1.6], "C": [3.0, 3.1]}
    after = {"A": [1.7], "B": [1.3, 1.2], "C": [2.6, 2.7, 2.8]}
    one, two = (
        [trial for person, values in part.items() for trial in build_set(values, person=person)]
        for part in (before, after)
    )
    change = of(compare_before_after(one, two))
    pairs = [np.mean(after[p]) - np.mean(before[p]) for p in before]
    expected = stats.ttest_1samp(pairs, 0).confidence_interval(0.95)
    assert change.difference == pytest.approx(np.mean(pairs))
    assert change.interval == pytest.approx((expected.low, expected.high))
    assert (change.unit_of_analysis, change.n) == ("persons", (3, 3))
    assert change.p == pytest.approx(2 / 2**3)  # all the same sign: the rarest of 8 arrangements


def test_one_trial_each_leaves_the_measuring_error_and_says_so():
    found = compare_before_after(build_set([2.0], sigma=0.3), build_set([1.6], sigma=0.4))
    change = of(found)
    assert change.unit_of_analysis == "measuring error"
    assert change.interval == pytest.approx((-0.4 - 0.98, -0.4 + 0.98))
    assert change.verdict is Verdict.NOT_DISTINGUISHABLE
    assert any("measuring error only" in reason for reason in found.reasons)
    assert math.isnan(change.p)


def test_a_single_trial_borrows_the_spread_of_the_other_set():
    change = of(compare_before_after(build_set([2.0, 2.2, 2.4]), build_set([1.0])))
    half = stats.t.ppf(0.975, 2) * 0.2 * math.sqrt(1 / 3 + 1)
    assert change.interval == pytest.approx((-1.2 - half, -1.2 + half))


def test_the_minimal_detectable_change_follows_from_repetition():
    change = of(compare_before_after(build_set([2.0, 2.4]), build_set([1.0, 1.2])))
    sem = math.sqrt((0.08 + 0.02) / 2)
    assert change.sem == pytest.approx(sem)
    assert change.mdc == pytest.approx(1.96 * math.sqrt(2) * sem)


def test_without_repetition_it_follows_from_the_measuring_error():
    change = of(compare_before_after(build_set([2.0], sigma=0.2), build_set([1.0], sigma=0.2)))
    assert change.sem == pytest.approx(0.2)


@pytest.mark.parametrize(
    ("after", "verdict"),
    [
        ([1.0, 1.1, 1.2], Verdict.IMPROVED),
        ([2.9, 3.0, 3.1], Verdict.WORSE),
        ([1.6, 2.0, 2.5], Verdict.NOT_DISTINGUISHABLE),
    ],
)
def test_verdicts(after, verdict):
    found = compare_before_after(build_set([2.0, 2.1, 2.2]), build_set(after))
    assert found.verdict is verdict
    assert found.sentence.endswith(f"{verdict}.")


def test_a_higher_weight_limit_is_an_improvement():
    one, two = ([build_trial(2.0, rwl=v + k / 100) for k in range(3)] for v in (8.0, 12.0))
    assert of(compare_before_after(one, two), "rwl").verdict is Verdict.IMPROVED


def test_a_height_is_neither_better_nor_worse():
    one, two = ([build_trial(2.0, origin_V=v + k / 100) for k in range(3)] for v in (20.0, 76.0))
    change = of(compare_before_after(one, two), "origin_V")
    assert change.verdict is Verdict.NOT_DISTINGUISHABLE
    assert change.interval[0] > 50


def test_what_got_worse_beside_an_improvement_is_said():
    one = [build_trial(2.0 + k / 100, rula=4.0 + k / 100) for k in range(3)]
    two = [build_trial(1.0 + k / 100, rula=6.0 + k / 100) for k in range(3)]
    found = compare_before_after(one, two)
    assert found.verdict is Verdict.IMPROVED
    assert found.sentence.endswith("Worse: RULA.")


def test_noise_is_called_an_improvement_in_few_cases_only():
    """Two sets of the same work: 5 % verdicts either way, give or take chance."""
    rng = np.random.default_rng(0)
    wrong = sum(
        compare_before_after(
            build_set(rng.normal(2.0, 0.3, 4)), build_set(rng.normal(2.0, 0.3, 4))
        ).verdict
        is not Verdict.NOT_DISTINGUISHABLE
        for _ in range(400)
    )
    assert wrong <= 32  # the 99 % bound of 400 draws at 5 %


def test_different_people_are_refused():
    found = compare_before_after(build_set([2.0, 2.1], person="A"), build_set([1.0], person="B"))
    assert found.verdict is None
    assert found.changes == ()
    assert "with different people" in found.sentence


def test_groups_of_different_people_are_compared_as_groups():
    one = [build_trial(v, person=p) for p, v in zip("ABC", (2.0, 2.1, 2.2), strict=True)]
    two = [build_trial(v, person=p) for p, v in zip("DEF", (1.0, 1.1, 1.2), strict=True)]
    change = of(compare_before_after(one, two))
    assert change.unit_of_analysis == "persons"
    assert change.verdict is Verdict.IMPROVED


def test_only_persons_filmed_both_times_count():
    one = [*build_set([2.0, 2.2], person="A"), *build_set([9.0], person="B")]
    found = compare_before_after(one, build_set([1.0, 1.1], person="A"))
    assert of(found).before == pytest.approx(2.1)
    assert any("filmed both times count: A" in reason for reason in found.reasons)


def test_another_load_and_another_solver_are_said():
    one = build_set([2.0, 2.1], settings={"solver": "geometric"})
    two = build_set([1.0, 1.1], task=Task(load_kg=5.0), settings={"solver": "least-squares"})
    reasons = " ".join(compare_before_after(one, two).reasons)
    assert "the load differs, 10.0 kg before and 5.0 kg after" in reasons
    assert "the solver differs, geometric before and least-squares after" in reasons


def test_what_one_set_lacks_is_named_and_left_out():
    found = compare_before_after(build_set([2.0], lifft=20.0), build_set([1.0]))
    assert all(change.measure.key != "lifft" for change in found.changes)
    assert any("LiFFT" in reason and "not compared" in reason for reason in found.reasons)


def test_infinite_indices_are_not_compared_but_the_limits_are():
    found = compare_before_after(
        build_set([math.inf, 3.0], rwl=0.0), build_set([1.0, 1.1], rwl=9.0)
    )
    assert found.changes[0].measure.key == "rwl"
    assert any("lifting index is not known" in reason for reason in found.reasons)


def test_without_any_main_measure_there_is_no_verdict():
    one, two = (TrialMeasures("x", "A", Task(), {"reba": Measurement(v, 1.0)}) for v in (8.0, 4.0))
    found = compare_before_after([one], [two])
    assert found.verdict is None
    assert "no verdict" in found.sentence


def test_empty_and_overlapping_sets_are_refused():
    trial = build_trial(2.0)
    with pytest.raises(DataError, match="at least one trial each"):
        compare_before_after([], [trial])
    with pytest.raises(DataError, match="before and after at once"):
        compare_before_after([trial], [trial])


def test_the_numbers_of_a_trial_are_those_of_its_results():
    exposure = build_bending(recovery_h=1.0)
    risk = assess_risk(exposure)
    found = measure_trial(
        label="x",
        subject=exposure.subject,
        task=exposure.task,
        lifts=exposure.lifts,
        angles=exposure.angles,
        risk=risk,
    )
    assert found.values["li"].value == pytest.approx(risk["rnle"].value)
    assert found.values["compression"].value == pytest.approx(risk["l5s1"].value)
    assert found.values["compression"].sigma == pytest.approx(
        risk["l5s1"].details["compression_sigma_n"]
    )
    assert found.values["origin_H"].value == exposure.lifts[0].origin.H_cm.value
    assert found.values["trunk"].value == pytest.approx(65.0, abs=0.1)


def test_what_was_not_measured_is_not_in_the_numbers():
    exposure = build_bending(load_kg=None)
    found = measure_trial(
        label="x",
        subject=exposure.subject,
        task=exposure.task,
        lifts=(),
        angles=dataclasses.replace(exposure.angles, names=("a", "b", "c", "d")),
        risk={"rnle": assess_risk(exposure, methods=("rnle",))["rnle"]},
    )
    assert set(found.values) == {"rwl"}
