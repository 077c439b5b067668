"""Result folders: written whole or not at all, read with every check.

A result folder holds `trial.json` (`trial.schema.json` describes it), `tracks.npz`,
`keypoints.trc`, `angles.mot`, `angles.csv` and, where made, `overlay.mp4` and `thumbnail.jpg`; with
two views also `overlay2.mp4` and `calibration.toml`.
"""

from __future__ import annotations

import contextlib
import errno
import json
import logging
import os
import shutil
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

from engine.datatypes import (
    BodyFit,
    Calibration,
    CalibrationCheck,
    Flag,
    JointAngles,
    Lift,
    PoseTrack,
    RiskResult,
    Subject,
    SyncEstimate,
    Task,
    TrialResult,
    ViewPose,
    WorldScene,
)
from engine.errors import ConfigError, DataError
from engine.storage.atomic import PARTIAL_SUFFIX, explain_os_errors, hidden_sibling
from engine.storage.document import (
    SCHEMA_VERSION,
    build_document,
    decode_calibration,
    decode_check,
    decode_flag,
    decode_lift,
    decode_risk,
    decode_scene,
    decode_subject,
    decode_sync,
    decode_task,
    decode_view,
    to_json,
)
from engine.storage.tables import write_angles_csv, write_angles_mot, write_keypoints_trc
from engine.storage.tracks import read_tracks, write_tracks

__all__ = [
    "CALIBRATION_NAME",
    "RESULT_FILES",
    "StoredResult",
    "check_target",
    "is_result_folder",
    "read_document",
    "read_result",
    "write_result",
]

logger = logging.getLogger(__name__)

DOCUMENT_NAME = "trial.json"
TRACKS_NAME = "tracks.npz"
OVERLAY_NAME = "overlay.mp4"
SECOND_OVERLAY_NAME = "overlay2.mp4"
CALIBRATION_NAME = "calibration.toml"
THUMBNAIL_NAMES = ("thumbnail.jpg", "thumbnail.jpeg", "thumbnail.png")
SUMMARY_NAME = "summary.json"

RESULT_FILES = (
    DOCUMENT_NAME,
    TRACKS_NAME,
    "keypoints.trc",
    "angles.mot",
    "angles.csv",
    OVERLAY_NAME,
    SECOND_OVERLAY_NAME,
    CALIBRATION_NAME,
    *THUMBNAIL_NAMES,
    SUMMARY_NAME,
)
"""Every file a result folder may hold."""

DECODING_ERRORS = (LookupError, TypeError, ValueError, AttributeError, ArithmeticError)
"""What values of another kind than expected raise on their way into the engine's types."""

DECODED_PARTS = (
    "lifts",
    "risk",
    "flags",
    "subject",
    "task",
    "scene",
    "calibration",
    "checks",
    "sync",
    "warnings",
)
REQUIRED_KEYS = ("schema_version", "views", "subject", "task", "lifts", "risk", "flags", "scene")


@dataclass(frozen=True, eq=False)
class StoredResult:
    """A result read back from its folder.

    `document` is `trial.json`; the properties give its parts as the engine's types.
    """

    folder: Path
    document: dict[str, Any]
    raw: PoseTrack
    corrected: PoseTrack
    views: tuple[ViewPose, ...]
    angles: JointAngles
    overlay_path: Path | None
    thumbnail_path: Path | None
    body: BodyFit | None = None
    second_overlay_path: Path | None = None

    @cached_property
    def lifts(self) -> tuple[Lift, ...]:
        """The lifts, in order of time."""
        return tuple(decode_lift(lift) for lift in self.document["lifts"])

    @cached_property
    def risk(self) -> dict[str, RiskResult]:
        """What each method says, by its key."""
        return {name: decode_risk(risk) for name, risk in self.document["risk"].items()}

    @cached_property
    def flags(self) -> tuple[Flag, ...]:
        """What a person should look at."""
        return tuple(decode_flag(flag) for flag in self.document["flags"])

    @cached_property
    def subject(self) -> Subject:
        """The person filmed."""
        return decode_subject(self.document["subject"])

    @cached_property
    def task(self) -> Task:
        """What the user said about the work."""
        return decode_task(self.document["task"])

    @cached_property
    def scene(self) -> WorldScene:
        """The camera in the world, with what is not known about it."""
        return decode_scene(self.document["scene"])

    @cached_property
    def calibration(self) -> Calibration | None:
        """The two cameras in the world of the trial; None with one view."""
        values = self._two_view
        return None if values is None else decode_calibration(values["calibration"])

    @cached_property
    def checks(self) -> tuple[CalibrationCheck, ...]:
        """What the world says of the calibration; empty with one view."""
        return tuple(decode_check(v) for v in (self._two_view or {}).get("checks", ()))

    @cached_property
    def sync(self) -> SyncEstimate | None:
        """How the clocks of the two videos belong together; None with one view."""
        return None if self._two_view is None else decode_sync(self._two_view["sync"])

    @property
    def _two_view(self) -> Mapping[str, Any] | None:
        # Results written before two views were possible have no such key.
        values: Mapping[str, Any] | None = self.document.get("two_view")
        return values

    @property
    def warnings(self) -> tuple[str, ...]:
        """What the steps had to say."""
        return tuple(self.document["warnings"])


