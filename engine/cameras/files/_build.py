"""What every reader of camera files needs: checked numbers, checked cameras, one world."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import combinations
from typing import Any

import cv2
import numpy as np

from engine.datatypes import Array, Calibration, Camera
from engine.errors import CalibrationError
from engine.optics import camera_centre

__all__ = [
    "build_calibration",
    "build_camera",
    "count_numbers",
    "read_array",
    "read_number",
    "read_size",
    "require_apart",
    "require_distinct",
    "rotation_from",
]

MAX_CAMERAS = 64
MAX_SIDE_PX = 20_000
ROTATION_TOLERANCE = 1e-3
FIELD_OF_VIEW_DEG = (5.0, 170.0)
SAME_PLACE_M = 0.05
METRES_UP_TO = 50.0
MILLIMETRES_FROM = 600.0
"""Cameras that film one person stand 0.6 to 50 m apart: the farthest two tell the unit."""
MAX_STEEP = 0.9
"""Sine of the steepest pitch with which a camera may still confirm which axis points up."""
UP_BY_CONVENTION_SIGMA_DEG = 1.0
FLOOR_BY_CONVENTION_SIGMA_M = 0.02
"""A laboratory's origin is laid on the floor with a bubble level, markers a little above it."""


def read_number(values: Mapping[str, Any], key: str, where: str) -> float:
    """Return a finite number, whether it is stored as one or as text.

    Raises
    ------
    CalibrationError
        If it is missing or no finite number.
    """
    if values.get(key) is None:
        raise CalibrationError(f"{where} lacks {key}; export the calibration again.")
    value = values[key]
    try:
        number = math.nan if isinstance(value, bool) else float(value)
    except (TypeError, ValueError):
        number = math.nan
    if not math.isfinite(number):
        raise CalibrationError(f"{key} of {where} must be a finite number, got {value!r}.")
    return number


def read_array(value: Any, shape: tuple[int, ...], what: str) -> Array:
    """Return finite numbers of a given shape; columns count as rows.

    Raises
    ------
    CalibrationError
        If they are missing, of another shape, or not finite.
    """
    wanted = " x ".join(map(str, shape))
    expected = f"{what} must be {wanted} finite numbers"
    if value is None:
        raise CalibrationError(f"{what} is missing; export the calibration again.")
    try:
        array = np.asarray(value, dtype=np.float64)
    except (TypeError, ValueError):
        raise CalibrationError(f"{expected}, got {str(value)[:60]!r}.") from None
    if array.size != math.prod(shape):
        raise CalibrationError(f"{expected}, got shape {array.shape}.")
    if not np.isfinite(array).all():
        raise CalibrationError(f"{expected}, but some are not finite; export it again.")
    return array.reshape(shape)


def count_numbers(value: Any) -> int:
    """Return how many numbers a list or array holds, 0 if it is ragged or missing."""
    if value is None:
        return 0
    try:
        return np.asarray(value, dtype=np.float64).size
    except (TypeError, ValueError):
        return 0


def read_size(value: Any, what: str) -> tuple[int, int]:
    """Return width and height in px.

    Raises
    ------
    CalibrationError
        If they are no whole positive numbers.
    """
    size = read_array(value, (2,), what)
    if not ((size == np.round(size)) & (size >= 1) & (size <= MAX_SIDE_PX)).all():
        raise CalibrationError(
            f"{what} must be whole numbers from 1 to {MAX_SIDE_PX}, got {size.tolist()}."
        )
    return int(size[0]), int(size[1])


