"""The full-body model with the markers of a set on it, and its scaling to a person.

The model is the full-body one of Pose2Sim, derived from that of Rajagopal et al.; see `model/`
for its licence. Scaling follows OpenSim's own procedure [1]_: distances between markers in a static
pose give the size of every body; then the pose is fitted and the markers move to where they were
measured.

References
----------
.. [1] Delp et al. (2007), IEEE Transactions on Biomedical Engineering 54, 1940-1950.
.. [2] Pagnon, Domalain & Reveret (2021), Sensors 21, 6530.
.. [3] Rajagopal et al. (2016), IEEE Transactions on Biomedical Engineering 63, 2068-2079.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cache, cached_property
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from engine.datatypes import Array
from engine.errors import DataError
from engine.kinematics.markers.inverse import MarkerProblem, Solution
from engine.kinematics.markers.osim import ModelMarker, OsimModel, read_osim
from engine.kinematics.markers.tree import KinematicTree, scale_model
from engine.skeletons import MARKER_SETS, MarkerSet

__all__ = [
    "DEFAULT_MODEL",
    "LOCKED",
    "MEASUREMENTS",
    "MarkerModel",
    "Measurement",
    "build_marker_model",
    "default_weights",
    "read_marker_model",
    "scale_to_person",
]

DEFAULT_MODEL = Path(__file__).parent / "model" / "Model_Pose2Sim_simple.osim"

LOCKED = ("subtalar_angle", "mtp_angle", "wrist_flex", "wrist_dev")
"""Coordinates held at their default (both sides): locked in the lifting method's model too."""

_BODY_OF_PART: Mapping[str, str] = {
    "forehead": "head",
    "vertex": "head",
    "front_head": "head",
    "back_head": "head",
    "side_head": "head",
    "c7": "torso",
    "t10": "torso",
    "notch": "torso",
    "xiphoid": "torso",
    "acromion": "torso",
    "upper_arm": "humerus",
    "lateral_elbow": "humerus",
    "medial_elbow": "humerus",
    "radial_wrist": "radius",
    "ulnar_wrist": "radius",
    "knuckle": "hand",
    "asis": "pelvis",
    "psis": "pelvis",
    "trochanter": "femur",
    "lateral_knee": "femur",
    "medial_knee": "femur",
    "fibula_head": "tibia",
    "tibial_tuberosity": "tibia",
    "lateral_ankle": "tibia",
    "medial_ankle": "tibia",
    "heel": "calcn",
    "first_metatarsal": "calcn",
    "fifth_metatarsal": "calcn",
}
_LOCAL_M: Mapping[str, tuple[float, float, float]] = {
    "forehead": (0.10, 0.12, 0.0),
    "vertex": (0.005, 0.18, 0.0),
    "front_head": (0.10, 0.14, 0.032),
    "back_head": (-0.063, 0.128, 0.038),
    "side_head": (0.0, 0.13, 0.08),
    "c7": (-0.07, 0.42, 0.0),
    "t10": (-0.10, 0.22, 0.0),
    "notch": (0.05, 0.37, 0.0),
    "xiphoid": (0.10, 0.20, 0.0),
    "acromion": (-0.02, 0.43, 0.17),
    "upper_arm": (0.01, -0.14, 0.045),
    "lateral_elbow": (0.005, -0.285, 0.045),
    "medial_elbow": (0.005, -0.285, -0.045),
    "radial_wrist": (-0.005, -0.235, 0.045),
    "ulnar_wrist": (-0.02, -0.235, -0.02),
    "knuckle": (-0.005, -0.07, 0.01),
    "asis": (0.02, 0.03, 0.128),
    "psis": (-0.16, 0.04, 0.05),
    "trochanter": (-0.01, -0.02, 0.09),
    "lateral_knee": (0.0, -0.404, 0.05),
    "medial_knee": (0.0, -0.404, -0.05),
    "fibula_head": (-0.02, -0.05, 0.055),
    "tibial_tuberosity": (0.045, -0.07, 0.0),
    "lateral_ankle": (-0.005, -0.41, 0.053),
    "medial_ankle": (0.006, -0.389, -0.038),
    "heel": (-0.02, 0.03, 0.0),
    "first_metatarsal": (0.18, 0.01, -0.03),
    "fifth_metatarsal": (0.14, 0.01, 0.055),
}
"""Where a landmark lies in the unscaled model's body on the right, m; the left mirrors Z."""

WEIGHT_OF_BODY: Mapping[str, float] = {"pelvis": 5.0, "torso": 2.0}
"""Others count 1: equal weights leave pelvic tilt, lumbar and hip flexion hardly determined."""

