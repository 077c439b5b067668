"""Assessments in worker processes of this computer, with all state on disk.

A job is a folder below the library's `jobs`::

    request.json   what to do (`JobRequest`), written before the folder gets its name
    videos/        the uploaded videos, until the job has succeeded
    state.json     what the worker last said; missing while the job waits
    alive.lock     locked by the worker for as long as it lives
    cancel         exists once somebody asked to stop
    worker.log     what the worker wrote to stderr

So every page, tab and process sees the same, and a restart of the dashboard changes nothing.
"""

from __future__ import annotations

import contextlib
import json
import logging
import os
import shutil
import signal
import subprocess
import sys
import time
from dataclasses import asdict, dataclass, replace
from enum import StrEnum
from pathlib import Path
from typing import Any

from engine.errors import ConfigError, EngineError
from engine.jobs.locks import hold, is_held
from engine.jobs.request import JobRequest
from engine.storage.atomic import explain_os_errors, hidden_sibling
from engine.storage.library import Library

__all__ = ["JobQueue", "JobRequest", "JobState", "JobStatus", "default_workers"]

logger = logging.getLogger(__name__)

WORKER_COMMAND = (sys.executable, "-m", "engine.jobs.worker")
STARTUP_GRACE_S = 30.0
"""How long a new worker may take until it holds its lock."""
CANCEL_GRACE_S = 10.0
"""How long a worker may take to stop by itself before it is killed."""
KEEP_UPLOADS_S = 24 * 3600.0
"""How long a video that was uploaded but never assessed is kept: it shows faces."""
KEEP_JOBS_S = 7 * 24 * 3600.0
"""How long ended jobs are kept; their results stay in the library."""


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
        return self in (JobState.DONE, JobState.FAILED, JobState.CANCELLED)


