"""The process that runs one job: ``python -m engine.jobs.worker JOB_FOLDER``."""

from __future__ import annotations

import contextlib
import logging
import os
import signal
import sys
import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from types import FrameType
from typing import Any

from engine.config import Config
from engine.corrections import NO_CORRECTIONS, Corrections
from engine.datatypes import ProgressCallback, Trial
from engine.errors import Cancelled, EngineError, OutputError
from engine.jobs.local import WORKER_COMMAND, JobQueue
from engine.jobs.renewal import renew
from engine.jobs.request import JobRequest
from engine.jobs.store import AT_WORK, HOST, JobState, JobStatus, JobStore
from engine.storage.library import Library
from engine.storage.locks import hold
from engine.storage.results import StoredResult, is_result_folder

__all__ = ["Assess", "main"]

logger = logging.getLogger(__name__)

Assess = Callable[[Trial, Config, Path, ProgressCallback], Path]
"""Like `engine.pipeline.assess_to_folder`: writes a whole result folder or none."""

REPORT_EVERY_S = 0.2
HEARTBEAT_S = 15.0
"""How often a worker says that it lives; other computers have nothing else to go by."""
END_TRIES = 5
STAGE_SPANS: dict[str, tuple[float, float]] = {"pose": (0.02, 0.85), "overlay": (0.9, 0.99)}
"""Which part of the whole job a stage usually takes; stages that take no time are not listed."""
UNEXPECTED_EXIT_CODE = 1


class _Reporter:
    """Writes progress into the queue, and stops the job once it is asked to."""

    def __init__(self, store: JobStore, status: JobStatus) -> None:
        self.store = store
        self.status = status
        self._last_s = 0.0

    def __call__(self, stage: str, done: int, total: int) -> None:
        now = time.monotonic()
        if stage == self.status.stage and now - self._last_s < REPORT_EVERY_S:
            return
        self._last_s = now
        fraction = max(self.status.fraction, find_fraction(stage, done, total))
        self.status = replace(self.status, stage=stage, done=done, total=total, fraction=fraction)
        try:
            is_mine = self._write(stage=stage, done=done, total=total, fraction=fraction)
            is_wanted = is_mine and self.store.read(self.status.id).cancel_requested_s is None
        except OutputError as error:
            # A database that is busy now must not cost an hour's work.
            logger.warning("The progress can't be told now: %s", error)
            return
        if not is_wanted:
            raise Cancelled("The assessment was cancelled; nothing was kept.")

    def end(self, state: JobState, *, exit_code: int, message: str = "", **more: Any) -> None:
        """Write down how the job ended; tried several times, since nobody else knows."""
        ended = {"state": state, "exit_code": exit_code, "message": message, **more}
        for attempt in range(1, END_TRIES + 1):
            try:
                self._write(**ended, ended_s=time.time())
            except OutputError as error:
                logger.warning("The end can't be told (try %d): %s", attempt, error)
                time.sleep(attempt)
            else:
                return

    def beat(self, stop: threading.Event) -> None:
        """Say from time to time that the worker lives, until `stop`."""
        while not stop.wait(HEARTBEAT_S):
            with contextlib.suppress(OutputError):
                self._write()

    def _write(self, **values: Any) -> bool:
        return self.store.change(
            self.status.id,
            expected=(JobState.RUNNING,),
            owner=self.status.pid,
            heartbeat_s=time.time(),
            **values,
        )


def main(
    argv: list[str], *, assess: Assess | None = None, command: tuple[str, ...] = WORKER_COMMAND
) -> int:
    """Run the job in the folder `argv` names, then start the next one that waits.

    Parameters
    ----------
    argv
        The job's folder.
    assess
        What does the work; None for the pipeline.
    command
        What starts the next worker.

    Returns
    -------
    int
        The exit code of the command line for the same outcome.
    """
    logging.basicConfig(level=logging.INFO, format="%(asctime)s %(levelname)s %(message)s")
    folder = Path(argv[0]).resolve()
    with hold(folder / "alive.lock"):
        library = Library(folder.parent.parent)
        reporter = _begin(JobStore(library), folder.name)
        if reporter is None:
            logger.info("The job %s is over already, or is not there.", folder.name)
            return 0
        signal.signal(signal.SIGTERM, _stop)
        ended = threading.Event()
        threading.Thread(target=reporter.beat, args=(ended,), daemon=True).start()
        try:
            exit_code = _run(library, folder, reporter, assess or _assess)
        finally:
            ended.set()
    JobQueue(library, command=command).advance()
    return exit_code


