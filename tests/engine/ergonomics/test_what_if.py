"""A measured lift judged as if it were done otherwise."""

import dataclasses
import math

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from engine.datatypes import Coupling, Measurement, Provenance
from engine.ergonomics.assess import assess_risk
from engine.ergonomics.lifting_equation import Duration, compute_rwl
from engine.ergonomics.what_if import (
    Change,
    apply_change,
    describe_change,
    focus_on_lift,
    what_if,
)
from engine.errors import ConfigError
from tests.engine.ergonomics.bending import START_S, build_bending
from tests.engine.ergonomics.exposures import build_exposure, build_lift

LIFT_METHODS = ("rnle", "rnle_job", "iso11228", "acgih", "lm_mmh", "lifft", "l5s1", "kim_lhc")


@pytest.fixture(scope="module")
def exposure():
    return build_bending(recovery_h=1.0, destination_control=True)


def same(one, two):
    return one == pytest.approx(two, nan_ok=True)


def test_no_change_gives_what_was_measured(exposure):
    measured, asked = assess_risk(exposure), what_if(exposure, Change())
    assert asked.keys() == measured.keys()
    for name, result in asked.items():
        assert same(result.value, measured[name].value)
        assert result.steps == measured[name].steps
        assert result.reasons == measured[name].reasons


@settings(max_examples=20, deadline=None)
@given(
    H=st.floats(25, 63),
    V=st.floats(0, 170),
    A=st.floats(0, 130),
    load=st.floats(1, 40),
    frequency=st.floats(0.2, 8),
)
def test_the_index_is_the_equation_at_the_new_values(exposure, H, V, A, load, frequency):
    change = Change(
        origin_H_cm=H,
        origin_V_cm=V,
        origin_A_deg=A,
        destination_H_cm=H,
        destination_V_cm=V + 5.0,
        destination_A_deg=A,
        load_kg=load,
        frequency_per_min=frequency,
        coupling=Coupling.POOR,
        duration_h=2.0,
        recovery_h=2.0,
    )
    found = what_if(exposure, change, methods=("rnle",))["rnle"]
    lift = apply_change(exposure, change).exposure.lifts[0]
    ends = [
        compute_rwl(
            H=H,
            V=v,
            D=lift.D_cm.value,
            A=A,
            frequency_per_min=frequency,
            duration=Duration.MODERATE,
            coupling=Coupling.POOR,
            V_origin=V,
        ).RWL
        for v in (V, V + 5.0)
    ]
    assert lift.D_cm.value == pytest.approx(5.0, abs=1e-6)
    assert found.value == pytest.approx(load / min(ends))


def test_the_travel_follows_the_heights_and_keeps_its_difference():
    lift = dataclasses.replace(build_lift(), D_cm=Measurement(64.0, 3.0))  # heights say 60
    found = apply_change(build_exposure(lift), Change(origin_V_cm=70.0)).exposure.lifts[0]
    assert found.D_cm.value == pytest.approx(24.0)
    assert apply_change(build_exposure(lift), Change(origin_H_cm=30.0)).exposure.lifts[0].D_cm == (
        lift.D_cm
    )


@pytest.mark.parametrize(
    ("change", "methods"),
    [
        (Change(load_kg=6.0), LIFT_METHODS),
        (Change(origin_H_cm=30.0, destination_H_cm=30.0), ("rnle", "lm_mmh", "l5s1", "lifft")),
        (Change(frequency_per_min=0.2), ("rnle", "rnle_job", "iso11228", "lm_mmh", "lifft")),
        (Change(coupling="good"), ("rnle", "rnle_job", "iso11228", "lm_mmh")),
        (Change(duration_h=0.2), ("lifft", "kim_lhc", "shoulder_tool")),
        (Change(origin_V_cm=76.0), ("rnle", "l5s1", "iso11228", "kim_lhc")),
    ],
    ids=["load", "distance", "frequency", "grip", "duration", "height"],
)
def test_a_better_workplace_lowers_the_methods_that_look_at_it(exposure, change, methods):
    measured, asked = (
        assess_risk(exposure, methods=methods),
        what_if(exposure, change, methods=methods),
    )
    for name in methods:
        assert asked[name].value < measured[name].value, name


def test_what_is_not_filmed_is_marked_as_assumed(exposure):
    asked = what_if(exposure, Change(origin_V_cm=76.0, load_kg=8.0))
    sources = {item.name: item.provenance for item in asked["rnle"].inputs}
    assert sources["V at origin"] is sources["D"] is sources["load"] is Provenance.ASSUMED
    assert sources["H at origin"] is Provenance.MEASURED
    back = asked["l5s1"]
    assert {i.name: i.provenance for i in back.inputs}[
        "forward bending moment"
    ] is Provenance.ASSUMED
    assert any("was not filmed" in reason for reason in back.reasons)
    assert not any("was not filmed" in reason for reason in asked["rnle"].reasons)
    assert back.steps[0].startswith("What if: origin height 76 cm instead of ")
    assert math.isnan(back.details["dynamic"]["compression_n"])
    assert back.per_lift[0].steps[0] == back.steps[0]


def test_a_change_of_the_load_leaves_the_filmed_posture(exposure):
    found = apply_change(exposure, Change(load_kg=5.0))
    assert found.exposure.track is exposure.track
    assert not found.is_posed
    back = what_if(exposure, Change(load_kg=5.0), methods=("l5s1",))["l5s1"]
    assert math.isfinite(back.details["dynamic"]["compression_n"])


def test_the_posed_back_load_is_less_certain(exposure):
    width = {}
    for name, change in {"as is": Change(), "posed": Change(origin_V_cm=45.0)}.items():
        low, high = what_if(exposure, change, methods=("l5s1",))["l5s1"].interval
        width[name] = high - low
    assert width["posed"] > width["as is"]


