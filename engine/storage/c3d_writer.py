"""C3D files: keypoints in millimetres and joint angles in degrees, for motion-capture programs.

The layout is that of the C3D user guide: one block of header, the parameters, then every
frame as 32-bit floats in Intel byte order. Joint angles are points listed in ``POINT:ANGLES``, as
Vicon and Visual3D write theirs: the angle is the X component, Y and Z are zero.

The fourth number of a point is 0, or -1 where the sample is missing. Programs disagree about
which of its bytes holds a residual, so standard errors are left to the CSV and the result itself.

References
----------
.. [1] The C3D File Format: A Technical User Guide, https://www.c3d.org
"""

from __future__ import annotations

import struct
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from engine.datatypes import Array, JointAngles, PoseTrack
from engine.errors import DataError, UnitError
from engine.skeletons import get_skeleton

__all__ = ["write_c3d"]

BLOCK_BYTES = 512
MM_PER_M = 1000.0
KEY = 0x50
INTEL = 84
SCALE = -1.0
"""Negative: coordinates are floats."""
MAX_FRAMES = 65535
"""What the header counts to; programs read longer files in different ways."""
MAX_POINTS = 255
CHARACTER, INTEGER, FLOAT = -1, 2, 4


@dataclass(frozen=True)
class _Parameter:
    """One parameter: its type in the file, its dimensions (first fastest) and its bytes."""

    name: str
    kind: int
    dimensions: tuple[int, ...]
    data: bytes


