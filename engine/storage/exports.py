"""Results in the formats of other tools."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path

from engine.errors import ConfigError
from engine.storage.atomic import explain_os_errors, write_aside
from engine.storage.bvh import write_bvh
from engine.storage.c3d_writer import write_c3d
from engine.storage.results import StoredResult, read_result
from engine.storage.tables import write_angles_csv, write_angles_mot, write_keypoints_trc

__all__ = ["EXPORT_FORMATS", "export_result"]

_Writer = Callable[[StoredResult, Path], None]


def _write_trc(stored: StoredResult, path: Path) -> None:
    write_keypoints_trc(stored.corrected, path, title="keypoints.trc")


def _write_mot(stored: StoredResult, path: Path) -> None:
    write_angles_mot(stored.angles, path)


def _write_csv(stored: StoredResult, path: Path) -> None:
    write_angles_csv(stored.angles, path)


def _write_c3d(stored: StoredResult, path: Path) -> None:
    write_c3d(stored.corrected, stored.angles, path)


def _write_bvh(stored: StoredResult, path: Path) -> None:
    write_bvh(stored.corrected, path, body=stored.body)


_WRITERS: Mapping[str, tuple[str, _Writer]] = {
    "trc": ("keypoints.trc", _write_trc),
    "mot": ("angles.mot", _write_mot),
    "csv": ("angles.csv", _write_csv),
    "c3d": ("motion.c3d", _write_c3d),
    "bvh": ("motion.bvh", _write_bvh),
}
EXPORT_FORMATS: tuple[str, ...] = tuple(_WRITERS)
"""The formats `export_result` writes."""


def export_result(folder: Path, format: str, out: Path | None = None) -> Path:  # noqa: A002
    """Write one part of a result in the format of another tool.

    Parameters
    ----------
    folder
        A result folder.
    format
        `trc` (corrected keypoints, world, mm), `mot` (joint angles for OpenSim), `csv` (joint
        angles with their errors), `c3d` (keypoints and joint angles) or `bvh` (a figure of rigid
        bones).
    out
        The file to write, or an existing folder to write it into; None for the current folder.
        The file then is named after the result.

    Returns
    -------
    Path
        The file.

    Raises
    ------
    ConfigError
        If the format is unknown or not available.
    DataError
        If the folder is no readable result.
    OutputError
        If the file can't be written.
    """
    suggested, write = _find_writer(format)
    stored = read_result(folder)
    target = Path.cwd() if out is None else Path(out).expanduser()
    with explain_os_errors(target, "The export"):
        if target.is_dir():
            target = target / f"{Path(folder).resolve().name}_{suggested}"
        target.parent.mkdir(parents=True, exist_ok=True)
        with write_aside(target) as aside:
            write(stored, aside)
    return target


def _find_writer(name: str) -> tuple[str, _Writer]:
    key = name.strip().lower().removeprefix(".")
    offered = ", ".join(EXPORT_FORMATS)
    if key not in _WRITERS:
        raise ConfigError(f"Unknown export format {name!r}; available: {offered}.")
    return _WRITERS[key]
