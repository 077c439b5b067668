"""Joint centres from skin markers, each with its source.

Hips by regression from the pelvis, knees, ankles, elbows and wrists half-way between two markers
or, where only the outer one exists, half a joint's width inwards; shoulders below the acromion.
Positions are metres, Y up, shape (T, 3); NaN where a marker it needs is missing.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

import numpy as np

from engine.datatypes import Array, PoseTrack
from engine.errors import DataError
from engine.skeletons import BODY_SEGMENTS, get_skeleton
from engine.validation.reference.base import Reference

__all__ = [
    "JointCentre",
    "build_pose_track",
    "estimate_hip_centres",
    "estimate_joint_centres",
    "shift_inwards",
]

HipMethod = Literal["harrington", "bell"]

HALF_KNEE_M = 0.055
HALF_ANKLE_M = 0.040
HALF_ELBOW_M = 0.042
"""Half of an adult's joint width, with half a marker; used where only one side is marked."""
SHOULDER_DROP = 0.17
"""Shoulder centre below the acromion, as a share of the distance between both acromia [3]_."""
STRAIGHT_SINE = 0.2
"""A limb bent by less than this sine hardly shows its own flexion axis."""
PLANE_ITERATIONS = 5

SEGMENT_M: Mapping[str, tuple[float, float]] = {
    "shoulder_width": (0.20, 0.55),
    "pelvis_width": (0.08, 0.30),
    "thigh": (0.25, 0.60),
    "shank": (0.25, 0.60),
    "upper_arm": (0.17, 0.45),
    "forearm": (0.15, 0.40),
}
"""Lengths between joint centres that a person may have."""

_SIDES = ("left", "right")


@dataclass(frozen=True, eq=False)
class JointCentre:
    """One point over time: `position` (T, 3) in metres, and how it came to be."""

    position: Array
    source: str


class _Points:
    """Landmarks of a reference by name, and the joint centres found so far."""

    def __init__(self, reference: Reference) -> None:
        if reference.markers is None:
            raise DataError(
                f"{reference.name} holds no markers, so that there are no joint centres; compare "
                "its angles instead."
            )
        self._markers = reference.markers
        self._landmarks = reference.landmarks
        self.found: dict[str, JointCentre] = {}

    def get(self, name: str) -> Array | None:
        """Return a landmark, shape (T, 3); None where the file has none."""
        label = self._landmarks.get(name)
        return None if label is None else self._markers[label]

    def mean(self, *names: str) -> Array | None:
        """Return the middle of landmarks; None unless all exist."""
        points = [self.get(name) for name in names]
        known = [p for p in points if p is not None]
        return np.asarray(sum(known) / len(known)) if len(known) == len(names) else None

    def centre(self, name: str) -> Array | None:
        """Return a joint centre found before, shape (T, 3)."""
        return self.found[name].position if name in self.found else None

    def add(self, name: str, position: Array | None, source: str) -> None:
        """Keep a joint centre, unless it is missing or a better one exists."""
        if position is not None and name not in self.found:
            self.found[name] = JointCentre(position, source)


def estimate_joint_centres(
    reference: Reference, *, hip_method: HipMethod = "harrington"
) -> Mapping[str, JointCentre]:
    """Estimate every joint centre that the markers allow.

    Parameters
    ----------
    reference
        With markers whose labels are known.
    hip_method
        Regression for the hips: Harrington et al. [1]_, which needs markers at the back of the
        pelvis, or Bell et al. [2]_, which is used where these are missing.

    Returns
    -------
    Mapping
        Keypoint name to joint centre.

    Raises
    ------
    DataError
        If there are no markers or no known label.

    References
    ----------
    .. [1] Harrington et al. (2007), Journal of Biomechanics 40, 595-602.
    .. [2] Bell, Pedersen & Brand (1990), Journal of Biomechanics 23, 617-621.
    .. [3] Rab, Petuskey & Bagley (2002), Gait & Posture 15, 113-119.
    """
    points = _Points(reference)
    if not reference.landmarks:
        labels = reference.markers.labels if reference.markers else ()
        raise DataError(
            f"No label of {reference.name} is known (it has {', '.join(labels[:5])} and so on); "
            "say in an import profile which landmark each label is."
        )
    # Centres that the recording itself holds come first: a laboratory's own are better.
    for keypoint in sorted({k for k in reference.landmarks if k in _keypoints()}):
        points.add(keypoint, points.get(keypoint), "marker of that name")
    _add_hips(points, hip_method)
    for side in _SIDES:
        _add_leg(points, side)
    _add_shoulders(points)
    for side in _SIDES:
        _add_arm(points, side)
    return points.found


