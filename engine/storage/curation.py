"""What people add to a trial: better names, tags, notes, and what they say to its flags.

Two people may work on one trial. Whoever changes what the other has not seen yet is told so, with
the state that is there now, and nothing of either is lost: the version a change starts from
has to be the trial's present one.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from datetime import UTC, date, datetime
from typing import Literal, get_args

from sqlalchemy import delete, func, select
from sqlalchemy.orm import Session

from engine.datatypes import Flag
from engine.errors import ConfigError, DataError
from engine.storage.catalogue import find_person, find_place, prune, update_search
from engine.storage.database.models import (
    Job,
    Note,
    Person,
    Reference,
    Result,
    Review,
    Site,
    Tag,
    Trial,
    TrialState,
    TrialTag,
)
from engine.storage.summary import clean_text

__all__ = [
    "EditConflict",
    "FlagReview",
    "Names",
    "NoteEntry",
    "PersonEntry",
    "ReferenceEntry",
    "ResultVersion",
    "TrialRecord",
    "Verdict",
    "flag_key",
]

Verdict = Literal["accepted", "rejected", "open"]
"""What a person says to a flag; `open` takes an earlier word back."""


@dataclass(frozen=True)
class Names:
    """How a trial is called; a change leaves out what is None."""

    label: str | None = None
    site: str | None = None
    job: str | None = None
    person: str | None = None


@dataclass(frozen=True)
class NoteEntry:
    """A note; `at_s` is the moment of the video it is about, if any."""

    id: int
    text: str
    author: str
    created: datetime
    at_s: float | None = None


@dataclass(frozen=True)
class FlagReview:
    """What somebody said to a flag (`flag_key`) of one version of the result."""

    flag: str
    verdict: Verdict
    reason: str
    reviewer: str
    created: datetime
    result_version: int


@dataclass(frozen=True)
class ResultVersion:
    """One version of a trial's result in short; only the newest lies in the folder."""

    version: int
    created: datetime
    liftlens_version: str
    worst_level: str | None
    li: float | None
    li_interval: tuple[float | None, float | None]
    n_lifts: int


@dataclass(frozen=True)
class TrialRecord:
    """All that people added to a trial, and how its results changed; lists are oldest first."""

    id: str
    version: int
    names: Names
    tags: tuple[str, ...]
    notes: tuple[NoteEntry, ...]
    reviews: tuple[FlagReview, ...]
    results: tuple[ResultVersion, ...]

    def verdict(self, flag: Flag) -> FlagReview | None:
        """Return what was last said to a flag of the newest result; None if nothing stands."""
        key, newest = flag_key(flag), self.results[-1].version if self.results else 0
        said = [r for r in self.reviews if r.flag == key and r.result_version == newest]
        return said[-1] if said and said[-1].verdict != "open" else None


@dataclass(frozen=True)
class PersonEntry:
    """Somebody who was filmed, what was agreed, and how many trials there are."""

    pseudonym: str
    consent_on: date | None
    keep_until: date | None
    n_trials: int


@dataclass(frozen=True)
class ReferenceEntry:
    """A performance to compare attempts with."""

    name: str
    trial_id: str
    lift_index: int | None
    notes: str
    created: datetime


class EditConflict(DataError):  # noqa: N818 - a state, as in the error tree
    """Somebody else changed the trial meanwhile; `current` is what is there now."""

    def __init__(self, message: str, current: TrialRecord) -> None:
        super().__init__(message)
        self.current = current


def flag_key(flag: Flag) -> str:
    """Return what recognises a flag within one result."""
    lift = "" if flag.lift_index is None else str(flag.lift_index)
    return clean_text(f"{flag.method}|{lift}|{flag.what}")


# --------------------------------------------------------------------------- reading


def find_trial(session: Session, trial_id: str) -> Trial:
    """Return a trial's row.

    Raises
    ------
    ConfigError
        If there is none.
    """
    trial = session.get(Trial, trial_id)
    if trial is None or trial.state == TrialState.DELETING:
        raise ConfigError(f"There is no trial {trial_id!r} in the library; it may be deleted.")
    return trial