def test_methods_that_score_every_frame_can_be_left_out(exposure):
    assert "reba" in what_if(exposure, Change(load_kg=5.0))
    assert "reba" not in what_if(exposure, Change(load_kg=5.0), frames=False)


def test_only_the_named_lift_is_moved():
    first, second = build_lift(start_s=1.0), build_lift(start_s=5.0)
    found = apply_change(build_exposure(first, second), Change(origin_V_cm=70.0, lift_index=1))
    assert found.exposure.lifts[0] == first
    assert found.exposure.lifts[1].origin.V_cm.value == 70.0


def test_one_lift_keeps_the_rate_of_all_that_were_counted():
    lifts = (build_lift(start_s=1.0), build_lift(start_s=5.0))
    single = focus_on_lift(build_exposure(*lifts, observed_s=1800.0), 1)
    assert single.lifts == lifts[1:]
    assert single.task.frequency_per_min == pytest.approx(2 / 30)


@pytest.mark.parametrize(
    ("wrong", "says"),
    [
        ({"origin_H_cm": -3.0}, "Origin H must lie between 0 and 150 cm"),
        ({"destination_V_cm": math.nan}, "Destination V must lie between"),
        ({"origin_A_deg": 200.0}, "180 degrees"),
        ({"load_kg": -1.0}, "Load must lie between"),
        ({"coupling": "great"}, "good, fair or poor"),
        ({"duration_h": 30.0}, "Duration must lie between"),
    ],
)
def test_impossible_changes_are_refused_in_one_sentence(wrong, says):
    with pytest.raises(ConfigError, match=says):
        Change(**wrong)


def test_a_lift_that_is_not_there_is_refused(exposure):
    with pytest.raises(ConfigError, match="There are 1 lifts"):
        what_if(exposure, Change(lift_index=3))


def test_changes_add_up_unless_they_touch_the_same():
    one, two = Change(load_kg=5.0), Change.at("origin", V_cm=76.0)
    assert one.merge(two) == Change(load_kg=5.0, origin_V_cm=76.0)
    assert one.merge(Change(load_kg=6.0)) is None


def test_changes_are_said_in_words(exposure):
    said = describe_change(exposure, Change(origin_V_cm=76.0, load_kg=6.0, coupling="good"))
    assert said[0].startswith("origin height 76 cm instead of ")
    assert said[1:] == ("load 6 kg instead of 12 kg", "grip good instead of fair")


# --------------------------------------------------------------------------- bad input


def test_methods_that_need_the_load_say_so_and_the_others_run():
    exposure = build_bending(load_kg=None)
    asked = what_if(exposure, Change(origin_V_cm=76.0), frames=False)
    assert asked["rnle"].is_applicable
    assert math.isnan(asked["rnle"].value)
    assert not asked["lifft"].is_applicable
    assert "load is not given" in asked["lifft"].reasons[-1]
    assert asked["l5s1"].is_applicable
    # A load that is supposed makes them run.
    assert what_if(exposure, Change(load_kg=9.0), frames=False)["lifft"].is_applicable


@pytest.mark.parametrize("condition", ["seated", "kneeling", "walking"])
def test_refusals_stay(condition):
    asked = what_if(build_bending(conditions=(condition,)), Change(origin_V_cm=76.0), frames=False)
    assert not asked["rnle"].is_applicable


def test_one_hand_is_refused_by_the_equation():
    asked = what_if(build_bending(), Change(hands=1), frames=False)
    assert not asked["rnle"].is_applicable
    assert asked["l5s1"].is_applicable


def test_more_than_eight_hours_is_refused_and_said():
    asked = what_if(build_bending(), Change(duration_h=9.0), methods=("rnle",))["rnle"]
    assert not asked.is_applicable
    assert any("at most 8 h" in r for r in asked.reasons)


def test_no_lifting_at_all_is_no_damage():
    asked = what_if(build_bending(), Change(frequency_per_min=0.0), frames=False)
    assert asked["lifft"].value == 0.0
    assert asked["rnle"].is_applicable


def test_without_a_lift_only_the_work_can_change(exposure):
    empty = dataclasses.replace(exposure, lifts=())
    asked = what_if(empty, Change(origin_V_cm=76.0, load_kg=5.0), frames=False)
    assert not any(result.is_applicable for result in asked.values())


def test_hands_that_were_not_measured_keep_the_posture_and_say_so(exposure):
    lift = exposure.lifts[0]
    unseen = dataclasses.replace(lift.origin, V_cm=Measurement(math.nan))
    hidden = dataclasses.replace(exposure, lifts=(dataclasses.replace(lift, origin=unseen),))
    found = apply_change(hidden, Change(origin_V_cm=76.0))
    assert not found.is_posed
    assert "posture stays as measured" in found.notes[0]
    assert found.exposure.lifts[0].origin.V_cm.value == 76.0


def test_a_gap_over_the_worst_moment_is_doubted_before_and_after():
    exposure = build_bending()
    position = exposure.track.position.copy()
    around = abs(exposure.track.time_s - START_S) < 0.3
    position[around] = math.nan
    track = dataclasses.replace(exposure.track, position=position, status=None)
    gappy = dataclasses.replace(exposure, track=track)
    for change in (Change(), Change(destination_V_cm=90.0)):
        back = what_if(gappy, change, methods=("l5s1",))["l5s1"]
        assert any("the real peak may be higher" in doubt for doubt in back.details["doubts"])


def test_a_place_out_of_reach_is_said(exposure):
    found = apply_change(exposure, Change(origin_H_cm=140.0))
    assert "out of reach" in found.notes[0]
