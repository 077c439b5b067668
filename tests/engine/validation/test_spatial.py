from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from engine.datatypes import PoseTrack
from engine.errors import ConfigError, DataError, ShapeError, UnitError
from engine.skeletons import get_skeleton
from engine.validation.resampling import resample_positions, shift_positions
from engine.validation.spatial import align_positions, compare_segment_lengths

RNG = np.random.default_rng(3)
BODY = RNG.normal(0.0, 0.5, (20, 17, 3))


def track(position, *, time_s=None, unit="m", frame="world"):
    time = np.arange(len(position)) / 30.0 if time_s is None else time_s
    return PoseTrack(time, position, unit, frame, "h36m_17")


@settings(max_examples=30, deadline=None)
@given(
    turn=st.tuples(*[st.floats(-3.0, 3.0)] * 3),
    shift=st.tuples(*[st.floats(-5.0, 5.0)] * 3),
    scale=st.floats(0.5, 2.0),
)
def test_a_similarity_is_found_exactly(turn, shift, scale):
    rotation = Rotation.from_rotvec(turn)
    moved = scale * rotation.apply(BODY.reshape(-1, 3)).reshape(BODY.shape) + shift
    found = align_positions(track(BODY), track(moved), mode="similarity")
    np.testing.assert_allclose(found.apply(BODY), moved, atol=1e-9)
    np.testing.assert_allclose(found.rotation, rotation.as_matrix(), atol=1e-9)
    assert found.scale == pytest.approx(scale)
    assert found.rms_m < 1e-9


def test_rigid_leaves_a_wrong_size_to_be_seen():
    found = align_positions(track(BODY), track(1.1 * BODY + 2.0), mode="rigid")
    assert found.scale == 1.0
    centred = BODY.reshape(-1, 3) - BODY.reshape(-1, 3).mean(axis=0)
    expected = 0.1 * np.sqrt((centred**2).sum(axis=1).mean())
    assert found.rms_m == pytest.approx(expected)
    np.testing.assert_allclose(found.rotation, np.eye(3), atol=1e-9)


def test_none_changes_nothing():
    found = align_positions(track(BODY), track(BODY + np.array([0.3, 0.0, 0.4])), mode="none")
    np.testing.assert_array_equal(found.apply(BODY), BODY)
    assert found.rms_m == pytest.approx(0.5)


def test_a_mirror_image_is_never_fitted():
    found = align_positions(track(BODY), track(BODY * [1, 1, -1]), mode="similarity")
    assert np.linalg.det(found.rotation) == pytest.approx(1.0)
    assert found.rms_m > 0.1


def test_turn_and_tilt_are_stated():
    heading = Rotation.from_euler("y", 40, degrees=True)
    moved = heading.apply(BODY.reshape(-1, 3)).reshape(BODY.shape)
    found = align_positions(track(BODY), track(moved))
    assert found.turn_deg == pytest.approx(40.0)
    assert found.tilt_deg == pytest.approx(0.0, abs=1e-5)


def test_missing_samples_are_left_out():
    gappy = np.array(BODY)
    gappy[3, 5] = gappy[4:6] = np.nan
    found = align_positions(track(gappy), track(BODY + 1.0))
    assert found.n_points == 20 * 17 - 1 - 2 * 17
    np.testing.assert_allclose(found.translation_m, 1.0, atol=1e-9)


def test_what_can_not_be_aligned_is_one_plain_sentence():
    with pytest.raises(ConfigError, match="mode must be one of"):
        align_positions(track(BODY), track(BODY), mode="affine")
    with pytest.raises(UnitError, match="1000 times the size"):
        align_positions(track(BODY), track(BODY * 1000))
    flat = track(BODY[..., :2], unit="px", frame="image")
    with pytest.raises(ShapeError, match=r"result is 2D in px.*Compare its angles"):
        align_positions(flat, track(BODY))
    with pytest.raises(ShapeError, match="same times"):
        align_positions(track(BODY), track(BODY[:-1]))
    with pytest.raises(DataError, match="fewer than three points"):
        align_positions(track(BODY), track(BODY * np.nan))
    line = BODY[..., :1] * np.array([1.0, 2.0, 3.0])
    with pytest.raises(DataError, match="lie on one line"):
        align_positions(track(line), track(line))


def test_positions_at_other_times_lie_on_straight_lines():
    time = np.arange(20) / 30.0
    straight = time[:, None, None] * np.ones((1, 17, 3))
    gappy = np.array(straight)
    gappy[8:15] = np.nan
    wanted = np.array([0.01, 0.2, 0.35, 0.6, 0.9])
    got = resample_positions(track(gappy, time_s=time), wanted).position[:, 0, 0]
    np.testing.assert_allclose(got, [0.01, 0.2, np.nan, 0.6, np.nan])


def test_a_track_can_be_shifted_in_time():
    assert shift_positions(track(BODY), 2.5).time_s[0] == 2.5


def body(scale=1.0):
    """Return a still body with known limbs, shape (3, 17, 3)."""
    skeleton = get_skeleton("h36m_17")
    position = np.full((3, 17, 3), np.nan)
    for side, z in (("left", -0.1), ("right", 0.1)):
        for joint, height in (("hip", 0.9), ("knee", 0.5), ("ankle", 0.1)):
            position[:, skeleton.index(f"{side}_{joint}")] = (0.0, height, z)
    return scale * position


def test_segments_of_one_person_are_compared_without_a_word():
    lengths = compare_segment_lengths(track(body()), track(body(1.05)))
    assert "left_thigh" in lengths.names
    assert "left_forearm" not in lengths.names
    assert lengths.result_m[lengths.names.index("left_thigh")] == pytest.approx(0.4)
    assert lengths.reference_m[lengths.names.index("left_thigh")] == pytest.approx(0.42)
    assert lengths.notes == ()


def test_another_person_is_suspected():
    lengths = compare_segment_lengths(track(body(1.25)), track(body()))
    assert "25 % longer" in lengths.notes[0]
    assert compare_segment_lengths(track(body()), track(body() * np.nan)).names == ()
