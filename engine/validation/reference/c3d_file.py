"""The container of C3D files: header, parameters and 3D points, as its user guide defines them.

Files come from elsewhere and may be damaged; this reader follows no pointer out of the file, where
a compiled library may end the whole process. Intel, DEC and MIPS byte orders, floats and scaled
integers are read; analog channels are skipped.

References
----------
.. [1] Motion Lab Systems (2021), The C3D File Format: A Technical User Guide.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from engine.datatypes import Array
from engine.errors import DataError

__all__ = ["C3dFile", "Parameter", "parse_c3d"]

BLOCK = 512
MAGIC = 0x50
INTEL, DEC, MIPS = 84, 85, 86
TYPE_BYTES = (-1, 1, 2, 4)
MAX_DIMENSIONS = 7
NEEDED = ("SCALE", "RATE", "LABELS")
"""Parameters of the group POINT, without which points can't be read."""


class _Damage(Exception):  # noqa: N818 - carries a reason, never leaves this module
    """What doesn't hang together."""


@dataclass(frozen=True)
class Parameter:
    """One raw parameter: `kind` -1 text, 1 bytes, 2 integers, 4 floats."""

    kind: int
    dimensions: tuple[int, ...]
    content: bytes
    processor: int

    def words(self) -> tuple[str, ...]:
        """Return the texts of a list of texts."""
        width = self.dimensions[0] if self.dimensions else 1
        text = self.content.decode("utf-8", errors="replace")
        if len(text) != len(self.content):
            text = self.content.decode("latin-1")
        if self.kind != -1 or width == 0:
            return ()
        return tuple(text[i : i + width].strip(" \0") for i in range(0, len(text), width))

    def numbers(self) -> Array:
        """Return the numbers, flat."""
        if self.kind == 4:
            return _floats(self.content, self.processor)
        code = {1: "u1", 2: "i2"}.get(self.kind, "u1")
        return np.frombuffer(self.content, _order(self.processor) + code).astype(np.float64)


@dataclass(frozen=True, eq=False)
class C3dFile:
    """Points of a file, in its own unit and axes.

    `position` (T, N, 3), NaN where a point is missing; `first_frame` counts from 1; `parameters`
    by group and name, in capitals.
    """

    position: Array
    first_frame: int
    parameters: Mapping[str, Mapping[str, Parameter]]


def parse_c3d(data: bytes, name: str) -> C3dFile:
    """Parse the content of a C3D file.

    Raises
    ------
    DataError
        If it is no C3D file, was cut off, or is damaged.
    """
    if len(data) < 2 or data[1] != MAGIC:
        raise DataError(f"{name} is no C3D file; export the recording again.")
    try:
        parameters, processor = _read_parameters(data)
        return _read_points(data, parameters, processor)
    except (_Damage, struct.error, IndexError) as error:
        reason = str(error) if isinstance(error, _Damage) else "it ends too early"
        raise DataError(f"{name} is a damaged C3D file: {reason}. Export it again.") from error


def _order(processor: int) -> str:
    return ">" if processor == MIPS else "<"


def _floats(content: bytes, processor: int) -> Array:
    if processor != DEC:
        return np.frombuffer(content, f"{_order(processor)}f4").astype(np.float64)
    # A DEC float is an IEEE float with its halves exchanged, times four.
    halves = np.frombuffer(content, "<u2").reshape(-1, 2)[:, ::-1]
    return halves.copy().view("<f4").astype(np.float64).ravel() / 4.0


# --------------------------------------------------------------------------- parameters


def _read_parameters(data: bytes) -> tuple[dict[str, dict[str, Parameter]], int]:
    """Walk all parameter records; return them by group, and the kind of processor."""
    start = (data[0] - 1) * BLOCK
    if start < BLOCK or start + 4 > len(data):
        raise _Damage("its parameters lie outside the file")
    n_blocks, processor = data[start + 2], data[start + 3]
    if processor not in (INTEL, DEC, MIPS):
        raise _Damage(f"it names the unknown processor {processor}")
    end = min(start + n_blocks * BLOCK, len(data)) if n_blocks else len(data)
    names: dict[int, str] = {}
    values: dict[int, dict[str, Parameter]] = {}
    for group, key, parameter in _walk(data, start + 4, end, processor):
        if parameter is None:
            names[-group] = key
        else:
            values.setdefault(group, {})[key] = parameter
    groups = {names[number]: found for number, found in values.items() if number in names}
    missing = [key for key in NEEDED if key not in groups.get("POINT", {})]
    if missing:
        raise _Damage(f"it lacks the parameter POINT:{missing[0]}")
    return groups, processor


