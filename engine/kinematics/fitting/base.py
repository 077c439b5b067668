"""What a solver is, and how solvers are found.

A solver turns keypoints in world metres into joint angles. It is one file in this folder with
a `SOLVER` object; the folder is listed, so nothing else is edited to add one.
"""

from __future__ import annotations

import importlib
import importlib.util
import pkgutil
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np

import engine.kinematics.fitting as solvers_package
from engine.datatypes import JointAngles, KinematicFit, PoseTrack, Subject, WorldScene
from engine.errors import BackendUnavailable, ConfigError, UnitError

__all__ = [
    "Solver",
    "SolverInfo",
    "add_scene_errors",
    "list_solvers",
    "require_world_metres",
    "select_solver",
]

VERTICAL_ANGLES = (
    "trunk_inclination",
    "trunk_flexion",
    "trunk_lateral_bend",
    "pelvis_tilt",
    "pelvis_list",
)
"""Angles against the vertical, which is itself only estimated."""

_NOT_SOLVERS = ("base",)


@dataclass(frozen=True)
class SolverInfo:
    """What a user should know of a solver.

    `angles` are the names it returns, as in `engine.kinematics.angles`; `requires` the modules
    it imports when used, `extra` the optional extra that installs them; `takes_markers` says that
    it fits skin markers, not keypoints.
    """

    name: str
    title: str
    angles: tuple[str, ...]
    description: str
    requires: tuple[str, ...] = ()
    extra: str = ""
    takes_markers: bool = False

    @property
    def missing(self) -> tuple[str, ...]:
        """Modules that are needed but not installed."""
        return tuple(m for m in self.requires if importlib.util.find_spec(m) is None)


class Solver(Protocol):
    """A solver: keypoints of one trial in, joint angles out."""

    info: SolverInfo

    def fit(self, track: PoseTrack, subject: Subject) -> KinematicFit:
        """Compute the angles `info.angles` of every frame.

        Raises
        ------
        UnitError
            If the track is not in world metres.
        """


def require_world_metres(track: PoseTrack) -> None:
    """Refuse a track a solver can't use.

    Raises
    ------
    UnitError
        If the track is not three-dimensional, in metres and in the world frame.
    """
    if track.unit != "m" or track.frame_of_reference != "world" or track.position.shape[2] != 3:
        raise UnitError(
            "Joint angles need 3D keypoints in metres in the world frame, got "
            f"{track.position.shape[2]}D in {track.unit} in the {track.frame_of_reference} frame; "
            "place the track in the world first."
        )


def list_solvers() -> tuple[Solver, ...]:
    """Return every solver, ordered by name."""
    names = sorted(m.name for m in pkgutil.iter_modules(solvers_package.__path__))
    return tuple(
        importlib.import_module(f"{solvers_package.__name__}.{name}").SOLVER
        for name in names
        if name not in _NOT_SOLVERS and not name.startswith("_")
    )


def select_solver(name: str) -> Solver:
    """Return the solver of that name.

    Raises
    ------
    ConfigError
        If there is none.
    BackendUnavailable
        If something it needs is not installed.
    """
    known = {solver.info.name: solver for solver in list_solvers()}
    if name not in known:
        raise ConfigError(f"Unknown solver {name!r}; known: {', '.join(known)}.")
    info = known[name].info
    if info.missing:
        raise BackendUnavailable(
            f"The solver {name!r} needs {', '.join(info.missing)}, which is not installed; "
            f"run: pip install 'liftlens[{info.extra}]'."
        )
    return known[name]


def add_scene_errors(angles: JointAngles, scene: WorldScene) -> JointAngles:
    """Widen the errors of angles against the vertical by that of the vertical itself.

    Parameters
    ----------
    angles
        With the errors of the keypoints.
    scene
        With the standard error of the gravity direction.
    """
    sigma = np.array(angles.sigma_deg)
    columns = [i for i, name in enumerate(angles.names) if name in VERTICAL_ANGLES]
    sigma[:, columns] = np.hypot(sigma[:, columns], scene.tilt_sigma_deg)
    return replace(angles, sigma_deg=sigma)
