"""The rows of the queue: what is known about every job, for all processes that look at it."""

from __future__ import annotations

import platform
import time
from collections.abc import Collection
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from enum import StrEnum
from typing import Any

from sqlalchemy import delete, func, or_, select, update
from sqlalchemy.orm import Session

from engine.errors import ConfigError
from engine.jobs.request import JobRequest
from engine.storage.database.models import QueuedJob
from engine.storage.library import Library
from engine.storage.summary import clean_text

__all__ = ["HOST", "JobState", "JobStatus", "JobStore"]

HOST = platform.node()
"""The name of this computer: several may work on one library."""


class JobState(StrEnum):
    """Where a job stands."""

    QUEUED = "queued"
    STARTING = "starting"
    RUNNING = "running"
    DONE = "done"
    FAILED = "failed"
    CANCELLED = "cancelled"

    @property
    def is_over(self) -> bool:
        """Whether nothing more will happen."""
        return self in OVER


OVER = (JobState.DONE, JobState.FAILED, JobState.CANCELLED)
AT_WORK = (JobState.STARTING, JobState.RUNNING)


@dataclass(frozen=True)
class JobStatus:
    """What is known about a job now.

    `stage` is the key of the running step; `done` of `total` units of it are finished (0:
    unknown). `fraction` is that of the whole job, 0 to 1. `message` says why a job
    failed. Times are seconds since 1970. `attempts` counts how often it was started; `pid` and
    `host` say where.
    """

    id: str
    state: JobState = JobState.QUEUED
    label: str = ""
    stage: str = ""
    done: int = 0
    total: int = 0
    fraction: float = 0.0
    message: str = ""
    exit_code: int | None = None
    trial_id: str | None = None
    pid: int | None = None
    submitted_s: float = 0.0
    started_s: float | None = None
    ended_s: float | None = None
    jobs_ahead: int = 0
    priority: int = 0
    attempts: int = 0
    host: str = ""
    heartbeat_s: float | None = None
    cancel_requested_s: float | None = None

    @property
    def elapsed_s(self) -> float:
        """Time since the worker was started; 0 while the job waits."""
        if self.started_s is None:
            return 0.0
        return max(0.0, (self.ended_s or time.time()) - self.started_s)


_TIMES = ("submitted", "started", "ended", "heartbeat", "cancel_requested")
_PLAIN = (
    "id", "label", "stage", "done", "total", "fraction", "message", "exit_code", "trial_id", "pid",
    "priority", "attempts", "host",
)  # fmt: skip
_ORDER = (QueuedJob.priority.desc(), QueuedJob.id)
_FRESH: dict[str, Any] = {
    "state": JobState.QUEUED,
    "stage": "",
    "done": 0,
    "total": 0,
    "fraction": 0.0,
    "message": "",
    "exit_code": None,
    "pid": None,
    "host": "",
    "started_s": None,
    "ended_s": None,
    "heartbeat_s": None,
    "cancel_requested_s": None,
}
"""What a job that waits (again) says."""


