"""The picture of a moment: only ever from the annotated video, and only if heads are covered."""

from __future__ import annotations

import io
import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

from engine.errors import VideoError
from engine.storage.results import StoredResult

if TYPE_CHECKING:
    from PIL.Image import Image

__all__ = ["NoPicture", "Photo", "take_photo"]

MAX_SIDE_PX = 900
JPEG_QUALITY = 80
FROM_END_S = 0.5
"""A moment at the very end may lie behind the last picture: the reader then looks earlier."""


@dataclass(frozen=True)
class Photo:
    """A JPEG with its size in px."""

    jpeg: bytes
    width_px: int
    height_px: int


@dataclass(frozen=True)
class NoPicture:
    """Why there is none: a key of the reports' wording."""

    reason: str


def take_photo(stored: StoredResult, time_s: float) -> Photo | NoPicture:
    """Take one picture out of a result's annotated video.

    Parameters
    ----------
    stored
        The result.
    time_s
        The moment, in the time of the trial.
    """
    if stored.overlay_path is None:
        return NoPicture("no_video")
    if not are_heads_covered(stored):
        return NoPicture("not_blurred")
    image = _read_image(stored, time_s)
    if image is None:
        return NoPicture("unreadable_video")
    buffer = io.BytesIO()
    image.save(buffer, "JPEG", quality=JPEG_QUALITY, optimize=True)
    return Photo(buffer.getvalue(), *image.size)


def are_heads_covered(stored: StoredResult) -> bool:
    """Whether the annotated video was made with heads covered; in doubt it was not."""
    config = stored.document.get("config")
    output = config.get("output") if isinstance(config, dict) else None
    return isinstance(output, dict) and output.get("blur_heads") is True


def _read_image(stored: StoredResult, time_s: float) -> Image | None:
    # Reading video takes a third of a second to load; most summaries need none.
    from PIL.Image import fromarray

    from engine.video.reader import read_frames

    assert stored.overlay_path is not None  # asked before
    # The annotated video begins at 0 with the first picture that was measured.
    times = stored.views[0].image.time_s if stored.views else stored.corrected.time_s
    wanted = max(0.0, time_s - float(times[0])) if times.size else 0.0
    for start_s in (wanted, max(0.0, wanted - FROM_END_S)):
        if not math.isfinite(start_s):
            return None
        try:
            frames = read_frames(stored.overlay_path, start_s=start_s, max_side_px=MAX_SIDE_PX)
            return fromarray(next(iter(frames)).image)
        except (VideoError, StopIteration):
            continue
    return None
