"""OpenSim motion and storage files (`.mot`, `.sto`): joint angles over time."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from engine.errors import DataError
from engine.validation.reference.base import AngleUnit, Recording
from engine.validation.reference.text import parse_lines, read_lines, require_times, split_rows

__all__ = ["read_motion"]

MAX_HEADER_LINES = 1000


def read_motion(path: Path) -> Recording:
    """Read an OpenSim motion or storage file.

    Names may be short (`knee_angle_r`) or paths (`/jointset/walker_knee_r/knee_angle_r/value`);
    speeds and the states of anything but joints are left out. Columns of translation stay in.

    Raises
    ------
    DataError
        If the file is no motion file or damaged.
    """
    lines = read_lines(path)
    end = _find_header_end(lines, path.name)
    header = dict(line.split("=", 1) for line in lines[:end] if "=" in line)
    stated = {key.strip().lower(): value.strip().lower() for key, value in header.items()}
    if "vec3" in stated.get("datatype", ""):
        raise DataError(f"{path.name} holds vectors, not angles; save the markers as TRC.")
    body = [(i, line) for i, line in enumerate(lines) if i > end and line.strip()]
    if not body:
        raise DataError(f"{path.name} ends after its header; export it again.")
    separator = "\t" if "\t" in body[0][1] else " "
    columns = split_rows([body[0][1]], separator)[0]
    columns = columns[: len(columns) - (columns[-1] == "")]
    if columns[0].lower() != "time":
        raise DataError(f"{path.name}: expected 'time' as first column, got {columns[0]!r}.")
    first_line = body[0][0] + 2
    values = parse_lines(
        [line for _, line in body[1:]],
        separator=separator,
        n_columns=len(columns),
        name=path.name,
        first_line=first_line,
    )
    time, notes = require_times(values[:, 0], name=path.name, first_line=first_line)
    kept = [(i, name) for i, c in enumerate(columns) if i and (name := _coordinate_name(c))]
    return Recording(
        name=path.name,
        format="mot",
        time_s=time,
        curves=tuple(name for _, name in kept),
        value=values[:, [i for i, _ in kept]] if kept else np.empty((time.size, 0)),
        angle_unit=_parse_angle_unit(stated.get("indegrees", "")),
        notes=notes,
    )


def _find_header_end(lines: Sequence[str], name: str) -> int:
    for index, line in enumerate(lines[:MAX_HEADER_LINES]):
        if line.strip().lower() == "endheader":
            return index
    raise DataError(f"{name} is no OpenSim motion file: its header has no line 'endheader'.")


def _coordinate_name(column: str) -> str:
    """Return the coordinate a column stands for; nothing for speeds, muscles and the like."""
    if "/" not in column:
        return column
    parts = column.strip("/").split("/")
    return parts[-2] if parts[0] == "jointset" and parts[-1] == "value" and len(parts) > 2 else ""


def _parse_angle_unit(text: str) -> AngleUnit | None:
    if text in ("yes", "true", "1"):
        return "deg"
    return "rad" if text in ("no", "false", "0") else None
