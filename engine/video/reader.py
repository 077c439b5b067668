"""Reading of video files: what a file holds, and its pictures one by one.

Pictures come upright (rotation and mirroring of the file are applied), as RGB with
8 bits, with their true time stamps in seconds after the first picture of the file.
Only a few pictures are in memory at a time, however long the video is.

Nothing but the file itself is opened: formats that name other files or addresses
(play lists) are refused.
"""

from __future__ import annotations

import hashlib
import logging
import math
import os
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from fractions import Fraction
from itertools import chain
from pathlib import Path
from typing import NoReturn, cast

import av
import av.error
import cv2
import numpy as np
from av.container import InputContainer
from av.packet import Packet
from av.stream import Disposition
from av.video.frame import VideoFrame
from av.video.stream import VideoStream
from numpy.typing import NDArray

from engine.datatypes import Array, Frame, ViewInfo
from engine.errors import ConfigError, VideoError

__all__ = ["probe_video", "read_frames"]

logger = logging.getLogger(__name__)

EXPECTED = "a video such as MP4, MOV, WebM, MKV or AVI"
FORMATS = "mov,matroska,webm,avi,mpegts,mpeg,asf,flv,ogg,mxf,ivf,h264,hevc,mjpeg"
OPEN_OPTIONS = {"format_whitelist": FORMATS, "protocol_whitelist": "file"}

MAX_DECODER_THREADS = 4
"""Each thread of the decoder holds a picture of its own: bounds the memory on big machines."""
SEEK_FROM_S = 1.0
"""Below this start the pictures before it are decoded and dropped; above it the reader jumps."""
TIME_TOLERANCE_S = 1e-6
ROTATIONS = {
    1: cv2.ROTATE_90_CLOCKWISE,
    2: cv2.ROTATE_180,
    3: cv2.ROTATE_90_COUNTERCLOCKWISE,
}
RATE_TOLERANCE = 0.10
"""A step between pictures that differs more than this share from the usual one is irregular."""


def probe_video(path: Path) -> ViewInfo:
    """Find out what a video file holds, without decoding more than its first picture.

    The packets of the whole file are counted, so the number of frames is exact, as are
    the duration and the mean rate. `n_missing_frames` tells how many more frames
    the file announces than it holds (it was cut off).

    Parameters
    ----------
    path
        The video file.

    Returns
    -------
    ViewInfo
        `size_px` as shown (upright, square pixels); `rotation_deg` clockwise (0, 90, 180 or
        270), as applied to show the picture upright.

    Raises
    ------
    VideoError
        If there is no such file or it holds no video that can be decoded.
    """
    path = Path(path)
    with _open_video(path) as (container, stream):
        census = _take_census(container, stream, path)
        if census.first is None:
            _raise_undecodable(path)
        orientation = _read_orientation(census.first)
        size_px = orientation.shown_size(*_square_size(census.first, stream))
        missing = census.count_missing(container, stream)
        fps = census.mean_rate(stream)
        is_variable_rate = census.is_irregular(stream)
        codec = stream.codec_context.name
    if missing:
        logger.warning("%s announces %d more frames than it holds.", path.name, missing)
    return ViewInfo(
        file_name=path.name,
        sha256=_hash_file(path),
        fps=fps,
        n_frames=census.n_frames,
        size_px=size_px,
        duration_s=census.n_frames / fps,
        codec=codec,
        rotation_deg=orientation.clockwise_deg,
        is_variable_rate=is_variable_rate,
        n_missing_frames=missing,
    )


def read_frames(
    path: Path,
    *,
    start_s: float = 0.0,
    stop_s: float | None = None,
    max_side_px: int | None = None,
) -> Iterator[Frame]:
    """Read the pictures of a video one by one.

    Parameters
    ----------
    path
        The video file.
    start_s, stop_s
        Part to read, seconds after the first picture of the file: `start_s` <= time <
        `stop_s`; None reads to the end.
    max_side_px
        Pictures whose longer side exceeds this come smaller, in their own proportions; the
        factor is ``image.shape[1] / ViewInfo.size_px[0]``. By default pictures come in full.

    Yields
    ------
    Frame
        `index` counts the delivered frames from 0; `time_s` increases strictly. A
        picture that can't be decoded, or whose time does not increase, is left
        out and a warning is logged.

    Raises
    ------
    VideoError
        If there is no such file, or nothing in it can be decoded, or nothing lies in the part.
    ConfigError
        If the part or `max_side_px` makes no sense.

    Notes
    -----
    A picture in memory takes width x height x 3 bytes, one of 7680 x 4320 px 100 MB; the
    decoder holds up to some twenty at half that size. `max_side_px` spares the first.
    """
    # Checked here, not in the generator: a wrong call fails where it is made.
    _require_part(start_s, stop_s)
    if max_side_px is not None and max_side_px < 2:
        raise ConfigError(f"max_side_px must be at least 2, got {max_side_px}.")
    _require_file(Path(path))
    return _read_part(Path(path), start_s, math.inf if stop_s is None else stop_s, max_side_px)


