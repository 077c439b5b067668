"""The solver `udeas+polish`: fewer searches by dynamic encoding, finished by least squares."""

from __future__ import annotations

from engine.kinematics.fitting._udeas_report import ANGLES
from engine.kinematics.fitting._udeas_search import SearchPlan
from engine.kinematics.fitting.base import SolverInfo
from engine.kinematics.fitting.udeas import UdeasSolver

__all__ = ["SOLVER"]

SOLVER = UdeasSolver(
    info=SolverInfo(
        name="udeas+polish",
        title="Body model fitted by uDEAS and least squares",
        angles=ANGLES,
        description="The published fit with fewer searches, each frame then finished by a few "
        "least-squares steps down the same cost: nearer to the keypoints than uDEAS alone, in "
        "less time. Frame by frame, not smoothed over time.",
    ),
    plan=SearchPlan(
        restarts=8, n_passes=10, narrowest_deg=3.0, searches_per_centre=1, polish_steps=6
    ),
)
