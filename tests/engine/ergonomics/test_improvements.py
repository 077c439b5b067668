"""Which change helps most: ranking, differences with common errors, locks and pairs."""

import dataclasses
import math

import numpy as np
import pytest

from engine.datatypes import Measurement, Task
from engine.ergonomics.improvements import (
    LOCKS,
    compare_change,
    find_governing_lift,
    rank_changes,
)
from engine.ergonomics.methods.rnle import METHOD as RNLE
from engine.ergonomics.what_if import Change, what_if
from engine.errors import ConfigError
from tests.engine.ergonomics.bending import build_bending
from tests.engine.ergonomics.exposures import build_exposure, build_lift

HEAVY = {"load_kg": 20.0, "duration_h": 4.0, "frequency_per_min": 3.0, "recovery_h": 1.0}


@pytest.fixture(scope="module")
def heavy():
    return build_bending(**HEAVY)


@pytest.fixture(scope="module")
def ranking(heavy):
    return rank_changes(heavy)


def test_changes_come_in_the_order_of_the_index(ranking):
    indices = [one.lifting_index.after for one in ranking.singles]
    assert indices == sorted(indices)
    for one in ranking.singles:
        effects = (one.lifting_index, one.compression)
        assert any(effect.after < effect.before for effect in effects), one.action


def test_stated_effects_are_those_of_what_if(heavy, ranking):
    for one in (*ranking.singles, *ranking.pairs):
        asked = what_if(heavy, one.change, methods=("rnle", "l5s1"))
        assert one.lifting_index.after == pytest.approx(asked["rnle"].value)
        assert one.compression.after == pytest.approx(asked["l5s1"].value)


def test_actions_speak_plainly(ranking):
    said = [one.sentence for one in ranking.singles]
    raised = next(s for s in said if s.startswith("Raise the origin to knuckle height (76 cm)"))
    assert ": LI " in raised
    assert " -> " in raised
    assert raised.endswith(" kN")


def test_pairs_beat_the_best_single_change(ranking):
    assert ranking.pairs
    assert not any(one.meets_goals for one in ranking.singles)
    best = ranking.singles[0]
    for pair in ranking.pairs:
        better = pair.lifting_index.after < best.lifting_index.after
        assert better or pair.compression.after < best.compression.after


def test_a_lift_within_the_goals_needs_no_pairs():
    easy = rank_changes(build_bending(load_kg=1.0))
    assert easy.meets_goals
    assert easy.pairs == ()


@pytest.mark.parametrize("lock", LOCKS)
def test_locks_rule_changes_out(heavy, lock):
    found = rank_changes(heavy, frozenset({lock}))
    for one in (*found.singles, *found.pairs):
        assert all(getattr(one.change, field) is None for field in LOCKS[lock])


def test_with_all_locked_nothing_is_offered(heavy):
    assert rank_changes(heavy, frozenset(LOCKS)).singles == ()


def test_unknown_locks_are_refused(heavy):
    with pytest.raises(ConfigError, match="Unknown lock 'shelf'"):
        rank_changes(heavy, frozenset({"shelf"}))


def test_halving_the_load_halves_the_index_surely():
    """Before and after share their errors: the ratio is exact though the index is not."""
    exposure = build_bending(recovery_h=1.0)
    change = Change(load_kg=exposure.task.load_kg / 2)
    effect = compare_change(exposure, change).lifting_index
    assert effect.after == pytest.approx(effect.before / 2)
    low, high = effect.difference_interval
    assert high < 0
    assert effect.is_sure
    before = RNLE.assess(exposure).interval
    assert high - low == pytest.approx((before[1] - before[0]) / 2, rel=0.15)


def test_the_difference_is_sharper_than_independent_errors_would_make_it():
    exposure = build_bending(recovery_h=1.0)
    effect = compare_change(exposure, Change(coupling="poor")).lifting_index
    low, high = effect.difference_interval
    (a, b), (c, d) = RNLE.assess(exposure).interval, effect.interval
    independent = math.hypot(b - a, d - c)
    assert high - low < independent / 3


