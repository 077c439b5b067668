"""Performances whose movement is known exactly."""

from __future__ import annotations

import numpy as np

from engine.datatypes import JointAngles, Lift, LiftEnd, Measurement
from engine.form.performance import FORM_ANGLES, Performance

DEPTH_DEG = {
    "trunk_flexion": 50.0,
    "hip_flexion_l": 80.0,
    "hip_flexion_r": 80.0,
    "knee_flexion_l": 90.0,
    "knee_flexion_r": 90.0,
    "shoulder_flexion_l": 30.0,
    "shoulder_flexion_r": 30.0,
    "elbow_flexion_l": 20.0,
    "elbow_flexion_r": 20.0,
}


def course(time_s, start_s, end_s):
    """Return a smooth bend: 0 up to the start, 1 in the middle, 0 from the end on."""
    share = np.clip((time_s - start_s) / (end_s - start_s), 0, 1)
    return np.sin(np.pi * share) ** 2


def make_performance_of(
    time_s,
    bend,
    *,
    depth=None,
    sigma_deg=3.0,
    label="clip",
    lifts=(),
    hands=None,
    noise=0.0,
    **more,
):
    """Make a performance that bends by `bend` (T,) times each angle's depth."""
    depth = DEPTH_DEG if depth is None else depth
    names = tuple(n for n in FORM_ANGLES if n in depth)
    value = np.column_stack([bend * depth[n] for n in names])
    value = value + np.random.default_rng(1).normal(0, noise, value.shape) if noise else value
    angles = JointAngles(time_s, value, names, np.full(value.shape, sigma_deg))
    height = 0.8 - 0.5 * bend if hands is None else hands
    known = {"person": "P01", "skeleton": "mediapipe_33", "solver": "geometric", **more}
    return Performance(label, angles, height, tuple(lifts), **known)


def make_squats(n=5, *, period_s=2.0, rest_s=1.0, fps=30.0, **more):
    """Make squats of equal length, standing before and after."""
    time_s = np.arange(0, 2 * rest_s + n * period_s, 1 / fps)
    bend = sum(course(time_s, rest_s + k * period_s, rest_s + (k + 1) * period_s) for k in range(n))
    return make_performance_of(time_s, bend, **more)


def make_lift_clip(*, scale=1.0, stretch=1.0, fps=30.0, **more):
    """Make one lift: reach from 1 s, lift-off 2 s, set-down 3 s, return to 4 s, stretched."""
    time_s = np.arange(0, 5 * stretch, 1 / fps)
    t = time_s / stretch
    bend = scale * np.interp(t, [0, 1, 2, 3, 4, 5], [0, 0, 1, 0.3, 0, 0])
    smooth = np.convolve(np.pad(bend, 3, mode="edge"), np.ones(7) / 7, mode="valid")
    lift = make_known_lift(2 * stretch, 3 * stretch)
    return make_performance_of(time_s, smooth, lifts=(lift,), **more)


def make_known_lift(start_s, end_s, *, origin_cm=20.0, destination_cm=80.0):
    """Make a lift of given times and heights."""
    nothing = Measurement(float("nan"))
    ends = [
        LiftEnd(t, nothing, Measurement(V, 3.0), nothing)
        for t, V in ((start_s, origin_cm), (end_s, destination_cm))
    ]
    return Lift(start_s, end_s, *ends, nothing, start_sigma_s=0.02, end_sigma_s=0.02)
