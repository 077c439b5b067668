"""Assessments in worker processes of this computer, with all state in the library.

What is known about a job is a row of the library's queue; its folder below `jobs` holds::

    videos/        the uploaded videos, until the job has succeeded
    alive.lock     locked by the worker for as long as it lives
    result/        what the worker has finished but not yet moved into the library
    worker.log     what the worker wrote to stderr

So every page, tab and process sees the same, and a restart of the dashboard changes nothing. A
worker that was killed is noticed by the lock the operating system took from it; its job is
tried once more, since most often the computer was switched off.
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
from dataclasses import replace
from pathlib import Path
from typing import Any

from engine.errors import ConfigError, EngineError
from engine.jobs.request import JobRequest
from engine.jobs.store import AT_WORK, HOST, OVER, JobState, JobStatus, JobStore
from engine.storage.atomic import explain_os_errors, hidden_sibling
from engine.storage.library import Library
from engine.storage.locks import is_held

__all__ = ["JobQueue", "JobRequest", "JobState", "JobStatus", "default_workers"]

logger = logging.getLogger(__name__)

WORKER_COMMAND = (sys.executable, "-m", "engine.jobs.worker")
STARTUP_GRACE_S = 60.0
"""How long a new worker may take until it holds its lock."""
CANCEL_GRACE_S = 10.0
"""How long a worker may take to stop by itself before it is killed."""
SILENCE_S = 180.0
"""A worker of another computer that gave no sign of life for so long is dead."""
MAX_ATTEMPTS = 2
"""How often a job is started whose worker was killed."""
KEEP_UPLOADS_S = 24 * 3600.0
"""How long a video that was uploaded but never assessed is kept: it shows faces."""
KEEP_JOBS_S = 7 * 24 * 3600.0
"""How long ended jobs are kept; their results stay in the library."""


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
        self.store = JobStore(library)

    def submit(self, request: JobRequest, *, priority: int = 0) -> str:
        """Add a job to the queue and start it if a worker is free; return its id.

        The trial it makes will have the same id.

        Parameters
        ----------
        request
            What to do.
        priority
            A higher one is started first; jobs of one priority in the order they came.

        Raises
        ------
        ConfigError
            If a video is not there.
        OutputError
            If the library takes nothing; uploads stay where they were.
        """
        _require_videos(request)
        if request.trial_id:
            self._require_at_rest(request.trial_id)
        folder = self.root / self.library.new_id()
        aside = hidden_sibling(folder)
        own = request
        try:
            with explain_os_errors(folder, "The job"):
                aside.mkdir()
                places = [Path("videos", str(n), v.name) for n, v in enumerate(request.videos)]
                own = replace(
                    request,
                    videos=tuple(
                        self._adopt(video, aside, place, folder)
                        for video, place in zip(request.videos, places, strict=True)
                    ),
                )
                aside.rename(folder)
            self.store.add(folder.name, own, priority=priority)
        except BaseException:
            _give_back(request.videos, own.videos, folder)
            for part in (aside, folder):
                shutil.rmtree(part, ignore_errors=True)
            raise
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
        return self.store.read(job_id)

    def jobs(self) -> tuple[JobStatus, ...]:
        """Return all jobs, oldest first."""
        self.advance()
        return self.store.all()

    def request(self, job_id: str) -> JobRequest:
        """Return what a job was asked to do."""
        return self.store.request(job_id)

    def renewals(self, trial_id: str) -> tuple[JobStatus, ...]:
        """Return the jobs that assess a trial of the library anew, oldest first."""
        self.advance()
        return self.store.of_trial(trial_id)

    def _require_at_rest(self, trial_id: str) -> None:
        if not all(job.state.is_over for job in self.store.of_trial(trial_id)):
            raise ConfigError(
                "This trial is being assessed anew already; wait until that is done, or cancel it."
            )

    def cancel(self, job_id: str) -> None:
        """Ask a job to stop; a waiting one never starts. Ended jobs stay as they are."""
        status = self.store.read(job_id)
        if not status.state.is_over and status.cancel_requested_s is None:
            unfinished = (JobState.QUEUED, *AT_WORK)
            self.store.change(job_id, expected=unfinished, cancel_requested_s=time.time())
        self.advance()

    def retry(self, job_id: str) -> None:
        """Let a job that failed or was cancelled wait for another try, with the same request.

        Raises
        ------
        ConfigError
            If it is not over, has succeeded, or its video is gone.
        """
        _require_videos(self.request(job_id))
        again = (JobState.FAILED, JobState.CANCELLED)
        if not self.store.requeue(job_id, expected=again, attempts=0):
            raise ConfigError(f"The job {job_id!r} has not failed, so there is nothing to repeat.")
        self.advance()

    def withdraw(self, job_id: str) -> JobRequest:
        """Remove an ended job and return its request, with its uploads back where they were."""
        request, folder = self.request(job_id), self.root / job_id
        if not self.store.read(job_id).state.is_over:
            raise ConfigError(f"The job {job_id!r} is still at work; cancel it first.")
        request = replace(request, videos=tuple(self._return(v, folder) for v in request.videos))
        self._remove(job_id)
        return request

    def forget(self, job_id: str) -> None:
        """Remove an ended job, with the uploaded video it still holds."""
        if self.store.read(job_id).state.is_over:
            self._remove(job_id)

    def advance(self) -> None:
        """Bring the queue up to date and start waiting jobs where a worker is free."""
        if self.library.is_read_only:
            return
        self._clear_uploads()
        self._take_in_folders()
        jobs = [self._settle(job) for job in self.store.unfinished()]
        if any(job.state is JobState.QUEUED for job in jobs):
            while (job := self.store.claim_next(self.max_workers)) is not None:
                self._start(job)
        for job_id in self.store.ended_before(time.time() - KEEP_JOBS_S):
            self._remove(job_id)
        for job_id, trial_id in self.store.renewed_trials().items():
            if not self.library.has(trial_id):  # deleted, with all that belongs to it
                self._remove(job_id)

    # ------------------------------------------------------------------ files

    def _clear_uploads(self) -> None:
        for folder in self.library.uploads.iterdir():
            with contextlib.suppress(FileNotFoundError):
                if not folder.name.startswith(".") and _age_s(folder) > KEEP_UPLOADS_S:
                    _remove_folder(folder)

    def _take_in_folders(self) -> None:
        """Put jobs of an older LiftLens into the queue; remove what a killed process left."""
        known: set[str] | None = None
        for folder in [p for p in self.root.iterdir() if not p.name.startswith(".")]:
            request = folder / "request.json"
            if not request.exists() and (not folder.is_dir() or _is_young(folder)):
                continue
            known = self.store.ids() if known is None else known
            if folder.name in known:
                continue
            if not request.exists():
                _remove_folder(folder)
            elif not is_held(folder / "alive.lock"):
                self._take_in(folder, request)

    def _take_in(self, folder: Path, request: Path) -> None:
        try:
            asked = JobRequest.from_json(request.read_text(encoding="utf-8"))
            known = _read_old_state(folder)
            known.setdefault("submitted_s", request.stat().st_mtime)
        except (EngineError, OSError, ValueError) as error:
            logger.warning("The job %s can't be read and is left alone: %s", folder.name, error)
            return
        self.store.add(folder.name, asked, **known)
        for name in ("request.json", "state.json", "cancel"):
            (folder / name).unlink(missing_ok=True)

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

    def _remove(self, job_id: str) -> None:
        _remove_folder(self.root / job_id)
        _reap(self.root / job_id)
        self.store.remove(job_id)

    # ------------------------------------------------------------------ workers

    def _settle(self, job: JobStatus) -> JobStatus:
        """Write down what nobody else could: workers that died, cancelled jobs that never ran."""
        if job.state is JobState.QUEUED:
            return job if job.cancel_requested_s is None else self._end(job, JobState.CANCELLED)
        if self._is_alive(job):
            self._press(job)
            return job
        if job.state is JobState.STARTING and self._may_still_start(job):
            return job
        return self._bury(job)

    def _is_alive(self, job: JobStatus) -> bool:
        # A library in a file belongs to one computer, even if that was given a new name.
        if job.host == HOST or self.library.database.is_sqlite:
            return is_held(self.root / job.id / "alive.lock")
        return time.time() - (job.heartbeat_s or job.started_s or 0.0) < SILENCE_S

    def _press(self, job: JobStatus) -> None:
        """End a worker that was asked to stop and doesn't."""
        asked_s = job.cancel_requested_s
        if asked_s is None or time.time() - asked_s <= CANCEL_GRACE_S or job.host != HOST:
            return
        if job.pid is not None:
            with contextlib.suppress(ProcessLookupError, PermissionError):
                os.kill(job.pid, getattr(signal, "SIGKILL", signal.SIGTERM))

    def _may_still_start(self, job: JobStatus) -> bool:
        if _reap(self.root / job.id) is not None:
            return False
        return job.elapsed_s < STARTUP_GRACE_S

    def _bury(self, job: JobStatus) -> JobStatus:
        """End a job whose worker is gone, or let it try once more."""
        _reap(self.root / job.id)
        if job.cancel_requested_s is not None:
            return self._end(job, JobState.CANCELLED)
        log = self.root / job.id / "worker.log"
        logger.warning("The worker of job %s died; see %s", job.id, log)
        if job.state is JobState.RUNNING and job.attempts < MAX_ATTEMPTS:
            self.store.requeue(job.id, expected=(job.state,))
            return self.store.read(job.id)
        return self._end(job, JobState.FAILED, message=_obituary(job, log))

    def _end(self, job: JobStatus, state: JobState, message: str = "") -> JobStatus:
        exit_code = 130 if state is JobState.CANCELLED else job.exit_code
        self.store.change(
            job.id,
            expected=(job.state,),
            state=state,
            message=message,
            exit_code=exit_code,
            ended_s=time.time(),
        )
        _reap(self.root / job.id)
        return self.store.read(job.id)

    def _start(self, job: JobStatus) -> None:
        folder = self.root / job.id
        try:
            folder.mkdir(exist_ok=True)
            _let_go(folder)
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
            self._end(job, JobState.FAILED, message=message)


