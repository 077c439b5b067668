"""The list of trials: searched, filtered, sorted and counted in the database."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field
from datetime import datetime
from pathlib import Path
from typing import Any, Literal, get_args

from sqlalchemy import Row, Select, case, exists, func, or_, select
from sqlalchemy.orm import Session
from sqlalchemy.sql.elements import ColumnElement

from engine.datatypes import FlagLevel
from engine.errors import ConfigError
from engine.storage.database.models import (
    Job,
    Note,
    Person,
    Result,
    Site,
    Tag,
    Trial,
    TrialState,
    TrialTag,
)

__all__ = [
    "Choices",
    "Filters",
    "Order",
    "TrialEntry",
    "TrialPage",
    "count_choices",
    "find_entries",
    "join_current",
]

Order = Literal["newest", "oldest", "label", "level", "index"]
"""How a list is sorted: by time, by name, most urgent first, highest lifting index first."""


@dataclass(frozen=True)
class TrialEntry:
    """One line of the list of trials.

    `created` is an ISO time in UTC. `worst_level` is that of the most urgent flag, None without
    flags. `li` is the lifting index with its interval of about 95 %: None where it does not apply,
    infinite where nothing may be lifted. A `damaged` entry says why in `message`. `version` grows
    with every change a person makes (see `Library.edit`).
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
    tags: tuple[str, ...] = ()
    n_notes: int = 0
    version: int = 1

    @property
    def is_damaged(self) -> bool:
        """Whether the result can't be read."""
        return self.status == "damaged"


@dataclass(frozen=True)
class TrialPage:
    """A part of the list, with what the whole of it holds.

    `total` counts all trials that match; `levels` those of each level as if no level had been
    asked for (None: not judged, or damaged), so that a filter can show what it would give.
    """

    entries: tuple[TrialEntry, ...]
    total: int
    levels: Mapping[FlagLevel | None, int]


@dataclass(frozen=True)
class Choices:
    """What there is to filter by, by name, with the number of trials each."""

    sites: Mapping[str, int]
    jobs: Mapping[str, int]
    people: Mapping[str, int]
    tags: Mapping[str, int]


@dataclass(frozen=True)
class Filters:
    """Which trials are meant; what is None or empty does not narrow.

    `level` is one level or several (None among them: not judged). A trial needs all `tags`.
    `since` counts, `until` does not.
    """

    search: str = ""
    site: str | None = None
    job: str | None = None
    person: str | None = None
    level: FlagLevel | Collection[FlagLevel | None] | None = None
    tags: Sequence[str] = ()
    since: datetime | None = None
    until: datetime | None = None
    ids: Sequence[str] | None = field(default=None)

    def conditions(self, *, with_level: bool = True) -> list[ColumnElement[bool]]:
        """Return what a row must fulfil."""
        found = [Trial.state != TrialState.DELETING]
        found += [Trial.search.contains(w, autoescape=True) for w in _words(self.search)]
        for column, wanted in ((Site.name, self.site), (Job.name, self.job)):
            if wanted is not None:
                found.append(column == wanted)
        if self.person is not None:
            found.append(func.coalesce(Person.pseudonym, "") == self.person)
        if self.since is not None:
            found.append(Trial.created_at >= _with_zone(self.since))
        if self.until is not None:
            found.append(Trial.created_at < _with_zone(self.until))
        if self.ids is not None:
            found.append(Trial.id.in_(self.ids))
        found += [_has_tag(tag) for tag in self.tags]
        if with_level and self.level is not None:
            found.append(_has_level(self.wanted_levels))
        return found

    @property
    def wanted_levels(self) -> frozenset[FlagLevel | None]:
        """The levels asked for; all of them without a choice."""
        if self.level is None:
            return frozenset({*FlagLevel, None})
        return frozenset({self.level} if isinstance(self.level, FlagLevel) else self.level)


def find_entries(
    session: Session,
    trials: Path,
    filters: Filters,
    *,
    order: Order = "newest",
    limit: int | None = None,
    offset: int = 0,
) -> tuple[list[TrialEntry], dict[str, str]]:
    """Return the matching entries, and the stamp of each one's folder when it was recorded."""
    statement = join_current(select(*_COLUMNS)).where(*filters.conditions())
    statement = statement.order_by(*_sorting(order)).limit(limit).offset(offset)
    rows = session.execute(statement).all()
    ids = None if limit is None else [row.id for row in rows]
    tags, notes = _read_tags(session, ids), _count_notes(session, ids)
    entries = [
        _build_entry(row, trials, tuple(tags.get(row.id, ())), notes.get(row.id, 0)) for row in rows
    ]
    return entries, {row.id: row.stamp for row in rows}


def count_levels(session: Session, filters: Filters) -> dict[FlagLevel | None, int]:
    """Return how many matching trials there are of each level, whatever level is asked for."""
    level = case((Trial.state == TrialState.DONE, Result.worst_level))
    statement = _join_asked(select(level, func.count()), filters)
    rows = session.execute(statement.where(*filters.conditions(with_level=False)).group_by(level))
    return {None if name is None else FlagLevel(name): count for name, count in rows}


def is_any(session: Session) -> bool:
    """Whether there is any trial."""
    statement = select(Trial.id).where(*Filters().conditions()).limit(1)
    return session.scalar(statement) is not None


