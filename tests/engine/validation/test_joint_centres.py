from __future__ import annotations

import numpy as np
import pytest

from engine.errors import DataError
from engine.skeletons import get_skeleton
from engine.validation.joint_centres import (
    HALF_ELBOW_M,
    HALF_KNEE_M,
    build_pose_track,
    estimate_hip_centres,
    estimate_joint_centres,
    shift_inwards,
)
from engine.validation.profiles import ImportProfile
from engine.validation.reference.base import Recording
from engine.validation.reference.interpret import interpret
from tests.engine.validation.recordings import moving_markers, upright_markers


def reference(markers=None, **profile):
    labels, position = moving_markers(5, markers)
    recording = Recording("a.trc", "trc", np.arange(5) / 100.0, labels, position, length_unit="m")
    return interpret(recording, ImportProfile(**profile))


def without(*names):
    return {k: v for k, v in upright_markers().items() if k not in names}


def first(centres, name):
    return centres[name].position[0]


def test_joints_lie_half_way_between_two_markers():
    centres = estimate_joint_centres(reference())
    np.testing.assert_allclose(first(centres, "right_knee"), [0.02, 0.52, 0.10])
    np.testing.assert_allclose(first(centres, "left_ankle"), [0.0, 0.10, -0.10])
    np.testing.assert_allclose(first(centres, "right_elbow"), [0.0, 1.20, 0.20])
    np.testing.assert_allclose(first(centres, "left_wrist"), [0.05, 0.96, -0.21])
    assert centres["right_knee"].source == "half-way between two markers"


def test_hips_follow_the_regression_of_harrington():
    """By hand, in mm: width 240, depth 181.1; the pelvis leans by atan(20/180)."""
    left, right = np.array([[0.10, 1.00, -0.12]]), np.array([[0.10, 1.00, 0.12]])
    back = np.array([[-0.08, 1.02, 0.0]])
    depth = np.hypot(0.18, 0.02)
    x, y = np.array([0.18, -0.02, 0]) / depth, np.array([0.02, 0.18, 0]) / depth
    expected = (
        np.array([0.10, 1.0, 0.0])
        + (-0.24 * depth - 0.0099) * x
        + (-0.30 * 0.24 - 0.0109) * y
        + (0.33 * 0.24 + 0.0073) * np.array([0, 0, 1])
    )
    left_hip, right_hip = estimate_hip_centres(left, right, back)
    np.testing.assert_allclose(right_hip[0], expected)
    np.testing.assert_allclose(left_hip[0], expected * [1, 1, -1])


def test_hips_follow_the_regression_of_bell():
    """14 % medial, 30 % distal and 19 % posterior of the spine, in a level pelvis."""
    left, right = np.array([[0.0, 1.0, -0.12]]), np.array([[0.0, 1.0, 0.12]])
    back = np.array([[-0.15, 1.0, 0.0]])
    _, right_hip = estimate_hip_centres(left, right, back, method="bell")
    np.testing.assert_allclose(right_hip[0], [-0.19 * 0.24, 1.0 - 0.30 * 0.24, 0.12 - 0.14 * 0.24])


def test_hips_turn_with_the_pelvis():
    rng = np.random.default_rng(2)
    turn = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    turn *= np.sign(np.linalg.det(turn))
    points = [np.array([p]) for p in ((0.1, 1.0, -0.12), (0.1, 1.0, 0.12), (-0.08, 1.02, 0.0))]
    plain = estimate_hip_centres(*points)
    turned = estimate_hip_centres(*(p @ turn.T for p in points))
    for a, b in zip(plain, turned, strict=True):
        np.testing.assert_allclose(a @ turn.T, b)


def test_a_sacral_marker_stands_in_for_both_posterior_spines():
    markers = without("LPSI", "RPSI") | {"SACR": (-0.08, 1.02, 0.0)}
    with_sacrum = estimate_joint_centres(reference(markers))
    plain = estimate_joint_centres(reference())
    np.testing.assert_allclose(first(with_sacrum, "left_hip"), first(plain, "left_hip"))


def test_without_a_marker_at_the_back_there_are_no_hips():
    centres = estimate_joint_centres(reference(without("LPSI", "RPSI")))
    assert "left_hip" not in centres
    assert "left_knee" in centres


def test_shoulders_lie_below_the_acromion_by_a_share_of_the_width():
    centres = estimate_joint_centres(reference())
    right = first(centres, "right_shoulder")
    drop = np.linalg.norm(right - [0.0, 1.50, 0.18])
    assert drop == pytest.approx(0.17 * 0.36)
    assert right[1] < 1.45
    assert right[2] == pytest.approx(0.18)


