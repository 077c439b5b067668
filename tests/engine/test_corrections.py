import json

import jsonschema
import numpy as np
import pytest

from engine.corrections import (
    LIMBS,
    NO_CORRECTIONS,
    PROVENANCE_KEY,
    Corrections,
    LiftCorrection,
    PersonChoice,
    SideSwap,
    apply_corrections,
    describe_correction,
    find_limb,
    read_corrections,
    restore_sides,
)
from engine.errors import ConfigError, DataError
from engine.pipeline import assess_pose
from engine.skeletons import MEDIAPIPE_33
from engine.storage.document import SCHEMA_PATH
from tests.builders import make_trial, make_view_pose


def column(pose, name, part="image"):
    return getattr(pose, part).position[:, MEDIAPIPE_33.index(name)]


@pytest.fixture
def pose():
    return make_view_pose(n_frames=30)


def test_sides_are_exchanged_in_the_stretch_only(pose):
    (fixed,) = apply_corrections([pose], [SideSwap(0.2, 0.5)])
    inside = (pose.image.time_s >= 0.2) & (pose.image.time_s <= 0.5)
    for part in ("image", "body"):
        left, right = column(pose, "left_knee", part), column(pose, "right_knee", part)
        np.testing.assert_array_equal(column(fixed, "left_knee", part)[inside], right[inside])
        np.testing.assert_array_equal(column(fixed, "right_knee", part)[inside], left[inside])
        np.testing.assert_array_equal(column(fixed, "left_knee", part)[~inside], left[~inside])
        np.testing.assert_array_equal(column(fixed, "nose", part), column(pose, "nose", part))


def test_one_limb_alone_can_be_put_right(pose):
    swap = SideSwap(0.0, 1.0, keypoints=("left_wrist",))
    (fixed,) = apply_corrections([pose], [swap])
    np.testing.assert_array_equal(column(fixed, "left_wrist"), column(pose, "right_wrist"))
    np.testing.assert_array_equal(column(fixed, "left_knee"), column(pose, "left_knee"))


def test_the_same_correction_twice_changes_nothing(pose):
    swap = SideSwap(0.1, 0.7)
    (fixed,) = apply_corrections([pose], [swap, swap])
    np.testing.assert_array_equal(fixed.image.position, pose.image.position)
    np.testing.assert_array_equal(fixed.body.position, pose.body.position)


def test_what_was_corrected_is_written_down_and_the_original_stays(pose):
    before = pose.image.position.copy()
    (fixed,) = apply_corrections([pose], [SideSwap(0.2, 0.5)])
    (note,) = fixed.image.provenance[PROVENANCE_KEY]
    assert (note["kind"], note["start_s"], note["end_s"]) == ("side_swap", 0.2, 0.5)
    assert fixed.image.provenance["made_by"] == "tests"
    assert PROVENANCE_KEY not in pose.image.provenance
    np.testing.assert_array_equal(pose.image.position, before)


def test_keypoints_exchanged_by_an_estimator_are_assessed_as_if_they_never_were():
    truth = make_view_pose(n_frames=60)
    (wrong,) = apply_corrections([truth], [SideSwap(0.0, 2.0)])
    (fixed,) = apply_corrections([wrong], [SideSwap(0.0, 2.0)])
    expected, got = assess_pose(make_trial(), truth), assess_pose(make_trial(), fixed)
    np.testing.assert_array_equal(got.angles.value_deg, expected.angles.value_deg)
    assert len(got.views[0].image.provenance[PROVENANCE_KEY]) == 2


@pytest.mark.parametrize(
    ("make", "says"),
    [
        (lambda: SideSwap(0.5, 0.2), "start before its end"),
        (lambda: SideSwap(0.0, 1.0, view=1), "no view 2"),
        (lambda: SideSwap(5.0, 6.0), "No picture lies between"),
        (lambda: SideSwap(0.0, 1.0, keypoints=("left_horn",)), "left_horn"),
    ],
)
def test_what_can_not_be_corrected_says_so(pose, make, says):
    with pytest.raises(ConfigError, match=says):
        apply_corrections([pose], [make()])


