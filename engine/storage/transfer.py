"""Trials in one zip file: to another computer, to an archive, to the person they are about.

::

    manifest.json              what is inside, with the hash of every file
    trials/<id>/...            the result folders
    artefacts/<sha256>         files kept with trials, each once

Such a file comes from outside, so nothing in it is believed: every name, size and hash is checked
before the first trial appears in the library, and then all of them do, or none.
"""

from __future__ import annotations

import hashlib
import json
import logging
import math
import re
import shutil
import zipfile
import zlib
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, date, datetime
from pathlib import Path, PurePosixPath
from typing import TYPE_CHECKING, Any

from sqlalchemy import select
from sqlalchemy.exc import IntegrityError
from sqlalchemy.orm import Session

from engine.errors import ConfigError, DataError, OutputError
from engine.storage.artefacts import CHUNK_BYTES, HashedFile, hash_file
from engine.storage.atomic import explain_os_errors, hidden_sibling, write_aside
from engine.storage.catalogue import VALID_ID, find_person, find_place, record, update_search
from engine.storage.curation import check_verdict, read_record, set_tags
from engine.storage.database.models import (
    Artefact,
    Assessment,
    Attachment,
    Note,
    Person,
    Reference,
    Result,
    Review,
    Trial,
    UtcDateTime,
)
from engine.storage.results import DECODING_ERRORS, DOCUMENT_NAME
from engine.storage.summary import clean_text, read_folder
from engine.version import __version__

if TYPE_CHECKING:
    from engine.storage.library import Library

__all__ = ["FORMAT", "VERSION", "ImportReport", "export_trials", "import_archive"]

logger = logging.getLogger(__name__)

FORMAT = "liftlens-library"
VERSION = 1
MANIFEST_NAME = "manifest.json"
MAX_MANIFEST_BYTES = 256 << 20
COMPRESSED = (".mp4", ".jpg", ".jpeg", ".png", ".npz", ".zip")
"""Files that a zip can't make smaller."""
_SHA256 = re.compile("[0-9a-f]{64}")
_BAD_ZIP = (zipfile.BadZipFile, zlib.error, EOFError, RuntimeError, NotImplementedError)


@dataclass(frozen=True)
class ImportReport:
    """What came in: `imported` has the id each trial got, by the one it had.

    `already_there` lists trials whose very result the library had; they stay as they are.
    """

    imported: Mapping[str, str]
    already_there: tuple[str, ...]


# --------------------------------------------------------------------------- export


def export_trials(library: Library, trial_ids: Sequence[str], target: Path) -> Path:
    """Write trials with all that belongs to them into a zip file; see `Library.export`."""
    target = Path(target).expanduser().resolve()
    present = [name for name in trial_ids if library.has(name)]
    for name in sorted(set(trial_ids) - set(present)):
        logger.warning("The trial %s has no folder any more and is left out.", name)
    if not present:
        raise ConfigError("There is nothing to export: no trial was chosen, or none is there.")
    with (
        explain_os_errors(target, "The export"),
        write_aside(target) as aside,
        zipfile.ZipFile(aside, "w", zipfile.ZIP_DEFLATED) as archive,
    ):
        files = {name: _pack_folder(archive, library.folder(name)) for name in present}
        with library.database.reading() as session:
            manifest = _describe(session, files)
        for kept in manifest["artefacts"]:
            archive.write(library.artefacts.check(kept["sha256"]), f"artefacts/{kept['sha256']}")
        archive.writestr(MANIFEST_NAME, json.dumps(manifest, indent=1, allow_nan=False))
    return target


def _pack_folder(archive: zipfile.ZipFile, folder: Path) -> list[dict[str, Any]]:
    packed = []
    for path in sorted(folder.rglob("*")):
        relative = path.relative_to(folder)
        if any(part.startswith(".") for part in relative.parts) or not path.is_file():
            continue
        hashed = hash_file(path)
        how = zipfile.ZIP_STORED if path.suffix.lower() in COMPRESSED else zipfile.ZIP_DEFLATED
        archive.write(path, f"trials/{folder.name}/{relative.as_posix()}", how)
        packed.append({"path": relative.as_posix(), "sha256": hashed.sha256, "size": hashed.size})
    return packed


