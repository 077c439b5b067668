"""The measured skeleton drawn over the video, with heads covered.

Left is blue and right vermillion (Okabe and Ito's colours, which colour-blind people can
tell apart); what is not sure is dashed, what is hardly seen is left out.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import lru_cache
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont

from engine.datatypes import Array, Lift, ProgressCallback, ViewPose, ignore_progress
from engine.errors import DataError
from engine.skeletons import get_skeleton
from engine.video.privacy import BlurRegion, blur_regions, estimate_head_regions
from engine.video.reader import read_frames
from engine.video.writer import VideoWriter

__all__ = ["OverlayPainter", "draw_pose", "write_overlay"]

Colour = tuple[int, int, int]

LEFT: Colour = (64, 156, 232)
RIGHT: Colour = (240, 108, 26)
MIDDLE: Colour = (245, 245, 245)
OUTLINE: Colour = (20, 22, 26)

SURE = 0.5
"""From this confidence on a keypoint is drawn in full, below it dashed."""
HARDLY_SEEN = 0.2
"""Below this confidence a keypoint is not drawn."""
LINE_SHARE = 0.0055
"""Width of a bone as a share of the picture's shorter side."""
MAX_SIDE_PX = 1280
SUBPIXEL_BITS = 4
SUBPIXEL = 1 << SUBPIXEL_BITS


def draw_pose(image: NDArray[np.uint8], points: Array, confidence: Array, *, skeleton: str) -> None:
    """Draw the bones and joints of one person, in place.

    Parameters
    ----------
    image
        Shape (H, W, 3), RGB, uint8, writeable.
    points
        Shape (K, 2), px of this image; NaN where missing.
    confidence
        Shape (K,); an unknown one (NaN) counts as sure.
    skeleton
        Name of the skeleton whose keypoints these are.
    """
    width = max(1.5, LINE_SHARE * min(image.shape[:2]))
    missing = ~np.isfinite(points).all(axis=1) | (confidence < HARDLY_SEEN)
    sure = (~(confidence < SURE)).tolist()
    # OpenCV draws fixed-point px; far outside it would overflow.
    fixed = np.clip(np.where(missing[:, None], 0.0, points), -4096.0, 12288.0) * SUBPIXEL
    at: list[tuple[int, int]] = [(x, y) for x, y in np.rint(fixed).astype(int).tolist()]
    bones = [bone for bone in _bones(skeleton) if not missing[bone[0]] and not missing[bone[1]]]
    solid = [(i, j, colour) for i, j, colour in bones if sure[i] and sure[j]]
    for i, j, _ in solid:
        _draw_line(image, at[i], at[j], OUTLINE, width + max(2.0, 0.6 * width))
    for i, j, colour in bones:
        if not (sure[i] and sure[j]):
            _draw_dashes(image, at[i], at[j], colour, width)
    for i, j, colour in solid:
        _draw_line(image, at[i], at[j], colour, width)
    colours = _joint_colours(skeleton)
    for i in sorted({end for bone in solid for end in bone[:2]}):
        _draw_joint(image, at[i], colours[i], width)


@lru_cache(maxsize=8)
def _bones(skeleton: str) -> tuple[tuple[int, int, Colour], ...]:
    """Return the two columns and the colour of every bone."""
    known = get_skeleton(skeleton)
    return tuple((known.index(a), known.index(b), _side_colour(a, b)) for a, b in known.edges)


@lru_cache(maxsize=8)
def _joint_colours(skeleton: str) -> tuple[Colour, ...]:
    return tuple(_side_colour(name) for name in get_skeleton(skeleton).keypoints)


def _side_colour(*names: str) -> Colour:
    if all(name.startswith("left_") for name in names):
        return LEFT
    if all(name.startswith("right_") for name in names):
        return RIGHT
    return MIDDLE


def _draw_line(
    image: NDArray[np.uint8],
    start: tuple[int, int],
    end: tuple[int, int],
    colour: Colour,
    width: float,
) -> None:
    cv2.line(image, start, end, colour, max(1, round(width)), cv2.LINE_AA, SUBPIXEL_BITS)


def _draw_dashes(
    image: NDArray[np.uint8],
    start: tuple[int, int],
    end: tuple[int, int],
    colour: Colour,
    width: float,
) -> None:
    (x, y), dx, dy = start, end[0] - start[0], end[1] - start[1]
    n_dashes = max(1, round(math.hypot(dx, dy) / (5.5 * width * SUBPIXEL)))
    for k in range(n_dashes):
        a, b = (k + 0.25) / n_dashes, (k + 0.75) / n_dashes
        dash = (round(x + a * dx), round(y + a * dy)), (round(x + b * dx), round(y + b * dy))
        _draw_line(image, *dash, colour, 0.6 * width)


def _draw_joint(
    image: NDArray[np.uint8], point: tuple[int, int], colour: Colour, width: float
) -> None:
    for radius, fill in ((1.25 * width + 1.0, OUTLINE), (1.25 * width, colour)):
        fixed = round(radius * SUBPIXEL)
        cv2.circle(image, point, fixed, fill, -1, cv2.LINE_AA, SUBPIXEL_BITS)


