"""Reading: codecs, rotation, time stamps, selection, memory and unusable files."""

from __future__ import annotations

import hashlib
import logging
import shutil
from pathlib import Path

import numpy as np
import psutil
import pytest

from engine.errors import ConfigError, VideoError
from engine.video.reader import probe_video, read_frames
from tests.engine.video import clips

CODECS = {
    "h264": ("libx264", "mp4"),
    "hevc": ("libx265", "mp4"),
    "mjpeg": ("mjpeg", "avi"),
    "vp9": ("libvpx-vp9", "webm"),
}


@pytest.mark.parametrize("name", CODECS)
def test_every_codec_gives_all_pictures_in_order_at_their_times(tmp_path: Path, name: str) -> None:
    codec, suffix = CODECS[name]
    path = clips.counting_clip(tmp_path / f"clip.{suffix}", codec=codec)
    frames = list(read_frames(path))
    assert [clips.index_of(f.image) for f in frames] == list(range(30))
    assert [f.index for f in frames] == list(range(30))
    assert np.allclose([f.time_s for f in frames], np.arange(30) / 30, atol=1e-3)
    assert probe_video(path).codec == name


@pytest.mark.parametrize("suffix", ["mp4", "mov", "mkv", "avi", "ts"])
def test_reordered_pictures_come_in_the_order_shown(tmp_path: Path, suffix: str) -> None:
    path = clips.counting_clip(tmp_path / f"clip.{suffix}", options={"bf": "3", "b-adapt": "0"})
    frames = list(read_frames(path))
    assert [clips.index_of(f.image) for f in frames] == list(range(30))
    assert np.allclose([f.time_s for f in frames], np.arange(30) / 30, atol=1e-3)


def test_probe_describes_the_file(tmp_path: Path) -> None:
    path = clips.counting_clip(tmp_path / "clip.mp4", 25, rate=25)
    info = probe_video(path)
    assert info.file_name == "clip.mp4"
    assert info.sha256 == hashlib.sha256(path.read_bytes()).hexdigest()
    assert (info.n_frames, info.size_px, info.rotation_deg) == (25, (64, 48), 0)
    assert info.fps == pytest.approx(25.0)
    assert info.duration_s == pytest.approx(1.0)
    assert not info.is_variable_rate
    assert info.n_missing_frames == 0


def test_images_are_rgb_bytes(tmp_path: Path) -> None:
    path = clips.write_clip(tmp_path / "clip.mp4", [clips.quadrants(64, 48)])
    (frame,) = read_frames(path)
    assert (frame.image.dtype, frame.image.shape) == (np.uint8, (48, 64, 3))
    assert_quadrants(frame.image)