def write_result(
    result: TrialResult,
    folder: Path,
    *,
    overlay: Path | None = None,
    thumbnail: Path | None = None,
    second_overlay: Path | None = None,
    calibration_text: str = "",
) -> Path:
    """Write a result folder: aside first, then renamed, so that it is whole or not there.

    Parameters
    ----------
    result
        What was found out.
    folder
        Where to; made with its parents. An earlier result there is replaced once the new one is
        complete.
    overlay, thumbnail
        The annotated video and its still picture; both are moved into the folder.
    second_overlay
        The annotated second video; moved into the folder.
    calibration_text
        The cameras as a file that later assessments can use; none where empty.

    Returns
    -------
    Path
        The folder, as an absolute path.

    Raises
    ------
    ConfigError
        If `folder` is a file, or holds anything but an earlier result.
    OutputError
        If it can't be written (no permission, no space); nothing is left behind.
    """
    folder = check_target(folder)
    with explain_os_errors(folder), _aside(folder) as partial:
        write_tracks(
            partial / TRACKS_NAME,
            raw=result.raw,
            corrected=result.corrected,
            views=result.views,
            angles=result.angles,
            body=result.body,
        )
        write_keypoints_trc(result.corrected, partial / "keypoints.trc")
        write_angles_mot(result.angles, partial / "angles.mot")
        write_angles_csv(result.angles, partial / "angles.csv")
        # A file name that is no valid text becomes JSON's own escapes.
        (partial / DOCUMENT_NAME).write_text(
            to_json(build_document(result)), encoding="utf-8", errors="backslashreplace"
        )
        if thumbnail is not None:
            shutil.move(thumbnail, partial / f"thumbnail{thumbnail.suffix.lower()}")
        if calibration_text:
            (partial / CALIBRATION_NAME).write_text(calibration_text, encoding="utf-8")
        for video, name in ((overlay, OVERLAY_NAME), (second_overlay, SECOND_OVERLAY_NAME)):
            if video is not None:
                shutil.move(video, partial / name)
        _replace(folder, partial)
    return folder


def check_target(folder: Path) -> Path:
    """Return `folder` as an absolute path if a result may be written there.

    Worth calling before hours of work.

    Raises
    ------
    ConfigError
        If it is a file, or holds anything but an earlier result.
    OutputError
        If it can't be looked into, or nothing may be written there.
    """
    folder = Path(folder).expanduser().resolve()
    with explain_os_errors(folder):
        _check_parent(folder)
        if not folder.exists():
            return folder
        if not folder.is_dir():
            raise ConfigError(
                f"The result needs a folder, but {folder} is a file; choose another name."
            )
        names = {p.name for p in folder.iterdir() if not p.name.endswith(PARTIAL_SUFFIX)}
    strangers = sorted(names - set(RESULT_FILES))
    if strangers or (names and not is_result_folder(folder)):
        what = f"other files ({', '.join(strangers[:3])})" if strangers else "no LiftLens result"
        raise ConfigError(
            f"The result needs a new or empty folder or one with an earlier result, but {folder} "
            f"holds {what}; choose another folder."
        )
    return folder