def test_taking_back_gives_the_same_bits(pose):
    swaps = [SideSwap(0.2, 0.5), SideSwap(0.0, 0.3, keypoints=("left_knee",)), SideSwap(0.4, 0.9)]
    (fixed,) = apply_corrections([pose], swaps)
    assert not np.array_equal(fixed.image.position, pose.image.position)
    (back,) = restore_sides([fixed])
    for part in ("image", "body"):
        for name in ("position", "confidence", "sigma", "status"):
            np.testing.assert_array_equal(
                getattr(getattr(back, part), name), getattr(getattr(pose, part), name)
            )
    assert back.image.provenance == pose.image.provenance


@pytest.mark.parametrize("limb", LIMBS)
def test_a_limb_is_exchanged_on_both_sides_and_nothing_else(pose, limb):
    swap = SideSwap(0.0, 1.0, keypoints=find_limb("mediapipe_33", limb))
    (fixed,) = apply_corrections([pose], [swap])
    moved = ~np.isclose(fixed.image.position, pose.image.position).all(axis=(0, 2))
    names = {MEDIAPIPE_33.keypoints[i].split("_", 1)[-1] for i in np.flatnonzero(moved)}
    assert names <= set(LIMBS[limb]) if LIMBS[limb] else len(names) > 10
    assert len(names) >= 4


# --------------------------------------------------------------------------- all together

MOVED = LiftCorrection((2.4, 3.6), (2.1, 3.6), by="AB", on="2026-11-22T14:05:00+00:00")
REMOVED = LiftCorrection((5.0, 6.0), None)
ADDED = LiftCorrection(None, (7.0, 8.5))
SWAP = SideSwap(1.0, 2.0, view=1, keypoints=("left_knee", "left_ankle"), by="CD")
PERSON = PersonChoice(1.5, (10.0, 20.0, 110.0, 320.0))
ALL = Corrections((MOVED, REMOVED, ADDED), (SWAP,), (PERSON,))


def test_corrections_survive_storing():
    plain = json.loads(json.dumps(ALL.as_plain()))
    back = Corrections.from_plain(plain)
    assert back == ALL
    assert back.lifts[0].by == "AB", "who said it is kept, though it makes no difference"
    assert read_corrections({"config": {"corrections": plain}}) == ALL
    assert read_corrections({"config": {}}) == NO_CORRECTIONS


@pytest.mark.parametrize("corrections", [ALL, Corrections.of_lifts([(1.0, 2.0)])])
def test_what_is_stored_fits_the_schema(corrections):
    schema = json.loads(SCHEMA_PATH.read_text(encoding="utf-8"))
    part = {"$defs": schema["$defs"], **schema["properties"]["config"]}
    plain = json.loads(json.dumps({"corrections": corrections.as_plain()}))
    jsonschema.validate(plain, part)
    plain["corrections"]["lifts"][0]["actual"] = 1.0
    with pytest.raises(jsonschema.ValidationError):
        jsonschema.validate(plain, part)


@pytest.mark.parametrize(
    "plain",
    [
        {"lifts": [{"found": None, "actual": None}]},
        {"lifts": [{"begin": 1}]},
        {"swaps": [{"start_s": "x", "end_s": 1}]},
        {"persons": [{"at_s": 1.0, "box": [1, 2]}]},
        {"lifts": [None]},
        [],
    ],
)
def test_damaged_corrections_are_said_to_be_so(plain):
    with pytest.raises(DataError, match="can't be read"):
        Corrections.from_plain(plain)


def test_each_is_said_in_words_with_who_and_when():
    said = ALL.describe()
    assert said[0] == (
        "Corrected by hand by AB on 22 Nov 2026, 14:05 UTC: lift from 2.40 to 3.60 s: start 2.40 "
        "-> 2.10 s."
    )
    assert describe_correction(REMOVED) == "no lift from 5.00 to 6.00 s"
    assert describe_correction(ADDED) == "a lift added from 7.00 to 8.50 s"
    assert describe_correction(SWAP) == (
        "left and right lower legs and feet exchanged from 1.00 to 2.00 s in video 2"
    )
    assert describe_correction(PERSON) == "another person is followed from 1.50 s on"
    assert "whole body" in describe_correction(SideSwap(0.0, 1.0))
    arms = find_limb("mediapipe_33", "arms")
    assert "right arms exchanged" in describe_correction(SideSwap(0.0, 1.0, keypoints=arms))


