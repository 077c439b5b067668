"""Skin markers: reading, filtering, and the joint angles of a full-body model fitted to them."""

from engine.kinematics.markers.fit import MarkerFit, fit_markers, table3_angles
from engine.kinematics.markers.keypoints import keypoints_from_markers
from engine.kinematics.markers.model import (
    MarkerModel,
    build_marker_model,
    read_marker_model,
    scale_to_person,
)
from engine.kinematics.markers.mot import write_coordinates_mot
from engine.kinematics.markers.recording import (
    MarkerRecording,
    filter_markers,
    resample_markers,
)
from engine.kinematics.markers.trc import read_marker_trc, write_marker_trc

__all__ = [
    "MarkerFit",
    "MarkerModel",
    "MarkerRecording",
    "build_marker_model",
    "filter_markers",
    "fit_markers",
    "keypoints_from_markers",
    "read_marker_model",
    "read_marker_trc",
    "resample_markers",
    "scale_to_person",
    "table3_angles",
    "write_coordinates_mot",
    "write_marker_trc",
]
