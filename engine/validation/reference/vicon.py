"""CSV exports of Vicon Nexus: blocks of trajectories, model outputs and joints in one file.

Every block starts with its name and its rate, then come a row of names, a row of components that
starts with `Frame`, in newer exports a row of units, and the frames up to an empty row.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from engine.datatypes import Array
from engine.errors import DataError
from engine.validation.reference.base import AngleUnit, LengthUnit, Recording
from engine.validation.reference.text import parse_numbers, read_lines, require_times, split_rows
from engine.validation.reference.trc import blank_zeros, parse_length_unit

__all__ = ["is_vicon_csv", "read_vicon_csv"]

SECTIONS = ("trajectories", "model outputs", "joints", "segments", "devices")
MARKER_SECTION = "trajectories"
ANGLE_SECTIONS = ("model outputs", "joints")
HEADER_ROWS = 6
LOOK_AHEAD = 20
ANGLE_WORDS = {"deg": "deg", "degrees": "deg", "rad": "rad", "radians": "rad"}


@dataclass(frozen=True, eq=False)
class _Section:
    """One block: `names` and `components` per data column; `units` empty where not stated."""

    title: str
    time_s: Array
    names: tuple[str, ...]
    components: tuple[str, ...]
    units: tuple[str, ...]
    values: Array
    notes: tuple[str, ...] = ()


def is_vicon_csv(lines: Sequence[str]) -> bool:
    """Whether the first lines look like such an export."""
    return any(_title(line) for line in lines[:LOOK_AHEAD])


def _title(line: str) -> str:
    word = line.strip().strip(',;\t"').lower()
    return word if word in SECTIONS else ""


def read_vicon_csv(path: Path) -> Recording:
    """Read trajectories and joint angles of a Nexus CSV export.

    Raises
    ------
    DataError
        If no block holds markers or angles, or a block is damaged.
    """
    lines = read_lines(path)
    starts = [i for i, line in enumerate(lines) if _title(line)]
    wanted = [i for i in starts if _title(lines[i]) in (MARKER_SECTION, *ANGLE_SECTIONS)]
    if not wanted:
        raise DataError(
            f"{path.name} has no block 'Trajectories', 'Model Outputs' or 'Joints'; export one of "
            "them."
        )
    sections = [_read_section(lines, i, path.name) for i in wanted]
    trajectories = [s for s in sections if s.title == MARKER_SECTION]
    outputs = [s for s in sections if s.title in ANGLE_SECTIONS]
    time = (trajectories or outputs)[0].time_s
    labels, position, length_unit = _collect_markers(trajectories[:1], path.name)
    curves, value, angle_unit = _collect_angles(outputs, time)
    return Recording(
        name=path.name,
        format="vicon-csv",
        time_s=time,
        labels=labels,
        position=position,
        curves=curves,
        value=value,
        length_unit=length_unit,
        angle_unit=angle_unit,
        notes=tuple(note for s in sections for note in s.notes),
    )


def _read_section(lines: Sequence[str], start: int, name: str) -> _Section:
    title = _title(lines[start])
    end = next((i for i in range(start + 2, len(lines)) if _is_blank(lines[i])), len(lines))
    rows = split_rows(lines[start:end], _separator(lines[start:end]))
    where = f"{name}, block {title!r}"
    rate = _parse_rate(rows[1] if len(rows) > 1 else [], where)
    head = next((i for i, row in enumerate(rows[:HEADER_ROWS]) if _is_frame_row(row)), 0)
    if head < 2 or len(rows) < head + 2:
        raise DataError(
            f"{where}: expected a row that starts with 'Frame', and frames below it; export the "
            "block again."
        )
    components = [cell.lower() for cell in rows[head] if cell]
    has_units = not rows[head + 1][0].isdigit()
    first = head + 1 + has_units
    units = [cell.lower() for cell in rows[head + 1]] if has_units else []
    n_columns, lead = len(components), 1 + (components[1:2] == ["sub frame"])
    values = parse_numbers(
        rows[first:], n_columns=n_columns, name=name, first_line=start + first + 1
    )
    time, notes = _read_times(values[:, :lead], rate, name=name, first_line=start + first + 1)
    return _Section(
        title=title,
        time_s=time,
        names=tuple(_spread(rows[head - 1], n_columns)[lead:]),
        components=tuple(components[lead:]),
        units=tuple([*units, *[""] * n_columns][lead:n_columns]),
        values=values[:, lead:],
        notes=notes,
    )


def _read_times(
    frames: Array, rate_hz: float, *, name: str, first_line: int
) -> tuple[Array, tuple[str, ...]]:
    """Turn frame and sub-frame numbers into times; frame 1 is at time 0."""
    if not frames.size:
        raise DataError(f"{name} holds no frames; export the recording again.")
    sub = frames[:, 1] if frames.shape[1] > 1 else np.zeros(len(frames))
    per_frame = float(np.nan_to_num(sub).max()) + 1.0
    # The rate counts sub-frames, where there are some.
    time = (frames[:, 0] - 1.0 + sub / per_frame) * per_frame / rate_hz
    return require_times(time, name=name, first_line=first_line)


def _is_blank(line: str) -> bool:
    return not line.strip(' ,;\t"')


def _separator(lines: Sequence[str]) -> str:
    header = next((line for line in lines if "frame" in line.lower()), "")
    return max(",;\t", key=header.count)


def _is_frame_row(row: Sequence[str]) -> bool:
    return bool(row) and row[0].strip().lower() == "frame"


def _parse_rate(row: Sequence[str], where: str) -> float:
    text = row[0].replace(",", ".") if row else ""
    try:
        rate = float(text)
    except ValueError:
        rate = 0.0
    if not rate > 0:
        raise DataError(f"{where}: expected the frame rate below its name, got {text!r}.")
    return rate


def _spread(row: Sequence[str], n_columns: int) -> list[str]:
    """Repeat every name over the columns up to the next name, without the subject's prefix."""
    names, current = [], ""
    for cell in [*row, *[""] * n_columns][:n_columns]:
        current = cell or current
        names.append(current)
    return names


