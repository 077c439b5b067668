"""The twist network: what it sees, and that it tells more than no twist."""

from __future__ import annotations

import numpy as np
import pytest

from engine.errors import BackendUnavailable
from engine.pose.swing_twist import twist as module
from engine.pose.swing_twist.inverse_kinematics import (
    place_joints,
    rotate_about,
    solve_posture,
)
from engine.pose.swing_twist.skeleton29 import JOINTS, PARENTS
from engine.pose.swing_twist.twist import MODEL_PATH, TwistNetwork, normalise_joints
from engine.training.twist import disturb, twist_errors
from engine.training.twist_postures import (
    draw_segments,
    find_twists,
    joint_rotations,
    make_examples,
)

from .builders import REST, human_rotations

JOINTS_SEEN = place_joints(REST, human_rotations(8, seed=1)).joints
TURN = rotate_about(np.array([0.0, 0.6, 0.8]), np.array(2.0))


@pytest.fixture(scope="module")
def network() -> TwistNetwork:
    return TwistNetwork()


def test_place_heading_and_size_are_not_seen():
    moved = 1.3 * JOINTS_SEEN @ TURN.T + (1.0, 2.0, 3.0)
    np.testing.assert_allclose(normalise_joints(moved), normalise_joints(JOINTS_SEEN), atol=1e-5)


def test_limbs_are_told_better_than_by_no_twist(network):
    rng = np.random.default_rng(77)
    examples = make_examples(draw_segments(1500, rng), rng)
    twist, sure = network.estimate(disturb(examples.joints, rng))
    told = twist_errors(twist, examples)
    none = twist_errors(np.zeros_like(twist), examples)
    for part, share in (("hip", 0.8), ("shoulder", 0.6), ("elbow", 0.6)):
        rows = [JOINTS.index(f"{side}_{part}") - 1 for side in ("left", "right")]
        assert told[rows].mean() < share * none[rows].mean()
    assert ((sure >= 0) & (sure <= 1)).all()


def test_a_missing_joint_gives_no_twist(network):
    joints = JOINTS_SEEN.copy()
    joints[3, JOINTS.index("left_wrist")] = np.nan
    twist, sure = network.estimate(joints)
    assert np.isnan(twist[3]).all()
    assert (sure[3] == 0).all()
    assert np.isfinite(np.delete(twist, 3, axis=0)).all()


def test_true_twists_lead_back_to_true_rotations():
    """Limbs of landmarks on a straight spine still reach the true rotation by the twist found."""
    rng = np.random.default_rng(5)
    segments = draw_segments(50, rng)
    world = joint_rotations(segments)
    local = world.copy()
    leg = [JOINTS.index(n) for n in ("left_hip", "left_knee", "left_ankle")]
    local[:, 1:] = np.swapaxes(world[:, list(PARENTS[1:24])], 2, 3) @ world[:, 1:]
    joints = place_joints(REST, local).joints
    twist = find_twists(joints, world)
    found = solve_posture(REST, joints, twist).rotation
    turned = found[:, 0]
    for joint in leg:
        turned = turned @ found[:, joint]
        np.testing.assert_allclose(turned, world[:, joint], atol=1e-6)


def test_a_missing_or_changed_file_is_said(tmp_path, monkeypatch):
    with pytest.raises(BackendUnavailable, match=r"none\.onnx is missing"):
        TwistNetwork(tmp_path / "none.onnx")
    changed = tmp_path / MODEL_PATH.name
    changed.write_bytes(MODEL_PATH.read_bytes()[:-1] + b"\x00")
    monkeypatch.setattr(module, "MODEL_PATH", changed)
    with pytest.raises(BackendUnavailable, match="not the one that was shipped"):
        TwistNetwork(changed)