class OverlayPainter:
    """Paints what is known of a moment into its picture: covers, skeleton, caption.

    Parameters
    ----------
    pose
        Keypoints and boxes of the view, in px of the original picture and the file's time.
    lifts
        Lifts of the trial, named in the caption while they last.
    blur_heads
        Whether heads are covered.
    time_offset_s
        Added to the file's time gives the time of the trial (that of `lifts` and caption).
    """

    def __init__(
        self,
        pose: ViewPose,
        *,
        lifts: Sequence[Lift] = (),
        blur_heads: bool = True,
        time_offset_s: float = 0.0,
    ) -> None:
        self._pose = pose
        self._lifts = tuple(lifts)
        self._regions = estimate_head_regions(pose) if blur_heads else ()
        self._offset_s = time_offset_s
        times = pose.image.time_s
        # A picture farther from every sample than this was not measured.
        self._reach_s = 0.6 * float(np.median(np.diff(times))) if times.size > 1 else 0.1

    def paint(self, image: NDArray[np.uint8], time_s: float) -> None:
        """Paint into a picture, in place.

        Parameters
        ----------
        image
            Shape (H, W, 3), RGB, uint8, writeable; may be smaller than the original.
        time_s
            Its time in the file.
        """
        i, is_measured = self._nearest(time_s)
        scale = image.shape[1] / self._pose.info.size_px[0]
        if self._regions:
            blur_regions(image, self._regions_at(i, is_measured, scale))
        if is_measured:
            track = self._pose.image
            points = (track.position[i, :, :2] + 0.5) * scale - 0.5
            assert track.confidence is not None  # set by PoseTrack
            draw_pose(image, points, track.confidence[i], skeleton=self._pose.image.skeleton)
        _draw_caption(image, time_s + self._offset_s, self._phase(time_s + self._offset_s))

    def _nearest(self, time_s: float) -> tuple[int, bool]:
        times = self._pose.image.time_s
        i = int(np.argmin(np.abs(times - time_s)))
        return i, bool(abs(times[i] - time_s) <= self._reach_s)

    def _regions_at(self, i: int, is_measured: bool, scale: float) -> list[BlurRegion]:
        """Return the covers; between measured samples those of both neighbours, larger."""
        if is_measured:
            return [region.scaled(scale) for region in self._regions[i]]
        near = self._regions[max(0, i - 1) : i + 2]
        return [region.grown(1.25).scaled(scale) for regions in near for region in regions]

    def _phase(self, time_s: float) -> str:
        for k, lift in enumerate(self._lifts, start=1):
            if lift.start_s <= time_s <= lift.end_s:
                return f"Lift {k}"
            if lift.reach_start_s <= time_s < lift.start_s:
                return f"Lift {k}: reaching"
            if lift.end_s < time_s <= lift.return_end_s:
                return f"Lift {k}: returning"
        return ""


def write_overlay(
    path: Path,
    pose: ViewPose,
    out: Path,
    *,
    blur_heads: bool = True,
    lifts: Sequence[Lift] = (),
    start_s: float = 0.0,
    stop_s: float | None = None,
    time_offset_s: float = 0.0,
    max_side_px: int = MAX_SIDE_PX,
    progress: ProgressCallback = ignore_progress,
) -> int:
    """Write a video of the part that was measured, with the skeleton drawn over it.

    Only pictures within the time of `pose` are written: of others nobody knows whose heads to
    cover. The file's own time begins at 0 with its first picture.

    Parameters
    ----------
    path
        The video that was measured.
    pose
        What was measured in it, in px of the original picture and in the file's time.
    out
        The file to write (MP4, H.264); replaced if it exists.
    blur_heads
        Whether heads are covered.
    lifts
        Lifts of the trial, named in the caption.
    start_s, stop_s
        Part to write, in the file's time.
    time_offset_s
        Added to the file's time gives the time of the trial (that of `lifts` and caption).
    max_side_px
        The longer side of the pictures written is at most this.
    progress
        Called as ``progress("overlay", done, total)``; may raise `Cancelled`, and then
        nothing is written.

    Returns
    -------
    int
        Number of pictures written.

    Raises
    ------
    VideoError
        If the video can't be read.
    OutputError
        If the file can't be written.
    DataError
        If nothing was measured in the part.
    """
    times = pose.image.time_s
    wanted = times[(times >= start_s - 1e-6) & (times < (math.inf if stop_s is None else stop_s))]
    if not wanted.size:
        raise DataError("There is no measured picture in the part to draw; choose another part.")
    painter = OverlayPainter(pose, lifts=lifts, blur_heads=blur_heads, time_offset_s=time_offset_s)
    frames = read_frames(
        path,
        start_s=max(0.0, float(wanted[0])),
        stop_s=float(wanted[-1]) + 1e-3,
        max_side_px=max_side_px,
    )
    with VideoWriter(out) as writer:
        for frame in frames:
            image = np.require(frame.image, requirements=["C", "W"])
            painter.paint(image, frame.time_s)
            writer.write(image, frame.time_s)
            progress("overlay", writer.n_frames, int(wanted.size))
        return writer.n_frames


