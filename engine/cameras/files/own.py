"""LiftLens' own calibration files (TOML), described in `docs/calibration.md`."""

from __future__ import annotations

import json
import math
from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np

from engine.cameras.files._build import (
    build_camera,
    read_array,
    read_number,
    read_size,
    require_apart,
    require_distinct,
    rotation_from,
)
from engine.datatypes import Array, Calibration, Camera
from engine.errors import CalibrationError

__all__ = ["FORMAT", "format_calibration", "is_own", "parse_own"]

FORMAT = "liftlens-calibration"
VERSION = 1
_SIGMAS = (
    "floor_m",
    "scale_sigma",
    "rotation_sigma_deg",
    "translation_sigma_m",
    "tilt_sigma_deg",
    "floor_sigma_m",
)
_KEYS = {"format", "version", "source", "up", "provenance", "camera", *_SIGMAS}
_CAMERA_KEYS = {"name", "size_px", "matrix", "distortion", "rotation", "translation_m"}


def is_own(tables: Mapping[str, Any]) -> bool:
    """Return whether a TOML file says that it is ours."""
    return tables.get("format") == FORMAT


def format_calibration(calibration: Calibration) -> str:
    """Write a calibration as TOML text; `read_calibration` reads exactly the same back.

    Values of the provenance that are neither text, numbers, truth values, lists nor tables of
    these come back as text; None is left out.
    """
    lines = [
        "# Cameras in one world: pixel = matrix * lens(rotation * X + translation_m), metres,",
        "# OpenCV's axes (x right, y down, z forward) and lens coefficients k1, k2, p1, p2, k3.",
        f"format = {_value(FORMAT)}",
        f"version = {VERSION}",
        f"source = {_value(calibration.source)}",
        f"up = {_value(calibration.up)}  # against gravity; nan: unknown",
        *(f"{key} = {_value(float(getattr(calibration, key)))}" for key in _SIGMAS),
        "",
        *_format_table("provenance", calibration.provenance),
    ]
    for camera in calibration.cameras:
        lines += ["", *_format_camera(camera)]
    return "\n".join(lines) + "\n"


def parse_own(tables: Mapping[str, Any], file_name: str) -> Calibration:
    """Build a calibration from the tables of one of our files.

    Raises
    ------
    CalibrationError
        If it is of a later version, or what it says can't be right.
    """
    version = tables.get("version")
    if version != VERSION:
        raise CalibrationError(
            f"{file_name} has version {version!r} of the calibration format, expected {VERSION}; "
            "install the current LiftLens, or calibrate again."
        )
    _refuse_unknown(tables, _KEYS, file_name)
    listed = tables.get("camera")
    if not isinstance(listed, list):
        raise CalibrationError(f"{file_name} has no [[camera]] tables; expected two or more.")
    cameras = tuple(_read_camera(table, file_name) for table in listed)
    require_distinct(cameras, file_name)
    require_apart(cameras, file_name)
    provenance = tables.get("provenance", {})
    if not isinstance(provenance, Mapping):
        raise CalibrationError(f"provenance of {file_name} must be a table, got {provenance!r}.")
    return Calibration(
        cameras=cameras,
        source=_read_text(tables, "source", file_name),
        up=_read_up(tables.get("up", [math.nan] * 3), file_name),
        **{key: _read_sigma(tables, key, file_name) for key in _SIGMAS},
        provenance=provenance,
    )


def _format_camera(camera: Camera) -> Iterator[str]:
    yield "[[camera]]"
    yield f"name = {_value(camera.name)}"
    yield f"size_px = {_value(list(camera.size_px))}  # width, height"
    yield f"matrix = {_value(camera.matrix)}"
    yield f"distortion = {_value(camera.distortion)}"
    yield f"rotation = {_value(camera.rotation)}"
    yield f"translation_m = {_value(camera.translation)}"


def _format_table(name: str, values: Mapping[str, Any]) -> Iterator[str]:
    yield f"[{name}]"
    for key, value in values.items():
        if value is not None:
            yield f"{_quote(str(key))} = {_value(value)}"


def _value(value: Any) -> str:
    if isinstance(value, np.ndarray | np.generic):
        value = value.tolist()
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, int | float):
        return repr(value)
    if isinstance(value, list | tuple):
        return f"[{', '.join(_value(item) for item in value if item is not None)}]"
    if isinstance(value, Mapping):
        pairs = [f"{_quote(str(k))} = {_value(v)}" for k, v in value.items() if v is not None]
        return f"{{ {', '.join(pairs)} }}" if pairs else "{}"
    return _quote(str(value))


def _quote(text: str) -> str:
    # JSON strings are TOML basic strings, but for DEL and lone surrogates, which TOML has not.
    whole = text.encode("utf-8", "replace").decode("utf-8")
    return json.dumps(whole, ensure_ascii=False).replace("\x7f", "\\u007f")


def _read_camera(table: Any, file_name: str) -> Camera:
    if not isinstance(table, Mapping):
        raise CalibrationError(f"A camera of {file_name} must be a table, got {table!r}.")
    name = _read_text(table, "name", f"a camera of {file_name}")
    owner = f"of camera {name!r} in {file_name}"
    _refuse_unknown(table, _CAMERA_KEYS, f"Camera {name!r} in {file_name}")
    return build_camera(
        name,
        read_size(table.get("size_px"), f"The size_px {owner}"),
        read_array(table.get("matrix"), (3, 3), f"The matrix {owner}"),
        rotation_from(table.get("rotation", ()), f"The rotation {owner}", is_exact=True),
        read_array(table.get("translation_m"), (3,), f"The translation_m {owner}"),
        read_array(table.get("distortion", [0.0] * 5), (5,), f"The distortion {owner}"),
    )


def _read_text(table: Mapping[str, Any], key: str, where: str) -> str:
    value = table.get(key)
    if not isinstance(value, str):
        raise CalibrationError(f"{key} of {where} must be text, got {value!r}.")
    return value


def _read_sigma(tables: Mapping[str, Any], key: str, file_name: str) -> float:
    value = tables.get(key, math.nan)
    if isinstance(value, float) and math.isnan(value):
        return math.nan
    number = read_number(tables, key, file_name)
    if number < 0 and key != "floor_m":
        raise CalibrationError(f"{key} of {file_name} must not be negative, got {number:g}.")
    return number


def _read_up(value: Any, file_name: str) -> Array:
    if isinstance(value, list) and len(value) == 3 and all(v != v for v in value):  # noqa: PLR0124
        return np.full(3, np.nan)
    up = read_array(value, (3,), f"up of {file_name}")
    if abs(float(np.linalg.norm(up)) - 1.0) > 1e-6:
        raise CalibrationError(f"up of {file_name} must have length 1, got {up.tolist()}.")
    return up


def _refuse_unknown(table: Mapping[str, Any], known: set[str], where: str) -> None:
    unknown = sorted(set(table) - known)
    if unknown:
        raise CalibrationError(
            f"{where} has the unknown key {unknown[0]!r}; known: {', '.join(sorted(known))}."
        )
