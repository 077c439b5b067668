"""Pictures of two people that cross, made from a sample clip."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import av
import cv2
import numpy as np

from engine.datatypes import Frame

SAMPLES = Path(__file__).parents[3] / "sample_data"
FPS = 30.0


def read_images(path: Path, count: int | None = None) -> list[np.ndarray]:
    """Decode the first pictures of a clip as RGB."""
    images = []
    with av.open(str(path)) as container:
        for frame in container.decode(video=0):
            if count is not None and len(images) == count:
                break
            images.append(frame.to_ndarray(format="rgb24"))
    return images


def frames_of(images: list[np.ndarray]) -> Iterator[Frame]:
    """Number and time pictures as the reader does."""
    for index, image in enumerate(images):
        yield Frame(index=index, time_s=index / FPS, image=image)


def cut_out(image: np.ndarray, box: tuple[int, int, int, int]) -> tuple[np.ndarray, np.ndarray]:
    """Cut a person out of a plain background.

    Returns the picture inside the box (left, top, right, bottom) and its opacity 0 to 1.
    """
    left, top, right, bottom = box
    mask = np.zeros(image.shape[:2], np.uint8)
    cv2.setRNGSeed(0)
    rect = (left, top, right - left, bottom - top)
    cv2.grabCut(image[:, :, ::-1].copy(), mask, rect, np.zeros((1, 65)), np.zeros((1, 65)), 4, 0)
    person = ((mask == cv2.GC_FGD) | (mask == cv2.GC_PR_FGD)).astype(np.float32)
    person = cv2.GaussianBlur(person, (3, 3), 0)
    return image[top:bottom, left:right].copy(), person[top:bottom, left:right, None]


def paste(image: np.ndarray, cut: tuple[np.ndarray, np.ndarray], left: float, top: int) -> None:
    """Lay a cut-out over a picture, in place; what reaches over the border is dropped."""
    person, opacity = cut
    x = round(left)
    low, high = max(0, -x), min(person.shape[1], image.shape[1] - x)
    if high <= low:
        return
    window = image[top : top + person.shape[0], x + low : x + high]
    share = opacity[: window.shape[0], low:high]
    window[:] = share * person[: window.shape[0], low:high] + (1 - share) * window