def _describe(session: Session, files: Mapping[str, list[dict[str, Any]]]) -> dict[str, Any]:
    trials = [_describe_trial(session, name, packed) for name, packed in files.items()]
    hashes = {one["sha256"] for trial in trials for one in trial["attachments"]}
    people = session.scalars(
        select(Person).where(Person.pseudonym.in_({trial["person"] for trial in trials}))
    )
    return {
        "format": FORMAT,
        "version": VERSION,
        "liftlens_version": __version__,
        "created": datetime.now(UTC).isoformat(timespec="seconds"),
        "trials": trials,
        "people": [_to_plain(person, leave_out=("id",)) for person in people],
        "artefacts": [
            _to_plain(kept, leave_out=("path", "created_at"))
            for kept in session.scalars(select(Artefact).where(Artefact.sha256.in_(hashes)))
        ],
    }


def _describe_trial(session: Session, trial_id: str, files: list[dict[str, Any]]) -> dict[str, Any]:
    known = read_record(session, trial_id)
    own = ("id", "trial_id")

    def rows(table: Any) -> list[dict[str, Any]]:
        found = session.scalars(select(table).where(table.trial_id == trial_id).order_by(table.id))
        return [_to_plain(row, leave_out=own) for row in found]

    results = rows(Result)
    for plain in results:
        said = session.scalars(
            select(Assessment)
            .join(Result)
            .where(Result.trial_id == trial_id, Result.version == plain["version"])
        )
        plain["assessments"] = [_to_plain(row, leave_out=("id", "result_id")) for row in said]
    return {
        "id": trial_id,
        "label": known.names.label,
        "site": known.names.site,
        "job": known.names.job,
        "person": known.names.person,
        "tags": list(known.tags),
        "notes": rows(Note),
        "reviews": rows(Review),
        "references": rows(Reference),
        "attachments": rows(Attachment),
        "results": results,
        "files": files,
    }


def _to_plain(row: Any, *, leave_out: Iterable[str]) -> dict[str, Any]:
    """Return a row's columns as values JSON has."""
    names = (column.key for column in row.__mapper__.column_attrs if column.key not in leave_out)
    return {name: _encode(getattr(row, name)) for name in names}


def _encode(value: Any) -> Any:
    if isinstance(value, datetime | date):
        return value.isoformat()
    if isinstance(value, float) and math.isinf(value):
        return "Infinity" if value > 0 else "-Infinity"
    return value


# --------------------------------------------------------------------------- import


@dataclass(frozen=True)
class _Member:
    """A file that the manifest announces."""

    name: str
    sha256: str
    size: int


def import_archive(library: Library, source: Path) -> ImportReport:
    """Take in what `export_trials` wrote; see `Library.import_archive`."""
    source = Path(source)
    scratch = hidden_sibling(library.trials / "import")
    try:
        with _reading(source), zipfile.ZipFile(source) as archive:
            manifest = _read_manifest(archive, source)
            members = _list_members(archive, manifest, source)
            _require_space(library.root, sum(member.size for member in members))
            with explain_os_errors(scratch, "The import"):
                for member in members:
                    _extract(archive, member, scratch, source)
        with _reading(source):
            return _take_in(library, manifest, scratch)
    finally:
        shutil.rmtree(scratch, ignore_errors=True)


class _reading:  # noqa: N801 - reads as a context, not as a type
    """Says in one sentence what is wrong with a file that can't be read."""

    def __init__(self, source: Path) -> None:
        self.source = source

    def __enter__(self) -> None:
        return None

    def __exit__(self, _kind: object, error: BaseException | None, _trace: object) -> None:
        if error is None or isinstance(error, ConfigError | DataError | OutputError):
            return
        if isinstance(error, FileNotFoundError | IsADirectoryError | PermissionError):
            raise DataError(f"The file {self.source} can't be opened; choose another.") from error
        if isinstance(error, IntegrityError):
            raise _damaged(self.source, "its rows contradict each other") from error
        if isinstance(error, _BAD_ZIP):
            raise _damaged(self.source, "it is no whole zip file") from error
        if isinstance(error, DECODING_ERRORS):
            raise _damaged(self.source, f"its {MANIFEST_NAME} is not as expected") from error


def _damaged(source: Path, why: str) -> DataError:
    return DataError(
        f"{source.name} is no usable export of a library ({why}); export it again. Nothing was "
        "taken in."
    )


