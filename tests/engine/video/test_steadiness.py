"""Whether the camera stood still."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator

import cv2
import numpy as np
import pytest

from engine.datatypes import Frame, PersonBox, TrackedFrame
from engine.video.steadiness import LOOK_EVERY, CameraWatch

SIZE = (640, 360)
N_FRAMES = 90
Shift = Callable[[int], tuple[float, float]]


def room(seed: int = 0) -> np.ndarray:
    """Draw a room with enough edges, larger than the picture."""
    rng = np.random.default_rng(seed)
    image = np.full((SIZE[1] + 200, SIZE[0] + 200, 3), 120, np.uint8)
    for _ in range(60):
        x, y = (int(v) for v in rng.integers(0, (SIZE[0] + 100, SIZE[1] + 100)))
        colour = tuple(int(v) for v in rng.integers(0, 255, 3))
        cv2.rectangle(image, (x, y), (x + 40, y + 25), colour, -1)
    return image


def film(shift: Shift, box: PersonBox | None = None, image: np.ndarray | None = None):
    background = room() if image is None else image
    for index in range(N_FRAMES):
        dx, dy = shift(index)
        matrix = np.array([[1.0, 0.0, dx - 100], [0.0, 1.0, dy - 100]])
        picture = cv2.warpAffine(background, matrix, SIZE, flags=cv2.INTER_LINEAR)
        if box is not None:  # a striped person who walks across the room
            x = int(box.left) + 3 * index
            picture[40:340, x : x + 80] = 255 * (np.arange(300)[:, None, None] // 9 % 2)
            moved = PersonBox(x, 40, x + 80, 340)
        yield TrackedFrame(
            Frame(index, index / 30, picture), None if box is None else moved, is_anchor=True
        )


def measure(frames: Iterator[TrackedFrame]) -> float:
    watch = CameraWatch()
    assert sum(1 for _ in watch.watch(frames)) == N_FRAMES
    return watch.travel


def test_a_fixed_camera_does_not_travel_though_a_person_does() -> None:
    assert measure(film(lambda _: (0.0, 0.0), PersonBox(60, 40, 140, 340))) < 0.0005


@pytest.mark.parametrize("size_px", [4.0, 12.0])
def test_sway_is_measured_in_shares_of_the_picture(size_px: float) -> None:
    def sway(index: int) -> tuple[float, float]:
        return size_px * math.sin(index / 5), 0.3 * size_px * math.cos(index / 7)

    assert measure(film(sway)) == pytest.approx(2 * size_px / SIZE[0], rel=0.05)


def test_a_pan_beyond_the_first_picture_is_followed() -> None:
    frames = film(lambda index: (-1.0 * index, 0.0))
    # Each new reference loses the step to it: a pan is told from sway, not measured exactly.
    assert measure(frames) == pytest.approx(N_FRAMES / SIZE[0], rel=0.2)


def test_a_bare_wall_tells_nothing() -> None:
    wall = np.full((SIZE[1] + 200, SIZE[0] + 200, 3), 128, np.uint8)
    assert math.isnan(measure(film(lambda index: (float(index), 0.0), image=wall)))


def test_too_few_pictures_tell_nothing() -> None:
    watch = CameraWatch()
    for tracked, _ in zip(
        watch.watch(film(lambda _: (0.0, 0.0))), range(4 * LOOK_EVERY), strict=False
    ):
        assert tracked.frame.image.shape == (SIZE[1], SIZE[0], 3)
    assert math.isnan(watch.travel)
