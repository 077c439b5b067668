"""Writing: what browsers need, true times, and whole files or none."""

from __future__ import annotations

import errno
import struct
import subprocess
import sys
from pathlib import Path

import av
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from engine.errors import DataError, OutputError, ShapeError
from engine.video.reader import probe_video, read_frames
from engine.video.writer import VideoWriter
from tests.engine.video import clips


def write(path: Path, times_s, size=(64, 48)) -> Path:
    with VideoWriter(path) as writer:
        for i, time_s in enumerate(times_s):
            writer.write(clips.counting_image(i, *size), time_s)
    return path


def test_the_file_is_what_browsers_play(tmp_path: Path) -> None:
    path = write(tmp_path / "out.mp4", np.arange(40) / 30)
    boxes = clips.top_level_boxes(path)
    assert boxes.index("moov") < boxes.index("mdat")
    data = path.read_bytes()
    n_edits, _, media_time = struct.unpack_from(">IIi", data, data.index(b"elst") + 8)
    assert (n_edits, media_time) == (1, 0)  # browsers differ in what they make of others
    with av.open(str(path)) as container:
        stream = container.streams.video[0]
        context = stream.codec_context
        assert (context.name, context.pix_fmt) == ("h264", "yuv420p")
        assert stream.codec_context.color_range == 1
        assert stream.start_time == 0
        keys = [p.is_keyframe for p in container.demux(stream) if p.size]
    assert [i for i, key in enumerate(keys) if key] == [0, 15, 30]


def test_colours_survive(tmp_path: Path) -> None:
    image = clips.quadrants(64, 48)
    with VideoWriter(tmp_path / "out.mp4") as writer:
        writer.write(image, 0.0)
    (frame,) = read_frames(tmp_path / "out.mp4")
    for row, column in ((12, 16), (12, 48), (36, 16), (36, 48)):
        difference = frame.image[row, column].astype(int) - image[row, column]
        assert np.abs(difference).max() < 8


@settings(max_examples=25, deadline=None, suppress_health_check=list(HealthCheck))
@given(
    steps_ms=st.lists(st.integers(min_value=1, max_value=3000), min_size=0, max_size=12),
    start_s=st.floats(min_value=0.0, max_value=1e4),
)
def test_times_survive_whatever_their_steps(tmp_path: Path, steps_ms, start_s: float) -> None:
    times_s = start_s + np.cumsum([0, *steps_ms]) / 1000
    path = write(tmp_path / "out.mp4", times_s, size=(16, 16))
    frames = list(read_frames(path))
    assert [clips.index_of(f.image) for f in frames] == list(range(len(times_s)))
    assert np.allclose([f.time_s for f in frames], times_s - start_s, atol=1e-5)


@pytest.mark.parametrize("size", [(63, 47), (64, 47), (63, 48), (1, 1), (64, 48)])
def test_odd_sizes_are_made_even(tmp_path: Path, size: tuple[int, int]) -> None:
    path = write(tmp_path / "out.mp4", [0.0, 0.1], size)
    assert probe_video(path).size_px == tuple(side + side % 2 for side in size)
    frame = next(read_frames(path))
    assert np.abs(frame.image.astype(int) - clips.grey(0)).max() < 8  # no dark border


def test_an_existing_file_is_replaced(tmp_path: Path) -> None:
    (tmp_path / "out.mp4").write_text("old")
    write(tmp_path / "out.mp4", [0.0, 0.1])
    assert probe_video(tmp_path / "out.mp4").n_frames == 2
    assert [p.name for p in tmp_path.iterdir()] == ["out.mp4"]


@pytest.mark.parametrize("error", [ValueError, KeyboardInterrupt])
@pytest.mark.parametrize("n_frames", [0, 3, 60])
def test_nothing_is_left_after_an_error(tmp_path: Path, error, n_frames: int) -> None:
    (tmp_path / "out.mp4").write_text("old")

    def fail_after_some_pictures() -> None:
        with VideoWriter(tmp_path / "out.mp4") as writer:
            for i in range(n_frames):
                writer.write(clips.noise_image(64, 48, i), i / 30)
            raise error

    with pytest.raises(error):
        fail_after_some_pictures()
    assert [p.name for p in tmp_path.iterdir()] == ["out.mp4"]
    assert (tmp_path / "out.mp4").read_text() == "old"


