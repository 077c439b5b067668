"""Reading of camera files whatever program wrote them, and giving each video its camera."""

from __future__ import annotations

import json
import re
import tomllib
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from engine.cameras.files.opencap import (
    is_opencap,
    parse_opencap,
    read_opencap_folder,
)
from engine.cameras.files.own import is_own, parse_own
from engine.cameras.files.pose2sim import is_pose2sim, parse_pose2sim
from engine.cameras.files.qualisys import parse_qualisys
from engine.cameras.picture import adapt_to_picture
from engine.datatypes import Calibration, CalibrationCheck, CheckLevel
from engine.errors import CalibrationError

__all__ = ["adapt_to_pictures", "match_cameras", "read_calibration"]

MAX_BYTES = 5_000_000
EXPECTED = (
    "a calibration of LiftLens (.toml), Pose2Sim or anipose (.toml), Qualisys (.qca.txt), or "
    "OpenCap (the session's folder)"
)


def read_calibration(
    path: Path,
    *,
    sizes_px: Sequence[tuple[int, int]] | None = None,
    names: Sequence[str] | None = None,
) -> Calibration:
    """Read the cameras that a program calibrated.

    Parameters
    ----------
    path
        A file of LiftLens, Pose2Sim, anipose or Qualisys, or the folder of an OpenCap session.
    sizes_px
        Picture size of each video; the cameras are adapted to them (see `adapt_to_picture`).
    names
        File names of the videos, in their order: their cameras are chosen (see `match_cameras`).

    Returns
    -------
    Calibration
        In metres. What had to be assumed is said in `provenance["notes"]`.

    Raises
    ------
    CalibrationError
        If it can't be read, what it says can't be right, or it does not fit the videos.
    """
    path = Path(path)
    calibration = _read(path)
    if names is not None:
        calibration, check = match_cameras(calibration, names)
        calibration = _with_notes(calibration, [check])
    if sizes_px is not None:
        calibration, checks = adapt_to_pictures(calibration, sizes_px)
        wrong = next((check for check in checks if check.level is CheckLevel.RED), None)
        if wrong:
            raise CalibrationError(f"{wrong.sentence} {wrong.action}".strip())
        calibration = _with_notes(calibration, checks)
    return calibration


def match_cameras(
    calibration: Calibration, names: Sequence[str]
) -> tuple[Calibration, CalibrationCheck]:
    """Choose the camera of each video: by name where the names say so, else by order.

    Parameters
    ----------
    calibration
        With at least as many cameras as videos.
    names
        File names of the videos. A video belongs to the camera whose name its own contains.

    Returns
    -------
    Calibration
        With one camera for each video, in their order.
    CalibrationCheck
        Which video got which camera, and why; amber where only the order tells.

    Raises
    ------
    CalibrationError
        If there are too few cameras, or only some of the videos are named after one.
    """
    known = [camera.name for camera in calibration.cameras]
    if len(known) < len(names):
        raise CalibrationError(
            f"The calibration has {len(known)} cameras for {len(names)} videos; expected one each."
        )
    found = [_find_named(Path(name).stem, known) for name in names]
    hits = [index for index in found if index is not None]
    if len(set(hits)) < len(hits):
        raise CalibrationError(
            f"Both videos are named after camera {known[hits[0]]!r}; rename one after its own "
            f"camera ({', '.join(known)})."
        )
    if len(hits) == len(names):
        level, how = CheckLevel.GREEN, "by name"
    elif hits or len(known) > len(names):
        missing = next(name for name, index in zip(names, found, strict=True) if index is None)
        raise CalibrationError(
            f"It can't be told which camera filmed {Path(missing).name}; rename the file so that "
            f"it contains the camera's name ({', '.join(known)})."
        )
    else:
        hits, level, how = list(range(len(names))), CheckLevel.AMBER, "by their order"
    pairs = [f"{Path(n).name} by camera {known[i]}" for n, i in zip(names, hits, strict=True)]
    check = CalibrationCheck(
        key="cameras",
        level=level,
        sentence=f"Filmed {how}: {', '.join(pairs)}.",
        action="" if level is CheckLevel.GREEN else "Check that the videos are not exchanged.",
    )
    chosen = tuple(calibration.cameras[index] for index in hits)
    return replace(calibration, cameras=chosen), check