def _begin(store: JobStore, job_id: str) -> _Reporter | None:
    """Take the job over; None if there is nothing (more) to do."""
    now = time.time()
    is_mine = store.change(
        job_id,
        expected=(JobState.QUEUED, *AT_WORK),
        state=JobState.RUNNING,
        host=HOST,
        pid=os.getpid(),
        started_s=now,
        heartbeat_s=now,
    )
    return _Reporter(store, store.read(job_id)) if is_mine else None


def find_fraction(stage: str, done: int, total: int) -> float:
    """Return how much of the whole job is done, 0 to 1; 0 where a stage says nothing of it."""
    start, end = STAGE_SPANS.get(stage, (0.0, 0.0))
    return start + (end - start) * min(1.0, done / total) if total > 0 else start


def _assess(trial: Trial, config: Config, folder: Path, progress: ProgressCallback) -> Path:
    # Imported late: the lock must be held, and the state written, within a moment.
    from engine.pipeline import assess_to_folder

    return assess_to_folder(trial, config, folder, progress)


def _assess_corrected(corrections: Corrections) -> Assess:
    def assess(trial: Trial, config: Config, folder: Path, progress: ProgressCallback) -> Path:
        from engine.pipeline import assess_to_folder

        return assess_to_folder(trial, config, folder, progress, corrections)

    return assess


def _reassess(
    stored: StoredResult,
    corrections: Corrections,
    folder: Path,
    videos: Sequence[Path],
    progress: ProgressCallback,
) -> Path:
    from engine.reassess import reassess_to_folder

    return reassess_to_folder(stored, corrections, folder, videos, progress)


def _stop(_signal: int, _frame: FrameType | None) -> None:
    raise Cancelled("The assessment was stopped from outside; nothing was kept.")


def _run(library: Library, folder: Path, reporter: _Reporter, assess: Assess) -> int:
    try:
        request = reporter.store.request(folder.name)
        reporter("start", 0, 0)
        _finish(library, folder, request, reporter, assess)
    except Cancelled as error:
        reporter.end(JobState.CANCELLED, exit_code=error.exit_code)
        return error.exit_code
    except EngineError as error:
        reporter.end(JobState.FAILED, exit_code=error.exit_code, message=str(error))
        return error.exit_code
    except Exception as error:
        # The outermost frame: a worker must never leave without saying why.
        logger.exception("The assessment failed")
        message = (
            f"Something went wrong that LiftLens did not foresee ({type(error).__name__}: {error})."
            f" Please report it with the file {folder / 'worker.log'}."
        )
        reporter.end(JobState.FAILED, exit_code=UNEXPECTED_EXIT_CODE, message=message)
        return UNEXPECTED_EXIT_CODE
    trial_id = request.trial_id or folder.name
    reporter.end(JobState.DONE, exit_code=0, trial_id=trial_id, fraction=1.0)
    _drop_uploads(folder, request)
    return 0


def _finish(
    library: Library, folder: Path, request: JobRequest, reporter: _Reporter, assess: Assess
) -> None:
    """Do what an earlier try has not done yet; a new trial gets the id of the job."""
    if request.trial_id:
        renew(library, folder, request, reporter, _reassess)
        return
    if library.has(folder.name):
        return
    result = folder / "result"
    if not is_result_folder(result):
        if request.corrections != NO_CORRECTIONS:
            assess = _assess_corrected(request.corrections)
        result = assess(request.trial, request.settings, result, reporter)
    library.adopt(result, folder.name)


def _drop_uploads(folder: Path, request: JobRequest) -> None:
    """Delete the unblurred originals that were uploaded; the annotated copy stays."""
    for video in request.videos:
        if folder in video.parents:
            with contextlib.suppress(OSError):
                video.unlink()


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