def test_what_the_events_are_told():
    assert ALL.set_lifts == ((2.1, 3.6), (7.0, 8.5))
    assert ALL.not_lifts == ((2.4, 3.6), (5.0, 6.0))
    only = Corrections.of_lifts([(1, 2)])
    assert only.set_lifts == ((1.0, 2.0),)
    assert only.not_lifts == ((float("-inf"), float("inf")),)
    assert Corrections.of_lifts([]) == NO_CORRECTIONS


def test_a_lift_corrected_twice_keeps_how_it_was_found():
    once = NO_CORRECTIONS.correct_lift((2.4, 3.6), (2.1, 3.6))
    # The result shows the nearest pictures, not exactly what was set.
    twice = once.correct_lift((2.1021, 3.5988), (2.0, 3.5))
    assert twice.lifts == (LiftCorrection((2.4, 3.6), (2.0, 3.5)),)
    assert twice.correct_lift((2.0, 3.5), (2.4, 3.6)) == NO_CORRECTIONS
    assert twice.correct_lift((2.0, 3.5), None).lifts == (LiftCorrection((2.4, 3.6), None),)


def test_the_rounding_of_the_screen_is_no_correction():
    found = (2.4333, 4.2667)
    assert NO_CORRECTIONS.correct_lift(found, (2.43, 4.27)) == NO_CORRECTIONS
    (one,) = NO_CORRECTIONS.correct_lift(found, (2.43, 4.1)).lifts
    assert one.actual == (2.4333, 4.1)
    assert "start" not in describe_correction(one)


def test_a_lift_added_and_removed_needs_no_correction():
    added = NO_CORRECTIONS.correct_lift(None, (7.0, 8.5))
    assert added.lifts == (ADDED,)
    assert added.correct_lift((7.0, 8.5), None) == NO_CORRECTIONS


def test_each_can_be_taken_back_alone():
    for one in ALL.all:
        left = ALL.remove(one)
        assert len(left.all) == len(ALL.all) - 1
        assert one not in left.all


def test_a_person_chosen_again_at_one_moment_replaces_the_earlier():
    again = PersonChoice(1.5, (200.0, 20.0, 300.0, 320.0))
    assert ALL.add(again).persons == (again,)
    later = PersonChoice(0.5, (0.0, 0.0, 9.0, 9.0))
    assert ALL.add(later).persons_in(0) == (later, PERSON)
    assert ALL.persons_in(1) == ()


@pytest.mark.parametrize(
    ("make", "says"),
    [
        (lambda: LiftCorrection(None, (3.0, 2.0)), "start before its end"),
        (lambda: LiftCorrection(None, (3.0, 3.0)), "start before its end"),
        (lambda: LiftCorrection(None, (3.0, float("inf"))), "start before its end"),
        (lambda: LiftCorrection(None, None), "needs times"),
        (lambda: NO_CORRECTIONS.correct_lift((1.0, 2.0), (2.0, 1.0)), "start before its end"),
        (lambda: ALL.correct_lift(None, (3.5, 4.0)), "can't overlap"),
        (lambda: PersonChoice(1.0, (10.0, 0.0, 5.0, 9.0)), "left < right"),
        (lambda: PersonChoice(float("nan"), (0.0, 0.0, 5.0, 9.0)), "a moment of the video"),
        (lambda: SideSwap(float("nan"), 1.0), "start before its end"),
        (lambda: Corrections(persons=(PERSON, PERSON)), "at one moment"),
    ],
)
def test_absurd_corrections_are_refused_in_one_sentence(make, says):
    with pytest.raises(ConfigError, match=says):
        make()
