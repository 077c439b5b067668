"""The queue in the library: order, second tries, interruptions, older and busy libraries."""

from __future__ import annotations

import dataclasses
import json
import os
import signal
import sqlite3
import time
from pathlib import Path
from typing import Any

import pytest

import engine.jobs.local as local
from engine.datatypes import Subject
from engine.errors import Cancelled, ConfigError, OutputError
from engine.jobs import worker
from engine.jobs.local import JobQueue, JobRequest, JobState
from engine.jobs.store import JobStore
from engine.storage.database import connection
from engine.storage.database.failures import DatabaseUnavailable
from engine.storage.library import Library
from engine.storage.results import write_result
from tests.builders import make_trial_result
from tests.engine.jobs.conftest import COMMAND, wait_until


def ask(folder: Path, words: str = "", label: str = "lift") -> JobRequest:
    video = folder / f"{label}.mp4"
    video.write_text(words)
    return JobRequest(videos=(video,), label=label, subject=Subject(label="P01"))


def wait_for(queue: JobQueue, job_id: str, state: JobState) -> Any:
    wait_until(lambda: queue.read(job_id).state is state)
    return queue.read(job_id)


@pytest.fixture
def idle(queue: JobQueue, monkeypatch: pytest.MonkeyPatch) -> JobQueue:
    """A queue that starts nothing by itself."""
    monkeypatch.setattr(JobQueue, "_start", lambda *_: None)
    return queue


def test_a_job_runs_alike_on_both_databases(any_queue: JobQueue, tmp_path: Path) -> None:
    label = "../Kiste 📦 \\ ‘a’"
    good = any_queue.submit(dataclasses.replace(ask(tmp_path), label=label))
    bad = any_queue.submit(ask(tmp_path, "fail", "bad"))
    assert wait_for(any_queue, good, JobState.DONE).trial_id == good
    assert "film the whole body" in wait_for(any_queue, bad, JobState.FAILED).message
    assert [(e.id, e.label) for e in any_queue.library.entries()] == [(good, label)]
    status = any_queue.read(good)
    assert (status.attempts, status.fraction, status.exit_code) == (1, 1.0, 0)
    assert 0 <= status.submitted_s - time.time() + 60 <= 60


def test_a_higher_priority_goes_first_then_who_came_first(idle: JobQueue, tmp_path: Path) -> None:
    a, b, c, d = (
        idle.store.add(name, ask(tmp_path, label=name), priority=priority) or name
        for name, priority in (("a", 0), ("b", 0), ("c", 5), ("d", 5))
    )
    assert [job.id for job in idle.store.unfinished()] == [c, d, a, b]
    assert {job.id: job.jobs_ahead for job in idle.store.all()} == {a: 2, b: 3, c: 0, d: 1}
    assert idle.store.read(b).jobs_ahead == 3
    assert [job.id for _ in range(4) if (job := idle.store.claim_next(9))] == [c, d, a, b]


def test_only_as_many_are_claimed_as_there_are_workers(idle: JobQueue, tmp_path: Path) -> None:
    for name in "abc":
        idle.store.add(name, ask(tmp_path, label=name))
    claimed = [idle.store.claim_next(2) for _ in range(3)]
    assert [job.id if job else None for job in claimed] == ["a", "b", None]


def test_a_failed_job_can_be_tried_again(queue: JobQueue, tmp_path: Path) -> None:
    request = ask(tmp_path, "fail")
    job_id = queue.submit(request)
    wait_for(queue, job_id, JobState.FAILED)
    request.videos[0].write_text("")
    queue.retry(job_id)
    status = wait_for(queue, job_id, JobState.DONE)
    assert (status.message, status.exit_code) == ("", 0)
    with pytest.raises(ConfigError, match="nothing to repeat"):
        queue.retry(job_id)


def test_a_second_try_needs_its_video(idle: JobQueue, tmp_path: Path) -> None:
    request = ask(tmp_path)
    idle.store.add("a", request, state=JobState.FAILED)
    request.videos[0].unlink()
    with pytest.raises(ConfigError, match="not there any more"):
        idle.retry("a")
    assert idle.store.read("a").state is JobState.FAILED


