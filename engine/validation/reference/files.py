"""One entrance for every format."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path

from engine.errors import DataError
from engine.validation.profiles import ImportProfile
from engine.validation.reference.base import Recording, Reference
from engine.validation.reference.c3d import read_c3d
from engine.validation.reference.interpret import interpret
from engine.validation.reference.motion import read_motion
from engine.validation.reference.plain_csv import read_plain_csv
from engine.validation.reference.text import read_lines
from engine.validation.reference.trc import read_trc
from engine.validation.reference.vicon import is_vicon_csv, read_vicon_csv

__all__ = ["REFERENCE_SUFFIXES", "describe_profile", "read_recording", "read_reference"]


def _read_table(path: Path) -> Recording:
    """Read a CSV file: blocks of Vicon Nexus, or a plain table."""
    return read_vicon_csv(path) if is_vicon_csv(read_lines(path)) else read_plain_csv(path)


_BY_SUFFIX: Mapping[str, Callable[[Path], Recording]] = {
    ".trc": read_trc,
    ".c3d": read_c3d,
    ".mot": read_motion,
    ".sto": read_motion,
    ".csv": _read_table,
    ".txt": _read_table,
    ".tsv": _read_table,
}
_BY_FORMAT: Mapping[str, Callable[[Path], Recording]] = {
    "trc": read_trc,
    "c3d": read_c3d,
    "mot": read_motion,
    "vicon-csv": read_vicon_csv,
    "csv": read_plain_csv,
}
REFERENCE_SUFFIXES: tuple[str, ...] = tuple(_BY_SUFFIX)
"""Endings of the files that can be read."""


def read_recording(path: Path, *, format: str | None = None) -> Recording:  # noqa: A002
    """Read a file as it is; the format is that of its ending unless given.

    Raises
    ------
    DataError
        If the ending is unknown or the file can't be read.
    """
    path = Path(path).expanduser()
    read = _BY_FORMAT.get(format or "") or _BY_SUFFIX.get(path.suffix.lower())
    if read is None:
        raise DataError(
            f"{path.name} has an ending that is not known; expected one of "
            f"{', '.join(REFERENCE_SUFFIXES)}. Rename it, or set format in an import profile."
        )
    return read(path)


def read_reference(path: Path, profile: ImportProfile | None = None) -> Reference:
    """Read a reference recording and work out what it means.

    Parameters
    ----------
    path
        A TRC, C3D, MOT, STO or CSV file.
    profile
        What is known of such recordings; the rest is detected and listed in `findings`.

    Raises
    ------
    DataError
        If the file can't be read or holds nothing to compare with.
    UnitError
        If the stated unit can't be right.
    """
    return interpret(read_recording(path, format=profile.format if profile else None), profile)


def describe_profile(reference: Reference, *, name: str = "") -> ImportProfile:
    """Return a profile that reads files of this kind as `reference` was read.

    Once a person has confirmed the findings, it makes them certain.
    """
    settings = reference.settings
    return ImportProfile(
        name=name or reference.name,
        format=settings["format"],
        length_unit=settings.get("length_unit"),
        angle_unit=settings.get("angle_unit"),
        axes=settings.get("axes"),
        swap_sides=settings["swap_sides"],
        labels={
            label: _as_written(landmark, swapped=settings["swap_sides"])
            for landmark, label in reference.landmarks.items()
        },
        angles=settings.get("angles", {}),
    )


def _as_written(landmark: str, *, swapped: bool) -> str:
    """Undo the exchange of sides, which the profile does again."""
    if not swapped:
        return landmark
    side, _, rest = landmark.partition("_")
    return {"left": f"right_{rest}", "right": f"left_{rest}"}.get(side, landmark)
