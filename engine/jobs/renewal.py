"""A trial assessed anew with what people corrected: asking for it, and the new version's place.

Between both somebody else may have done the same, or deleted the trial; then nothing is replaced,
and the job says so.
"""

from __future__ import annotations

import hashlib
import logging
import shutil
from collections.abc import Callable, Sequence
from datetime import datetime
from pathlib import Path

from engine.corrections import Corrections, read_corrections
from engine.datatypes import ProgressCallback
from engine.errors import ConfigError, DataError
from engine.jobs.request import JobRequest
from engine.storage.atomic import explain_os_errors, hidden_sibling
from engine.storage.catalogue import record_folder
from engine.storage.database.failures import DatabaseUnavailable
from engine.storage.database.models import Trial
from engine.storage.library import Library
from engine.storage.results import (
    RESULT_FILES,
    StoredResult,
    is_result_folder,
    read_document,
    read_result,
)

__all__ = ["Reassess", "ask_again", "renew"]

logger = logging.getLogger(__name__)

Reassess = Callable[[StoredResult, Corrections, Path, Sequence[Path], ProgressCallback], Path]
"""Like `engine.reassess.reassess_to_folder`: writes a whole result folder or none."""


def ask_again(
    library: Library,
    trial_id: str,
    corrections: Corrections,
    *,
    version: int,
    videos: Sequence[Path] = (),
) -> JobRequest:
    """Return the request to assess a trial anew, and keep others from doing the same meanwhile.

    Parameters
    ----------
    library
        Where the trial is.
    trial_id
        Which one.
    corrections
        All that is to be corrected; what is left out is taken back.
    version
        Of the trial's record that the corrections were made on.
    videos
        The videos it was made from, where they are at hand.

    Raises
    ------
    EditConflict
        If somebody else changed the trial since.
    ConfigError
        If there is no such trial.
    DataError
        If its result is damaged.
    """
    stored = read_result(library.folder(trial_id))
    based_on = _find_fingerprint(stored.folder)
    library.edit(trial_id, version=version)
    return JobRequest(
        videos=tuple(videos),
        subject=stored.subject,
        task=stored.task,
        label=library.record(trial_id).names.label or stored.document["label"],
        trial_id=trial_id,
        based_on=based_on,
        corrections=corrections,
    )


def renew(
    library: Library,
    folder: Path,
    request: JobRequest,
    progress: ProgressCallback,
    reassess: Reassess,
) -> None:
    """Assess a trial of the library anew, and put the result in the place of the earlier one.

    Parameters
    ----------
    library
        Where the trial is.
    folder
        Of the job; what an interrupted try has finished is used.
    request
        Names the trial, the result it starts from, and the corrections.
    progress
        May raise `Cancelled`.
    reassess
        What does the work.

    Raises
    ------
    ConfigError
        If the trial is gone.
    DataError
        If it is another result by now than the corrections were made on.
    OutputError
        If nothing can be written.
    """
    target = library.folder(request.trial_id)
    if not is_result_folder(target):
        raise ConfigError("The trial was deleted meanwhile, so there is nothing to correct.")
    if _find_fingerprint(target) != request.based_on:
        if read_corrections(read_document(target)) == request.corrections:
            return  # an earlier try got this far
        raise _conflict()
    result = folder / "result"
    if not is_result_folder(result):
        result = reassess(
            read_result(target), request.corrections, result, request.videos, progress
        )
    _put_in_place(library, result, target, request.based_on)


def _find_fingerprint(folder: Path) -> str:
    return hashlib.sha256((folder / "trial.json").read_bytes()).hexdigest()


def _conflict() -> DataError:
    return DataError(
        "Somebody else assessed this trial anew meanwhile, so this correction was not kept. Look "
        "at what is there now, and correct that."
    )


def _put_in_place(library: Library, result: Path, target: Path, based_on: str) -> None:
    """Exchange a trial's result, with what else is kept in its folder left as it is."""
    aside, earlier = hidden_sibling(target), hidden_sibling(target)
    with explain_os_errors(target):
        try:
            # Aside first: a move between disks is a slow copy.
            shutil.move(result, aside)
            _carry_over(target, aside)
            if _find_fingerprint(target) != based_on:
                raise _conflict()
            target.rename(earlier)
            try:
                aside.rename(target)
            except BaseException:
                earlier.rename(target)
                raise
        finally:
            shutil.rmtree(aside, ignore_errors=True)
            shutil.rmtree(earlier, ignore_errors=True)
    _record(library, target)


def _carry_over(target: Path, aside: Path) -> None:
    """Copy what was added to a result, such as a reference recording."""
    for own in target.iterdir():
        if own.name in RESULT_FILES:
            continue
        if own.is_dir():
            shutil.copytree(own, aside / own.name)
        else:
            shutil.copy2(own, aside / own.name)


def _record(library: Library, target: Path) -> None:
    """Bring the list up to date; the trial keeps the day on which it was first assessed."""
    try:
        first = _find_day(library, target.name)
        record_folder(target, library.database)
        with library.database.writing() as session:
            trial = session.get(Trial, target.name)
            if trial is not None and first is not None:
                trial.created_at = first
    except DatabaseUnavailable as error:
        # The result is safe: whoever lists the trials next finds it.
        logger.warning("The trial %s is not in the list yet: %s", target.name, error)


def _find_day(library: Library, trial_id: str) -> datetime | None:
    with library.database.reading() as session:
        trial = session.get(Trial, trial_id)
        return None if trial is None else trial.created_at