def _read_part(
    path: Path, start_s: float, stop_s: float, max_side_px: int | None
) -> Iterator[Frame]:
    index = 0
    time_s = math.nan
    for time_s, image in _iterate_images(path, start_s, stop_s, max_side_px):
        if image is not None:
            yield Frame(index=index, time_s=time_s, image=image)
            index += 1
    if math.isnan(time_s):
        _raise_undecodable(path)
    if index == 0:
        part = f"from {start_s:g} s on" if math.isinf(stop_s) else f"{start_s:g} to {stop_s:g} s"
        raise VideoError(
            f"{path.name} has no picture in the part asked for ({part}): "
            f"its last one is at {time_s:.2f} s. Choose a part within the video."
        )


def _iterate_images(
    path: Path, start_s: float, stop_s: float, max_side_px: int | None, *, may_jump: bool = True
) -> Iterator[tuple[float, NDArray[np.uint8] | None]]:
    """Yield times up to `stop_s`, with an image from `start_s` on."""
    with _open_video(path) as (container, stream):
        pictures = _decode(container, stream, path)
        first = next(pictures, None)
        if first is None:
            return
        clock = _Clock.start_at(first, container, stream)
        convert = _Converter.plan(first, stream, max_side_px)
        pictures = chain([first], pictures)
        if may_jump and start_s >= SEEK_FROM_S and not clock.counts_pictures:
            jumped = _jump(container, stream, path, clock, start_s)
            if jumped is None:
                yield from _iterate_images(path, start_s, stop_s, max_side_px, may_jump=False)
                return
            pictures = jumped
        try:
            for picture in pictures:
                time_s = clock.stamp(picture)
                if time_s is None:
                    continue
                if time_s >= stop_s - TIME_TOLERANCE_S:
                    return
                wanted = time_s >= start_s - TIME_TOLERANCE_S
                yield time_s, convert(picture) if wanted else None
        finally:
            clock.report(path)


def _jump(
    container: InputContainer, stream: VideoStream, path: Path, clock: _Clock, start_s: float
) -> Iterator[VideoFrame] | None:
    """Return the pictures from a key picture at or before `start_s` on.

    None if the file lands elsewhere: some have no index, or a wrong one.
    """
    origin = clock.origin or 0
    target = origin + math.floor(start_s / clock.unit_s)
    try:
        container.seek(target, stream=stream, backward=True)
    except av.error.FFmpegError:
        return None
    pictures = _decode(container, stream, path)
    landed = next(pictures, None)
    if landed is None or landed.pts is None:
        return None
    if (landed.pts - origin) * clock.unit_s > start_s + TIME_TOLERANCE_S:
        return None
    return chain([landed], pictures)


@contextmanager
def _open_video(path: Path) -> Iterator[tuple[InputContainer, VideoStream]]:
    """Open a file and choose its first video stream that is no cover picture."""
    _require_file(path)
    try:
        container = av.open(f"file:{path}", mode="r", options=dict(OPEN_OPTIONS))
    except av.error.FFmpegError as error:
        raise VideoError(
            f"{path.name} can't be read as a video: expected {EXPECTED}, got something else or a "
            f"file that was cut off ({error.strerror}). Export or copy it again."
        ) from error
    with container:
        yield container, _choose_stream(container, path)


def _choose_stream(container: InputContainer, path: Path) -> VideoStream:
    streams = [s for s in container.streams.video if Disposition.attached_pic not in s.disposition]
    if not streams:
        raise VideoError(
            f"{path.name} holds no moving picture: expected {EXPECTED}, got sound or data only. "
            "Choose the video file."
        )
    stream = streams[0]
    if stream.codec_context is None:
        raise VideoError(
            f"{path.name} is coded in a way that can't be decoded here; "
            "expected H.264, HEVC, VP9 or MJPEG. Convert it to MP4 (H.264)."
        )
    stream.thread_type = "AUTO"
    stream.codec_context.thread_count = min(MAX_DECODER_THREADS, os.cpu_count() or 1)
    return stream