def test_finished_work_is_not_done_twice(idle: JobQueue, tmp_path: Path) -> None:
    """A worker was killed after it wrote the result, before or after it was moved."""
    for is_moved in (False, True):
        job_id = idle.submit(ask(tmp_path))
        result = write_result(make_trial_result(n_frames=2), idle.root / job_id / "result")
        if is_moved:
            idle.library.adopt(result, job_id)
        idle.store.requeue(job_id, expected=tuple(JobState))
        assert worker.main([str(idle.root / job_id)], assess=_never, command=COMMAND) == 0
        assert idle.store.read(job_id).state is JobState.DONE
        assert idle.library.has(job_id)


def _never(*_: object) -> Path:
    raise AssertionError("the work was done already")


def test_a_job_that_vanished_or_was_taken_away_stops(idle: JobQueue, tmp_path: Path) -> None:
    """Its trial was deleted, or another computer believed this one dead."""
    changes: dict[str, Any] = {
        "removed": idle.store.remove,
        "given to another": lambda i: idle.store.change(i, expected=tuple(JobState), pid=1),
    }
    for change in changes.values():
        job_id = idle.submit(ask(tmp_path))

        def assess(*given: Any, job_id: str = job_id, change: Any = change) -> Path:
            change(job_id)
            given[3]("pose", 1, 2)
            raise AssertionError("nobody wants this any more")

        code = worker.main([str(idle.root / job_id)], assess=assess, command=COMMAND)
        assert code == Cancelled.exit_code
        assert not idle.library.has(job_id)