def test_an_outer_marker_alone_gives_a_centre_inwards():
    centres = estimate_joint_centres(reference(without("RMKNE", "RMEL", "RMED")))
    knee = first(centres, "right_knee")
    np.testing.assert_allclose(np.linalg.norm(knee - [0.02, 0.52, 0.15]), HALF_KNEE_M)
    assert knee[2] == pytest.approx(0.15 - HALF_KNEE_M, abs=0.006)
    elbow = first(centres, "right_elbow")
    assert elbow[2] == pytest.approx(0.24 - HALF_ELBOW_M, abs=0.008)
    assert "assumed width" in centres["right_knee"].source
    assert "half-way" in centres["left_knee"].source


@pytest.mark.parametrize("flexion_deg", [0.0, 20.0, 90.0, 130.0])
@pytest.mark.parametrize("toe_out_deg", [0.0, 25.0])
def test_the_bent_limb_shows_its_axis(flexion_deg, toe_out_deg):
    """A right leg whose plane is turned outwards; its outer markers lie 5 cm outside."""
    turn, bend = np.radians(toe_out_deg), np.radians(flexion_deg)
    front = np.array([np.cos(turn), 0.0, np.sin(turn)])
    axis = np.cross(front, [0.0, 1.0, 0.0])  # to the right of that plane
    knee = np.array([0.0, 0.5, 0.1])
    hip = knee + 0.4 * (-front * np.sin(bend / 2) + np.array([0, 1, 0]) * np.cos(bend / 2))
    ankle = knee + 0.4 * (-front * np.sin(bend / 2) - np.array([0, 1, 0]) * np.cos(bend / 2))
    centre = shift_inwards(
        hip[None],
        (knee + 0.05 * axis)[None],
        (ankle + 0.05 * axis)[None],
        across=np.array([[0.0, 0.0, -1.0]]),
        half_width_m=0.05,
        distal_half_width_m=0.05,
    )[0]
    # A straight leg does not show its plane: the error is then that of the assumed direction.
    worst = 0.05 * 2 * np.sin(turn / 2) if flexion_deg < 10 else 0.012
    assert np.linalg.norm(centre - knee) <= worst + 1e-9


def test_a_missing_marker_is_a_missing_joint():
    labels, position = moving_markers(5)
    position[2, labels.index("RKNE")] = np.nan
    recording = Recording("a", "trc", np.arange(5) / 100.0, labels, position, length_unit="m")
    centres = estimate_joint_centres(interpret(recording))
    missing = np.isnan(centres["right_knee"].position).all(axis=1)
    np.testing.assert_array_equal(missing, [False, False, True, False, False])


def test_the_track_has_our_names_and_its_sources():
    track = build_pose_track(reference())
    skeleton = get_skeleton("h36m_17")
    assert (track.unit, track.frame_of_reference) == ("m", "world")
    pelvis = skeleton.point(track.position, "pelvis")
    hips = [track.position[:, skeleton.index(f"{s}_hip")] for s in ("left", "right")]
    np.testing.assert_allclose(pelvis, (hips[0] + hips[1]) / 2)
    for name in ("spine", "nose", "head"):
        assert np.isnan(track.position[:, skeleton.index(name)]).all()
    assert "Harrington" in track.provenance["sources"]["left_hip"]


def test_a_larger_skeleton_gets_feet_and_hands():
    track = build_pose_track(reference(), skeleton="mediapipe_33")
    toe = track.position[0, get_skeleton("mediapipe_33").index("right_big_toe")]
    np.testing.assert_allclose(toe, [0.16, 0.03, 0.11])


def test_keypoints_of_ours_are_taken_as_they_are():
    markers = {
        "left_hip": (0, 0.9, -0.1),
        "right_hip": (0, 0.9, 0.1),
        "left_knee": (0, 0.5, -0.1),
        "right_knee": (0, 0.5, 0.1),
        "left_ankle": (0, 0.1, -0.1),
        "right_ankle": (0, 0.1, 0.1),
    }
    centres = estimate_joint_centres(reference(markers))
    np.testing.assert_allclose(first(centres, "left_knee"), [0, 0.5, -0.1])
    assert centres["left_knee"].source == "marker of that name"


def test_exchanged_sides_are_refused_with_the_remedy():
    other = {"L": "R", "R": "L"}
    markers = {
        f"{other[k[0]]}{k[1:]}" if k not in ("C7", "CLAV") else k: v
        for k, v in upright_markers().items()
    }
    with pytest.raises(DataError, match="left and right look exchanged"):
        build_pose_track(reference(markers))
    repaired = build_pose_track(reference(markers, swap_sides=True))
    np.testing.assert_allclose(repaired.position, build_pose_track(reference()).position)


def test_a_body_no_person_has_is_refused():
    markers = upright_markers() | {"RKNE": (0.02, 0.95, 0.15), "RMKNE": (0.02, 0.95, 0.05)}
    with pytest.raises(DataError, match=r"right thigh measures 0\.\d+ m, expected 0\.25 to 0\.6"):
        build_pose_track(reference(markers))


def test_unknown_labels_are_refused_with_the_remedy():
    markers = {f"M{i}": v for i, v in enumerate(upright_markers().values())}
    with pytest.raises(DataError, match=r"No label of a\.trc is known.*import profile"):
        build_pose_track(reference(markers))
