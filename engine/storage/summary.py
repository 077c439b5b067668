"""The main facts of a result folder: what the list of trials shows, searches and counts."""

from __future__ import annotations

import hashlib
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from engine.datatypes import FlagLevel
from engine.errors import DataError
from engine.storage.results import (
    DECODING_ERRORS,
    DOCUMENT_NAME,
    THUMBNAIL_NAMES,
    TRACKS_NAME,
    is_result_folder,
    read_document,
)

__all__ = ["MethodSummary", "Summary", "TrialFolder", "clean_text", "find_stamp", "read_folder"]

LIFTING_INDEX_METHOD = "rnle"
_LEVELS = (FlagLevel.HIGH, FlagLevel.REVIEW, FlagLevel.OK)


@dataclass(frozen=True)
class MethodSummary:
    """What one method says of a trial; numbers are None where there are none."""

    method: str
    value: float | None
    low: float | None
    high: float | None
    category: str
    is_applicable: bool


@dataclass(frozen=True)
class Summary:
    """The main facts of one result.

    `n_high`, `n_review` and `n_ok` count lifts by their most urgent flag; a lift no flag speaks
    of is in none of them.
    """

    document_sha256: str
    created: datetime | None
    liftlens_version: str
    backend: str
    solver: str
    label: str
    site: str
    job: str
    person: str
    worst_level: FlagLevel | None
    methods: tuple[MethodSummary, ...]
    duration_s: float | None
    n_lifts: int
    n_high: int
    n_review: int
    n_ok: int

    @property
    def lifting_index(self) -> MethodSummary | None:
        """What the lifting equation says."""
        return next((m for m in self.methods if m.method == LIFTING_INDEX_METHOD), None)


@dataclass(frozen=True)
class TrialFolder:
    """One look at a trial's folder: a summary, or in `message` why there is none."""

    id: str
    path: Path
    inode: str
    stamp: str
    created: datetime
    summary: Summary | None = None
    message: str = ""
    thumbnail: str = ""


def find_stamp(folder: Path) -> str:
    """Return what changes when the result does; empty for a folder without a whole one."""
    try:
        found = (folder / DOCUMENT_NAME).stat()
        (folder / TRACKS_NAME).stat()
    except OSError:
        return ""
    return f"{found.st_mtime_ns}-{found.st_size}"


def read_folder(folder: Path) -> TrialFolder | None:
    """Look at a trial's folder; None if it is not there (any more)."""
    try:
        made = folder.stat()
    except OSError:
        return None
    stamp = find_stamp(folder)
    summary, message = None, ""
    try:
        summary = _read_summary(folder)
    except DataError as error:
        message = str(error)
    except (OSError, *DECODING_ERRORS) as error:
        message = f"The result in {folder} is damaged ({error!r}); assess the video again."
    if summary is None and not folder.exists():
        return None
    found = None if summary is None else summary.created
    return TrialFolder(
        id=folder.name,
        path=folder,
        inode=str(made.st_ino),
        stamp=stamp,
        created=found or datetime.fromtimestamp(made.st_mtime, UTC).replace(microsecond=0),
        summary=summary,
        message=clean_text(message),
        thumbnail=next((n for n in THUMBNAIL_NAMES if (folder / n).is_file()), ""),
    )


def clean_text(text: object) -> str:
    """Return text that every database takes: no half characters, no zero bytes."""
    return str(text).encode("utf-8", "replace").decode("utf-8").replace("\0", "")


def _read_summary(folder: Path) -> Summary:
    if not is_result_folder(folder) or not (folder / TRACKS_NAME).is_file():
        raise DataError(f"{folder} holds no whole result; delete it or assess the video again.")
    digest = hashlib.sha256((folder / DOCUMENT_NAME).read_bytes()).hexdigest()
    return _summarise(read_document(folder), digest)


def _summarise(document: Mapping[str, Any], digest: str) -> Summary:
    n_lifts = len(document["lifts"])
    levels = [_level_of(document["flags"], index) for index in range(n_lifts)]
    worst = {flag["level"] for flag in document["flags"]}
    text = {key: clean_text(document[key]) for key in ("label", "site", "job")}
    return Summary(
        **text,
        document_sha256=digest,
        created=_read_time(document.get("created")),
        liftlens_version=clean_text(document.get("liftlens_version", "")),
        backend=clean_text(document.get("backend", "")),
        solver=clean_text(document.get("solver", "")),
        person=clean_text(document["subject"]["label"]),
        worst_level=next((level for level in _LEVELS if level.value in worst), None),
        methods=tuple(_summarise_method(name, r) for name, r in document["risk"].items()),
        duration_s=_number(document["views"][0]["duration_s"]),
        n_lifts=n_lifts,
        n_high=levels.count(FlagLevel.HIGH),
        n_review=levels.count(FlagLevel.REVIEW),
        n_ok=levels.count(FlagLevel.OK),
    )


def _level_of(flags: Sequence[Mapping[str, Any]], lift: int) -> FlagLevel | None:
    found = {flag["level"] for flag in flags if flag.get("lift_index") == lift}
    return next((level for level in _LEVELS if level.value in found), None)


def _summarise_method(name: str, risk: Mapping[str, Any]) -> MethodSummary:
    low, high = (
        _number(value, is_infinite=infinite)
        for value, infinite in zip(
            risk.get("interval", [None, None]),
            risk.get("interval_is_infinite", [False, False]),
            strict=True,
        )
    )
    return MethodSummary(
        method=clean_text(name),
        value=_number(risk.get("value"), is_infinite=risk.get("is_infinite", False)),
        low=low,
        high=high,
        category=clean_text(risk.get("category", "")),
        is_applicable=bool(risk.get("is_applicable", True)),
    )


def _number(value: float | None, *, is_infinite: bool = False) -> float | None:
    if value is None:
        return math.inf if is_infinite else None
    number = float(value)
    return None if math.isnan(number) else number


def _read_time(text: object) -> datetime | None:
    """Return a time of the document in UTC; None where it holds none that makes sense."""
    try:
        found = datetime.fromisoformat(str(text))
        return (found if found.tzinfo else found.replace(tzinfo=UTC)).astimezone(UTC)
    except (ValueError, OverflowError):
        return None