def assert_quadrants(image: np.ndarray) -> None:
    height, width = image.shape[:2]
    places = {"red": (1, 1), "green": (1, 3), "blue": (3, 1), "white": (3, 3)}
    for name, (row, column) in places.items():
        pixel = image[row * height // 4, column * width // 4].astype(int)
        assert np.abs(pixel - clips.COLOURS[name]).max() < 12, f"{name} is {pixel}"


# What a phone stores for each way it is held, and the track matrix that goes with it:
# the stored picture is the upright one turned back (and mirrored).
ORIENTATIONS = {
    "upright": (lambda up: up, (1, 0, 0, 1), 0),
    "clockwise 90": (lambda up: np.rot90(up, 1), (0, 1, -1, 0), 90),
    "upside down": (lambda up: np.rot90(up, 2), (-1, 0, 0, -1), 180),
    "clockwise 270": (lambda up: np.rot90(up, -1), (0, -1, 1, 0), 270),
    "mirrored": (lambda up: up[:, ::-1], (-1, 0, 0, 1), 0),
    "mirrored, clockwise 90": (lambda up: np.rot90(up, 1)[:, ::-1], (0, -1, -1, 0), 90),
}


@pytest.mark.parametrize("name", ORIENTATIONS)
def test_pictures_come_upright(tmp_path: Path, name: str) -> None:
    store, matrix, clockwise_deg = ORIENTATIONS[name]
    stored = np.ascontiguousarray(store(clips.quadrants(64, 48)))
    path = clips.write_clip(tmp_path / "clip.mp4", [stored] * 3)
    clips.set_display_matrix(path, *matrix)
    info = probe_video(path)
    frames = list(read_frames(path))
    assert (info.size_px, info.rotation_deg) == ((64, 48), clockwise_deg)
    assert len(frames) == 3
    assert frames[0].image.shape == (48, 64, 3)
    assert_quadrants(frames[0].image)


@pytest.mark.parametrize("size", [(63, 47), (65, 48), (64, 49), (17, 131)])
def test_odd_sizes(tmp_path: Path, size: tuple[int, int]) -> None:
    path = clips.write_clip(tmp_path / "c.mp4", [clips.quadrants(*size)], pixel_format="yuv444p")
    (frame,) = read_frames(path)
    assert probe_video(path).size_px == size
    assert frame.image.shape == (size[1], size[0], 3)
    assert_quadrants(frame.image)


def test_pixels_that_are_not_square_are_made_so(tmp_path: Path) -> None:
    options = {"x264-params": "sar=4/3"}
    path = clips.write_clip(tmp_path / "c.mp4", [clips.quadrants(60, 60)], options=options)
    (frame,) = read_frames(path)
    assert probe_video(path).size_px == (80, 60)
    assert frame.image.shape == (60, 80, 3)
    assert_quadrants(frame.image)


def test_variable_rate_keeps_true_times(tmp_path: Path) -> None:
    times_ms = [0, 33, 67, 100, 300, 310, 400, 900]
    path = clips.counting_clip(tmp_path / "c.mp4", len(times_ms), times_ms=times_ms)
    info = probe_video(path)
    assert np.allclose([f.time_s for f in read_frames(path)], np.array(times_ms) / 1000, atol=1e-4)
    assert info.is_variable_rate
    assert info.fps == pytest.approx(7 / 0.9)


def test_rounded_stamps_are_not_a_variable_rate(tmp_path: Path) -> None:
    path = clips.counting_clip(tmp_path / "c.mkv", 60, rate=60)  # 16, 17, 17 ms
    assert not probe_video(path).is_variable_rate


def test_times_count_from_the_first_picture(tmp_path: Path) -> None:
    times_ms = [5000 + 40 * i for i in range(10)]
    path = clips.counting_clip(tmp_path / "c.mkv", 10, times_ms=times_ms)
    assert np.allclose([f.time_s for f in read_frames(path)], 0.04 * np.arange(10), atol=1e-6)


def test_pictures_before_an_edit_list_are_not_shown(tmp_path: Path) -> None:
    path = clips.counting_clip(
        tmp_path / "c.mp4",
        options={"bf": "0"},
        container_options={"avoid_negative_ts": "disabled"},
        shift_packets=-10,
    )
    info = probe_video(path)
    frames = list(read_frames(path))
    assert [clips.index_of(f.image) for f in frames] == list(range(10, 30))
    assert frames[0].time_s == 0.0
    assert (info.n_frames, info.n_missing_frames) == (20, 0)


def test_missing_stamps_are_replaced_and_reported(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    path = clips.counting_clip(tmp_path / "c.h264", 10, rate=25)
    with caplog.at_level(logging.WARNING):
        frames = list(read_frames(path))
    assert np.allclose([f.time_s for f in frames], np.arange(10) / 25)
    assert "10 pictures carry no time stamp" in caplog.text


@pytest.mark.parametrize("rate", [1, 240])
def test_unusual_rates(tmp_path: Path, rate: int) -> None:
    path = clips.counting_clip(tmp_path / "c.mp4", 5, rate=rate)
    assert probe_video(path).fps == pytest.approx(rate)
    assert np.allclose([f.time_s for f in read_frames(path)], np.arange(5) / rate)


def test_one_picture_is_readable(tmp_path: Path) -> None:
    path = clips.counting_clip(tmp_path / "c.mp4", 1)
    info = probe_video(path)
    assert (info.n_frames, info.fps) == (1, pytest.approx(30.0))
    assert len(list(read_frames(path))) == 1


# --- a part of the video -------------------------------------------------------------------


@pytest.fixture(scope="module")
def long_clips(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """Six seconds with a key picture every second, in several containers."""
    folder = tmp_path_factory.mktemp("long")
    options = {"g": "30", "bf": "2"}
    made = {
        suffix: clips.counting_clip(folder / f"c.{suffix}", 180, options=options)
        for suffix in ("mp4", "mkv", "ts", "avi")
    }
    made["mjpeg"] = clips.counting_clip(folder / "m.avi", 180, codec="mjpeg")
    return made


@pytest.mark.parametrize("container", ["mp4", "mkv", "ts", "avi", "mjpeg"])
@pytest.mark.parametrize(
    ("start_s", "stop_s"), [(0.0, 0.5), (0.7, 1.3), (2.5, 3.02), (3.0, None), (5.9, None)]
)
def test_a_part_holds_exactly_its_pictures(
    long_clips: dict[str, Path], container: str, start_s: float, stop_s: float | None
) -> None:
    frames = list(read_frames(long_clips[container], start_s=start_s, stop_s=stop_s))
    first = int(np.ceil(start_s * 30 - 0.1))
    last = 180 if stop_s is None else int(np.ceil(stop_s * 30 - 0.1))
    assert [clips.index_of(f.image) for f in frames] == [i % 32 for i in range(first, last)]
    assert np.allclose([f.time_s for f in frames], np.arange(first, last) / 30, atol=1e-3)
    assert frames[0].index == 0


def test_neighbouring_parts_share_no_picture(long_clips: dict[str, Path]) -> None:
    parts = [(0.0, 2.0), (2.0, 4.0), (4.0, None)]
    read = [list(read_frames(long_clips["mp4"], start_s=a, stop_s=b)) for a, b in parts]
    times = [f.time_s for part in read for f in part]
    assert np.allclose(times, np.arange(180) / 30)


def test_a_part_behind_the_end_says_where_the_end_is(long_clips: dict[str, Path]) -> None:
    with pytest.raises(VideoError, match=r"from 20 s on.*last one is at 5\.97 s"):
        list(read_frames(long_clips["mp4"], start_s=20.0))


@pytest.mark.parametrize(
    "part",
    [
        {"start_s": -1.0},
        {"start_s": float("nan")},
        {"start_s": 2.0, "stop_s": 2.0},
        {"max_side_px": 0},
    ],
)
def test_a_senseless_part_is_refused_at_once(long_clips: dict[str, Path], part: dict) -> None:
    with pytest.raises(ConfigError):
        read_frames(long_clips["mp4"], **part)


def test_a_reader_that_is_left_early_closes_the_file(long_clips: dict[str, Path]) -> None:
    before = psutil.Process().num_fds()
    frames = read_frames(long_clips["mp4"])
    next(frames)
    frames.close()
    assert psutil.Process().num_fds() == before


# --- size and memory -------------------------------------------------------------------------


def test_large_pictures_are_read_in_full_or_smaller(tmp_path: Path) -> None:
    path = clips.write_clip(tmp_path / "8k.avi", [clips.quadrants(7680, 4320)], codec="mjpeg")
    (full,) = read_frames(path)
    (small,) = read_frames(path, max_side_px=1280)
    assert probe_video(path).size_px == (7680, 4320)
    assert full.image.shape == (4320, 7680, 3)
    assert small.image.shape == (720, 1280, 3)
    assert_quadrants(full.image)
    assert_quadrants(small.image)


def test_small_pictures_are_not_enlarged(tmp_path: Path) -> None:
    path = clips.counting_clip(tmp_path / "c.mp4", 1)
    (frame,) = read_frames(path, max_side_px=1280)
    assert frame.image.shape == (48, 64, 3)


def test_memory_does_not_grow_with_length(tmp_path: Path) -> None:
    image = clips.quadrants(640, 480)
    options = {"preset": "ultrafast", "bf": "0"}
    path = clips.write_clip(tmp_path / "c.mp4", (image for _ in range(600)), options=options)
    process = psutil.Process()
    rss = [process.memory_info().rss for frame in read_frames(path) if frame.index % 10 == 0]
    assert len(rss) == 60
    # All pictures together are 550 MB; those after the first 100 may add next to nothing.
    assert max(rss[10:]) - rss[10] < 25e6


# --- unusable files --------------------------------------------------------------------------


def make_missing(folder: Path) -> Path:
    return folder / "missing.mp4"


def make_folder(folder: Path) -> Path:
    (folder / "folder.mp4").mkdir()
    return folder / "folder.mp4"


def make_empty(folder: Path) -> Path:
    (folder / "empty.mp4").write_bytes(b"")
    return folder / "empty.mp4"


def make_text(folder: Path) -> Path:
    (folder / "text.mp4").write_text("Dear sir or madam,\n" * 200)
    return folder / "text.mp4"


def make_sound(folder: Path) -> Path:
    return clips.write_sound(folder / "sound.mp4")


def make_cut_index(folder: Path) -> Path:
    """Cut a file whose index comes last."""
    path = clips.noise_clip(folder / "cut.mp4")
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    return path


def make_picture(folder: Path) -> Path:
    path = folder / "picture.mp4"
    shutil.copy(clips.counting_clip(folder / "p.png", 1, codec="png", pixel_format="rgb24"), path)
    return path


def make_playlist(folder: Path) -> Path:
    """A list that names another file: must not make the reader open that file."""
    clips.counting_clip(folder / "other.mp4")
    path = folder / "list.mp4"
    path.write_text("ffconcat version 1.0\nfile other.mp4\n")
    return path


UNUSABLE = {
    make_missing: "There is no file",
    make_folder: "is a folder",
    make_empty: "empty",
    make_text: "can't be read as a video",
    make_sound: "holds no moving picture",
    make_cut_index: "cut off",
    make_picture: "can't be read as a video",
    make_playlist: "can't be read as a video",
}


@pytest.mark.parametrize("make", UNUSABLE, ids=lambda make: make.__name__)
def test_unusable_files_are_refused_in_plain_words(tmp_path: Path, make) -> None:
    path = make(tmp_path)
    for read in (probe_video, lambda p: list(read_frames(p))):
        with pytest.raises(VideoError, match=UNUSABLE[make]) as caught:
            read(path)
        message = str(caught.value)
        assert path.name in message
        assert "expected" in message
        assert message.endswith(".")
        assert caught.value.exit_code == 3


def test_a_missing_file_is_refused_before_the_first_picture(tmp_path: Path) -> None:
    with pytest.raises(VideoError):
        read_frames(tmp_path / "missing.mp4")


def test_a_file_cut_in_its_data_gives_what_it_holds(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    path = clips.noise_clip(
        tmp_path / "c.mp4", container_options={"movflags": "+faststart"}, options={"bf": "0"}
    )
    path.write_bytes(path.read_bytes()[: int(0.6 * path.stat().st_size)])
    with caplog.at_level(logging.WARNING):
        info = probe_video(path)
        frames = list(read_frames(path))
    assert 15 <= len(frames) <= 30
    assert info.n_frames == len(frames)
    assert info.n_frames + info.n_missing_frames == 40
    assert "more frames than it holds" in caplog.text


def test_a_cut_matroska_file_tells_what_is_missing(tmp_path: Path) -> None:
    path = clips.noise_clip(tmp_path / "c.mkv", options={"bf": "0"})
    path.write_bytes(path.read_bytes()[: int(0.6 * path.stat().st_size)])
    info = probe_video(path)
    assert info.n_frames == len(list(read_frames(path))) < 30
    assert abs(info.n_frames + info.n_missing_frames - 40) <= 2


def test_damaged_data_leaves_the_rest_readable(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    path = clips.noise_clip(tmp_path / "c.avi", codec="mjpeg")
    data = bytearray(path.read_bytes())
    start = data.index(b"00dc", len(data) // 2) + 8  # one picture, wiped out
    size = int.from_bytes(data[start - 4 : start], "little")
    data[start : start + size] = bytes(size)
    path.write_bytes(data)
    with caplog.at_level(logging.WARNING):
        frames = list(read_frames(path))
    assert len(frames) == 39
    assert "damaged" in caplog.text


def test_sound_beside_the_picture_is_ignored(tmp_path: Path) -> None:
    path = clips.counting_clip(tmp_path / "c.mp4", 10, sound=True)
    assert probe_video(path).n_frames == 10
    assert len(list(read_frames(path))) == 10


@pytest.mark.parametrize("name", ["a b.mp4", "näher.mp4", "50%d.mp4", "a:b.mp4", "-x.mp4"])
def test_awkward_file_names(tmp_path: Path, name: str) -> None:
    clips.counting_clip(tmp_path / "c.mp4", 3).rename(tmp_path / name)
    assert len(list(read_frames(tmp_path / name))) == 3
