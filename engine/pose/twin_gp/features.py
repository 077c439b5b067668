"""What the estimator looks at: pictures as gradients, landmarks as numbers, one row per frame."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from engine.datatypes import Array, Frame
from engine.errors import ConfigError, DataError, ShapeError
from engine.pose.twin_gp.hog import HogSettings, compute_hog, compute_soft_hog
from engine.skeletons import MEDIAPIPE_33

__all__ = [
    "FEATURES",
    "Crop",
    "FeatureSet",
    "combine_features",
    "describe_landmarks",
    "describe_picture",
    "describe_video",
    "fixed_crop",
]

CROP_MARGIN: Final = 0.10
WINDOW_STEP_FRAMES: Final = 2
MIN_CONFIDENCE: Final = 1e-3
FEATURE_LANDMARKS: Final = tuple(
    MEDIAPIPE_33.index(name)
    for name in MEDIAPIPE_33.keypoints
    if not any(part in name for part in ("eye", "mouth", "pinky", "thumb"))
)
"""Nose, ears, shoulders to index fingers, hips to toes; eyes and mouth add nothing to the body."""


@dataclass(frozen=True)
class Crop:
    """A fixed part of every picture of one view, px: left, top, right, bottom.

    The right and bottom edges are outside it. `picture_px` is the (width, height) it belongs to.
    """

    left: int
    top: int
    right: int
    bottom: int
    picture_px: tuple[int, int]

    def __post_init__(self) -> None:
        width, height = self.picture_px
        inside = 0 <= self.left < self.right <= width and 0 <= self.top < self.bottom <= height
        if not inside:
            raise DataError(
                f"A crop must lie inside its picture of {width} x {height} px, got left, top, "
                f"right, bottom = {self.left}, {self.top}, {self.right}, {self.bottom}."
            )


@dataclass(frozen=True)
class FeatureSet:
    """A named way to describe a moment.

    `hog` says how pictures are described, None if they are not looked at; `uses_landmarks` whether
    keypoints of a pose network are, and `window` how many neighbours on each side of a
    frame lend theirs.
    """

    name: str
    title: str
    hog: HogSettings | None = None
    uses_landmarks: bool = False
    window: int = 0


SOFT_HOG: Final = HogSettings(cell_px=16, noise_floor=20.0)

FEATURES: Final[Mapping[str, FeatureSet]] = {
    s.name: s
    for s in (
        FeatureSet("hog", "HoG of a fixed crop, 128 x 256 px per view", HogSettings()),
        FeatureSet("hog-paper", "HoG of the whole picture, 8 px cells", HogSettings(size_px=None)),
        FeatureSet("hog-soft", "HoG of a fixed crop with soft votes and a noise floor", SOFT_HOG),
        FeatureSet("landmarks", "BlazePose landmarks of each view", uses_landmarks=True),
        FeatureSet(
            "landmarks-window",
            "BlazePose landmarks of each view, with those of neighbouring frames",
            uses_landmarks=True,
            window=1,
        ),
        FeatureSet(
            "hog+landmarks", "Soft HoG of a fixed crop and BlazePose landmarks", SOFT_HOG, True
        ),
    )
}


def fixed_crop(boxes: Array, picture_px: tuple[int, int], *, margin: float = CROP_MARGIN) -> Crop:
    """Return the part of the picture in which the person moves: the union of all boxes.

    A crop that stays where it is keeps the place inside it informative, which a box that follows
    the person does not.

    Parameters
    ----------
    boxes
        Shape (T, 4), left, top, right, bottom in px; NaN rows are left out.
    picture_px
        Width and height of the picture.
    margin
        Added on each side, as a share of the union's width and height.

    Raises
    ------
    DataError
        If no box is known.
    """
    if boxes.ndim != 2 or boxes.shape[1] != 4:
        raise ShapeError(f"Expected boxes of shape (T, 4), got {boxes.shape}.")
    known = boxes[np.isfinite(boxes).all(axis=1)]
    if not len(known):
        raise DataError("Expected at least one box of the person to crop around, got none.")
    low, high = known[:, :2].min(axis=0), known[:, 2:].max(axis=0)
    room = margin * (high - low)
    left, top = np.floor(np.maximum(low - room, 0)).astype(int)
    right, bottom = np.ceil(np.minimum(high + room, picture_px)).astype(int)
    return Crop(int(left), int(top), int(right), int(bottom), picture_px)


def describe_picture(
    image: NDArray[np.uint8], crop: Crop | None, settings: HogSettings
) -> NDArray[np.float32]:
    """Describe one picture by its gradients, as a vector of length 1.

    Parameters
    ----------
    image
        Shape (H, W, 3) RGB.
    crop
        Which part; ignored if the settings take the whole picture.
    settings
        Size and cells.

    Raises
    ------
    DataError
        If the picture has another size than the one the crop was made for.
    """
    height, width = image.shape[:2]
    if crop is not None and (width, height) != crop.picture_px:
        raise DataError(
            f"Expected pictures of {crop.picture_px[0]} x {crop.picture_px[1]} px, as the crop was "
            f"made for, got {width} x {height} px; film and export at the same size."
        )
    part = image
    if settings.size_px is not None and crop is not None:
        part = image[crop.top : crop.bottom, crop.left : crop.right]
    grey = cv2.cvtColor(np.ascontiguousarray(part), cv2.COLOR_RGB2GRAY)
    if settings.size_px is not None:
        shrinks = grey.shape[1] > settings.size_px[0]
        how = cv2.INTER_AREA if shrinks else cv2.INTER_LINEAR
        grey = cv2.resize(grey, settings.size_px, interpolation=how)
    picture = np.asarray(grey, dtype=np.uint8)
    if settings.noise_floor is None:
        return _unit_rows(compute_hog(picture, cell_px=settings.cell_px))
    floor = settings.noise_floor
    return _unit_rows(compute_soft_hog(picture, cell_px=settings.cell_px, noise_floor=floor))


def describe_video(
    frames: Iterable[Frame], crop: Crop | None, settings: HogSettings
) -> NDArray[np.float32]:
    """Describe every picture of one view; see `describe_picture`.

    Returns
    -------
    NDArray[np.float32]
        Shape (T, d), each row of length 1.
    """
    rows = [describe_picture(frame.image, crop, settings) for frame in frames]
    if not rows:
        raise DataError("Expected pictures to describe, got none.")
    return np.stack(rows)


def describe_landmarks(
    position_px: Array, picture_px: tuple[int, int], *, window: int = 0
) -> NDArray[np.float32]:
    """Describe every frame of one view by the places of its landmarks.

    Parameters
    ----------
    position_px
        Shape (T, 33, 2), BlazePose's landmarks of consecutive frames of ONE clip; short gaps are
        bridged in a straight line, at the ends by the nearest frame.
    picture_px
        Width and height of the picture.
    window
        Neighbours on each side whose landmarks are added, every second frame away; a clip's ends
        repeat.

    Returns
    -------
    NDArray[np.float32]
        Shape (T, (2 * window + 1) * 2 * L), in picture heights from the picture's centre; NaN
        where a landmark is never seen.
    """
    if position_px.ndim != 3 or position_px.shape[1:] != (len(MEDIAPIPE_33.keypoints), 2):
        raise ShapeError(f"Expected landmarks of shape (T, 33, 2), got {position_px.shape}.")
    centred = position_px[:, FEATURE_LANDMARKS] - np.array(picture_px) / 2
    flat = _bridge_gaps((centred / picture_px[1]).reshape(len(position_px), -1))
    at = np.arange(len(flat))
    steps = WINDOW_STEP_FRAMES * np.arange(-window, window + 1)
    rows = [flat[np.clip(at + step, 0, len(flat) - 1)] for step in steps]
    return np.concatenate(rows, axis=1).astype(np.float32)


def combine_features(
    hog: Sequence[NDArray[np.float32]] = (), landmarks: Sequence[NDArray[np.float32]] = ()
) -> tuple[NDArray[np.float32], tuple[int, ...]]:
    """Put what the views show side by side.

    Parameters
    ----------
    hog
        Of each view, shape (T, d) with rows of length 1; together they get length 1 again.
    landmarks
        Of each view, shape (T, k).

    Returns
    -------
    tuple
        Features (T, D), and the widths of their blocks: one of HoG, one of landmarks, if given.
        Each block has its own scale in the kernel, which is then a product of kernels.
    """
    blocks = []
    if hog:
        blocks.append(_unit_rows(np.concatenate(hog, axis=1)))
    if landmarks:
        blocks.append(np.concatenate(landmarks, axis=1))
    if not blocks:
        raise ConfigError("Expected HoG or landmarks of at least one view to combine, got none.")
    if len({len(b) for b in blocks}) != 1:
        counts = ", ".join(str(len(b)) for b in blocks)
        raise ShapeError(f"HoG and landmarks need the same number of frames, got {counts}.")
    return np.concatenate(blocks, axis=1), tuple(b.shape[1] for b in blocks)


def _unit_rows(values: NDArray[np.float32]) -> NDArray[np.float32]:
    length = np.linalg.norm(values, axis=-1, keepdims=True)
    # An even picture has no gradients: it stays zero.
    return np.asarray(values / np.maximum(length, 1e-12), dtype=np.float32)


def _bridge_gaps(rows: Array) -> Array:
    """Fill NaN by straight lines in time, at the ends by the nearest value, column by column."""
    filled = np.array(rows)
    at = np.arange(len(rows))
    for column in np.flatnonzero(np.isnan(rows).any(axis=0)):
        known = np.isfinite(rows[:, column])
        if known.any():
            filled[:, column] = np.interp(at, at[known], rows[known, column])
    return filled
