"""The solver `udeas`: the published humanoid fit by dynamic encoding, frame by frame.

Choi et al. (2024) fit 21 variables (Eq 7) to twelve joints by the mean distance between them
(Eq 8), with uDEAS. Cost, variables and ranges are theirs. How the searches are spread over the
clip is not published; see `_udeas_search`.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from engine.datatypes import Array, BodyFit, KinematicFit, PoseTrack, Subject
from engine.kinematics.fitting._udeas_report import ANGLES, read_angles, share_pitch
from engine.kinematics.fitting._udeas_search import LOWER, UPPER, SearchPlan, search_clip
from engine.kinematics.fitting.base import SolverInfo, require_world_metres
from engine.kinematics.humanoid import (
    FITTED_JOINTS,
    VARIABLES,
    SegmentLengths,
    centre_on_pelvis,
    compute_joints,
    estimate_segment_lengths,
    to_world_axes,
)
from engine.skeletons import get_skeleton

__all__ = ["SOLVER", "UdeasSolver"]

MIN_JOINTS = 4
"""Joints a frame must show, both hips among them."""
MAX_DISTANCE_M = 50.0
"""Keypoints further from the world's origin are no measurement."""
MAX_RESIDUAL_M = 0.15
"""No human posture comes near keypoints that lie further off on average."""
POOR_FIT_M = 0.08
SIZE_MISMATCH = 0.15
OFTEN = 0.05
"""Share of frames from which something is worth a warning."""
_FREE = ("psi_bd", "theta_bd", "theta_ws", "theta_hp_l", "theta_hp_r")
"""Variables whose place in their range means nothing: a heading, and pitches that only share."""

_INFO = SolverInfo(
    name="udeas",
    title="Body model fitted by uDEAS",
    angles=ANGLES,
    description="The published fit: a jointed figure brought near twelve joints frame by frame, "
    "by searches that move one angle at a time. Slower than least squares, and not smoothed over "
    "time; how the pitch of the trunk is shared between pelvis and lumbar spine is an assumption.",
)


@dataclass(frozen=True)
class UdeasSolver:
    """The humanoid of 21 variables, fitted by dynamic encoding."""

    info: SolverInfo = _INFO
    plan: SearchPlan = field(default_factory=SearchPlan)

    def fit(self, track: PoseTrack, subject: Subject) -> KinematicFit:
        """Compute the angles of every frame.

        Parameters
        ----------
        track
            World metres, Y up; sigma per keypoint, NaN where unknown.
        subject
            The stature guides the segment lengths where the clip doesn't show them well.

        Returns
        -------
        KinematicFit
            Angles are NaN where a hip or a keypoint that determines them is missing, the posture
            doesn't show them, or no posture comes near the keypoints. The same track gives the
            same angles.

        Raises
        ------
        UnitError
            If the track is not in world metres.
        """
        require_world_metres(track)
        track = _drop_impossible(track)
        lengths = estimate_segment_lengths(track, subject.stature)
        targets = centre_on_pelvis(track)
        n_seen = np.isfinite(targets).all(axis=2).sum(axis=1)
        is_enough = np.asarray(n_seen >= MIN_JOINTS)
        values = np.full((track.n_frames, len(VARIABLES)), np.nan)
        residual = np.full(track.n_frames, np.nan)
        if is_enough.any():
            found = search_clip(targets[is_enough], lengths, self.plan)
            values[is_enough], residual[is_enough] = found.values, found.residual_m
        is_fitted = is_enough & (np.nan_to_num(residual, nan=np.inf) <= MAX_RESIDUAL_M)
        shared = share_pitch(values[is_fitted])
        angles = read_angles(track, shared, is_fitted, targets[is_fitted], lengths)
        body = self._make_body(track, values, is_fitted, residual, lengths)
        warnings = _warn(values, residual, is_enough, is_fitted, body, subject)
        return KinematicFit(angles, body, tuple(warnings))

    def _make_body(
        self,
        track: PoseTrack,
        values: Array,
        is_fitted: NDArray[np.bool_],
        residual: Array,
        lengths: SegmentLengths,
    ) -> BodyFit:
        """Put the figure's joints into the track's skeleton."""
        skeleton = get_skeleton(track.skeleton)
        position = np.full(track.position.shape, np.nan)
        size = float("nan")
        if is_fitted.any():
            joints = to_world_axes(compute_joints(values[is_fitted], lengths))
            hips = [skeleton.index(f"{side}_hip") for side in ("left", "right")]
            joints += track.position[is_fitted][:, hips].mean(axis=1, keepdims=True)
            _fill_in(position, skeleton.keypoints, joints, is_fitted)
            size = float(np.median(values[is_fitted, 0]))
        return BodyFit(
            joints=PoseTrack(
                track.time_s,
                position,
                "m",
                "world",
                track.skeleton,
                provenance={"made_by": self.info.name},
            ),
            residual_m=np.where(is_fitted, residual, np.nan),
            segment_lengths_m={
                name: size * length
                for name, length in lengths.as_dict().items()
                if name in _USED_LENGTHS
            },
        )


