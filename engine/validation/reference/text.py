"""Tables of numbers in text files: encodings, separators, decimal commas, blanks."""

from __future__ import annotations

import csv
import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from engine.datatypes import Array
from engine.errors import DataError

__all__ = [
    "parse_lines",
    "parse_numbers",
    "read_lines",
    "regular_time",
    "require_times",
    "split_rows",
]

MISSING_WORDS = frozenset({"", "nan", "-nan", "na", "n/a", "null", "none", "-", "inf", "-inf"})
_DECIMAL_COMMA = re.compile(r"[+-]?\d*,\d+([eE][+-]?\d+)?")
_SEPARATORS = ("\t", ";", ",")
MAX_BYTES = 2_000_000_000
SAMPLE_ROWS = 200
MAX_ROUNDING_S = 0.02


def read_lines(path: Path) -> list[str]:
    """Read a text file, whatever its encoding and line ends.

    Raises
    ------
    DataError
        If there is no such file, it is empty, or it is no text.
    """
    data = read_bytes(path)
    if b"\0" in data[:4096] and not data.startswith((b"\xff\xfe", b"\xfe\xff")):
        raise DataError(f"{path.name} is no text file; expected a table of numbers as text.")
    if data.startswith((b"\xff\xfe", b"\xfe\xff")):
        text = data.decode("utf-16", errors="replace")
    else:
        try:
            text = data.decode("utf-8-sig")
        except UnicodeDecodeError:
            text = data.decode("latin-1")
    return text.splitlines()


def read_bytes(path: Path) -> bytes:
    """Read a file, or say plainly why it can't be read."""
    try:
        if path.stat().st_size > MAX_BYTES:
            raise DataError(f"{path.name} is larger than 2 GB; export only the trial to compare.")
        data = path.read_bytes()
    except FileNotFoundError:
        raise DataError(f"There is no file {path}; check the path.") from None
    except IsADirectoryError:
        raise DataError(f"{path} is a folder; give the recording itself.") from None
    except OSError as error:
        raise DataError(f"{path} can't be read: {error.strerror or error}.") from error
    if not data.strip():
        raise DataError(f"{path.name} is empty; export the recording again.")
    return data


def split_rows(lines: Sequence[str], separator: str | None = None) -> list[list[str]]:
    """Split lines into cells; without a `separator`, at the one that the lines use.

    Cells in double quotes may hold the separator, as spreadsheets write decimal commas.
    """
    chosen = separator or _guess_separator(lines)
    if chosen == " ":
        return [line.split() for line in lines]
    if not any('"' in line for line in lines):
        return [[cell.strip() for cell in line.split(chosen)] for line in lines]
    return [[cell.strip() for cell in row] for row in csv.reader(lines, delimiter=chosen)]


def _guess_separator(lines: Sequence[str]) -> str:
    sample = [line for line in lines if line.strip()][:SAMPLE_ROWS]
    counts = {s: float(np.median([line.count(s) for line in sample] or [0])) for s in _SEPARATORS}
    # A semicolon or a tab in most lines is never part of a number; a comma may be.
    return next((s for s in _SEPARATORS if counts[s] >= 1), " ")


def parse_lines(
    lines: Sequence[str], *, separator: str, n_columns: int, name: str, first_line: int = 1
) -> Array:
    """Turn lines of text into numbers, as `parse_numbers` does with cells; quicker."""
    if not lines:
        return np.empty((0, n_columns))
    try:
        delimiter = None if separator == " " else separator
        stripped = [line.rstrip() for line in lines]
        table = np.loadtxt(stripped, delimiter=delimiter, comments=None, ndmin=2)
        if table.shape == (len(lines), n_columns):
            return table
    except ValueError:
        pass  # blanks, words, decimal commas or damage: look at every cell
    return parse_numbers(
        split_rows(lines, separator), n_columns=n_columns, name=name, first_line=first_line
    )


def parse_numbers(
    rows: Sequence[Sequence[str]], *, n_columns: int, name: str, first_line: int = 1
) -> Array:
    """Turn cells into numbers of shape (rows, n_columns).

    Blank cells and words such as `nan` are missing, as are cells that a short row lacks. A decimal
    comma counts as a point where no number of the table has a point.

    Parameters
    ----------
    rows
        The cells.
    n_columns
        How many columns the header announces.
    name, first_line
        File name, and number of the first row in it, for messages.

    Raises
    ------
    DataError
        If a cell is no number, or a row is longer than the header.
    """
    for index, row in enumerate(rows):
        if len(row) > n_columns and any(row[n_columns:]):
            raise DataError(_too_long(row, n_columns, f"{name}, line {first_line + index}"))
    cells = [
        row if len(row) == n_columns else [*row[:n_columns], *[""] * (n_columns - len(row))]
        for row in rows
    ]
    if _has_decimal_commas(cells, name):
        cells = [[cell.replace(",", ".") for cell in row] for row in cells]
    try:
        # The quick way: nearly every file holds only numbers and blanks.
        return np.array([[float(c or "nan") for c in row] for row in cells]).reshape(-1, n_columns)
    except ValueError:
        pass
    values = [
        [_parse_cell(c, f"{name}, line {first_line + i}, column {j + 1}") for j, c in enumerate(r)]
        for i, r in enumerate(cells)
    ]
    return np.array(values, dtype=np.float64).reshape(-1, n_columns)


