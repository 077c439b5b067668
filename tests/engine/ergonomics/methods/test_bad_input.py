"""What no method may take in silence: every method against every kind of unusual input."""

import dataclasses
import math

import numpy as np
import pytest

from engine.datatypes import JointAngles, Subject
from engine.ergonomics.base import list_methods
from tests.engine.ergonomics.bending import START_S, build_bending

METHODS = {method.info.name: method for method in list_methods()}
CHILD = Subject(stature_m=1.20, mass_kg=25.0, age_y=10.0)

INPUTS = {
    "a child": {"subject": CHILD},
    "nine hours": {"duration_h": 9.0},
    "never": {"frequency_per_min": 0.0},
    "sixty a minute": {"frequency_per_min": 60.0},
    "one hand": {"hands": 1},
    "seated": {"conditions": ("seated",)},
    "kneeling": {"conditions": ("kneeling",)},
    "carrying": {"conditions": ("walking",)},
    "no load given": {"load_kg": None},
    "nothing in the hands": {"load_kg": 0.0},
    "half a ton": {"load_kg": 500.0},
    "nothing known": {
        "subject": Subject(),
        "load_kg": None,
        "coupling": None,
        "frequency_per_min": None,
        "duration_h": None,
    },
}
LOAD_METHODS = {"rnle", "rnle_job", "rnle_vli", "iso11228", "acgih", "kim_lhc", "lm_mmh", "lifft"}
STANDING_METHODS = {"rnle", "rnle_job", "rnle_vli", "iso11228", "lm_mmh"}


def assess(name, **kwargs):
    return METHODS[name].assess(build_bending(**kwargs))


def said(result):
    return " ".join(result.reasons)


@pytest.mark.parametrize("kwargs", INPUTS.values(), ids=INPUTS)
@pytest.mark.parametrize("name", METHODS)
def test_every_method_answers_in_order(name, kwargs):
    """No error, no number without a level, no refusal without a reason, bounds around the value."""
    result = assess(name, **kwargs)
    assert result.method == name
    if not result.is_applicable:
        assert result.reasons
        assert math.isnan(result.value)
        return
    low, high = result.interval
    assert math.isnan(low) or low <= result.value + 1e-9
    assert math.isnan(high) or high >= result.value - 1e-9
    assert result.category


@pytest.mark.parametrize("name", sorted(LOAD_METHODS | {"l5s1", "shoulder_tool"}))
def test_methods_made_for_adults_doubt_a_child(name):
    assert "that of a child" in said(assess(name, subject=CHILD))


@pytest.mark.parametrize("name", sorted(LOAD_METHODS))
def test_methods_that_need_the_load_say_so(name):
    result = assess(name, load_kg=None)
    assert math.isnan(result.value)
    assert "load is not given" in said(result)


@pytest.mark.parametrize("condition", ["seated", "kneeling", "walking"])
@pytest.mark.parametrize("name", sorted(STANDING_METHODS))
def test_methods_for_standing_lifts_refuse_others(name, condition):
    assert not assess(name, conditions=(condition,)).is_applicable


@pytest.mark.parametrize("name", ["rnle", "rnle_job", "iso11228"])
def test_more_than_eight_hours_is_refused(name):
    result = assess(name, duration_h=9.0)
    assert not result.is_applicable
    assert "at most 8 h" in said(result)


def test_acceptable_loads_beyond_their_day_are_doubted():
    assert "for a day of 8 h" in said(assess("lm_mmh", duration_h=9.0))
    assert "for a day of 8 h" not in said(assess("lm_mmh", duration_h=8.0))


def test_a_gap_over_the_worst_moment_is_no_relief():
    """The posture of the deepest bend was not seen: who says less must say so."""
    whole = build_bending()
    around = abs(whole.track.time_s - START_S) < 0.35
    position = np.where(around[:, None, None], np.nan, whole.track.position)
    value = np.where(around[:, None], np.nan, whole.angles.value_deg)
    gappy = dataclasses.replace(
        whole,
        track=dataclasses.replace(whole.track, position=position, status=None),
        angles=JointAngles(whole.angles.time_s, value, whole.angles.names, whole.angles.sigma_deg),
    )
    back = METHODS["l5s1"].assess(gappy)
    assert back.value < METHODS["l5s1"].assess(whole).value
    assert "the real peak may be higher" in said(back)
    for name in ("reba", "rula", "owas"):
        scored = METHODS[name].assess(gappy)
        assert scored.details["scored_share"] < 1.0
        assert any("scored" in doubt or "seen" in doubt for doubt in scored.details["doubts"]), name
