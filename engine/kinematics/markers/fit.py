"""Joint angles from skin markers: scaling, inverse kinematics, and angles in LiftLens's names."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from engine.datatypes import Array, JointAngles, frozen_array
from engine.errors import ConfigError, DataError, ShapeError
from engine.kinematics import angles as geometry
from engine.kinematics.markers._opensim import require_opensim, run_opensim
from engine.kinematics.markers.inverse import Solution
from engine.kinematics.markers.keypoints import find_marker_set, keypoints_from_markers
from engine.kinematics.markers.model import MarkerModel, build_marker_model, scale_to_person
from engine.kinematics.markers.recording import MarkerRecording
from engine.skeletons import BODY_SEGMENTS, get_skeleton

__all__ = ["TABLE3_ROWS", "MarkerFit", "fit_markers", "table3_angles"]

STANDING_WINDOW_S = 0.5
"""Frames around the moment of standing that are averaged for scaling."""
STANDING_SEARCH_S = 1.5
"""Trials start standing; the most upright moment of this long a start is taken as static."""
MAX_LEAN_DEG, MAX_KNEE_DEG = 25.0, 30.0
"""More than this is no standing: the line from PSIS to C7 leans 5 to 10 degrees in most people, and
the trochanter lies beside the hip, so that a straight knee shows some 5 degrees."""
MIN_MARKERS_IN_FRAME = 12
UNSEEN_DEG = 30.0
"""An angle whose standard error for errors of 1 cm in every marker is above this is not shown."""
TEST_ERROR_M = 0.01
LARGE_RESIDUAL_M = 0.04

TABLE3_ROWS: Mapping[str, tuple[str, int]] = {
    "hip flexion": ("hip_flexion_*", 1),
    "hip adduction": ("hip_adduction_*", 1),
    "hip rotation": ("hip_rotation_*", 1),
    "knee flexion": ("knee_angle_*", 1),
    "ankle flexion": ("ankle_angle_*", 1),
    "lumbar extension": ("L5_S1_Flex_Ext", 1),
    "lumbar bending": ("L5_S1_Lat_Bending", 1),
    "lumbar rotation": ("L5_S1_axial_rotation", 1),
    "arm flexion": ("arm_flex_*", 1),
    "arm adduction": ("arm_add_*", 1),
    "arm rotation": ("arm_rot_*", 1),
    "elbow flexion": ("elbow_flex_*", 1),
    "elbow rotation": ("pro_sup_*", 1),
}
"""The 13 rows of the lifting method's table of angles: coordinate of the model, and sign. Positive
is flexion (dorsiflexion of the ankle), adduction, internal rotation, pronation; of the lumbar spine
extension, bending to the right, turning to the left."""
_OTHER_NAMES: Mapping[str, str] = {
    "L5_S1_Flex_Ext": "lumbar_extension",
    "L5_S1_Lat_Bending": "lumbar_bending",
    "L5_S1_axial_rotation": "lumbar_rotation",
}
"""Names of the same coordinates in the model of Hamner et al. (2010)."""


@dataclass(frozen=True, eq=False)
class MarkerFit:
    """What inverse kinematics makes of markers.

    Parameters
    ----------
    time_s
        Shape (T,), s.
    coordinates
        Shape (T, Q): the model's coordinates; NaN in frames that could not be fitted.
    coordinate_names, unit
        Of the Q coordinates; the unit is `deg` or `m` each.
    sigma
        Shape (T, Q): standard errors in the same units, from how far the markers miss; NaN where
        a coordinate was held fixed.
    scale
        Body to factor against the unscaled model.
    marker_names
        The M markers.
    markers_m, residual_m
        Shapes (T, M, 3) and (T, M): the model's markers, and their distances from the measured
        ones; NaN where the model has no such marker or nothing was measured.
    angles
        In LiftLens's names and signs.
    model
        As fitted; give it to `fit_markers` to fit other trials of the same person.
    solver
        `builtin` or `opensim`.
    static_rms_m
        How far the scaled model missed the static markers, before they moved.
    warnings
        What makes the result less certain, in words.
    """

    time_s: Array
    coordinates: Array
    coordinate_names: tuple[str, ...]
    unit: tuple[str, ...]
    sigma: Array
    scale: Mapping[str, float]
    marker_names: tuple[str, ...]
    markers_m: Array
    residual_m: Array
    angles: JointAngles
    model: MarkerModel
    solver: str = "builtin"
    static_rms_m: float = float("nan")
    warnings: tuple[str, ...] = field(default=())

    def __post_init__(self) -> None:
        for name in ("time_s", "coordinates", "sigma", "markers_m", "residual_m"):
            object.__setattr__(self, name, frozen_array(getattr(self, name)))

    @property
    def segment_lengths_m(self) -> dict[str, float]:
        """Thigh, shank, upper arm, forearm of either side, widths of pelvis and shoulders, m."""
        joints = self.model.joint_centres(self.model.start[None])
        lengths = {}
        for segment, first, second in BODY_SEGMENTS:
            if first in joints and second in joints:
                lengths[segment] = float(np.linalg.norm(joints[first] - joints[second]))
        return lengths

    def __getitem__(self, name: str) -> Array:
        """Return one coordinate over time, shape (T,), degrees or metres."""
        if name not in self.coordinate_names:
            known = ", ".join(self.coordinate_names)
            raise DataError(f"There is no coordinate {name!r} here; known: {known}.")
        return self.coordinates[:, self.coordinate_names.index(name)]


def fit_markers(
    time_s: ArrayLike,
    position_m: ArrayLike,
    names: Sequence[str],
    *,
    static_frames: slice | Sequence[int] | None = None,
    stature_m: float | None = None,
    mass_kg: float | None = None,
    weights: Mapping[str, float] | None = None,
    ik: Literal["builtin", "opensim"] = "builtin",
    model: MarkerModel | None = None,
) -> MarkerFit:
    """Fit the full-body model to markers: scaling on static frames, then inverse kinematics.

    Parameters
    ----------
    time_s
        Shape (T,), s.
    position_m
        Shape (T, M, 3), m, Y up; NaN where missing.
    names
        The M markers, of one of `engine.skeletons.MARKER_SETS`.
    static_frames
        Frames in which the person stands still, as a slice or numbers; by default the most upright
        half second of the first 1.5 s.
    stature_m, mass_kg
        Written to OpenSim's files; the fit itself takes all sizes from the markers.
    weights
        Marker to weight, replacing the defaults (pelvis 5, trunk 2, others 1).
    ik
        `builtin`, or `opensim` for the reference implementation (extra `opensim`).
    model
        A model scaled on another trial of the same person; nothing is scaled then.

    Returns
    -------
    MarkerFit

    Raises
    ------
    ShapeError
        If shapes do not match.
    DataError
        If the markers are of no known set, nobody stands, or the sizes are not human.
    BackendUnavailable
        If `ik` is `opensim` and it is not installed.
    """
    times = np.asarray(time_s, dtype=np.float64)
    position = np.asarray(position_m, dtype=np.float64)
    if position.shape != (times.size, len(names), 3):
        raise ShapeError(
            f"position_m needs shape {(times.size, len(names), 3)} for these times and names, got "
            f"{position.shape}."
        )
    if ik not in ("builtin", "opensim"):
        raise ConfigError(f"ik must be 'builtin' or 'opensim', got {ik!r}.")
    if ik == "opensim":
        require_opensim()
    static = None
    if model is None:
        static = average_static(times, position, names, static_frames)
        unscaled = build_marker_model(find_marker_set(names).name, weights=weights)
        model = scale_to_person(unscaled, static, names)
    if ik == "opensim":
        return _fit_opensim(
            times,
            position,
            tuple(names),
            model,
            static=static,
            stature_m=stature_m,
            mass_kg=mass_kg,
        )
    return _fit_builtin(times, position, tuple(names), model)


def average_static(
    time_s: Array,
    position_m: Array,
    names: Sequence[str],
    frames: slice | Sequence[int] | None = None,
) -> Array:
    """Return the markers while standing, shape (M, 3), m: the median over the static frames.

    Raises
    ------
    DataError
        If no static frames were named and nobody stands at the start.
    """
    if frames is None:
        frames = find_standing(time_s, position_m, names)
    chosen = position_m[frames]
    if chosen.shape[0] == 0:
        raise DataError("The static frames hold no frame; name frames in which the person stands.")
    seen = np.isfinite(chosen).all(axis=2).any(axis=0)
    static = np.full(chosen.shape[1:], np.nan)
    static[seen] = np.nanmedian(chosen[:, seen], axis=0)
    return static


def find_standing(time_s: Array, position_m: Array, names: Sequence[str]) -> slice:
    """Return the frames around the most upright moment, at the start of the trial if possible.

    Raises
    ------
    DataError
        If trunk or legs are never seen, or nobody stands upright with straight legs.
    """
    lean, bend, height = _posture(position_m, names)
    stands = (lean < MAX_LEAN_DEG) & (bend < MAX_KNEE_DEG) & np.isfinite(height)
    if not stands.any():
        raise DataError(
            "Nobody stands upright with straight legs in this trial, which sizes the model; name "
            "the static frames, or use a model scaled on another trial of the person."
        )
    early = stands & (time_s <= time_s[0] + STANDING_SEARCH_S)
    chosen = np.flatnonzero(early if early.any() else stands)
    best = chosen[int(np.argmax(height[chosen]))]
    near = np.flatnonzero(stands & (np.abs(time_s - time_s[best]) <= STANDING_WINDOW_S / 2))
    # Only the unbroken stretch around the best frame: no moment before or after bending.
    breaks = np.flatnonzero(np.diff(near) > 1)
    at = int(np.searchsorted(near, best))
    first = max((int(i) + 1 for i in breaks if i < at), default=0)
    last = min((int(i) for i in breaks if i >= at), default=near.size - 1)
    return slice(int(near[first]), int(near[last]) + 1)


def _posture(position_m: Array, names: Sequence[str]) -> tuple[Array, Array, Array]:
    """Return lean of the trunk and larger knee bend, degrees, and height of C7, m; (T,) each."""
    of = find_marker_set(names).of_landmark
    column = {name: i for i, name in enumerate(names)}
    missing = np.full((len(position_m), 3), np.nan)

    def middle(*landmarks: str) -> Array:
        parts = [
            position_m[:, column[of[k]]] if of.get(k) in column else missing for k in landmarks
        ]
        return np.asarray(sum(parts) / len(parts))

    top = middle("c7")
    trunk = top - middle("left_psis", "right_psis")
    lean = np.degrees(np.arctan2(np.linalg.norm(trunk[:, [0, 2]], axis=1), trunk[:, 1]))
    bends = [
        geometry.compute_hinge_flexion(
            middle(f"{side}_trochanter"),
            middle(f"{side}_lateral_knee", f"{side}_medial_knee"),
            middle(f"{side}_lateral_ankle", f"{side}_medial_ankle"),
        )
        for side in ("left", "right")
    ]
    return lean, np.fmax(*bends), top[:, 1]


def _frames_to_fit(measured: Array) -> NDArray[np.bool_]:
    """Return which frames (T,) have enough markers of (T, M, 3)."""
    enough = np.isfinite(measured).all(axis=2).sum(axis=1) >= MIN_MARKERS_IN_FRAME
    if not enough.any():
        raise DataError(
            f"No frame has {MIN_MARKERS_IN_FRAME} of the model's markers; there is nothing to fit."
        )
    return np.asarray(enough)


def _fit_builtin(
    time_s: Array, position: Array, names: tuple[str, ...], model: MarkerModel
) -> MarkerFit:
    problem, used = model.problem(names)
    measured = position[:, used]
    fitted = _frames_to_fit(measured)
    rate = float(1.0 / np.median(np.diff(time_s[fitted]))) if fitted.sum() > 1 else 1.0
    solution = problem.solve(measured[fitted], model.start, rate_hz=rate)
    return _describe(time_s, position, names, model, solution, fitted, solver="builtin")


def _fit_opensim(
    time_s: Array,
    position: Array,
    names: tuple[str, ...],
    model: MarkerModel,
    *,
    static: Array | None,
    stature_m: float | None,
    mass_kg: float | None,
) -> MarkerFit:
    """Fit with OpenSim; with `static`, its `ScaleTool` makes the model anew."""
    rate = float(1.0 / np.median(np.diff(time_s))) if time_s.size > 1 else 100.0
    recording = MarkerRecording(time_s, position, names, rate)
    start = model
    if static is not None:
        unscaled = build_marker_model(model.marker_set, weights=model.weights)
        start = replace(unscaled, static_coordinates=model.static_coordinates)
    run = run_opensim(recording, start, static_m=static, stature_m=stature_m, mass_kg=mass_kg)
    problem, used = run.model.problem(names)
    fitted = _frames_to_fit(position[:, used]) & np.isfinite(run.coordinates).all(axis=1)
    solution = problem.evaluate(position[fitted][:, used], run.coordinates[fitted])
    return _describe(time_s, position, names, run.model, solution, fitted, solver="opensim")


def _describe(
    time_s: Array,
    position: Array,
    names: tuple[str, ...],
    model: MarkerModel,
    solution: Solution,
    fitted: NDArray[np.bool_],
    *,
    solver: str,
) -> MarkerFit:
    """Turn the solution of the `fitted` frames (T,) into a fit of all of them."""
    problem, used = model.problem(names)
    is_length = model.tree.is_translation
    shape = (time_s.size, is_length.size)
    coordinates, variance = np.full(shape, np.nan), np.full(shape, np.nan)
    coordinates[fitted] = _unwrap(solution.coordinates, problem.free, model)
    variance[fitted] = solution.variance
    is_unseen = ~is_length & (TEST_ERROR_M * np.sqrt(variance) > np.radians(UNSEEN_DEG))
    coordinates[is_unseen] = np.nan
    markers = np.full(position.shape, np.nan)
    markers[np.ix_(fitted, used)] = solution.markers
    error = _marker_error(position[fitted][:, used], solution.markers, problem.free.size)
    factor = np.where(is_length, 1.0, np.degrees(1.0))
    value, sigma = coordinates * factor, np.sqrt(variance) * error * factor
    sigma[is_unseen] = np.nan
    residual = np.linalg.norm(markers - position, axis=2)
    return MarkerFit(
        time_s=time_s,
        coordinates=value,
        coordinate_names=model.tree.coordinate_names,
        unit=tuple("m" if t else "deg" for t in is_length),
        sigma=sigma,
        scale=dict(model.scale),
        marker_names=names,
        markers_m=markers,
        residual_m=residual,
        angles=_name_angles(time_s, value, sigma, model, markers, names),
        model=model,
        solver=solver,
        static_rms_m=model.static_rms_m,
        warnings=_warnings(residual, time_s.size - int(fitted.sum())),
    )


def _warnings(residual: Array, n_left_out: int) -> tuple[str, ...]:
    found = []
    rms = float(np.sqrt(np.nanmean(residual**2)))
    if rms > LARGE_RESIDUAL_M:
        found.append(
            f"The markers miss the model by {100 * rms:.1f} cm (root mean square); 1 to 3 cm are "
            "usual. Check the names of the markers."
        )
    if n_left_out:
        found.append(f"{n_left_out} frames have too few markers for a pose and stay empty.")
    return tuple(found)


def _marker_error(measured: Array, placed: Array, n_free: int) -> float:
    """Return the standard error per axis of a marker, from how far all of them miss the model.

    Every frame's own coordinates follow the errors, which makes the distances too small for them.
    """
    missed = measured - placed
    seen = np.isfinite(missed)
    spare = int(seen.sum()) - n_free * len(measured)
    return float(np.sqrt(np.nansum(missed**2) / max(1, spare)))


def _unwrap(coordinates: Array, free: NDArray[np.intp], model: MarkerModel) -> Array:
    """Return angles without turns of 360 degrees: within half a turn of zero at first."""
    turned = coordinates.copy()
    for column in free:
        if model.tree.is_translation[column]:
            continue
        curve = np.unwrap(coordinates[:, column])
        turned[:, column] = curve - 2 * np.pi * np.round(np.median(curve) / (2 * np.pi))
    return turned


# --------------------------------------------------------------------------- angles


def _name_angles(
    time_s: Array,
    value: Array,
    error: Array,
    model: MarkerModel,
    markers: Array,
    names: tuple[str, ...],
) -> JointAngles:
    """Return every angle of the convention that the model has, in LiftLens's names and signs."""
    columns = model.tree.column
    shape = (time_s.size, len(geometry.ANGLE_NAMES))
    angle, sigma = np.full(shape, np.nan), np.full(shape, np.nan)
    for i, name in enumerate(geometry.ANGLE_NAMES):
        found = _coordinate_of(name, columns)
        if found is not None:
            angle[:, i] = found[1] * value[:, columns[found[0]]]
            sigma[:, i] = error[:, columns[found[0]]]
    trunk = _trunk_angles(model, value)
    for name, curve in trunk.items():
        angle[:, geometry.ANGLE_NAMES.index(name)] = curve
    if model.marker_set:
        neck = geometry.ANGLE_NAMES.index("neck_flexion")
        angle[:, neck] = _neck_flexion(time_s, markers, names, trunk["trunk_inclination"])
    return JointAngles(time_s=time_s, value_deg=angle, names=geometry.ANGLE_NAMES, sigma_deg=sigma)