STANDING: Mapping[str, float] = {
    "arm_add_r": -0.15,
    "arm_add_l": -0.15,
    "pro_sup_r": 1.2,
    "pro_sup_l": 1.2,
    "elbow_flex_r": 0.15,
    "elbow_flex_l": 0.15,
}
"""A person at ease, rad. The model's own default is a T, in which distances across the shoulder
differ from those of a standing person by a fifth."""
_ORIGIN_BODIES: Mapping[str, str] = {
    "hip": "femur",
    "knee": "tibia",
    "ankle": "talus",
    "shoulder": "humerus",
    "elbow": "ulna",
    "wrist": "hand",
}
"""Bodies whose origin is a joint's centre."""
SCALING_ROUNDS = 4
HEADINGS_RAD = (0.0, np.pi / 2, np.pi, -np.pi / 2)
FACTOR_RANGE = (0.5, 1.7)


@dataclass(frozen=True)
class Measurement:
    """Distances that tell the size of some bodies: pairs of landmarks; ``*`` is either side."""

    bodies: tuple[str, ...]
    pairs: tuple[tuple[str, str], ...]


MEASUREMENTS: tuple[Measurement, ...] = (
    Measurement(("torso", "head"), (("c7", "left_psis"), ("c7", "right_psis"))),
    Measurement(("pelvis", "sacrum"), (("right_asis", "left_asis"), ("right_psis", "left_psis"))),
    Measurement(("femur_*",), (("*_trochanter", "*_lateral_knee"),)),
    Measurement(
        ("tibia_*",),
        (("*_lateral_knee", "*_lateral_ankle"), ("*_medial_knee", "*_medial_ankle")),
    ),
    Measurement(
        ("talus_*", "calcn_*", "toes_*"),
        (("*_heel", "*_first_metatarsal"), ("*_heel", "*_fifth_metatarsal")),
    ),
    Measurement(
        ("humerus_*",), (("*_acromion", "*_lateral_elbow"), ("*_acromion", "*_medial_elbow"))
    ),
    Measurement(
        ("ulna_*", "radius_*", "hand_*"),
        (("*_lateral_elbow", "*_radial_wrist"), ("*_medial_elbow", "*_ulnar_wrist")),
    ),
)
"""What sizes which body; both sides are averaged."""


@dataclass(frozen=True, eq=False)
class MarkerModel:
    """A model with the markers of a set, scaled to a person or not yet.

    Parameters
    ----------
    model
        Its markers are those of the set, in the set's order (some may be left out).
    marker_set
        Name of the set; empty where the markers are a model file's own.
    weights
        Marker name to weight.
    scale
        Body to factor against the unscaled model.
    static_coordinates
        Shape (Q,): the pose of the static frames, rad and m; the default pose before scaling.
    static_rms_m
        Distance of the model's markers from the static ones before they moved there.
    source
        The model file.
    """

    model: OsimModel
    marker_set: str
    weights: Mapping[str, float]
    scale: Mapping[str, float] = field(default_factory=dict)
    static_coordinates: Array | None = None
    static_rms_m: float = float("nan")
    source: Path = DEFAULT_MODEL

    @cached_property
    def tree(self) -> KinematicTree:
        """The model ready for computing."""
        return KinematicTree(self.model)

    @property
    def marker_names(self) -> tuple[str, ...]:
        """The model's markers."""
        return tuple(m.name for m in self.model.markers)

    @cached_property
    def free(self) -> NDArray[np.intp]:
        """Columns of the coordinates that may change."""
        names = self.tree.coordinate_names
        locked = {c.name for c in self.model.coordinates if c.is_locked}
        return np.array(
            [i for i, n in enumerate(names) if n not in locked and n[:-2] not in LOCKED]
        )

    @cached_property
    def start(self) -> Array:
        """Shape (Q,): a pose to start from."""
        if self.static_coordinates is not None:
            return self.static_coordinates
        start = self.tree.default_coordinates()
        for name, value in STANDING.items():
            if name in self.tree.column:
                start[self.tree.column[name]] = value
        return start

    def joint_centres(self, coordinates: Array) -> dict[str, Array]:
        """Return hips, knees, ankles, shoulders, elbows and wrists, shape (T, 3) each, m.

        `coordinates` (T, Q) in rad and m; NaN there makes NaN here.
        """
        poses = self.tree.pose(coordinates)
        return {
            f"{side}_{joint}": poses.origin[self.tree.body_column[f"{body}_{side[0]}"]].T
            for side in ("left", "right")
            for joint, body in _ORIGIN_BODIES.items()
            if f"{body}_{side[0]}" in self.tree.body_column
        }

    def problem(self, names: Sequence[str]) -> tuple[MarkerProblem, NDArray[np.intp]]:
        """Return the fit to markers of these names, and the columns among them that it uses."""
        own = {m.name: m for m in self.model.markers}
        used = np.array([i for i, name in enumerate(names) if name in own], dtype=np.intp)
        if used.size < 3:
            raise DataError(
                f"The model has markers {', '.join(list(own)[:5])} and so on, the recording "
                f"{', '.join(list(names)[:5])}; expected the names of one marker set."
            )
        chosen = [own[names[i]] for i in used]
        problem = MarkerProblem(
            tree=self.tree,
            body=np.array([self.tree.body_column[m.body] for m in chosen]),
            local=np.array([m.local for m in chosen]),
            weights=np.array([self.weights.get(m.name, 1.0) for m in chosen]),
            free=self.free,
        )
        return problem, used