def _keypoints() -> frozenset[str]:
    return frozenset((*get_skeleton("h36m_17").keypoints, *get_skeleton("mediapipe_33").keypoints))


# --------------------------------------------------------------------------- hips


def estimate_hip_centres(
    left_asis: Array,
    right_asis: Array,
    back: Array | None,
    *,
    method: HipMethod = "harrington",
) -> tuple[Array, Array]:
    """Estimate both hip centres from the pelvis.

    Parameters
    ----------
    left_asis, right_asis
        Anterior superior iliac spines, shape (T, 3), m.
    back
        Middle of the posterior superior iliac spines, or the sacrum, shape (T, 3), m.
    method
        `harrington` or `bell`; both are linear in the clip's median pelvic width, and
        Harrington's in the median depth. The size of the pelvis does not change within a clip.

    Returns
    -------
    tuple of Array
        Left and right hip centre, shape (T, 3), m.

    Raises
    ------
    DataError
        If `back` is missing: the plane of the pelvis is not defined without it.
    """
    if back is None:
        raise DataError("Hip centres need a marker at the back of the pelvis, PSIS or sacrum.")
    middle = (left_asis + right_asis) / 2
    across, forward = right_asis - left_asis, middle - back
    width, depth = _median_length(across), _median_length(forward)
    z = _unit(across)
    x = _unit(forward - _dot(forward, z) * z)
    y = np.cross(z, x)
    if method == "harrington":
        front, up = -0.24 * depth - 0.0099, -0.30 * width - 0.0109
        side = 0.33 * width + 0.0073
    else:
        front, up, side = -0.19 * width, -0.30 * width, 0.36 * width
    centre = middle + front * x + up * y
    return centre - side * z, centre + side * z


def _add_hips(points: _Points, method: HipMethod) -> None:
    left, right = points.get("left_asis"), points.get("right_asis")
    back = points.mean("left_psis", "right_psis")
    if back is None:
        back = points.get("sacrum")
    if left is None or right is None or back is None:
        return
    hips = estimate_hip_centres(left, right, back, method=method)
    for side, hip in zip(_SIDES, hips, strict=True):
        points.add(f"{side}_hip", hip, f"regression of {method.title()} from the pelvis")


# --------------------------------------------------------------------------- limbs


def shift_inwards(
    proximal: Array,
    outer: Array,
    distal: Array,
    *,
    across: Array,
    half_width_m: float,
    distal_half_width_m: float = 0.0,
) -> Array:
    """Estimate a hinge's centre from its outer marker alone.

    The centre lies `half_width_m` from the marker along the flexion axis. A bent limb shows that
    axis: it is normal to the plane of both segments. For a straight limb it is taken to lie as
    near as possible to `across`; between the two the directions are blended, so that the centre
    does not jump. Plane and centre depend on each other and are found in turn.

    Parameters
    ----------
    proximal, outer, distal
        Shape (T, 3), m: the joint centre above, the outer marker, the joint centre below or,
        with `distal_half_width_m`, its outer marker.
    across
        Shape (T, 3): from the outer side inwards, such as from the right to the left hip.
    half_width_m, distal_half_width_m
        From a marker's middle to the joint centre.

    Returns
    -------
    Array
        Shape (T, 3), m.
    """
    inwards = _unit(across)
    axis = inwards
    for _ in range(PLANE_ITERATIONS):
        centre, below = outer + half_width_m * axis, distal + distal_half_width_m * axis
        limb = _unit(below - proximal)
        prior = inwards - _dot(inwards, limb) * limb
        normal = np.cross(_unit(centre - proximal), _unit(below - centre))
        # The normal's sign depends on the way the joint bends; the axis itself has none.
        normal = normal * np.where(_dot(normal, inwards) < 0, -1.0, 1.0)
        axis = _unit(normal + STRAIGHT_SINE * prior)
    return outer + half_width_m * axis


