"""Sound: reading it, its lag, and what it adds to the movement."""

from __future__ import annotations

from fractions import Fraction
from pathlib import Path

import av
import numpy as np
import pytest

from engine.datatypes import CheckLevel
from engine.errors import DataError
from engine.video._audio import RATE_HZ, estimate_audio_lag
from engine.video.sync import AudioTrack, estimate_offset, read_audio
from tests.engine.video import clips
from tests.engine.video.sync_scenes import film, frames, look_from, make_lift, stand_still

SIDE, OBLIQUE = look_from(90.0), look_from(130.0, height_m=1.5)


def knock_at(times_s, length_s: float = 12.0, seed: int = 0) -> np.ndarray:
    """Knocks of 50 ms."""
    rng = np.random.default_rng(seed)
    sound = np.zeros(round(length_s * RATE_HZ))
    for time_s in times_s:
        begin = round(time_s * RATE_HZ)
        count = min(400, len(sound) - begin)
        sound[begin : begin + count] += np.exp(-np.arange(count) / 80) * rng.normal(size=count)
    return 0.2 * sound


def record(sound: np.ndarray, start_s: float = 0.0, noise: float = 0.003, seed: int = 1):
    heard = sound[round(start_s * RATE_HZ) :]
    return AudioTrack(heard + np.random.default_rng(seed).normal(0.0, noise, heard.size))


UNEVEN = (0.9, 2.1, 4.4, 5.0, 7.7, 8.1, 10.3)


@pytest.mark.parametrize("late_s", [0.0, 0.5, 3.217])
def test_lag_of_knocks_within_two_milliseconds(late_s: float) -> None:
    sound = knock_at(UNEVEN)
    found = estimate_audio_lag(record(sound), record(sound, late_s, seed=2))
    assert found.offset_s == pytest.approx(late_s, abs=0.002)
    assert found.confidence > 0.9
    back = estimate_audio_lag(record(sound, late_s, seed=2), record(sound))
    assert back.offset_s == pytest.approx(-late_s, abs=0.002)


def test_sound_that_starts_after_the_picture_is_counted_from_the_picture() -> None:
    sound = knock_at(UNEVEN)
    first = AudioTrack(record(sound).samples, start_s=0.3)
    second = AudioTrack(record(sound, 1.0, seed=2).samples, start_s=0.1)
    assert estimate_audio_lag(first, second).offset_s == pytest.approx(1.2, abs=0.002)


def test_even_knocking_and_other_sounds_are_not_sure() -> None:
    even = knock_at(np.arange(0.2, 12.0, 0.5))
    same = knock_at(np.arange(0.2, 12.0, 0.5))
    assert estimate_audio_lag(record(even), record(same, 1.0, seed=2)).confidence < 0.5
    rng = np.random.default_rng(4)
    noises = [AudioTrack(rng.normal(0.0, 0.1, 12 * RATE_HZ)) for _ in range(2)]
    assert estimate_audio_lag(*noises).confidence < 0.5


def test_clocks_of_different_rate_over_minutes() -> None:
    rng = np.random.default_rng(6)
    times = np.cumsum(rng.uniform(0.4, 3.0, 160))
    times = times[times < 235.0]
    first = record(knock_at(times, 240.0))
    second = record(knock_at((times - 2.0)[3:] / 1.0002, 236.0), seed=2)
    found = estimate_audio_lag(first, second)
    assert 1e6 * found.drift == pytest.approx(200.0, abs=20.0)
    assert found.offset_s == pytest.approx(2.0, abs=0.008)


def test_without_two_sounds_there_is_no_lag() -> None:
    sound = record(knock_at(UNEVEN))
    assert estimate_audio_lag(None, sound) is None
    assert estimate_audio_lag(sound, None) is None
    assert estimate_audio_lag(sound, AudioTrack(np.zeros(100))) is None


def test_a_track_checks_its_shape_and_rate() -> None:
    with pytest.raises(DataError, match="one channel"):
        AudioTrack(np.zeros((2, 100)))
    with pytest.raises(DataError, match="8000 Hz"):
        AudioTrack(np.zeros(100), rate_hz=44100)


