"""Marker names of known label sets, as data, and the choice of the set a file uses.

A label set maps labels to landmarks. Landmarks on the skin are `left_asis`, `right_lateral_knee`
and so on; joint centres have the names of our keypoints (`left_knee`). Labels are compared without
case, separators and the subject's prefix, so that `L.ASIS`, `L_ASIS` and `Subject1:LASIS` are one.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

from engine.skeletons import SKELETONS, MarkerSet

__all__ = ["LABEL_SETS", "LANDMARKS", "LabelMatch", "LabelSet", "match_labels", "strip_prefixes"]

SIDES = {"left": ("L", "l"), "right": ("R", "r")}
MIN_MATCHES = 3


@dataclass(frozen=True)
class LabelSet:
    """A naming convention: `labels` maps a label as usually written to its landmark."""

    name: str
    title: str
    labels: Mapping[str, str]


@dataclass(frozen=True)
class LabelMatch:
    """Which set fits, and what its labels mean.

    `landmarks` maps landmark to the file's label; `unknown` are labels without a meaning here
    (clusters on the thigh, for example). `score` is the share of the set's landmarks that the file
    has, among those of its best-known part (at most 1).
    """

    label_set: str
    title: str
    landmarks: Mapping[str, str]
    unknown: tuple[str, ...]
    score: float


def _sided(
    patterns: Mapping[str, str], *, middle: Mapping[str, str] | None = None
) -> dict[str, str]:
    """Expand patterns with `{S}` (L/R) or `{s}` (l/r) to both sides; `middle` has no side."""
    labels = dict(middle or {})
    for side, (upper, lower) in SIDES.items():
        for pattern, landmark in patterns.items():
            labels[pattern.format(S=upper, s=lower)] = f"{side}_{landmark}"
    return labels


_PLUG_IN_GAIT = LabelSet(
    "plug_in_gait",
    "Plug-in Gait",
    _sided(
        {
            "{S}ASI": "asis",
            "{S}PSI": "psis",
            "{S}SHO": "acromion",
            "{S}ELB": "lateral_elbow",
            "{S}MEL": "medial_elbow",
            "{S}ELBM": "medial_elbow",
            "{S}WRA": "radial_wrist",
            "{S}WRB": "ulnar_wrist",
            "{S}FIN": "knuckle",
            "{S}KNE": "lateral_knee",
            "{S}KNM": "medial_knee",
            "{S}KNEM": "medial_knee",
            "{S}MKNE": "medial_knee",
            "{S}ANK": "lateral_ankle",
            "{S}MED": "medial_ankle",
            "{S}ANKM": "medial_ankle",
            "{S}MMA": "medial_ankle",
            "{S}HEE": "heel",
            "{S}TOE": "toe",
            "{S}FHD": "front_head",
            "{S}BHD": "back_head",
        },
        middle={"SACR": "sacrum", "C7": "c7", "T10": "t10", "CLAV": "notch", "STRN": "xiphoid"},
    ),
)
_HELEN_HAYES = LabelSet(
    "helen_hayes",
    "Helen Hayes",
    _sided(
        {
            "{S}.ASIS": "asis",
            "{S}.PSIS": "psis",
            "{S}.Shoulder": "acromion",
            "{S}.Acromium": "acromion",
            "{S}.Acromion": "acromion",
            "{S}.Elbow": "lateral_elbow",
            "{S}.Elbow.Lat": "lateral_elbow",
            "{S}.Elbow.Med": "medial_elbow",
            "{S}.Wrist": "mid_wrist",
            "{S}.Wrist.Lat": "radial_wrist",
            "{S}.Wrist.Med": "ulnar_wrist",
            "{S}.Knee": "lateral_knee",
            "{S}.Knee.Lat": "lateral_knee",
            "{S}.Knee.Med": "medial_knee",
            "{S}.Knee.Medial": "medial_knee",
            "{S}.Ankle": "lateral_ankle",
            "{S}.Ankle.Lat": "lateral_ankle",
            "{S}.Ankle.Med": "medial_ankle",
            "{S}.Ankle.Medial": "medial_ankle",
            "{S}.Heel": "heel",
            "{S}.Toe": "toe",
            "{S}.Toe.Tip": "toe",
        },
        middle={"V.Sacral": "sacrum", "Sacral": "sacrum", "Top.Head": "vertex", "Sternum": "notch"},
    ),
)
_LIFTLENS_45 = LabelSet(
    "liftlens_45",
    "45 anatomical landmarks",
    _sided(
        {
            "{S}ASIS": "asis",
            "{S}PSIS": "psis",
            "{S}AC": "acromion",
            "{S}UA": "upper_arm",
            "{S}LHE": "lateral_elbow",
            "{S}MHE": "medial_elbow",
            "{S}RS": "radial_wrist",
            "{S}US": "ulnar_wrist",
            "{S}MC3": "knuckle",
            "{S}GT": "trochanter",
            "{S}LE": "lateral_knee",
            "{S}ME": "medial_knee",
            "{S}HF": "fibula_head",
            "{S}TT": "tibial_tuberosity",
            "{S}LM": "lateral_ankle",
            "{S}MM": "medial_ankle",
            "{S}CA": "heel",
            "{S}FM": "first_metatarsal",
            "{S}VM": "fifth_metatarsal",
        },
        middle={
            "HFRONT": "forehead",
            "HRSIDE": "right_side_head",
            "HLSIDE": "left_side_head",
            "C7": "c7",
            "T10": "t10",
            "IJ": "notch",
            "PX": "xiphoid",
        },
    ),
)
_SYNTHETIC_45 = LabelSet(
    "synthetic_45",
    "45 markers of the synthetic lifts",
    _sided(
        {
            "{S}ASI": "asis",
            "{S}PSI": "psis",
            "{S}SHO": "acromion",
            "{S}UPA": "upper_arm",
            "{S}ELL": "lateral_elbow",
            "{S}ELM": "medial_elbow",
            "{S}WRR": "radial_wrist",
            "{S}WRU": "ulnar_wrist",
            "{S}FIN": "knuckle",
            "{S}GTR": "trochanter",
            "{S}LEP": "lateral_knee",
            "{S}MEP": "medial_knee",
            "{S}HFB": "fibula_head",
            "{S}LML": "lateral_ankle",
            "{S}MML": "medial_ankle",
            "{S}CAL": "heel",
            "{S}MT1": "first_metatarsal",
            "{S}MT5": "fifth_metatarsal",
            "{S}FHD": "front_head",
            "{S}BHD": "back_head",
        },
        middle={"HTOP": "vertex", "C7": "c7", "T10": "t10", "CLAV": "notch", "STRN": "xiphoid"},
    ),
)
_OPENCAP = LabelSet(
    "opencap",
    "OpenCap laboratory set",
    _sided(
        {
            "{s}.ASIS": "asis",
            "{s}.PSIS": "psis",
            "{S}_Shoulder": "acromion",
            "{S}_elbow_lat": "lateral_elbow",
            "{S}_elbow_med": "medial_elbow",
            "{S}_wrist_radius": "radial_wrist",
            "{S}_wrist_ulna": "ulnar_wrist",
            "{s}_knee": "lateral_knee",
            "{s}_mknee": "medial_knee",
            "{s}_ankle": "lateral_ankle",
            "{s}_mankle": "medial_ankle",
            "{s}_calc": "heel",
            "{s}_toe": "toe",
            "{s}_5meta": "fifth_metatarsal",
            "{S}_HJC": "hip",
            "{S}HJC": "hip",
            "{S}_Sternum": "sternum",
            "{s}_shoulder": "acromion",
            "{s}_lelbow": "lateral_elbow",
            "{s}_melbow": "medial_elbow",
            "{s}_lwrist": "radial_wrist",
            "{s}_mwrist": "ulnar_wrist",
        },
        middle={"C7": "c7", "Sternum": "notch"},
    ),
)
_ISB = LabelSet(
    "isb",
    "ISB landmarks",
    _sided(
        {
            "{S}ASIS": "asis",
            "{S}PSIS": "psis",
            "{S}AC": "acromion",
            "{S}AA": "scapular_angle",
            "{S}GH": "shoulder",
            "{S}EL": "lateral_elbow",
            "{S}EM": "medial_elbow",
            "{S}RS": "radial_wrist",
            "{S}US": "ulnar_wrist",
            "{S}LFE": "lateral_knee",
            "{S}MFE": "medial_knee",
            "{S}FLE": "lateral_knee",
            "{S}FME": "medial_knee",
            "{S}LM": "lateral_ankle",
            "{S}MM": "medial_ankle",
            "{S}TAM": "medial_ankle",
            "{S}FAL": "lateral_ankle",
            "{S}FCC": "heel",
            "{S}FM1": "first_metatarsal",
            "{S}FM5": "fifth_metatarsal",
            "{S}HJC": "hip",
        },
        middle={"C7": "c7", "T8": "t8", "IJ": "notch", "PX": "xiphoid"},
    ),
)
_WAIST = LabelSet(
    "waist_pairs",
    "full body with inner and outer markers",
    _sided(
        {
            "{S}FWT": "asis",
            "{S}BWT": "psis",
            "{S}FSH": "front_shoulder",
            "{S}BSH": "back_shoulder",
            "{S}ELB": "lateral_elbow",
            "{S}IEL": "medial_elbow",
            "{S}OWR": "radial_wrist",
            "{S}IWR": "ulnar_wrist",
            "{S}OHAND": "knuckle",
            "{S}KNE": "lateral_knee",
            "{S}KNI": "medial_knee",
            "{S}ANK": "lateral_ankle",
            "{S}HEL": "heel",
            "{S}MT1": "first_metatarsal",
            "{S}MT5": "fifth_metatarsal",
            "{S}TOE": "toe",
            "{S}FHD": "front_head",
            "{S}BHD": "back_head",
        },
        middle={"ARIEL": "vertex", "C7": "c7", "T10": "t10", "CLAV": "notch", "STRN": "xiphoid"},
    ),
)
_SHOULDER_ARM = LabelSet(
    "shoulder_arm",
    "shoulder girdle and right arm",
    {
        "ASISr": "right_asis",
        "ASISl": "left_asis",
        "PSISr": "right_psis",
        "PSISl": "left_psis",
        "STER": "notch",
        "XIPH": "xiphoid",
        "T1": "t1",
        "T10": "t10",
        "ACRO_tip": "right_acromion",
        "EPICl": "right_lateral_elbow",
        "EPICm": "right_medial_elbow",
        "STYLr": "right_radial_wrist",
        "STYLu": "right_ulnar_wrist",
    },
)
_JOINTS = LabelSet(
    "joints",
    "joint centres of pose estimators",
    _sided(
        {
            f"{{S}}{word}": word_of
            for word, word_of in {
                "Shoulder": "shoulder",
                "Elbow": "elbow",
                "Wrist": "wrist",
                "Hip": "hip",
                "Knee": "knee",
                "Ankle": "ankle",
                "Heel": "heel",
                "BigToe": "big_toe",
                "Ear": "ear",
            }.items()
        },
        middle={"Nose": "nose", "Head": "head"},
    ),
)
_KEYPOINTS = LabelSet(
    "liftlens",
    "LiftLens keypoints",
    {
        keypoint: keypoint
        for skeleton in SKELETONS.values()
        if not isinstance(skeleton, MarkerSet)
        for keypoint in skeleton.keypoints
    },
)

LABEL_SETS: tuple[LabelSet, ...] = (
    _KEYPOINTS,
    _PLUG_IN_GAIT,
    _SYNTHETIC_45,
    _LIFTLENS_45,
    _OPENCAP,
    _HELEN_HAYES,
    _ISB,
    _WAIST,
    _SHOULDER_ARM,
    _JOINTS,
)
"""Every label set that is recognised; where two fit alike, the earlier one counts."""

LANDMARKS: frozenset[str] = frozenset(x for s in LABEL_SETS for x in s.labels.values())
"""Every landmark a label can stand for."""


def _normalise(label: str) -> str:
    return re.sub(r"[\s._\-]", "", label).lower().removesuffix("study")


def strip_prefixes(labels: Sequence[str]) -> tuple[tuple[str, ...], tuple[int, ...], str]:
    """Remove the subject's name (`Anna:LASI`) from labels.

    Returns
    -------
    tuple
        The labels of the subject with most of them, their columns, and a note where another
        subject was left out.
    """
    subjects = [label.rpartition(":")[0] for label in labels]
    named = sorted({s for s in subjects if s}, key=subjects.count, reverse=True)
    # Unprefixed points belong to everybody; points of a second subject would double every label.
    kept = tuple(i for i, s in enumerate(subjects) if not s or s == named[0])
    note = ""
    if len(named) > 1:
        note = f"Several subjects are in the file; {named[0]!r} was taken, not {named[1:]}."
    return tuple(labels[i].rpartition(":")[2].strip() for i in kept), kept, note


def match_labels(labels: Iterable[str]) -> LabelMatch | None:
    """Find the label set that explains most labels; None if none explains three."""
    own = {_normalise(label): label for label in labels}
    best: LabelMatch | None = None
    for label_set in LABEL_SETS:
        meaning = {_normalise(k): v for k, v in label_set.labels.items()}
        found = {meaning[key]: label for key, label in own.items() if key in meaning}
        if len(found) >= MIN_MATCHES and (best is None or len(found) > len(best.landmarks)):
            unknown = tuple(v for k, v in own.items() if k not in meaning)
            # A full body has some 12 landmarks that matter; fewer leave the choice less sure.
            score = min(1.0, len(found) / 12)
            best = LabelMatch(label_set.name, label_set.title, found, unknown, score)
    return best
