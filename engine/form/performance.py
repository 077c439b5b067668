"""One performance of a movement: what is compared, and the joint angles that describe form."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from engine.datatypes import Array, JointAngles, Lift, PoseTrack, frozen_array
from engine.errors import DataError, ShapeError
from engine.skeletons import get_skeleton

__all__ = ["FORM_ANGLES", "Performance", "fill_short_gaps", "make_performance", "side_of"]

FORM_ANGLES: tuple[str, ...] = (
    "trunk_flexion",
    "trunk_lateral_bend",
    "trunk_twist",
    *(
        f"{name}_{side}"
        for name in ("hip_flexion", "knee_flexion", "shoulder_flexion", "elbow_flexion")
        for side in ("l", "r")
    ),
)
"""Posture of a lift or exercise in a plane. Angles of pelvis and lumbar spine are left out: they
share the trunk's evidence and would count it twice."""

MAX_GAP_S = 0.3
"""Longer gaps are not bridged: within 0.3 s a lifting person can bend by more than 20 degrees."""


@dataclass(frozen=True, eq=False)
class Performance:
    """The measured movement of one clip.

    Parameters
    ----------
    label
        What the user calls it.
    angles
        Joint angles with their standard errors.
    hand_height_m
        Shape (T,), height of the hands over the floor at the angles' times; NaN where unseen.
    lifts
        Lifts found in the clip; none in an exercise.
    person
        The pseudonym of the person.
    skeleton, solver
        How the angles were found; a difference is noted in comparisons.
    n_views, view_azimuth_deg
        How it was filmed; 90 is the person's right side.
    """

    label: str
    angles: JointAngles
    hand_height_m: Array
    lifts: tuple[Lift, ...] = ()
    person: str = ""
    skeleton: str = ""
    solver: str = ""
    n_views: int = 1
    view_azimuth_deg: float = math.nan

    def __post_init__(self) -> None:
        height = frozen_array(self.hand_height_m)
        object.__setattr__(self, "hand_height_m", height)
        object.__setattr__(self, "lifts", tuple(self.lifts))
        if height.shape != self.time_s.shape:
            raise ShapeError(f"hand_height_m needs shape {self.time_s.shape}, got {height.shape}.")

    @property
    def time_s(self) -> Array:
        """Times of the angles, shape (T,), seconds."""
        return self.angles.time_s

    @property
    def form_angles(self) -> tuple[str, ...]:
        """Those of `FORM_ANGLES` that were measured at all."""
        known = [n for n in FORM_ANGLES if n in self.angles.names]
        return tuple(n for n in known if np.isfinite(self.angles[n]).any())

    def values(self, names: Sequence[str]) -> Array:
        """Return angles with short gaps bridged, shape (T, A), degrees; NaN in longer gaps."""
        columns = [fill_short_gaps(self.time_s, self.angles[name]) for name in names]
        return np.column_stack(columns) if columns else np.empty((len(self.time_s), 0))

    def sigmas(self, names: Sequence[str]) -> Array:
        """Return the standard errors like `values`; an unknown one is NaN."""
        columns = [fill_short_gaps(self.time_s, self.angles.sigma(name)) for name in names]
        return np.column_stack(columns) if columns else np.empty((len(self.time_s), 0))


def make_performance(
    angles: JointAngles,
    track: PoseTrack,
    *,
    label: str,
    lifts: Sequence[Lift] = (),
    person: str = "",
    solver: str = "",
    n_views: int = 1,
    view_azimuth_deg: float = math.nan,
) -> Performance:
    """Build a performance from what an assessment left.

    Parameters
    ----------
    angles
        Joint angles.
    track
        World metres, corrected; the wrists give the hands' height.
    label, lifts, person, solver, n_views, view_azimuth_deg
        As in `Performance`.

    Raises
    ------
    DataError
        If the clip has fewer than three frames.
    """
    if len(angles.time_s) < 3:
        raise DataError(
            f"{label} has {len(angles.time_s)} frames; comparing form needs a movement of at "
            "least one second. Choose a longer video."
        )
    skeleton = get_skeleton(track.skeleton)
    wrists = np.array(
        [skeleton.point(np.asarray(track.position), f"{s}_wrist")[:, 1] for s in ("left", "right")]
    )
    known = np.isfinite(wrists)
    total = np.where(known, wrists, 0.0).sum(axis=0)
    seen = known.sum(axis=0)
    height = np.where(seen > 0, total / np.maximum(seen, 1), np.nan)
    return Performance(
        label=label,
        angles=angles,
        hand_height_m=_at(angles.time_s, track.time_s, height),
        lifts=tuple(lifts),
        person=person,
        skeleton=track.skeleton,
        solver=solver,
        n_views=n_views,
        view_azimuth_deg=view_azimuth_deg,
    )


def _at(wanted_s: Array, time_s: Array, values: Array) -> Array:
    """Return values at other times; NaN outside and inside long gaps."""
    if np.array_equal(wanted_s, time_s):
        return values
    filled = fill_short_gaps(time_s, values)
    return np.interp(wanted_s, time_s, filled, left=np.nan, right=np.nan)


def fill_short_gaps(time_s: Array, values: Array, *, max_gap_s: float = MAX_GAP_S) -> Array:
    """Bridge gaps up to `max_gap_s` by straight lines; longer ones and the ends stay NaN.

    Parameters
    ----------
    time_s, values
        Shape (T,).
    max_gap_s
        Between the last sample before and the first after the gap, seconds.
    """
    known = np.flatnonzero(np.isfinite(values))
    if known.size < 2 or known.size == len(values):
        return np.array(values)
    filled = np.interp(time_s, time_s[known], values[known], left=np.nan, right=np.nan)
    is_long = (np.diff(known) > 1) & (np.diff(time_s[known]) > max_gap_s)
    for k in np.flatnonzero(is_long):
        filled[known[k] + 1 : known[k + 1]] = np.nan
    return filled


def side_of(name: str) -> Mapping[str, str]:
    """Return an angle's base name and its side: `left`, `right`, or empty for the trunk."""
    side = {"_l": "left", "_r": "right"}.get(name[-2:], "")
    return {"base": name[:-2] if side else name, "side": side}
