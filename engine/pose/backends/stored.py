"""Keypoints that were estimated before, read from a file instead of the pictures."""

from __future__ import annotations

import json
import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from engine.config import PoseConfig
from engine.datatypes import (
    Array,
    PersonBox,
    PoseTrack,
    ProgressCallback,
    Status,
    SubjectState,
    TrackedStream,
    ViewInfo,
    ViewPose,
)
from engine.errors import ConfigError, DataError
from engine.pose.base import BackendInfo
from engine.skeletons import MEDIAPIPE_33

BACKEND_INFO = BackendInfo(
    name="stored",
    title="Stored keypoints",
    skeleton=MEDIAPIPE_33.name,
    licence="that of the keypoints",
    description=(
        "Keypoints from a file named by pose.model, for the video they were made from: the "
        "tracks.npz of a result, or an .npz with time_s (T,), image (T, K, 2) in px and, if known, "
        "body (T, K, 3) in m, confidence (T, K) and skeleton."
    ),
    needs_video=False,
    takes_model=True,
)

Arrays = Mapping[str, NDArray[Any]]
PARTS = ("image", "body")


class Backend:
    """Keypoints from the file that `PoseConfig.model` names.

    Raises
    ------
    ConfigError
        If no file is named, or it does not exist.
    DataError
        If it does not hold keypoints.
    """

    info = BACKEND_INFO

    def __init__(self, config: PoseConfig) -> None:
        if not config.model:
            raise ConfigError(
                "The estimator 'stored' needs a file of keypoints; name it in the setting "
                "pose.model."
            )
        self._path = Path(config.model)
        self._tracks = read_stored_tracks(self._path)

    def estimate(
        self, frames: TrackedStream, view: ViewInfo, progress: ProgressCallback
    ) -> ViewPose:
        """Return the stored keypoints at the times of the frames; the pictures are not looked at.

        A frame takes the keypoints nearest in time, if they are less than half a frame away; the
        others are NaN.
        """
        time_s: list[float] = []
        boxes: list[PersonBox | None] = []
        others: list[tuple[PersonBox, ...]] = []
        for tracked in frames:
            time_s.append(tracked.frame.time_s)
            boxes.append(tracked.box)
            others.append(tracked.others)
            progress("pose", len(time_s), view.n_frames)
        times = np.array(time_s)
        body = self._tracks.get("body")
        return ViewPose(
            image=resample_track(self._tracks["image"], times),
            body=None if body is None else resample_track(body, times),
            box=np.array([_edges(box) for box in boxes]).reshape(-1, 4),
            state=tuple(SubjectState.LOST if b is None else b.state for b in boxes),
            info=view,
            others=tuple(others),
        )


def read_stored_tracks(path: Path) -> dict[str, PoseTrack]:
    """Read `image` and, if there is one, `body` from a file of keypoints.

    From the `tracks.npz` of a result the first view is taken.

    Raises
    ------
    ConfigError
        If the file does not exist.
    DataError
        If it does not hold keypoints.
    """
    if not path.is_file():
        raise ConfigError(f"There is no file of keypoints {path}; check its path.")
    try:
        with path.open("rb") as file, np.load(file, allow_pickle=False) as stored:
            arrays = {name: stored[name] for name in stored.files}
        return _unpack_result(arrays) if "view0_image_position" in arrays else _unpack_plain(arrays)
    except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile) as error:
        raise DataError(
            f"Expected keypoints in {path.name} (tracks.npz of a result, or an .npz with time_s "
            f"and image), but it can't be read as such: {error}."
        ) from error


def _unpack_result(arrays: Arrays) -> dict[str, PoseTrack]:
    meta = json.loads(str(arrays["meta"]))["views"][0]
    return {
        part: PoseTrack(
            time_s=arrays[f"view0_{part}_time_s"],
            position=arrays[f"view0_{part}_position"],
            confidence=arrays[f"view0_{part}_confidence"],
            sigma=arrays[f"view0_{part}_sigma"],
            status=arrays[f"view0_{part}_status"],
            unit=meta[part]["unit"],
            frame_of_reference=part,  # type: ignore[arg-type]
            skeleton=meta[part]["skeleton"],
        )
        for part in PARTS
        if meta[part] is not None
    }


def _unpack_plain(arrays: Arrays) -> dict[str, PoseTrack]:
    skeleton = str(arrays["skeleton"]) if "skeleton" in arrays else MEDIAPIPE_33.name
    return {
        part: PoseTrack(
            time_s=arrays["time_s"],
            position=arrays[part],
            confidence=arrays.get("confidence", np.full(arrays[part].shape[:2], np.nan)),
            unit="px" if part == "image" else "m",
            frame_of_reference=part,  # type: ignore[arg-type]
            skeleton=skeleton,
        )
        for part in PARTS
        if part == "image" or part in arrays
    }


def resample_track(track: PoseTrack, time_s: Array) -> PoseTrack:
    """Return the samples of a track nearest to given times; NaN where none is near.

    Parameters
    ----------
    track
        The stored track.
    time_s
        Shape (T,), increasing.

    Returns
    -------
    PoseTrack
        T frames; a sample is taken if it is at most half the usual step of `track` away.
    """
    row = _nearest_rows(track.time_s, time_s)
    is_far = row < 0

    def take(values: NDArray[Any] | None, missing: float) -> NDArray[Any]:
        assert values is not None  # set in __post_init__
        taken = np.full((len(row), *values.shape[1:]), missing, dtype=values.dtype)
        taken[~is_far] = values[row[~is_far]]
        return taken

    return PoseTrack(
        time_s=time_s,
        position=take(track.position, np.nan),
        unit=track.unit,
        frame_of_reference=track.frame_of_reference,
        skeleton=track.skeleton,
        confidence=take(track.confidence, np.nan),
        sigma=take(track.sigma, np.nan),
        status=take(track.status, Status.MISSING),
        provenance={"estimator": BACKEND_INFO.name},
    )


def _nearest_rows(stored_s: Array, time_s: Array) -> NDArray[np.intp]:
    """Return which stored sample is nearest to each time; -1 if it is over half a step away."""
    if stored_s.size == 0:
        return np.full(time_s.shape, -1)
    between = (stored_s[1:] + stored_s[:-1]) / 2
    row = np.searchsorted(between, time_s)
    step_s = float(np.median(np.diff(stored_s))) if stored_s.size > 1 else np.inf
    return np.where(np.abs(time_s - stored_s[row]) <= step_s / 2, row, -1)


def _edges(box: PersonBox | None) -> tuple[float, float, float, float]:
    if box is None:
        return (np.nan, np.nan, np.nan, np.nan)
    return (box.left, box.top, box.right, box.bottom)
