"""C3D files: markers, and joint angles where the recording software stored them as points."""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from engine.datatypes import Array
from engine.errors import DataError
from engine.validation.reference.base import AngleUnit, Recording
from engine.validation.reference.text import read_bytes, regular_time
from engine.validation.reference.trc import blank_zeros, parse_length_unit

__all__ = ["read_c3d"]

MAGIC = 0x50
_MODEL_OUTPUT = re.compile(r"(Angles?|Force|Moment|Power|GRF|CentreOfMass.*)$")
_OUTPUT_GROUPS = ("FORCES", "MOMENTS", "POWERS", "SCALARS")


def read_c3d(path: Path) -> Recording:
    """Read a C3D file; points with a negative residual are missing, analog channels are skipped.

    Raises
    ------
    DataError
        If the file is no C3D file, damaged, or holds no points.
    """
    if read_bytes(path)[1:2] != bytes([MAGIC]):
        raise DataError(f"{path.name} is no C3D file; export the recording again.")
    import ezc3d  # a compiled library, not needed for other formats

    try:
        content = ezc3d.c3d(str(path))
    except Exception as error:
        # The library raises plain and system errors of many kinds on damaged files.
        raise DataError(f"{path.name} can't be read as C3D: {error}.") from error
    parameters: Mapping[str, Any] = content["parameters"]["POINT"]
    points = np.asarray(content["data"]["points"], dtype=np.float64)
    names = _read_words(parameters, "LABELS")[: points.shape[1]]
    rate = float(_first(parameters, "RATE", 0.0))
    if not names or points.shape[2] == 0:
        raise DataError(f"{path.name} holds no points (only analog channels); export the markers.")
    if not rate > 0:
        raise DataError(f"{path.name} states no frame rate; correct POINT:RATE.")
    position = np.moveaxis(points[:3, : len(names)], 2, 0).transpose(0, 2, 1)
    residual = np.asarray(content["data"]["meta_points"]["residuals"])[0, : len(names)].T
    position = np.where((residual < 0)[:, :, None], np.nan, position)
    return _sort_points(path.name, names, position, parameters, rate, content["header"])


def _sort_points(
    name: str,
    names: tuple[str, ...],
    position: Array,
    parameters: Mapping[str, Any],
    rate: float,
    header: Mapping[str, Any],
) -> Recording:
    """Tell markers from angles and from other model outputs, which are dropped."""
    angles = set(_read_words(parameters, "ANGLES"))
    others = {word for group in _OUTPUT_GROUPS for word in _read_words(parameters, group)}
    is_angle = np.array([n in angles or (n not in others and n.endswith("Angles")) for n in names])
    is_marker = ~is_angle & np.array(
        [not (n in others or n.startswith("*") or _MODEL_OUTPUT.search(n)) for n in names]
    )
    n_frames = position.shape[0]
    return Recording(
        name=name,
        format="c3d",
        time_s=regular_time(n_frames, rate, first_frame=int(header["points"]["first_frame"]) + 1),
        labels=tuple(n for n, keep in zip(names, is_marker, strict=True) if keep),
        position=blank_zeros(position[:, is_marker]),
        curves=tuple(
            f"{n}.{axis}" for n, keep in zip(names, is_angle, strict=True) if keep for axis in "xyz"
        ),
        value=position[:, is_angle].reshape(n_frames, -1),
        length_unit=parse_length_unit(str(_first(parameters, "UNITS", "")), name),
        angle_unit=_parse_angle_unit(str(_first(parameters, "ANGLE_UNITS", "deg"))),
    )


def _parse_angle_unit(text: str) -> AngleUnit:
    return "rad" if text.strip().lower().startswith("rad") else "deg"


def _read_words(parameters: Mapping[str, Any], key: str) -> tuple[str, ...]:
    """Return a list of words; long lists go on in LABELS2, LABELS3 and so on."""
    words: list[str] = []
    for part in (key, *(f"{key}{n}" for n in range(2, 10))):
        if part in parameters:
            words += [str(word).strip() for word in parameters[part]["value"]]
    return tuple(words)


def _first(parameters: Mapping[str, Any], key: str, default: object) -> Any:
    values: Any = parameters[key]["value"] if key in parameters else ()
    return values[0] if len(values) else default