def write_c3d(track: PoseTrack, angles: JointAngles, path: Path) -> None:
    """Write a world track and its joint angles as C3D.

    Frames are those of the video, in order; a C3D file has one rate only, so the mean rate stands
    in the header and the true times, in seconds, in the analog channel ``time``.

    Raises
    ------
    UnitError
        If the track is not in metres in the world frame.
    DataError
        If track and angles differ in their frames, or the file can't hold so many points.
    """
    if track.frame_of_reference != "world":
        raise UnitError(
            f"A C3D file needs a track in the world frame, got the {track.frame_of_reference} "
            "frame; give the world track of the result."
        )
    if not np.array_equal(track.time_s, angles.time_s):
        raise DataError("The track and the joint angles have different frames; assess again.")
    names = get_skeleton(track.skeleton).keypoints
    labels = (*names, *angles.names)
    if not 1 <= track.n_frames <= MAX_FRAMES or len(labels) > MAX_POINTS:
        raise DataError(
            f"A C3D file holds up to {MAX_POINTS} points and 1 to {MAX_FRAMES} frames, got "
            f"{len(labels)} points and {track.n_frames} frames; export TRC and MOT instead."
        )
    rate_hz = _mean_rate_hz(track.time_s)
    groups = _describe(names, angles.names, track, rate_hz)
    parameters = _encode_parameters(groups, first_block=2)
    header = _encode_header(len(labels), track.n_frames, rate_hz, 2 + len(parameters) // 512)
    points = np.concatenate([track.position * MM_PER_M, _angle_points(angles)], axis=1)
    samples = _mark_missing(points).reshape(track.n_frames, -1)
    data = np.column_stack([samples, track.time_s]).astype("<f4")
    path.write_bytes(header + parameters + _pad(data.tobytes()))


def _mean_rate_hz(time_s: Array) -> float:
    """Return the mean frame rate; 1 where a single frame has none."""
    if time_s.size < 2:
        return 1.0
    return float((time_s.size - 1) / (time_s[-1] - time_s[0]))


# --------------------------------------------------------------------------- samples


def _angle_points(angles: JointAngles) -> Array:
    value = np.zeros((*angles.value_deg.shape, 3))
    value[..., 0] = angles.value_deg
    return value


def _mark_missing(position: Array) -> Array:
    """Return (T, K, 4) as the file has it; missing samples are zero with a residual of -1."""
    is_there = np.isfinite(position).min(axis=2, keepdims=True)
    residual = np.where(is_there, 0.0, -1.0)
    return np.concatenate([np.where(is_there, position, 0.0), residual], axis=2)


# --------------------------------------------------------------------------- parameters


def _describe(
    keypoints: Sequence[str], angles: Sequence[str], track: PoseTrack, rate_hz: float
) -> Mapping[str, Sequence[_Parameter]]:
    """Return the parameter groups of the file."""
    labels = (*keypoints, *angles)
    what = [*["keypoint"] * len(keypoints), *["joint angle, X in deg"] * len(angles)]
    return {
        "POINT": (
            _integers("USED", len(labels)),
            _integers("FRAMES", track.n_frames),
            _integers("DATA_START", 0),  # known only once all parameters are
            _floats("SCALE", SCALE),
            _floats("RATE", rate_hz),
            _text("UNITS", "mm"),
            _text("X_SCREEN", "+X"),
            _text("Y_SCREEN", "+Y"),
            _texts("LABELS", labels),
            _texts("DESCRIPTIONS", what),
            _texts("ANGLES", angles),
            _text("ANGLE_UNITS", "deg"),
        ),
        "ANALOG": (
            _integers("USED", 1),
            _floats("RATE", rate_hz),
            _floats("GEN_SCALE", 1.0),
            _listed(_floats("SCALE", 1.0)),
            _listed(_integers("OFFSET", 0)),
            _texts("LABELS", ["time"]),
            _texts("DESCRIPTIONS", ["true time of the frame"]),
            _texts("UNITS", ["s"]),
        ),
        "FORCE_PLATFORM": (_integers("USED", 0),),
        "TRIAL": (
            _pair("ACTUAL_START_FIELD", 1),
            _pair("ACTUAL_END_FIELD", track.n_frames),
            _floats("CAMERA_RATE", rate_hz),
        ),
        "MANUFACTURER": (
            _text("COMPANY", "LiftLens"),
            _text("SOFTWARE", "LiftLens"),
            _text("AXES", "X front, Y up, Z right of the subject"),
        ),
    }


def _integers(name: str, *values: int) -> _Parameter:
    return _Parameter(name, INTEGER, (), struct.pack(f"<{len(values)}H", *values))


def _pair(name: str, value: int) -> _Parameter:
    """Return a 32-bit number as the file has it: two words, the low one first."""
    return _Parameter(name, INTEGER, (2,), struct.pack("<I", value))


def _floats(name: str, value: float) -> _Parameter:
    return _Parameter(name, FLOAT, (), struct.pack("<f", value))


def _listed(one: _Parameter) -> _Parameter:
    """Return a single value as a list of one, which readers expect of channels."""
    return _Parameter(one.name, one.kind, (1,), one.data)


def _text(name: str, text: str) -> _Parameter:
    encoded = text.encode("ascii", "replace")
    return _Parameter(name, CHARACTER, (len(encoded),), encoded)


def _texts(name: str, texts: Sequence[str]) -> _Parameter:
    width = max((len(text) for text in texts), default=1)
    encoded = b"".join(text.encode("ascii", "replace").ljust(width) for text in texts)
    return _Parameter(name, CHARACTER, (width, len(texts)), encoded)


def _encode_parameters(groups: Mapping[str, Sequence[_Parameter]], *, first_block: int) -> bytes:
    """Return the parameter section, filled to whole blocks."""
    body = b""
    where_start = 0
    for number, (group, members) in enumerate(groups.items(), start=1):
        body += _entry(group, -number, b"")
        for member in members:
            dimensions = bytes(member.dimensions)
            content = struct.pack("<bB", member.kind, len(dimensions)) + dimensions + member.data
            if (group, member.name) == ("POINT", "DATA_START"):
                where_start = 4 + len(body) + 2 + len(member.name) + 2 + 2
            body += _entry(member.name, number, content)
    body += b"\0\0"
    n_blocks = -(-(4 + len(body)) // BLOCK_BYTES)
    section = bytearray(_pad(struct.pack("<BBBB", 1, KEY, n_blocks, INTEL) + body))
    struct.pack_into("<H", section, where_start, first_block + n_blocks)
    return bytes(section)


def _entry(name: str, group: int, content: bytes) -> bytes:
    """Return a group or parameter; the offset counts from itself to the next entry."""
    rest = content + b"\0"  # no description
    return (
        struct.pack("<bb", len(name), group)
        + name.encode()
        + struct.pack("<H", 2 + len(rest))
        + rest
    )


def _encode_header(n_points: int, n_frames: int, rate_hz: float, data_block: int) -> bytes:
    head = struct.pack(
        "<BBHHHHHfHHf", 2, KEY, n_points, 1, 1, n_frames, 0, SCALE, data_block, 1, rate_hz
    )
    return _pad(head)


def _pad(content: bytes) -> bytes:
    return content + b"\0" * (-len(content) % BLOCK_BYTES)