_children: dict[Path, subprocess.Popen[bytes]] = {}
"""Workers this process started, so that they don't stay as zombies."""


def _reap(folder: Path) -> int | None:
    """Return the exit code of a worker this process started, if it has ended."""
    child = _children.get(folder)
    if child is None or child.poll() is None:
        return None
    _children.pop(folder, None)
    return child.returncode


_leaving: list[subprocess.Popen[bytes]] = []
"""Workers that have said how their job ended, but have not left yet."""


def _let_go(folder: Path) -> None:
    """Make room for another worker of a job."""
    _leaving[:] = [child for child in _leaving if child.poll() is None]
    if (child := _children.pop(folder, None)) is not None and child.poll() is None:
        _leaving.append(child)


def _require_videos(request: JobRequest) -> None:
    for video in request.videos:
        if not video.is_file():
            raise ConfigError(f"The video {video.name} is not there any more; add it again.")


def _give_back(asked: tuple[Path, ...], own: tuple[Path, ...], folder: Path) -> None:
    """Put uploads back that a job took over before it could not be queued."""
    for before, after in zip(asked, own, strict=True):
        if before != after and after.exists() and folder in after.parents:
            with contextlib.suppress(OSError):
                before.parent.mkdir(parents=True, exist_ok=True)
                shutil.move(after, before)