def _inwards(points: _Points, side: str) -> Array | None:
    """Return the direction from one side of the body to the other."""
    other = "left" if side == "right" else "right"
    for word in ("hip", "asis", "shoulder", "acromion"):
        pair = []
        for s in (side, other):
            centre = points.centre(f"{s}_{word}")
            pair.append(points.get(f"{s}_{word}") if centre is None else centre)
        if pair[0] is not None and pair[1] is not None:
            return np.asarray(pair[1] - pair[0])
    return None


def _add_hinge(
    points: _Points,
    side: str,
    joint: str,
    *,
    above: Array | None,
    below: Array | None,
    half_width_m: float,
    below_half_width_m: float = 0.0,
) -> None:
    """Add a joint half-way between its two markers, or inwards from the outer one."""
    middle = points.mean(f"{side}_lateral_{joint}", f"{side}_medial_{joint}")
    points.add(f"{side}_{joint}", middle, "half-way between two markers")
    outer, across = points.get(f"{side}_lateral_{joint}"), _inwards(points, side)
    if outer is None or above is None or below is None or across is None:
        return
    centre = shift_inwards(
        above,
        outer,
        below,
        across=across,
        half_width_m=half_width_m,
        distal_half_width_m=below_half_width_m,
    )
    source = f"{1000 * half_width_m:.0f} mm inwards of the outer marker (assumed width)"
    points.add(f"{side}_{joint}", centre, source)


def _add_leg(points: _Points, side: str) -> None:
    hip, knee = points.centre(f"{side}_hip"), points.get(f"{side}_lateral_knee")
    ankle = points.get(f"{side}_lateral_ankle")
    _add_hinge(
        points,
        side,
        "knee",
        above=hip,
        below=ankle,
        half_width_m=HALF_KNEE_M,
        below_half_width_m=HALF_ANKLE_M,
    )
    # The axis of the ankle follows that of the knee, as the foot hardly turns on the shank.
    middle = points.mean(f"{side}_lateral_ankle", f"{side}_medial_ankle")
    points.add(f"{side}_ankle", middle, "half-way between two markers")
    centre = points.centre(f"{side}_knee")
    if ankle is not None and knee is not None and centre is not None:
        shank, axis = _unit(ankle - knee), centre - knee
        inwards = _unit(axis - _dot(axis, shank) * shank)
        source = f"{1000 * HALF_ANKLE_M:.0f} mm inwards of the outer marker (assumed width)"
        points.add(f"{side}_ankle", ankle + HALF_ANKLE_M * inwards, source)
    points.add(f"{side}_big_toe", points.get(f"{side}_toe"), "toe marker")
    points.add(f"{side}_big_toe", points.get(f"{side}_first_metatarsal"), "first metatarsal")


def _add_shoulders(points: _Points) -> None:
    """Add shoulders below the acromia, or between markers in front of and behind them."""
    for side in _SIDES:
        middle = points.mean(f"{side}_front_shoulder", f"{side}_back_shoulder")
        points.add(f"{side}_shoulder", middle, "half-way between two markers")
    left, right = points.get("left_acromion"), points.get("right_acromion")
    if left is None or right is None:
        return
    hips = [points.centre(f"{side}_hip") for side in _SIDES]
    if hips[0] is None or hips[1] is None:
        return
    width = _median_length(right - left)
    z = _unit(right - left)
    trunk = (left + right) / 2 - (hips[0] + hips[1]) / 2
    down = -_unit(trunk - _dot(trunk, z) * z)
    source = f"{100 * SHOULDER_DROP:.0f} % of the acromial distance below the acromion"
    for side, acromion in zip(_SIDES, (left, right), strict=True):
        points.add(f"{side}_shoulder", acromion + SHOULDER_DROP * width * down, source)