def test_the_name_appears_only_when_the_file_is_whole(tmp_path: Path) -> None:
    with VideoWriter(tmp_path / "out.mp4") as writer:
        writer.write(clips.noise_image(64, 48), 0.0)
        assert not (tmp_path / "out.mp4").exists()
    assert (tmp_path / "out.mp4").exists()


def test_no_pictures_make_no_file(tmp_path: Path) -> None:
    with pytest.raises(OutputError, match="expected pictures, got none"):
        with VideoWriter(tmp_path / "out.mp4"):
            pass
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    "image",
    [np.zeros((48, 64), np.uint8), np.zeros((48, 64, 4), np.uint8), np.zeros((48, 64, 3))],
    ids=["grey", "alpha", "float"],
)
def test_other_arrays_are_refused(tmp_path: Path, image: np.ndarray) -> None:
    with pytest.raises(ShapeError), VideoWriter(tmp_path / "out.mp4") as writer:
        writer.write(image, 0.0)


def test_the_size_must_stay(tmp_path: Path) -> None:
    with VideoWriter(tmp_path / "out.mp4") as writer:
        writer.write(clips.noise_image(64, 48), 0.0)
        with pytest.raises(ShapeError):
            writer.write(clips.noise_image(64, 50), 0.1)


@pytest.mark.parametrize("second_s", [1.0, 0.5, 1.0 + 1e-7])
def test_times_must_increase(tmp_path: Path, second_s: float) -> None:
    with VideoWriter(tmp_path / "out.mp4") as writer:
        writer.write(clips.noise_image(64, 48), 1.0)
        with pytest.raises(DataError, match="increase"):
            writer.write(clips.noise_image(64, 48), second_s)


def test_a_missing_folder_is_named(tmp_path: Path) -> None:
    with pytest.raises(OutputError, match=r"nowhere.*the folder does not exist"):
        write(tmp_path / "nowhere" / "out.mp4", [0.0])


def test_a_folder_of_that_name_is_refused(tmp_path: Path) -> None:
    (tmp_path / "out.mp4").mkdir()
    with pytest.raises(OutputError, match="can't be written"):
        write(tmp_path / "out.mp4", [0.0])
    assert [p.name for p in tmp_path.iterdir()] == ["out.mp4"]


@pytest.mark.parametrize(
    ("code", "words"),
    [
        (errno.EACCES, "may not write there"),
        (errno.EROFS, "read-only"),
        (errno.ENOSPC, "disk is full"),
        (errno.EIO, "choose another folder"),
    ],
)
def test_what_the_disk_says_is_put_in_words(tmp_path: Path, monkeypatch, code, words) -> None:
    def refuse(*_args, **_kwargs):
        raise OSError(code, "refused")

    monkeypatch.setattr("engine.video.writer.av.open", refuse)
    with pytest.raises(OutputError, match=words) as caught:
        write(tmp_path / "out.mp4", [0.0])
    assert caught.value.exit_code == 2


FILL_THE_DISK = """
import resource, sys
from pathlib import Path
from engine.errors import OutputError
from engine.video.writer import VideoWriter
from tests.engine.video.clips import noise_image
resource.setrlimit(resource.RLIMIT_FSIZE, (int(sys.argv[2]), -1))
try:
    with VideoWriter(Path(sys.argv[1])) as writer:
        for i in range(int(sys.argv[3])):
            writer.write(noise_image(320, 240, i), i / 30)
except OutputError as error:
    print(error)
"""


@pytest.mark.parametrize(("limit", "n_frames"), [(100_000, 60), (20_000, 1)])
def test_a_full_disk_leaves_nothing(tmp_path: Path, limit: int, n_frames: int) -> None:
    """A limit on the size of files fails as a full disk does, while writing or at the end."""
    path = tmp_path / "out.mp4"
    command = [sys.executable, "-c", FILL_THE_DISK, str(path), str(limit), str(n_frames)]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    assert "out.mp4 can't be written: the file would grow too large" in done.stdout
    assert list(tmp_path.iterdir()) == []
