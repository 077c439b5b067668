import dataclasses

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from engine.correction.chain import correct_track
from engine.correction.diagnosis import diagnose
from engine.correction.swaps import exchange_sides, find_swaps
from engine.datatypes import PoseTrack, Status
from engine.skeletons import H36M_17, get_skeleton

from .figures import make_walker, photograph

LOWER = ("hip", "knee", "ankle", "heel", "big_toe")
HEAD = ("eye_inner", "eye", "eye_outer", "ear", "mouth")


def columns_of(skeleton, parts):
    """Return the paired columns of `upper`, `lower`, `head` or `all`."""
    chosen = []
    for pair in skeleton.pairs:
        name = skeleton.keypoints[pair[0]].removeprefix("left_")
        group = "lower" if name in LOWER else "head" if name in HEAD else "upper"
        if parts in ("all", group):
            chosen += pair
    return chosen


def with_swap(track, frames, parts="all"):
    skeleton = get_skeleton(track.skeleton)
    mark = np.zeros(track.position.shape[:2], dtype=bool)
    mark[frames, np.array(columns_of(skeleton, parts))[:, None]] = True
    position = exchange_sides(np.asarray(track.position), mark, skeleton.mirror_order)
    return dataclasses.replace(track, position=position), mark


@pytest.mark.parametrize("parts", ["all", "upper", "lower"])
@pytest.mark.parametrize("skeleton", ["h36m_17", "mediapipe_33"])
@pytest.mark.parametrize("frames", [slice(40, 41), slice(40, 52), slice(0, 9), slice(100, 120)])
def test_exchanged_sides_are_found_to_the_frame(parts, skeleton, frames):
    truth = make_walker(skeleton=skeleton, noise_m=0.01)
    swapped, mark = with_swap(truth, frames, parts)
    found = diagnose(swapped, min_confidence=0.3)
    assert np.array_equal(found.swaps.is_exchanged, mark)
    assert np.array_equal(found.track.position, truth.position)
    assert (found.track.status[mark] == Status.REPAIRED).all()
    assert (found.track.status[~mark] == Status.MEASURED).all()
    (interval,) = found.swaps.intervals
    assert interval.parts == (parts,)
    assert (interval.start, interval.stop) == (frames.start, frames.stop)


def test_what_belongs_to_a_sample_goes_with_it():
    track = make_walker()
    confidence = np.full(track.position.shape[:2], 0.9)
    sigma = np.full_like(confidence, 0.02)
    left = H36M_17.index("left_wrist")
    confidence[:, left], sigma[:, left] = 0.8, 0.05
    swapped, mark = with_swap(track, slice(30, 40))
    order = list(H36M_17.mirror_order)
    swapped = dataclasses.replace(
        swapped,
        confidence=np.where(mark, confidence[:, order], confidence),
        sigma=np.where(mark, sigma[:, order], sigma),
    )
    repaired = diagnose(swapped, min_confidence=0.3).track
    assert np.array_equal(repaired.confidence, confidence)
    assert np.array_equal(repaired.sigma, sigma)


@pytest.mark.parametrize("parts", ["all", "upper", "lower"])
def test_exchanged_sides_in_a_picture(parts):
    picture = photograph(make_walker(n_frames=150), noise_px=2.0)
    swapped, mark = with_swap(picture, slice(60, 75), parts)
    assert np.array_equal(diagnose(swapped, min_confidence=0.3).swaps.is_exchanged, mark)


def test_half_a_clip_of_exchanged_sides_in_a_picture_is_not_decided():
    picture = photograph(make_walker(n_frames=60), noise_px=2.0)
    swapped, _ = with_swap(picture, slice(30, 60))
    corrected = correct_track(swapped)
    note = corrected.provenance["correction"]
    assert note["exchanged"] == 0
    assert len(note["possible_swaps"]) == 1
    assert any("may be exchanged" in w for w in note["warnings"])


def test_the_front_of_the_body_decides_where_most_frames_are_wrong():
    truth = make_walker(noise_m=0.01)
    swapped, mark = with_swap(truth, slice(0, 90))
    found = diagnose(swapped, min_confidence=0.3)
    assert np.array_equal(found.swaps.is_exchanged, mark)


@pytest.mark.parametrize("skeleton", ["h36m_17", "mediapipe_33"])
def test_right_labels_stay(skeleton):
    for track in (
        make_walker(skeleton=skeleton, noise_m=0.02),
        photograph(make_walker(skeleton=skeleton, noise_m=0.02), azimuth_deg=90.0, noise_px=3.0),
    ):
        assert not diagnose(track, min_confidence=0.3).swaps.is_exchanged.any()


