"""The process that runs one job: ``python -m engine.jobs.worker JOB_FOLDER``."""

from __future__ import annotations

import contextlib
import logging
import os
import signal
import sys
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import FrameType

from engine.config import Config
from engine.datatypes import ProgressCallback, Trial
from engine.errors import Cancelled, EngineError
from engine.jobs.local import (
    WORKER_COMMAND,
    JobQueue,
    JobState,
    JobStatus,
    read_state,
    write_state,
)
from engine.jobs.locks import hold
from engine.jobs.request import JobRequest
from engine.storage.library import Library

__all__ = ["Assess", "main"]

logger = logging.getLogger(__name__)

Assess = Callable[[Trial, Config, Path, ProgressCallback], Path]
"""Like `engine.pipeline.assess_to_folder`: writes a whole result folder or none."""

REPORT_EVERY_S = 0.2
STAGE_SPANS: dict[str, tuple[float, float]] = {"pose": (0.02, 0.85), "overlay": (0.9, 0.99)}
"""Which part of the whole job a stage usually takes; stages that take no time are not listed."""
UNEXPECTED_EXIT_CODE = 1


class _Reporter:
    """Writes progress into the job's folder, and stops the job once it is asked to."""

    def __init__(self, folder: Path, status: JobStatus) -> None:
        self.folder = folder
        self.status = status
        self._last_s = 0.0

    def __call__(self, stage: str, done: int, total: int) -> None:
        now = time.monotonic()
        if stage == self.status.stage and now - self._last_s < REPORT_EVERY_S:
            return
        self._last_s = now
        if (self.folder / "cancel").exists():
            raise Cancelled("The assessment was cancelled; nothing was kept.")
        self.status = replace(
            self.status,
            stage=stage,
            done=done,
            total=total,
            fraction=max(self.status.fraction, find_fraction(stage, done, total)),
        )
        write_state(self.folder, self.status)

    def end(self, state: JobState, *, exit_code: int, message: str = "") -> None:
        self.status = replace(
            self.status, state=state, exit_code=exit_code, message=message, ended_s=time.time()
        )
        write_state(self.folder, self.status)


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
        status = replace(
            read_state(folder), state=JobState.RUNNING, pid=os.getpid(), started_s=time.time()
        )
        reporter = _Reporter(folder, status)
        write_state(folder, status)
        signal.signal(signal.SIGTERM, _stop)
        exit_code = _run(folder, reporter, assess or _assess)
    JobQueue(Library(folder.parent.parent), command=command).advance()
    return exit_code


def find_fraction(stage: str, done: int, total: int) -> float:
    """Return how much of the whole job is done, 0 to 1; 0 where a stage says nothing of it."""
    start, end = STAGE_SPANS.get(stage, (0.0, 0.0))
    return start + (end - start) * min(1.0, done / total) if total > 0 else start


def _assess(trial: Trial, config: Config, folder: Path, progress: ProgressCallback) -> Path:
    # Imported late: the lock must be held, and the state written, within a moment.
    from engine.pipeline import assess_to_folder

    return assess_to_folder(trial, config, folder, progress)


def _stop(_signal: int, _frame: FrameType | None) -> None:
    raise Cancelled("The assessment was stopped from outside; nothing was kept.")


def _run(folder: Path, reporter: _Reporter, assess: Assess) -> int:
    try:
        request = JobRequest.from_json((folder / "request.json").read_text(encoding="utf-8"))
        reporter("start", 0, 0)
        result = assess(request.trial, request.settings, folder / "result", reporter)
        trial_id = _publish(result, folder)
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
    reporter.status = replace(reporter.status, trial_id=trial_id, fraction=1.0)
    reporter.end(JobState.DONE, exit_code=0)
    _drop_uploads(folder, request)
    return 0


def _publish(result: Path, folder: Path) -> str:
    """Move the result into the library as a whole; the trial gets the id of the job."""
    return Library(folder.parent.parent).adopt(result, folder.name)


def _drop_uploads(folder: Path, request: JobRequest) -> None:
    """Delete the unblurred originals that were uploaded; the annotated copy stays."""
    for video in request.videos:
        if folder in video.parents:
            with contextlib.suppress(OSError):
                video.unlink()


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
