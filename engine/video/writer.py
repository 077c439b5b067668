"""Writing of H.264 video that browsers play.

A file appears under its name only when it is whole: it is written beside, under a
hidden name, and renamed at the end. Sound is never written.
"""

from __future__ import annotations

import errno
import logging
import os
import uuid
from collections.abc import Iterator
from contextlib import contextmanager
from fractions import Fraction
from pathlib import Path
from types import TracebackType
from typing import Self, cast

import av
import av.error
import cv2
import numpy as np
from av.container import OutputContainer
from av.video.frame import VideoFrame
from av.video.stream import VideoStream
from numpy.typing import NDArray

from engine.errors import DataError, OutputError, ShapeError

__all__ = ["VideoWriter"]

logger = logging.getLogger(__name__)

TIME_BASE = Fraction(1, 90_000)
"""Divides every usual frame rate without rest; rounds others by less than 6 microseconds."""
KEY_PICTURE_EVERY = 15
"""A player that jumps decodes at most this many pictures: scrubbing stays fluent."""
BT709 = 1
"""Code point of BT.709 primaries and transfer, those of sRGB displays (ITU-T H.273)."""
BT601 = 6
"""Code point of the BT.601 (SMPTE 170M) matrix between RGB and luma and colour difference."""
LIMITED_RANGE = 1
MAX_ENCODER_THREADS = 4
REASONS = {
    errno.ENOSPC: "the disk is full; free some space or choose another folder",
    errno.EDQUOT: "your share of the disk is used up; free some space or choose another folder",
    errno.EFBIG: "the file would grow too large for this disk; choose another folder",
    errno.EACCES: "you may not write there; choose another folder",
    errno.EPERM: "you may not write there; choose another folder",
    errno.EROFS: "that disk is read-only; choose another folder",
    errno.ENOENT: "the folder does not exist; create it or choose another one",
    errno.ENOTDIR: "the folder does not exist; create it or choose another one",
}


class VideoWriter:
    """Writes pictures with their times into an MP4 file (H.264, yuv420p, fast start).

    Use it as a context manager: the file appears when the block ends well, and nothing
    is left behind when it does not.

    Parameters
    ----------
    path
        The file to write; replaced if it exists.
    crf
        Constant rate factor of x264: smaller is better and larger; 24 is hard to tell from the
        source at normal size.
    preset
        Speed preset of x264; the default takes half the time of `superfast` and a quarter more
        space at the same quality.

    Raises
    ------
    OutputError
        If the folder or disk does not take the file.

    Notes
    -----
    The first picture sets the size; an odd size is made even by repeating the last row
    or column. There are no B-pictures, so the edit list shifts nothing: the file begins at 0 with
    the first picture, and each further picture keeps its distance in time to it.
    """

    def __init__(self, path: Path, *, crf: int = 24, preset: str = "ultrafast") -> None:
        self.path = Path(path)
        self.n_frames = 0
        self._options = {"crf": str(crf), "preset": preset, "bf": "0"}
        self._part = self.path.with_name(f".{self.path.name}.{uuid.uuid4().hex}.part")
        self._container: OutputContainer | None = None
        self._stream: VideoStream | None = None
        self._shape: tuple[int, ...] = ()
        self._first_s = 0.0
        self._last_tick = -1

    def __enter__(self) -> Self:
        with _translate_errors(self.path):
            if not self.path.parent.is_dir():
                raise NotADirectoryError(errno.ENOENT, "no such folder")
            self._container = av.open(
                f"file:{self._part}", mode="w", format="mp4", options={"movflags": "+faststart"}
            )
        return self

    def write(self, image: NDArray[np.uint8], time_s: float) -> None:
        """Add one picture.

        Parameters
        ----------
        image
            Shape (H, W, 3), RGB.
        time_s
            Its time; must increase by at least 1/90000 s from picture to picture.

        Raises
        ------
        ShapeError
            If the image has another shape than the first.
        DataError
            If the time does not increase.
        OutputError
            If the disk does not take it.
        """
        stream = self._stream or self._start(image, time_s)
        if image.shape != self._shape:
            raise ShapeError(f"All pictures need shape {self._shape}, got {image.shape}.")
        tick = round((time_s - self._first_s) / TIME_BASE)
        if tick <= self._last_tick:
            raise DataError(f"The time of a picture must increase, got {time_s:g} s.")
        self._last_tick = tick
        picture = _encode_colours(_pad_to_even(image))
        picture.pts, picture.time_base = tick, TIME_BASE
        with _translate_errors(self.path):
            self._mux(stream, picture)
        self.n_frames += 1

    def _start(self, image: NDArray[np.uint8], time_s: float) -> VideoStream:
        if image.ndim != 3 or image.shape[2] != 3 or image.dtype != np.uint8:
            raise ShapeError(
                f"A picture needs shape (H, W, 3) of uint8, got {image.shape} of {image.dtype}."
            )
        if self._container is None:
            raise OutputError(f"{self.path.name} is not open; use the writer in a `with` block.")
        stream = self._container.add_stream("libx264", rate=30, options=self._options)
        stream.height, stream.width = (side + side % 2 for side in image.shape[:2])
        stream.pix_fmt = "yuv420p"
        context = stream.codec_context
        context.time_base = TIME_BASE
        context.gop_size = KEY_PICTURE_EVERY
        context.color_primaries = context.color_trc = BT709
        context.colorspace, context.color_range = BT601, LIMITED_RANGE
        context.thread_count = min(MAX_ENCODER_THREADS, os.cpu_count() or 1)
        self._shape, self._first_s, self._stream = image.shape, time_s, stream
        return stream

    def _mux(self, stream: VideoStream, picture: VideoFrame | None) -> None:
        if self._container is not None:
            self._container.mux(stream.encode(picture))

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        try:
            self._close(is_whole=kind is None)
        finally:
            self._part.unlink(missing_ok=True)

    def _close(self, *, is_whole: bool) -> None:
        container, self._container = self._container, None
        if container is None:
            return
        if not is_whole:
            try:
                container.close()
            except (OSError, av.error.FFmpegError) as error:
                logger.debug("Closing the unfinished %s: %s", self._part, error)
            return
        if self._stream is None:
            container.close()
            raise OutputError(f"{self.path.name} was not written: expected pictures, got none.")
        with _translate_errors(self.path):
            container.mux(self._stream.encode(None))
            container.close()
            self._part.replace(self.path)


@contextmanager
def _translate_errors(path: Path) -> Iterator[None]:
    try:
        yield
    except (OSError, av.error.FFmpegError) as error:
        reason = REASONS.get(error.errno or 0, f"{error.strerror or error}; choose another folder")
        raise OutputError(f"{path} can't be written: {reason}.") from error


def _pad_to_even(image: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Repeat the last row or column where a side is odd (4:2:0 colour needs even sides)."""
    height, width = image.shape[:2]
    if height % 2 or width % 2:
        return np.pad(image, ((0, height % 2), (0, width % 2), (0, 0)), mode="edge")
    return image


def _encode_colours(image: NDArray[np.uint8]) -> VideoFrame:
    # OpenCV's conversion (BT.601, limited range) takes a tenth of the time of swscale's.
    planes = cv2.cvtColor(image, cv2.COLOR_RGB2YUV_I420)
    return VideoFrame.from_ndarray(cast("NDArray[np.uint8]", planes), format="yuv420p")