def _check_parent(folder: Path) -> None:
    """Find out early, as far as one can without writing, whether folders can be made there."""
    nearest = next(parent for parent in folder.parents if parent.exists())
    if not nearest.is_dir():
        raise NotADirectoryError(errno.ENOTDIR, "not a folder")
    if not os.access(nearest, os.W_OK | os.X_OK):
        raise PermissionError(errno.EACCES, "no permission")


def is_result_folder(folder: Path) -> bool:
    """Whether `folder` holds a result (of any version, whole or damaged)."""
    return (Path(folder) / DOCUMENT_NAME).is_file()


def read_result(folder: Path) -> StoredResult:
    """Read a result folder.

    Raises
    ------
    DataError
        If it is no result, is damaged, or was written in an unknown version.
    """
    folder = Path(folder)
    document = read_document(folder)
    try:
        infos = [decode_view(view) for view in document["views"]]
    except DECODING_ERRORS as error:
        raise _damaged(folder, f"its views are not as expected: {error!r}") from error
    tracks = read_tracks(folder / TRACKS_NAME, infos)
    stored = StoredResult(
        folder=folder,
        document=document,
        raw=tracks.raw,
        corrected=tracks.corrected,
        views=tracks.views,
        angles=tracks.angles,
        overlay_path=_first_file(folder, (OVERLAY_NAME,)),
        second_overlay_path=_first_file(folder, (SECOND_OVERLAY_NAME,)),
        thumbnail_path=_first_file(folder, THUMBNAIL_NAMES),
        body=tracks.body,
    )
    _check_parts(stored)
    return stored


def read_document(folder: Path) -> dict[str, Any]:
    """Read `trial.json` and check its version and its main keys.

    Raises
    ------
    DataError
        If it is missing, damaged or of an unknown version.
    """
    path = Path(folder) / DOCUMENT_NAME
    try:
        document = json.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError as error:
        raise DataError(
            f"{folder} is no LiftLens result: expected {DOCUMENT_NAME} in it, found none; "
            "name the folder that `liftlens assess` wrote."
        ) from error
    except (OSError, ValueError, RecursionError) as error:
        raise _damaged(folder, f"{DOCUMENT_NAME} can't be read: {error}") from error
    if not isinstance(document, dict) or "schema_version" not in document:
        raise _damaged(folder, f"{DOCUMENT_NAME} has no schema_version")
    if document["schema_version"] != SCHEMA_VERSION:
        raise DataError(
            f"{folder} has schema version {document['schema_version']!r}, this program reads "
            f"{SCHEMA_VERSION}; use the LiftLens version that wrote it, or assess the video again."
        )
    missing = [key for key in REQUIRED_KEYS if key not in document]
    if missing:
        raise _damaged(folder, f"{DOCUMENT_NAME} lacks {', '.join(missing)}")
    return document


def _check_parts(stored: StoredResult) -> None:
    """Decode every typed part once, so that later readers can trust them."""
    try:
        for part in DECODED_PARTS:
            getattr(stored, part)
    except DECODING_ERRORS as error:
        raise _damaged(stored.folder, f"its {part} are not as expected: {error!r}") from error


def _damaged(folder: Path, why: str) -> DataError:
    return DataError(f"The result in {folder} is damaged ({why}); assess the video again.")


def _first_file(folder: Path, names: tuple[str, ...]) -> Path | None:
    return next((folder / name for name in names if (folder / name).is_file()), None)


@contextlib.contextmanager
def _aside(folder: Path) -> Iterator[Path]:
    """Give a hidden sibling to write into; on any failure it and new parents vanish."""
    new_parents = [parent for parent in folder.parents if not parent.exists()]
    partial = hidden_sibling(folder)
    try:
        partial.mkdir(parents=True)
        yield partial
    except BaseException:
        shutil.rmtree(partial, ignore_errors=True)
        for parent in new_parents:
            with contextlib.suppress(OSError):
                parent.rmdir()
        raise


def _replace(folder: Path, partial: Path) -> None:
    """Put `partial` in the place of `folder`; what was there stays if that fails."""
    if not folder.exists():
        partial.rename(folder)
        return
    earlier = hidden_sibling(folder)
    folder.rename(earlier)
    try:
        partial.rename(folder)
    except BaseException:
        earlier.rename(folder)
        raise
    shutil.rmtree(earlier, ignore_errors=True)
    if earlier.exists():
        logger.warning("The earlier result could not be removed; it is left as %s.", earlier)