def _draw_caption(image: NDArray[np.uint8], time_s: float, phase: str) -> None:
    """Draw time and phase on the left, the meaning of the colours on the right, at the bottom."""
    size_px = max(12, round(0.030 * min(image.shape[:2])))
    margin = max(4, round(0.7 * size_px))
    text = f"{time_s:.2f} s" + (f"   {phase}" if phase else "")
    _blend(image, _label(text, size_px), margin, at_right=False)
    _blend(image, _legend(size_px), margin, at_right=True)


def _blend(image: NDArray[np.uint8], label: _Label, margin: int, *, at_right: bool) -> None:
    colour, cover = label
    height, width = cover.shape[:2]
    top = image.shape[0] - margin - height
    left = image.shape[1] - margin - width if at_right else margin
    if top < 0 or left < 0 or left + width > image.shape[1]:
        return  # too small a picture for a caption
    window = image[top : top + height, left : left + width]
    window[:] = (colour + window * (255 - cover).astype(np.uint16) // 255).astype(np.uint8)


_Label = tuple[NDArray[np.uint16], NDArray[np.uint8]]
"""Colour times opacity, and opacity (H, W, 1) in 0 to 255."""


@lru_cache(maxsize=8)
def _font(size_px: int) -> ImageFont.FreeTypeFont | ImageFont.ImageFont:
    return ImageFont.load_default(size=size_px)


@lru_cache(maxsize=64)
def _text_width(text: str, size_px: int) -> int:
    return math.ceil(_font(size_px).getlength(text))


def _label(text: str, size_px: int) -> _Label:
    """Compose white text on a dark, rounded, half transparent plate, from ready characters."""
    left, right = _plate_ends(size_px)
    pieces = [left, *(_character(c, size_px) for c in text), right]
    return np.hstack([p[0] for p in pieces]), np.hstack([p[1] for p in pieces])


@lru_cache(maxsize=256)
def _character(character: str, size_px: int) -> _Label:
    """Render one character; all digits are as wide as 0, so that a running time does not twitch."""
    width = _text_width("0" if character.isdigit() else character, size_px)
    plate, draw = _plate(width, size_px, corner=0)
    at = (width / 2, plate.height / 2)
    draw.text(at, character, font=_font(size_px), fill=(255,) * 4, anchor="mm")
    return _premultiply(plate)


@lru_cache(maxsize=8)
def _plate_ends(size_px: int) -> tuple[_Label, _Label]:
    half = size_px // 2
    colour, cover = _premultiply(_plate(2 * half, size_px)[0])
    return (colour[:, :half], cover[:, :half]), (colour[:, half:], cover[:, half:])


@lru_cache(maxsize=4)
def _legend(size_px: int) -> _Label:
    """Render which colour is which side."""
    entries = (("left", LEFT), ("right", RIGHT))
    widths = [_text_width(name, size_px) + round(1.4 * size_px) for name, _ in entries]
    plate, draw = _plate(sum(widths) + size_px // 2, size_px)
    x, middle, radius = size_px // 2, plate.height / 2, 0.3 * size_px
    for (name, colour), width in zip(entries, widths, strict=True):
        plate.alpha_composite(_dot(radius, colour), (x, round(middle - radius)))
        draw.text(
            (x + 0.9 * size_px, middle), name, font=_font(size_px), fill=(255,) * 4, anchor="lm"
        )
        x += width
    return _premultiply(plate)


def _dot(radius: float, colour: Colour) -> Image.Image:
    """Draw a disc large and reduce it: Pillow's own edges are not smooth."""
    side, big = math.ceil(2 * radius), 8 * math.ceil(2 * radius)
    dot = Image.new("RGBA", (big, big), (*colour, 0))
    ImageDraw.Draw(dot).ellipse((0, 0, big - 1, big - 1), fill=(*colour, 255))
    return dot.resize((side, side), Image.Resampling.BOX)


def _plate(
    width: int, size_px: int, *, corner: int | None = None
) -> tuple[Image.Image, ImageDraw.ImageDraw]:
    """Make an empty plate and the means to draw on it."""
    height = round(1.7 * size_px)
    corner = round(0.35 * size_px) if corner is None else corner
    plate = Image.new("RGBA", (width, height), (0, 0, 0, 0))
    draw = ImageDraw.Draw(plate)
    draw.rounded_rectangle((0, 0, width - 1, height - 1), corner, fill=(*OUTLINE, 165))
    return plate, draw


def _premultiply(plate: Image.Image) -> _Label:
    rgba = np.asarray(plate, dtype=np.uint16)
    cover = rgba[:, :, 3:]
    return rgba[:, :, :3] * cover // 255, cover.astype(np.uint8)
