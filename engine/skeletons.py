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

__all__ = [
    "BODY_SEGMENTS",
    "H36M_17",
    "LIFTING_45",
    "MARKER_SETS",
    "MEDIAPIPE_33",
    "SKELETONS",
    "SYNTHETIC_45",
    "MarkerSet",
    "Skeleton",
    "get_skeleton",
]

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


@dataclass(frozen=True)
class MarkerSet(Skeleton):
    """A set of skin markers, each on a named landmark of the body.

    Parameters
    ----------
    landmarks
        One per marker: `c7`, `left_asis`, `right_lateral_knee` and so on. Markers of two sets with
        the same landmark are the same point of the body.
    """

    landmarks: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        if len(self.landmarks) != len(self.keypoints):
            raise DataError(
                f"Marker set {self.name!r} needs one landmark per marker: {len(self.keypoints)} "
                f"markers, {len(self.landmarks)} landmarks."
            )

    @property
    def pairs(self) -> tuple[tuple[int, int], ...]:
        """Columns of every marker on the left and its partner on the right."""
        return tuple(
            (i, self.landmarks.index(name.replace("left_", "right_", 1)))
            for i, name in enumerate(self.landmarks)
            if name.startswith("left_")
        )

    @property
    def of_landmark(self) -> Mapping[str, str]:
        """The marker on each landmark: landmark -> marker."""
        return dict(zip(self.landmarks, self.keypoints, strict=True))

    def columns_in(self, other: MarkerSet) -> dict[int, int]:
        """Return which markers another set has too: own column -> column there."""
        theirs = {landmark: i for i, landmark in enumerate(other.landmarks)}
        return {i: theirs[name] for i, name in enumerate(self.landmarks) if name in theirs}


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

_PAIRED_LANDMARKS: Mapping[str, tuple[str, str]] = {
    "front_head": ("", "FHD"),
    "back_head": ("", "BHD"),
    "side_head": ("", ""),
    "asis": ("ASIS", "ASI"),
    "psis": ("PSIS", "PSI"),
    "acromion": ("AC", "SHO"),
    "upper_arm": ("UA", "UPA"),
    "lateral_elbow": ("LHE", "ELL"),
    "medial_elbow": ("MHE", "ELM"),
    "radial_wrist": ("RS", "WRR"),
    "ulnar_wrist": ("US", "WRU"),
    "knuckle": ("MC3", "FIN"),
    "trochanter": ("GT", "GTR"),
    "lateral_knee": ("LE", "LEP"),
    "medial_knee": ("ME", "MEP"),
    "fibula_head": ("HF", "HFB"),
    "tibial_tuberosity": ("TT", ""),
    "lateral_ankle": ("LM", "LML"),
    "medial_ankle": ("MM", "MML"),
    "heel": ("CA", "CAL"),
    "first_metatarsal": ("FM", "MT1"),
    "fifth_metatarsal": ("VM", "MT5"),
}
"""Landmarks on both sides: the marker's name without R or L in `LIFTING_45` and `SYNTHETIC_45`."""


def _sided(side: str, column: int, *landmarks: str) -> dict[str, str]:
    """Return marker -> landmark of one side, in the order of `landmarks`."""
    letter = {"right": "R", "left": "L"}[side]
    return {letter + _PAIRED_LANDMARKS[mark][column]: f"{side}_{mark}" for mark in landmarks}


def _marker_set(name: str, markers: Mapping[str, str]) -> MarkerSet:
    """Build a set from marker -> landmark; joints between two of its markers are derived."""
    of = {landmark: marker for marker, landmark in markers.items()}
    joints = {
        f"{side}_{joint}": {
            of[f"{side}_{first}_{joint}"]: 0.5,
            of[f"{side}_{second}_{joint}"]: 0.5,
        }
        for side in ("left", "right")
        for joint, first, second in (
            ("knee", "lateral", "medial"),
            ("ankle", "lateral", "medial"),
            ("elbow", "lateral", "medial"),
            ("wrist", "radial", "ulnar"),
        )
    }
    chains = [("notch", "xiphoid"), ("c7", "t10"), ("left_asis", "right_asis")]
    chains += [("left_psis", "right_psis"), ("c7", "notch")]
    for side in ("left", "right"):
        arm = ("acromion", "lateral_elbow", "radial_wrist", "knuckle")
        leg = (
            "trochanter",
            "lateral_knee",
            "lateral_ankle",
            "fifth_metatarsal",
            "first_metatarsal",
        )
        for chain in (
            ("c7", *(f"{side}_{part}" for part in arm)),
            tuple(f"{side}_{part}" for part in ("asis", *leg, "heel")),
        ):
            chains += pairwise(chain)
        chains += [(f"{side}_asis", f"{side}_psis"), ("t10", f"{side}_psis")]
    return MarkerSet(
        name=name,
        keypoints=tuple(markers),
        edges=tuple((of[a], of[b]) for a, b in chains),
        derived=joints,
        landmarks=tuple(markers.values()),
    )


_ARM = ("upper_arm", "lateral_elbow", "medial_elbow", "radial_wrist", "ulnar_wrist", "knuckle")
_THIGH = ("trochanter", "lateral_knee", "medial_knee")
_FOOT = ("lateral_ankle", "medial_ankle", "heel", "first_metatarsal", "fifth_metatarsal")
_TRUNK = {"C7": "c7", "T10": "t10"}

LIFTING_45 = _marker_set(
    "lifting_45",
    {
        "HFRONT": "forehead",
        "HRSIDE": "right_side_head",
        "HLSIDE": "left_side_head",
        **_TRUNK,
        "IJ": "notch",
        "PX": "xiphoid",
        **_sided("right", 0, "acromion", *_ARM, "asis", "psis", *_THIGH),
        **_sided("right", 0, "fibula_head", "tibial_tuberosity", *_FOOT),
        **_sided("left", 0, "acromion", *_ARM, "asis", "psis", *_THIGH),
        **_sided("left", 0, "fibula_head", "tibial_tuberosity", *_FOOT),
    },
)
"""The 45 anatomical landmarks of the two-view lifting method, after Cappozzo et al. (1995)."""

SYNTHETIC_45 = _marker_set(
    "synthetic_45",
    {
        "HTOP": "vertex",
        **_sided("right", 1, "front_head", "back_head"),
        **_sided("left", 1, "front_head", "back_head"),
        **_TRUNK,
        "CLAV": "notch",
        "STRN": "xiphoid",
        **_sided("right", 1, "asis", "psis", "acromion", *_ARM, *_THIGH, "fibula_head", *_FOOT),
        **_sided("left", 1, "asis", "psis", "acromion", *_ARM, *_THIGH, "fibula_head", *_FOOT),
    },
)
"""The 45 markers of the synthetic lifts, in the order of their files."""

MARKER_SETS: Mapping[str, MarkerSet] = {s.name: s for s in (LIFTING_45, SYNTHETIC_45)}

SKELETONS: Mapping[str, Skeleton] = {
    s.name: s for s in (MEDIAPIPE_33, H36M_17, *MARKER_SETS.values())
}


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
