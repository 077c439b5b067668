"""Segment lengths: from the stature, and from the clip itself."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, fields

import numpy as np

from engine.datatypes import Array, Measurement, PoseTrack, Status
from engine.errors import DataError
from engine.skeletons import Skeleton, get_skeleton

__all__ = [
    "ANTHROPOMETRY_SIGMA",
    "LINKS",
    "SegmentLengths",
    "estimate_segment_lengths",
    "prior_sigma_m",
]

_SHARE_OF_STATURE: Mapping[str, float] = {
    "thigh": 0.245,
    "shank": 0.246,
    "pelvis_half_width": 0.050,
    "trunk": 0.288,
    "shoulder_half_width": 0.115,
    "upper_arm": 0.186,
    "forearm": 0.146,
    "spine": 0.144,
    "neck": 0.105,
    "ear_half_width": 0.042,
    "nose_forward": 0.060,
    "nose_up": -0.010,
    "heel_back": 0.028,
    "heel_down": 0.030,
    "toe_forward": 0.085,
    "toe_down": 0.032,
}
"""Drillis & Contini, as tabulated by Winter; the widths are between joint centres. Head and foot
are typical of image keypoints and only stand in where a clip shows neither."""

ANTHROPOMETRY_SIGMA: Mapping[str, float] = {
    "pelvis_half_width": 0.15,
    "shoulder_half_width": 0.10,
    "trunk": 0.08,
}
"""Standard deviation between persons of the same stature, as a share of the length."""
_OTHER_SIGMA = 0.06

LINKS: Mapping[str, tuple[tuple[str, str, float], ...]] = {
    "thigh": (("left_hip", "left_knee", 1.0), ("right_hip", "right_knee", 1.0)),
    "shank": (("left_knee", "left_ankle", 1.0), ("right_knee", "right_ankle", 1.0)),
    "pelvis_half_width": (("left_hip", "right_hip", 0.5),),
    "trunk": (("pelvis", "thorax", 1.0),),
    "shoulder_half_width": (("left_shoulder", "right_shoulder", 0.5),),
    "upper_arm": (("left_shoulder", "left_elbow", 1.0), ("right_shoulder", "right_elbow", 1.0)),
    "forearm": (("left_elbow", "left_wrist", 1.0), ("right_elbow", "right_wrist", 1.0)),
    "spine": (("pelvis", "spine", 1.0),),
    "neck": (("thorax", "mid_ear", 1.0),),
    "ear_half_width": (("left_ear", "right_ear", 0.5),),
}
"""Which distances between keypoints show a length, with the factor between them."""

TRUSTED = (Status.MEASURED, Status.SMOOTHED, Status.REPAIRED)
MIN_LENGTH_M = 0.01
CLIP_SIGMA_M = 0.005
"""What remains uncertain of a length however long the clip: where a keypoint sits on the joint."""
SYSTEMATIC_SHARE = 0.3
"""Share of the spread over the clip that averaging over it does not remove."""


@dataclass(frozen=True)
class SegmentLengths:
    """Constant lengths of the figure, in metres; left and right are alike.

    `trunk` runs from mid-hip to mid-shoulder, `spine` from mid-hip to the middle of the back,
    `neck` from mid-shoulder to mid-ear. The nose is seen from mid-ear with the head upright;
    heel and toe are seen from the ankle with the foot at a right angle to the shank.
    """

    thigh: float
    shank: float
    pelvis_half_width: float
    trunk: float
    shoulder_half_width: float
    upper_arm: float
    forearm: float
    spine: float
    neck: float
    ear_half_width: float
    nose_forward: float
    nose_up: float
    heel_back: float
    heel_down: float
    toe_forward: float
    toe_down: float

    def __post_init__(self) -> None:
        for name, value in asdict(self).items():
            is_length = name not in ("nose_forward", "nose_up", "heel_back", "toe_down")
            if not np.isfinite(value) or (is_length and value <= 0):
                raise DataError(f"Segment length {name} must be positive metres, got {value}.")

    @classmethod
    def from_stature(cls, stature_m: float) -> SegmentLengths:
        """Return the lengths of a typical adult of that stature.

        References
        ----------
        .. [1] Winter (2009), Biomechanics and Motor Control of Human Movement, 4th ed., ch. 4.
        """
        return cls(**{name: share * stature_m for name, share in _SHARE_OF_STATURE.items()})

    def as_dict(self) -> dict[str, float]:
        """Return the lengths by name, in metres."""
        return asdict(self)


LENGTH_NAMES: tuple[str, ...] = tuple(f.name for f in fields(SegmentLengths))


def estimate_segment_lengths(
    track: PoseTrack, stature: Measurement, *, min_frames: int = 5
) -> SegmentLengths:
    """Estimate the segment lengths of the person in a clip.

    Every length is the median over the clip of the distance between its keypoints, left and
    right together, blended with the length a person of that stature typically has by inverse
    variance. Frames whose keypoints were rejected or filled in don't count.

    Parameters
    ----------
    track
        Metres, any frame of reference.
    stature
        Metres, with its standard error.
    min_frames
        With fewer frames, the typical length is taken.

    Returns
    -------
    SegmentLengths
        Never NaN: what the clip doesn't show is typical of the stature.
    """
    skeleton = get_skeleton(track.skeleton)
    position = _trusted(track, min_frames)
    typical = SegmentLengths.from_stature(stature.value).as_dict()
    lengths = dict(typical)
    for name, links in LINKS.items():
        seen = _distances(position, skeleton, links)
        if seen.size < min_frames:
            continue
        prior = Measurement(typical[name], prior_sigma_m(name, stature))
        lengths[name] = _blend(seen, prior)
    lengths |= _estimate_head(position, skeleton, min_frames)
    lengths |= _estimate_foot(position, skeleton, min_frames)
    return SegmentLengths(**lengths)


def prior_sigma_m(name: str, stature: Measurement) -> float:
    """Return the standard deviation of a length among persons of about that stature, m."""
    relative = stature.sigma / stature.value if np.isfinite(stature.sigma) else 0.0
    typical = _SHARE_OF_STATURE[name] * stature.value
    return float(typical * np.hypot(ANTHROPOMETRY_SIGMA.get(name, _OTHER_SIGMA), relative))


def _trusted(track: PoseTrack, min_frames: int) -> Array:
    """Return the positions with what was filled in or rejected made NaN, where enough is left."""
    trusted = np.isin(track.status, TRUSTED)
    enough = trusted.sum(axis=0) >= min_frames
    return np.where((trusted | ~enough)[..., None], track.position, np.nan)


def _point(position: Array, skeleton: Skeleton, name: str) -> Array:
    """Return a point of shape (T, 3); middles are those of their two joints, as in the figure."""
    if name in skeleton.derived and all(k in skeleton.keypoints for k in skeleton.derived[name]):
        parts = skeleton.derived[name].items()
        return np.asarray(sum(w * position[:, skeleton.index(k)] for k, w in parts))
    return skeleton.point(position, name)


def _distances(
    position: Array, skeleton: Skeleton, links: Sequence[tuple[str, str, float]]
) -> Array:
    """Return every finite length that the links show over the clip."""
    found = [
        factor
        * np.linalg.norm(_point(position, skeleton, a) - _point(position, skeleton, b), axis=1)
        for a, b, factor in links
        if skeleton.has(a) and skeleton.has(b)
    ]
    values = np.concatenate(found) if found else np.empty(0)
    return np.asarray(values[np.isfinite(values) & (values > MIN_LENGTH_M)])


def _blend(seen: Array, typical: Measurement) -> float:
    """Return the mean of the clip's median and the typical length, by inverse variance."""
    median = float(np.median(seen))
    spread = 1.4826 * float(np.median(np.abs(seen - median)))
    seen_sigma = np.hypot(SYSTEMATIC_SHARE * spread, CLIP_SIGMA_M)
    weight = typical.sigma**2 / (typical.sigma**2 + seen_sigma**2)
    return float(weight * median + (1.0 - weight) * typical.value)