class JobStore:
    """The queue in a library's database.

    Parameters
    ----------
    library
        Whose queue.
    """

    def __init__(self, library: Library) -> None:
        self.database = library.database

    def add(self, job_id: str, request: JobRequest, *, priority: int = 0, **known: Any) -> None:
        """Put a job into the queue; `known` are fields of a status it has already."""
        # A trial that is assessed anew is known from the start, a new one once it is there.
        renewed = {"trial_id": request.trial_id} if request.trial_id else {}
        values = {"submitted_s": time.time(), **renewed, **known}
        with self.database.writing() as session:
            session.add(
                QueuedJob(
                    id=job_id,
                    request=clean_text(request.as_json()),
                    label=clean_text(request.label),
                    person=clean_text(request.subject.label),
                    priority=priority,
                    **_to_row({"state": JobState.QUEUED, **values}),
                )
            )

    def has(self, job_id: str) -> bool:
        """Whether there is a job of that id."""
        with self.database.reading() as session:
            return session.get(QueuedJob, job_id) is not None

    def ids(self) -> set[str]:
        """Return the ids of all jobs."""
        with self.database.reading() as session:
            return set(session.scalars(select(QueuedJob.id)))

    def read(self, job_id: str) -> JobStatus:
        """Return where a job stands.

        Raises
        ------
        ConfigError
            If there is no such job.
        """
        with self.database.reading() as session:
            row = _require(session, job_id)
            status = _to_status(row)
            if status.state is not JobState.QUEUED:
                return status
            ahead = select(func.count()).where(
                QueuedJob.state.not_in(OVER),
                or_(
                    QueuedJob.priority > row.priority,
                    (QueuedJob.priority == row.priority) & (QueuedJob.id < row.id),
                ),
            )
            return replace(status, jobs_ahead=session.scalar(ahead) or 0)

    def request(self, job_id: str) -> JobRequest:
        """Return what a job was asked to do."""
        with self.database.reading() as session:
            return JobRequest.from_json(_require(session, job_id).request)

    def all(self) -> tuple[JobStatus, ...]:
        """Return all jobs, oldest first."""
        with self.database.reading() as session:
            rows = session.scalars(select(QueuedJob).order_by(QueuedJob.id))
            found = [_to_status(row) for row in rows]
        waiting = sorted(
            (job for job in found if not job.state.is_over), key=lambda j: (-j.priority, j.id)
        )
        ahead = {job.id: number for number, job in enumerate(waiting)}
        return tuple(
            replace(job, jobs_ahead=ahead[job.id]) if job.state is JobState.QUEUED else job
            for job in found
        )

    def of_trial(self, trial_id: str) -> tuple[JobStatus, ...]:
        """Return the jobs that assess a trial of the library anew, oldest first."""
        statement = select(QueuedJob).where(
            QueuedJob.trial_id == trial_id, QueuedJob.id != trial_id
        )
        with self.database.reading() as session:
            return tuple(map(_to_status, session.scalars(statement.order_by(QueuedJob.id))))

    def renewed_trials(self) -> dict[str, str]:
        """Return which trial each job assessed anew that is over."""
        statement = select(QueuedJob.id, QueuedJob.trial_id).where(
            QueuedJob.trial_id != QueuedJob.id, QueuedJob.state.in_(OVER)
        )
        with self.database.reading() as session:
            return {str(job): str(trial) for job, trial in session.execute(statement)}

    def unfinished(self) -> tuple[JobStatus, ...]:
        """Return the jobs that wait or run, in the order they are started."""
        with self.database.reading() as session:
            rows = session.scalars(
                select(QueuedJob).where(QueuedJob.state.not_in(OVER)).order_by(*_ORDER)
            )
            return tuple(map(_to_status, rows))

    def ended_before(self, limit_s: float) -> list[str]:
        """Return the jobs that ended before a time."""
        limit = datetime.fromtimestamp(limit_s, UTC)
        with self.database.reading() as session:
            return list(
                session.scalars(
                    select(QueuedJob.id).where(
                        QueuedJob.state.in_(OVER), QueuedJob.ended_at < limit
                    )
                )
            )

    def claim_next(self, max_workers: int) -> JobStatus | None:
        """Take the next job that waits, if this computer has a worker free."""
        with self.database.writing() as session:
            running = session.scalar(
                select(func.count()).where(
                    QueuedJob.state.in_(AT_WORK), QueuedJob.host.in_(("", HOST))
                )
            )
            if (running or 0) >= max_workers:
                return None
            row = session.scalars(
                select(QueuedJob)
                .where(QueuedJob.state == JobState.QUEUED, QueuedJob.cancel_requested_at.is_(None))
                .order_by(*_ORDER)
                .limit(1)
            ).first()
            if row is None:
                return None
            row.state, row.host = JobState.STARTING.value, HOST
            row.started_at, row.attempts = datetime.now(UTC), row.attempts + 1
            return _to_status(row)

    def change(
        self,
        job_id: str,
        *,
        expected: Collection[JobState],
        owner: int | None = None,
        **values: Any,
    ) -> bool:
        """Change fields of a job if it is still in an `expected` state.

        Parameters
        ----------
        expected
            The states it may be in.
        owner
            The process on this computer it must belong to; anybody if None.
        values
            The new fields, named as in `JobStatus`.

        Returns
        -------
        bool
            Whether it was; a job that somebody else ended meanwhile stays as it is.
        """
        condition = [QueuedJob.id == job_id, QueuedJob.state.in_(expected)]
        if owner is not None:
            condition += [QueuedJob.pid == owner, QueuedJob.host == HOST]
        with self.database.writing() as session:
            is_there = session.scalar(select(QueuedJob.id).where(*condition)) is not None
            session.execute(update(QueuedJob).where(*condition).values(**_to_row(values)))
            return is_there

    def requeue(self, job_id: str, *, expected: Collection[JobState], **values: Any) -> bool:
        """Let a job wait again as if it never ran; whether it was in an `expected` state."""
        return self.change(job_id, expected=expected, **{**_FRESH, **values})

    def remove(self, job_id: str) -> None:
        """Forget a job."""
        with self.database.writing() as session:
            session.execute(delete(QueuedJob).where(QueuedJob.id == job_id))


def _require(session: Session, job_id: str) -> QueuedJob:
    row = session.get(QueuedJob, job_id)
    if row is None:
        raise ConfigError(f"There is no job {job_id!r}; it may have been cleared.")
    return row


def _to_status(row: QueuedJob) -> JobStatus:
    values = {name: getattr(row, name) for name in _PLAIN}
    for name in _TIMES:
        moment = getattr(row, f"{name}_at")
        values[f"{name}_s"] = None if moment is None else moment.timestamp()
    return JobStatus(state=JobState(row.state), **values)


def _to_row(values: dict[str, Any]) -> dict[str, Any]:
    """Return fields of a status as columns."""
    row: dict[str, Any] = {}
    for name, value in values.items():
        if name.endswith("_s") and name.removesuffix("_s") in _TIMES:
            moment = None if value is None else datetime.fromtimestamp(value, UTC)
            row[f"{name.removesuffix('_s')}_at"] = moment
        else:
            row[name] = clean_text(value) if isinstance(value, str) else value
    return row
