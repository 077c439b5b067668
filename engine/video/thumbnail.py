"""A small still picture of a trial, for lists."""

from __future__ import annotations

from pathlib import Path

import cv2

from engine.errors import OutputError
from engine.video.reader import read_frames

__all__ = ["write_thumbnail"]


def write_thumbnail(video: Path, out: Path, *, at_s: float = 0.0, max_side_px: int = 480) -> Path:
    """Write the first picture of a video at or after a time as JPEG.

    Parameters
    ----------
    video
        The annotated video, so that heads are covered here whenever they are there.
    out
        The file to write.
    at_s
        Time in the video, s.
    max_side_px
        The longer side of the picture.

    Raises
    ------
    VideoError
        If the video can't be read, or ends before that time.
    OutputError
        If the picture can't be written.
    """
    frames = read_frames(video, start_s=at_s, max_side_px=max_side_px)
    image = next(iter(frames)).image
    if not cv2.imwrite(str(out), cv2.cvtColor(image, cv2.COLOR_RGB2BGR)):
        raise OutputError(f"The picture {out} can't be written; check the folder and free space.")
    return out
