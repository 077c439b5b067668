"""The tables of the library.

Measurements are not in here: they stay in result folders that other tools can read. The
database holds what is needed to find a trial among thousands, and what people add to it. Every
time is UTC. An empty name of a site or job means that none was given.
"""

from __future__ import annotations

from datetime import UTC, date, datetime

from sqlalchemy import (
    BigInteger,
    DateTime,
    Dialect,
    Float,
    ForeignKey,
    Index,
    MetaData,
    Text,
    TypeDecorator,
    UniqueConstraint,
)
from sqlalchemy.orm import DeclarativeBase, Mapped, mapped_column

__all__ = [
    "Artefact",
    "Assessment",
    "Attachment",
    "Base",
    "Job",
    "LibraryIdentity",
    "Note",
    "Person",
    "QueuedJob",
    "Reference",
    "Result",
    "Review",
    "Site",
    "Tag",
    "Trial",
    "TrialState",
    "TrialTag",
    "UtcDateTime",
]


class UtcDateTime(TypeDecorator[datetime]):
    """A moment: goes in with its zone, is kept as UTC, comes out as UTC on every database."""

    impl = DateTime(timezone=True)
    cache_ok = True

    def process_bind_param(self, value: datetime | None, dialect: Dialect) -> datetime | None:
        """Return what the database gets."""
        if value is None:
            return None
        if value.tzinfo is None:
            raise ValueError("A time in the library needs its zone, got one without.")
        value = value.astimezone(UTC)
        return value.replace(tzinfo=None) if dialect.name == "sqlite" else value

    def process_result_value(self, value: datetime | None, dialect: Dialect) -> datetime | None:
        """Return what the program gets."""
        if value is None:
            return None
        return value.replace(tzinfo=UTC) if value.tzinfo is None else value.astimezone(UTC)


class Base(DeclarativeBase):
    """Base of all tables; constraints have names, so that migrations can change them."""

    metadata = MetaData(
        naming_convention={
            "ix": "ix_%(table_name)s_%(column_0_N_name)s",
            "uq": "uq_%(table_name)s_%(column_0_N_name)s",
            "fk": "fk_%(table_name)s_%(column_0_N_name)s",
            "pk": "pk_%(table_name)s",
        }
    )
    type_annotation_map = {  # noqa: RUF012 - read by SQLAlchemy, never changed
        str: Text(),
        float: Float(53),
        datetime: UtcDateTime(),
    }


class LibraryIdentity(Base):
    """One row: which data folder this database belongs to."""

    __tablename__ = "library"

    id: Mapped[str] = mapped_column(primary_key=True)
    created_at: Mapped[datetime]


class Site(Base):
    """A place of work."""

    __tablename__ = "sites"

    id: Mapped[int] = mapped_column(primary_key=True)
    name: Mapped[str] = mapped_column(unique=True)


class Job(Base):
    """A kind of work at a site."""

    __tablename__ = "jobs"
    __table_args__ = (UniqueConstraint("site_id", "name"),)

    id: Mapped[int] = mapped_column(primary_key=True)
    site_id: Mapped[int] = mapped_column(ForeignKey("sites.id", ondelete="CASCADE"))
    name: Mapped[str]


class Person(Base):
    """Somebody who was filmed, under a pseudonym, with what was agreed about their data."""

    __tablename__ = "people"

    id: Mapped[int] = mapped_column(primary_key=True)
    pseudonym: Mapped[str] = mapped_column(unique=True)
    consent_on: Mapped[date | None]
    keep_until: Mapped[date | None] = mapped_column(index=True)


class TrialState:
    """The words for a trial's `state`."""

    DONE = "done"
    DAMAGED = "damaged"
    DELETING = "deleting"
    """Its deletion was decided; whoever opens the library next finishes it."""


class Trial(Base):
    """One trial: a result folder of the same name, and what people made of it.

    `inode`, `stamp` say which state of the folder this row describes. `search` is what a search
    looks at. `version` grows with every change a person makes.
    """

    __tablename__ = "trials"
    __table_args__ = (Index("ix_trials_created_at_id", "created_at", "id"),)

    id: Mapped[str] = mapped_column(primary_key=True)
    state: Mapped[str] = mapped_column(index=True)
    message: Mapped[str] = mapped_column(default="")
    label: Mapped[str] = mapped_column(default="")
    job_id: Mapped[int] = mapped_column(ForeignKey("jobs.id"), index=True)
    person_id: Mapped[int | None] = mapped_column(ForeignKey("people.id"), index=True)
    created_at: Mapped[datetime]
    result_version: Mapped[int] = mapped_column(default=0)
    version: Mapped[int] = mapped_column(default=1)
    thumbnail: Mapped[str] = mapped_column(default="")
    search: Mapped[str] = mapped_column(default="")
    inode: Mapped[str] = mapped_column(default="")
    stamp: Mapped[str] = mapped_column(default="")


class Result(Base):
    """What one version of a trial's result says in short; the newest lies in the folder.

    `li` and its interval are infinite where nothing may be lifted. `label` to `person` are what
    the result itself says: people may have corrected the trial's since.
    """

    __tablename__ = "results"
    __table_args__ = (UniqueConstraint("trial_id", "version"),)

    id: Mapped[int] = mapped_column(primary_key=True)
    trial_id: Mapped[str] = mapped_column(ForeignKey("trials.id", ondelete="CASCADE"))
    version: Mapped[int]
    created_at: Mapped[datetime]
    document_sha256: Mapped[str]
    liftlens_version: Mapped[str] = mapped_column(default="")
    backend: Mapped[str] = mapped_column(default="")
    solver: Mapped[str] = mapped_column(default="")
    label: Mapped[str] = mapped_column(default="")
    site: Mapped[str] = mapped_column(default="")
    job: Mapped[str] = mapped_column(default="")
    person: Mapped[str] = mapped_column(default="")
    worst_level: Mapped[str | None] = mapped_column(index=True)
    li: Mapped[float | None]
    li_low: Mapped[float | None]
    li_high: Mapped[float | None]
    category: Mapped[str] = mapped_column(default="")
    duration_s: Mapped[float | None]
    n_lifts: Mapped[int] = mapped_column(default=0)
    n_high: Mapped[int] = mapped_column(default=0)
    n_review: Mapped[int] = mapped_column(default=0)
    n_ok: Mapped[int] = mapped_column(default=0)


