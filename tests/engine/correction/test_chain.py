import numpy as np
import pytest

from engine.correction.chain import correct_track, summarise_status
from engine.datatypes import PoseTrack, Status
from engine.errors import ConfigError

TIME_S = np.arange(60) / 30


def make_track(confidence=0.9, sigma=0.01):
    position = np.zeros((60, 33, 3))
    position[:, :, 0] = TIME_S[:, None]
    shape = position.shape[:2]
    return PoseTrack(
        TIME_S,
        position,
        "m",
        "world",
        "mediapipe_33",
        confidence=np.full(shape, confidence),
        sigma=np.full(shape, sigma),
    )


def with_doubtful(track, frames, keypoint, offset=5.0):
    confidence = np.array(track.confidence)
    position = np.array(track.position)
    confidence[frames, keypoint] = 0.1
    position[frames, keypoint] += offset
    return PoseTrack(
        track.time_s, position, "m", "world", track.skeleton, confidence, np.array(track.sigma)
    )


def test_doubtful_samples_are_replaced_and_say_so():
    corrected = correct_track(with_doubtful(make_track(), slice(20, 25), 15))
    assert np.allclose(corrected.position[20:25, 15, 0], TIME_S[20:25], atol=1e-3)
    assert (corrected.status[20:25, 15] == Status.FILLED).all()
    assert (corrected.sigma[20:25, 15] > corrected.sigma[10, 15]).all()
    assert corrected.provenance["correction"]["rejected"] == 5


def test_long_gap_stays_missing_and_visible():
    corrected = correct_track(with_doubtful(make_track(), slice(10, 50), 15))
    assert np.isnan(corrected.position[10:50, 15]).all()
    assert (corrected.status[10:50, 15] == Status.REJECTED).all()
    assert summarise_status(corrected)["missing"] == pytest.approx(40 / (60 * 33))


def test_other_keypoints_are_not_touched():
    corrected = correct_track(with_doubtful(make_track(), slice(20, 25), 15))
    others = np.delete(corrected.position, 15, axis=1)[:, :, 0]
    assert np.allclose(others, TIME_S[:, None], atol=1e-4)


def test_shares_add_up_to_one():
    corrected = correct_track(with_doubtful(make_track(), slice(20, 25), 15))
    assert sum(summarise_status(corrected).values()) == pytest.approx(1.0)


def test_unknown_confidence_is_kept():
    corrected = correct_track(make_track(confidence=np.nan))
    assert corrected.is_present.all()


def test_none_returns_the_track_itself():
    track = make_track()
    assert correct_track(track, preset="none") is track


def test_unknown_names_say_what_there_is():
    with pytest.raises(ConfigError, match="'default', 'paper' or 'none'"):
        correct_track(make_track(), preset="best")
    with pytest.raises(ConfigError, match="must be one of kalman, butterworth"):
        correct_track(make_track(), smoother="moving_average")
