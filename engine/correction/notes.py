"""What was corrected and why, as plain values for the provenance of a track."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from engine.correction.diagnosis import Diagnosis
from engine.correction.gaps import find_runs
from engine.correction.swaps import SwapInterval
from engine.datatypes import Array, PoseTrack
from engine.skeletons import get_skeleton

__all__ = ["describe_diagnosis", "list_unrepairable", "list_warnings"]

Mask = NDArray[np.bool_]
LONGEST_LIST = 40
"""More findings than this say less, not more; the counts stay complete."""


def describe_diagnosis(found: Diagnosis) -> dict[str, Any]:
    """Count samples per class and list the intervals of exchanged sides, s."""
    time_s, outliers = found.track.time_s, found.outliers
    note: dict[str, Any] = {
        "rejected": int(found.is_rejected.sum()),
        "doubtful": int(found.is_doubtful.sum()),
    }
    if outliers is not None:
        lost = outliers.is_lost[:, None] & found.track.is_present
        note |= {
            "misdetected": int((outliers.is_misdetected & found.track.is_present).sum()),
            "lost": int(lost.sum()),
            "jitter": int(outliers.is_jitter.sum()),
        }
    if found.swaps is not None:
        listed = found.swaps.intervals
        note |= {
            "exchanged": int(found.swaps.is_exchanged.sum()),
            "swaps": [_as_plain(i, time_s) for i in listed if i.is_repaired][:LONGEST_LIST],
            "possible_swaps": [_as_plain(i, time_s) for i in listed if not i.is_repaired][
                :LONGEST_LIST
            ],
        }
    return note


def _as_plain(interval: SwapInterval, time_s: Array) -> dict[str, Any]:
    return {
        "start_s": round(float(time_s[interval.start]), 4),
        "end_s": round(float(time_s[interval.stop - 1]), 4),
        "parts": list(interval.parts),
        "back_to_front": interval.reflected,
        "margin": round(interval.margin, 1),
    }


def list_unrepairable(
    corrected: PoseTrack, found: Diagnosis, *, max_gap_s: float
) -> list[dict[str, Any]]:
    """List the stretches that were rejected and stay missing, with the reason.

    Keypoints that are missing over the same frames for the same reason share an entry.
    """
    stretches: dict[tuple[int, int, str], list[str]] = {}
    names = get_skeleton(corrected.skeleton).keypoints
    missing = found.is_rejected & ~corrected.is_present
    for k in np.flatnonzero(missing.any(axis=0)):
        for start, stop in find_runs(missing[:, k]):
            reason = _reason(found, start, stop, int(k))
            stretches.setdefault((start, stop, reason), []).append(names[k])
    time_s = corrected.time_s
    listed = [
        {
            "start_s": round(float(time_s[start]), 4),
            "end_s": round(float(time_s[stop - 1]), 4),
            "keypoints": keypoints,
            "reason": reason,
            "why_missing": _why_missing(start, stop, time_s, max_gap_s),
        }
        for (start, stop, reason), keypoints in sorted(stretches.items())
    ]
    return listed[:LONGEST_LIST]


def _reason(found: Diagnosis, start: int, stop: int, keypoint: int) -> str:
    """Return the class that explains most of a stretch."""
    part = slice(start, stop)
    shares = {"low confidence": found.is_doubtful[part, keypoint].mean()}
    if found.outliers is not None:
        shares["person lost"] = found.outliers.is_lost[part].mean()
        shares["misdetection"] = found.outliers.is_misdetected[part, keypoint].mean()
    return max(shares, key=lambda name: float(shares[name]))


def _why_missing(start: int, stop: int, time_s: Array, max_gap_s: float) -> str:
    if start == 0 or stop == len(time_s):
        return "at an end of the clip"
    if time_s[stop] - time_s[start - 1] > max_gap_s:
        return f"longer than {max_gap_s:g} s"
    return "part of a longer gap"


def list_warnings(found: Diagnosis, unrepairable: int) -> list[str]:
    """Say in plain words what makes the corrected track doubtful."""
    warnings = []
    if found.outliers is not None and found.outliers.is_unsteady.any():
        count = int(found.outliers.is_unsteady.sum())
        warnings.append(
            f"{count} of {found.outliers.is_unsteady.size} links change their length in most of "
            "the frames: the keypoints are unreliable throughout, and outliers among them can't "
            "be told from the rest."
        )
    if found.swaps is not None:
        doubtful = sum(not i.is_repaired for i in found.swaps.intervals)
        if doubtful:
            warnings.append(
                f"Left and right may be exchanged in {doubtful} stretch(es), but not surely enough "
                "to change the labels; look at `possible_swaps`."
            )
        n_exchanged = int(found.swaps.is_exchanged.any(axis=1).sum())
        if 2 * n_exchanged > found.track.n_frames:
            warnings.append(
                "Left and right were exchanged in more than half of the frames, judged by which "
                "way knees, toes and nose point. If the video is mirrored, film again."
            )
    if unrepairable:
        warnings.append(
            f"{unrepairable} stretch(es) of keypoints were misplaced for too long to be filled and "
            "stay missing."
        )
    return warnings
