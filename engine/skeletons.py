"""Keypoint sets as data: names, segments, left/right pairs and derived points.

Left and right are the subject's. A skeleton may have more keypoints than another,
but the same point has the same name everywhere.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from itertools import pairwise

import numpy as np

from engine.datatypes import Array
from engine.errors import ConfigError, DataError

__all__ = ["BODY_SEGMENTS", "H36M_17", "MEDIAPIPE_33", "SKELETONS", "Skeleton", "get_skeleton"]

DERIVED_POINTS: Mapping[str, Mapping[str, float]] = {
    "pelvis": {"left_hip": 0.5, "right_hip": 0.5},
    "thorax": {"left_shoulder": 0.5, "right_shoulder": 0.5},
    "mid_ankle": {"left_ankle": 0.5, "right_ankle": 0.5},
    "mid_wrist": {"left_wrist": 0.5, "right_wrist": 0.5},
    "mid_ear": {"left_ear": 0.5, "right_ear": 0.5},
}

BODY_SEGMENTS: tuple[tuple[str, str, str], ...] = (
    ("shoulder_width", "left_shoulder", "right_shoulder"),
    ("pelvis_width", "left_hip", "right_hip"),
    ("left_thigh", "left_hip", "left_knee"),
    ("right_thigh", "right_hip", "right_knee"),
    ("left_shank", "left_knee", "left_ankle"),
    ("right_shank", "right_knee", "right_ankle"),
    ("left_upper_arm", "left_shoulder", "left_elbow"),
    ("right_upper_arm", "right_shoulder", "right_elbow"),
    ("left_forearm", "left_elbow", "left_wrist"),
    ("right_forearm", "right_elbow", "right_wrist"),
)
"""The ten links of Choi et al. (2024): name, proximal and distal keypoint."""


@dataclass(frozen=True)
class Skeleton:
    """A named set of keypoints.

    Parameters
    ----------
    name
        Key of the skeleton.
    keypoints
        Names in array order.
    edges
        Pairs of names to draw as bones.
    derived
        Points that are weighted means of keypoints: name -> {keypoint: weight}.
    """

    name: str
    keypoints: tuple[str, ...]
    edges: tuple[tuple[str, str], ...]
    derived: Mapping[str, Mapping[str, float]] = field(default_factory=lambda: DERIVED_POINTS)

    def index(self, keypoint: str) -> int:
        """Return the column of a keypoint.

        Raises
        ------
        DataError
            If the skeleton has no such keypoint.
        """
        if keypoint not in self.keypoints:
            raise DataError(f"Skeleton {self.name!r} has no keypoint {keypoint!r}.")
        return self.keypoints.index(keypoint)

    def has(self, name: str) -> bool:
        """Whether `name` is a keypoint or can be derived from keypoints."""
        return name in self.keypoints or all(
            part in self.keypoints for part in self.derived.get(name, {"": 0.0})
        )

    def point(self, position: Array, name: str) -> Array:
        """Return one point over time.

        Parameters
        ----------
        position
            Shape (T, K, D).
        name
            A keypoint, or a derived point such as `pelvis`.

        Returns
        -------
        Array
            Shape (T, D); NaN where one of the parts is missing.
        """
        if name in self.keypoints:
            return position[:, self.index(name)]
        if not self.has(name):
            raise DataError(f"Skeleton {self.name!r} has no point {name!r}.")
        parts = self.derived[name]
        return np.asarray(sum(w * position[:, self.index(k)] for k, w in parts.items()))

    @property
    def pairs(self) -> tuple[tuple[int, int], ...]:
        """Columns of every left keypoint and its right partner."""
        return tuple(
            (i, self.keypoints.index(name.replace("left_", "right_", 1)))
            for i, name in enumerate(self.keypoints)
            if name.startswith("left_")
        )

    @property
    def mirror_order(self) -> tuple[int, ...]:
        """Column order that exchanges left and right."""
        order = list(range(len(self.keypoints)))
        for left, right in self.pairs:
            order[left], order[right] = right, left
        return tuple(order)


def _both(*names: str) -> tuple[str, ...]:
    """Return left and right of each name, alternating."""
    return tuple(f"{side}_{name}" for name in names for side in ("left", "right"))


def _limb_edges(*chain: str) -> tuple[tuple[str, str], ...]:
    return tuple(
        (f"{side}_{a}", f"{side}_{b}") for side in ("left", "right") for a, b in pairwise(chain)
    )


_TORSO_EDGES = (
    ("left_shoulder", "right_shoulder"),
    ("left_hip", "right_hip"),
    ("left_shoulder", "left_hip"),
    ("right_shoulder", "right_hip"),
)

MEDIAPIPE_33 = Skeleton(
    name="mediapipe_33",
    keypoints=(
        "nose",
        "left_eye_inner",
        "left_eye",
        "left_eye_outer",
        "right_eye_inner",
        "right_eye",
        "right_eye_outer",
        "left_ear",
        "right_ear",
        "left_mouth",
        "right_mouth",
        *_both("shoulder", "elbow", "wrist", "pinky", "index", "thumb"),
        *_both("hip", "knee", "ankle", "heel", "big_toe"),
    ),
    edges=(
        *_TORSO_EDGES,
        *_limb_edges("shoulder", "elbow", "wrist", "index"),
        *_limb_edges("hip", "knee", "ankle", "heel", "big_toe", "ankle"),
        ("left_ear", "nose"),
        ("right_ear", "nose"),
    ),
)
"""BlazePose's 33 landmarks in MediaPipe's order; `foot_index` is `big_toe` here."""

H36M_17 = Skeleton(
    name="h36m_17",
    keypoints=(
        "pelvis",
        "right_hip",
        "right_knee",
        "right_ankle",
        "left_hip",
        "left_knee",
        "left_ankle",
        "spine",
        "thorax",
        "nose",
        "head",
        "left_shoulder",
        "left_elbow",
        "left_wrist",
        "right_shoulder",
        "right_elbow",
        "right_wrist",
    ),
    edges=(
        *_limb_edges("hip", "knee", "ankle"),
        *_limb_edges("shoulder", "elbow", "wrist"),
        ("pelvis", "left_hip"),
        ("pelvis", "right_hip"),
        ("pelvis", "spine"),
        ("spine", "thorax"),
        ("thorax", "left_shoulder"),
        ("thorax", "right_shoulder"),
        ("thorax", "nose"),
        ("nose", "head"),
    ),
)
"""The 17 joints of Human3.6M, the common skeleton of the lifting networks."""

SKELETONS: Mapping[str, Skeleton] = {s.name: s for s in (MEDIAPIPE_33, H36M_17)}


def get_skeleton(name: str) -> Skeleton:
    """Return a skeleton by name.

    Raises
    ------
    ConfigError
        If there is none of that name.
    """
    if name not in SKELETONS:
        raise ConfigError(f"Unknown skeleton {name!r}; known: {', '.join(SKELETONS)}.")
    return SKELETONS[name]
