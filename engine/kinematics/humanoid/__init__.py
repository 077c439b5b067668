"""The jointed figure that is fitted to keypoints: 26 degrees of freedom, constant segments.

The axes of this package are those of the figure: X forward, Y to the left, Z up, origin in the
middle between the hips. `to_model_axes` and `to_world_axes` lead there and back.
"""

from engine.kinematics.humanoid.forward import compute_joints, fit_residual
from engine.kinematics.humanoid.lengths import SegmentLengths, estimate_segment_lengths
from engine.kinematics.humanoid.model import (
    FITTED_JOINTS,
    VARIABLES,
    Variable,
    centre_on_pelvis,
    to_model_axes,
    to_world_axes,
)
from engine.kinematics.humanoid.readout import angles_from_model
from engine.kinematics.humanoid.tree import compute_jacobian

__all__ = [
    "FITTED_JOINTS",
    "VARIABLES",
    "SegmentLengths",
    "Variable",
    "angles_from_model",
    "centre_on_pelvis",
    "compute_jacobian",
    "compute_joints",
    "estimate_segment_lengths",
    "fit_residual",
    "to_model_axes",
    "to_world_axes",
]
