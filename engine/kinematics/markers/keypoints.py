"""Joint centres and keypoints from the markers of a set.

Hips by the regression of Harrington et al. from the pelvis, shoulders below the acromion, elbows,
wrists, knees and ankles half-way between the two markers at the joint.

References
----------
.. [1] Harrington et al. (2007), Journal of Biomechanics 40, 595-602.
.. [2] Rab, Petuskey & Bagley (2002), Gait & Posture 15, 113-119.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from engine.datatypes import Array, PoseTrack
from engine.errors import DataError, ShapeError
from engine.skeletons import MARKER_SETS, MarkerSet, get_skeleton

__all__ = ["find_marker_set", "keypoints_from_markers"]

SHOULDER_DROP = 0.17
"""Shoulder centre below the acromion, as a share of the distance between both acromia [2]_."""
EAR_DOWN, EAR_ASIDE = 0.46, 0.47
"""Ears below and beside the middle of four markers round the head, as shares of the distance from
front to back; of the synthetic lifts' training persons."""

_SIDES = ("left", "right")


def find_marker_set(names: Sequence[str]) -> MarkerSet:
    """Return the set that has all these markers.

    Raises
    ------
    DataError
        If none has.
    """
    for marker_set in MARKER_SETS.values():
        if set(names) <= set(marker_set.keypoints):
            return marker_set
    raise DataError(
        f"The markers {', '.join(list(names)[:5])} and so on are of no known set; known: "
        f"{', '.join(MARKER_SETS)}."
    )


def keypoints_from_markers(
    time_s: Array, position_m: Array, names: Sequence[str], *, skeleton: str = "mediapipe_33"
) -> PoseTrack:
    """Turn skin markers into keypoints.

    Parameters
    ----------
    time_s
        Shape (T,), s.
    position_m
        Shape (T, M, 3), m, Y up; NaN where missing.
    names
        The M markers, of one of `engine.skeletons.MARKER_SETS`.
    skeleton
        Of the result; keypoints that the markers do not give stay NaN (a nose, for example).

    Returns
    -------
    PoseTrack
        World metres. `provenance` says where every keypoint comes from.

    Raises
    ------
    DataError
        If the markers are of no known set.
    ShapeError
        If names and positions differ in number.
    """
    position = np.asarray(position_m, dtype=np.float64)
    if position.ndim != 3 or position.shape[1:] != (len(names), 3):
        raise ShapeError(f"position_m needs shape (T, {len(names)}, 3), got {position.shape}.")
    marker_set = find_marker_set(names)
    columns = {name: i for i, name in enumerate(names)}
    points = {
        landmark: position[:, columns[marker]]
        for landmark, marker in marker_set.of_landmark.items()
        if marker in columns
    }
    centres = _joint_centres(points)
    keypoints = get_skeleton(skeleton).keypoints
    result = np.full((len(position), len(keypoints), 3), np.nan)
    for i, keypoint in enumerate(keypoints):
        if keypoint in centres:
            result[:, i] = centres[keypoint][0]
    return PoseTrack(
        time_s=time_s,
        position=result,
        unit="m",
        frame_of_reference="world",
        skeleton=skeleton,
        provenance={
            "markers": marker_set.name,
            "sources": {k: centres[k][1] for k in keypoints if k in centres},
        },
    )