_USED_LENGTHS = (
    "thigh",
    "shank",
    "pelvis_half_width",
    "trunk",
    "shoulder_half_width",
    "upper_arm",
    "forearm",
)


def _drop_impossible(track: PoseTrack) -> PoseTrack:
    """Make keypoints NaN that are infinite or too far off to be a measurement."""
    is_there = np.abs(track.position).max(axis=2) < MAX_DISTANCE_M
    return replace(track, position=np.where(is_there[..., None], track.position, np.nan))


def _fill_in(
    position: Array, keypoints: tuple[str, ...], joints: Array, frames: NDArray[np.bool_]
) -> None:
    """Write joints (F, 12, 3) and the middles of hips and shoulders into a skeleton."""
    places = {name: joints[:, i] for i, name in enumerate(FITTED_JOINTS)}
    for middle, part in (("pelvis", "hip"), ("thorax", "shoulder")):
        places[middle] = (places[f"left_{part}"] + places[f"right_{part}"]) / 2
    for name, place in places.items():
        if name in keypoints:
            position[frames, keypoints.index(name)] = place


def _warn(
    values: Array,
    residual: Array,
    is_enough: NDArray[np.bool_],
    is_fitted: NDArray[np.bool_],
    body: BodyFit,
    subject: Subject,
) -> Iterator[str]:
    """Say in plain words what makes these angles less certain, or why some are missing."""
    missing, unlike = float(np.mean(~is_enough)), float(np.mean(is_enough & ~is_fitted))
    if missing > OFTEN:
        yield (
            f"{_percent(missing)} of the frames don't show both hips and {MIN_JOINTS - 2} more "
            "joints, so they have no joint angles; film the whole person."
        )
    if unlike > 0:
        yield (
            f"In {_percent(unlike)} of the frames no human posture comes within "
            f"{100 * MAX_RESIDUAL_M:.0f} cm of the keypoints, so they have no joint angles; look "
            "at the overlay."
        )
    if not is_fitted.any():
        return
    typical = SegmentLengths.from_stature(subject.stature.value).as_dict()
    size = float(
        np.median([body.segment_lengths_m[n] / typical[n] for n in ("thigh", "shank", "trunk")])
    )
    if abs(size - 1.0) > SIZE_MISMATCH:
        yield (
            f"The body in the clip measures {_percent(size)} of a person of "
            f"{subject.stature.value:.2f} m; check the stature and the scale."
        )
    usual = float(np.median(residual[is_fitted]))
    if usual > POOR_FIT_M:
        yield (
            f"The keypoints lie {100 * usual:.0f} cm from the fitted body on average; they may "
            "belong to several persons or be exchanged. Look at the overlay."
        )
    at_end = _find_at_end_of_range(values[is_fitted])
    if at_end:
        yield (
            "The fit often reached the end of what a person can do "
            f"({', '.join(at_end)}); its angles are less certain there."
        )


def _percent(share: float) -> str:
    return f"{100 * share:.0f} %" if share >= 0.01 else "under 1 %"


def _find_at_end_of_range(values: Array) -> tuple[str, ...]:
    """Return the variables that are often at an end of their range that people rarely reach.

    Straight knees and elbows are the lower end of theirs, and no sign of trouble.
    """
    margin = 0.005 * (UPPER - LOWER)
    is_low, is_high = values <= LOWER + margin, values >= UPPER - margin
    found = []
    for i, variable in enumerate(VARIABLES):
        is_hinge = variable.name.startswith(("theta_kn", "theta_el"))
        at_end = is_high[:, i] if is_hinge else is_low[:, i] | is_high[:, i]
        if variable.name not in _FREE and at_end.mean() > OFTEN:
            found.append(variable.name)
    return tuple(found)


SOLVER = UdeasSolver()
