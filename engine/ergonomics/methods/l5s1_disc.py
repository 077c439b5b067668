"""Experimental low-back model: L5/S1 from the pelvis, forces across the disc, shear limits.

The body and the load are those of `l5s1`; `engine.ergonomics.disc` has what was not confirmed
against its publication, so that this method runs only when experimental methods are switched on.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from engine.datatypes import Array, Lift, PoseTrack, Provenance, RiskInput, RiskResult, Sex
from engine.ergonomics.base import Exposure, MethodInfo
from engine.ergonomics.disc import (
    compute_pelvis_rotation,
    compute_polynomial_compression,
    compute_sacral_inclination,
    find_shear_limit,
    locate_l5s1,
)
from engine.ergonomics.methods.l5s1 import LEVELS
from engine.ergonomics.spine import SpineForces
from engine.ergonomics.upper_body import (
    BackLoad,
    UpperBody,
    compute_back_load,
    find_held,
    measure_upper_body,
)
from engine.ergonomics.work import (
    classify,
    combine_lifts,
    list_doubts,
    read_lifts,
    read_repetitions,
    refuse,
)
from engine.skeletons import get_skeleton

__all__ = ["METHOD"]

STRAIGHT_DEG = 180.0


@dataclass(frozen=True, eq=False)
class _Pelvis:
    """Place of L5/S1 and normal of its disc, shape (T, 3) each; angles in degrees, shape (T,)."""

    joint: Array
    normal: Array
    rotation_deg: Array
    knee_deg: Array


def _measure_knee(track: PoseTrack) -> Array:
    """Return the mean included angle of the knees that were seen, degrees, shape (T,)."""
    skeleton = get_skeleton(track.skeleton)
    angles = []
    for side in ("left", "right"):
        hip, knee, ankle = (
            skeleton.point(track.position, f"{side}_{joint}") for joint in ("hip", "knee", "ankle")
        )
        cosine = np.sum((hip - knee) * (ankle - knee), axis=1) / (
            np.linalg.norm(hip - knee, axis=1) * np.linalg.norm(ankle - knee, axis=1)
        )
        angles.append(np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0))))
    both = np.stack(angles)
    seen = np.isfinite(both)
    total = np.where(seen, both, 0.0).sum(axis=0)
    return np.asarray(np.divide(total, np.where(seen.any(axis=0), seen.sum(axis=0), np.nan)))


def _measure_pelvis(body: UpperBody, track: PoseTrack, sex: Sex) -> _Pelvis:
    hips, shoulders = body.points["hips"], body.points["shoulders"]
    across = np.array(body.right, copy=True)
    across[:, 1] = 0.0
    across /= np.linalg.norm(across, axis=1, keepdims=True)
    up = np.array([0.0, 1.0, 0.0])
    ahead = np.cross(up, across)
    trunk = shoulders - hips
    flexion = np.degrees(np.arctan2(np.sum(trunk * ahead, axis=1), trunk[:, 1]))
    knee = _measure_knee(track)
    rotation = compute_pelvis_rotation(flexion, knee)
    tilted = _tilt(ahead, rotation)
    offset = np.linalg.norm(body.points["right_hip"] - body.points["left_hip"], axis=1)
    joint = locate_l5s1(hips, float(np.nanmedian(offset)), *tilted, sex)
    normal, _ = _tilt(ahead, compute_sacral_inclination(flexion, knee))
    return _Pelvis(joint, normal, rotation, knee)


def _tilt(ahead: Array, angle_deg: Array) -> tuple[Array, Array]:
    """Return the vertical and the forward direction, tilted forward by an angle."""
    angle = np.radians(angle_deg)[:, None]
    up = np.array([0.0, 1.0, 0.0])
    return np.cos(angle) * up + np.sin(angle) * ahead, np.cos(angle) * ahead - np.sin(angle) * up


class L5S1Disc:
    """Compression and shear across the L5/S1 disc."""

    info = MethodInfo(
        name="l5s1_disc",
        title="Low-back load across the L5/S1 disc",
        reference="Reed et al. (1999), SAE 1999-01-0959; Anderson et al. (1985), J. Biomechanics "
        "18(8):571-584; Gallagher & Marras (2012), Clin Biomech 27:973-978; McGill et al. (1996), "
        "Ergonomics 39(9):1107-1118: recalled, not checked [R].",
        verification="R",
        levels=LEVELS,
        value_name="peak compression across the disc",
        decimals=0,
        description="As `l5s1`, but with the joint placed from the pelvis, whose rotation is "
        "estimated from trunk and knees, and forces across the inclined disc. Experimental.",
    )

    def assess(self, exposure: Exposure) -> RiskResult:
        """Judge every lift by its peak static compression; the headline is the worst lift."""
        if not exposure.lifts:
            return refuse(self.info, "no lift was found in the video")
        if exposure.subject.sex is None:
            return refuse(self.info, "the sex is not given, and the pelvis' shape depends on it")
        body, lifts = measure_upper_body(exposure), read_lifts(exposure)
        if not np.isfinite(body.right).all(axis=1).any():
            return refuse(self.info, "hips and shoulders could not be seen")
        pelvis = _measure_pelvis(body, exposure.track, exposure.subject.sex)
        load = compute_back_load(
            body,
            lifts,
            subject=exposure.subject,
            load_kg=exposure.task.load_kg or 0.0,
            joint=pelvis.joint,
            normal=pelvis.normal,
        )
        results = [
            self._assess_lift(exposure, pelvis, load, lift, k) for k, lift in enumerate(lifts)
        ]
        return combine_lifts(self.info, results)

    def _assess_lift(
        self, exposure: Exposure, pelvis: _Pelvis, load: BackLoad, lift: Lift, index: int
    ) -> RiskResult:
        frames = np.flatnonzero(find_held(load.time_s, lift))
        values = load.static.compression_n[frames]
        if not np.isfinite(values).any():
            reason = "the body could not be seen while the load was held"
            return replace(refuse(self.info, reason), lift_index=index)
        frame = int(frames[np.nanargmax(values)])
        at = {name: float(curve[frame]) for name, curve in vars(load.static).items()}
        shear = _peak_shear(load.static, frames)
        limit = find_shear_limit(read_repetitions(exposure).per_day)
        half = 1.96 * float(load.compression_sigma_n[frame])
        level = classify(LEVELS, at["compression_n"])
        doubts = ["experimental: its numbers were not checked", *list_doubts(exposure, lift)]
        if exposure.task.load_kg is None:
            doubts.append("the load is not given: this is the body's own part, the least it can be")
        if shear > limit:
            doubts.append(f"shear of {shear:.0f} N is above {limit:.0f} N")
        return RiskResult(
            method=self.info.name,
            value=at["compression_n"],
            unit="N",
            category="unknown" if level is None else level.name,
            inputs=_list_inputs(exposure, pelvis, frame),
            steps=_explain(pelvis, frame, at, shear, limit),
            interval=(
                float(np.maximum(0.0, at["compression_n"] - half)),
                at["compression_n"] + half,
            ),
            reference=self.info.reference,
            reasons=tuple(doubts),
            details={
                "peak_s": float(load.time_s[frame]),
                "static": at,
                "peak_shear_n": shear,
                "shear_limit_n": limit,
                "polynomial_compression_n": _polynomial(at),
                "doubts": doubts,
            },
            lift_index=index,
        )


def _peak_shear(forces: SpineForces, frames: NDArray[np.intp]) -> float:
    return float(np.nanmax(forces.shear_n[frames]))


def _polynomial(at: dict[str, float]) -> float:
    moments = (at[f"{name}_nm"] for name in ("flexion", "lateral", "twist"))
    return float(compute_polynomial_compression(*moments))


def _list_inputs(exposure: Exposure, pelvis: _Pelvis, frame: int) -> tuple[RiskInput, ...]:
    derived, user = Provenance.DERIVED, Provenance.USER
    return (
        RiskInput("pelvis rotation", float(pelvis.rotation_deg[frame]), "deg", derived),
        RiskInput("knee angle", float(pelvis.knee_deg[frame]), "deg", Provenance.MEASURED),
        RiskInput("sex", exposure.subject.sex, "", user),
        RiskInput("load", exposure.task.load_kg, "kg", user),
    )


def _explain(
    pelvis: _Pelvis, frame: int, at: dict[str, float], shear: float, limit: float
) -> tuple[str, ...]:
    flexed = STRAIGHT_DEG - pelvis.knee_deg[frame]
    return (
        f"Pelvis rotated {pelvis.rotation_deg[frame]:.0f} deg forward (knees flexed {flexed:.0f})",
        (
            f"Moment at L5/S1 {at['flexion_nm']:.0f} N m; compression across the disc "
            f"{at['compression_n']:.0f} N"
        ),
        f"Largest shear {shear:.0f} N, limit {limit:.0f} N",
        f"McGill's polynomial gives {_polynomial(at):.0f} N",
    )


METHOD = L5S1Disc()
