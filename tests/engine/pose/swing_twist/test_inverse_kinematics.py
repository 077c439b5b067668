"""Swing-twist inverse kinematics against exact rotations."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from engine.errors import ShapeError
from engine.pose.swing_twist.inverse_kinematics import (
    compute_swings,
    compute_twists,
    fit_rotation,
    place_joints,
    rotate_about,
    solve_posture,
    twist_about,
)
from engine.pose.swing_twist.skeleton29 import CHILDREN, JOINTS, PARENTS, RestSkeleton

from .builders import REST, human_rotations, random_rotations

BOTH = pytest.mark.parametrize("ik", ["adaptive", "naive"])
ENDS = [j for j in range(len(JOINTS)) if not CHILDREN[j]]
angles = st.floats(-3.1, 3.1)


def lengths_of(joints):
    return np.linalg.norm(joints[:, 1:] - joints[:, list(PARENTS[1:])], axis=2)


@BOTH
def test_round_trip(ik):
    rotation = random_rotations(300, seed=3)
    posed = place_joints(REST, rotation, root=np.random.default_rng(4).normal(size=(300, 3)))
    found = solve_posture(REST, posed.joints, compute_twists(REST, rotation), ik=ik)
    np.testing.assert_allclose(found.rotation, rotation, atol=1e-6)
    np.testing.assert_allclose(found.joints, posed.joints, atol=1e-9)


def test_adaptive_ends_nearer_to_noisy_joints_and_to_the_truth():
    rotation = human_rotations(400, seed=7)
    true = place_joints(REST, rotation).joints
    for sigma_m in (0.003, 0.006, 0.01):
        seen = true + np.random.default_rng(8).normal(0, sigma_m, true.shape)
        error = {}
        for ik in ("naive", "adaptive"):
            found = solve_posture(REST, seen, ik=ik).joints
            error[ik] = [
                np.linalg.norm(found[:, ENDS] - other[:, ENDS], axis=2).mean()
                for other in (seen, true)
            ]
        assert error["adaptive"][0] < 0.97 * error["naive"][0]
        assert error["adaptive"][1] < 0.97 * error["naive"][1]


def test_one_wrong_joint_does_not_bend_what_follows():
    """An elbow 5 cm off: beyond 15 mm the forearm keeps the direction that was seen."""
    true = place_joints(REST, human_rotations(50, seed=9)).joints
    seen = true.copy()
    shoulder, elbow, wrist, hand = (
        JOINTS.index(f"left_{p}") for p in ("shoulder", "elbow", "wrist", "hand")
    )
    along = true[:, elbow] - true[:, shoulder]
    seen[:, elbow : wrist + 1 : wrist - elbow] += 0.2 * along[:, None]
    seen[:, [hand, JOINTS.index("left_fingers")]] += 0.2 * along[:, None]

    def forearm(joints):
        vector = joints[:, wrist] - joints[:, elbow]
        return vector / np.linalg.norm(vector, axis=1, keepdims=True)

    guarded = solve_posture(REST, seen).joints
    np.testing.assert_allclose(forearm(guarded), forearm(true), atol=1e-9)
    greedy = solve_posture(REST, seen, max_deviation_m=1.0).joints
    assert np.abs(forearm(greedy) - forearm(true)).max() > 0.05


@BOTH
def test_bones_keep_their_lengths_whatever_was_seen(ik):
    seen = np.random.default_rng(1).normal(0, 1.0, (40, 29, 3))
    found = solve_posture(REST, seen, ik=ik)
    np.testing.assert_allclose(lengths_of(found.joints), np.tile(REST.lengths[1:], (40, 1)))
    unit = np.swapaxes(found.rotation, 2, 3) @ found.rotation
    np.testing.assert_allclose(unit, np.broadcast_to(np.eye(3), unit.shape), atol=1e-9)
    np.testing.assert_allclose(np.linalg.det(found.rotation), 1.0)


@BOTH
@settings(max_examples=25, deadline=None)
@given(seed=st.integers(0, 999), turn=st.tuples(angles, angles, angles))
def test_moving_the_whole_body_moves_only_the_root(ik, seed, turn):
    rng = np.random.default_rng(seed)
    seen = place_joints(REST, human_rotations(3, seed)).joints
    seen = seen + rng.normal(0, 0.01, seen.shape)
    twist = rng.uniform(-1, 1, (3, 23))
    x, y, z = np.eye(3)
    whole = rotate_about(x, turn[0]) @ rotate_about(y, turn[1]) @ rotate_about(z, turn[2])
    shift = rng.normal(size=3)
    before = solve_posture(REST, seen, twist, ik=ik)
    after = solve_posture(REST, seen @ whole.T + shift, twist, ik=ik)
    np.testing.assert_allclose(after.joints, before.joints @ whole.T + shift, atol=1e-8)
    np.testing.assert_allclose(after.rotation[:, 1:], before.rotation[:, 1:], atol=1e-7)
    np.testing.assert_allclose(after.rotation[:, 0], whole @ before.rotation[:, 0], atol=1e-8)


@settings(max_examples=25, deadline=None)
@given(factor=st.floats(0.4, 2.5), seed=st.integers(0, 999))
def test_the_size_does_not_matter(factor, seed):
    seen = place_joints(REST, human_rotations(2, seed)).joints
    large = RestSkeleton(factor * REST.position)
    np.testing.assert_allclose(
        solve_posture(large, factor * seen).rotation,
        solve_posture(REST, seen).rotation,
        atol=1e-9,
    )


@settings(max_examples=40, deadline=None)
@given(
    bone=st.tuples(*[st.floats(-1, 1)] * 3).filter(lambda v: np.linalg.norm(v) > 0.1),
    twist=st.floats(-3.1, 3.1),
    swing=st.floats(0.0, 3.0),
    seed=st.integers(0, 99),
)
def test_swing_then_twist_come_apart_again(bone, twist, swing, seed):
    bone = np.array(bone)
    axis = np.cross(bone, np.random.default_rng(seed).normal(size=3))
    turn = rotate_about(axis / np.linalg.norm(axis), np.array(swing))
    rotation = turn @ rotate_about(bone / np.linalg.norm(bone), np.array(twist))
    assert twist_about(bone, rotation[None])[0] == pytest.approx(twist, abs=1e-6)
    np.testing.assert_allclose(compute_swings(bone, (rotation @ bone)[None])[0], turn, atol=1e-6)


@pytest.mark.parametrize("sense", [1.0, -1.0], ids=["along", "opposite"])
@pytest.mark.parametrize("off", [0.0, 1e-12, 1e-8])
def test_swings_next_to_none_and_to_half_a_turn(sense, off):
    bone = np.array([0.3, -0.2, 0.5])
    target = sense * bone + off * np.array([1.0, 0.0, 0.0])
    swing = compute_swings(bone, target[None])[0]
    np.testing.assert_allclose(swing @ bone, sense * bone, atol=1e-7)
    np.testing.assert_allclose(swing.T @ swing, np.eye(3), atol=1e-9)
    assert np.linalg.det(swing) == pytest.approx(1.0)


def test_a_mirror_image_is_never_a_rotation():
    rest = REST.offsets[list(CHILDREN[0])]
    # Hips exchanged: a reflection would fit exactly.
    rotation = fit_rotation(rest, rest[None] * (1.0, 1.0, -1.0))
    assert np.linalg.det(rotation[0]) == pytest.approx(1.0)


def test_points_on_one_line_take_the_smallest_rotation():
    rest = np.array([[0.0, 1.0, 0.0], [0.0, 2.0, 0.0], [0.0, -1.0, 0.0]])
    rotation = fit_rotation(rest, rest[None, :, [1, 0, 2]])[0]
    np.testing.assert_allclose(rotation @ [0.0, 1.0, 0.0], [1.0, 0.0, 0.0], atol=1e-12)
    np.testing.assert_allclose(rotation @ [0.0, 0.0, 1.0], [0.0, 0.0, 1.0], atol=1e-12)


def test_what_hangs_on_a_missing_joint_is_missing():
    seen = place_joints(REST, human_rotations(4, seed=2)).joints
    whole = solve_posture(REST, seen)
    elbow = JOINTS.index("right_elbow")
    seen[1, elbow] = np.nan
    found = solve_posture(REST, seen)
    lost = [JOINTS.index(f"right_{p}") for p in ("elbow", "wrist", "hand", "fingers")]
    assert np.isnan(found.joints[1, lost]).all()
    kept = [j for j in range(29) if j not in lost]
    np.testing.assert_allclose(found.joints[1, kept], whole.joints[1, kept])
    np.testing.assert_allclose(found.joints[[0, 2, 3]], whole.joints[[0, 2, 3]])


def test_twist_turns_the_bone_about_itself_only():
    seen = place_joints(REST, human_rotations(5, seed=6)).joints
    twist = np.random.default_rng(0).uniform(-1, 1, (5, 23))
    with_twist, without = solve_posture(REST, seen, twist), solve_posture(REST, seen)
    np.testing.assert_allclose(with_twist.joints, without.joints, atol=1e-9)
    assert np.abs(with_twist.rotation - without.rotation).max() > 0.1


def test_wrong_shapes_are_named():
    with pytest.raises(ShapeError, match=r"\(T, 29, 3\), got \(5, 33, 3\)"):
        solve_posture(REST, np.zeros((5, 33, 3)))
    with pytest.raises(ShapeError, match=r"\(5, 23\), got \(5, 24\)"):
        solve_posture(REST, np.zeros((5, 29, 3)), np.zeros((5, 24)))
    with pytest.raises(ShapeError, match=r"\(T, 24, 3, 3\)"):
        place_joints(REST, np.zeros((5, 23, 3, 3)))
