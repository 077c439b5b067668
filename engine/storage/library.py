"""The library: every assessed trial of this computer, as folders with a list of them.

::

    root/trials/<id>/    a result folder
    root/uploads/<id>/   the videos a user uploaded for it
    root/jobs/<id>/      the work that made it: videos until it is done, the worker's log
    root/artefacts/      files that several trials share, by the hash of their content
    root/library.db      the list of trials, what people added to them, the queue of work

Measurements stay in folders that other tools read; the database can be made from them again,
except for what people added. Names that start with a dot are being written or removed and don't
count. Files come first, then one transaction: whatever is interrupted, the next opening
finds either all or nothing. Several processes may use one library.
"""

from __future__ import annotations

import contextlib
import logging
import os
import secrets
import shutil
import sys
import time
import uuid
from collections.abc import Collection, Iterable, Sequence
from dataclasses import dataclass
from datetime import UTC, date, datetime
from pathlib import Path
from typing import TYPE_CHECKING

from sqlalchemy import Delete, delete, select
from sqlalchemy.orm import Session

from engine.datatypes import Flag, FlagLevel
from engine.errors import ConfigError, OutputError
from engine.storage import curation
from engine.storage.artefacts import ArtefactStore
from engine.storage.atomic import PARTIAL_SUFFIX, explain_os_errors, hidden_sibling
from engine.storage.catalogue import (
    VALID_ID,
    find_place,
    prune,
    record_folder,
    refresh,
    verify,
)
from engine.storage.curation import (
    Names,
    NoteEntry,
    PersonEntry,
    ReferenceEntry,
    TrialRecord,
    Verdict,
)
from engine.storage.database.connection import Database, connect, find_url
from engine.storage.database.failures import DatabaseDamaged, DatabaseUnavailable
from engine.storage.database.models import (
    Artefact,
    Attachment,
    LibraryIdentity,
    Person,
    QueuedJob,
    Trial,
    TrialState,
)
from engine.storage.database.schema import KEEP_BACKUPS_S, prepare, remove_backups
from engine.storage.entries import (
    Choices,
    Filters,
    Order,
    TrialEntry,
    TrialPage,
    count_choices,
    count_levels,
    find_entries,
    is_any,
)
from engine.storage.overview import Overview, read_overview
from engine.storage.results import read_document
from engine.storage.summary import clean_text

if TYPE_CHECKING:
    from engine.storage.transfer import ImportReport

__all__ = ["HOME_VARIABLE", "AttachmentEntry", "Library", "TrialEntry", "TrialPage", "default_root"]

logger = logging.getLogger(__name__)

HOME_VARIABLE = "LIFTLENS_HOME"
LEFTOVER_AGE_S = 24 * 3600.0
"""A hidden folder as old as this belongs to a process that was killed."""
STRAY_AGE_S = 3600.0
"""A file in the store that nothing refers to for so long is nobody's."""
SWEEP_EVERY_S = 3600.0
SCRUB_TRIES = 20
SCRUB_WAIT_S = 0.05
IDENTITY_NAME = "library-id"
OVER_STATES = ("done", "failed", "cancelled")
"""What the queue calls a job nothing more will happen to."""


