"""Keeping the rows of the library in step with its folders.

A result folder is the truth about a trial, and other tools may copy, change or delete it; the
rows are found again from it at any time. A look at the names of all folders (some
milliseconds for ten thousand) finds what came, went or was replaced; what is about to
be shown is also compared by its file's size and time.
"""

from __future__ import annotations

import logging
import os
import re
import time
from collections.abc import Iterable, Iterator, Sequence
from datetime import UTC, datetime
from itertools import islice
from pathlib import Path
from typing import TypeVar

from sqlalchemy import delete, exists, select
from sqlalchemy.orm import Session

from engine.storage.database.connection import Database
from engine.storage.database.models import (
    Assessment,
    Job,
    Person,
    Result,
    Site,
    Tag,
    Trial,
    TrialState,
    TrialTag,
)
from engine.storage.summary import Summary, TrialFolder, find_stamp, read_folder

__all__ = [
    "VALID_ID",
    "find_person",
    "find_place",
    "prune",
    "record",
    "record_folder",
    "refresh",
    "update_search",
    "verify",
]

logger = logging.getLogger(__name__)

VALID_ID = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]{0,99}")
BATCH = 100
"""How many folders are read in before their rows are kept: others may work in between."""
REPLACING_S = 0.05
"""How long a folder may be away while a new result takes its place."""
SETTLED_NS = 2_000_000_000
"""A folder's time is trusted once it is this old: within one tick of the disk's clock another
change would not show."""
UNSETTLED = -1

_T = TypeVar("_T")


def refresh(trials: Path, database: Database) -> None:
    """Bring the rows up to date with the folders below `trials`.

    Raises
    ------
    DatabaseUnavailable
        If something changed and the database takes no changes.
    """
    if database.is_read_only and not database.is_scratch:
        return
    mark = trials.stat().st_mtime_ns
    if database.seen_ns == mark:
        return
    looked_ns = time.time_ns()
    changed, gone = _compare(trials, database)
    for names in _batches(changed):
        folders = [found for name in names if (found := read_folder(trials / name))]
        with database.writing() as session:
            for folder in folders:
                record(session, folder)
    if gone:
        _record_missing(trials, database, gone)
    database.seen_ns = mark if looked_ns - mark > SETTLED_NS else UNSETTLED


def verify(trials: Path, database: Database, stamps: Iterable[tuple[str, str]]) -> bool:
    """Compare trials (id, stamp) with their folders; whether any row had to be changed."""
    if database.is_read_only and not database.is_scratch:
        return False
    stale = [name for name, stamp in stamps if find_stamp(trials / name) != stamp]
    if not stale:
        return False
    folders = {name: read_folder(trials / name) for name in stale}
    with database.writing() as session:
        for folder in filter(None, folders.values()):
            record(session, folder)
    missing = [name for name, folder in folders.items() if folder is None]
    return _record_missing(trials, database, missing) or len(missing) < len(stale)


def record_folder(folder: Path, database: Database) -> None:
    """Keep the row of one folder."""
    if found := read_folder(folder):
        with database.writing() as session:
            record(session, found)


def record(session: Session, folder: TrialFolder) -> None:
    """Make or update the row of a trial from a look at its folder.

    A folder that was deleted since the look gets none: nobody deletes it before its row says so.
    """
    if not folder.path.exists():
        return
    trial = session.get(Trial, folder.id)
    if trial is not None and trial.state == TrialState.DELETING:
        return
    is_new = trial is None
    if trial is None:
        trial = _introduce(session, folder)
    trial.inode, trial.stamp, trial.thumbnail = folder.inode, folder.stamp, folder.thumbnail
    trial.message = folder.message
    trial.state = TrialState.DAMAGED if folder.summary is None else TrialState.DONE
    if folder.summary is not None:
        _record_result(session, trial, folder.summary, folder.created, is_new=is_new)
    if not is_new:
        update_search(session, trial)


