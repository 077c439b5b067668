"""The library: every assessed trial of this computer, as folders.

::

    root/trials/<id>/    a result folder
    root/uploads/<id>/   the videos a user uploaded for it
    root/jobs/<id>/      the work that made it

Names that start with a dot are being written or removed and don't count. All changes are
single renames, so several processes may use one library.
"""

from __future__ import annotations

import contextlib
import json
import logging
import math
import os
import re
import secrets
import shutil
import sys
import time
from collections.abc import Mapping
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Literal

from engine.datatypes import FlagLevel
from engine.errors import ConfigError, DataError
from engine.storage.atomic import (
    PARTIAL_SUFFIX,
    explain_os_errors,
    hidden_sibling,
    write_aside,
)
from engine.storage.results import (
    DECODING_ERRORS,
    SUMMARY_NAME,
    THUMBNAIL_NAMES,
    TRACKS_NAME,
    is_result_folder,
    read_document,
)

__all__ = ["HOME_VARIABLE", "Library", "TrialEntry", "default_root"]

logger = logging.getLogger(__name__)

HOME_VARIABLE = "LIFTLENS_HOME"
SUMMARY_VERSION = 1
LIFTING_INDEX_METHOD = "rnle"
LEFTOVER_AGE_S = 24 * 3600.0
"""A hidden folder as old as this belongs to a process that was killed."""

TEXT_KEYS = ("label", "created", "subject", "site", "job", "category")
_VALID_ID = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]{0,99}")
_LEVELS = (FlagLevel.HIGH, FlagLevel.REVIEW, FlagLevel.OK)


@dataclass(frozen=True)
class TrialEntry:
    """One line of the list of trials.

    `created` is an ISO time in UTC. `worst_level` is that of the most urgent flag, None without
    flags. `li` is the lifting index with its interval of about 95 %: None where it does not apply,
    infinite where nothing may be lifted. A `damaged` entry says why in `message`.
    """

    id: str
    status: Literal["done", "damaged"]
    label: str = ""
    created: str = ""
    subject: str = ""
    site: str = ""
    job: str = ""
    worst_level: FlagLevel | None = None
    li: float | None = None
    li_interval: tuple[float | None, float | None] = (None, None)
    category: str = ""
    n_lifts: int = 0
    duration_s: float | None = None
    message: str = ""
    thumbnail_path: Path | None = None

    @property
    def is_damaged(self) -> bool:
        """Whether the result can't be read."""
        return self.status == "damaged"


def default_root() -> Path:
    """Return where the library lives: `LIFTLENS_HOME`, or this system's place for user data."""
    if given := os.environ.get(HOME_VARIABLE):
        return Path(given).expanduser()
    home = Path.home()
    if sys.platform == "win32":
        return Path(os.environ.get("LOCALAPPDATA") or home / "AppData" / "Local") / "LiftLens"
    if sys.platform == "darwin":
        return home / "Library" / "Application Support" / "LiftLens"
    return Path(os.environ.get("XDG_DATA_HOME") or home / ".local" / "share") / "liftlens"


class Library:
    """The trials below one folder.

    Parameters
    ----------
    root
        The folder; its parts are made if missing.

    Raises
    ------
    OutputError
        If the folder can't be made.
    """

    def __init__(self, root: Path) -> None:
        self.root = Path(root).expanduser().resolve()
        self.trials = self.root / "trials"
        self.uploads = self.root / "uploads"
        self.jobs = self.root / "jobs"
        with explain_os_errors(self.root, "The library"):
            for folder in (self.trials, self.uploads, self.jobs):
                folder.mkdir(parents=True, exist_ok=True)

    @classmethod
    def open(cls, root: Path | None = None) -> Library:
        """Open the library at `root`, by default the user's own, and clear what was left over."""
        library = cls(default_root() if root is None else root)
        library._remove_leftovers()
        return library

    @property
    def is_empty(self) -> bool:
        """Whether there is no trial yet."""
        return next(iter(self._folders()), None) is None

    def new_id(self) -> str:
        """Return an id nobody uses; ids sort by time."""
        return f"{datetime.now(UTC):%Y%m%d-%H%M%S-%f}-{secrets.token_hex(3)}"

    def folder(self, trial_id: str) -> Path:
        """Return the result folder of a trial, whether or not it is there.

        Raises
        ------
        ConfigError
            If the id could name a folder outside the library.
        """
        return self.trials / _check_id(trial_id)

    def has(self, trial_id: str) -> bool:
        """Whether there is a trial of that id."""
        return self.folder(trial_id).is_dir()

    def upload_folder(self, trial_id: str) -> Path:
        """Return where uploaded videos of a trial belong; made if missing."""
        folder = self.uploads / _check_id(trial_id)
        with explain_os_errors(folder, "The upload"):
            folder.mkdir(parents=True, exist_ok=True)
        return folder

    def entries(self) -> tuple[TrialEntry, ...]:
        """List the trials, newest first; damaged ones are listed as such."""
        found = [
            entry
            for folder in self._folders()
            # What another process deletes while this one reads is gone, not damaged.
            if not (entry := _read_entry(folder)).is_damaged or folder.exists()
        ]
        return tuple(sorted(found, key=lambda e: (e.created, e.id), reverse=True))

    def adopt(self, result_folder: Path, trial_id: str | None = None) -> str:
        """Move a result folder into the library; return its id.

        Raises
        ------
        ConfigError
            If the id is taken.
        DataError
            If the folder is no readable result.
        OutputError
            If it can't be moved.
        """
        result_folder = Path(result_folder).resolve()
        read_document(result_folder)
        trial_id = trial_id or self.new_id()
        target = self.folder(trial_id)
        aside = hidden_sibling(target)
        with explain_os_errors(target):
            try:
                # Aside first: a move between disks is a slow copy.
                shutil.move(result_folder, aside)
                if target.exists():
                    shutil.move(aside, result_folder)
                    raise ConfigError(f"The library already has a trial {trial_id!r}; delete it.")
                aside.rename(target)
            finally:
                shutil.rmtree(aside, ignore_errors=True)
        return trial_id

    def delete(self, trial_id: str) -> None:
        """Delete a trial and all that belongs to it: uploads and the work that made it.

        Raises
        ------
        ConfigError
            If there is no such trial.
        OutputError
            If something can't be deleted.
        """
        parts = [
            part
            for part in (self.folder(trial_id), self.uploads / trial_id, self.jobs / trial_id)
            if part.exists()
        ]
        if not parts:
            raise ConfigError(f"There is no trial {trial_id!r} in the library {self.root}.")
        for part in parts:
            with explain_os_errors(part, "The deletion"):
                _remove(part)

    def _folders(self) -> list[Path]:
        return [
            entry
            for entry in sorted(self.trials.iterdir())
            if not entry.name.startswith(".") and entry.is_dir()
        ]

    def _remove_leftovers(self) -> None:
        """Remove what killed processes left behind; it may hold pictures of people."""
        for part in (self.trials, self.uploads, self.jobs):
            for hidden in part.glob(f".*{PARTIAL_SUFFIX}"):
                with contextlib.suppress(OSError):
                    if time.time() - hidden.stat().st_mtime > LEFTOVER_AGE_S:
                        logger.info("Removing what an interrupted process left: %s", hidden)
                        _discard(hidden)


