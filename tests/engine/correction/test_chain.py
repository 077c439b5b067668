import dataclasses
import json
import time

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from engine.config import CorrectionConfig
from engine.correction.chain import correct_track, summarise_status
from engine.datatypes import PoseTrack, Status
from engine.errors import ConfigError
from engine.skeletons import H36M_17, SKELETONS

from .figures import make_walker, photograph

PRESETS = [
    {"preset": "paper"},
    *(
        {"smoother": name}
        for name in (
            "kalman",
            "butterworth",
            "savitzky_golay",
            "median",
            "hampel",
            "one_euro",
            "none",
        )
    ),
    {"gate_probability": 0.999},
]
IDS = [" ".join(map(str, p.values())) for p in PRESETS]

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


def test_the_settings_of_the_configuration_are_the_defaults():
    track = make_track()
    stated = correct_track(track, **dataclasses.asdict(CorrectionConfig()))
    assert np.array_equal(stated.position, correct_track(track).position)
    assert dict(stated.provenance) == dict(correct_track(track).provenance)


class TestNote:
    def spoil(self):
        track = make_walker(noise_m=0.003)
        position = np.array(track.position)
        wrist = H36M_17.index("left_wrist")
        position[40:60, wrist] += [0.0, 0.4, 0.2]
        position[80:90] = position[80:90][:, list(H36M_17.mirror_order)]
        confidence = np.array(track.confidence)
        confidence[10:14, 0] = 0.1
        return dataclasses.replace(track, position=position, confidence=confidence)

    def test_says_what_was_done_when_and_why(self):
        note = correct_track(self.spoil()).provenance["correction"]
        assert note["doubtful"] == 4
        assert note["misdetected"] == 20
        assert note["lost"] == 0
        assert note["rejected"] == 24
        assert note["exchanged"] == 10 * 12
        (swap,) = note["swaps"]
        assert swap["parts"] == ["all"]
        assert (swap["start_s"], swap["end_s"]) == pytest.approx((80 / 30, 89 / 30), abs=1e-3)
        (gap,) = note["unrepairable"]
        assert gap["keypoints"] == ["left_wrist"]
        assert gap["reason"] == "misdetection"
        assert gap["why_missing"] == "longer than 0.5 s"
        assert any("stay missing" in w for w in note["warnings"])
        json.dumps(note, allow_nan=False)

    def test_every_sample_says_what_happened_to_it(self):
        corrected = correct_track(self.spoil())
        status, wrist = np.asarray(corrected.status), H36M_17.index("left_wrist")
        assert (status[40:60, wrist] == Status.REJECTED).all()
        assert (status[10:14, 0] == Status.FILLED).all()
        assert (status[80:90, wrist] == Status.REPAIRED).all()
        assert (status[:10] == Status.MEASURED).all()
        shares = summarise_status(corrected)
        assert sum(shares.values()) == pytest.approx(1.0)
        assert shares["repaired"] == pytest.approx(120 / (120 * 17))


def odd_tracks():
    """Give tracks of every bad kind with a name."""
    walker = make_walker(noise_m=0.005, n_frames=60)
    position = np.array(walker.position)
    rng = np.random.default_rng(0)

    def changed(**parts):
        return dataclasses.replace(walker, **parts)

    unseen = position.copy()
    unseen[:, 3] = np.nan
    yield "a joint never seen", changed(position=unseen)
    yield "nobody", changed(position=np.full_like(position, np.nan))
    infinite = position.copy()
    infinite[5, 4], infinite[6, 4, 1], infinite[7, 2] = np.inf, -np.inf, np.nan
    yield "infinite values", changed(position=infinite)
    for n in (1, 2, 3):
        yield f"{n} frames", make_walker(n_frames=n)
    yield "no frames", make_walker(n_frames=0)
    yield "1 frame/s", make_walker(n_frames=20, fps=1.0)
    yield "1000 frames/s", make_walker(n_frames=100, fps=1000.0)
    yield "a constant pose", changed(position=np.repeat(position[:1], 60, axis=0))
    yield "coincident joints", changed(position=np.repeat(position[:, :1], 17, axis=1))
    yield "a point at the origin", changed(position=np.zeros_like(position))
    bad = position.copy()
    wild = rng.random(60) < 0.8
    bad[wild] += 0.3 * rng.standard_normal(bad[wild].shape)
    yield "80 % bad frames", changed(position=bad)
    yield "no confidence at all", changed(confidence=np.zeros((60, 17)))
    yield (
        "unknown confidence and error",
        changed(confidence=np.full((60, 17), np.nan), sigma=np.full((60, 17), np.nan)),
    )
    uneven = np.cumsum(rng.uniform(0.005, 0.4, 60))
    yield "uneven times", make_walker(time_s=uneven)
    yield "a picture", photograph(walker)
    yield (
        "a huge picture",
        dataclasses.replace(photograph(walker), position=1e6 * photograph(walker).position),
    )


ODD = list(odd_tracks())


