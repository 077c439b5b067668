"""What BlazePose really saw in the lifting trials of the training persons, beside the truth."""

from __future__ import annotations

import json
import logging
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from engine.datatypes import Array
from engine.pose.lifting.joints import to_h36m, to_h36m_confidence
from engine.training.corpus import MIRRORED, TRAINING_PERSONS, read_lift_joints

__all__ = ["Detected", "mirror_detected", "read_detected"]

logger = logging.getLogger(__name__)

_FLIP = np.array([-1.0, 1.0, 1.0])


@dataclass(frozen=True, eq=False)
class Detected:
    """One video.

    Parameters
    ----------
    person
        Who is seen.
    rays
        Shape (T, 17, 3), lines of sight (unit depth) to what BlazePose saw.
    confidence
        Shape (T, 17), BlazePose's own.
    joints
        Shape (T, 17, 3), m, true, camera axes (x right, y down, z away).
    stature_m
        The person's.
    """

    person: str
    rays: Array = field(repr=False)
    confidence: Array = field(repr=False)
    joints: Array = field(repr=False)
    stature_m: float


def mirror_detected(video: Detected) -> Detected:
    """Return the same as a mirror would show it."""
    return Detected(
        person=video.person,
        rays=video.rays[:, MIRRORED] * _FLIP,
        confidence=video.confidence[:, MIRRORED],
        joints=video.joints[:, MIRRORED] * _FLIP,
        stature_m=video.stature_m,
    )


def read_detected(
    data: Path, keypoints: Path, persons: tuple[str, ...] = TRAINING_PERSONS
) -> list[Detected]:
    """Read keypoints that `benchmarks/monocular_lifts.py` kept, with the truth.

    Parameters
    ----------
    data
        Folder of the synthetic lifts.
    keypoints
        The benchmark's cache.
    persons
        Whose videos; a video without keypoints is left out with a warning.
    """
    videos = []
    for person in persons:
        facts = json.loads((data / person / "subject.json").read_text(encoding="utf-8"))
        for truth in sorted((data / person).glob("*/truth.npz")):
            for camera in facts["calibration"]:
                file = keypoints / f"{truth.parent.name}_{camera['name']}.npz"
                if not file.exists():
                    logger.warning("There are no keypoints %s; left out", file.name)
                    continue
                videos.append(_read_video(file, truth, camera, person, facts["height_m"]))
    return videos


def _read_video(
    file: Path, truth: Path, camera: dict[str, list[list[float]]], person: str, stature_m: float
) -> Detected:
    with np.load(file, allow_pickle=False) as seen:
        image, confidence, time_s = to_h36m(seen["image"]), seen["confidence"], seen["time_s"]
    joints = np.asarray(read_lift_joints(truth, at_s=time_s), dtype=np.float64)
    joints = joints @ np.array(camera["R"]).T + np.array(camera["t"]).ravel()
    image, sure = _bridge(image, to_h36m_confidence(confidence))
    pixels = np.concatenate([image, np.ones((*image.shape[:2], 1))], axis=-1)
    return Detected(
        person=person,
        rays=pixels @ np.linalg.inv(np.array(camera["K"])).T,
        confidence=sure,
        joints=joints,
        stature_m=stature_m,
    )


def _bridge(image: Array, confidence: Array) -> tuple[Array, Array]:
    """Bridge frames in which nobody was seen, with no confidence."""
    seen = np.asarray(np.isfinite(image).all(axis=(1, 2)))
    rows = np.arange(len(image))
    filled = image.reshape(len(image), -1).copy()
    for column in filled.T:
        column[~seen] = np.interp(rows[~seen], rows[seen], column[seen])
    sure = np.where(seen[:, None], np.nan_to_num(confidence), 0.0)
    return filled.reshape(image.shape), sure