def _joint_centres(points: Mapping[str, Array]) -> dict[str, tuple[Array, str]]:
    """Return keypoint -> position (T, 3) and source, for all that the landmarks allow."""
    found: dict[str, tuple[Array, str]] = {}
    for side in _SIDES:
        for joint, a, b in (
            ("knee", "lateral_knee", "medial_knee"),
            ("ankle", "lateral_ankle", "medial_ankle"),
            ("elbow", "lateral_elbow", "medial_elbow"),
            ("wrist", "radial_wrist", "ulnar_wrist"),
        ):
            pair = [points.get(f"{side}_{k}") for k in (a, b)]
            if pair[0] is not None and pair[1] is not None:
                found[f"{side}_{joint}"] = (pair[0] + pair[1]) / 2, "half-way between two markers"
        for keypoint, landmark in (
            ("heel", "heel"),
            ("big_toe", "first_metatarsal"),
            ("index", "knuckle"),
        ):
            if f"{side}_{landmark}" in points:
                found[f"{side}_{keypoint}"] = points[f"{side}_{landmark}"], landmark
    found |= _hips(points) | _shoulders(points) | _ears(points)
    for name, part in (("pelvis", "hip"), ("thorax", "shoulder")):
        if f"left_{part}" in found and f"right_{part}" in found:
            middle = (found[f"left_{part}"][0] + found[f"right_{part}"][0]) / 2
            found[name] = middle, f"half-way between both {part}s"
    return found


def _unit(vector: Array) -> Array:
    length = np.linalg.norm(vector, axis=-1, keepdims=True)
    return np.asarray(vector / np.where(length > 0, length, np.nan))


def _median_length(vector: Array) -> float:
    length = np.linalg.norm(vector, axis=-1)
    return float(np.nanmedian(length)) if np.isfinite(length).any() else float("nan")


def _hips(points: Mapping[str, Array]) -> dict[str, tuple[Array, str]]:
    needed = ("left_asis", "right_asis", "left_psis", "right_psis")
    if any(k not in points for k in needed):
        return {}
    left, right, *back = (points[k] for k in needed)
    middle = (left + right) / 2
    forward = middle - (back[0] + back[1]) / 2
    width, depth = _median_length(right - left), _median_length(forward)
    z = _unit(right - left)
    x = _unit(forward - (forward * z).sum(axis=1, keepdims=True) * z)
    y = np.cross(z, x)
    centre = middle - (0.24 * depth + 0.0099) * x - (0.30 * width + 0.0109) * y
    aside = (0.33 * width + 0.0073) * z
    source = "regression of Harrington from the pelvis"
    return {"left_hip": (centre - aside, source), "right_hip": (centre + aside, source)}


def _shoulders(points: Mapping[str, Array]) -> dict[str, tuple[Array, str]]:
    needed = ("left_acromion", "right_acromion", "left_psis", "right_psis")
    if any(k not in points for k in needed):
        return {}
    left, right, *low = (points[k] for k in needed)
    across, trunk = right - left, (left + right) / 2 - (low[0] + low[1]) / 2
    z = _unit(across)
    down = -_unit(trunk - (trunk * z).sum(axis=1, keepdims=True) * z)
    drop = SHOULDER_DROP * _median_length(across)
    source = f"{100 * SHOULDER_DROP:.0f} % of the acromial distance below the acromion"
    return {
        "left_shoulder": (left + drop * down, source),
        "right_shoulder": (right + drop * down, source),
    }


def _ears(points: Mapping[str, Array]) -> dict[str, tuple[Array, str]]:
    """Return both ears, from markers round the head."""
    if {"left_side_head", "right_side_head"} <= set(points):
        return {
            f"{side}_ear": (points[f"{side}_side_head"], "marker at the side of the head")
            for side in _SIDES
        }
    needed = [f"{side}_{part}_head" for part in ("front", "back") for side in _SIDES]
    if any(k not in points for k in needed):
        return {}
    corners = [points[k] for k in needed]
    forward = (corners[0] + corners[1] - corners[2] - corners[3]) / 2
    depth = _median_length(forward)
    x = _unit(forward)
    across = corners[1] + corners[3] - corners[0] - corners[2]
    z = _unit(across - (across * x).sum(axis=1, keepdims=True) * x)
    low = sum(corners) / 4 - EAR_DOWN * depth * np.cross(z, x)
    source = "four markers round the head"
    return {
        "left_ear": (low - EAR_ASIDE * depth * z, source),
        "right_ear": (low + EAR_ASIDE * depth * z, source),
    }
