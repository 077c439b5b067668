"""C3D recordings: markers, and joint angles where the recording software stored them as points."""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from engine.errors import DataError
from engine.validation.reference.base import AngleUnit, Recording
from engine.validation.reference.c3d_file import C3dFile, Parameter, parse_c3d
from engine.validation.reference.text import read_bytes, regular_time
from engine.validation.reference.trc import blank_zeros, parse_length_unit

__all__ = ["read_c3d"]

_MODEL_OUTPUT = re.compile(r"(Angles?|Force|Moment|Power|GRF|CentreOfMass.*)$")
_OUTPUT_GROUPS = ("FORCES", "MOMENTS", "POWERS", "SCALARS")

Group = Mapping[str, Parameter]


def read_c3d(path: Path) -> Recording:
    """Read a C3D file; points with a negative residual are missing, analog channels are skipped.

    Raises
    ------
    DataError
        If the file is no C3D file, damaged, or holds no points.
    """
    content = parse_c3d(read_bytes(path), path.name)
    point = content.parameters["POINT"]
    names = _read_words(point, "LABELS")[: content.position.shape[1]]
    if not names or content.position.shape[0] == 0:
        raise DataError(f"{path.name} holds no points (only analog channels); export the markers.")
    rates = point["RATE"].numbers()
    if rates.size != 1 or not (np.isfinite(rates[0]) and rates[0] > 0):
        raise DataError(f"{path.name} states no frame rate; correct POINT:RATE.")
    return _sort_points(path.name, names, content, float(rates[0]))


def _sort_points(name: str, names: tuple[str, ...], content: C3dFile, rate_hz: float) -> Recording:
    """Tell markers from angles and from other model outputs, which are dropped."""
    point = content.parameters["POINT"]
    position = content.position[:, : len(names)]
    angles = set(_read_words(point, "ANGLES"))
    others = {word for group in _OUTPUT_GROUPS for word in _read_words(point, group)}
    is_angle = np.array([n in angles or (n not in others and n.endswith("Angles")) for n in names])
    is_marker = ~is_angle & np.array(
        [not (n in others or n.startswith("*") or _MODEL_OUTPUT.search(n)) for n in names]
    )
    n_frames = position.shape[0]
    unit = next(iter(_read_words(point, "UNITS")), "")
    return Recording(
        name=name,
        format="c3d",
        time_s=regular_time(n_frames, rate_hz, first_frame=content.first_frame),
        labels=tuple(n for n, keep in zip(names, is_marker, strict=True) if keep),
        position=blank_zeros(position[:, is_marker]),
        curves=tuple(
            f"{n}.{axis}" for n, keep in zip(names, is_angle, strict=True) if keep for axis in "xyz"
        ),
        value=position[:, is_angle].reshape(n_frames, -1),
        length_unit=parse_length_unit(unit, name),
        angle_unit=_parse_angle_unit(next(iter(_read_words(point, "ANGLE_UNITS")), "")),
    )


def _parse_angle_unit(text: str) -> AngleUnit:
    return "rad" if text.strip().lower().startswith("rad") else "deg"


def _read_words(group: Group, key: str) -> tuple[str, ...]:
    """Return a list of words; long lists go on in LABELS2, LABELS3 and so on."""
    parts = (key, *(f"{key}{n}" for n in range(2, 100)))
    return tuple(word for part in parts if part in group for word in group[part].words())