def _coordinate_of(name: str, columns: Mapping[str, int]) -> tuple[str, int] | None:
    """Return the model's coordinate for one of our angles, and ``ours = sign * theirs``."""
    for system in ("opensim_pose2sim", "opensim_hamner"):
        external = geometry.get_external_angle(name, system)
        if external is not None and external.name in columns:
            return external.name, external.sign
    return None


def _trunk_angles(model: MarkerModel, value: Array) -> dict[str, Array]:
    """Return the angles of the trunk line between the model's hips and shoulders."""
    factor = np.where(model.tree.is_translation, 1.0, np.radians(1.0))
    joints = model.joint_centres(value * factor)
    needed = ("left_shoulder", "right_shoulder", "left_hip", "right_hip")
    trunk = geometry.compute_trunk_angles(*(joints[k] for k in needed))
    return {
        f"trunk_{k}": v
        for k, v in zip(("inclination", "flexion", "lateral_bend", "twist"), trunk, strict=True)
    }


def _neck_flexion(
    time_s: Array, markers: Array, names: tuple[str, ...], inclination: Array
) -> Array:
    """Return neck flexion against upright standing, from the model's markers."""
    track = keypoints_from_markers(time_s, markers, names)
    skeleton = get_skeleton(track.skeleton)
    point = {
        k: skeleton.point(track.position, k)
        for k in ("mid_ear", "left_shoulder", "right_shoulder", "pelvis")
    }
    curve = geometry.compute_neck_angle(
        point["mid_ear"],
        left_shoulder=point["left_shoulder"],
        right_shoulder=point["right_shoulder"],
        mid_hip=point["pelvis"],
    )
    upright = geometry.find_upright(inclination) & np.isfinite(curve)
    return np.asarray(curve - geometry.estimate_neutral_deg(curve, upright))