def write_film(path: Path, sound: np.ndarray | None, *, rate_hz: int = 44100, late_s: float = 0.0):
    """Write a film of grey pictures with sound that starts so much later."""
    with av.open(str(path), "w") as container:
        picture = container.add_stream("libx264", rate=30)
        picture.width, picture.height, picture.pix_fmt = 64, 48, "yuv420p"
        voice = None
        if sound is not None:
            voice = container.add_stream("aac", rate=rate_hz, layout="stereo")
        for i in range(60):
            frame = av.VideoFrame.from_ndarray(clips.counting_image(i, 64, 48), "rgb24")
            frame.pts, frame.time_base = i, Fraction(1, 30)
            container.mux(picture.encode(frame))
        container.mux(picture.encode(None))
        if voice is not None:
            for begin in range(0, len(sound) - 1023, 1024):
                block = np.tile(sound[begin : begin + 1024].astype(np.float32), (2, 1))
                frame = av.AudioFrame.from_ndarray(block, "fltp", "stereo")
                frame.rate, frame.time_base = rate_hz, Fraction(1, rate_hz)
                frame.pts = begin + round(late_s * rate_hz)
                container.mux(voice.encode(frame))
            container.mux(voice.encode(None))
    return path


@pytest.mark.parametrize("late_s", [0.0, 0.5])
@pytest.mark.parametrize("suffix", ["mp4", "mkv"])
def test_sound_is_read_at_its_time(tmp_path: Path, late_s: float, suffix: str) -> None:
    rate = 44100
    sound = np.zeros(2 * rate)
    sound[rate : rate + 2000] = 0.5 * np.sin(np.arange(2000) * 2 * np.pi * 600 / rate)
    track = read_audio(write_film(tmp_path / f"a.{suffix}", sound, late_s=late_s))
    loud = np.flatnonzero(np.abs(track.samples) > 0.1)
    assert track.rate_hz == RATE_HZ
    assert track.start_s + loud[0] / RATE_HZ == pytest.approx(1.0 + late_s, abs=0.03)
    assert len(loud) / RATE_HZ < 0.06


def test_videos_without_sound_give_none(tmp_path: Path) -> None:
    assert read_audio(write_film(tmp_path / "mute.mp4", None)) is None
    assert read_audio(write_film(tmp_path / "silent.mp4", np.zeros(44100))) is None
    broken = tmp_path / "broken.mp4"
    broken.write_bytes(b"no video at all" * 100)
    assert read_audio(broken) is None
    assert read_audio(tmp_path / "missing.mp4") is None


def both_views(late_s: float, seed: int = 1):
    world = make_lift(seed)
    first = film(world, SIDE, frames(0.0, 7.0), seed=1)
    return first, film(world, OBLIQUE, frames(late_s, 7.5), seed=2)


def test_sound_and_movement_confirm_each_other() -> None:
    views, sound = both_views(0.7), knock_at(UNEVEN)
    alone = estimate_offset(*views)
    both = estimate_offset(*views, audio=(record(sound), record(sound, 0.7, seed=2)))
    assert (both.method, both.level) == ("both", CheckLevel.GREEN)
    assert both.confidence >= alone.confidence
    assert both.sigma_s < alone.sigma_s
    assert both.offset_s == pytest.approx(0.7, abs=0.01)


def test_sound_that_contradicts_the_movement_makes_it_red() -> None:
    sound = knock_at(UNEVEN)
    estimate = estimate_offset(*both_views(0.7), audio=(record(sound), record(sound, 2.5, seed=2)))
    assert estimate.level is CheckLevel.RED
    assert "Movement and sound disagree" in estimate.sentence
    assert f"{estimate.offset_s:.3f} s, the sound 2.500 s" in estimate.sentence


def test_sound_settles_which_repetition_it_is() -> None:
    lift, sound = make_lift(9), knock_at(UNEVEN)
    first = film(lambda t: lift(t % 4.0), SIDE, frames(0.0, 11.9), seed=1)
    second = film(lambda t: lift(t % 4.0), OBLIQUE, frames(4.2, 7.8), seed=2)
    assert estimate_offset(first, second).level is not CheckLevel.GREEN
    heard = estimate_offset(first, second, audio=(record(sound), record(sound, 4.2, seed=2)))
    assert (heard.level, heard.method) == (CheckLevel.GREEN, "both")
    assert heard.offset_s == pytest.approx(4.2, abs=0.01)


def test_sound_alone_is_amber() -> None:
    still = [film(stand_still, camera, frames(0.0, 8.0)) for camera in (SIDE, OBLIQUE)]
    sound = knock_at(UNEVEN)
    estimate = estimate_offset(*still, audio=(record(sound), record(sound, 1.5, seed=2)))
    assert (estimate.method, estimate.level) == ("audio", CheckLevel.AMBER)
    assert estimate.offset_s == pytest.approx(1.5, abs=0.01)


def test_missing_sound_changes_nothing() -> None:
    views = both_views(0.7)
    assert estimate_offset(*views, audio=(None, None)) == estimate_offset(*views)
