"""Whether a camera's calibration was made for the pictures it is used with.

A calibration holds for one picture size. Programs scale, crop, pad and turn pictures; each moves
the points in its own way, and a wrong guess bends the world without a sign. So the likely case is
looked for, and named.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from engine.datatypes import Array, CalibrationCheck, Camera, CheckLevel
from engine.optics import with_size

__all__ = ["adapt_to_picture"]

ROUNDING_PX = 1.0
"""Scaled sizes are rounded to whole, often even pixels."""
DARK = 24.0
"""Mean brightness (0 to 255) up to which padded rows or columns may be after compression."""
BRIGHT = 1.5 * DARK
LEAST_SHARE = 0.55
"""A crop from 4:3 to 16:9 leaves 0.75 of the height, to 21:9 0.57; less is no plausible guess."""
CALIBRATE_AGAIN = "Calibrate with a video from the same phone, lens, format and orientation."


@dataclass(frozen=True)
class _Fit:
    """How the calibrated picture got to the video's size: ``new = scale * old + shift`` px."""

    name: str
    scale: float
    shift: tuple[float, float]


def adapt_to_picture(
    camera: Camera,
    size_px: tuple[int, int],
    *,
    picture: NDArray[np.uint8] | None = None,
    up: Array | None = None,
) -> tuple[Camera, CalibrationCheck | None]:
    """Adapt a camera to the size of the pictures it is used with.

    Parameters
    ----------
    camera
        As calibrated.
    size_px
        Width and height of the video, px.
    picture
        Shape (H, W, 3), one picture of the video: black bars then tell a padded picture from a
        cropped one.
    up
        Shape (3,), against gravity in the camera's world: tells whether a picture was turned or
        the phone.

    Returns
    -------
    Camera
        For pictures of `size_px`; unchanged where the check is red.
    CalibrationCheck or None
        What was done: green for a plain change of size, amber where it is a guess, red where
        the calibration can't be used. None if the sizes are equal.
    """
    if camera.size_px == tuple(size_px):
        return camera, None
    if _is_scaled(camera.size_px, size_px):
        check = _tell(camera, size_px, CheckLevel.GREEN, "was scaled to its size")
        return with_size(camera, size_px), check
    turned = camera.size_px[::-1]
    if turned == tuple(size_px) or _is_scaled(turned, size_px):
        return _turn(camera, size_px, up)
    return _fit(camera, size_px, picture)


def _is_scaled(old: tuple[int, int], new: tuple[int, int]) -> bool:
    factor = [n / o for o, n in zip(old, new, strict=True)]
    # An axis alone tells the other's size up to rounding.
    return (
        abs(old[1] * factor[0] - new[1]) <= ROUNDING_PX
        or abs(old[0] * factor[1] - new[0]) <= ROUNDING_PX
    )


def _tell(
    camera: Camera, size_px: tuple[int, int], level: CheckLevel, what: str, action: str = ""
) -> CalibrationCheck:
    old, new = (f"{w} x {h}" for w, h in (camera.size_px, size_px))
    return CalibrationCheck(
        key="picture_size",
        level=level,
        sentence=f"Camera {camera.name} was calibrated for {old} px and the video has {new} px: "
        f"the calibration {what}.",
        action=action,
    )


def _turn(
    camera: Camera, size_px: tuple[int, int], up: Array | None
) -> tuple[Camera, CalibrationCheck]:
    """Turn the calibrated picture by a quarter if that puts the world upright in the video."""
    right, down = (0.0, -1.0) if up is None else (camera.rotation @ up)[:2]
    if up is None or abs(down) >= abs(right):
        what = "belongs to the phone held the other way and can't be used"
        return camera, _tell(camera, size_px, CheckLevel.RED, what, CALIBRATE_AGAIN)
    # Where up lies to the left in the calibrated picture, a turn to the right sets it upright.
    is_clockwise = right < 0
    width, height = camera.size_px
    quarter = (
        np.array([[0.0, -1.0], [1.0, 0.0]]) if is_clockwise else np.array([[0.0, 1.0], [-1.0, 0.0]])
    )
    corner = np.array([height - 1.0, 0.0]) if is_clockwise else np.array([0.0, width - 1.0])
    matrix = np.eye(3)
    matrix[:2, :2] = quarter @ camera.matrix[:2, :2] @ quarter.T
    matrix[:2, 2] = quarter @ camera.matrix[:2, 2] + corner
    turn = np.eye(3)
    turn[:2, :2] = quarter
    k1, k2, p1, p2, k3 = camera.distortion
    # The tangential terms are a vector in the picture, (p2, p1).
    p2, p1 = quarter @ np.array([p2, p1])
    turned = replace(
        camera,
        size_px=(height, width),
        matrix=matrix,
        distortion=np.array([k1, k2, p1, p2, k3]),
        rotation=turn @ camera.rotation,
        translation=turn @ camera.translation,
    )
    side = "right" if is_clockwise else "left"
    what = f"was turned to the {side}, as the world then stands upright"
    action = "Check that the person stands on the floor."
    check = _tell(camera, size_px, CheckLevel.AMBER, what, action)
    return with_size(turned, size_px), check


