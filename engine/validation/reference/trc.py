"""TRC marker files (Motion Analysis, OpenSim): tab-separated text, one frame a line."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from engine.datatypes import Array
from engine.errors import DataError
from engine.validation.reference.base import LengthUnit, Recording
from engine.validation.reference.text import (
    parse_lines,
    read_lines,
    regular_time,
    require_times,
)

__all__ = ["blank_zeros", "parse_length_unit", "read_trc"]

MIN_HEADER_LINES = 5
LABEL_LINE = 3
UNIT_WORDS: Mapping[str, LengthUnit] = {
    "m": "m",
    "meter": "m",
    "meters": "m",
    "metre": "m",
    "metres": "m",
    "cm": "cm",
    "centimeters": "cm",
    "centimetres": "cm",
    "mm": "mm",
    "millimeters": "mm",
    "millimetres": "mm",
}


def parse_length_unit(text: str, name: str) -> LengthUnit | None:
    """Return the unit a file states; None where it states none.

    Raises
    ------
    DataError
        If the unit is not metres, centimetres or millimetres.
    """
    word = text.strip().lower()
    if not word:
        return None
    if word not in UNIT_WORDS:
        raise DataError(
            f"{name} states the unit {text!r}; expected mm, cm or m. Convert it, or correct the "
            "header."
        )
    return UNIT_WORDS[word]


def read_trc(path: Path) -> Recording:
    """Read a TRC file.

    Raises
    ------
    DataError
        If the file is no TRC file or damaged.
    """
    lines = read_lines(path)
    header, labels = _read_header(lines, path.name)
    start = next((i for i in range(LABEL_LINE + 1, len(lines)) if _is_data(lines[i])), len(lines))
    body = [line for line in lines[start:] if line.strip()]
    values = parse_lines(
        body,
        separator="\t" if body and "\t" in body[0] else " ",
        n_columns=2 + 3 * len(labels),
        name=path.name,
        first_line=start + 1,
    )
    rate = _parse_rate(header.get("datarate", ""))
    time = values[:, 1]
    if time.size > 1 and np.isnan(time).all() and rate:
        time = regular_time(time.size, rate)
    time, notes = require_times(time, name=path.name, rate_hz=rate, first_line=start + 1)
    announced = header.get("numframes", "")
    if announced.isdigit() and int(announced) > time.size:
        notes += (f"The header announces {announced} frames, the file has {time.size}.",)
    return Recording(
        name=path.name,
        format="trc",
        time_s=time,
        labels=labels,
        position=blank_zeros(values[:, 2:].reshape(time.size, len(labels), 3)),
        length_unit=parse_length_unit(header.get("units", ""), path.name),
        notes=notes,
    )


def blank_zeros(position: Array) -> Array:
    """Set points at exactly the origin to missing: exporters write gaps that way."""
    is_zero = (position == 0.0).all(axis=2, keepdims=True)
    return np.where(is_zero, np.nan, position)


def _read_header(lines: Sequence[str], name: str) -> tuple[dict[str, str], tuple[str, ...]]:
    if not lines[0].lstrip().lower().startswith("pathfiletype") or len(lines) < MIN_HEADER_LINES:
        raise DataError(
            f"{name} is no TRC file: expected a first line that starts with PathFileType, got "
            f"{lines[0][:30]!r}."
        )
    keys, values = lines[1].split(), lines[2].split()
    header = {key.lower(): value for key, value in zip(keys, values, strict=False)}
    labels = tuple(lines[LABEL_LINE].split("\t")) if "\t" in lines[LABEL_LINE] else ()
    labels = tuple(x.strip() for x in labels if x.strip()) or tuple(lines[LABEL_LINE].split())
    if len(labels) < 3:
        raise DataError(f"{name} names no markers in its fourth line; export the markers again.")
    return header, labels[2:]


def _is_data(line: str) -> bool:
    first = line.split()[:1]
    return bool(first) and first[0].lstrip("+-").replace(".", "", 1).replace(",", "", 1).isdigit()


def _parse_rate(text: str) -> float | None:
    try:
        rate = float(text.replace(",", "."))
    except ValueError:
        return None
    return rate if rate > 0 else None