@cache
def _default_model() -> OsimModel:
    return read_osim(DEFAULT_MODEL)


def default_weights(marker_set: MarkerSet) -> dict[str, float]:
    """Return marker -> weight: pelvis 5, trunk 2, others 1."""
    return {
        marker: WEIGHT_OF_BODY.get(_place(landmark)[0], 1.0)
        for marker, landmark in zip(marker_set.keypoints, marker_set.landmarks, strict=True)
    }


def _place(landmark: str) -> tuple[str, Array]:
    """Return body and local position of a landmark in the unscaled model."""
    side, _, part = landmark.partition("_")
    if side not in {"left", "right"}:
        return _BODY_OF_PART[landmark], np.array(_LOCAL_M[landmark])
    body, local = _BODY_OF_PART[part], np.array(_LOCAL_M[part])
    local[2] *= 1.0 if side == "right" else -1.0
    return (body if body in {"head", "torso", "pelvis"} else f"{body}_{side[0]}"), local


def build_marker_model(
    marker_set: str = "synthetic_45",
    *,
    model: str | Path | None = None,
    weights: Mapping[str, float] | None = None,
) -> MarkerModel:
    """Put the markers of a set on a model that is not scaled yet.

    Parameters
    ----------
    marker_set
        Name of the set.
    model
        Another OpenSim 4 model with bodies of the same names, such as Hamner's; by default the one
        that comes with LiftLens.
    weights
        Marker to weight, replacing the defaults of those named.

    Raises
    ------
    DataError
        If the set is unknown or the model lacks a body.
    """
    if marker_set not in MARKER_SETS:
        raise DataError(f"Unknown marker set {marker_set!r}; known: {', '.join(MARKER_SETS)}.")
    chosen = MARKER_SETS[marker_set]
    base = _default_model() if model is None else read_osim(model)
    markers = []
    for marker, landmark in zip(chosen.keypoints, chosen.landmarks, strict=True):
        body, local = _place(landmark)
        if body == "head" and "head" not in base.bodies:
            # Models without a neck carry the head on the torso.
            body, local = "torso", local + np.array([0.0, 0.51, 0.0])
        if body not in base.bodies:
            raise DataError(f"The model {base.name} has no body {body!r} for the marker {marker}.")
        markers.append(ModelMarker(marker, body, local))
    return MarkerModel(
        model=replace(base, markers=tuple(markers)),
        marker_set=marker_set,
        weights={**default_weights(chosen), **(weights or {})},
        source=DEFAULT_MODEL if model is None else Path(model).resolve(),
    )


def read_marker_model(
    path: str | Path, *, weights: Mapping[str, float] | None = None
) -> MarkerModel:
    """Read a model that is scaled already and has markers of its own.

    Parameters
    ----------
    path
        An OpenSim 4 model, such as `ScaleTool` leaves it.
    weights
        Marker to weight; 1 where absent.

    Raises
    ------
    DataError
        If the file is no OpenSim 4 model, uses joints that are not supported, or has no markers.
    """
    model = read_osim(path)
    if not model.markers:
        raise DataError(
            f"The model {Path(path).name} has no markers; scale it with its marker set first."
        )
    return MarkerModel(
        model=model, marker_set="", weights=dict(weights or {}), source=Path(path).resolve()
    )


# --------------------------------------------------------------------------- scaling