def test_a_busy_database_does_not_cost_the_work(
    idle: JobQueue, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    job_id = idle.submit(ask(tmp_path))
    change, refused = JobStore.change, []

    def busy(store: JobStore, *given: Any, **values: Any) -> bool:
        if values.get("stage") == "pose" or (values.get("state") == "done" and len(refused) < 3):
            refused.append(values)
            raise DatabaseUnavailable("busy")
        return change(store, *given, **values)

    monkeypatch.setattr(JobStore, "change", busy)
    monkeypatch.setattr(worker.time, "sleep", lambda _s: None)

    def assess(*given: Any) -> Path:
        given[3]("pose", 1, 2)
        return write_result(make_trial_result(n_frames=2), given[2])

    assert worker.main([str(idle.root / job_id)], assess=assess, command=COMMAND) == 0
    assert len(refused) == 3
    assert idle.store.read(job_id).state is JobState.DONE


def test_a_silent_worker_of_another_computer_is_given_up(
    any_queue: JobQueue, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(JobQueue, "_start", lambda *_: None)
    store, now = any_queue.store, time.time()
    far = {"state": JobState.RUNNING, "host": "elsewhere", "pid": 1, "started_s": now - 9999}
    store.add("dead", ask(tmp_path), **far, attempts=1, heartbeat_s=now - 9999)
    store.add("alive", ask(tmp_path), **far, attempts=1, heartbeat_s=now)
    store.add("again", ask(tmp_path), **far, attempts=2, heartbeat_s=now - 9999)
    states = {job.id: job.state for job in any_queue.jobs()}
    assert states["again"] is JobState.FAILED
    assert states["dead"] in (JobState.QUEUED, JobState.STARTING)
    if any_queue.library.database.is_sqlite:  # its lock tells: a computer that was renamed
        assert states["alive"] in (JobState.QUEUED, JobState.STARTING)
    else:
        assert states["alive"] is JobState.RUNNING
    for job in any_queue.jobs():
        store.remove(job.id)


def test_two_uploads_of_one_name_at_once(queue: JobQueue) -> None:
    videos = []
    for number in range(2):
        videos.append(queue.library.upload_folder(f"u{number}") / "clip.mp4")
        videos[-1].write_text("slow" if number else "")
    ids = [
        queue.submit(JobRequest(videos=(video,), label=str(n))) for n, video in enumerate(videos)
    ]
    assert [queue.request(i).videos[0].read_text() for i in ids] == ["", "slow"]
    assert not any(video.parent.exists() for video in videos)


def test_an_upload_stays_where_it_was_if_the_library_takes_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(connection, "BUSY_TIMEOUT_S", 0.05)
    queue = JobQueue(Library(tmp_path / "home"), command=COMMAND)
    video = queue.library.upload_folder("u") / "clip 📦.mp4"
    video.write_text("")
    other = sqlite3.connect(queue.library.root / "library.db", isolation_level=None)
    other.execute("BEGIN IMMEDIATE")
    with pytest.raises(OutputError, match="another program is holding it"):
        queue.submit(JobRequest(videos=(video,)))
    other.close()
    assert video.read_text() == ""
    assert list(queue.root.iterdir()) == []


class TestOlderLibraries:
    def make(self, queue: JobQueue, name: str, state: dict[str, Any] | None) -> Path:
        """Make a job's folder as an older program left it."""
        folder = queue.root / name
        folder.mkdir()
        video = queue.library.root / f"{name}.mp4"
        video.write_text("")
        plain = json.loads(JobRequest(videos=(video,), label=name).as_json())
        del plain["version"]
        (folder / "request.json").write_text(json.dumps(plain))
        if state is not None:
            (folder / "state.json").write_text(json.dumps({"id": name, **state}))
        return folder

    def test_their_jobs_are_taken_over(self, idle: JobQueue) -> None:
        now = time.time()
        over = {"state": "failed", "message": "No person.", "exit_code": 3, "ended_s": now}
        self.make(idle, "failed", over)
        self.make(idle, "running", {"state": "running", "pid": 1, "started_s": now, "done": 5})
        self.make(idle, "waiting", None)
        (self.make(idle, "unwanted", None) / "cancel").touch()
        (idle.root / "nonsense").mkdir()
        (idle.root / "nonsense" / "request.json").write_text("{")
        jobs = {job.id: job for job in idle.jobs()}
        assert {i: str(j.state) for i, j in jobs.items()} == {
            "failed": "failed",
            "running": "starting",
            "unwanted": "cancelled",
            "waiting": "queued",
        }
        assert (jobs["failed"].message, jobs["failed"].exit_code) == ("No person.", 3)
        assert idle.request("waiting").label == "waiting"
        assert not list(idle.root.glob("*/state.json"))
        assert [p.parent.name for p in idle.root.glob("*/request.json")] == ["nonsense"]

    def test_what_a_killed_submission_left_goes_after_a_while(self, idle: JobQueue) -> None:
        for name in ("old", "new"):
            (idle.root / name / "videos").mkdir(parents=True)
        os.utime(idle.root / "old", (1, 1))
        idle.advance()
        assert [p.name for p in idle.root.iterdir()] == ["new"]


def test_a_request_of_a_newer_program_is_refused(tmp_path: Path) -> None:
    plain = json.loads(ask(tmp_path).as_json())
    assert JobRequest.from_json(json.dumps(plain)).label == "lift"
    plain["version"] += 1
    with pytest.raises(ConfigError, match="newer LiftLens"):
        JobRequest.from_json(json.dumps(plain))


def test_a_restart_of_the_computer_goes_on_by_itself(
    queue: JobQueue, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Workers die with everything else; the next look at the queue starts them again."""
    request = ask(tmp_path, "slow")
    job_id = queue.submit(request)
    wait_until(lambda: queue.read(job_id).stage == "pose")
    pid = queue.read(job_id).pid
    assert pid is not None
    request.videos[0].write_text("")
    os.kill(pid, signal.SIGKILL)
    with monkeypatch.context() as patch:
        patch.setattr(local, "_children", {})
        again = JobQueue(Library(queue.library.root), max_workers=1, command=COMMAND)
        assert wait_for(again, job_id, JobState.DONE).attempts == 2
        for child in local._children.values():
            child.wait(60)
    assert queue.library.has(job_id)
