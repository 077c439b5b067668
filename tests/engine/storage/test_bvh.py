"""BVH files move the figure as the person moved, to an independent parser."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from bvh import Bvh
from scipy.spatial.transform import Rotation

from engine.datatypes import Array, BodyFit, PoseTrack
from engine.errors import DataError, UnitError
from engine.skeletons import get_skeleton
from engine.storage.bvh import write_bvh
from tests.builders import make_pose_track

SKELETON = get_skeleton("mediapipe_33")
ENDS = {
    "LeftUpLeg": "left_hip",
    "LeftLeg": "left_knee",
    "LeftFoot": "left_ankle",
    "RightUpLeg": "right_hip",
    "RightLeg": "right_knee",
    "RightFoot": "right_ankle",
    "LeftArm": "left_shoulder",
    "LeftForeArm": "left_elbow",
    "LeftHand": "left_wrist",
    "RightArm": "right_shoulder",
    "RightForeArm": "right_elbow",
    "RightHand": "right_wrist",
}
LENGTHS_M = {
    "thigh": 0.42, "shank": 0.41, "foot": 0.2, "upper_arm": 0.29, "forearm": 0.25, "hand": 0.1,
}  # fmt: skip


def rigid_track(n_frames: int = 50, seed: int = 3) -> PoseTrack:
    """Make a figure of rigid segments that turns, bends and swings all limbs widely."""
    rng = np.random.default_rng(seed)
    share = np.linspace(0, 1, n_frames)
    position = np.full((n_frames, len(SKELETON.keypoints), 3), np.nan)

    def put(name: str, where: Array) -> None:
        position[:, SKELETON.index(name)] = where

    def swing(size: float) -> Rotation:
        axis, phase = rng.normal(size=3), rng.uniform(0, 6)
        angle = size * np.sin(3 * share + phase)
        return Rotation.from_rotvec(angle[:, None] * axis / np.linalg.norm(axis))

    pelvis = np.stack([share, 0.9 - 0.3 * share, 0.2 * share], axis=1)
    hips, chest = swing(2.5), swing(1.2)
    thorax = pelvis + (hips * chest).apply([0, 0.5, 0])
    put("left_ear", thorax + (hips * chest).apply([0.05, 0.25, -0.07]))
    put("right_ear", thorax + (hips * chest).apply([0.05, 0.25, 0.07]))
    for side, z in (("left", -1), ("right", 1)):
        leg, arm = hips * swing(1.5), hips * chest * swing(2.5)
        joint = pelvis + hips.apply([0, 0, 0.09 * z])
        put(f"{side}_hip", joint)
        for part, name, down in (
            ("thigh", "knee", [0, -1, 0]),
            ("shank", "ankle", [0, -1, 0]),
            ("foot", "big_toe", [1, 0, 0]),
        ):
            joint = joint + LENGTHS_M[part] * leg.apply(down)
            leg = leg * swing(0.8)
            put(f"{side}_{name}", joint)
        joint = thorax + (hips * chest).apply([0, 0, 0.18 * z])
        put(f"{side}_shoulder", joint)
        for part, name in (("upper_arm", "elbow"), ("forearm", "wrist"), ("hand", "index")):
            joint = joint + LENGTHS_M[part] * arm.apply([0, -1, 0])
            arm = arm * swing(1.0)
            put(f"{side}_{name}", joint)
    return PoseTrack(np.arange(n_frames) / 30, position, "m", "world", "mediapipe_33")


def parse(path: Path) -> Bvh:
    return Bvh(path.read_text(encoding="ascii"))


def replay(file: Bvh) -> dict[str, Array]:
    """Return where the joints of the figure are, (T, 3) in world metres."""
    found: dict[str, tuple[Array, Rotation]] = {}
    for name in file.get_joints_names():
        offset = np.array(file.joint_offset(name))
        angles = np.array(file.frames_joint_channels(name, ["Zrotation", "Xrotation", "Yrotation"]))
        turn = Rotation.from_euler("ZXY", angles, degrees=True)
        parent = file.joint_parent(name)
        if parent is None:
            channels = ["Xposition", "Yposition", "Zposition"]
            found[name] = np.array(file.frames_joint_channels(name, channels)), turn
            continue
        place, above = found[parent.name]
        found[name] = place + above.apply(offset), above * turn
    to_world = np.array([[0, 0, 1], [0, 1, 0], [-1, 0, 0]]) / 100
    return {name: place @ to_world.T for name, (place, _) in found.items()}


@pytest.mark.parametrize("seed", range(5))
def test_a_rigid_figure_is_replayed_within_a_millimetre(tmp_path: Path, seed: int) -> None:
    track = rigid_track(seed=seed)
    write_bvh(track, tmp_path / "a.bvh")
    joints = replay(parse(tmp_path / "a.bvh"))
    for name, keypoint in ENDS.items():
        truth = track.position[:, SKELETON.index(keypoint)]
        assert np.abs(joints[name] - truth).max() < 1e-3, name


def test_head_toes_and_finger_tips_end_their_bones(tmp_path: Path) -> None:
    track = rigid_track()
    write_bvh(track, tmp_path / "a.bvh")
    lines = (tmp_path / "a.bvh").read_text().splitlines()
    tips = [
        np.array(lines[i + 2].split()[1:], float)
        for i, line in enumerate(lines)
        if line.strip() == "End Site"
    ]
    lengths = sorted(float(np.linalg.norm(tip)) for tip in tips)
    head = np.hypot(5, 25)
    assert lengths == pytest.approx([10, 10, 20, 20, head], abs=1e-3)


def test_frames_and_rate_are_those_of_the_video(tmp_path: Path) -> None:
    write_bvh(rigid_track(n_frames=31), tmp_path / "a.bvh")
    file = parse(tmp_path / "a.bvh")
    assert file.nframes == 31
    assert file.frame_time == pytest.approx(1 / 30)


def test_uneven_times_are_made_even_between_true_samples(tmp_path: Path) -> None:
    track = rigid_track(n_frames=41)
    time_s = np.cumsum(np.tile([0.02, 0.04], 21))[:41]
    pelvis = np.column_stack([time_s, np.ones(41), np.zeros(41)])
    position = track.position[:1] - SKELETON.point(track.position[:1], "pelvis")[:, None]
    track = replace(track, time_s=time_s, position=position + pelvis[:, None])
    write_bvh(track, tmp_path / "a.bvh")
    found = replay(parse(tmp_path / "a.bvh"))["Hips"][:, 0]
    np.testing.assert_allclose(found, np.linspace(time_s[0], time_s[-1], 41), atol=1e-4)


def test_lengths_are_the_mean_of_what_was_measured(tmp_path: Path) -> None:
    track = rigid_track()
    position = track.position.copy()
    knee, ankle = SKELETON.index("left_knee"), SKELETON.index("left_ankle")
    shank = position[:, ankle] - position[:, knee]
    position[::2, ankle] += 0.1 * shank[::2]
    write_bvh(replace(track, position=position, status=None), tmp_path / "a.bvh")
    offset = parse(tmp_path / "a.bvh").joint_offset("LeftFoot")
    assert np.linalg.norm(offset) == pytest.approx(1.05 * 41, abs=1e-3)


def test_a_hidden_arm_stays_and_one_never_seen_is_left_out(tmp_path: Path) -> None:
    track = rigid_track()
    position = track.position.copy()
    position[10:20, SKELETON.index("left_wrist")] = np.nan
    position[:, SKELETON.index("right_wrist")] = np.nan
    write_bvh(replace(track, position=position, status=None), tmp_path / "a.bvh")
    file = parse(tmp_path / "a.bvh")
    joints = replay(file)
    forearm = (joints["LeftHand"] - joints["LeftForeArm"])[9:20]
    np.testing.assert_allclose(forearm, np.broadcast_to(forearm[0], forearm.shape), atol=1e-6)
    assert "RightArm" in file.get_joints_names()
    assert not {"RightForeArm", "RightHand"} & set(file.get_joints_names())
    assert "nan" not in (tmp_path / "a.bvh").read_text()


def test_the_fitted_body_is_preferred(tmp_path: Path) -> None:
    seen, fitted = rigid_track(seed=1), rigid_track(seed=2)
    body = BodyFit(fitted, np.zeros(fitted.n_frames))
    write_bvh(seen, tmp_path / "a.bvh", body=body)
    found = replay(parse(tmp_path / "a.bvh"))["LeftHand"]
    truth = fitted.position[:, SKELETON.index("left_wrist")]
    assert np.abs(found - truth).max() < 1e-3


def test_what_makes_no_figure_is_refused(tmp_path: Path) -> None:
    track = rigid_track()
    hidden = replace(track, position=np.full_like(track.position, np.nan), status=None)
    with pytest.raises(DataError, match="hips and shoulders"):
        write_bvh(hidden, tmp_path / "a.bvh")
    with pytest.raises(UnitError, match="got the body"):
        write_bvh(make_pose_track(frame_of_reference="body"), tmp_path / "a.bvh")