def test_difference_in_compression_of_the_same_posture_leaves_the_person_out():
    exposure = build_bending()
    effect = compare_change(exposure, Change(load_kg=11.0)).compression
    low, high = effect.difference_interval
    before = what_if(exposure, Change(), methods=("l5s1",))["l5s1"].interval
    assert low < effect.difference < high < 0
    assert high - low < (before[1] - before[0]) / 5


def test_crossed_limits_are_named():
    exposure = build_bending(load_kg=14.0, recovery_h=1.0)
    found = compare_change(exposure, Change(load_kg=2.0, origin_H_cm=30.0, origin_V_cm=76.0))
    assert any(text.startswith("lifting index falls below 1.0") for text in found.limits)
    worse = compare_change(exposure, Change(load_kg=60.0))
    assert any("lifting index rises above 3.0" in text for text in worse.limits)


def test_equal_changes_are_not_told_apart():
    """Two ends alike: bringing the load closer at one or the other is worth the same."""
    end = (50.0, 75.0, 0.0)
    lift = build_lift(origin=end, destination=end, D=30.0, sigma=(4.0, 4.0, 5.0))
    exposure = build_exposure(lift, load_kg=10.0, coupling="good", frequency_per_min=0.2)
    found = rank_changes(exposure)
    closer = [one for one in found.singles if "closer" in one.action]
    assert all(not one.is_distinguishable for one in closer[:-1])


def test_the_worst_lift_is_taken_unless_another_is_asked_for():
    near = build_lift(origin=(30.0, 75.0, 0.0), destination=(30.0, 100.0, 0.0), start_s=1.0)
    far = build_lift(origin=(55.0, 20.0, 0.0), destination=(40.0, 100.0, 0.0), start_s=5.0)
    exposure = build_exposure(near, far, load_kg=10.0)
    assert find_governing_lift(exposure) == 1
    assert rank_changes(exposure).lift_index == 1
    assert rank_changes(exposure, lift_index=0).lift_index == 0
    with pytest.raises(ConfigError, match="choose one of them"):
        rank_changes(exposure, lift_index=4)


def test_without_a_lift_it_says_so():
    with pytest.raises(ConfigError, match="There is no lift"):
        rank_changes(build_exposure())


def test_without_a_load_changes_are_ranked_by_the_recommended_weight(heavy):
    unknown = dataclasses.replace(heavy, task=Task(coupling="fair", frequency_per_min=1.0))
    found = rank_changes(unknown)
    limits = [one.rwl.after for one in found.singles]
    assert limits == sorted(limits, reverse=True)
    assert all(one.lifting_index is None for one in found.singles)
    assert "load is not given" in found.reasons[0]


def test_where_the_equation_is_refused_the_back_decides():
    found = rank_changes(build_bending(conditions=("seated",), **HEAVY))
    values = [one.compression.after for one in found.singles]
    assert values == sorted(values)
    assert values
    assert "can't be used here" in found.reasons[0]


def test_infinite_indices_are_ranked_and_written():
    far = build_lift(origin=(70.0, 30.0, 0.0), destination=(30.0, 90.0, 0.0), sigma=(3, 3, 5))
    found = rank_changes(build_exposure(far, load_kg=10.0, coupling="good"))
    best = found.singles[0]
    assert "LI infinite -> " in best.sentence
    assert np.isfinite(best.lifting_index.after)


def test_unknown_errors_give_no_interval():
    lift = build_lift(sigma=(math.nan, 2.0, 2.0))
    effect = compare_change(build_exposure(lift, load_kg=10.0), Change(load_kg=5.0)).lifting_index
    assert all(math.isnan(x) for x in effect.difference_interval)
    assert not effect.is_sure


def test_a_missing_destination_does_not_hinder_the_origin():
    lift = build_lift()
    unseen = dataclasses.replace(lift.destination, H_cm=Measurement(math.nan))
    exposure = build_exposure(dataclasses.replace(lift, destination=unseen), load_kg=10.0)
    assert rank_changes(exposure).singles
