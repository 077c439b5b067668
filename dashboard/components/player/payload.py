"""What the player shows of a trial, as plain values and compact arrays. No Streamlit here."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dashboard import labels
from dashboard.charts import BAND_FACTOR
from engine.datatypes import Array, Camera, Flag, JointAngles, Lift, PoseTrack, Status
from engine.optics import camera_centre, normalise_points
from engine.skeletons import Skeleton, get_skeleton
from engine.storage.curation import FlagReview, TrialRecord, flag_key
from engine.storage.results import StoredResult

__all__ = ["Payload", "build_payload", "describe_flags", "order_flags"]

SURE = 0.5
"""Below this confidence a joint is drawn as doubtful, as in the annotated video."""
SEEN, DOUBTFUL, FILLED = 1, 2, 3
"""How a joint is drawn; 0 is missing and drawn nowhere."""
MIDLINE = (("pelvis", "thorax"), ("thorax", "mid_ear"))
"""Bones that no keypoints span, so that trunk and head hang together."""
FRUSTUM_M = 0.35
"""Length at which the edges of a camera's picture are drawn."""


@dataclass(frozen=True)
class Payload:
    """One trial for the player.

    Parameters
    ----------
    meta
        Plain values: what the points, bones, curves, lifts and cameras are called.
    arrays
        Little-endian samples in C order: `time` (T,) and `points` (T, P, 3) in float32,
        `states` (T, P) in uint8, `values` and `halves` (T, A) in float32, where a half is half
        the width of the 95 % band; `marks` (T, A) in uint8, 1 where a sample was filled in.
    """

    meta: Mapping[str, Any]
    arrays: Mapping[str, bytes]


def build_payload(result: StoredResult) -> Payload:
    """Gather what does not change while a trial is looked at."""
    track = result.corrected
    names, bones = _points(get_skeleton(track.skeleton))
    angles, groups = _curves(result.angles)
    meta = {
        "points": names,
        "bones": bones,
        "hands": [names.index(n) for n in ("left_wrist", "right_wrist") if n in names],
        "groups": groups,
        "lifts": [_describe_lift(number, lift) for number, lift in enumerate(result.lifts, 1)],
        "cameras": _cameras(result),
        "n_frames": track.n_frames,
    }
    position, states = _sample_points(track, names)
    columns = [result.angles.names.index(name) for name in angles]
    status = result.angles.status
    marks = np.zeros((track.n_frames, len(angles)), dtype=np.uint8)
    if status is not None and columns:
        marks = (status[:, columns] == Status.FILLED).astype(np.uint8)
    return Payload(
        meta=meta,
        arrays={
            "time": _floats(track.time_s),
            "points": _floats(position),
            "states": states.tobytes(),
            "values": _floats(result.angles.value_deg[:, columns]),
            "halves": _floats(BAND_FACTOR * result.angles.sigma_deg[:, columns]),
            "marks": marks.tobytes(),
        },
    )


def _floats(values: Array) -> bytes:
    return np.ascontiguousarray(values, dtype="<f4").tobytes()


# --------------------------------------------------------------------------- the body


def _points(skeleton: Skeleton) -> tuple[list[str], list[list[Any]]]:
    """Return the points that bones need, and the bones as (from, to, side)."""
    midline = tuple(bone for bone in MIDLINE if all(skeleton.has(name) for name in bone))
    known = {frozenset(edge) for edge in skeleton.edges}
    edges = [*skeleton.edges, *(bone for bone in midline if frozenset(bone) not in known)]
    names = list(dict.fromkeys(name for edge in edges for name in edge))
    bones = [[names.index(a), names.index(b), _side(a, b)] for a, b in edges]
    return names, bones


def _side(*names: str) -> str:
    for side in ("left", "right"):
        if all(name.startswith(f"{side}_") for name in names):
            return side
    return "middle"