def _require_file(path: Path) -> None:
    if path.is_dir():
        raise VideoError(f"{path} is a folder; expected {EXPECTED}. Give the file in it.")
    if not path.is_file():
        raise VideoError(f"There is no file {path}; expected {EXPECTED}. Check the path.")
    try:
        with path.open("rb") as file:
            empty = not file.read(1)
    except OSError as error:
        raise VideoError(
            f"{path} can't be opened ({error.strerror}); expected a readable video file. "
            "Check who may read it."
        ) from error
    if empty:
        raise VideoError(
            f"{path.name} is empty (0 bytes); expected {EXPECTED}. Copy it again from the camera."
        )


def _require_part(start_s: float, stop_s: float | None) -> None:
    if not math.isfinite(start_s) or start_s < 0:
        raise ConfigError(f"The start must be 0 s or later, got {start_s:g} s.")
    if stop_s is not None and not stop_s > start_s:
        raise ConfigError(
            f"The stop must come after the start at {start_s:g} s, got {stop_s:g} s; "
            "leave it out to read to the end."
        )


def _raise_undecodable(path: Path) -> NoReturn:
    raise VideoError(
        f"No picture of {path.name} can be decoded: expected {EXPECTED}, got a damaged file "
        "or one that was cut off. Copy it again from the camera."
    )


def _hash_file(path: Path) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def _demux(
    container: InputContainer, stream: VideoStream, path: Path
) -> Iterator[Packet[VideoStream]]:
    """Yield the whole packets; stops where the file ends too early."""
    try:
        for packet in container.demux(stream):
            if packet.is_corrupt:
                logger.warning("%s: an incomplete picture was left out.", path.name)
            else:
                yield packet
    except av.error.FFmpegError as error:
        logger.warning("%s ends too early: %s.", path.name, error.strerror)


def _decode(container: InputContainer, stream: VideoStream, path: Path) -> Iterator[VideoFrame]:
    """Yield the pictures that can be decoded, in the order they are shown."""
    n_damaged = 0
    try:
        for packet in _demux(container, stream, path):
            try:
                pictures = packet.decode()
            except av.error.FFmpegError:
                n_damaged += 1
            else:
                yield from pictures
    finally:
        if n_damaged:
            logger.warning("%s: %d damaged pictures were left out.", path.name, n_damaged)


def _is_timed_by_decoding(container: InputContainer, stream: VideoStream) -> bool:
    """Whether the stamps belong to the order of decoding: AVI with reordered pictures."""
    return "avi" in container.format.name.split(",") and bool(stream.codec_context.has_b_frames)


def _nominal_rate(stream: VideoStream) -> float:
    """Return the rate the file states, frames per second."""
    return float(stream.average_rate or stream.guessed_rate or 25)


@dataclass
class _Clock:
    """Gives every picture its time; counts what had to be guessed or left out."""

    origin: int | None
    unit_s: float
    step_s: float
    counts_pictures: bool
    last_s: float = -math.inf
    n_guessed: int = 0
    n_repeated: int = 0

    @classmethod
    def start_at(cls, first: VideoFrame, container: InputContainer, stream: VideoStream) -> _Clock:
        unit = first.time_base or stream.time_base or Fraction(1, 1)
        return cls(
            origin=first.pts,
            unit_s=float(unit),
            step_s=1.0 / _nominal_rate(stream),
            counts_pictures=first.pts is None or _is_timed_by_decoding(container, stream),
        )

    def stamp(self, picture: VideoFrame) -> float | None:
        """Return seconds after the first picture; None if the time does not increase."""
        if self.counts_pictures or picture.pts is None or self.origin is None:
            self.n_guessed += 1
            time_s = 0.0 if math.isinf(self.last_s) else self.last_s + self.step_s
        else:
            time_s = (picture.pts - self.origin) * self.unit_s
        if time_s <= self.last_s:
            self.n_repeated += 1
            return None
        self.last_s = time_s
        return time_s

    def report(self, path: Path) -> None:
        """Log what is not as the file says."""
        if self.n_guessed:
            logger.warning(
                "%s: %d pictures carry no time stamp; their times follow from %.3f frames/s.",
                path.name,
                self.n_guessed,
                1.0 / self.step_s,
            )
        if self.n_repeated:
            logger.warning(
                "%s: %d pictures with a repeated or earlier time stamp were left out.",
                path.name,
                self.n_repeated,
            )


@dataclass(frozen=True)
class _Orientation:
    """How a stored picture becomes upright: mirrored left-right first, then turned clockwise."""

    is_mirrored: bool = False
    quarter_turns: int = 0

    @property
    def clockwise_deg(self) -> int:
        return 90 * self.quarter_turns

    def shown_size(self, width: int, height: int) -> tuple[int, int]:
        return (height, width) if self.quarter_turns % 2 else (width, height)

    def apply(self, image: NDArray[np.uint8]) -> NDArray[np.uint8]:
        if self.is_mirrored:
            image = cast("NDArray[np.uint8]", cv2.flip(image, 1))
        if self.quarter_turns:
            turn = ROTATIONS[self.quarter_turns]
            image = cast("NDArray[np.uint8]", cv2.rotate(image, turn))
        return image