def test_legs_that_pass_each_other_in_a_side_view_are_not_exchanged():
    side = photograph(make_walker(n_frames=300), azimuth_deg=90.0)
    found = diagnose(side, min_confidence=0.3).swaps
    assert not found.is_exchanged.any()


def test_a_mirrored_video_is_one_person_not_many_faults():
    # A mirror makes another person whose left is the first one's right; labels fit that person.
    track = make_walker(noise_m=0.01)
    position = np.asarray(track.position)[:, list(H36M_17.mirror_order)] * [1.0, 1.0, -1.0]
    mirrored = dataclasses.replace(track, position=position)
    assert not diagnose(mirrored, min_confidence=0.3).swaps.is_exchanged.any()
    # Labels that don't fit are wrong from the first frame to the last, never here and there.
    swapped, _ = with_swap(track, slice(None))
    exchanged = diagnose(swapped, min_confidence=0.3).swaps.is_exchanged
    paired = columns_of(H36M_17, "all")
    assert exchanged[:, paired].all() or not exchanged.any()


def test_a_body_turned_back_to_front_is_turned_again():
    world = make_walker(noise_m=0.005)
    about = world.position - world.position[:, [H36M_17.index("pelvis")]]
    # Seen by a camera in front: x to its right, y down, z away from it.
    body = np.stack([-about[..., 2], -about[..., 1], -about[..., 0]], axis=2)
    turned = body.copy()
    part = slice(50, 62)
    turned[part] = body[part][:, list(H36M_17.mirror_order)] * [1.0, 1.0, -1.0]
    track = PoseTrack(world.time_s, turned, "m", "body", "h36m_17")
    truth = dataclasses.replace(track, position=body)
    found = diagnose(track, min_confidence=0.3)
    error = np.abs(found.track.position - truth.position)[part]
    assert error.max() < 0.03


def test_coincident_and_missing_pairs_say_nothing():
    track = make_walker()
    position = np.array(track.position)
    position[:, 1:] = position[:, :1]
    for case in (position, np.full_like(position, np.nan), np.zeros_like(position)):
        found = find_swaps(track.time_s, case, H36M_17)
        assert not found.is_exchanged.any()
        assert found.intervals == ()


@settings(max_examples=15, deadline=None)
@given(
    angles=st.tuples(*[st.floats(-3.1, 3.1)] * 3),
    shift=st.tuples(*[st.floats(-50.0, 50.0)] * 3),
    scale=st.floats(0.2, 5.0),
)
def test_findings_do_not_depend_on_place_direction_or_size(angles, shift, scale):
    swapped, mark = with_swap(make_walker(noise_m=0.01, n_frames=60), slice(20, 29), "upper")
    turn = np.eye(3)
    for axis, angle in enumerate(angles):
        c, s = np.cos(angle), np.sin(angle)
        i, j = [(1, 2), (0, 2), (0, 1)][axis]
        step = np.eye(3)
        step[[i, i, j, j], [i, j, i, j]] = c, -s, s, c
        turn = step @ turn
    moved = dataclasses.replace(swapped, position=scale * swapped.position @ turn.T + shift)
    assert np.array_equal(diagnose(moved, min_confidence=0.3).swaps.is_exchanged, mark)


def test_repairing_twice_changes_nothing_more():
    swapped, _ = with_swap(make_walker(noise_m=0.01), slice(20, 30))
    once = diagnose(swapped, min_confidence=0.3).track
    twice = diagnose(once, min_confidence=0.3)
    assert not twice.swaps.is_exchanged.any()
    assert np.array_equal(twice.track.position, once.position)


@pytest.mark.parametrize("fps", [10.0, 15.0, 60.0, 240.0])
def test_every_frame_rate(fps):
    n_frames = int(4 * fps)
    part = slice(n_frames // 2, n_frames // 2 + max(1, int(0.3 * fps)))
    swapped, mark = with_swap(make_walker(n_frames=n_frames, fps=fps, noise_m=0.01), part)
    assert np.array_equal(diagnose(swapped, min_confidence=0.3).swaps.is_exchanged, mark)


def test_uneven_time_stamps():
    rng = np.random.default_rng(2)
    time_s = np.cumsum(rng.uniform(0.01, 0.08, 150))
    swapped, mark = with_swap(make_walker(time_s=time_s, noise_m=0.01), slice(70, 85))
    assert np.array_equal(diagnose(swapped, min_confidence=0.3).swaps.is_exchanged, mark)