def read_record(session: Session, trial_id: str) -> TrialRecord:
    """Return all that people added to a trial."""
    trial = find_trial(session, trial_id)
    site, job = session.execute(
        select(Site.name, Job.name).join(Site).where(Job.id == trial.job_id)
    ).one()
    person = session.scalar(select(Person.pseudonym).where(Person.id == trial.person_id)) or ""
    tags = session.scalars(
        select(Tag.name).join(TrialTag).where(TrialTag.trial_id == trial_id).order_by(Tag.name)
    )
    notes = session.scalars(select(Note).where(Note.trial_id == trial_id).order_by(Note.id))
    reviews = session.scalars(select(Review).where(Review.trial_id == trial_id).order_by(Review.id))
    results = session.scalars(
        select(Result).where(Result.trial_id == trial_id).order_by(Result.version)
    )
    return TrialRecord(
        id=trial_id,
        version=trial.version,
        names=Names(trial.label, site, job, person),
        tags=tuple(tags),
        notes=tuple(NoteEntry(n.id, n.text, n.author, n.created_at, n.at_s) for n in notes),
        reviews=tuple(map(_read_review, reviews)),
        results=tuple(map(_read_version, results)),
    )


def _read_review(review: Review) -> FlagReview:
    return FlagReview(
        flag=review.flag,
        verdict=check_verdict(review.verdict),
        reason=review.reason,
        reviewer=review.reviewer,
        created=review.created_at,
        result_version=review.result_version,
    )


def _read_version(result: Result) -> ResultVersion:
    return ResultVersion(
        version=result.version,
        created=result.created_at,
        liftlens_version=result.liftlens_version,
        worst_level=result.worst_level,
        li=result.li,
        li_interval=(result.li_low, result.li_high),
        n_lifts=result.n_lifts,
    )


def check_verdict(word: str) -> Verdict:
    """Return a verdict.

    Raises
    ------
    ConfigError
        If the word is none.
    """
    for verdict in get_args(Verdict):
        if word == verdict:
            found: Verdict = verdict
            return found
    raise ConfigError(f"A flag is {', '.join(get_args(Verdict))}; got {word!r}.")


# --------------------------------------------------------------------------- changing


def edit(
    session: Session,
    trial_id: str,
    *,
    version: int,
    names: Names,
    tags: Iterable[str] | None = None,
) -> int:
    """Change a trial's names and tags; return its new version.

    Raises
    ------
    EditConflict
        If somebody changed it since `version`.
    """
    trial = _claim(session, trial_id, version)
    before = read_record(session, trial_id).names
    if names.label is not None:
        trial.label = _name(names.label)
    if names.site is not None or names.job is not None:
        site = before.site if names.site is None else names.site
        job = before.job if names.job is None else names.job
        trial.job_id = find_place(session, _name(site or ""), _name(job or ""))
    if names.person is not None:
        trial.person_id = find_person(session, _name(names.person))
    if tags is not None:
        set_tags(session, trial_id, tags)
    update_search(session, trial)
    prune(session)
    return trial.version


def review(
    session: Session,
    trial_id: str,
    flag: Flag,
    verdict: Verdict,
    *,
    version: int,
    reason: str,
    reviewer: str,
) -> int:
    """Keep what somebody says to a flag of the newest result; return the trial's new version.

    Raises
    ------
    EditConflict
        If somebody changed the trial since `version`.
    ConfigError
        If a rejection has no reason.
    """
    if check_verdict(verdict) == "rejected" and not reason.strip():
        raise ConfigError("Rejecting a flag needs a reason, so that others can follow it.")
    trial = _claim(session, trial_id, version)
    session.add(
        Review(
            trial_id=trial_id,
            result_version=trial.result_version,
            flag=flag_key(flag),
            verdict=verdict,
            reason=clean_text(reason).strip(),
            reviewer=_name(reviewer),
            created_at=datetime.now(UTC),
        )
    )
    return trial.version


