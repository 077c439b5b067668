"""Queues on both kinds of database, whose workers are real processes without a model."""

from __future__ import annotations

import os
import signal
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

import engine.jobs.local as local
from engine.jobs.local import JobQueue
from engine.jobs.store import HOST, JobState
from engine.storage.database.connection import URL_VARIABLE, close_databases
from engine.storage.library import Library
from tests.postgres import Server, postgres  # noqa: F401 - a fixture

COMMAND = (sys.executable, str(Path(__file__).with_name("fake_worker.py")))


@pytest.fixture(autouse=True)
def _environment(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Let workers find the tests, and keep them off a database somebody set."""
    monkeypatch.setenv("PYTHONPATH", str(Path(__file__).parents[3]))
    monkeypatch.delenv(URL_VARIABLE, raising=False)
    yield
    close_databases()


@pytest.fixture
def queue(tmp_path: Path) -> Iterator[JobQueue]:
    """A queue of one worker on an own library."""
    made = JobQueue(Library(tmp_path / "home"), max_workers=1, command=COMMAND)
    yield made
    stop_all(made)


@pytest.fixture(params=["sqlite", "postgres"])
def any_queue(
    request: pytest.FixtureRequest, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> Iterator[JobQueue]:
    """A queue of one worker, on SQLite and on PostgreSQL."""
    if request.param == "postgres":
        server: Server = request.getfixturevalue("postgres")
        monkeypatch.setenv(URL_VARIABLE, server.url(server.make_database()))
    made = JobQueue(Library(tmp_path / "home"), max_workers=1, command=COMMAND)
    yield made
    stop_all(made)


def stop_all(queue: JobQueue) -> None:
    """End every job and its worker."""
    for job in queue.store.unfinished():
        if job.pid and job.host == HOST:
            queue.cancel(job.id)
            os.kill(job.pid, signal.SIGKILL)
        elif job.state is JobState.QUEUED or queue.root / job.id not in local._children:
            queue.store.remove(job.id)
        else:
            queue.cancel(job.id)
    wait_until(lambda: all(job.state.is_over for job in queue.jobs()))
    for child in (*local._children.values(), *local._leaving):
        child.wait(60)


def wait_until(condition: Callable[[], bool], timeout_s: float = 90.0) -> None:
    """Look again and again until a condition holds."""
    end_s = time.monotonic() + timeout_s
    while not condition():
        assert time.monotonic() < end_s, "waited too long"
        time.sleep(0.02)