def _read_manifest(archive: zipfile.ZipFile, source: Path) -> dict[str, Any]:
    try:
        info = archive.getinfo(MANIFEST_NAME)
    except KeyError:
        raise _damaged(source, f"it has no {MANIFEST_NAME}") from None
    if info.file_size > MAX_MANIFEST_BYTES:
        raise _damaged(source, f"its {MANIFEST_NAME} is too large")
    manifest = json.loads(archive.read(info))
    if manifest.get("format") != FORMAT:
        raise _damaged(source, "it was written by another program")
    if int(manifest["version"]) > VERSION:
        raise DataError(
            f"{source.name} was written by a newer LiftLens (version {manifest['version']} of the "
            f"format, this program reads up to {VERSION}); update LiftLens. Nothing was taken in."
        )
    return dict(manifest)


def _list_members(
    archive: zipfile.ZipFile, manifest: Mapping[str, Any], source: Path
) -> list[_Member]:
    """Return the announced files, after a look that the zip holds these and no others."""
    members = list(_announced(manifest, source))
    names = [info.filename for info in archive.infolist() if not info.is_dir()]
    expected = {MANIFEST_NAME, *(member.name for member in members)}
    if len(names) != len(set(names)) or len(expected) != len(members) + 1:
        raise _damaged(source, "a name occurs twice")
    if strangers := sorted(set(names) - expected):
        raise _damaged(source, f"it holds {strangers[0]!r}, which its list does not")
    if missing := sorted(expected - set(names)):
        raise _damaged(source, f"it lacks {missing[0]!r}")
    return members


def _announced(manifest: Mapping[str, Any], source: Path) -> Iterator[_Member]:
    for trial in manifest["trials"]:
        if not VALID_ID.fullmatch(trial["id"]):
            raise _damaged(source, f"{trial['id']!r} can't be the id of a trial")
        for file in trial["files"]:
            if not _is_inside(file["path"]):
                raise _damaged(source, f"{file['path']!r} leads out of its folder")
            name = f"trials/{trial['id']}/{file['path']}"
            yield _Member(name, str(file["sha256"]), int(file["size"]))
    for kept in manifest["artefacts"]:
        if not _SHA256.fullmatch(kept["sha256"]):
            raise _damaged(source, f"{kept['sha256']!r} is no SHA-256")
        yield _Member(f"artefacts/{kept['sha256']}", str(kept["sha256"]), int(kept["size"]))


def _is_inside(path: str) -> bool:
    parts = path.split("/")
    return not (set(path) & set("\\:\0")) and all(
        part and part not in (".", "..") and not part.startswith(".") for part in parts
    )


def _require_space(root: Path, size: int) -> None:
    free = shutil.disk_usage(root).free
    if size > free:
        raise OutputError(
            f"The import needs {size / 1e6:.0f} MB, but only {free / 1e6:.0f} MB are free at "
            f"{root}; free some space."
        )


def _extract(archive: zipfile.ZipFile, member: _Member, scratch: Path, source: Path) -> None:
    target = scratch.joinpath(*PurePosixPath(member.name).parts)
    target.parent.mkdir(parents=True, exist_ok=True)
    digest, size = hashlib.sha256(), 0
    with archive.open(member.name) as packed, target.open("xb") as file:
        while chunk := packed.read(CHUNK_BYTES):
            size += len(chunk)
            if size > member.size:
                raise _damaged(source, f"{member.name!r} is larger than announced")
            digest.update(chunk)
            file.write(chunk)
    if size != member.size or digest.hexdigest() != member.sha256:
        raise _damaged(source, f"{member.name!r} is not what was exported")


def _take_in(library: Library, manifest: Mapping[str, Any], scratch: Path) -> ImportReport:
    imported: dict[str, str] = {}
    already_there: list[str] = []
    moved: list[tuple[Path, Path]] = []
    kinds = {kept["sha256"]: clean_text(kept["kind"]) for kept in manifest["artefacts"]}
    try:
        # Rows and folders appear together: nobody changes the library in between.
        with library.database.writing() as session:
            _keep_artefacts(library, session, kinds, scratch)
            for trial in manifest["trials"]:
                source = scratch / "trials" / trial["id"]
                if _is_known(session, trial["id"], source):
                    already_there.append(trial["id"])
                    continue
                name = _free_id(library, session, trial["id"])
                target = library.folder(name)
                with explain_os_errors(target, "The import"):
                    source.rename(target)
                moved.append((source, target))
                _record_trial(session, target, trial)
                imported[trial["id"]] = name
            _keep_agreements(session, manifest["people"])
    except BaseException:
        for source, target in moved:
            target.rename(source)
        raise
    return ImportReport(imported, tuple(already_there))


