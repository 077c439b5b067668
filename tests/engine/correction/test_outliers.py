import dataclasses

import numpy as np
import pytest

from engine.correction.jumps import find_bumps
from engine.correction.links import measure_links
from engine.correction.outliers import find_outliers
from engine.skeletons import H36M_17, MEDIAPIPE_33, get_skeleton

from .figures import make_walker


def find(track):
    links = measure_links(track)
    return find_outliers(
        track.time_s, np.asarray(track.position), links, get_skeleton(track.skeleton)
    )


def moved(track, frames, names, offset):
    position = np.array(track.position)
    skeleton = get_skeleton(track.skeleton)
    for name in names:
        position[frames, skeleton.index(name)] += offset
    return dataclasses.replace(track, position=position)


@pytest.mark.parametrize("noise_m", [0.0, 0.01])
def test_right_joints_are_left_alone(noise_m):
    found = find(make_walker(noise_m=noise_m))
    assert not found.is_rejected.any()
    assert not found.is_unsteady.any()


@pytest.mark.parametrize(
    ("wrong", "blamed"),
    [
        ("left_wrist", {"left_wrist"}),
        ("right_ankle", {"right_ankle"}),
        ("left_elbow", {"left_elbow", "left_wrist"}),
        ("right_knee", {"right_knee", "right_ankle"}),
        ("left_hip", {"left_hip", "left_knee", "left_ankle"}),
    ],
)
def test_the_joint_that_explains_the_links_goes_with_those_beyond_it(wrong, blamed):
    track = moved(make_walker(noise_m=0.005), slice(40, 46), [wrong], [0.05, 0.3, 0.12])
    found = find(track)
    rejected = {H36M_17.keypoints[k] for k in np.flatnonzero(found.is_rejected.any(axis=0))}
    assert wrong in rejected
    assert rejected <= blamed
    assert np.flatnonzero(found.is_rejected.any(axis=1)).tolist() == list(range(40, 46))


def test_fingers_and_toes_go_with_their_limb():
    part = ["left_wrist", "left_index", "left_thumb", "left_pinky"]
    track = moved(make_walker(skeleton="mediapipe_33"), slice(40, 46), part, [0.0, 0.3, 0.1])
    found = find(track)
    rejected = {MEDIAPIPE_33.keypoints[k] for k in np.flatnonzero(found.is_rejected[42])}
    assert rejected == set(part)


def test_a_lost_person_is_no_single_joint():
    track = make_walker()
    position = np.array(track.position)
    position[50:54] += 0.4 * np.random.default_rng(0).standard_normal(position[50:54].shape)
    found = find(dataclasses.replace(track, position=position))
    assert np.flatnonzero(found.is_lost).tolist() == [50, 51, 52, 53]
    assert found.is_rejected[50:54].all()
    assert not found.is_misdetected[50:54].any()


def test_a_joint_that_keeps_its_distance_is_found_by_its_jumps():
    track = make_walker()
    elbow, wrist = (
        np.asarray(track.position)[:, H36M_17.index(f"left_{k}")] for k in ("elbow", "wrist")
    )
    position = np.array(track.position)
    # Turned about the elbow by a half circle: the forearm keeps its length.
    position[60:67, H36M_17.index("left_wrist")] = (2 * elbow - wrist)[60:67]
    turned = dataclasses.replace(track, position=position)
    np.testing.assert_allclose(measure_links(turned).length_cm, measure_links(track).length_cm)
    found = find(turned)
    assert np.argwhere(found.is_rejected).tolist() == [
        [t, H36M_17.index("left_wrist")] for t in range(60, 67)
    ]


class TestJumps:
    def test_a_fast_movement_out_and_back_is_no_jump(self):
        track = make_walker()
        # A punch: 0.5 m out and back within half a second, at 6 m/s.
        out = 0.5 * np.exp(-(((track.time_s - 2.0) / 0.08) ** 2))
        position = np.array(track.position)
        position[:, H36M_17.index("left_wrist"), 0] += out
        assert not find_bumps(track.time_s, position, H36M_17).any()

    def test_a_jump_that_does_not_come_back_is_left(self):
        track = moved(make_walker(), slice(60, None), ["left_wrist"], [0.0, 0.3, 0.0])
        assert not find_bumps(track.time_s, np.asarray(track.position), H36M_17).any()

    def test_one_that_comes_back_too_late_is_left(self):
        track = moved(make_walker(), slice(50, 110), ["left_wrist"], [0.0, 0.3, 0.0])
        assert not find_bumps(track.time_s, np.asarray(track.position), H36M_17).any()

    @pytest.mark.parametrize("n_frames", [0, 1, 2, 3])
    def test_too_few_frames(self, n_frames):
        track = make_walker(n_frames=n_frames)
        assert not find_bumps(track.time_s, np.asarray(track.position), H36M_17).any()


def test_small_alternating_jumps_are_jitter():
    track = make_walker()
    names = [H36M_17.index(f"left_{part}") for part in ("elbow", "wrist")]
    forearm = np.diff(np.asarray(track.position)[60:62, names], axis=1)[:, 0]
    along = forearm / np.linalg.norm(forearm, axis=1, keepdims=True) * [[0.025], [-0.025]]
    found = find(moved(track, slice(60, 62), ["left_wrist"], along))
    assert np.flatnonzero(found.is_jitter.any(axis=1)).tolist() == [60, 61, 62]
    assert not found.is_rejected.any()