def _fit(
    camera: Camera, size_px: tuple[int, int], picture: NDArray[np.uint8] | None
) -> tuple[Camera, CalibrationCheck]:
    """Choose between a padded and a cropped picture."""
    fits = list(_list_fits(camera.size_px, size_px))
    padded, cropped = fits[0], fits[-1]
    if picture is not None and _has_bars(picture, padded, camera.size_px):
        bar = round(max(padded.shift))
        what = f"was fitted to the picture between its black bars of {bar} px"
        action = (
            "Check that the person stands on the floor; a video as the camera stored it is safer."
        )
        check = _tell(camera, size_px, CheckLevel.AMBER, what, action)
        return _apply(camera, padded, size_px), check
    share = min(n / (cropped.scale * o) for n, o in zip(size_px, camera.size_px, strict=True))
    if share < LEAST_SHARE:
        what = "can't be told from it, as too little of the calibrated picture would be left"
        return camera, _tell(camera, size_px, CheckLevel.RED, what, CALIBRATE_AGAIN)
    apart_px = _largest_difference(fits, camera.size_px)
    what = (
        f"was taken as cropped alike on both sides; other explanations differ by up to "
        f"{apart_px:.0f} px at the edge"
    )
    action = "Check that the person stands on the floor, or calibrate with this video's format."
    check = _tell(camera, size_px, CheckLevel.AMBER, what, action)
    return _apply(camera, cropped, size_px), check


def _list_fits(old: tuple[int, int], new: tuple[int, int]) -> Iterator[_Fit]:
    """Yield the padded, the unscaled (if it fits), and at last the cropped picture."""
    factors = [n / o for o, n in zip(old, new, strict=True)]
    scales = {"padded": min(factors), "cropped": max(factors)}
    for name, scale in scales.items():
        shift = [(n - scale * o) / 2 for o, n in zip(old, new, strict=True)]
        # Integers are pixel centres, so the pictures' corners lie at -0.5.
        yield _Fit(name, scale, (shift[0] - 0.5 + 0.5 * scale, shift[1] - 0.5 + 0.5 * scale))


def _apply(camera: Camera, fit: _Fit, size_px: tuple[int, int]) -> Camera:
    matrix = np.array(camera.matrix)
    matrix[:2] *= fit.scale
    matrix[:2, 2] += fit.shift
    return replace(camera, matrix=matrix, size_px=(size_px[0], size_px[1]))


def _largest_difference(fits: list[_Fit], old: tuple[int, int]) -> float:
    corners = np.array([[x, y] for x in (0, old[0] - 1) for y in (0, old[1] - 1)], dtype=float)
    placed = np.array([fit.scale * corners + np.array(fit.shift) for fit in fits])
    return float(np.ptp(placed, axis=0).max())


def _has_bars(picture: NDArray[np.uint8], padded: _Fit, old: tuple[int, int]) -> bool:
    """Return whether the picture has black bars where a padded one has them."""
    brightness = np.asarray(picture, dtype=np.float64).mean(axis=2)
    size = brightness.shape[::-1]
    shown = [padded.scale * side for side in old]
    axis = int(np.argmax([s - p for s, p in zip(size, shown, strict=True)]))
    profile = brightness.mean(axis=axis)
    bar = (size[axis] - shown[axis]) / 2
    inner = int(np.floor(bar))
    if inner < 1:
        return False
    # The last row of a bar is mixed with the picture by scaling and compression.
    dark = np.r_[profile[: max(1, inner - 1)], profile[len(profile) - max(1, inner - 1) :]]
    edge = np.r_[profile[inner + 2 : inner + 5], profile[-inner - 5 : -inner - 2]]
    return bool(dark.max() <= DARK and edge.mean() > max(BRIGHT, 2 * dark.mean()))