def _add_arm(points: _Points, side: str) -> None:
    wrist = points.mean(f"{side}_radial_wrist", f"{side}_ulnar_wrist")
    points.add(f"{side}_wrist", wrist, "half-way between two markers")
    for word in ("mid_wrist", "radial_wrist", "ulnar_wrist"):
        points.add(f"{side}_wrist", points.get(f"{side}_{word}"), f"{word.replace('_', ' ')}")
    _add_hinge(
        points,
        side,
        "elbow",
        above=points.centre(f"{side}_shoulder"),
        below=points.centre(f"{side}_wrist"),
        half_width_m=HALF_ELBOW_M,
    )
    points.add(f"{side}_index", points.get(f"{side}_knuckle"), "third knuckle")


# --------------------------------------------------------------------------- as a track


def build_pose_track(
    reference: Reference, *, skeleton: str = "h36m_17", hip_method: HipMethod = "harrington"
) -> PoseTrack:
    """Turn markers into a track of joint centres, ready for a solver.

    Parameters
    ----------
    reference
        With markers whose labels are known.
    skeleton
        The skeleton of the track; its other keypoints stay NaN (a spine or a nose is never
        invented). `pelvis` and `thorax` are the middle of hips and shoulders.
    hip_method
        See `estimate_joint_centres`.

    Returns
    -------
    PoseTrack
        World metres, Y up. `provenance` has the source of every keypoint under `sources`.

    Raises
    ------
    DataError
        If no joint centre can be estimated, or left and right look exchanged.
    UnitError
        If segments have lengths that no person has.
    """
    if reference.are_sides_swapped:
        sides = reference.finding("sides")
        raise DataError(
            f"In {reference.name} left and right look exchanged "
            f"({sides.why if sides else ''}); set swap_sides = true, or correct the axes, in an "
            "import profile."
        )
    centres = dict(estimate_joint_centres(reference, hip_method=hip_method))
    if not centres or reference.markers is None:
        known = ", ".join(sorted(reference.landmarks)[:6])
        raise DataError(
            f"The markers of {reference.name} give no joint centre (known landmarks: {known}); "
            "name more labels in an import profile."
        )
    _require_human_lengths(reference.name, centres)
    for name, part in (("pelvis", "hip"), ("thorax", "shoulder")):
        pair = [centres.get(f"{side}_{part}") for side in _SIDES]
        if pair[0] is not None and pair[1] is not None and name not in centres:
            middle = (pair[0].position + pair[1].position) / 2
            centres[name] = JointCentre(middle, f"half-way between both {part}s")
    keypoints = get_skeleton(skeleton).keypoints
    position = np.full((reference.markers.time_s.size, len(keypoints), 3), np.nan)
    for column, keypoint in enumerate(keypoints):
        if keypoint in centres:
            position[:, column] = centres[keypoint].position
    return PoseTrack(
        time_s=reference.markers.time_s,
        position=position,
        unit="m",
        frame_of_reference="world",
        skeleton=skeleton,
        provenance={
            "reference": reference.name,
            "sources": {k: centres[k].source for k in keypoints if k in centres},
        },
    )


def _require_human_lengths(name: str, centres: Mapping[str, JointCentre]) -> None:
    """Refuse bodies that no person has: labels or unit are wrong then."""
    for segment, proximal, distal in BODY_SEGMENTS:
        if proximal not in centres or distal not in centres:
            continue
        length = _median_length(centres[distal].position - centres[proximal].position)
        low, high = SEGMENT_M[segment.removeprefix("left_").removeprefix("right_")]
        if np.isfinite(length) and not low <= length <= high:
            raise DataError(
                f"In {name} the {segment.replace('_', ' ')} measures {length:.2f} m, expected "
                f"{low:g} to {high:g} m; check the labels of {proximal} and {distal}, and the unit."
            )


# --------------------------------------------------------------------------- geometry


def _dot(a: Array, b: Array) -> Array:
    return np.asarray((a * b).sum(axis=-1, keepdims=True))


def _unit(vector: Array) -> Array:
    length = np.linalg.norm(vector, axis=-1, keepdims=True)
    return np.asarray(vector / np.where(length > 0, length, np.nan))


def _median_length(vector: Array) -> float:
    length = np.linalg.norm(vector, axis=-1)
    known = length[np.isfinite(length)]
    return float(np.median(known)) if known.size else float("nan")