def _collect_markers(
    sections: Sequence[_Section], name: str
) -> tuple[tuple[str, ...], Array, LengthUnit | None]:
    if not sections:
        return (), np.empty((0, 0, 3)), None
    section = sections[0]
    first = [
        i for i in range(len(section.names) - 2) if section.components[i : i + 3] == ("x", "y", "z")
    ]
    columns = [i + axis for i in first for axis in range(3)]
    position = section.values[:, columns].reshape(len(section.time_s), len(first), 3)
    unit = next((section.units[i] for i in first if section.units[i]), "")
    labels = tuple(section.names[i] for i in first)
    return labels, blank_zeros(position), parse_length_unit(unit, name)


def _collect_angles(
    sections: Sequence[_Section], time_s: Array
) -> tuple[tuple[str, ...], Array, AngleUnit | None]:
    """Take the angles out of the model outputs, at the times of the trajectories."""
    names: list[str] = []
    values: list[Array] = []
    unit: AngleUnit | None = None
    for section in sections:
        for i, (curve, axis) in enumerate(zip(section.names, section.components, strict=True)):
            stated = ANGLE_WORDS.get(section.units[i], "")
            if not stated and (section.units[i] or not curve.lower().endswith("angles")):
                continue
            unit = ("rad" if stated == "rad" else "deg") if stated else unit
            names.append(f"{curve}.{axis}")
            values.append(_at_times(section.values[:, i], section.time_s, time_s))
    value = np.stack(values, axis=1) if values else np.empty((time_s.size, 0))
    return tuple(names), value, unit


def _at_times(curve: Array, own_s: Array, wanted_s: Array) -> Array:
    """Return a curve at other times; NaN outside and beside missing samples."""
    if own_s.shape == wanted_s.shape and np.allclose(own_s, wanted_s):
        return curve
    return np.interp(wanted_s, own_s, curve, left=np.nan, right=np.nan)