@dataclass(frozen=True)
class JobStatus:
    """What is known about a job now.

    `stage` is the key of the running step; `done` of `total` units of it are finished (0:
    unknown). `fraction` is that of the whole job, 0 to 1. `message` says why a job
    failed. Times are seconds since 1970.
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

    @property
    def elapsed_s(self) -> float:
        """Time since the worker was started; 0 while the job waits."""
        if self.started_s is None:
            return 0.0
        return max(0.0, (self.ended_s or time.time()) - self.started_s)


def default_workers() -> int:
    """How many assessments run at once by default: one for every two cores."""
    return max(1, (os.cpu_count() or 1) // 2)


class JobQueue:
    """The jobs of one library.

    Parameters
    ----------
    library
        Where jobs, uploads and results live. A job takes over the videos among the uploads and
        deletes them when it has succeeded; other videos are only read.
    max_workers
        How many jobs run at once; None for `default_workers`.
    command
        What starts a worker; the job's folder is added to it.
    """

    def __init__(
        self,
        library: Library,
        *,
        max_workers: int | None = None,
        command: tuple[str, ...] = WORKER_COMMAND,
    ) -> None:
        self.library = library
        self.root = library.jobs
        self.max_workers = max_workers or default_workers()
        self.command = command

    def submit(self, request: JobRequest) -> str:
        """Add a job to the queue and start it if a worker is free; return its id.

        The trial it makes will have the same id.

        Raises
        ------
        ConfigError
            If a video is not there.
        """
        for video in request.videos:
            if not video.is_file():
                raise ConfigError(f"The video {video.name} is not there any more; add it again.")
        folder = self.root / self.library.new_id()
        aside = hidden_sibling(folder)
        with explain_os_errors(folder, "The job"):
            aside.mkdir()
            request = replace(
                request,
                videos=tuple(
                    self._adopt(video, aside, Path("videos", str(number), video.name), folder)
                    for number, video in enumerate(request.videos)
                ),
            )
            (aside / "request.json").write_text(request.as_json(), encoding="utf-8")
            aside.rename(folder)
        self.advance()
        return folder.name

    def read(self, job_id: str) -> JobStatus:
        """Return where a job stands.

        Raises
        ------
        ConfigError
            If there is no such job.
        """
        self.advance()
        return self._read(self._folder(job_id))

    def jobs(self) -> tuple[JobStatus, ...]:
        """Return all jobs, oldest first."""
        self.advance()
        return tuple(self._read(folder) for folder in self._folders())

    def request(self, job_id: str) -> JobRequest:
        """Return what a job was asked to do."""
        path = self._folder(job_id) / "request.json"
        return JobRequest.from_json(path.read_text(encoding="utf-8"))

    def cancel(self, job_id: str) -> None:
        """Ask a job to stop; a waiting one never starts. Ended jobs stay as they are."""
        folder = self._folder(job_id)
        if not self._read(folder).state.is_over:
            (folder / "cancel").touch()
        self.advance()

    def withdraw(self, job_id: str) -> JobRequest:
        """Remove an ended job and return its request, with its uploads back where they were."""
        folder = self._folder(job_id)
        request = self.request(job_id)
        if not self._read(folder).state.is_over:
            raise ConfigError(f"The job {job_id!r} is still at work; cancel it first.")
        request = replace(request, videos=tuple(self._return(v, folder) for v in request.videos))
        _remove(folder)
        return request

    def forget(self, job_id: str) -> None:
        """Remove an ended job, with the uploaded video it still holds."""
        folder = self._folder(job_id)
        if self._read(folder).state.is_over:
            _remove(folder)

    def advance(self) -> None:
        """Bring the state on disk up to date and start waiting jobs where a worker is free."""
        with hold(self.root / ".lock"):
            self._clear_uploads()
            running = 0
            for folder in self._folders():
                status = self._settle(folder)
                if status.state is JobState.QUEUED and running < self.max_workers:
                    status = self._start(folder, status)
                running += status.state in (JobState.STARTING, JobState.RUNNING)
                if status.state.is_over and time.time() - (status.ended_s or 0) > KEEP_JOBS_S:
                    _remove(folder)

    def _clear_uploads(self) -> None:
        for folder in self.library.uploads.iterdir():
            if not folder.name.startswith(".") and _age_s(folder) > KEEP_UPLOADS_S:
                _remove(folder)

    def _folder(self, job_id: str) -> Path:
        folder = self.root / job_id
        if folder not in self._folders():
            raise ConfigError(f"There is no job {job_id!r}; it may have been cleared.")
        return folder

    def _folders(self) -> tuple[Path, ...]:
        visible = (p for p in self.root.iterdir() if not p.name.startswith("."))
        return tuple(sorted(p for p in visible if (p / "request.json").exists()))

    def _adopt(self, video: Path, aside: Path, place: Path, folder: Path) -> Path:
        """Return where the job finds the video: uploads at `place` in its own folder."""
        if self.library.uploads not in video.resolve().parents:
            return video
        (aside / place).parent.mkdir(parents=True)
        shutil.move(video, aside / place)
        with contextlib.suppress(OSError):  # something else lies there too
            video.parent.rmdir()
        return folder / place

    def _return(self, video: Path, folder: Path) -> Path:
        if folder not in video.parents or not video.exists():
            return video
        target = self.library.upload_folder(self.library.new_id()) / video.name
        return Path(shutil.move(video, target))

    def _read(self, folder: Path) -> JobStatus:
        status = read_state(folder)
        if status.state is not JobState.QUEUED:
            return status
        earlier = (read_state(f) for f in self._folders() if f.name < folder.name)
        return replace(status, jobs_ahead=sum(not s.state.is_over for s in earlier))

    def _settle(self, folder: Path) -> JobStatus:
        """Write down what nobody else could: workers that died, cancelled jobs that never ran."""
        status = read_state(folder)
        cancelled = (folder / "cancel").exists()
        if status.state.is_over:
            return status
        if status.state is JobState.QUEUED:
            return _end(folder, status, JobState.CANCELLED) if cancelled else status
        if is_held(folder / "alive.lock"):
            if cancelled and _age_s(folder / "cancel") > CANCEL_GRACE_S:
                _kill(status.pid)
            return status
        if status.state is JobState.STARTING and _may_still_start(folder, status):
            return status
        return self._bury(folder, cancelled=cancelled)

    def _bury(self, folder: Path, *, cancelled: bool) -> JobStatus:
        """End a job whose worker is gone."""
        status = read_state(folder)  # it may have ended between the two looks
        if status.state.is_over:
            return status
        if cancelled:
            return _end(folder, status, JobState.CANCELLED)
        logger.warning("The worker of job %s died; see %s", status.id, folder / "worker.log")
        return _end(folder, status, JobState.FAILED, message=_obituary(folder))

    def _start(self, folder: Path, status: JobStatus) -> JobStatus:
        status = replace(status, state=JobState.STARTING, started_s=time.time())
        write_state(folder, status)
        try:
            with (folder / "worker.log").open("ab") as log:
                _children[folder] = subprocess.Popen(
                    [*self.command, str(folder)],
                    stdin=subprocess.DEVNULL,
                    stdout=log,
                    stderr=log,
                    # Its own session: closing the dashboard's terminal must not stop it.
                    start_new_session=True,
                )
        except OSError as error:
            message = f"The worker can't be started ({error.strerror}); check the installation."
            return _end(folder, status, JobState.FAILED, message=message)
        return status


_children: dict[Path, subprocess.Popen[bytes]] = {}
"""Workers this process started, so that they don't stay as zombies."""


