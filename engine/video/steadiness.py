"""Whether the camera stood still: how far the background travels in the picture.

Everything that is measured from one camera leans on the floor staying where it is in the
picture, so a hand-held phone must not pass for a fixed one.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from engine.datatypes import Array, PersonBox, TrackedFrame

__all__ = ["CameraWatch"]

LOOK_EVERY: Final = 3
SIDE_PX: Final = 480
"""Longer side of the small grey picture that is compared."""
MAX_CORNERS: Final = 120
MIN_CORNERS: Final = 10
PERSON_MARGIN: Final = 0.15
"""By this share of its larger side a person's box may miss limbs and the load."""
MAX_SPREAD_PX: Final = 1.0
"""Corners that go different ways are other people or machines, not the camera."""
MIN_LOOKS: Final = 5

Grey = NDArray[np.uint8]


class CameraWatch:
    """Measures the camera's travel while pictures pass through.

    Corners of the background are found in a reference picture and sought again in later ones by
    the method of Lucas and Kanade; the median of their shifts is the camera's. Comparing with one
    picture instead of the one before keeps errors from adding up.
    """

    def __init__(self) -> None:
        self._reference: tuple[Grey, NDArray[np.float32]] | None = None
        self._origin = np.zeros(2)
        self._shifts: list[Array] = []

    @property
    def travel(self) -> float:
        """How far the background travelled, as a share of the picture's longer side.

        NaN where there was too little background to tell.
        """
        if len(self._shifts) < MIN_LOOKS:
            return float("nan")
        low, high = np.percentile(np.array(self._shifts), (2.0, 98.0), axis=0)
        return float((high - low).max()) / SIDE_PX

    def watch(self, frames: Iterator[TrackedFrame]) -> Iterator[TrackedFrame]:
        """Pass frames on, looking at every third."""
        for tracked in frames:
            if tracked.frame.index % LOOK_EVERY == 0:
                self._look(tracked)
            yield tracked

    def _look(self, tracked: TrackedFrame) -> None:
        image = tracked.frame.image
        scale = SIDE_PX / max(image.shape[:2])
        size = (max(1, round(image.shape[1] * scale)), max(1, round(image.shape[0] * scale)))
        small = cv2.resize(image, size, interpolation=cv2.INTER_AREA)
        grey = np.asarray(cv2.cvtColor(small, cv2.COLOR_RGB2GRAY), dtype=np.uint8)
        people = (*([tracked.box] if tracked.box else []), *tracked.others)
        background = _mask_background(grey, people, scale)
        shift = self._find_shift(grey, background)
        if shift is None:
            self._start_again(grey, background)
        else:
            self._shifts.append(self._origin + shift)

    def _find_shift(self, grey: Grey, background: Grey) -> Array | None:
        if self._reference is None:
            return None
        picture, corners = self._reference
        found, is_found, _ = cv2.calcOpticalFlowPyrLK(
            picture, grey, corners, np.empty_like(corners), winSize=(21, 21), maxLevel=3
        )
        places = np.clip(np.rint(found), 0, np.array(grey.shape[::-1]) - 1).astype(int)
        kept = is_found.ravel().astype(bool) & (background[places[:, 1], places[:, 0]] > 0)
        if kept.sum() < MIN_CORNERS:
            return None
        flow = (found - corners)[kept].astype(np.float64)
        shift = np.median(flow, axis=0)
        spread = np.median(np.abs(flow - shift), axis=0).max()
        return np.asarray(shift) if spread <= MAX_SPREAD_PX else None

    def _start_again(self, grey: Grey, background: Grey) -> None:
        """Take a new reference, from where the camera was last."""
        self._origin = self._shifts[-1] if self._shifts else np.zeros(2)
        corners = cv2.goodFeaturesToTrack(grey, MAX_CORNERS, 0.02, 8, mask=background)
        is_enough = corners is not None and len(corners) >= MIN_CORNERS
        self._reference = (grey, corners.reshape(-1, 2).astype(np.float32)) if is_enough else None


def _mask_background(grey: Grey, people: tuple[PersonBox, ...], scale: float) -> Grey:
    """Return 255 where nobody is, else 0."""
    mask = np.full(grey.shape, 255, np.uint8)
    for person in people:
        margin = PERSON_MARGIN * max(person.size_px)
        left, top = (max(0, int((edge - margin) * scale)) for edge in (person.left, person.top))
        right, bottom = (int((edge + margin) * scale) + 1 for edge in (person.right, person.bottom))
        mask[top : max(0, bottom), left : max(0, right)] = 0
    return mask
