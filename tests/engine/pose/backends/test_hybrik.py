"""The estimator `hybrik`: BlazePose's landmarks on a skeleton of constant bones."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from engine.config import PoseConfig
from engine.datatypes import (
    Frame,
    PersonBox,
    PoseTrack,
    Status,
    SubjectState,
    TrackedFrame,
    ViewInfo,
    ViewPose,
    ignore_progress,
)
from engine.errors import ConfigError, NoPersonFound
from engine.pose.backends import hybrik, mediapipe
from engine.pose.base import create_backend
from engine.skeletons import MEDIAPIPE_33
from tests.builders import make_view_pose
from tests.engine.pose.backends.test_mediapipe import StandInNetworks
from tests.engine.pose.swing_twist.builders import REST, human_rotations, place
from tests.engine.pose.swing_twist.onnx_files import write_network

VIEW = ViewInfo("clip.mp4", "", 30.0, 3, (720, 480), 0.1)
BOX = PersonBox(310.0, 90.0, 410.0, 390.0)
SHIN = [MEDIAPIPE_33.index(n) for n in ("left_knee", "left_ankle")]


@pytest.fixture(autouse=True)
def _stand_in(monkeypatch):
    monkeypatch.setattr(mediapipe, "BlazePoseNetworks", StandInNetworks)


def frames(n: int = 3):
    picture = np.zeros((480, 720, 3), np.uint8)
    picture[0, 360] = 255
    for i in range(n):
        yield TrackedFrame(Frame(i, i / 30, picture), BOX, is_anchor=True)


def pose_of(body: np.ndarray) -> ViewPose:
    time_s, confidence = np.arange(len(body)) / 30, np.full(body.shape[:2], 0.9)
    image = 300 * body[..., :2] + (360, 240)
    return ViewPose(
        image=PoseTrack(time_s, image, "px", "image", "mediapipe_33", confidence),
        body=PoseTrack(
            time_s, body, "m", "body", "mediapipe_33", confidence, provenance={"variant": "full"}
        ),
        box=np.tile([310.0, 90, 410, 390], (len(body), 1)),
        state=(SubjectState.TRACKED,) * len(body),
        info=VIEW,
    )


@pytest.mark.parametrize("ik", ["adaptive", "naive"])
def test_bones_are_constant_and_the_picture_is_blazepose_s(ik):
    rng = np.random.default_rng(1)
    body = place(human_rotations(30, seed=1))
    seen = pose_of(body + rng.normal(0, 0.01, body.shape))
    posed = hybrik.Backend(PoseConfig(backend="hybrik", ik=ik)).lift(seen)
    np.testing.assert_array_equal(posed.image.position, seen.image.position)
    shin = np.linalg.norm(np.diff(posed.body.position[:, SHIN], axis=1), axis=-1)
    assert np.ptp(shin) < 1e-9
    assert np.linalg.norm(posed.body.position - body, axis=-1).mean() < 0.04
    told = {"estimator": "hybrik-open", "ik": ik, "landmarks": "mediapipe", "variant": "full"}
    assert dict(posed.body.provenance) == dict(posed.image.provenance) == told


def test_frames_without_landmarks_stay_missing():
    body = place(human_rotations(5, seed=2))
    body[2] = np.nan
    posed = hybrik.Backend(PoseConfig(backend="hybrik")).lift(pose_of(body))
    assert (posed.body.status[2] == Status.MISSING).all()
    assert (posed.body.status[[0, 1, 3, 4]] == Status.MEASURED).all()


def test_it_is_found_by_name_and_follows_frames(monkeypatch):
    body = place(human_rotations(3, seed=3))
    monkeypatch.setattr(mediapipe.Backend, "estimate", lambda *_: pose_of(body))
    backend = create_backend(PoseConfig(backend="hybrik"))
    pose = backend.estimate(frames(), VIEW, ignore_progress)
    assert pose.body.provenance["estimator"] == "hybrik-open"


@pytest.mark.parametrize("kind", ["joints_xyz", "joints_uvd"])
def test_a_network_of_the_user_s_own_gives_the_joints(tmp_path, monkeypatch, kind):
    body = place(human_rotations(3, seed=4))
    monkeypatch.setattr(
        mediapipe.Backend, "estimate", lambda _self, stream, *_: (list(stream), pose_of(body))[1]
    )
    joints = REST.position * (1.0, -1.0, -1.0)
    side_m = 300 * 1.25 / 300  # of the crop: px, at the 300 px per m of `pose_of`
    given = joints if kind == "joints_xyz" else joints / (side_m, side_m, 2.2)
    outputs = {kind: given[None], "twist": np.ones((1, 23, 2))}
    file = write_network(tmp_path / "own.onnx", outputs)
    backend = create_backend(PoseConfig(backend="hybrik", model=str(file), threads=1))
    pose = backend.estimate(frames(), VIEW, ignore_progress)
    told = pose.body.provenance
    assert told["estimator"] == "hybrik-official"
    assert len(told["model_sha256"]) == 64
    at = pose.body.position[0]
    knee, ankle = at[SHIN]
    np.testing.assert_allclose(ankle - knee, [0.0, 0.246 * 1.75, 0.0], atol=1e-5)
    wrists = at[[MEDIAPIPE_33.index(f"{side}_wrist") for side in ("left", "right")]]
    np.testing.assert_allclose(wrists[1] - wrists[0], (0, 0, -2 * 0.447 * 1.75), atol=1e-5)


def test_a_lost_person_has_no_joints_of_the_network_either(tmp_path, monkeypatch):
    body = place(human_rotations(2, seed=5))
    monkeypatch.setattr(
        mediapipe.Backend, "estimate", lambda _self, stream, *_: (list(stream), pose_of(body))[1]
    )
    outputs = {"joints_xyz": REST.position[None], "twist": np.ones((1, 23, 2))}
    file = write_network(tmp_path / "own.onnx", outputs)
    stream = list(frames(2))
    stream[1] = dataclasses.replace(stream[1], box=None)
    backend = hybrik.Backend(PoseConfig(backend="hybrik", model=str(file), threads=1))
    pose = backend.estimate(iter(stream), VIEW, ignore_progress)
    assert np.isfinite(pose.body.position[0]).all()
    assert np.isnan(pose.body.position[1]).all()


def test_what_can_t_be_used_is_said():
    with pytest.raises(ConfigError, match="no network file"):
        create_backend(PoseConfig(backend="hybrik", model="nowhere.onnx"))
    without = dataclasses.replace(pose_of(place(human_rotations(2, seed=6))), body=None)
    with pytest.raises(NoPersonFound, match="came without"):
        hybrik.Backend(PoseConfig(backend="hybrik")).lift(without)


def test_a_network_that_looks_at_pictures_can_not_lift_keypoints(monkeypatch):
    monkeypatch.setattr(hybrik, "OfficialNetwork", lambda path, threads: object())
    backend = hybrik.Backend(PoseConfig(backend="hybrik", model="own.onnx"))
    with pytest.raises(ConfigError, match="looks at the pictures"):
        backend.lift(make_view_pose())
