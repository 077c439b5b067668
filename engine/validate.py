"""Compare results with reference recordings; used by the command line and the dashboard.

The one place that knows both the solvers and `engine.validation`.
"""

from __future__ import annotations

import contextlib
import logging
import shutil
from collections.abc import Sequence
from pathlib import Path

from threadpoolctl import threadpool_limits

from engine.errors import ConfigError, DataError
from engine.kinematics.fitting.base import select_solver
from engine.storage.atomic import explain_os_errors, hidden_sibling, scratch_folder
from engine.storage.results import StoredResult
from engine.validation.compare import (
    Estimate,
    OffsetRule,
    ReferenceFacts,
    ReferenceMovement,
    TrialComparison,
    compare_trial,
    thin_track,
)
from engine.validation.joint_centres import build_pose_track
from engine.validation.outcome import AGREEMENT_NAME, render_outcome
from engine.validation.pooled import Agreement, pool_trials
from engine.validation.reference.base import Reference
from engine.version import __version__

__all__ = [
    "check_agreement_target",
    "compare_result",
    "compare_results",
    "move_reference",
    "write_agreement",
]

logger = logging.getLogger(__name__)


def compare_results(
    pairs: Sequence[tuple[StoredResult, Reference]],
    *,
    offset: OffsetRule = "auto",
    max_lag_s: float | None = None,
    seed: int = 0,
) -> Agreement:
    """Compare results with their references and pool them.

    Parameters
    ----------
    pairs
        Every result with its reference.
    offset, max_lag_s
        As in `engine.validation.compare.compare_trial`.
    seed
        Of bootstrap and permutation.
    """
    # Thousands of tiny matrices: handing each to several threads costs a hundred times the work.
    with threadpool_limits(limits=1, user_api="blas"):
        trials = [
            compare_result(stored, reference, offset=offset, max_lag_s=max_lag_s)
            for stored, reference in pairs
        ]
        return pool_trials(trials, seed=seed)


def compare_result(
    stored: StoredResult,
    reference: Reference,
    *,
    offset: OffsetRule = "auto",
    max_lag_s: float | None = None,
) -> TrialComparison:
    """Compare one result with its reference; see `compare_results`."""
    document = stored.document
    label = document["label"] or stored.folder.name
    estimate = Estimate(
        subject=stored.subject.label or "subject",
        label=label,
        task=document["job"] or "",
        angles=stored.angles,
        track=stored.corrected,
        solver=document["solver"],
    )
    try:
        movement = move_reference(reference, stored)
        return compare_trial(estimate, movement, offset=offset, max_lag_s=max_lag_s)
    except DataError as error:
        # With several pairs, the sentence has to say which one.
        raise type(error)(f"{label} and {reference.name}: {error}") from error


def move_reference(reference: Reference, stored: StoredResult) -> ReferenceMovement:
    """Return a reference's angles: its own, or computed from its joint centres.

    The solver is the one that made the result's angles, and the joint centres take the place of
    its keypoints, so that both sets of angles follow the same definitions.
    """
    track = None
    notes: tuple[str, ...] = ()
    if reference.markers is not None and (reference.landmarks or reference.angles is None):
        try:
            track = build_pose_track(reference, skeleton=stored.corrected.skeleton)
        except DataError as error:
            if reference.angles is None:
                raise
            notes = (f"The markers were not used: {error}",)
    facts = ReferenceFacts.of(reference, track)
    if reference.angles is not None:
        return ReferenceMovement(facts, reference.angles, "recorded", track, notes)
    if track is None:
        raise DataError(f"{reference.name} holds neither joint angles nor usable markers.")
    rate_hz = _video_rate_hz(stored)
    solver = select_solver(stored.document["solver"])
    fit = solver.fit(thin_track(track, rate_hz), stored.subject)
    return ReferenceMovement(facts, fit.angles, "computed", track, fit.warnings)


def _video_rate_hz(stored: StoredResult) -> float:
    time = stored.angles.time_s
    return (time.size - 1) / float(time[-1] - time[0]) if time.size > 1 else 0.0


def check_agreement_target(folder: Path) -> Path:
    """Return `folder` as an absolute path if a comparison may be written there.

    Raises
    ------
    ConfigError
        If it is a file, or holds anything but an earlier comparison.
    """
    folder = Path(folder).expanduser().resolve()
    if folder.is_file():
        raise ConfigError(f"The comparison needs a folder, but {folder} is a file.")
    if folder.is_dir() and any(folder.iterdir()) and not (folder / AGREEMENT_NAME).is_file():
        raise ConfigError(
            f"The comparison needs a new or empty folder or one with an earlier comparison, but "
            f"{folder} holds other files; choose another folder."
        )
    return folder


def write_agreement(agreement: Agreement, folder: Path) -> Path:
    """Write a comparison: aside first, then renamed, so that it is whole or not there.

    Raises
    ------
    ConfigError
        If something else is in `folder`.
    OutputError
        If it can't be written; nothing is left behind.
    """
    folder = check_agreement_target(folder)
    files = render_outcome(agreement, version=__version__)
    with scratch_folder(folder) as scratch, explain_os_errors(folder, "The comparison"):
        whole = scratch / folder.name
        for name, content in files.items():
            path = whole / name
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_bytes(content)
        _put_in_place(whole, folder)
    return folder


def _put_in_place(whole: Path, folder: Path) -> None:
    """Let `whole` take the place of `folder`; what was there stays if that fails."""
    earlier = hidden_sibling(folder)
    if folder.exists():
        folder.rename(earlier)
    try:
        whole.rename(folder)
    except OSError:
        with contextlib.suppress(OSError):
            earlier.rename(folder)
        raise
    shutil.rmtree(earlier, ignore_errors=True)