def adapt_to_pictures(
    calibration: Calibration,
    sizes_px: Sequence[tuple[int, int]],
    pictures: Sequence[Any] | None = None,
) -> tuple[Calibration, tuple[CalibrationCheck, ...]]:
    """Adapt each camera to the pictures of its video; see `adapt_to_picture`.

    Raises
    ------
    CalibrationError
        If there is not one size for each camera.
    """
    if len(sizes_px) != len(calibration.cameras):
        raise CalibrationError(
            f"The calibration has {len(calibration.cameras)} cameras for {len(sizes_px)} videos; "
            "expected one each."
        )
    shown = pictures if pictures is not None else [None] * len(sizes_px)
    up = calibration.up if np.isfinite(calibration.up).all() else None
    adapted = [
        adapt_to_picture(camera, size, picture=picture, up=up)
        for camera, size, picture in zip(calibration.cameras, sizes_px, shown, strict=True)
    ]
    checks = tuple(check for _, check in adapted if check is not None)
    return replace(calibration, cameras=tuple(camera for camera, _ in adapted)), checks


def _read(path: Path) -> Calibration:
    if path.is_dir():
        return read_opencap_folder(path)
    if path.suffix in (".pickle", ".pkl"):
        raise CalibrationError(
            f"{path.name} holds one camera; give the folder of the OpenCap session with all."
        )
    text = _read_text(path)
    if text.lstrip().startswith("<"):
        return parse_qualisys(text, path.name)
    if text.lstrip().startswith("{"):
        return _parse_json(text, path)
    try:
        tables = tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        raise CalibrationError(f"{path.name} is not TOML ({error}); expected {EXPECTED}.") from None
    if is_own(tables):
        return parse_own(tables, path.name)
    if is_pose2sim(tables):
        return parse_pose2sim(tables, path.name)
    raise CalibrationError(f"{path.name} holds no cameras; expected {EXPECTED}.")


def _parse_json(text: str, path: Path) -> Calibration:
    try:
        tables = json.loads(text)
    except (json.JSONDecodeError, RecursionError) as error:
        raise CalibrationError(f"{path.name} is not JSON ({error}); copy it again.") from None
    if not is_opencap(tables):
        raise CalibrationError(f"{path.name} holds no cameras; expected {EXPECTED}.")
    return parse_opencap(tables, path.name)


def _read_text(path: Path) -> str:
    try:
        if path.stat().st_size > MAX_BYTES:
            raise CalibrationError(f"{path.name} is too large; expected {EXPECTED}.")
        return path.read_text(encoding="utf-8-sig")
    except FileNotFoundError:
        raise CalibrationError(
            f"There is no calibration file {path}; expected {EXPECTED}."
        ) from None
    except UnicodeDecodeError:
        raise CalibrationError(f"{path.name} is not text; expected {EXPECTED}.") from None
    except OSError as error:
        raise CalibrationError(
            f"{path.name} can't be read ({error.strerror}); expected {EXPECTED}."
        ) from None


def _find_named(stem: str, names: Sequence[str]) -> int | None:
    """Return which camera's name is in the file's name; the longest, not a part of a number."""
    hits = []
    for index, name in enumerate(names):
        # cam1 is not in cam12.
        bounded = re.escape(name.lower()) + (r"(?!\d)" if name[-1:].isdigit() else "")
        if name and re.search((r"(?<!\d)" if name[:1].isdigit() else "") + bounded, stem.lower()):
            hits.append((len(name), index))
    return max(hits)[1] if hits else None


def _with_notes(calibration: Calibration, checks: Sequence[CalibrationCheck]) -> Calibration:
    notes = [*calibration.provenance.get("notes", ()), *(c.sentence for c in checks)]
    return replace(calibration, provenance={**calibration.provenance, "notes": notes})
