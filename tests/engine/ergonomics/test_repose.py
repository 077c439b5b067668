"""Posing a lift for other places of the hands: the hands arrive, the body stays a body."""

import dataclasses

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from engine.datatypes import Status
from engine.ergonomics.methods.l5s1 import METHOD as L5S1
from engine.ergonomics.repose import HandShift, repose_lift
from engine.skeletons import BODY_SEGMENTS, MEDIAPIPE_33
from tests.engine.ergonomics.bending import END_S, START_S, bend_at, build_bending, hands_at

FEET = [MEDIAPIPE_33.index(f"{s}_{p}") for s in ("left", "right") for p in ("ankle", "big_toe")]
HANDS = [MEDIAPIPE_33.index(f"{s}_index") for s in ("left", "right")]


def pose(exposure, origin=(0.0, 0.0), destination=(0.0, 0.0)):
    return repose_lift(
        exposure.track,
        exposure.angles,
        exposure.lifts[0],
        origin=HandShift(*origin),
        destination=HandShift(*destination),
    )


def frame_at(exposure, time_s):
    return int(np.argmin(np.abs(exposure.track.time_s - time_s)))


def hands(found, frame):
    return found.track.position[frame, HANDS].mean(axis=0)


def compression(exposure, found):
    posed = dataclasses.replace(exposure, track=found.track, angles=found.angles)
    return L5S1.assess(posed).value


def test_without_a_shift_nothing_changes():
    exposure = build_bending()
    found = pose(exposure)
    assert found.track is exposure.track
    assert found.angles is exposure.angles
    assert not found.is_posed.any()


shifts = st.tuples(st.floats(-0.15, 0.08), st.floats(-0.05, 0.5))


@settings(max_examples=25, deadline=None)
@given(origin=shifts, destination=shifts, turn_deg=st.floats(0, 360))
def test_hands_arrive_and_limbs_keep_their_length(origin, destination, turn_deg):
    exposure = build_bending(turn_deg=turn_deg)
    found = pose(exposure, origin, destination)
    start, end = (frame_at(exposure, t) for t in (START_S, END_S))
    forward = hands_at(START_S, turn_deg) * [1, 0, 1]
    forward /= np.linalg.norm(forward)
    for frame, (away, up) in ((start, origin), (end, destination)):
        was = exposure.track.position[frame, HANDS].mean(axis=0)
        target = was + away * forward + np.array([0.0, up, 0.0])
        assert np.linalg.norm(hands(found, frame) - target) < 0.01 + found.unreached_m
    for name, a, b in BODY_SEGMENTS:
        one, two = (
            np.linalg.norm(
                t.position[:, MEDIAPIPE_33.index(a)] - t.position[:, MEDIAPIPE_33.index(b)], axis=1
            )
            for t in (exposure.track, found.track)
        )
        # A limb that is stretched to its end may give a little.
        assert np.abs(one - two).max() < 0.03 + found.unreached_m, name
    assert np.allclose(found.track.position[:, FEET], exposure.track.position[:, FEET])


def test_a_height_that_was_passed_takes_the_posture_of_that_moment():
    """Raising the start to where the hands were later: the trunk stands as it stood then."""
    exposure = build_bending()
    later_s = 1.9
    gap = hands_at(later_s) - hands_at(START_S)
    found = pose(exposure, (gap[0], gap[1]))
    start = frame_at(exposure, START_S)
    assert found.angles["trunk_inclination"][start] == pytest.approx(bend_at(later_s), abs=2.0)
    assert np.allclose(hands(found, start), hands_at(later_s), atol=0.01)
    assert found.unreached_m < 0.005


def test_the_reach_down_follows_the_raised_start():
    exposure = build_bending()
    gap = hands_at(1.9) - hands_at(START_S)
    found = pose(exposure, (gap[0], gap[1]))
    before = np.nanmax(exposure.angles["trunk_flexion"])
    assert np.nanmax(found.angles["trunk_flexion"]) < before - 25
    assert found.angles["trunk_flexion"][0] == pytest.approx(exposure.angles["trunk_flexion"][0])


@pytest.mark.parametrize("away", [-0.2, -0.1, 0.05])
def test_load_on_the_back_follows_the_distance(away):
    exposure = build_bending()
    now, then = (
        compression(exposure, pose(exposure)),
        compression(exposure, pose(exposure, (away, 0))),
    )
    assert (then < now) is (away < 0)


def test_turning_the_person_changes_nothing():
    values = []
    for turn in (0.0, 130.0):
        exposure = build_bending(turn_deg=turn)
        values.append(compression(exposure, pose(exposure, (-0.1, 0.2), (0.05, 0.3))))
    assert values[0] == pytest.approx(values[1], rel=1e-6)


def test_what_is_posed_is_less_certain_and_says_so():
    exposure = build_bending()
    found = pose(exposure, (0.0, 0.3))
    start, after = frame_at(exposure, START_S), -1
    assert found.is_posed[start]
    assert not found.is_posed[after]
    shoulder = MEDIAPIPE_33.index("left_shoulder")
    assert found.track.status[start, shoulder] == Status.FILLED
    assert found.track.sigma[start, shoulder] > 3 * exposure.track.sigma[start, shoulder]
    assert found.track.sigma[after, shoulder] == exposure.track.sigma[after, shoulder]
    assert (
        found.angles.sigma("trunk_flexion")[start] > exposure.angles.sigma("trunk_flexion")[start]
    )
    assert np.isnan(found.angles["pelvis_tilt"][start])
    assert found.angles["pelvis_tilt"][after] == exposure.angles["pelvis_tilt"][after]


def test_missing_points_stay_missing():
    exposure = build_bending(hidden=("left_elbow", "left_wrist", "left_index", "left_pinky"))
    found = pose(exposure, (-0.1, 0.2))
    elbow = MEDIAPIPE_33.index("left_elbow")
    assert np.isnan(found.track.position[:, elbow]).all()
    assert np.isfinite(found.track.position[:, MEDIAPIPE_33.index("right_elbow")]).all()
    assert found.is_posed.any()


def test_without_hands_nothing_is_posed():
    names = [n for n in MEDIAPIPE_33.keypoints if n.endswith(("wrist", "index", "pinky"))]
    exposure = build_bending(hidden=names)
    assert not pose(exposure, (-0.1, 0.2)).is_posed.any()


def test_a_place_beyond_the_arms_is_not_reached():
    assert pose(build_bending(), (1.2, 0.0)).unreached_m > 0.3