def _is_known(session: Session, trial_id: str, folder: Path) -> bool:
    known = session.execute(
        select(Result.document_sha256)
        .join(Trial, Trial.id == Result.trial_id)
        .where(Trial.id == trial_id, Result.version == Trial.result_version)
    ).scalar()
    document = folder / DOCUMENT_NAME
    return known is not None and document.is_file() and hash_file(document).sha256 == known


def _free_id(library: Library, session: Session, trial_id: str) -> str:
    is_taken = session.get(Trial, trial_id) is not None or library.has(trial_id)
    return library.new_id() if is_taken else trial_id


def _keep_artefacts(
    library: Library, session: Session, kinds: Mapping[str, str], scratch: Path
) -> None:
    for sha256, kind in kinds.items():
        path = scratch / "artefacts" / sha256
        kept = library.artefacts.keep(HashedFile(path, sha256, path.stat().st_size))
        if session.get(Artefact, sha256) is None:
            session.add(
                Artefact(
                    sha256=sha256,
                    size=kept.size,
                    kind=kind,
                    path=kept.path.relative_to(library.root).as_posix(),
                    created_at=datetime.now(UTC),
                )
            )
    session.flush()


def _record_trial(session: Session, folder: Path, plain: Mapping[str, Any]) -> None:
    found = read_folder(folder)
    if found is None:
        raise DataError(f"The folder {folder} vanished while it was taken in; try again.")
    texts = {key: clean_text(plain[key]) for key in ("label", "site", "job", "person")}
    trial = Trial(
        id=folder.name,
        state="done",
        label=texts["label"],
        created_at=found.created,
        job_id=find_place(session, texts["site"], texts["job"]),
        person_id=find_person(session, texts["person"]),
        result_version=max((int(r["version"]) for r in plain["results"]), default=0),
    )
    session.add(trial)
    session.flush()
    for result in plain["results"]:
        values = dict(result)
        said = values.pop("assessments")
        row = _from_plain(Result, values, trial_id=trial.id)
        session.add(row)
        session.flush()
        session.add_all(_from_plain(Assessment, one, result_id=row.id) for one in said)
    _record_words(session, trial.id, plain)
    # The folder has the last word about the result itself.
    record(session, found)
    update_search(session, trial)


def _record_words(session: Session, trial_id: str, plain: Mapping[str, Any]) -> None:
    set_tags(session, trial_id, plain["tags"])
    for review in plain["reviews"]:
        check_verdict(review["verdict"])
    taken = set(session.scalars(select(Reference.name)))
    references = [one for one in plain["references"] if clean_text(one["name"]) not in taken]
    for table, rows in (
        (Note, plain["notes"]),
        (Review, plain["reviews"]),
        (Reference, references),
        (Attachment, plain["attachments"]),
    ):
        session.add_all(_from_plain(table, row, trial_id=trial_id) for row in rows)
    session.flush()


def _keep_agreements(session: Session, people: Iterable[Mapping[str, Any]]) -> None:
    """Take over what was agreed with people the library knew nothing of."""
    for plain in people:
        number = find_person(session, clean_text(plain["pseudonym"]))
        if number is None:
            continue
        person = session.get_one(Person, number)
        if person.consent_on is None and person.keep_until is None:
            given = _from_plain(Person, plain)
            person.consent_on, person.keep_until = given.consent_on, given.keep_until


def _from_plain(table: Any, plain: Mapping[str, Any], **own: Any) -> Any:
    """Build a row from values of JSON; a column it does not have is an error."""
    columns = table.__table__.columns
    values = {name: _decode(_kind_of(columns[name].type), v) for name, v in plain.items()}
    return table(**values, **own)


def _kind_of(column: Any) -> type:
    kind: type = datetime if isinstance(column, UtcDateTime) else column.python_type
    return kind


def _decode(kind: type, value: Any) -> Any:
    if value is None:
        return None
    if kind is datetime:
        return datetime.fromisoformat(value)
    if kind is date:
        return date.fromisoformat(value)
    if kind is str:
        return clean_text(value)
    if kind is bool and not isinstance(value, bool):
        raise TypeError(f"expected true or false, got {value!r}")
    return kind(value)