def table3_angles(fit: MarkerFit) -> tuple[tuple[str, ...], Array]:
    """Return the angles of the lifting method's Table 3, with its signs.

    Parameters
    ----------
    fit
        From `fit_markers`.

    Returns
    -------
    tuple
        The 23 names, such as ``hip flexion (left)`` and ``lumbar bending``, in the order of the
        13 rows, and their curves, shape (T, 23), degrees. Missing coordinates are NaN.
    """
    names, curves = [], []
    for row, (pattern, sign) in TABLE3_ROWS.items():
        for side in ("left", "right") if "*" in pattern else ("",):
            coordinate = pattern.replace("*", side[:1])
            names.append(f"{row} ({side})" if side else row)
            curves.append(sign * _curve_of(fit, coordinate))
    return tuple(names), np.stack(curves, axis=1)


def _curve_of(fit: MarkerFit, coordinate: str) -> Array:
    for name in (coordinate, _OTHER_NAMES.get(coordinate, "")):
        if name in fit.coordinate_names:
            low = fit.model.model.coordinate(name).low
            # In Hamner's model the knee bends towards negative angles.
            is_reversed = name.startswith("knee") and low < np.radians(-60)
            return -fit[name] if is_reversed else fit[name]
    return np.full(fit.time_s.size, np.nan)