@dataclass(frozen=True)
class AttachmentEntry:
    """A file kept with a trial; `path` is where its content lies, named by its hash."""

    role: str
    name: str
    sha256: str
    size: int
    path: Path
    created: datetime


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
    """The trials below one folder, and their database.

    Parameters
    ----------
    root
        The folder; its parts are made if missing.

    Raises
    ------
    OutputError
        If the folder can't be made, or its database can't be used now.
    DataError
        If the database is damaged, of a newer program, or of another folder.
    """

    def __init__(self, root: Path) -> None:
        self.root = Path(root).expanduser().resolve()
        self.trials = self.root / "trials"
        self.uploads = self.root / "uploads"
        self.jobs = self.root / "jobs"
        self.artefacts = ArtefactStore(self.root / "artefacts")
        with explain_os_errors(self.root, "The library"):
            for folder in (self.trials, self.uploads, self.jobs):
                folder.mkdir(parents=True, exist_ok=True)
        self.database = _open_database(self.root)

    @classmethod
    def open(cls, root: Path | None = None) -> Library:
        """Open the library at `root`, by default the user's own, and clear what was left over."""
        library = cls(default_root() if root is None else root)
        library._sweep()
        return library

    @property
    def is_empty(self) -> bool:
        """Whether there is no trial yet."""
        refresh(self.trials, self.database)
        with self.database.reading() as session:
            return not is_any(session)

    @property
    def is_read_only(self) -> bool:
        """Whether nothing can be changed, for want of permission."""
        return self.database.is_read_only

    # ------------------------------------------------------------------ folders

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

    # ------------------------------------------------------------------ finding

    def entries(self) -> tuple[TrialEntry, ...]:
        """List the trials, newest first; damaged ones are listed as such."""
        return self._find(Filters(), "newest", None, 0)

    def query(
        self,
        *,
        search: str = "",
        site: str | None = None,
        job: str | None = None,
        person: str | None = None,
        level: FlagLevel | Collection[FlagLevel | None] | None = None,
        tags: Sequence[str] = (),
        since: datetime | None = None,
        until: datetime | None = None,
        order: Order = "newest",
        limit: int | None = None,
        offset: int = 0,
    ) -> TrialPage:
        """Return a part of the list, with how many trials match in all.

        Parameters
        ----------
        search
            Every word of it must stand in a trial's name, person, site, job, tags or category.
        site, job, person, level, tags, since, until
            As in `engine.storage.entries.Filters`.
        order
            `newest`, `oldest`, `label`, `level` (most urgent first) or `index` (highest first).
        limit, offset
            Which part of the matches to return; all if None.

        Raises
        ------
        ConfigError
            If the order is unknown, or a time has no zone.
        """
        filters = Filters(search, site, job, person, level, tuple(tags), since, until)
        entries = self._find(filters, order, limit, offset)
        with self.database.reading() as session:
            levels = count_levels(session, filters)
        total = sum(levels.get(one, 0) for one in filters.wanted_levels)
        return TrialPage(entries, total, levels)

    def choices(self) -> Choices:
        """Return the sites, jobs, people and tags there are, with the number of trials each."""
        refresh(self.trials, self.database)
        with self.database.reading() as session:
            return count_choices(session)

    def overview(
        self,
        *,
        site: str | None = None,
        job: str | None = None,
        since: datetime | None = None,
        until: datetime | None = None,
    ) -> Overview:
        """Count lifts by level, site, job and month; before and after a change, call it twice."""
        refresh(self.trials, self.database)
        with self.database.reading() as session:
            return read_overview(session, Filters(site=site, job=job, since=since, until=until))

    def _find(
        self, filters: Filters, order: Order, limit: int | None, offset: int
    ) -> tuple[TrialEntry, ...]:
        refresh(self.trials, self.database)
        for _ in range(2):
            with self.database.reading() as session:
                entries, stamps = find_entries(
                    session, self.trials, filters, order=order, limit=limit, offset=offset
                )
            # Once more only if what was to be shown had changed on disk.
            if not verify(self.trials, self.database, stamps.items()):
                break
        return tuple(entries)

    # ------------------------------------------------------------------ what people add

    def record(self, trial_id: str) -> TrialRecord:
        """Return what people added to a trial, and how its results changed.

        Raises
        ------
        ConfigError
            If there is no such trial.
        """
        refresh(self.trials, self.database)
        with self.database.reading() as session:
            return curation.read_record(session, _check_id(trial_id))

    def edit(
        self,
        trial_id: str,
        *,
        version: int,
        label: str | None = None,
        site: str | None = None,
        job: str | None = None,
        person: str | None = None,
        tags: Iterable[str] | None = None,
    ) -> int:
        """Correct a trial's names or tags; what is None stays. Return its new version.

        The result folder keeps what it said when it was made.

        Parameters
        ----------
        version
            Of the entry or record the change starts from.

        Raises
        ------
        EditConflict
            If somebody else changed the trial since; its `current` is what is there now.
        ConfigError
            If there is no such trial.
        """
        names = Names(label, site, job, person)
        with self.database.writing() as session:
            return curation.edit(session, trial_id, version=version, names=names, tags=tags)

    def review(
        self,
        trial_id: str,
        flag: Flag,
        verdict: Verdict,
        *,
        version: int,
        reason: str = "",
        reviewer: str = "",
    ) -> int:
        """Keep that somebody accepts or rejects a flag, and why; return the trial's new version.

        Raises
        ------
        EditConflict
            If somebody else changed the trial since `version`.
        ConfigError
            If a rejection has no reason.
        """
        with self.database.writing() as session:
            return curation.review(
                session, trial_id, flag, verdict, version=version, reason=reason, reviewer=reviewer
            )

    def add_note(
        self, trial_id: str, text: str, *, author: str = "", at_s: float | None = None
    ) -> NoteEntry:
        """Add a note to a trial, or to a moment of its video."""
        with self.database.writing() as session:
            return curation.add_note(session, trial_id, text, author=author, at_s=at_s)

    def delete_note(self, trial_id: str, note_id: int) -> None:
        """Delete a note."""
        with self.database.writing() as session:
            curation.delete_note(session, trial_id, note_id)
        self._scrub()

    def people(self) -> tuple[PersonEntry, ...]:
        """Return everybody who was filmed, by pseudonym."""
        refresh(self.trials, self.database)
        with self.database.reading() as session:
            return curation.list_people(session)

    def set_agreement(
        self, pseudonym: str, *, consent_on: date | None = None, keep_until: date | None = None
    ) -> None:
        """Keep when a person agreed, and until when their data may be kept."""
        with self.database.writing() as session:
            curation.set_agreement(session, pseudonym, consent_on=consent_on, keep_until=keep_until)

    def overdue(self, today: date) -> tuple[PersonEntry, ...]:
        """Return the people whose data should have been deleted before `today`."""
        return tuple(p for p in self.people() if p.keep_until is not None and p.keep_until < today)

    def references(self) -> tuple[ReferenceEntry, ...]:
        """Return the performances that attempts are compared with."""
        with self.database.reading() as session:
            return curation.list_references(session)

    def set_reference(
        self, name: str, trial_id: str, *, lift_index: int | None = None, notes: str = ""
    ) -> None:
        """Call a trial, or one lift of it, a reference performance."""
        with self.database.writing() as session:
            curation.set_reference(session, name, trial_id, lift_index=lift_index, notes=notes)

    def remove_reference(self, name: str) -> None:
        """Forget a reference performance; its trial stays."""
        with self.database.writing() as session:
            curation.remove_reference(session, name)

    # ------------------------------------------------------------------ attachments

    def attach(self, trial_id: str, source: Path, *, role: str, name: str | None = None) -> str:
        """Keep a copy of a file with a trial; return its SHA-256.

        Parameters
        ----------
        source
            The file; it is only read.
        role
            What it is to the trial, for example `calibration`.
        name
            Under which name; its own if None. An earlier file of that role and name goes.

        Raises
        ------
        ConfigError
            If there is no such trial.
        OutputError
            If it can't be copied.
        """
        brought = self.artefacts.bring(source)
        name = clean_text(Path(name or source.name).name)
        try:
            with self.database.writing() as session:
                curation.find_trial(session, _check_id(trial_id))
                kept = self.artefacts.keep(brought)
                now = datetime.now(UTC)
                if session.get(Artefact, kept.sha256) is None:
                    path = kept.path.relative_to(self.root).as_posix()
                    session.add(
                        Artefact(
                            sha256=kept.sha256,
                            size=kept.size,
                            kind=role,
                            path=path,
                            created_at=now,
                        )
                    )
                    session.flush()
                session.execute(_this_attachment(trial_id, role, name))
                session.add(
                    Attachment(
                        trial_id=trial_id,
                        sha256=kept.sha256,
                        role=role,
                        name=name,
                        created_at=now,
                    )
                )
        finally:
            self.artefacts.drop(brought)
        self._drop_unused()
        return kept.sha256

    def attachments(self, trial_id: str, role: str | None = None) -> tuple[AttachmentEntry, ...]:
        """Return the files kept with a trial, by role and name."""
        statement = (
            select(Attachment, Artefact)
            .join(Artefact)
            .where(Attachment.trial_id == _check_id(trial_id))
            .order_by(Attachment.role, Attachment.name)
        )
        if role is not None:
            statement = statement.where(Attachment.role == role)
        with self.database.reading() as session:
            return tuple(
                AttachmentEntry(
                    a.role, a.name, f.sha256, f.size, self.artefacts.path(f.sha256), a.created_at
                )
                for a, f in session.execute(statement)
            )

    def detach(self, trial_id: str, role: str, name: str) -> None:
        """Forget a file kept with a trial; its content goes unless another trial has it too."""
        with self.database.writing() as session:
            session.execute(_this_attachment(_check_id(trial_id), role, name))
        self._drop_unused()

    def _drop_unused(self) -> None:
        """Remove content nothing refers to any more."""
        unused = select(Artefact).where(
            ~select(Attachment.id).where(Attachment.sha256 == Artefact.sha256).exists()
        )
        with self.database.reading() as session:
            if session.scalar(unused.limit(1)) is None:
                return
        with self.database.writing() as session:
            gone = [artefact.sha256 for artefact in session.scalars(unused)]
            session.execute(delete(Artefact).where(Artefact.sha256.in_(gone)))
        # Rows first: content without a row is swept later, a row without content is damage.
        with self.database.writing() as session:
            for sha256 in gone:
                if session.get(Artefact, sha256) is None:
                    self.artefacts.remove(sha256)

    # ------------------------------------------------------------------ coming and going

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
        try:
            record_folder(target, self.database)
        except DatabaseUnavailable as error:
            # The result is safe: whoever lists the trials next finds it.
            logger.warning("The trial %s is not in the list yet: %s", trial_id, error)
        return trial_id

    def delete(self, trial_id: str) -> None:
        """Delete a trial and all that belongs to it: rows, result, uploads, the work that made it.

        Raises
        ------
        ConfigError
            If there is no such trial, or it is still being made.
        OutputError
            If something can't be deleted.
        """
        _check_id(trial_id)
        if not self._delete([trial_id]):
            raise ConfigError(f"There is no trial {trial_id!r} in the library {self.root}.")

    def delete_person(self, pseudonym: str) -> int:
        """Delete a person with all trials, jobs and files; return how many trials there were.

        Raises
        ------
        ConfigError
            If nobody has that pseudonym, or one of their videos is being assessed now.
        OutputError
            If something can't be deleted.
        """
        refresh(self.trials, self.database)
        with self.database.reading() as session:
            person = session.scalar(select(Person).where(Person.pseudonym == pseudonym))
            trials = (
                session.scalars(select(Trial.id).where(Trial.person_id == person.id)).all()
                if person
                else ()
            )
            jobs = session.scalars(select(QueuedJob.id).where(QueuedJob.person == pseudonym)).all()
        if person is None and not jobs:
            raise ConfigError(f"Nobody in the library has the pseudonym {pseudonym!r}.")
        self._delete([*trials, *(job for job in jobs if job not in trials)])
        with self.database.writing() as session:
            session.execute(delete(Person).where(Person.pseudonym == pseudonym))
        self._scrub()
        return len(trials)

    def export(
        self,
        target: Path,
        *,
        trials: Sequence[str] | None = None,
        site: str | None = None,
        job: str | None = None,
        person: str | None = None,
    ) -> Path:
        """Write trials with all that belongs to them into one zip file.

        Parameters
        ----------
        target
            The file; replaced once the new one is whole.
        trials
            Which ones; all that fit `site`, `job` and `person` if None.

        Raises
        ------
        ConfigError
            If no trial is meant.
        OutputError
            If it can't be written.
        """
        from engine.storage.transfer import export_trials

        filters = Filters(site=site, job=job, person=person, ids=trials)
        ids = [entry.id for entry in self._find(filters, "oldest", None, 0)]
        return export_trials(self, ids, target)

    def import_archive(self, source: Path) -> ImportReport:
        """Take in what `export` wrote, here or elsewhere; all of it or nothing.

        Raises
        ------
        DataError
            If it is no such file, damaged, of a newer program, or would write elsewhere.
        OutputError
            If there is no space.
        """
        from engine.storage.transfer import import_archive

        return import_archive(self, source)

    # ------------------------------------------------------------------ deleting and sweeping

    def _delete(self, trial_ids: Sequence[str]) -> bool:
        """Delete trials, whether there was any; decided first, so no interruption undoes it."""
        doomed = self._doom(trial_ids)
        if not doomed:
            return False
        try:
            self._remove_files(doomed)
        except OutputError:
            with self.database.writing() as session:
                for trial in session.scalars(select(Trial).where(Trial.id.in_(doomed))):
                    # Read again at the next look, and its state with it.
                    trial.state, trial.inode, trial.stamp = TrialState.DONE, "?", "?"
            self.database.seen_ns = None
            raise
        self._forget_rows(doomed)
        return True

    def _doom(self, trial_ids: Sequence[str]) -> list[str]:
        """Mark trials as being deleted; return those there are."""
        with self.database.writing() as session:
            rows = {t.id: t for t in session.scalars(select(Trial).where(Trial.id.in_(trial_ids)))}
            queued = session.scalars(select(QueuedJob).where(QueuedJob.id.in_(trial_ids))).all()
            for job in queued:
                if job.state not in OVER_STATES:
                    raise ConfigError(
                        f"The trial {job.id!r} is still being made; cancel that first."
                    )
            with_files = {n for n in trial_ids if any(part.exists() for part in self._parts(n))}
            for name in with_files - set(rows):
                rows[name] = _tombstone(session, name)
                session.add(rows[name])
            for trial in rows.values():
                trial.state = TrialState.DELETING
            return sorted({*rows, *(job.id for job in queued)})

    def _parts(self, trial_id: str) -> tuple[Path, Path, Path]:
        return self.trials / trial_id, self.uploads / trial_id, self.jobs / trial_id

    def _remove_files(self, trial_ids: Iterable[str]) -> None:
        for trial_id in trial_ids:
            for part in self._parts(trial_id):
                with explain_os_errors(part, "The deletion"):
                    _remove(part)

    def _forget_rows(self, trial_ids: Sequence[str]) -> None:
        with self.database.writing() as session:
            session.execute(delete(Trial).where(Trial.id.in_(trial_ids)))
            session.execute(delete(QueuedJob).where(QueuedJob.id.in_(trial_ids)))
            prune(session)
        self._drop_unused()
        self._scrub()

    def _scrub(self) -> None:
        """Take care that nothing deleted is left in the database's log or in copies of it."""
        if self.database.path is not None:
            remove_backups(self.database.path)
        for _ in range(SCRUB_TRIES):
            if self.database.scrub():
                return
            time.sleep(SCRUB_WAIT_S)
        logger.warning("Somebody reads the library; the next opening clears its log.")

    def _sweep(self) -> None:
        """Finish what killed processes left behind; it may hold pictures of people."""
        parts = (self.trials, self.uploads, self.jobs)
        mark = tuple(part.stat().st_mtime for part in parts)
        now = time.monotonic()
        swept = self.database.swept_at
        if self.is_read_only or (swept[:-1] == mark and now - swept[-1] < SWEEP_EVERY_S):
            return
        for part in parts:
            _remove_leftovers(part)
        try:
            self._finish_deletions()
            self._sweep_store()
        except (DatabaseUnavailable, OutputError) as error:
            logger.warning("What was left over is cleared next time: %s", error)
            return
        self.database.swept_at = (*mark, now)

    def _finish_deletions(self) -> None:
        with self.database.reading() as session:
            doomed = session.scalars(
                select(Trial.id).where(Trial.state == TrialState.DELETING)
            ).all()
        if doomed:
            self._remove_files(doomed)
            self._forget_rows(doomed)

    def _sweep_store(self) -> None:
        if self.database.path is not None:
            remove_backups(self.database.path, older_than_s=KEEP_BACKUPS_S)
        self.database.scrub()
        if not self.artefacts.strays(set(), older_than_s=STRAY_AGE_S):
            return
        with self.database.writing() as session:
            known = set(session.scalars(select(Artefact.sha256)))
            for path in self.artefacts.strays(known, older_than_s=STRAY_AGE_S):
                logger.info("Removing what an interrupted process left: %s", path)
                path.unlink(missing_ok=True)