def _parse_cell(cell: str, where: str) -> float:
    if cell.lower() in MISSING_WORDS:
        return float("nan")
    try:
        return float(cell)
    except ValueError:
        raise DataError(f"{where}: expected a number, got {cell!r}; correct the cell.") from None


def _has_decimal_commas(rows: Sequence[Sequence[str]], name: str) -> bool:
    sample = [cell for row in rows[:SAMPLE_ROWS] for cell in row]
    with_comma = [cell for cell in sample if "," in cell]
    if not with_comma:
        return False
    if any("." in cell for cell in sample) or not all(map(_DECIMAL_COMMA.fullmatch, with_comma)):
        raise DataError(
            f"{name} mixes points and commas in its numbers (such as {with_comma[0]!r}); "
            "export it without thousands separators."
        )
    return True


def _too_long(row: Sequence[str], n_columns: int, where: str) -> str:
    expected = f"{where}: expected {n_columns} columns as in the header, got {len(row)}"
    if all(cell.lstrip("+-").isdigit() for cell in row if cell):
        return (
            f"{expected}. Decimal commas in a file that is separated by commas can't be told "
            "apart; export it with semicolons, tabs or decimal points."
        )
    return f"{expected}; export the file again."


def regular_time(n_frames: int, rate_hz: float, *, first_frame: int = 1) -> Array:
    """Return the times of frames that are numbered from 1 at time 0."""
    return (np.arange(n_frames) + first_frame - 1) / rate_hz


def require_times(
    time_s: Array, *, name: str, rate_hz: float | None = None, first_line: int = 1
) -> tuple[Array, tuple[str, ...]]:
    """Check a time column; repair what is only rounding, and report jumps.

    Parameters
    ----------
    time_s
        Shape (T,), as written.
    name, first_line
        File name, and number of the first row in it, for messages.
    rate_hz
        The rate that the header states, if any.

    Returns
    -------
    tuple
        Increasing times, shape (T,), s, and notes in words.

    Raises
    ------
    DataError
        If times are missing or go back.
    """
    if time_s.size == 0:
        raise DataError(f"{name} holds no frames; export the recording again.")
    if not np.isfinite(time_s).all():
        line = first_line + int(np.argmin(np.isfinite(time_s)))
        raise DataError(f"{name}, line {line}: there is no time; fill the time column.")
    steps = np.diff(time_s)
    if steps.size and steps.min() <= 0:
        repaired = _from_rate(time_s, rate_hz)
        if repaired is None:
            line = first_line + int(np.argmax(steps <= 0)) + 1
            at = time_s[line - first_line]
            raise DataError(
                f"{name}, line {line}: the time does not increase (it goes to {at:g} s); export "
                "one trial with continuous times."
            )
        note = f"Times are rounded so far that some repeat; they were rebuilt from {rate_hz:g} Hz."
        return repaired, (note,)
    return time_s, _report_jumps(time_s, steps)


def _from_rate(time_s: Array, rate_hz: float | None) -> Array | None:
    """Rebuild times from the rate where it explains them to within the rounding."""
    if not rate_hz or not np.isfinite(rate_hz) or rate_hz <= 0:
        return None
    rebuilt: Array = time_s[0] + np.arange(time_s.size) / rate_hz
    steps = np.diff(time_s)
    rounding = float(steps[steps > 0].min(initial=np.inf)) if (steps > 0).any() else 0.0
    tolerance = 1.01 * max(1.0 / rate_hz, min(rounding, MAX_ROUNDING_S))
    return rebuilt if np.abs(rebuilt - time_s).max() <= tolerance else None


def _report_jumps(time_s: Array, steps: Array) -> tuple[str, ...]:
    if steps.size < 2:
        return ()
    usual = float(np.median(steps))
    jumps = np.flatnonzero(steps > 2.5 * usual)
    if not jumps.size:
        return ()
    total = float((steps[jumps] - usual).sum())
    first = int(jumps[0])
    note = (
        f"Time jumps {jumps.size} times, first by {steps[first]:.2f} s after "
        f"{time_s[first]:.2f} s; the {total:.2f} s in between are not compared."
    )
    return (note,)
