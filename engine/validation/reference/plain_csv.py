"""Plain CSV tables: a time column, then markers (x, y, z each) or joint angles.

Also the angle tables that LiftLens itself writes, and tables with two header rows (names above,
X, Y, Z below). Separators, decimal commas and units in headings are recognised.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from engine.datatypes import Array
from engine.errors import DataError
from engine.validation.reference.base import AngleUnit, LengthUnit, Recording
from engine.validation.reference.text import parse_numbers, read_lines, require_times, split_rows
from engine.validation.reference.trc import blank_zeros

__all__ = ["read_plain_csv"]

_TIME = re.compile(r"(time|times|t|timestamp|zeit|temps|tiempo)", re.IGNORECASE)
_UNIT = re.compile(r"\s*[\[(]\s*([^\])]+?)\s*[\])]\s*$|_(s|ms|sec|deg|rad|mm|cm|m)$", re.IGNORECASE)
_AXIS = re.compile(r"^(?P<label>.+?)\s*[_.:\- ]\s*(?P<axis>[xyz])$", re.IGNORECASE)
_TIME_SCALE = {"": 1.0, "s": 1.0, "sec": 1.0, "seconds": 1.0, "ms": 1e-3, "milliseconds": 1e-3}
_LENGTHS: dict[str, LengthUnit] = {"m": "m", "cm": "cm", "mm": "mm"}
_ANGLES: dict[str, AngleUnit] = {
    "deg": "deg",
    "degree": "deg",
    "degrees": "deg",
    "°": "deg",
    "rad": "rad",
    "radians": "rad",
}
_SIGMA = "_sigma"


def read_plain_csv(path: Path) -> Recording:
    """Read a table of markers or angles over time.

    Raises
    ------
    DataError
        If there is no time column, or no other column of numbers.
    """
    lines = [(i, line) for i, line in enumerate(read_lines(path)) if _has_content(line)]
    rows = split_rows([line for _, line in lines])
    n_head = _count_header_rows(rows, path.name)
    headings = _join_headings(rows[:n_head])
    names, units = zip(*(_split_unit(heading) for heading in headings), strict=True)
    values = parse_numbers(
        rows[n_head:], n_columns=len(names), name=path.name, first_line=lines[n_head][0] + 1
    )
    column = next((i for i, name in enumerate(names) if _TIME.fullmatch(name)), None)
    if column is None:
        raise DataError(
            f"{path.name} has no time column; name one column 'time_s'. Found: "
            f"{', '.join(n for n in headings[:6] if n)}."
        )
    scale = _TIME_SCALE.get(units[column], 1.0)
    time, notes = require_times(
        values[:, column] * scale, name=path.name, first_line=lines[n_head][0] + 1
    )
    markers = _find_markers(names)
    taken = {column, *(i for triple in markers.values() for i in triple)}
    curves = [i for i, name in enumerate(names) if i not in taken and name]
    return _build(path.name, time, names, units, values, markers, curves, notes)


def _build(
    name: str,
    time_s: Array,
    names: Sequence[str],
    units: Sequence[str],
    values: Array,
    markers: dict[str, tuple[int, int, int]],
    curves: Sequence[int],
    notes: tuple[str, ...],
) -> Recording:
    columns = [i for triple in markers.values() for i in triple]
    own = [i for i in curves if not names[i].lower().endswith(_SIGMA)]
    sigma = np.full((time_s.size, len(own)), np.nan)
    for k, i in enumerate(own):
        partner = f"{names[i]}{_SIGMA}"
        if partner in names:
            sigma[:, k] = values[:, names.index(partner)]
    return Recording(
        name=name,
        format="csv",
        time_s=time_s,
        labels=tuple(markers),
        position=blank_zeros(values[:, columns].reshape(time_s.size, len(markers), 3)),
        curves=tuple(names[i] for i in own),
        value=values[:, own],
        sigma=sigma,
        length_unit=next((_LENGTHS[units[i]] for i in columns if units[i] in _LENGTHS), None),
        angle_unit=next((_ANGLES[units[i]] for i in own if units[i] in _ANGLES), None),
        notes=notes,
    )


def _has_content(line: str) -> bool:
    return bool(line.strip(' ,;\t"')) and not line.lstrip().startswith("#")


def _is_number(cell: str) -> bool:
    try:
        float(cell.replace(",", "."))
    except ValueError:
        return False
    return True


def _count_header_rows(rows: Sequence[Sequence[str]], name: str) -> int:
    """Return how many rows come before the first that starts with a number."""
    for index, row in enumerate(rows[:5]):
        if row and _is_number(next((cell for cell in row if cell), "")):
            if index == 0:
                raise DataError(
                    f"{name} has no headings; expected a first line such as "
                    "'time_s,knee_flexion_r_deg'."
                )
            return index
    raise DataError(f"{name} holds no table of numbers; expected headings, then one frame a line.")


def _join_headings(rows: Sequence[Sequence[str]]) -> list[str]:
    """Return one heading per column; a row of X, Y, Z is joined to the names above it."""
    axes = next((row for row in rows if sum(c.lower() in ("x", "y", "z") for c in row) >= 3), None)
    if axes is None:
        return list(rows[-1])
    above = rows[0] if rows[0] is not axes else []
    headings, current = [], ""
    for i, cell in enumerate(axes):
        own = above[i] if i < len(above) else ""
        current = own or current
        is_axis = cell.lower() in ("x", "y", "z")
        headings.append(f"{current}_{cell}" if is_axis else (cell or own))
    return headings


def _split_unit(heading: str) -> tuple[str, str]:
    """Return a heading without its unit, and the unit in lower case."""
    text = heading.strip()
    found = _UNIT.search(text)
    if not found or not text[: found.start()]:
        return text, ""
    return text[: found.start()].strip(), (found.group(1) or found.group(2)).lower()


def _find_markers(names: Sequence[str]) -> dict[str, tuple[int, int, int]]:
    """Return the columns of every label that has all of x, y and z."""
    found: dict[str, dict[str, int]] = {}
    for i, name in enumerate(names):
        match = _AXIS.match(name)
        if match and not match["label"].lower().endswith("angles"):
            found.setdefault(match["label"], {})[match["axis"].lower()] = i
    return {
        label: (axes["x"], axes["y"], axes["z"])
        for label, axes in found.items()
        if {"x", "y", "z"} <= set(axes)
    }
