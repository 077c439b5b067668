"""OpenCap's camera files: a pickle a camera, or the same values as JSON.

A session keeps ``<camera>/cameraIntrinsicsExtrinsics.pickle``. The world is that of the board (its
first corner, in millimetres), whose axis nearest to the cameras' upright is taken for up; where the
floor is it does not tell.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from engine.cameras.files._build import (
    build_calibration,
    build_camera,
    count_numbers,
    read_array,
    read_size,
    rotation_from,
)
from engine.cameras.files._plain_pickle import MAX_BYTES, read_plain_pickle
from engine.datatypes import Array, Calibration, Camera
from engine.errors import CalibrationError

__all__ = ["FILE_NAME", "is_opencap", "parse_opencap", "read_opencap_folder"]

FILE_NAME = "cameraIntrinsicsExtrinsics.pickle"
KEYS = ("intrinsicMat", "rotation", "translation")
MAX_OFF_AXIS_DEG = 30.0
UPRIGHT_BOARD_SIGMA_DEG = 2.0
"""How far a board on a tripod or a wall may be off the vertical."""


def is_opencap(tables: object) -> bool:
    """Return whether a JSON document holds such cameras by name."""
    return isinstance(tables, Mapping) and any(
        isinstance(table, Mapping) and KEYS[0] in table for table in tables.values()
    )


def read_opencap_folder(folder: Path) -> Calibration:
    """Read all cameras of a session.

    Raises
    ------
    CalibrationError
        If there are none, or what they say can't be right.
    """
    found = sorted(folder.rglob(FILE_NAME))
    if not found:
        raise CalibrationError(
            f"The folder {folder.name} holds no {FILE_NAME}; give a calibration file, or the "
            "folder of an OpenCap session."
        )
    tables = {}
    for path in found:
        name = path.parent.name
        if path.stat().st_size > MAX_BYTES:
            raise CalibrationError(f"{name}/{FILE_NAME} is too large to be a camera file.")
        tables[name] = read_plain_pickle(path.read_bytes(), f"{name}/{FILE_NAME}")
    return parse_opencap(tables, folder.name)


def parse_opencap(tables: Mapping[str, Any], file_name: str) -> Calibration:
    """Build a calibration from the values of each camera.

    Raises
    ------
    CalibrationError
        If what they say can't be right.
    """
    cameras = [
        _read_camera(str(name), table)
        for name, table in tables.items()
        if isinstance(table, Mapping) and any(key in table for key in KEYS)
    ]
    up = _nearest_axis(cameras)
    calibration = build_calibration(
        cameras,
        file_name=file_name,
        format_name="OpenCap",
        unit="mm",
        up=None if up is None else up.tolist(),
    )
    if not np.isfinite(calibration.up).all():
        return calibration
    return replace(calibration, tilt_sigma_deg=UPRIGHT_BOARD_SIGMA_DEG)


def _read_camera(name: str, table: Mapping[str, Any]) -> Camera:
    owner = f"of camera {name!r}"
    matrix = read_array(table.get("intrinsicMat"), (3, 3), f"The intrinsicMat {owner}")
    size = read_size(table.get("imageSize"), f"The imageSize {owner}")
    # Some versions store height and width: the optical axis is near the middle of the picture.
    middle = matrix[:2, 2]
    size_px = min((size, size[::-1]), key=lambda s: float(np.linalg.norm(middle - np.array(s) / 2)))
    distortion = table.get("distortion")
    flat = (
        np.zeros(0)
        if distortion is None
        else read_array(distortion, (count_numbers(distortion),), f"The distortion {owner}")
    )
    return build_camera(
        name,
        size_px,
        matrix,
        rotation_from(table.get("rotation", ()), f"The rotation {owner}"),
        read_array(table.get("translation"), (3,), f"The translation {owner}"),
        flat,
    )


def _nearest_axis(cameras: list[Camera]) -> Array | None:
    """Return the world's axis that points up in all pictures, None if none does."""
    if not cameras:
        return None
    upwards = np.array([-camera.rotation[1] for camera in cameras])
    mean = upwards.mean(axis=0)
    axis = np.zeros(3)
    axis[np.argmax(np.abs(mean))] = np.sign(mean[np.argmax(np.abs(mean))])
    is_near = (upwards @ axis > np.cos(np.radians(MAX_OFF_AXIS_DEG))).all()
    return axis if is_near else None
