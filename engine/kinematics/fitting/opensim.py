"""The solver `opensim`: the same fit to skin markers by OpenSim's tools (extra `opensim`).

Without OpenSim it raises `BackendUnavailable` with the command that installs it.
"""

from __future__ import annotations

from engine.kinematics.angles import ANGLE_NAMES
from engine.kinematics.fitting.base import SolverInfo
from engine.kinematics.fitting.marker_ik import MarkerSolver

__all__ = ["SOLVER"]

SOLVER = MarkerSolver(
    SolverInfo(
        name="opensim",
        title="OpenSim's inverse kinematics on skin markers",
        angles=ANGLE_NAMES,
        description="For tracks of 45 skin markers: OpenSim's own scaling and inverse kinematics, "
        "in a process of its own, on the model of the solver `markers`. Slower; for comparison "
        "with published work.",
        requires=("opensim",),
        extra="opensim",
        takes_markers=True,
    ),
    "opensim",
)