def _open_database(root: Path) -> Database:
    url = find_url()
    first = connect(root, url)
    prepare(first, root / ".library.lock")
    database = connect(root, url)
    if database is not first:  # its file was made just now
        first.dispose()
    if not database.is_sqlite:
        _check_identity(database, root)
    return database


def _check_identity(database: Database, root: Path) -> None:
    """See to it that a database server and a data folder belong together.

    Raises
    ------
    DatabaseDamaged
        If they don't: the trials of one would all be damaged in the other.
    """
    path = root / IDENTITY_NAME
    with database.reading() as session:
        known = session.scalar(select(LibraryIdentity.id))
    if known is None:
        with database.writing() as session:
            known = session.scalar(select(LibraryIdentity.id)) or _introduce(session)
    if not path.exists() and not _has_trials(database):
        with explain_os_errors(path, "The library"):
            path.write_text(f"{known}\n", encoding="ascii")
    if not path.exists() or path.read_text(encoding="ascii").strip() != known:
        raise DatabaseDamaged(
            f"The database {database.where} belongs to another data folder than {root}; name that "
            f"folder by {HOME_VARIABLE}, or give this one an empty database."
        )


def _introduce(session: Session) -> str:
    identity = LibraryIdentity(id=uuid.uuid4().hex, created_at=datetime.now(UTC))
    session.add(identity)
    return identity.id