def scale_to_person(unscaled: MarkerModel, static_m: Array, names: Sequence[str]) -> MarkerModel:
    """Scale a model to a person and move its markers to where they were measured.

    Distances are compared in the pose of the static markers, found by inverse kinematics, and the
    scaling is repeated with the pose of the scaled model: pairs that cross a joint then measure
    the body and not the model's default pose.

    Parameters
    ----------
    unscaled
        From `build_marker_model`.
    static_m
        Shape (M, 3): the markers while standing, m; NaN where missing.
    names
        The M markers.

    Raises
    ------
    DataError
        If the markers make a body half or twice the size of the model's.
    """
    marker_set = MARKER_SETS[unscaled.marker_set]
    measured = dict(zip(names, np.asarray(static_m), strict=True))
    current, factors = unscaled, dict.fromkeys(unscaled.model.bodies, 1.0)
    solution = _fit_static(current, static_m, names)
    for _ in range(SCALING_ROUNDS):
        placed = dict(zip(current.marker_names, _markers_of(current, solution), strict=True))
        ratio = _compare(marker_set, measured, placed)
        factors = {body: f * ratio.get(body, 1.0) for body, f in factors.items()}
        _require_human(factors)
        current = replace(
            unscaled,
            model=scale_model(unscaled.model, factors),
            scale=factors,
            static_coordinates=solution.coordinates[0],
        )
        solution = _fit_static(current, static_m, names)
    return replace(
        current,
        model=_move_markers(current.model, solution.coordinates[0], measured),
        static_coordinates=solution.coordinates[0],
        static_rms_m=float(solution.rms_m[0]),
    )


def _fit_static(model: MarkerModel, static_m: Array, names: Sequence[str]) -> Solution:
    """Fit one frame, facing whichever way."""
    problem, used = model.problem(names)
    target = np.asarray(static_m)[None, used]
    if model.static_coordinates is not None:
        return problem.solve(target, model.start, rate_hz=1.0)
    best: Solution | None = None
    for heading in HEADINGS_RAD:
        start = model.start.copy()
        if "pelvis_rotation" in model.tree.column:
            start[model.tree.column["pelvis_rotation"]] = heading
        for axis, name in enumerate(("pelvis_tx", "pelvis_ty", "pelvis_tz")):
            if name in model.tree.column:
                start[model.tree.column[name]] = np.nanmean(target[0, :, axis])
        found = problem.solve(target, start, rate_hz=1.0)
        if best is None or found.rms_m[0] < best.rms_m[0]:
            best = found
    assert best is not None
    return best


def _markers_of(model: MarkerModel, solution: Solution) -> Array:
    """Return all markers of a model in the pose of a solution, shape (M, 3)."""
    poses = model.tree.pose(solution.coordinates)
    body = np.array([model.tree.body_column[m.body] for m in model.model.markers])
    return poses.place(body, np.array([m.local for m in model.model.markers]))[..., 0].T


def _compare(
    marker_set: MarkerSet, measured: Mapping[str, Array], placed: Mapping[str, Array]
) -> dict[str, float]:
    """Return body -> measured by model distance; absent where nothing was measured."""
    of = marker_set.of_landmark
    ratio: dict[str, float] = {}
    for measurement in MEASUREMENTS:
        found = []
        for a, b in measurement.pairs:
            for side in ("left", "right") if "*" in a else ("",):
                first, second = (of.get(k.replace("*", side), "") for k in (a, b))
                if first not in measured or second not in measured:
                    continue
                own = np.linalg.norm(measured[first] - measured[second])
                found.append(own / np.linalg.norm(placed[first] - placed[second]))
        usable = [value for value in found if np.isfinite(value)]
        for body in measurement.bodies if usable else ():
            for letter in ("l", "r") if "*" in body else ("",):
                ratio[body.replace("*", letter)] = float(np.mean(usable))
    return ratio


def _require_human(factors: Mapping[str, float]) -> None:
    for body, factor in factors.items():
        if not FACTOR_RANGE[0] <= factor <= FACTOR_RANGE[1]:
            raise DataError(
                f"The markers make the {body.replace('_', ' ')} {factor:.2f} times as large as the "
                f"model's, expected {FACTOR_RANGE[0]:g} to {FACTOR_RANGE[1]:g}; check which "
                "markers are named what, and that the static frames show the person standing."
            )


def _move_markers(model: OsimModel, coordinates: Array, measured: Mapping[str, Array]) -> OsimModel:
    """Put every measured marker where it was, seen from its body in the static pose."""
    tree = KinematicTree(model)
    poses = tree.pose(coordinates[None])
    markers = []
    for marker in model.markers:
        seen = measured.get(marker.name)
        if seen is not None and np.isfinite(seen).all():
            body = tree.body_column[marker.body]
            local = poses.rotation[body, ..., 0].T @ (seen - poses.origin[body, :, 0])
            markers.append(replace(marker, local=local))
        else:
            markers.append(marker)
    return replace(model, markers=tuple(markers))