def _read_old_state(folder: Path) -> dict[str, Any]:
    """Return what an older LiftLens knew of a job, as fields of a status."""
    try:
        plain = json.loads((folder / "state.json").read_text(encoding="utf-8"))
    except FileNotFoundError:
        plain = {}
    known = ("stage", "done", "total", "fraction", "message", "exit_code", "trial_id")
    kept = {name: plain[name] for name in known if name in plain}
    times = ("submitted_s", "started_s", "ended_s")
    kept |= {name: plain[name] for name in times if plain.get(name) is not None}
    state = JobState(plain.get("state", JobState.QUEUED))
    if (folder / "cancel").exists() and state not in OVER:
        state = JobState.CANCELLED
        kept["ended_s"] = time.time()
    # Nobody holds its lock any more, so what ran waits again.
    return {**kept, "state": state if state in OVER else JobState.QUEUED}


def _age_s(path: Path) -> float:
    return time.time() - path.stat().st_mtime


def _is_young(folder: Path) -> bool:
    try:
        return _age_s(folder) < KEEP_UPLOADS_S
    except FileNotFoundError:
        return True


def _obituary(job: JobStatus, log: Path) -> str:
    often = f" {job.attempts} times" if job.attempts > 1 else ""
    return (
        f"The assessment stopped{often} without a word: its process was ended from outside, or "
        f"the computer ran out of memory. Start it again; details are in {log}."
    )


def _remove_folder(folder: Path) -> None:
    # Renamed first, so that nobody sees a job that is half there.
    hidden = hidden_sibling(folder)
    with contextlib.suppress(FileNotFoundError):
        folder.rename(hidden)
    shutil.rmtree(hidden, ignore_errors=True)
