"""One moment of a stored trial, for a person who says whom to follow, or when something happened.

The pictures come from the annotated video, so that heads are covered here as everywhere.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from engine.errors import DataError
from engine.storage.results import StoredResult
from engine.video.reader import read_frames
from engine.video.sync import resample_views

__all__ = ["Box", "People", "ViewClock", "draw_boxes", "find_people", "read_clocks", "read_moment"]

Box = tuple[float, float, float, float]
"""Left, top, right, bottom, px of the original picture."""

COLOURS = ((0, 158, 115), (230, 159, 0), (204, 121, 167), (86, 180, 233), (240, 228, 66))
"""Okabe and Ito's, without the two of the skeleton's sides; a number stands beside each."""
OUTLINE = (20, 22, 26)


@dataclass(frozen=True)
class ViewClock:
    """How a trial's time and that of one of its videos belong together."""

    start_s: float = 0.0
    rate: float = 1.0
    drawn_from_s: float = 0.0
    """In the trial's time: where the annotated video begins."""

    def to_view(self, time_s: float) -> float:
        """Return a moment of the trial in the view's own time."""
        return time_s * self.rate + self.start_s

    def to_trial(self, time_s: float) -> float:
        """Return a moment of the view in the trial's time."""
        return (time_s - self.start_s) / self.rate


@dataclass(frozen=True)
class People:
    """Who was seen in one picture: the person followed, if any, first among the boxes."""

    time_s: float
    boxes: tuple[Box, ...]
    is_followed: bool


def read_clocks(stored: StoredResult) -> tuple[ViewClock, ...]:
    """Return the clock of every view of a trial."""
    if stored.sync is None:
        return (ViewClock(drawn_from_s=float(stored.views[0].image.time_s[0])),)
    synced = resample_views(stored.views, stored.sync)
    return (
        ViewClock(synced.start_in_first_s),
        ViewClock(synced.start_in_second_s, synced.rate_in_second),
    )


def find_people(stored: StoredResult, view: int, at_s: float) -> People:
    """Return who was seen in the picture nearest to a moment of a view's own time."""
    pose = stored.views[view]
    row = int(np.argmin(np.abs(pose.image.time_s - at_s)))
    left, top, right, bottom = (float(edge) for edge in pose.box[row])
    is_followed = bool(np.isfinite([left, top, right, bottom]).all())
    others = [
        (float(b.left), float(b.top), float(b.right), float(b.bottom))
        for b in (pose.others[row] if pose.others else ())
    ]
    own = [(left, top, right, bottom)] if is_followed else []
    return People(float(pose.image.time_s[row]), (*own, *others), is_followed)


def read_moment(stored: StoredResult, view: int, at_s: float) -> NDArray[np.uint8]:
    """Return the picture of the annotated video at a moment of the trial, (H, W, 3) RGB.

    Raises
    ------
    DataError
        If the trial was saved without its annotated video.
    VideoError
        If the video can't be read.
    """
    path = (stored.overlay_path, stored.second_overlay_path)[view]
    if path is None:
        raise DataError("This trial was saved without its annotated video; there is no picture.")
    clock = read_clocks(stored)[view]
    half = 0.5 / max(stored.views[view].info.fps, 1.0)
    start_s = max(0.0, at_s - clock.drawn_from_s - half)
    return np.array(next(iter(read_frames(path, start_s=start_s))).image)


def draw_boxes(
    image: NDArray[np.uint8], boxes: Sequence[Box], *, width_px: int, chosen: int | None = None
) -> NDArray[np.uint8]:
    """Return a picture with numbered boxes; the chosen one is thick, the others thin.

    Parameters
    ----------
    image
        Shape (H, W, 3), RGB; maybe smaller than the original picture.
    boxes
        In px of the original picture, which was `width_px` wide.
    width_px
        Of the original picture.
    chosen
        Which of the boxes is chosen.
    """
    drawn = np.array(image)
    scale = drawn.shape[1] / width_px
    unit = max(1, round(min(drawn.shape[:2]) / 240))
    for number, box in enumerate(boxes):
        left, top, right, bottom = (round(edge * scale) for edge in box)
        colour = COLOURS[number % len(COLOURS)]
        thickness = unit * (2 if number == chosen else 1)
        for line, shade in ((thickness + unit, OUTLINE), (thickness, colour)):
            cv2.rectangle(drawn, (left, top), (right, bottom), shade, line)
        _write_number(drawn, str(number + 1), (left, top), colour, unit)
    return drawn


def _write_number(
    image: NDArray[np.uint8], text: str, corner: tuple[int, int], colour: Sequence[int], unit: int
) -> None:
    size = 18 * unit
    x = int(np.clip(corner[0], 0, image.shape[1] - size))
    y = int(np.clip(corner[1], 0, image.shape[0] - size))
    cv2.rectangle(image, (x, y), (x + size, y + size), OUTLINE, cv2.FILLED)
    at = (x + 4 * unit, y + size - 4 * unit)
    cv2.putText(image, text, at, cv2.FONT_HERSHEY_SIMPLEX, 0.5 * unit, tuple(colour), unit)
