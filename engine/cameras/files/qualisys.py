"""Qualisys Track Manager's camera files (`.qca.txt`, XML).

Lengths are millimetres and the world has Z up, its origin on the floor. Focal lengths and centres
count sub-pixels of the whole sensor, 64 to a pixel; `fov_video` is the part of the sensor that the
video shows. The transform's rows are the camera's right, up and backward axes in the world, x, y, z
its place. The lens coefficients are OpenCV's.
"""

from __future__ import annotations

import math
from collections.abc import Mapping

# The text is checked for document types and entities before it is parsed.
from xml.etree import ElementTree as ET

import numpy as np

from engine.cameras.files._build import (
    build_calibration,
    build_camera,
    read_number,
    read_size,
    rotation_from,
)
from engine.datatypes import Array, Calibration, Camera
from engine.errors import CalibrationError

__all__ = ["parse_qualisys"]

SUB_PIXELS = 64.0
FROM_QUALISYS = np.diag([1.0, -1.0, -1.0])
"""Right, up, backward to right, down, forward."""
DISTORTION = (
    "radialDistortion1",
    "radialDistortion2",
    "tangentalDistortion1",
    "tangentalDistortion2",
    "radialDistortion3",
)


def parse_qualisys(text: str, file_name: str) -> Calibration:
    """Read the text of a Qualisys calibration.

    Raises
    ------
    CalibrationError
        If it is no such file, or what it says can't be right.
    """
    if "<!DOCTYPE" in text or "<!ENTITY" in text:
        raise CalibrationError(f"{file_name} declares entities; a Qualisys calibration has none.")
    try:
        root = ET.fromstring(text.encode())  # noqa: S314
    except ET.ParseError as error:
        raise CalibrationError(f"{file_name} is cut off or no XML ({error}).") from None
    cameras = [
        _read_camera(element, f"{file_name}, camera {index + 1}")
        for index, element in enumerate(root.iterfind("cameras/camera"))
        if element.get("active", "1") != "0" and element.get("calibrated", "true") != "false"
    ]
    residuals = [
        float(text)
        for element in root.iterfind("cameras/camera")
        if (text := element.get("avg-residual", "")) and _is_number(text)
    ]
    provenance = {} if not residuals else {"residual_mm": float(np.mean(residuals))}
    return build_calibration(
        cameras,
        file_name=file_name,
        format_name="Qualisys",
        unit="mm",
        up=(0.0, 0.0, 1.0),
        floor_m=0.0,
        provenance=provenance,
    )


def _is_number(text: str) -> bool:
    try:
        return math.isfinite(float(text))
    except ValueError:
        return False


def _read_camera(element: ET.Element, where: str) -> Camera:
    name = element.get("serial") or where.rsplit(" ", 1)[-1]
    where = f"{where} ({name})"
    intrinsic = _attributes(element, "intrinsic", where)
    transform = _attributes(element, "transform", where)
    left, top, size_px = _read_shown_part(element, intrinsic, where)
    matrix = _read_matrix(intrinsic, left, top, where)
    rows = [[read_number(transform, f"r{i}{j}", where) for j in (1, 2, 3)] for i in (1, 2, 3)]
    rotation = FROM_QUALISYS @ rotation_from(np.array(rows), f"The rotation of {where}")
    place = np.array([read_number(transform, axis, where) for axis in "xyz"])
    present = {key: intrinsic.get(key, "0") for key in DISTORTION}
    distortion = [read_number(present, key, where) for key in DISTORTION]
    return build_camera(name, size_px, matrix, rotation, -rotation @ place, distortion)


def _read_matrix(intrinsic: Mapping[str, str], left: float, top: float, where: str) -> Array:
    u, v = (read_number(intrinsic, f"focalLength{axis}", where) for axis in "UV")
    cu, cv = (read_number(intrinsic, f"centerPoint{axis}", where) for axis in "UV")
    return np.array(
        [
            [u / SUB_PIXELS, 0.0, cu / SUB_PIXELS - left],
            [0.0, v / SUB_PIXELS, cv / SUB_PIXELS - top],
            [0.0, 0.0, 1.0],
        ]
    )


def _read_shown_part(
    element: ET.Element, intrinsic: Mapping[str, str], where: str
) -> tuple[float, float, tuple[int, int]]:
    """Return where the video's picture starts on the sensor and how large it is, px."""
    shown = element.find("fov_video")
    if shown is None:
        sensor = [
            read_number(intrinsic, f"sensorMax{axis}", where)
            - read_number(intrinsic, f"sensorMin{axis}", where)
            for axis in "UV"
        ]
        size = np.floor(np.array(sensor) / SUB_PIXELS) + 1
        return 0.0, 0.0, read_size(size, f"The sensor of {where}")
    edges = {k: read_number(shown.attrib, k, where) for k in ("left", "top", "right", "bottom")}
    size = np.array([edges["right"] - edges["left"], edges["bottom"] - edges["top"]]) + 1
    return edges["left"], edges["top"], read_size(size, f"The fov_video of {where}")


def _attributes(element: ET.Element, name: str, where: str) -> Mapping[str, str]:
    found = element.find(name)
    if found is None:
        raise CalibrationError(f"{where} lacks its {name}; export the calibration again.")
    return found.attrib
