"""Markers of a person whose every joint angle is known: the model itself, sized and moved."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from engine.kinematics.markers import MarkerModel, MarkerRecording, build_marker_model
from engine.kinematics.markers.model import STANDING
from engine.kinematics.markers.tree import scale_model

SIZES = {
    "torso": 1.06,
    "head": 1.06,
    "pelvis": 1.04,
    "sacrum": 1.04,
    **{f"{b}_{s}": 1.05 for b in ("femur",) for s in "lr"},
    **{f"{b}_{s}": 0.97 for b in ("tibia",) for s in "lr"},
    **{f"{b}_{s}": 1.08 for b in ("talus", "calcn", "toes") for s in "lr"},
    **{f"{b}_{s}": 1.03 for b in ("humerus",) for s in "lr"},
    **{f"{b}_{s}": 0.96 for b in ("ulna", "radius", "hand") for s in "lr"},
}

DEEPEST_DEG = {
    "pelvis_tilt": -40.0,
    "pelvis_list": 3.0,
    "pelvis_rotation": 8.0,
    "hip_flexion": 85.0,
    "hip_adduction": -8.0,
    "hip_rotation": -6.0,
    "knee_angle": 70.0,
    "ankle_angle": 18.0,
    "L5_S1_Flex_Ext": -35.0,
    "L5_S1_Lat_Bending": 6.0,
    "L5_S1_axial_rotation": 7.0,
    "neck_flexion": 15.0,
    "neck_bending": 3.0,
    "neck_rotation": 5.0,
    "arm_flex": 60.0,
    "arm_add": -12.0,
    "arm_rot": 20.0,
    "elbow_flex": 45.0,
    "pro_sup": 75.0,
}


@dataclass(frozen=True)
class KnownLift:
    """A recording without noise, the model that made it, and its coordinates (T, Q), rad and m."""

    recording: MarkerRecording
    model: MarkerModel
    coordinates: np.ndarray


def make_lift(
    *, n_frames: int = 80, marker_set: str = "synthetic_45", heading_deg: float = 0.0
) -> KnownLift:
    """Stand, bend down, come up."""
    unscaled = build_marker_model(marker_set)
    sized = MarkerModel(
        model=scale_model(unscaled.model, SIZES),
        marker_set=marker_set,
        weights=unscaled.weights,
        scale=SIZES,
    )
    tree = sized.tree
    start = tree.default_coordinates()
    for name, value in STANDING.items():
        start[tree.column[name]] = value
    deep = start.copy()
    for name, column in tree.column.items():
        key = name if name in DEEPEST_DEG else name[:-2]
        if key in DEEPEST_DEG:
            side = 1.05 if name.endswith("_l") else 1.0
            deep[column] = np.radians(DEEPEST_DEG[key]) * side
    deep[tree.column["pelvis_tx"]], deep[tree.column["pelvis_ty"]] = -0.1, 0.6
    for pose in (start, deep):
        pose[tree.column["pelvis_rotation"]] += np.radians(heading_deg)
        for side in "lr":
            # Off the bound at a straight knee, where the fit could hide a wrong sign.
            pose[tree.column[f"knee_angle_{side}"]] += 0.05
    time_s = np.arange(n_frames) / 30.0
    share = np.clip((time_s / time_s[-1] - 0.2) / 0.6, 0.0, 1.0)
    share = 0.5 - 0.5 * np.cos(2 * np.pi * share)
    coordinates = start + share[:, None] * (deep - start)
    body = np.array([tree.body_column[m.body] for m in sized.model.markers])
    local = np.array([m.local for m in sized.model.markers])
    position = tree.pose(coordinates).place(body, local).transpose(2, 1, 0)
    recording = MarkerRecording(
        time_s, position, sized.marker_names, rate_hz=30.0, marker_set=marker_set
    )
    return KnownLift(recording, sized, coordinates)