def _introduce(session: Session, folder: TrialFolder) -> Trial:
    """Make the row of a trial that was never listed; thousands come at once from an old library."""
    told = folder.summary
    site, job, person = (told.site, told.job, told.person) if told else ("", "", "")
    index = told.lifting_index if told else None
    trial = Trial(
        id=folder.id,
        state=TrialState.DONE,
        label=told.label if told else "",
        created_at=folder.created,
        job_id=find_place(session, site, job),
        person_id=find_person(session, person),
        result_version=0,
        search=_search_text(
            told.label if told else "", person, site, job, index.category if index else ""
        ),
    )
    session.add(trial)
    session.flush()
    return trial


def find_place(session: Session, site: str, job: str) -> int:
    """Return the row of a job at a site; made if it is new."""
    known: dict[tuple[str, str], int] = session.info.setdefault("places", {})
    if (site, job) in known:
        return known[site, job]
    place = session.scalar(select(Site).where(Site.name == site))
    if place is None:
        place = Site(name=site)
        session.add(place)
        session.flush()
    work = session.scalar(select(Job).where(Job.site_id == place.id, Job.name == job))
    if work is None:
        work = Job(site_id=place.id, name=job)
        session.add(work)
        session.flush()
    return known.setdefault((site, job), work.id)


def find_person(session: Session, pseudonym: str) -> int | None:
    """Return the row of a person, made if it is new; None without a pseudonym."""
    if not pseudonym:
        return None
    known: dict[str, int] = session.info.setdefault("people", {})
    if pseudonym in known:
        return known[pseudonym]
    person = session.scalar(select(Person).where(Person.pseudonym == pseudonym))
    if person is None:
        person = Person(pseudonym=pseudonym)
        session.add(person)
        session.flush()
    return known.setdefault(pseudonym, person.id)


def update_search(session: Session, trial: Trial) -> None:
    """Write down what a search looks at: names, the method's word, tags."""
    session.flush()
    site, job = session.execute(
        select(Site.name, Job.name).join(Site).where(Job.id == trial.job_id)
    ).one()
    person = session.scalar(select(Person.pseudonym).where(Person.id == trial.person_id))
    category = session.scalar(
        select(Result.category).where(
            Result.trial_id == trial.id, Result.version == trial.result_version
        )
    )
    tags = session.scalars(select(Tag.name).join(TrialTag).where(TrialTag.trial_id == trial.id))
    trial.search = _search_text(trial.label, person, site, job, category, *sorted(tags))


def _search_text(*parts: str | None) -> str:
    return " ".join(part for part in parts if part).casefold()


def prune(session: Session) -> None:
    """Remove names that no trial uses any more: they may say more than was meant."""
    session.flush()
    session.info.clear()
    session.execute(delete(Tag).where(~exists().where(TrialTag.tag_id == Tag.id)))
    session.execute(delete(Job).where(~exists().where(Trial.job_id == Job.id)))
    session.execute(delete(Site).where(~exists().where(Job.site_id == Site.id)))
    session.execute(
        delete(Person).where(
            Person.consent_on.is_(None),
            Person.keep_until.is_(None),
            ~exists().where(Trial.person_id == Person.id),
        )
    )


# --------------------------------------------------------------------------- comparing


def _compare(trials: Path, database: Database) -> tuple[list[str], list[str]]:
    """Return the names of folders whose rows are missing or old, and rows without a folder."""
    with os.scandir(trials) as entries:
        found = {e.name: str(e.inode()) for e in entries if _is_trial(e)}
    with database.reading() as session:
        rows = session.execute(
            select(Trial.id, Trial.inode, Trial.stamp).where(Trial.state != TrialState.DELETING)
        )
        known = {name: (inode, stamp) for name, inode, stamp in rows}
        deleting = set(session.scalars(select(Trial.id).where(Trial.state == TrialState.DELETING)))
    is_first_look = database.seen_ns is None
    changed = [
        name
        for name, inode in found.items()
        if name not in deleting
        and (
            name not in known
            or known[name][0] != inode
            or (is_first_look and find_stamp(trials / name) != known[name][1])
        )
    ]
    gone = [name for name, (inode, _) in known.items() if inode and name not in found]
    return sorted(changed), gone


