"""The library in numbers: lifts by level, site, job and month, for who decides what to change."""

from __future__ import annotations

import math
from dataclasses import dataclass
from datetime import datetime
from typing import Any

from sqlalchemy import Select, extract, func, select
from sqlalchemy.orm import Session

from engine.storage.database.models import Job, Result, Site, Trial, TrialState
from engine.storage.entries import Filters, join_current

__all__ = ["LiftCounts", "MonthOverview", "Overview", "PlaceOverview", "read_overview"]

Z_95 = 1.959964


@dataclass(frozen=True)
class LiftCounts:
    """Trials and their lifts by the most urgent flag; `n_lifts` has those no flag speaks of too."""

    n_trials: int = 0
    n_lifts: int = 0
    n_high: int = 0
    n_review: int = 0
    n_ok: int = 0

    @property
    def n_unjudged(self) -> int:
        """Lifts that no flag speaks of."""
        return self.n_lifts - self.n_high - self.n_review - self.n_ok

    @property
    def share_high(self) -> float:
        """Share of high-risk lifts among the judged ones, 0 to 1; NaN without any."""
        judged = self.n_high + self.n_review + self.n_ok
        return self.n_high / judged if judged else math.nan

    @property
    def share_high_interval(self) -> tuple[float, float]:
        """About 95 % interval of `share_high` (Wilson), lifts taken as independent; NaN for none.

        References
        ----------
        .. [1] Wilson (1927), Journal of the American Statistical Association 22(158), 209-212.
        """
        n = self.n_high + self.n_review + self.n_ok
        if not n:
            return math.nan, math.nan
        p, z2 = self.n_high / n, Z_95**2
        middle = (p + z2 / (2 * n)) / (1 + z2 / n)
        half = Z_95 / (1 + z2 / n) * math.sqrt(p * (1 - p) / n + z2 / (4 * n * n))
        return max(0.0, middle - half), min(1.0, middle + half)


@dataclass(frozen=True)
class PlaceOverview:
    """A site (`job` is None then), or a job at a site; an empty name: none was given.

    `worst_li` is the highest lifting index of its trials, None where none has one.
    """

    site: str
    job: str | None
    lifts: LiftCounts
    worst_li: float | None
    latest: datetime


@dataclass(frozen=True)
class MonthOverview:
    """One month (UTC) in which trials were assessed."""

    year: int
    month: int
    lifts: LiftCounts


@dataclass(frozen=True)
class Overview:
    """All of it. `n_damaged` trials are in no other number."""

    lifts: LiftCounts
    n_damaged: int
    sites: tuple[PlaceOverview, ...]
    jobs: tuple[PlaceOverview, ...]
    months: tuple[MonthOverview, ...]

    def worst_jobs(self, limit: int = 5) -> tuple[PlaceOverview, ...]:
        """Return the jobs that most surely have many high-risk lifts.

        Sorted by the lower end of the share's interval, then by the lifting index: one bad lift
        out of one weighs less than nineteen out of twenty. Jobs without a high-risk lift are left
        out.
        """
        found = [place for place in self.jobs if place.lifts.n_high]
        found.sort(key=lambda p: (p.lifts.share_high_interval[0], p.worst_li or 0.0), reverse=True)
        return tuple(found[:limit])


_COUNTS = (
    func.count(Trial.id),
    *(
        func.coalesce(func.sum(column), 0)
        for column in (Result.n_lifts, Result.n_high, Result.n_review, Result.n_ok)
    ),
)


def read_overview(session: Session, filters: Filters) -> Overview:
    """Count all trials that match."""
    is_done = (*filters.conditions(), Trial.state == TrialState.DONE)

    def rows(statement: Select[*tuple[Any, ...]]) -> list[Any]:
        return list(session.execute(join_current(statement).where(*is_done)).all())

    (total,) = rows(select(*_COUNTS))
    year, month = extract("year", Trial.created_at), extract("month", Trial.created_at)
    by_month = rows(select(year, month, *_COUNTS).group_by(year, month).order_by(year, month))
    damaged = join_current(select(func.count())).where(
        *filters.conditions(), Trial.state == TrialState.DAMAGED
    )
    facts = (func.max(Result.li), func.max(Trial.created_at), *_COUNTS)
    sites = rows(select(Site.name, *facts).group_by(Site.name).order_by(Site.name))
    jobs = rows(
        select(Site.name, Job.name, *facts)
        .group_by(Site.name, Job.name)
        .order_by(Site.name, Job.name)
    )
    return Overview(
        lifts=LiftCounts(*map(int, total)),
        n_damaged=session.scalar(damaged) or 0,
        sites=tuple(_place(site, None, *rest) for site, *rest in sites),
        jobs=tuple(_place(site, job, *rest) for site, job, *rest in jobs),
        months=tuple(
            MonthOverview(int(y), int(m), LiftCounts(*map(int, counts)))
            for y, m, *counts in by_month
        ),
    )


def _place(
    site: str, job: str | None, worst_li: float | None, latest: datetime, *counts: int
) -> PlaceOverview:
    return PlaceOverview(site, job, LiftCounts(*map(int, counts)), worst_li, latest)