def count_choices(session: Session) -> Choices:
    """Return what there is to filter by."""
    is_there = Trial.state != TrialState.DELETING

    def count(column: Any, statement: Select[*tuple[Any, ...]]) -> dict[str, int]:
        rows = session.execute(statement.where(is_there, column != "").group_by(column))
        return {str(name): int(number) for name, number in sorted(tuple(row) for row in rows)}

    counted = func.count(Trial.id)
    return Choices(
        sites=count(Site.name, join_current(select(Site.name, counted))),
        jobs=count(Job.name, join_current(select(Job.name, counted))),
        people=count(Person.pseudonym, join_current(select(Person.pseudonym, counted))),
        tags=count(Tag.name, select(Tag.name, counted).select_from(Trial).join(TrialTag).join(Tag)),
    )


def join_current(statement: Select[*tuple[Any, ...]]) -> Select[*tuple[Any, ...]]:
    """Join a trial with its place, its person and the newest version of its result."""
    return (
        statement.select_from(Trial)
        .join(Job, Trial.job_id == Job.id)
        .join(Site, Job.site_id == Site.id)
        .outerjoin(Person, Trial.person_id == Person.id)
        .outerjoin(Result, (Result.trial_id == Trial.id) & (Result.version == Trial.result_version))
    )


def _join_asked(statement: Select[*tuple[Any, ...]], filters: Filters) -> Select[*tuple[Any, ...]]:
    """Join a trial with its result, and else only with what is asked for: counts look at all."""
    current = (Result.trial_id == Trial.id) & (Result.version == Trial.result_version)
    statement = statement.select_from(Trial).outerjoin(Result, current)
    if filters.site is not None or filters.job is not None:
        statement = statement.join(Job, Trial.job_id == Job.id).join(Site, Job.site_id == Site.id)
    if filters.person is not None:
        statement = statement.outerjoin(Person, Trial.person_id == Person.id)
    return statement


# --------------------------------------------------------------------------- conditions


def _words(search: str) -> list[str]:
    return search.replace("\0", "").casefold().split()


def _with_zone(moment: datetime) -> datetime:
    if moment.tzinfo is None:
        raise ConfigError(
            f"A filter by time needs times with their zone, got {moment.isoformat()}; add it, for "
            "example datetime.now(UTC)."
        )
    return moment


def _has_tag(name: str) -> ColumnElement[bool]:
    return (
        exists()
        .where(TrialTag.trial_id == Trial.id, TrialTag.tag_id == Tag.id, Tag.name == name)
        .correlate(Trial)
    )


def _has_level(wanted: Collection[FlagLevel | None]) -> ColumnElement[bool]:
    named = (Trial.state == TrialState.DONE) & Result.worst_level.in_(
        [one.value for one in wanted if one is not None]
    )
    if None not in wanted:
        return named
    return or_(named, Result.worst_level.is_(None), Trial.state == TrialState.DAMAGED)


_URGENCY = case(
    *(
        (Result.worst_level == level.value, rank)
        for rank, level in enumerate((FlagLevel.HIGH, FlagLevel.REVIEW, FlagLevel.OK))
    ),
    else_=3,
)


def _sorting(order: Order) -> list[ColumnElement[Any]]:
    newest: list[ColumnElement[Any]] = [Trial.created_at.desc(), Trial.id.desc()]
    choices: dict[str, list[ColumnElement[Any]]] = {
        "newest": newest,
        "oldest": [Trial.created_at.asc(), Trial.id.asc()],
        "label": [func.lower(Trial.label), *newest],
        "level": [_URGENCY, *newest],
        "index": [Result.li.is_(None), Result.li.desc(), *newest],
    }
    if order not in choices:
        raise ConfigError(f"Trials are sorted by {', '.join(get_args(Order))}, not by {order!r}.")
    return choices[order]


# --------------------------------------------------------------------------- entries


_COLUMNS = (
    *(getattr(Trial, name) for name in (
        "id", "state", "message", "label", "created_at", "version", "thumbnail", "stamp"
    )),
    *(getattr(Result, name) for name in (
        "worst_level", "li", "li_low", "li_high", "category", "n_lifts", "duration_s"
    )),
    Job.name.label("job"),
    Site.name.label("site"),
    Person.pseudonym,
)  # fmt: skip
"""Columns, not whole rows: building an object for each of ten thousand takes a second."""


def _build_entry(
    row: Row[*tuple[Any, ...]], trials: Path, tags: tuple[str, ...], n_notes: int
) -> TrialEntry:
    common: dict[str, Any] = {
        "id": row.id,
        "label": row.label,
        "created": row.created_at.isoformat(timespec="seconds"),
        "subject": row.pseudonym or "",
        "site": row.site,
        "job": row.job,
        "tags": tags,
        "n_notes": n_notes,
        "version": row.version,
    }
    if row.state != TrialState.DONE or row.category is None:
        return TrialEntry(status="damaged", message=row.message, **common)
    return TrialEntry(
        status="done",
        worst_level=None if row.worst_level is None else FlagLevel(row.worst_level),
        li=row.li,
        li_interval=(row.li_low, row.li_high),
        category=row.category,
        n_lifts=row.n_lifts,
        duration_s=row.duration_s,
        thumbnail_path=trials / row.id / row.thumbnail if row.thumbnail else None,
        **common,
    )


def _read_tags(session: Session, ids: Sequence[str] | None) -> dict[str, list[str]]:
    statement = select(TrialTag.trial_id, Tag.name).join(Tag).order_by(Tag.name)
    if ids is not None:
        statement = statement.where(TrialTag.trial_id.in_(ids))
    found: dict[str, list[str]] = {}
    for trial_id, name in session.execute(statement):
        found.setdefault(trial_id, []).append(name)
    return found


def _count_notes(session: Session, ids: Sequence[str] | None) -> dict[str, int]:
    statement = select(Note.trial_id, func.count()).group_by(Note.trial_id)
    if ids is not None:
        statement = statement.where(Note.trial_id.in_(ids))
    return {str(trial_id): int(number) for trial_id, number in session.execute(statement)}
