import dataclasses

import numpy as np
import pytest

from engine.errors import DataError
from engine.validation.compare import compare_trial
from engine.validation.pooled import (
    bland_altman_points,
    describe_agreement,
    describe_offsets,
    find_sides,
    pool_trials,
    pooled_differences,
)
from tests.engine.validation.test_compare import make_estimate, make_reference

FAST = {"n_resamples": 200, "n_flips": 200}


def compare(bias_deg=2.0, *, subject="P01", label="lift", task="", source="computed"):
    estimate = make_estimate(
        bias_deg=(bias_deg, 0.5 * bias_deg, -bias_deg), noise_deg=0.5, seed=round(100 * bias_deg)
    )
    named = dataclasses.replace(estimate, subject=subject, label=label, task=task)
    return compare_trial(named, make_reference(source))


def test_nothing_to_pool_is_refused():
    with pytest.raises(DataError, match="at least one"):
        pool_trials([])


def test_subjects_are_the_units_and_tasks_are_kept_apart():
    trials = [
        compare(1.0 + i, subject=f"P{i % 2}", label=f"lift {i}", task=("pack", "stack")[i // 2])
        for i in range(4)
    ]
    pooled = pool_trials(trials, **FAST)
    trunk = pooled.angles[0]
    assert (trunk.unit, trunk.n_trials, trunk.n_subjects) == ("subject", 4, 2)
    assert trunk.per_unit.n == 2
    assert trunk.pooled.bias_deg == pytest.approx(np.mean([1, 2, 3, 4]), abs=0.1)
    assert set(pooled.tasks) == {"pack", "stack"}
    assert pooled.tasks["pack"][0].pooled.bias_deg == pytest.approx(1.5, abs=0.1)
    assert pooled.tasks["stack"][0].pooled.bias_deg == pytest.approx(3.5, abs=0.1)


def test_one_task_is_not_listed_twice():
    assert not pool_trials([compare()], **FAST).tasks


def test_trials_of_one_name_are_told_apart():
    pooled = pool_trials([compare(1.0), compare(2.0), compare(3.0, subject="P02")], **FAST)
    assert [t.label for t in pooled.trials] == ["lift", "lift (2)", "lift"]


def test_no_interval_of_an_angle_is_wider_than_a_full_turn():
    for trials in ([compare()], [compare(1.0), compare(9.0, subject="P02")]):
        for summary in pool_trials(trials, **FAST).angles:
            for name in ("bias_interval", "lower_interval", "upper_interval"):
                interval = getattr(summary.bland_altman, name)
                assert not interval.high - interval.low > 360.0


def test_the_scope_is_said_once_and_the_worst_angle_named():
    lead, *others = describe_agreement(pool_trials([compare()], **FAST))
    assert lead.count("says nothing about others") == 1
    assert not any("says nothing about others" in s for s in others)
    assert others[0].startswith("Trunk flexion")
    assert "least knee flexion (left)" in lead


@pytest.mark.parametrize(
    ("source", "words"),
    [("computed", "counts as error"), ("recorded", "was taken out first")],
)
def test_what_was_done_with_offsets_is_said(source, words):
    assert words in describe_offsets(pool_trials([compare(source=source)], **FAST))


def test_left_and_right_are_matched():
    sides = find_sides(pool_trials([compare()], **FAST))
    assert [(name, a.name, b.name) for name, a, b in sides] == [
        ("knee_flexion", "knee_flexion_l", "knee_flexion_r")
    ]


def test_points_of_the_plot_are_the_differences():
    trials = (compare(3.0),)
    mean, difference = bland_altman_points(trials, "trunk_flexion")
    column = trials[0].names.index("trunk_flexion")
    own = trials[0].pairs.estimated_deg[:, column]
    assert mean == pytest.approx(own - difference / 2)
    assert pooled_differences(trials, "trunk_flexion") == pytest.approx(difference)
