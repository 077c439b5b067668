"""`tracks.npz`: every track, box and angle curve of a result, exact and without pickle.

Arrays are named `<part>_<field>`, the parts being `raw`, `corrected`, `view0_image`,
`view0_body`, `view0`, `angles` and, where a body model was fitted, `model`; the array `meta`
holds what is not an array (units, frames of reference, skeletons, names, provenance) as JSON
text.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from engine.datatypes import (
    Array,
    BodyFit,
    JointAngles,
    PersonBox,
    PoseTrack,
    SubjectState,
    ViewInfo,
    ViewPose,
)
from engine.errors import DataError
from engine.skeletons import get_skeleton
from engine.storage.document import decode_number, decode_plain, encode_number, encode_plain

__all__ = ["StoredTracks", "read_tracks", "write_tracks"]

TRACK_ARRAYS = ("time_s", "position", "confidence", "sigma", "status")
ANGLE_ARRAYS = ("time_s", "value_deg", "sigma_deg", "status")
STATES = tuple(SubjectState)

Arrays = dict[str, NDArray[Any]]


@dataclass(frozen=True, eq=False)
class StoredTracks:
    """The curves of one result."""

    raw: PoseTrack
    corrected: PoseTrack
    views: tuple[ViewPose, ...]
    angles: JointAngles
    body: BodyFit | None = None


def write_tracks(
    path: Path,
    *,
    raw: PoseTrack,
    corrected: PoseTrack,
    views: Sequence[ViewPose],
    angles: JointAngles,
    body: BodyFit | None = None,
) -> None:
    """Write all curves of a result into one compressed file."""
    arrays: Arrays = {}
    meta: dict[str, Any] = {"views": []}
    for part, track in (("raw", raw), ("corrected", corrected)):
        meta[part] = _pack_track(arrays, part, track)
    for index, view in enumerate(views):
        meta["views"].append(_pack_view(arrays, f"view{index}", view))
    arrays |= {f"angles_{name}": getattr(angles, name) for name in ANGLE_ARRAYS}
    meta["angles"] = {"names": list(angles.names), "convention": angles.convention}
    if body is not None:
        arrays["model_residual_m"] = body.residual_m
        meta["model"] = {
            "joints": _pack_track(arrays, "model", body.joints),
            "segment_lengths_m": encode_plain(body.segment_lengths_m),
        }
    text = json.dumps(meta, allow_nan=False)
    np.savez_compressed(path, allow_pickle=False, meta=np.array(text), **arrays)


def read_tracks(path: Path, infos: Sequence[ViewInfo]) -> StoredTracks:
    """Read what `write_tracks` wrote.

    Parameters
    ----------
    path
        The file.
    infos
        The facts about the video of every view, which `trial.json` holds.

    Raises
    ------
    DataError
        If the file is missing, damaged or lacks a part.
    """
    try:
        # Opened here because np.load forgets to close a file that it can't make sense of.
        with path.open("rb") as file, np.load(file, allow_pickle=False) as stored:
            arrays = {name: stored[name] for name in stored.files}
        meta = json.loads(str(arrays["meta"]))
        return StoredTracks(
            raw=_unpack_track(arrays, "raw", meta["raw"]),
            corrected=_unpack_track(arrays, "corrected", meta["corrected"]),
            views=tuple(
                _unpack_view(arrays, f"view{index}", view_meta, info)
                for index, (view_meta, info) in enumerate(zip(meta["views"], infos, strict=True))
            ),
            angles=_unpack_angles(arrays, meta["angles"]),
            body=_unpack_body(arrays, meta.get("model")),
        )
    except Exception as error:
        # Changed bytes make the formats beneath (zip, npy headers, JSON) raise almost anything.
        raise DataError(
            f"The curves in {path} can't be read ({type(error).__name__}: {error}); "
            "the result is damaged, so assess the video again."
        ) from error


def _pack_track(arrays: Arrays, part: str, track: PoseTrack) -> dict[str, Any]:
    arrays |= {f"{part}_{name}": getattr(track, name) for name in TRACK_ARRAYS}
    return {
        "unit": track.unit,
        "frame_of_reference": track.frame_of_reference,
        "skeleton": track.skeleton,
        "keypoints": list(get_skeleton(track.skeleton).keypoints),
        "provenance": encode_plain(track.provenance),
    }


def _unpack_track(arrays: Mapping[str, Any], part: str, meta: Mapping[str, Any]) -> PoseTrack:
    return PoseTrack(
        **{name: arrays[f"{part}_{name}"] for name in TRACK_ARRAYS},
        unit=meta["unit"],
        frame_of_reference=meta["frame_of_reference"],
        skeleton=meta["skeleton"],
        provenance=decode_plain(meta["provenance"]),
    )


def _pack_view(arrays: Arrays, part: str, view: ViewPose) -> dict[str, Any]:
    arrays[f"{part}_box"] = view.box
    arrays[f"{part}_state"] = np.array([STATES.index(s) for s in view.state], dtype=np.uint8)
    arrays[f"{part}_others"] = _pack_others(view.others)
    return {
        "image": _pack_track(arrays, f"{part}_image", view.image),
        "body": None if view.body is None else _pack_track(arrays, f"{part}_body", view.body),
        "has_others": bool(view.others),
        "model_time_s": encode_number(view.model_time_s),
    }


def _unpack_view(
    arrays: Mapping[str, Any], part: str, meta: Mapping[str, Any], info: ViewInfo
) -> ViewPose:
    image = _unpack_track(arrays, f"{part}_image", meta["image"])
    others = _unpack_others(arrays[f"{part}_others"], image.n_frames)
    has_body = meta["body"] is not None
    return ViewPose(
        image=image,
        body=_unpack_track(arrays, f"{part}_body", meta["body"]) if has_body else None,
        box=arrays[f"{part}_box"],
        state=tuple(STATES[code] for code in arrays[f"{part}_state"]),
        info=info,
        others=others if meta["has_others"] else (),
        model_time_s=decode_number(meta["model_time_s"]),
    )


def _pack_others(others: Sequence[Sequence[PersonBox]]) -> Array:
    """Return one row per box: frame, left, top, right, bottom, confidence, overlap, state."""
    rows = [
        (f, b.left, b.top, b.right, b.bottom, b.confidence, b.iou, STATES.index(b.state))
        for f, boxes in enumerate(others)
        for b in boxes
    ]
    return np.array(rows, dtype=np.float64).reshape(-1, 8)


def _unpack_others(rows: Array, n_frames: int) -> tuple[tuple[PersonBox, ...], ...]:
    boxes: list[list[PersonBox]] = [[] for _ in range(n_frames)]
    for frame, left, top, right, bottom, confidence, iou, state in rows.tolist():
        boxes[int(frame)].append(
            PersonBox(left, top, right, bottom, confidence, iou, STATES[int(state)])
        )
    return tuple(tuple(row) for row in boxes)


def _unpack_angles(arrays: Mapping[str, Any], meta: Mapping[str, Any]) -> JointAngles:
    return JointAngles(
        **{name: arrays[f"angles_{name}"] for name in ANGLE_ARRAYS},
        names=tuple(meta["names"]),
        convention=meta["convention"],
    )


def _unpack_body(arrays: Mapping[str, Any], meta: Mapping[str, Any] | None) -> BodyFit | None:
    if meta is None:
        return None
    return BodyFit(
        joints=_unpack_track(arrays, "model", meta["joints"]),
        residual_m=arrays["model_residual_m"],
        segment_lengths_m=meta["segment_lengths_m"],
    )
