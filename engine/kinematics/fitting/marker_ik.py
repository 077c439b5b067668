"""The solver `markers`: a full-body model fitted to skin markers, by LiftLens's own optimiser."""

from __future__ import annotations

from typing import Literal

import numpy as np

from engine.datatypes import BodyFit, KinematicFit, PoseTrack, Subject
from engine.errors import DataError
from engine.kinematics.angles import ANGLE_NAMES
from engine.kinematics.fitting.base import SolverInfo, require_world_metres
from engine.kinematics.markers import MarkerFit, fit_markers
from engine.skeletons import MARKER_SETS, MarkerSet, get_skeleton

__all__ = ["SOLVER", "MarkerSolver", "fit_marker_track"]


def fit_marker_track(
    track: PoseTrack, subject: Subject, *, ik: Literal["builtin", "opensim"]
) -> KinematicFit:
    """Fit the full-body model to a track of skin markers.

    Parameters
    ----------
    track
        World metres, Y up; its skeleton is a marker set.
    subject
        Stature and mass go into OpenSim's files; sizes come from the markers.
    ik
        As in `fit_markers`.

    Raises
    ------
    UnitError
        If the track is not in world metres.
    DataError
        If the track holds keypoints and not markers, or nobody stands upright in it.
    """
    require_world_metres(track)
    skeleton = get_skeleton(track.skeleton)
    if not isinstance(skeleton, MarkerSet):
        raise DataError(
            f"The solvers for markers need skin markers ({', '.join(MARKER_SETS)}), got keypoints "
            f"({track.skeleton}); choose the solver least-squares for keypoints."
        )
    fit = fit_markers(
        track.time_s,
        track.position,
        skeleton.keypoints,
        stature_m=subject.stature_m,
        mass_kg=subject.mass_kg,
        ik=ik,
    )
    return KinematicFit(angles=fit.angles, body=_body_of(track, fit), warnings=fit.warnings)


def _body_of(track: PoseTrack, fit: MarkerFit) -> BodyFit:
    """Return the model's markers as the body that was fitted."""
    is_seen = np.isfinite(fit.residual_m)
    total = np.where(is_seen, fit.residual_m, 0.0).sum(axis=1)
    count = is_seen.sum(axis=1)
    return BodyFit(
        joints=PoseTrack(
            time_s=track.time_s,
            position=fit.markers_m,
            unit="m",
            frame_of_reference="world",
            skeleton=track.skeleton,
            provenance={"model": fit.model.model.name, "solver": fit.solver},
        ),
        residual_m=np.where(count > 0, total / np.maximum(count, 1), np.nan),
        segment_lengths_m=fit.segment_lengths_m,
    )


class MarkerSolver:
    """Inverse kinematics of a full-body model, for tracks of skin markers."""

    def __init__(self, info: SolverInfo, ik: Literal["builtin", "opensim"]) -> None:
        self.info = info
        self._ik = ik

    def fit(self, track: PoseTrack, subject: Subject) -> KinematicFit:
        """Compute the angles of every frame; see `fit_marker_track`."""
        return fit_marker_track(track, subject, ik=self._ik)


SOLVER = MarkerSolver(
    SolverInfo(
        name="markers",
        title="Full-body model fitted to skin markers",
        angles=ANGLE_NAMES,
        description="For tracks of 45 skin markers: the full-body model of Pose2Sim is scaled to "
        "the person while standing, then placed in every frame where its markers lie nearest to "
        "the measured ones.",
        takes_markers=True,
    ),
    "builtin",
)