def add_note(
    session: Session, trial_id: str, text: str, *, author: str, at_s: float | None
) -> NoteEntry:
    """Add a note. Notes stand side by side, so no two people can be in each other's way.

    Raises
    ------
    ConfigError
        If it is empty, or there is no such trial.
    """
    trial, text = find_trial(session, trial_id), clean_text(text).strip()
    if not text:
        raise ConfigError("A note needs some words.")
    note = Note(
        trial_id=trial_id,
        text=text,
        author=_name(author),
        at_s=at_s,
        created_at=datetime.now(UTC),
    )
    session.add(note)
    trial.version += 1
    session.flush()
    return NoteEntry(note.id, note.text, note.author, note.created_at, note.at_s)


def delete_note(session: Session, trial_id: str, note_id: int) -> None:
    """Delete a note; nothing happens if somebody else was faster."""
    trial = find_trial(session, trial_id)
    session.execute(delete(Note).where(Note.trial_id == trial_id, Note.id == note_id))
    trial.version += 1


def _claim(session: Session, trial_id: str, version: int) -> Trial:
    """Return a trial's row for a change that starts from `version`, which it ends."""
    trial = find_trial(session, trial_id)
    if trial.version != version:
        raise EditConflict(
            "Somebody else changed this trial while you were working on it, so yours was not "
            "kept yet. Look at what is there now, then save again.",
            read_record(session, trial_id),
        )
    trial.version += 1
    return trial


def set_tags(session: Session, trial_id: str, tags: Iterable[str]) -> None:
    """Give a trial these tags and no others."""
    wanted = {name for tag in tags if (name := _name(tag))}
    session.execute(delete(TrialTag).where(TrialTag.trial_id == trial_id))
    for name in sorted(wanted):
        tag = session.scalar(select(Tag).where(Tag.name == name))
        if tag is None:
            tag = Tag(name=name)
            session.add(tag)
            session.flush()
        session.add(TrialTag(trial_id=trial_id, tag_id=tag.id))
    session.flush()


def _name(text: str) -> str:
    """Return a name in one line."""
    return " ".join(clean_text(text).split())


# --------------------------------------------------------------------------- people, references


def list_people(session: Session) -> tuple[PersonEntry, ...]:
    """Return everybody who was filmed, by pseudonym."""
    statement = (
        select(Person, func.count(Trial.id))
        .outerjoin(Trial, Trial.person_id == Person.id)
        .group_by(Person.id)
        .order_by(Person.pseudonym)
    )
    return tuple(
        PersonEntry(person.pseudonym, person.consent_on, person.keep_until, number)
        for person, number in session.execute(statement)
    )


def set_agreement(
    session: Session, pseudonym: str, *, consent_on: date | None, keep_until: date | None
) -> None:
    """Keep what was agreed with a person about their data."""
    number = find_person(session, _name(pseudonym))
    if number is None:
        raise ConfigError("An agreement needs the pseudonym of a person.")
    person = session.get_one(Person, number)
    person.consent_on, person.keep_until = consent_on, keep_until


def list_references(session: Session) -> tuple[ReferenceEntry, ...]:
    """Return the reference performances, by name."""
    rows: Sequence[Reference] = session.scalars(select(Reference).order_by(Reference.name)).all()
    return tuple(
        ReferenceEntry(r.name, r.trial_id, r.lift_index, r.notes, r.created_at) for r in rows
    )


def set_reference(
    session: Session, name: str, trial_id: str, *, lift_index: int | None, notes: str
) -> None:
    """Call a trial, or one lift of it, a reference performance; an earlier one of the name goes."""
    find_trial(session, trial_id)
    name = _name(name)
    if not name:
        raise ConfigError("A reference performance needs a name.")
    session.execute(delete(Reference).where(Reference.name == name))
    session.add(
        Reference(
            name=name,
            trial_id=trial_id,
            lift_index=lift_index,
            notes=clean_text(notes),
            created_at=datetime.now(UTC),
        )
    )


def remove_reference(session: Session, name: str) -> None:
    """Forget a reference performance; its trial stays."""
    session.execute(delete(Reference).where(Reference.name == name))
