"""Load on the low back: a top-down model of the forces and moments at L5/S1.

Points and masses come from `engine.ergonomics.upper_body`, the mechanics from
`engine.ergonomics.spine`. This file decides what the peak is, what was assumed and how sure it is.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from engine.datatypes import Array, Lift, Provenance, RiskInput, RiskResult
from engine.ergonomics.base import Exposure, MethodInfo, RiskLevel
from engine.ergonomics.spine import (
    ACTION_LIMIT_N,
    EXTENSOR_LEVER_M,
    EXTENSOR_LEVER_SIGMA_M,
    MAXIMUM_LIMIT_N,
    SpineForces,
)
from engine.ergonomics.upper_body import (
    ACCELERATION_CUTOFF_HZ,
    LOAD_SIGMA,
    BackLoad,
    UpperBody,
    compute_back_load,
    find_held,
    measure_upper_body,
    read_mass,
)
from engine.ergonomics.work import classify, combine_lifts, list_doubts, read_lifts, refuse

__all__ = ["LEVELS", "METHOD"]

Frames = NDArray[np.intp]

LEVELS: tuple[RiskLevel, ...] = (
    RiskLevel(
        "below the action limit",
        ACTION_LIMIT_N,
        "compression that most healthy backs bear",
        "none from this method; keep the load close",
    ),
    RiskLevel(
        "above the action limit",
        MAXIMUM_LIMIT_N,
        "compression that some backs do not bear",
        "bring the load closer or higher, or make it lighter",
    ),
    RiskLevel(
        "above the maximum",
        math.inf,
        "compression at which about half of people risk damage to the endplates",
        "stop lifting this way; use a lifting aid",
    ),
)
MODEL_NOTE = (
    "The headline leaves accelerations out, as the static models did that the limits were set "
    "with; the peak with accelerations, usually higher, stands beside it. "
    "One equivalent muscle balances forward bending only: sideways and twisting moments are shown "
    "but add no compression, so that asymmetric lifts load the back more than stated. The "
    "interval holds the errors of what went in, not the simplicity of the model."
)
MAX_MISSING = 0.2
"""Share of the frames of a lift that may be missing before the peak is doubted."""
MAX_ASYMMETRY = 0.35
"""Sideways and twisting moment, as a share of the forward one, that the model may neglect."""
MIN_MOMENT_NM = 20.0
NEAR_END_S = 0.15


@dataclass(frozen=True, eq=False)
class _Peak:
    """The frame of the largest compression, and what acts there."""

    frame: int
    time_s: float
    forces: dict[str, float]


def _find_peak(forces: SpineForces, time_s: Array, frames: Frames) -> _Peak | None:
    values = forces.compression_n[frames]
    if not np.isfinite(values).any():
        return None
    frame = int(frames[np.nanargmax(values)])
    at = {name: float(curve[frame]) for name, curve in vars(forces).items()}
    return _Peak(frame, float(time_s[frame]), at)


def _integrate(values: Array, time_s: Array) -> float:
    """Return the time integral over frames that are known: each stands for its own time step."""
    if len(time_s) < 2:
        return math.nan
    known = np.isfinite(values)
    return float(np.sum(values[known] * np.gradient(time_s)[known])) if known.any() else math.nan


class L5S1:
    """Compression and moments at L5/S1."""

    info = MethodInfo(
        name="l5s1",
        title="Low-back load at L5/S1",
        reference="Top-down model with one equivalent extensor of 0.056 m (Chaffin, Andersson & "
        "Martin 2006, ch. 6) [V2]; masses of de Leva (1996), table 4 [V2]; limits 3400 and 6400 N "
        "of NIOSH (1981), Work Practices Guide [V2]. L5/S1 half-way up de Leva's lower trunk "
        "(derived, standard error 25 mm).",
        verification="V2",
        levels=LEVELS,
        value_name="peak compression",
        decimals=0,
        description="Peak spinal compression, bending moments in three directions and shear while "
        "the load is held, static and with accelerations. " + MODEL_NOTE,
    )

    def assess(self, exposure: Exposure) -> RiskResult:
        """Judge every lift by its peak static compression; the headline is the worst lift.

        Returns
        -------
        RiskResult
            `value` in N. `details` has the peak with accelerations, moments, shear, cumulative
            loads and their times. Without a load it is the body's own part, a lower bound.
        """
        if not exposure.lifts:
            return refuse(self.info, "no lift was found in the video")
        body = measure_upper_body(exposure)
        lifts = read_lifts(exposure)
        load = compute_back_load(
            body,
            lifts,
            subject=exposure.subject,
            load_kg=exposure.task.load_kg or 0.0,
        )
        results = [self._assess_lift(exposure, body, load, lift, k) for k, lift in enumerate(lifts)]
        return combine_lifts(self.info, results)

    def _assess_lift(
        self, exposure: Exposure, body: UpperBody, load: BackLoad, lift: Lift, index: int
    ) -> RiskResult:
        frames = np.flatnonzero(find_held(load.time_s, lift))
        peak = _find_peak(load.static, load.time_s, frames)
        if peak is None:
            reason = "trunk, head or arms could not be seen while the load was held"
            return replace(refuse(self.info, reason), lift_index=index)
        moving = _find_peak(load.dynamic, load.time_s, frames)
        value = peak.forces["compression_n"]
        half = 1.96 * float(load.compression_sigma_n[peak.frame])
        level = classify(LEVELS, value)
        mass, _, assumed = read_mass(exposure.subject)
        assumptions = [*assumed, *_list_assumptions(exposure, body, frames)]
        doubts = _list_doubts(exposure, body, load, lift, frames, peak, moving)
        return RiskResult(
            method=self.info.name,
            value=value,
            unit="N",
            category="unknown" if level is None else level.name,
            inputs=_list_inputs(exposure, load, peak),
            steps=_explain(exposure, load, peak, moving, mass.value),
            interval=(float(np.maximum(0.0, value - half)), value + half),
            reference=self.info.reference,
            reasons=(*assumptions, *doubts),
            details={
                **_details(load, frames, peak, moving),
                "assumptions": assumptions,
                "doubts": doubts,
                "notes": [MODEL_NOTE],
            },
            lift_index=index,
        )


def _list_assumptions(exposure: Exposure, body: UpperBody, frames: Frames) -> list[str]:
    notes = []
    if exposure.subject.sex is None:
        notes.append("Sex not given: the mean of women's and men's segment masses is used.")
    mirrored = float(body.is_mirrored[frames].mean())
    if mirrored > 0:
        notes.append(
            f"In {100 * mirrored:.0f} % of the frames an arm was hidden: it is taken as the mirror "
            "image of the other."
        )
    return notes


def _list_doubts(
    exposure: Exposure,
    body: UpperBody,
    load: BackLoad,
    lift: Lift,
    frames: Frames,
    peak: _Peak,
    moving: _Peak | None,
) -> list[str]:
    doubts = list_doubts(exposure, lift)
    if exposure.task.load_kg is None:
        doubts.append("the load is not given: this is the body's own part, the least it can be")
    missing = ~np.isfinite(load.static.compression_n[frames])
    near_end = np.abs(load.time_s[frames, None] - [lift.start_s, lift.end_s]).min(axis=1)
    if missing.mean() > MAX_MISSING or missing[near_end <= NEAR_END_S].any():
        doubts.append(
            f"the body was not seen in {100 * missing.mean():.0f} % of the lift, ends included, "
            "so that the real peak may be higher"
        )
    if lift.hands == 1 and body.is_mirrored[frames].any():
        doubts.append("one hand lifts, but a hidden arm had to be taken as its mirror image")
    sideways = math.hypot(peak.forces["lateral_nm"], peak.forces["twist_nm"])
    if sideways > max(MIN_MOMENT_NM, MAX_ASYMMETRY * abs(peak.forces["flexion_nm"])):
        doubts.append(
            f"{sideways:.0f} N m bend sideways or twist the trunk, which the model leaves out"
        )
    if math.isnan(load.compression_sigma_n[peak.frame]):
        doubts.append("the measuring error is not known, so that no interval can be given")
    faster = -math.inf if moving is None else moving.forces["compression_n"]
    static_level = classify(LEVELS, peak.forces["compression_n"])
    if faster > peak.forces["compression_n"] and classify(LEVELS, faster) is not static_level:
        doubts.append(f"with accelerations the peak is {faster:.0f} N, in the next level")
    return doubts


def _list_inputs(exposure: Exposure, load: BackLoad, peak: _Peak) -> tuple[RiskInput, ...]:
    subject, task = exposure.subject, exposure.task
    mass, mass_from, _ = read_mass(subject)
    user, assumed = Provenance.USER, Provenance.ASSUMED
    load_sigma = math.nan if task.load_kg is None else LOAD_SIGMA * task.load_kg
    return (
        RiskInput(
            "forward bending moment",
            peak.forces["flexion_nm"],
            "N m",
            Provenance.DERIVED,
            float(load.flexion_sigma_nm[peak.frame]),
        ),
        RiskInput(
            "load to L5/S1, horizontal",
            100 * float(load.load_lever_m[peak.frame]),
            "cm",
            Provenance.MEASURED,
            100 * float(load.load_lever_sigma_m[peak.frame]),
        ),
        RiskInput("body mass", mass.value, "kg", mass_from, mass.sigma),
        RiskInput("sex", subject.sex, "", assumed if subject.sex is None else user),
        RiskInput("stature", subject.stature.value, "m", _stature_from(exposure)),
        RiskInput("load", task.load_kg, "kg", user, load_sigma),
        RiskInput(
            "lever arm of the muscle", EXTENSOR_LEVER_M, "m", assumed, EXTENSOR_LEVER_SIGMA_M
        ),
    )


def _stature_from(exposure: Exposure) -> Provenance:
    return exposure.subject.provenance["stature_m"] or Provenance.ASSUMED


def _explain(
    exposure: Exposure, load: BackLoad, peak: _Peak, moving: _Peak | None, mass_kg: float
) -> tuple[str, ...]:
    at = peak.forces
    muscle = max(at["flexion_nm"], 0.0) / EXTENSOR_LEVER_M
    lines = [
        (
            f"Body mass {mass_kg:.0f} kg, load {load.load_kg[peak.frame]:g} kg held "
            f"{100 * load.load_lever_m[peak.frame]:.0f} cm from L5/S1 (horizontal)"
        ),
        (
            f"Largest at {peak.time_s:.2f} s, without accelerations: moments of "
            f"{at['flexion_nm']:.0f} N m forward, {at['lateral_nm']:.0f} to the right and "
            f"{at['twist_nm']:.0f} about the trunk"
        ),
        (
            f"Muscle force = {max(at['flexion_nm'], 0.0):.1f} N m / {EXTENSOR_LEVER_M:g} m = "
            f"{muscle:.0f} N"
        ),
        f"Weight above L5/S1 along the trunk = {at['compression_n'] - muscle:.0f} N",
        (
            f"Compression = {at['compression_n']:.0f} N, standard error "
            f"{load.compression_sigma_n[peak.frame]:.0f} N; shear across the trunk "
            f"{at['shear_n']:.0f} N"
        ),
        f"Limits: action {ACTION_LIMIT_N:.0f} N, maximum {MAXIMUM_LIMIT_N:.0f} N",
    ]
    if moving is None:
        lines.append("With accelerations: not known (gaps, or under 25 frames per second)")
    else:
        lines.append(
            f"With accelerations (positions low-passed at {ACCELERATION_CUTOFF_HZ:g} Hz): "
            f"{moving.forces['compression_n']:.0f} N at {moving.time_s:.2f} s"
        )
    if exposure.task.load_kg is None:
        lines.insert(0, "Load not given: the body's own part only")
    return tuple(lines)


def _details(load: BackLoad, frames: Frames, peak: _Peak, moving: _Peak | None) -> dict[str, Any]:
    time_s, static = load.time_s, load.static
    causes = {name: float(curve[peak.frame]) for name, curve in load.variances_n2.items()}
    total = sum(causes.values())
    shares = {name: variance / total if total > 0 else 0.0 for name, variance in causes.items()}
    is_known = math.isfinite(total) and total > 0
    quiet = dict.fromkeys(peak.forces, math.nan)
    return {
        "peak_s": peak.time_s,
        "static": peak.forces,
        "dynamic": quiet if moving is None else moving.forces,
        "dynamic_peak_s": math.nan if moving is None else moving.time_s,
        "flexion_sigma_nm": float(load.flexion_sigma_nm[peak.frame]),
        "compression_sigma_n": float(load.compression_sigma_n[peak.frame]),
        "uncertainty_shares": shares,
        "dominant_input": max(shares, key=lambda name: shares[name]) if is_known else "",
        "load_lever_cm": 100 * float(load.load_lever_m[peak.frame]),
        "cumulative_moment_lift_nm_s": _integrate(static.flexion_nm[frames], time_s[frames]),
        "cumulative_moment_nm_s": _integrate(static.flexion_nm, time_s),
        "cumulative_compression_n_s": _integrate(static.compression_n, time_s),
        "share_seen": float(np.isfinite(static.compression_n).mean()),
        "acceleration_cutoff_hz": ACCELERATION_CUTOFF_HZ,
    }


METHOD = L5S1()
