"""Keypoints read from files."""

from __future__ import annotations

import numpy as np
import pytest

from engine.config import PoseConfig
from engine.datatypes import Frame, PersonBox, SubjectState, TrackedFrame, ViewInfo, ignore_progress
from engine.errors import ConfigError, DataError
from engine.pose.backends.stored import Backend, read_stored_tracks, resample_track

VIEW = ViewInfo("clip.mp4", "", 30.0, 5, (720, 480), 1.0)
TIME_S = np.arange(5) / 30
IMAGE = np.random.default_rng(0).uniform(0, 480, (5, 33, 2))


def write(path, **arrays):
    np.savez(path, **{"time_s": TIME_S, "image": IMAGE} | arrays)
    return path


def frames(times=TIME_S):
    """Frames without pictures: the estimator must not look at them."""
    for i, time_s in enumerate(times):
        box = None if i == 0 else PersonBox(0, 0, 10, 20, state=SubjectState.HELD)
        yield TrackedFrame(Frame(i, float(time_s), None), box)


def estimate(path, times=TIME_S):
    return Backend(PoseConfig(backend="stored", model=str(path))).estimate(
        frames(times), VIEW, ignore_progress
    )


def test_positions_come_back_as_they_were(tmp_path):
    body = np.ones((5, 33, 3))
    confidence = np.full((5, 33), 0.5)
    pose = estimate(write(tmp_path / "k.npz", body=body, confidence=confidence))
    np.testing.assert_array_equal(pose.image.position, IMAGE)
    np.testing.assert_array_equal(pose.body.position, body)
    np.testing.assert_array_equal(pose.image.confidence, confidence)
    assert pose.state == (SubjectState.LOST, *[SubjectState.HELD] * 4)
    assert np.isnan(pose.box[0]).all()
    assert pose.model_time_s == 0


def test_body_is_optional_and_skeletons_are_kept(tmp_path):
    path = write(tmp_path / "k.npz", image=IMAGE[:, :17], skeleton=np.array("h36m_17"))
    pose = estimate(path)
    assert pose.body is None
    assert pose.image.skeleton == "h36m_17"


def test_frames_take_the_nearest_sample_in_time(tmp_path):
    path = write(tmp_path / "k.npz")
    pose = estimate(path, np.array([0.010, 1 / 30 + 0.010, 4 / 30 + 0.020, 9.0]))
    np.testing.assert_array_equal(pose.image.position[:2], IMAGE[:2])
    assert np.isnan(pose.image.position[2:]).all()
    assert (pose.image.status[2:] == 0).all()


def test_reads_the_tracks_of_a_result(tmp_path):
    from engine.storage.tracks import write_tracks
    from tests.builders import make_trial_result

    result = make_trial_result()
    path = tmp_path / "tracks.npz"
    write_tracks(
        path,
        raw=result.raw,
        corrected=result.corrected,
        views=result.views,
        angles=result.angles,
    )
    image = result.views[0].image
    pose = estimate(path, image.time_s)
    np.testing.assert_array_equal(pose.image.position, image.position)
    np.testing.assert_array_equal(pose.image.status, image.status)
    assert pose.image.skeleton == image.skeleton
    assert pose.image.provenance["estimator"] == "stored"


def test_resampling_an_empty_track():
    empty = read_like(np.empty((0, 33, 2)), np.empty(0))
    assert np.isnan(resample_track(empty, TIME_S).position).all()


def read_like(position, time_s):
    from engine.datatypes import PoseTrack

    return PoseTrack(time_s, position, "px", "image", "mediapipe_33")


def test_no_file_named():
    with pytest.raises(ConfigError, match=r"pose\.model"):
        Backend(PoseConfig(backend="stored"))


def test_file_does_not_exist(tmp_path):
    with pytest.raises(ConfigError, match=r"none\.npz"):
        read_stored_tracks(tmp_path / "none.npz")


@pytest.mark.parametrize("kind", ["text", "empty", "other arrays", "cut off", "wrong shape"])
def test_unusable_file(tmp_path, kind):
    path = tmp_path / "k.npz"
    if kind == "text":
        path.write_text("time,x,y")
    elif kind == "empty":
        path.write_bytes(b"")
    elif kind == "other arrays":
        np.savez(path, a=np.zeros(3))
    elif kind == "wrong shape":
        write(path, image=np.zeros((4, 33, 2)))
    else:
        write(path)
        path.write_bytes(path.read_bytes()[:400])
    with pytest.raises(DataError):
        Backend(PoseConfig(backend="stored", model=str(path)))
