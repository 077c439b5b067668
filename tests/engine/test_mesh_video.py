"""The video with a body surface."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from engine import pipeline
from engine.config import Config, OutputConfig
from engine.datatypes import PoseTrack, SubjectState, ViewInfo, ViewPose
from engine.errors import BackendUnavailable, DataError
from engine.mesh_video import place_surface, write_mesh_overlay
from engine.pose.swing_twist.inverse_kinematics import rotate_about
from engine.video.reader import read_frames
from engine.video.writer import VideoWriter
from tests.builders import make_trial
from tests.engine.pose.swing_twist.builders import place
from tests.engine.pose.swing_twist.test_mesh import STILL, points_around_joints

# From the world's axes to a camera in front of the person: x right, y down, z away.
TO_CAMERA = rotate_about(np.array([0.0, 1.0, 0.0]), np.array(np.pi / 2)) * [[1], [-1], [-1]]
SIZE_PX = (320, 240)


def seen_pose(n: int = 6) -> ViewPose:
    body = np.repeat(place(STILL), n, axis=0) @ TO_CAMERA.T
    image = 100.0 * body[..., :2] + (160, 120)
    time_s, confidence = np.arange(n) / 30, np.full(body.shape[:2], 0.9)
    return ViewPose(
        image=PoseTrack(time_s, image, "px", "image", "mediapipe_33", confidence),
        body=PoseTrack(time_s, body, "m", "body", "mediapipe_33", confidence),
        box=np.tile([80.0, 10, 240, 230], (n, 1)),
        state=(SubjectState.TRACKED,) * n,
        info=ViewInfo("clip.mp4", "", 30.0, n, SIZE_PX, n / 30),
    )


def test_the_surface_lies_on_the_landmarks():
    pose, mesh = seen_pose(2), points_around_joints()
    surface = next(iter(place_surface(pose, mesh)))
    true = 100.0 * mesh.vertices @ TO_CAMERA.T
    parts = surface.reshape(24, -1, 3).mean(axis=1) - true.reshape(24, -1, 3).mean(axis=1)
    # Knees, ankles, elbows (columns of the 29 joints): twists turn the points around them a bit.
    limbs = [4, 5, 7, 8, 18, 19]
    assert np.abs(parts[limbs, :2] - (160, 120)).max() < 8.0


def test_a_video_with_covered_head_and_surface_is_written(tmp_path):
    pose, clip = seen_pose(), tmp_path / "clip.mp4"
    with VideoWriter(clip) as writer:
        for i in range(6):
            writer.write(np.full((SIZE_PX[1], SIZE_PX[0], 3), 90, np.uint8), i / 30)
    seen = []
    n = write_mesh_overlay(
        clip,
        pose,
        tmp_path / "mesh.mp4",
        mesh=points_around_joints(),
        progress=lambda *report: seen.append(report),
    )
    assert n == 6
    assert seen[-1] == ("overlay", 6, 6)
    assert len(list(read_frames(tmp_path / "mesh.mp4"))) == 6


def test_what_can_t_be_drawn_is_said(tmp_path):
    pose = seen_pose()
    with pytest.raises(DataError, match="no measured picture"):
        write_mesh_overlay(tmp_path / "a.mp4", pose, tmp_path / "b.mp4", start_s=99.0)
    with pytest.raises(DataError, match="landmarks in metres"):
        next(iter(place_surface(dataclasses.replace(pose, body=None), points_around_joints())))


def test_a_surface_that_can_not_be_drawn_is_refused_before_the_work(tmp_path, monkeypatch):
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    estimated = []
    monkeypatch.setattr(pipeline, "estimate_view", lambda *args: estimated.append(args))
    config = Config(output=OutputConfig(surface=True))
    with pytest.raises(BackendUnavailable, match=r"pip install 'liftlens\[anny\]'"):
        pipeline.assess_to_folder(make_trial(), config, tmp_path / "out")
    assert not estimated
    assert not (tmp_path / "out").exists()