class Assessment(Base):
    """What one risk method says of one version of a result."""

    __tablename__ = "assessments"
    __table_args__ = (UniqueConstraint("result_id", "method"),)

    id: Mapped[int] = mapped_column(primary_key=True)
    result_id: Mapped[int] = mapped_column(ForeignKey("results.id", ondelete="CASCADE"))
    method: Mapped[str]
    value: Mapped[float | None]
    low: Mapped[float | None]
    high: Mapped[float | None]
    category: Mapped[str] = mapped_column(default="")
    is_applicable: Mapped[bool] = mapped_column(default=True)


class Artefact(Base):
    """A file kept once under the hash of its content, however many trials it belongs to."""

    __tablename__ = "artefacts"

    sha256: Mapped[str] = mapped_column(primary_key=True)
    size: Mapped[int] = mapped_column(BigInteger)
    kind: Mapped[str]
    path: Mapped[str]
    created_at: Mapped[datetime]


class Attachment(Base):
    """A file that belongs to a trial beside its result: a calibration, an original, a paper."""

    __tablename__ = "attachments"
    __table_args__ = (UniqueConstraint("trial_id", "role", "name"),)

    id: Mapped[int] = mapped_column(primary_key=True)
    trial_id: Mapped[str] = mapped_column(ForeignKey("trials.id", ondelete="CASCADE"))
    sha256: Mapped[str] = mapped_column(ForeignKey("artefacts.sha256"), index=True)
    role: Mapped[str]
    name: Mapped[str]
    created_at: Mapped[datetime]


class Reference(Base):
    """A performance that attempts are compared with: one lift of a trial, under a name."""

    __tablename__ = "references"

    id: Mapped[int] = mapped_column(primary_key=True)
    name: Mapped[str] = mapped_column(unique=True)
    trial_id: Mapped[str] = mapped_column(ForeignKey("trials.id", ondelete="CASCADE"), index=True)
    lift_index: Mapped[int | None]
    notes: Mapped[str] = mapped_column(default="")
    created_at: Mapped[datetime]


class Tag(Base):
    """A word people sort trials by."""

    __tablename__ = "tags"

    id: Mapped[int] = mapped_column(primary_key=True)
    name: Mapped[str] = mapped_column(unique=True)


class TrialTag(Base):
    """Which trial has which tag."""

    __tablename__ = "trial_tags"

    trial_id: Mapped[str] = mapped_column(
        ForeignKey("trials.id", ondelete="CASCADE"), primary_key=True
    )
    tag_id: Mapped[int] = mapped_column(
        ForeignKey("tags.id", ondelete="CASCADE"), primary_key=True, index=True
    )


class Note(Base):
    """What somebody wrote about a trial; `at_s` is a moment of the video, if it is about one."""

    __tablename__ = "notes"

    id: Mapped[int] = mapped_column(primary_key=True)
    trial_id: Mapped[str] = mapped_column(ForeignKey("trials.id", ondelete="CASCADE"), index=True)
    author: Mapped[str] = mapped_column(default="")
    text: Mapped[str]
    at_s: Mapped[float | None]
    created_at: Mapped[datetime]


class Review(Base):
    """Who accepted or rejected which flag, why and when; never changed, only followed by more."""

    __tablename__ = "reviews"

    id: Mapped[int] = mapped_column(primary_key=True)
    trial_id: Mapped[str] = mapped_column(ForeignKey("trials.id", ondelete="CASCADE"), index=True)
    result_version: Mapped[int]
    flag: Mapped[str]
    verdict: Mapped[str]
    reason: Mapped[str] = mapped_column(default="")
    reviewer: Mapped[str] = mapped_column(default="")
    created_at: Mapped[datetime]


class QueuedJob(Base):
    """One assessment that waits, runs or has ended; its videos and log lie in `jobs/<id>`.

    `host` and `pid` name the worker; `heartbeat_at` is its last sign of life.
    """

    __tablename__ = "queue"
    __table_args__ = (Index("ix_queue_state_priority_id", "state", "priority", "id"),)

    id: Mapped[str] = mapped_column(primary_key=True)
    request: Mapped[str]
    label: Mapped[str] = mapped_column(default="")
    person: Mapped[str] = mapped_column(default="", index=True)
    priority: Mapped[int] = mapped_column(default=0)
    state: Mapped[str]
    stage: Mapped[str] = mapped_column(default="")
    done: Mapped[int] = mapped_column(default=0)
    total: Mapped[int] = mapped_column(default=0)
    fraction: Mapped[float] = mapped_column(default=0.0)
    message: Mapped[str] = mapped_column(default="")
    exit_code: Mapped[int | None]
    trial_id: Mapped[str | None]
    attempts: Mapped[int] = mapped_column(default=0)
    host: Mapped[str] = mapped_column(default="")
    pid: Mapped[int | None]
    heartbeat_at: Mapped[datetime | None]
    submitted_at: Mapped[datetime]
    started_at: Mapped[datetime | None]
    ended_at: Mapped[datetime | None]
    cancel_requested_at: Mapped[datetime | None]