def _has_trials(database: Database) -> bool:
    with database.reading() as session:
        return session.scalar(select(Trial.id).limit(1)) is not None


def _tombstone(session: Session, trial_id: str) -> Trial:
    """Return the row of a trial that was never listed, so that nobody lists it while it goes."""
    return Trial(
        id=trial_id,
        state=TrialState.DELETING,
        created_at=datetime.now(UTC),
        job_id=find_place(session, "", ""),
    )


def _this_attachment(trial_id: str, role: str, name: str) -> Delete:
    return delete(Attachment).where(
        Attachment.trial_id == trial_id, Attachment.role == role, Attachment.name == name
    )


def _check_id(trial_id: str) -> str:
    if not VALID_ID.fullmatch(trial_id):
        raise ConfigError(
            f"A trial id has letters, digits, dots, dashes and underscores only, got {trial_id!r}."
        )
    return trial_id


def _remove_leftovers(folder: Path) -> None:
    with os.scandir(folder) as entries:
        hidden = [Path(e.path) for e in entries if e.name.startswith(".")]
    for path in hidden:
        with contextlib.suppress(OSError):
            is_old = time.time() - path.stat().st_mtime > LEFTOVER_AGE_S
            if path.name.endswith(PARTIAL_SUFFIX) and is_old:
                logger.info("Removing what an interrupted process left: %s", path)
                _discard(path)


def _remove(path: Path) -> None:
    """Remove a file or folder if it is there; by one rename, it is gone for everybody at once."""
    hidden = hidden_sibling(path)
    try:
        path.rename(hidden)
    except FileNotFoundError:
        return
    _discard(hidden)


def _discard(path: Path) -> None:
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path)
    else:
        path.unlink(missing_ok=True)