def rotation_from(value: Any, what: str, *, is_exact: bool = False) -> Array:
    """Return a rotation matrix from one (nine numbers) or from a rotation vector (three).

    Files round to a few digits: unless `is_exact`, the nearest rotation is returned.

    Raises
    ------
    CalibrationError
        If the matrix does not turn, but stretches or mirrors.
    """
    if count_numbers(value) == 3:
        return np.asarray(cv2.Rodrigues(read_array(value, (3,), what))[0], dtype=np.float64)
    rotation = read_array(value, (3, 3), what)
    miss = float(np.linalg.norm(rotation @ rotation.T - np.eye(3)))
    if miss > ROTATION_TOLERANCE or np.linalg.det(rotation) < 0:
        kind = "a mirror" if miss <= ROTATION_TOLERANCE else f"off by {miss:.2g}"
        raise CalibrationError(
            f"{what} is not a rotation matrix ({kind}); check its rows, or export it again."
        )
    if is_exact:
        return rotation
    left, _, right = np.linalg.svd(rotation)
    return np.asarray(left @ right)


def build_camera(
    name: str,
    size_px: tuple[int, int],
    matrix: Array,
    rotation: Array,
    translation: Array,
    distortion: Sequence[float] | Array = (),
) -> Camera:
    """Build a camera after checking that it can be one.

    Parameters
    ----------
    name
        Of the camera, for messages.
    size_px, matrix, rotation, translation
        As in `Camera`; the translation in the file's unit.
    distortion
        Up to five of OpenCV's coefficients; further ones must be 0.

    Raises
    ------
    CalibrationError
        If the matrix is singular, the field of view impossible or the lens model another one.
    """
    where = f"the matrix of camera {name!r}"
    focal = np.array([matrix[0, 0], matrix[1, 1]])
    ends_right = np.allclose(matrix[2], (0.0, 0.0, 1.0), rtol=0.0, atol=1e-9)
    if not ends_right or not (focal > 0).all():
        raise CalibrationError(
            f"Expected {where} as focal lengths on the diagonal above a row 0, 0, 1; got "
            f"{np.round(matrix, 3).tolist()}, which is singular or none."
        )
    fov_deg = 2 * np.degrees(np.arctan(np.array(size_px) / (2 * focal)))
    if not ((fov_deg > FIELD_OF_VIEW_DEG[0]) & (fov_deg < FIELD_OF_VIEW_DEG[1])).all():
        raise CalibrationError(
            f"By {where} its field of view is {fov_deg.max():.2g} degrees; expected 5 to 170: "
            f"the focal lengths must be in px of its {size_px[0]} x {size_px[1]} px picture."
        )
    if not (np.abs(matrix[:2, 2] / np.array(size_px) - 0.5) < 0.5).all():
        raise CalibrationError(
            f"By {where} the optical axis leaves its {size_px[0]} x {size_px[1]} px picture; "
            "check whether width and height are exchanged."
        )
    coefficients = np.asarray(distortion, dtype=np.float64).reshape(-1)
    if np.any(coefficients[5:]):
        raise CalibrationError(
            f"Camera {name!r} has a lens model of {coefficients.size} coefficients; LiftLens "
            "knows OpenCV's five (k1, k2, p1, p2, k3). Calibrate it again with that model."
        )
    five = np.zeros(5)
    five[: min(5, coefficients.size)] = coefficients[:5]
    return Camera(name, size_px, matrix, rotation, translation, five)