def _read_orientation(picture: VideoFrame) -> _Orientation:
    """Read the display matrix: shown x = a x + c y, shown y = b x + d y, y down."""
    side_data = picture.side_data.get("DISPLAYMATRIX")
    if side_data is None:
        return _Orientation()
    a, b, _, c, d = np.frombuffer(cast("bytes", side_data), dtype=np.int32)[:5].astype(float)
    is_mirrored = a * d - b * c < 0
    if is_mirrored:
        a, b = -a, -b
    return _Orientation(is_mirrored, round(math.degrees(math.atan2(b, a)) / 90.0) % 4)


def _square_size(picture: VideoFrame, stream: VideoStream) -> tuple[int, int]:
    """Return width and height in square pixels, as stored."""
    aspect = float(stream.sample_aspect_ratio or 1)
    if not 0.1 < aspect < 10:
        aspect = 1.0
    return max(1, round(picture.width * aspect)), picture.height


@dataclass(frozen=True)
class _Converter:
    """Turns a decoded picture into an upright RGB array of the planned size."""

    width: int
    height: int
    orientation: _Orientation

    @classmethod
    def plan(cls, first: VideoFrame, stream: VideoStream, max_side_px: int | None) -> _Converter:
        width, height = _square_size(first, stream)
        factor = 1.0 if max_side_px is None else min(1.0, max_side_px / max(width, height))
        return cls(
            max(1, round(width * factor)), max(1, round(height * factor)), _read_orientation(first)
        )

    def __call__(self, picture: VideoFrame) -> NDArray[np.uint8]:
        smaller = self.width < picture.width
        image = picture.to_ndarray(
            format="rgb24",
            width=self.width,
            height=self.height,
            interpolation="AREA" if smaller else "BILINEAR",
            threads=1,  # a pool per picture costs more than it gains
        )
        return self.orientation.apply(cast("NDArray[np.uint8]", image))


@dataclass
class _Census:
    """What a pass over all packets found; times in the stream's unit."""

    first: VideoFrame | None = None
    n_packets: int = 0
    n_untimed: int = 0
    ticks: list[int] = field(default_factory=list)

    @property
    def n_frames(self) -> int:
        return len(set(self.ticks)) + self.n_untimed

    def _steps_s(self, stream: VideoStream) -> Array:
        unit_s = float(stream.time_base or 1)
        return np.diff(np.unique(np.asarray(self.ticks, dtype=np.float64))) * unit_s

    def mean_rate(self, stream: VideoStream) -> float:
        """Return frames per second, from the time stamps where there are two or more."""
        steps_s = self._steps_s(stream)
        if self.n_untimed or not steps_s.size:
            return _nominal_rate(stream)
        return float(1.0 / steps_s.mean())

    def is_irregular(self, stream: VideoStream) -> bool:
        """Whether some step differs from the usual one by more than rounding."""
        steps_s = self._steps_s(stream)
        if self.n_untimed or steps_s.size < 2:
            return False
        usual_s = float(np.median(steps_s))
        tolerance_s = RATE_TOLERANCE * usual_s + 1.5 * float(stream.time_base or 0)
        return bool(np.any(np.abs(steps_s - usual_s) > tolerance_s))

    def count_missing(self, container: InputContainer, stream: VideoStream) -> int:
        """Return how many frames the file announces beyond those it holds."""
        formats = container.format.name.split(",")
        if "mov" in formats:
            announced = len(stream.index_entries)
        elif "matroska" in formats and len(container.streams) == 1 and container.duration:
            # The header tells the length only; a rounding of one frame is not a loss.
            announced = round(container.duration / av.time_base * self.mean_rate(stream)) - 1
        else:
            announced = stream.frames
        return max(0, announced - self.n_packets)


def _take_census(container: InputContainer, stream: VideoStream, path: Path) -> _Census:
    """Count all packets, decode up to the first picture."""
    census = _Census()
    for packet in _demux(container, stream, path):
        if census.first is None:
            try:
                census.first = next(iter(packet.decode()), None)
            except av.error.FFmpegError:
                logger.warning("%s: a damaged picture was left out.", path.name)
        if not packet.size:
            continue
        census.n_packets += 1
        if packet.is_discard:
            continue
        if packet.pts is None:
            census.n_untimed += 1
        else:
            census.ticks.append(packet.pts)
    return census