@pytest.mark.parametrize("options", PRESETS, ids=IDS)
@pytest.mark.parametrize("track", [t for _, t in ODD], ids=[name for name, _ in ODD])
def test_bad_input_gives_a_track_and_never_a_made_up_position(track, options):
    corrected = correct_track(track, **options)
    assert corrected.position.shape == track.position.shape
    assert not np.isinf(corrected.position).any()
    seen = track.is_present.any(axis=0)
    assert np.isnan(corrected.position[:, ~seen]).all()
    present = corrected.is_present
    assert np.isin(corrected.status[~present], (Status.MISSING, Status.REJECTED)).all()
    assert not np.isin(corrected.status[present], (Status.MISSING, Status.REJECTED)).any()
    if options.get("preset") != "paper":
        first, last = (
            np.flatnonzero(track.is_present.any(axis=1))[[0, -1]] if seen.any() else (0, -1)
        )
        assert not present[:first].any()
        assert not present[last + 1 :].any()
    json.dumps(corrected.provenance["correction"], allow_nan=False)


def test_mostly_bad_frames_are_warned_of():
    note = correct_track(dict(ODD)["80 % bad frames"]).provenance["correction"]
    assert any("unreliable throughout" in w for w in note["warnings"])


@pytest.mark.parametrize("stature_m", [1.0, 1.7, 2.3])
def test_a_wrong_stature_does_no_harm_to_a_right_track(stature_m):
    track = make_walker(noise_m=0.005)
    corrected = correct_track(track, stature_m=stature_m)
    assert corrected.is_present.all()
    assert np.abs(corrected.position - track.position).max() < 0.05


@pytest.mark.parametrize("name", sorted(SKELETONS))
def test_every_skeleton(name):
    columns = len(SKELETONS[name].keypoints)
    position = np.random.default_rng(0).standard_normal((1, columns, 3)).repeat(40, axis=0)
    position += 0.2 * np.sin(np.arange(40) / 10)[:, None, None]
    track = PoseTrack(np.arange(40) / 30, position, "m", "world", name)
    for options in PRESETS[:2]:
        # Which way random points face is chance, so sides stay.
        corrected = correct_track(track, **options, repair_swaps=False)
        assert corrected.is_present.all()
        assert np.abs(corrected.position - position).max() < 0.05
        assert correct_track(track, **options).is_present.all()


def turned(angle):
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, 0.0, s], [0.0, 1.0, 0.0], [-s, 0.0, c]])


@settings(max_examples=10, deadline=None)
@given(
    angle=st.floats(-3.1, 3.1),
    shift=st.tuples(*[st.floats(-20.0, 20.0)] * 3),
    frames=st.tuples(st.integers(10, 30), st.integers(1, 10)),
)
def test_turning_and_moving_the_person_turns_and_moves_the_result(angle, shift, frames):
    track = make_walker(n_frames=60, noise_m=0.005)
    position = np.array(track.position)
    start, length = frames
    position[start : start + length, H36M_17.index("left_wrist")] += [0.1, 0.4, 0.0]
    spoilt = dataclasses.replace(track, position=position)
    moved = dataclasses.replace(track, position=position @ turned(angle).T + shift)
    expected = correct_track(spoilt, smoother="butterworth")
    found = correct_track(moved, smoother="butterworth")
    assert np.array_equal(found.status, expected.status)
    after = expected.position @ turned(angle).T + shift
    # The gaps' cubic keeps the order of each coordinate, so it isn't the same in turned axes.
    measured = expected.status == Status.MEASURED
    far = np.ones(60, dtype=bool)
    far[max(0, start - 12) : start + length + 12] = False
    same = measured & far[:, None]
    np.testing.assert_allclose(found.position[same], after[same], atol=1e-6)
    np.testing.assert_allclose(found.position, after, atol=0.05)


def test_a_mirrored_person_gets_a_mirrored_result():
    track = make_walker(noise_m=0.005)
    position = np.array(track.position)
    position[30:40, H36M_17.index("left_wrist")] += [0.1, 0.4, 0.0]
    position[70:80] = position[70:80][:, list(H36M_17.mirror_order)]
    order, flip = list(H36M_17.mirror_order), np.array([1.0, 1.0, -1.0])
    straight = correct_track(dataclasses.replace(track, position=position))
    mirrored = correct_track(dataclasses.replace(track, position=position[:, order] * flip))
    np.testing.assert_allclose(mirrored.position, straight.position[:, order] * flip, atol=1e-9)
    assert np.array_equal(mirrored.status, straight.status[:, order])


def test_pixels_of_any_size_give_the_same_result():
    track = photograph(make_walker(noise_m=0.005), noise_px=2.0)
    large = dataclasses.replace(track, position=10.0 * track.position)
    np.testing.assert_allclose(
        correct_track(large).position, 10.0 * correct_track(track).position, rtol=1e-6, atol=1e-6
    )


def test_the_time_grows_with_the_length_only():
    def seconds(n_frames):
        track = make_walker(n_frames=n_frames, skeleton="mediapipe_33", noise_m=0.01)
        spent = []
        for _ in range(2):
            start = time.process_time()
            correct_track(track)
            spent.append(time.process_time() - start)
        return min(spent)

    seconds(50)
    # Quadratic growth would take 16 times as long.
    assert seconds(1200) < 8.0 * seconds(300)
