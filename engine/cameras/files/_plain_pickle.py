"""Reading of pickles that hold nothing but numbers, text and arrays.

A pickle is a program. This reader first checks, without running it, that it has only the few
instructions that plain data need, and bounds their sizes; then lets it name only stand-ins of
NumPy's array constructors. No function of NumPy or of any other module is ever called by a file.
"""

from __future__ import annotations

import io
import math
import pickle
import pickletools
from typing import Any

import numpy as np

from engine.errors import CalibrationError

__all__ = ["read_plain_pickle"]

MAX_BYTES = 1_000_000
MAX_INSTRUCTIONS = 20_000
MAX_NUMBERS = 10_000
# fmt: off
OPCODES = frozenset({
    "PROTO", "FRAME", "MARK", "STOP", "POP", "POP_MARK", "PUT", "BINPUT", "LONG_BINPUT", "MEMOIZE",
    "GET", "BINGET", "LONG_BINGET", "NONE", "NEWTRUE", "NEWFALSE", "INT", "BININT", "BININT1",
    "BININT2", "LONG", "LONG1", "FLOAT", "BINFLOAT", "UNICODE", "BINUNICODE", "SHORT_BINUNICODE",
    "STRING", "BINSTRING", "SHORT_BINSTRING", "BINBYTES", "SHORT_BINBYTES", "EMPTY_DICT", "DICT",
    "SETITEM", "SETITEMS", "EMPTY_LIST", "LIST", "APPEND", "APPENDS", "EMPTY_TUPLE", "TUPLE",
    "TUPLE1", "TUPLE2", "TUPLE3", "GLOBAL", "STACK_GLOBAL", "REDUCE", "BUILD",
})
# fmt: on
NUMBER_TYPES = frozenset(["f4", "f8", "i4", "i8", "u4", "u8"])
_ARRAY_MODULES = ("numpy.core.multiarray", "numpy._core.multiarray")


class _Refused(Exception):  # noqa: N818
    """The pickle holds something else than plain data."""


class _ArrayType:
    """Stands for `numpy.ndarray`, which a pickle passes to the constructor of arrays."""

    __slots__ = ()

    def __setstate__(self, _state: object) -> None:
        raise _Refused


class _Number:
    """Stands for `numpy.dtype`: a number type and its byte order."""

    __slots__ = ("code",)

    def __init__(self, code: object = None, *_flags: object) -> None:
        if not isinstance(code, str) or code not in NUMBER_TYPES:
            raise _Refused
        self.code = "<" + code

    def __setstate__(self, state: object) -> None:
        order = state[1] if isinstance(state, tuple) and len(state) > 1 else None
        if order not in ("<", ">", "=", "|"):
            raise _Refused
        self.code = (">" if order == ">" else "<") + self.code[1:]


class _Array:
    """Stands for an array: shape, type and bytes, checked against each other."""

    __slots__ = ("values",)

    def __init__(self, *_arguments: object) -> None:
        self.values = np.zeros(0)

    def __setstate__(self, state: object) -> None:
        if not isinstance(state, tuple) or len(state) != 5:
            raise _Refused
        _, shape, number, is_fortran, raw = state
        if not isinstance(number, _Number):
            raise _Refused
        values = _decode(raw, number)
        is_shape = isinstance(shape, tuple) and all(type(n) is int and n >= 0 for n in shape)
        if not is_shape or len(shape) > 4 or math.prod(shape) != values.size:
            raise _Refused
        self.values = values.reshape(shape, order="F" if is_fortran else "C")


class _Scalar:
    """Stands for a NumPy number."""

    __slots__ = ("values",)

    def __init__(self, number: object, raw: object = b"") -> None:
        if not isinstance(number, _Number):
            raise _Refused
        self.values = _decode(raw, number)
        if self.values.size != 1:
            raise _Refused

    def __setstate__(self, _state: object) -> None:
        raise _Refused


def _decode(raw: object, number: _Number) -> np.ndarray[Any, np.dtype[np.float64]]:
    # Protocol 2 keeps bytes as text, one character a byte.
    data = raw.encode("latin1") if isinstance(raw, str) else raw
    item = int(number.code[2:])
    if not isinstance(data, bytes) or len(data) % item or len(data) > MAX_NUMBERS * item:
        raise _Refused
    return np.frombuffer(data, dtype=number.code).astype(np.float64)


def _encode(text: object, encoding: object = "latin1") -> bytes:
    """Stand for `_codecs.encode`, by which protocol 2 writes bytes."""
    if not isinstance(text, str) or encoding != "latin1":
        raise _Refused
    return text.encode("latin1")


class _Maker:
    """What a pickle gets when it names a function or class: callable, and nothing more."""

    __slots__ = ("_make",)

    def __init__(self, make: Any) -> None:
        self._make = make

    def __call__(self, *arguments: object) -> Any:
        return self._make(*arguments)

    def __setstate__(self, _state: object) -> None:
        raise _Refused


_MAKERS = {
    ("numpy", "dtype"): _Number,
    ("numpy", "ndarray"): _ArrayType,
    ("_codecs", "encode"): _encode,
    **{(module, "_reconstruct"): _Array for module in _ARRAY_MODULES},
    **{(module, "scalar"): _Scalar for module in _ARRAY_MODULES},
}


class _PlainUnpickler(pickle.Unpickler):
    def find_class(self, module: str, name: str) -> Any:
        make = _MAKERS.get((module, name))
        if make is None:
            raise _Refused
        return _Maker(make)

    def persistent_load(self, _pid: object) -> Any:
        raise _Refused


def read_plain_pickle(data: bytes, file_name: str) -> dict[str, Any]:
    """Read a pickled dictionary of numbers, text and arrays.

    Parameters
    ----------
    data
        The file's bytes.
    file_name
        For messages.

    Returns
    -------
    dict
        Text keys; arrays and NumPy numbers as arrays of floats, anything else as it is.

    Raises
    ------
    CalibrationError
        If it holds anything else, or is damaged.
    """
    refusal = CalibrationError(
        f"{file_name} holds more than numbers, text and arrays; it was not opened, for such a file "
        "could run a program. Export the calibration as TOML."
    )
    damage = CalibrationError(f"{file_name} is cut off or no pickle; copy it again.")
    if len(data) > MAX_BYTES:
        raise refusal
    try:
        _require_plain(data)
        content = _PlainUnpickler(io.BytesIO(data), encoding="latin1").load()
    except _Refused:
        raise refusal from None
    except (
        pickle.UnpicklingError, EOFError, ValueError, TypeError, KeyError, IndexError,
        AttributeError, OverflowError, RecursionError, MemoryError,
    ):  # fmt: skip
        # What the machine that runs a damaged pickle may stumble on.
        raise damage from None
    if not isinstance(content, dict) or not all(isinstance(key, str) for key in content):
        raise refusal
    return {key: _unwrap(value) for key, value in content.items()}


def _unwrap(value: Any) -> Any:
    return value.values if isinstance(value, _Array | _Scalar) else value


def _require_plain(data: bytes) -> None:
    for count, (opcode, argument, _) in enumerate(pickletools.genops(data)):
        if opcode.name not in OPCODES or count > MAX_INSTRUCTIONS:
            raise _Refused
        # A huge slot number would reserve memory for all the slots below it.
        if opcode.name in ("PUT", "LONG_BINPUT") and int(str(argument)) > MAX_INSTRUCTIONS:
            raise _Refused