def read_state(folder: Path) -> JobStatus:
    """Return what `state.json` says; queued while there is none."""
    submitted_s = (folder / "request.json").stat().st_mtime
    try:
        plain: dict[str, Any] = json.loads((folder / "state.json").read_text(encoding="utf-8"))
    except FileNotFoundError:
        return JobStatus(id=folder.name, label=_label(folder), submitted_s=submitted_s)
    return JobStatus(**{**plain, "state": JobState(plain["state"])})


def write_state(folder: Path, status: JobStatus) -> None:
    """Replace `state.json` as a whole."""
    aside = folder / f"state.{os.getpid()}.tmp"
    aside.write_text(json.dumps(asdict(status)), encoding="utf-8")
    aside.replace(folder / "state.json")


def _label(folder: Path) -> str:
    try:
        return JobRequest.from_json((folder / "request.json").read_text(encoding="utf-8")).label
    except EngineError:
        return ""


def _end(folder: Path, status: JobStatus, state: JobState, message: str = "") -> JobStatus:
    exit_code = 130 if state is JobState.CANCELLED else status.exit_code
    status = replace(status, state=state, message=message, exit_code=exit_code, ended_s=time.time())
    write_state(folder, status)
    _reap(folder)
    return status


def _reap(folder: Path) -> int | None:
    """Return the exit code of a worker this process started, if it has ended."""
    child = _children.get(folder)
    if child is None or child.poll() is None:
        return None
    del _children[folder]
    return child.returncode


def _may_still_start(folder: Path, status: JobStatus) -> bool:
    if _reap(folder) is not None:
        return False
    return status.elapsed_s < STARTUP_GRACE_S


def _age_s(path: Path) -> float:
    return time.time() - path.stat().st_mtime


def _kill(pid: int | None) -> None:
    if pid is not None:
        with contextlib.suppress(ProcessLookupError, PermissionError):
            os.kill(pid, getattr(signal, "SIGKILL", signal.SIGTERM))


def _obituary(folder: Path) -> str:
    return (
        "The assessment stopped without a word: its process was ended from outside, or the "
        f"computer ran out of memory. Start it again; details are in {folder / 'worker.log'}."
    )


def _remove(folder: Path) -> None:
    # Renamed first, so that nobody sees a job that is half there.
    hidden = hidden_sibling(folder)
    folder.rename(hidden)
    shutil.rmtree(hidden, ignore_errors=True)
    _reap(folder)