def _is_trial(entry: os.DirEntry[str]) -> bool:
    if entry.name.startswith(".") or not entry.is_dir():
        return False
    if VALID_ID.fullmatch(entry.name):
        return True
    logger.warning(
        "The folder %r can't be a trial: expected letters, digits, dots, dashes and underscores; "
        "rename it.",
        entry.name,
    )
    return False


def _record_missing(trials: Path, database: Database, names: Sequence[str]) -> bool:
    """Say of rows that their folder is gone; not of those that others delete or replace now."""
    time.sleep(REPLACING_S)
    is_any = False
    with database.writing() as session:
        for name in names:
            trial = session.get(Trial, name)
            if trial is None or trial.state == TrialState.DELETING or (trials / name).exists():
                continue
            is_any = True
            trial.state, trial.inode, trial.stamp = TrialState.DAMAGED, "", ""
            trial.thumbnail = ""
            trial.message = (
                f"The folder {trials / name} is gone: it was moved or deleted outside LiftLens. "
                "Put it back from a backup, or delete this entry."
            )
    return is_any


def _batches(names: Sequence[_T]) -> Iterator[list[_T]]:
    iterator = iter(names)
    while batch := list(islice(iterator, BATCH)):
        yield batch


# --------------------------------------------------------------------------- results


def _record_result(
    session: Session, trial: Trial, summary: Summary, created: datetime, *, is_new: bool
) -> None:
    if not is_new:
        latest = session.scalars(
            select(Result).where(
                Result.trial_id == trial.id, Result.version == trial.result_version
            )
        ).one_or_none()
        if latest is not None and latest.document_sha256 == summary.document_sha256:
            return
        _follow_names(session, trial, latest, summary)
    trial.created_at = created
    trial.result_version += 1
    index = summary.lifting_index
    result = Result(
        trial_id=trial.id,
        version=trial.result_version,
        created_at=summary.created or datetime.now(UTC),
        document_sha256=summary.document_sha256,
        liftlens_version=summary.liftlens_version,
        backend=summary.backend,
        solver=summary.solver,
        label=summary.label,
        site=summary.site,
        job=summary.job,
        person=summary.person,
        worst_level=None if summary.worst_level is None else summary.worst_level.value,
        li=None if index is None else index.value,
        li_low=None if index is None else index.low,
        li_high=None if index is None else index.high,
        category="" if index is None else index.category,
        duration_s=summary.duration_s,
        n_lifts=summary.n_lifts,
        n_high=summary.n_high,
        n_review=summary.n_review,
        n_ok=summary.n_ok,
    )
    session.add(result)
    session.flush()
    session.add_all(
        Assessment(
            result_id=result.id,
            method=m.method,
            value=m.value,
            low=m.low,
            high=m.high,
            category=m.category,
            is_applicable=m.is_applicable,
        )
        for m in summary.methods
    )


def _follow_names(session: Session, trial: Trial, earlier: Result | None, summary: Summary) -> None:
    """Take over the result's names, except those that a person has corrected in the library."""
    site, job = session.execute(
        select(Site.name, Job.name).join(Site).where(Job.id == trial.job_id)
    ).one()
    person = session.scalar(select(Person.pseudonym).where(Person.id == trial.person_id)) or ""
    if earlier is None or trial.label == earlier.label:
        trial.label = summary.label
    if earlier is None or (site, job) == (earlier.site, earlier.job):
        trial.job_id = find_place(session, summary.site, summary.job)
    if earlier is None or person == earlier.person:
        trial.person_id = find_person(session, summary.person)
