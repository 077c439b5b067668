"""Tiny ONNX files, written byte by byte: the package that writes them is not needed for tests."""

from __future__ import annotations

from pathlib import Path

import numpy as np

FLOAT, DOUBLE = 1, 11


def _varint(value: int) -> bytes:
    out = bytearray()
    while value > 0x7F:
        out.append(value & 0x7F | 0x80)
        value >>= 7
    return bytes([*out, value])


def _field(number: int, value: int | bytes | str) -> bytes:
    if isinstance(value, int):
        return _varint(number << 3) + _varint(value)
    content = value.encode() if isinstance(value, str) else value
    return _varint(number << 3 | 2) + _varint(len(content)) + content


def _value(name: str, shape: tuple[int | str, ...], kind: int) -> bytes:
    dims = b"".join(_field(1, _field(1, d) if isinstance(d, int) else _field(2, d)) for d in shape)
    return _field(1, name) + _field(2, _field(1, _field(1, kind) + _field(2, dims)))


def write_network(
    path: Path,
    outputs: dict[str, np.ndarray],
    *,
    input_shape: tuple[int | str, ...] = (1, 3, 256, 256),
    input_kind: int = FLOAT,
    opset: int = 17,
) -> Path:
    """Write a network that gives the same numbers for every picture."""
    graph = b""
    for name in outputs:
        graph += _field(1, _field(1, f"{name}_value") + _field(2, name) + _field(4, "Identity"))
    graph += _field(2, "constant")
    for name, values in outputs.items():
        dims = b"".join(_field(1, n) for n in values.shape)
        raw = values.astype(np.float32).tobytes()
        graph += _field(5, dims + _field(2, FLOAT) + _field(8, f"{name}_value") + _field(9, raw))
    graph += _field(11, _value("image", input_shape, input_kind))
    for name, values in outputs.items():
        graph += _field(12, _value(name, values.shape, FLOAT))
    opsets = _field(8, _field(1, "") + _field(2, opset))
    path.write_bytes(_field(1, 8) + _field(7, graph) + opsets)
    return path