def _estimate_head(position: Array, skeleton: Skeleton, min_frames: int) -> dict[str, float]:
    """Return where the nose is, along and across the line from mid-shoulder to mid-ear."""
    if not all(skeleton.has(name) for name in ("thorax", "mid_ear", "nose")):
        return {}
    ear = skeleton.point(position, "mid_ear")
    line = ear - skeleton.point(position, "thorax")
    nose = skeleton.point(position, "nose") - ear
    length = np.linalg.norm(line, axis=1)
    up = np.sum(nose * line, axis=1) / np.where(length > MIN_LENGTH_M, length, np.nan)
    forward = np.sqrt(np.clip(np.sum(nose**2, axis=1) - up**2, 0.0, None))
    known = np.isfinite(forward)
    if known.sum() < min_frames:
        return {}
    return {
        "nose_up": float(np.median(up[known])),
        "nose_forward": float(np.median(forward[known])),
    }


def _estimate_foot(position: Array, skeleton: Skeleton, min_frames: int) -> dict[str, float]:
    """Return heel and toe as seen from the ankle, the sole level."""
    sides = [
        s
        for s in ("left", "right")
        if all(skeleton.has(f"{s}_{part}") for part in ("ankle", "heel", "big_toe"))
    ]
    if not sides:
        return {}
    rows = np.concatenate([_foot_triangle(position, skeleton, side) for side in sides])
    rows = rows[np.isfinite(rows).all(axis=1)]
    if len(rows) < min_frames:
        return {}
    heel_back, toe_forward, down = np.median(rows, axis=0)
    down = max(float(down), MIN_LENGTH_M)
    return {
        "heel_back": float(heel_back),
        "toe_forward": max(float(toe_forward), MIN_LENGTH_M),
        "heel_down": down,
        "toe_down": down,
    }


def _foot_triangle(position: Array, skeleton: Skeleton, side: str) -> Array:
    """Return heel behind, toe before and ankle above the line heel to toe; shape (T, 3)."""
    ankle, heel, toe = (
        skeleton.point(position, f"{side}_{part}") for part in ("ankle", "heel", "big_toe")
    )
    sole = toe - heel
    length = np.linalg.norm(sole, axis=1, keepdims=True)
    unit = sole / np.where(length > MIN_LENGTH_M, length, np.nan)
    back = np.sum((ankle - heel) * unit, axis=1)
    forward = np.sum((toe - ankle) * unit, axis=1)
    height = np.linalg.norm(ankle - heel - back[:, None] * unit, axis=1)
    return np.stack([back, forward, height], axis=1)