def _check_id(trial_id: str) -> str:
    if not _VALID_ID.fullmatch(trial_id):
        raise ConfigError(
            f"A trial id has letters, digits, dots, dashes and underscores only, got {trial_id!r}."
        )
    return trial_id


def _remove(path: Path) -> None:
    """Remove a file or folder; by one rename, it is gone for everybody else at once."""
    hidden = hidden_sibling(path)
    path.rename(hidden)
    _discard(hidden)


def _discard(path: Path) -> None:
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path)
    else:
        path.unlink(missing_ok=True)


def _read_entry(folder: Path) -> TrialEntry:
    try:
        return _build_entry(folder, _read_summary(folder))
    except DataError as error:
        message = str(error)
    except (OSError, *DECODING_ERRORS) as error:
        message = f"The result in {folder} is damaged ({error!r}); assess the video again."
    return TrialEntry(id=folder.name, status="damaged", created=_created(folder), message=message)


def _build_entry(folder: Path, summary: Mapping[str, Any]) -> TrialEntry:
    low, high = (
        _number(value, is_infinite=infinite)
        for value, infinite in zip(
            summary["li_interval"], summary["li_interval_is_infinite"], strict=True
        )
    )
    level, duration_s = summary["worst_level"], summary["duration_s"]
    thumbnails = (folder / name for name in THUMBNAIL_NAMES)
    return TrialEntry(
        id=folder.name,
        status="done",
        **{key: str(summary[key]) for key in TEXT_KEYS},
        worst_level=None if level is None else FlagLevel(level),
        li=_number(summary["li"], is_infinite=summary["li_is_infinite"]),
        li_interval=(low, high),
        n_lifts=int(summary["n_lifts"]),
        duration_s=None if duration_s is None else float(duration_s),
        thumbnail_path=next((path for path in thumbnails if path.is_file()), None),
    )


def _number(value: float | None, *, is_infinite: bool) -> float | None:
    if value is None:
        return math.inf if is_infinite else None
    return float(value)


def _created(folder: Path) -> str:
    with contextlib.suppress(OSError):
        stamp = datetime.fromtimestamp(folder.stat().st_mtime, UTC)
        return stamp.isoformat(timespec="seconds")
    return ""


def _read_summary(folder: Path) -> dict[str, Any]:
    """Return the main facts of a trial, from a small file that is made on first sight."""
    if not is_result_folder(folder) or not (folder / TRACKS_NAME).is_file():
        raise DataError(f"{folder} holds no whole result; delete it or assess the video again.")
    stamp = (folder / "trial.json").stat()
    source = [SUMMARY_VERSION, stamp.st_mtime_ns, stamp.st_size]
    path = folder / SUMMARY_NAME
    with contextlib.suppress(OSError, ValueError, KeyError, TypeError):
        kept = json.loads(path.read_text(encoding="utf-8"))
        if kept["source"] == source:
            return dict(kept["summary"])
    summary = _summarise(read_document(folder))
    # A library one may only read still works, just slower.
    with contextlib.suppress(OSError), write_aside(path) as aside:
        aside.write_text(json.dumps({"source": source, "summary": summary}), encoding="utf-8")
    return summary


def _summarise(document: Mapping[str, Any]) -> dict[str, Any]:
    risk = document["risk"].get(LIFTING_INDEX_METHOD, {})
    levels = {flag["level"] for flag in document["flags"]}
    return {
        **{key: str(document[key]) for key in ("label", "created", "site", "job")},
        "subject": str(document["subject"]["label"]),
        "worst_level": next((level.value for level in _LEVELS if level.value in levels), None),
        "li": risk.get("value"),
        "li_is_infinite": risk.get("is_infinite", False),
        "li_interval": risk.get("interval", [None, None]),
        "li_interval_is_infinite": risk.get("interval_is_infinite", [False, False]),
        "category": str(risk.get("category", "")),
        "n_lifts": len(document["lifts"]),
        "duration_s": document["views"][0]["duration_s"],
    }
