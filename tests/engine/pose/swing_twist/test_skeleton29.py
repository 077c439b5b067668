"""The plain skeleton: names, tree, proportions."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest

from engine.errors import ConfigError, ShapeError
from engine.pose.swing_twist.skeleton29 import (
    BRANCHING,
    CHILDREN,
    JOINTS,
    N_TURNING,
    ONLY_CHILD,
    PARENTS,
    RestSkeleton,
    measure_lengths,
    mirror_order,
)

from .builders import REST

UPPER_BODY = ("spine_low", "spine_mid", "spine_high", "neck", "head", "head_top")


def test_the_tree_has_24_turning_joints_and_five_ends():
    assert len(JOINTS) == len(set(JOINTS)) == len(PARENTS) == 29
    ends = [JOINTS[j] for j in range(29) if not CHILDREN[j]]
    assert ends == ["head_top", "left_fingers", "right_fingers", "left_big_toe", "right_big_toe"]
    assert all(parent < joint for joint, parent in enumerate(PARENTS))
    assert [JOINTS[j] for j in BRANCHING] == ["pelvis", "spine_high"]
    assert sorted([*ONLY_CHILD, *BRANCHING]) == list(range(N_TURNING))


def test_limb_joints_have_the_published_columns():
    """The twelve joints of the cost of Choi et al. in the published order of 29."""
    columns = {"shoulder": (16, 17), "elbow": (18, 19), "wrist": (20, 21)}
    columns |= {"hip": (1, 2), "knee": (4, 5), "ankle": (7, 8)}
    for part, (left, right) in columns.items():
        assert JOINTS[left] == f"left_{part}"
        assert JOINTS[right] == f"right_{part}"


def test_left_mirrors_right():
    mirrored = REST.position[mirror_order()] * (1.0, 1.0, -1.0)
    np.testing.assert_allclose(mirrored, REST.position, atol=1e-12)


def test_proportions_are_those_of_an_adult():
    at = dict(zip(JOINTS, REST.position, strict=True))
    assert at["right_shoulder"][2] > 0 > at["left_shoulder"][2]
    assert all(at[a][1] < at[b][1] for a, b in pairwise(UPPER_BODY))
    ankle_to_top = at["head_top"][1] - at["left_ankle"][1]
    assert ankle_to_top == pytest.approx(1.75 * (1 - 0.039), abs=0.02)
    assert np.linalg.norm(at["left_knee"] - at["left_hip"]) == pytest.approx(0.245 * 1.75)
    assert REST.lengths[0] == 0.0


def test_other_lengths_keep_the_directions():
    wanted = 1.3 * REST.lengths
    wanted[JOINTS.index("head")] = np.nan
    longer = REST.with_lengths(wanted)
    expected = np.where(np.isfinite(wanted), wanted, REST.lengths)
    np.testing.assert_allclose(longer.lengths, expected)
    cosine = (longer.offsets * REST.offsets).sum(axis=1)[1:]
    np.testing.assert_allclose(cosine, (longer.lengths * REST.lengths)[1:])


def test_measured_lengths_are_medians_of_both_sides():
    joints = np.repeat(REST.position[None], 5, axis=0)
    joints[0, JOINTS.index("left_wrist")] += (0.0, 0.0, -5.0)
    joints[:, JOINTS.index("right_big_toe")] = np.nan
    joints[:, JOINTS.index("head_top")] = np.nan
    lengths = measure_lengths(joints)
    seen = np.isfinite(lengths)
    np.testing.assert_allclose(lengths[seen], REST.lengths[seen])
    assert [JOINTS[j] for j in np.flatnonzero(~seen)] == ["head_top"]


@pytest.mark.parametrize("stature", [0.0, 175.0, np.nan])
def test_a_stature_in_another_unit_is_refused(stature):
    with pytest.raises(ConfigError, match=r"between 0\.5 and 2\.6 m"):
        RestSkeleton.from_stature(stature)


def test_a_bone_without_length_is_named():
    position = REST.position.copy()
    position[JOINTS.index("left_knee")] = position[JOINTS.index("left_hip")]
    with pytest.raises(ShapeError, match="left_knee"):
        RestSkeleton(position)
    with pytest.raises(ShapeError, match=r"\(29, 3\)"):
        RestSkeleton(position[:24])
    with pytest.raises(ShapeError, match=r"\(29,\)"):
        REST.with_lengths([1.0])