def build_calibration(
    cameras: Sequence[Camera],
    *,
    file_name: str,
    format_name: str,
    unit: str | None = None,
    up: Sequence[float] | None = None,
    floor_m: float = math.nan,
    provenance: Mapping[str, Any] | None = None,
) -> Calibration:
    """Put cameras of a file into one world in metres.

    Parameters
    ----------
    cameras
        Translations in the file's unit.
    file_name, format_name
        For messages and the provenance.
    unit
        `m`, `mm`, or None where the format leaves it open: the distances then tell.
    up, floor_m
        The format's convention, taken only if the cameras can stand so.
    provenance
        More about the origin.

    Raises
    ------
    CalibrationError
        If there are fewer than two cameras, two of one name or place, or the unit is unclear.
    """
    require_distinct(cameras, file_name)
    notes = []
    if unit is None:
        unit, remark = _tell_unit(cameras, file_name)
        notes += [remark] if remark else []
    if unit == "mm":
        cameras = [replace(camera, translation=camera.translation / 1000.0) for camera in cameras]
    require_apart(cameras, file_name)
    is_up_known = up is not None and _stands_up(cameras, np.asarray(up), floor_m)
    if up is not None and not is_up_known:
        notes.append(
            f"{file_name}: the cameras can't stand upright in a world whose axis "
            f"{_name_axis(up)} points up; the person tells where up is."
        )
    floor_m = floor_m if is_up_known else math.nan
    return Calibration(
        cameras=tuple(cameras),
        source="file",
        up=np.full(3, np.nan) if not is_up_known or up is None else np.asarray(up, dtype=float),
        floor_m=floor_m,
        tilt_sigma_deg=UP_BY_CONVENTION_SIGMA_DEG if is_up_known else math.nan,
        floor_sigma_m=math.nan if math.isnan(floor_m) else FLOOR_BY_CONVENTION_SIGMA_M,
        provenance={
            "file": file_name,
            "format": format_name,
            **(provenance or {}),
            "notes": notes,
        },
    )


def require_distinct(cameras: Sequence[Camera], file_name: str) -> None:
    """Refuse too few cameras, and cameras of one name.

    Raises
    ------
    CalibrationError
        If it is so.
    """
    if not 2 <= len(cameras) <= MAX_CAMERAS:
        raise CalibrationError(
            f"{file_name} has {len(cameras)} cameras; expected 2 to {MAX_CAMERAS}, calibrated "
            "together."
        )
    names = [camera.name for camera in cameras]
    twice = sorted({name for name in names if names.count(name) > 1})
    if twice:
        raise CalibrationError(
            f"{file_name} has more than one camera named {twice[0]!r}; give each its own name."
        )


def _largest_distance(cameras: Sequence[Camera]) -> float:
    centres = [camera_centre(camera) for camera in cameras]
    return max(float(np.linalg.norm(a - b)) for a, b in combinations(centres, 2))


def _tell_unit(cameras: Sequence[Camera], file_name: str) -> tuple[str, str]:
    """Return `m` or `mm`, and a remark where that was found out rather than given."""
    farthest = _largest_distance(cameras)
    if farthest <= METRES_UP_TO:
        return "m", ""
    if farthest < MILLIMETRES_FROM:
        raise CalibrationError(
            f"The unit of {file_name} is unclear: its cameras are {farthest:.0f} apart "
            f"({farthest / 100:.1f} m if centimetres, {farthest / 1000:.2f} m if millimetres). "
            "Write the translations in metres."
        )
    return "mm", (
        f"{file_name}: its cameras are {farthest:.0f} apart, so it is in millimetres; "
        f"taken as {farthest / 1000:.2f} m."
    )


def require_apart(cameras: Sequence[Camera], file_name: str) -> None:
    """Refuse cameras (in metres) that are at one place.

    Raises
    ------
    CalibrationError
        If it is so.
    """
    for a, b in combinations(cameras, 2):
        if np.linalg.norm(camera_centre(a) - camera_centre(b)) < SAME_PLACE_M:
            raise CalibrationError(
                f"By {file_name} the cameras {a.name!r} and {b.name!r} are at the same place; "
                "expected them metres apart. Check the unit, or calibrate again."
            )


def _stands_up(cameras: Sequence[Camera], up: Array, floor_m: float) -> bool:
    """Return whether every camera stands upright, more or less level, above the floor."""
    for camera in cameras:
        right, down, forward = camera.rotation @ up
        # A camera on its side in one world may stand upright in another: it confirms nothing.
        if abs(forward) > MAX_STEEP or -down < abs(right):
            return False
        if not math.isnan(floor_m) and camera_centre(camera) @ up < floor_m:
            return False
    return True


def _name_axis(up: Sequence[float]) -> str:
    axis = int(np.argmax(np.abs(up)))
    return f"{'-' if up[axis] < 0 else ''}{'XYZ'[axis]}"