def _walk(
    data: bytes, at: int, end: int, processor: int
) -> Iterator[tuple[int, str, Parameter | None]]:
    """Yield group number, name and value of every record; a group itself has no value."""
    while at + 2 <= end:
        n_chars, group = struct.unpack_from("<bb", data, at)
        n_chars = abs(n_chars)
        if n_chars == 0 or group == 0:
            return
        key = data[at + 2 : at + 2 + n_chars].decode("latin-1").upper()
        offset_at = at + 2 + n_chars
        (offset,) = struct.unpack_from(f"{_order(processor)}H", data, offset_at)
        following = offset_at + offset if offset else end
        if following > end or following < offset_at + 3:
            raise _Damage(f"the parameter {_show(key)} points outside the parameters")
        if group < 0:
            yield group, key, None
        else:
            yield group, key, _read_value(data, offset_at + 2, following, key, processor)
        at = following


def _show(key: str) -> str:
    return "".join(c if c.isprintable() and c.isascii() else "?" for c in key[:20])


def _read_value(data: bytes, at: int, end: int, key: str, processor: int) -> Parameter:
    kind, n_dimensions = struct.unpack_from("<bB", data, at)
    if kind not in TYPE_BYTES or n_dimensions > MAX_DIMENSIONS:
        raise _Damage(f"the parameter {_show(key)} has no known type")
    dimensions = tuple(data[at + 2 : at + 2 + n_dimensions])
    size = abs(kind)
    for dimension in dimensions:
        size *= dimension
    first = at + 2 + n_dimensions
    if first + size > end:
        raise _Damage(f"the parameter {_show(key)} is longer than its place")
    return Parameter(kind, dimensions, data[first : first + size], processor)


# --------------------------------------------------------------------------- points


def _read_points(
    data: bytes, parameters: dict[str, dict[str, Parameter]], processor: int
) -> C3dFile:
    order = _order(processor)
    words = struct.unpack_from(f"{order}10H", data, 0)
    n_points, n_analog, first, data_block = words[1], words[2], words[3], words[8]
    n_frames = _count_frames(words, parameters) if n_points else 0
    scale = parameters["POINT"]["SCALE"].numbers()
    if scale.size != 1 or not np.isfinite(scale[0]) or scale[0] == 0:
        raise _Damage("it states no scale")
    is_float = bool(scale[0] < 0)
    width = 4 * n_points + n_analog
    start, size = (data_block - 1) * BLOCK, n_frames * width * (4 if is_float else 2)
    if n_points and (data_block < 2 or start + size > len(data)):
        raise _Damage(f"it announces {max(start, 0) + size} bytes and has {len(data)}: cut off")
    raw = data[start : start + size] if n_points else b""
    if is_float:
        table = _floats(raw, processor).reshape(n_frames, width)
    else:
        table = np.frombuffer(raw, f"{order}i2").astype(np.float64).reshape(n_frames, width)
    points = table[:, : 4 * n_points].reshape(n_frames, n_points, 4)
    position = points[..., :3] * (1.0 if is_float else scale[0])
    with np.errstate(invalid="ignore"):
        is_missing = ~(points[..., 3] >= 0) | ~np.isfinite(position).all(axis=2)
    return C3dFile(np.where(is_missing[..., None], np.nan, position), int(first), parameters)


def _count_frames(words: tuple[Any, ...], parameters: Mapping[str, Mapping[str, Parameter]]) -> int:
    """Return the number of frames; long recordings state it in TRIAL, not in the header."""
    first, last = int(words[3]), int(words[4])
    trial = parameters.get("TRIAL", {})
    if "ACTUAL_START_FIELD" in trial and "ACTUAL_END_FIELD" in trial:
        fields = (_as_long(trial[f"ACTUAL_{word}_FIELD"]) for word in ("START", "END"))
        actual_first, actual_last = fields
        if actual_last >= actual_first > 0:
            return actual_last - actual_first + 1
    if last < first:
        raise _Damage("its last frame comes before its first")
    return last - first + 1


def _as_long(parameter: Parameter) -> int:
    """Return a number kept as two 16-bit words, the low one first."""
    words: NDArray[np.int64] = parameter.numbers().astype(np.int64) & 0xFFFF
    return int(words[0] + (words[1] << 16)) if words.size == 2 else 0
