"""Ask of stored results what a change would do, whether one worked, and what a job adds up to.

The one place that knows both `engine.storage` and `engine.ergonomics`; the dashboard asks it. No
video is needed.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from engine.ergonomics.base import Exposure
from engine.ergonomics.before_after import (
    BeforeAfter,
    TrialMeasures,
    compare_before_after,
    measure_trial,
)
from engine.kinematics.events import find_conditions
from engine.storage.results import StoredResult

__all__ = ["compare_results", "measure_result", "read_exposure"]

CAMERA_TRAVEL, STEADY_TRAVEL = "camera_travel", 0.005
"""As in `engine.pipeline`, which writes the first and judges by the second."""


def read_exposure(stored: StoredResult) -> Exposure:
    """Return what the risk methods judged when a trial was assessed.

    The conditions of the clip are not stored; they are found again in its track and scene.
    """
    time_s = stored.corrected.time_s
    return Exposure(
        track=stored.corrected,
        angles=stored.angles,
        lifts=stored.lifts,
        subject=stored.subject,
        task=stored.task,
        observed_s=float(time_s[-1] - time_s[0]) if time_s.size else 0.0,
        conditions=tuple(_find_conditions(stored)),
    )


def _find_conditions(stored: StoredResult) -> Iterator[str]:
    yield from find_conditions(stored.corrected, stored.subject.stature.value)
    if stored.corrected.provenance.get(CAMERA_TRAVEL, 0.0) > STEADY_TRAVEL:
        yield "camera_moved"
    if not stored.scene.provenance.get("upright_frames"):
        yield "never_upright"


def measure_result(stored: StoredResult) -> TrialMeasures:
    """Return the numbers by which a stored trial is compared with others."""
    document = stored.document
    return measure_trial(
        label=document["label"] or stored.folder.name,
        subject=stored.subject,
        task=stored.task,
        lifts=stored.lifts,
        angles=stored.angles,
        risk=stored.risk,
        settings={
            "estimator": document["backend"],
            "solver": document["solver"],
            "number of cameras": str(len(document["views"])),
        },
    )


def compare_results(before: Sequence[StoredResult], after: Sequence[StoredResult]) -> BeforeAfter:
    """Compare two sets of stored trials; see `engine.ergonomics.before_after`.

    Raises
    ------
    DataError
        If a set is empty, or a trial is in both.
    """
    known = {one.folder: measure_result(one) for one in (*before, *after)}
    return compare_before_after(
        [known[one.folder] for one in before], [known[one.folder] for one in after]
    )