def _sample_points(track: PoseTrack, names: Sequence[str]) -> tuple[Array, NDArray[np.uint8]]:
    """Return positions (T, P, 3) and how each is drawn (T, P)."""
    skeleton = get_skeleton(track.skeleton)
    position = np.stack([skeleton.point(track.position, name) for name in names], axis=1)
    states = np.stack([_state_of(track, skeleton, name) for name in names], axis=1)
    states[~np.isfinite(position).all(axis=2)] = 0
    return position, states.astype(np.uint8)


def _state_of(track: PoseTrack, skeleton: Skeleton, name: str) -> NDArray[np.int64]:
    """Return how sure a point is; a derived one is as unsure as the worst of its parts."""
    parts = [name] if name in skeleton.keypoints else list(skeleton.derived[name])
    columns = [skeleton.index(part) for part in parts]
    assert track.confidence is not None  # set by PoseTrack itself
    assert track.status is not None
    doubtful = (track.confidence[:, columns] < SURE).any(axis=1)
    filled = (track.status[:, columns] == Status.FILLED).any(axis=1)
    return np.where(filled, FILLED, np.where(doubtful, DOUBTFUL, SEEN))


def _cameras(result: StoredResult) -> list[dict[str, Any]]:
    """Return the calibrated cameras as pyramids in the world."""
    if result.calibration is None:
        return []
    return [_pyramid(camera) for camera in result.calibration.cameras]


def _pyramid(camera: Camera) -> dict[str, Any]:
    width, height = camera.size_px
    corners = np.array([[0, 0], [width, 0], [width, height], [0, height]], dtype=float)
    flat = normalise_points(camera, corners)
    # A strong lens may not reach its own corners; the pin-hole then says about where they look.
    plain = normalise_points(replace(camera, distortion=np.zeros(5)), corners)
    flat = np.where(np.isfinite(flat), flat, plain)
    eye = camera_centre(camera)
    ends = eye + FRUSTUM_M * np.column_stack([flat, np.ones(4)]) @ camera.rotation
    return {"name": camera.name, "eye": eye.tolist(), "corners": ends.tolist()}


# --------------------------------------------------------------------------- curves and marks


def _curves(angles: JointAngles) -> tuple[list[str], list[dict[str, Any]]]:
    """Return the shown angles, and how they are grouped by joint."""
    shown: list[str] = []
    groups = []
    for title, names in labels.JOINTS.items():
        there = [name for name in names if name in angles.names]
        if there:
            curves = [
                {"column": len(shown) + k, "label": labels.name_angle(name)}
                for k, name in enumerate(there)
            ]
            groups.append({"title": title, "curves": curves})
            shown += there
    return shown, groups


def _describe_lift(number: int, lift: Lift) -> dict[str, Any]:
    return {
        "label": f"Lift {number}",
        "reach": _plain(lift.reach_start_s),
        "start": _plain(lift.start_s),
        "end": _plain(lift.end_s),
        "return": _plain(lift.return_end_s),
    }


def _plain(value: float) -> float | None:
    """Return a number that JSON knows."""
    return value if math.isfinite(value) else None


def order_flags(flags: Sequence[Flag]) -> tuple[Flag, ...]:
    """Return flags the most urgent first, then by time; those of the whole trial last."""
    urgency = list(labels.LEVELS)

    def place(flag: Flag) -> tuple[int, float]:
        start = flag.start_s if math.isfinite(flag.start_s) else math.inf
        return urgency.index(flag.level), start

    return tuple(sorted(flags, key=place))


def describe_flags(result: StoredResult, record: TrialRecord | None) -> list[dict[str, Any]]:
    """Return the flags in the order of their number keys, with what was said to them."""
    return list(_describe_flags(order_flags(result.flags), record))


def _describe_flags(flags: Sequence[Flag], record: TrialRecord | None) -> Iterator[dict[str, Any]]:
    for flag in flags:
        label = labels.LEVELS[flag.level]
        said: FlagReview | None = record.verdict(flag) if record else None
        yield {
            "key": flag_key(flag),
            "css": label.css,
            "word": label.word,
            "what": labels.typeset(flag.what),
            "why": labels.typeset(flag.why),
            "start": _plain(flag.start_s),
            "end": _plain(flag.end_s),
            "review": labels.REVIEWS[said.verdict] if said else "",
        }
