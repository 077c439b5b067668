"""A jointed figure that bends down, lifts a load and stands up: every place is known exactly."""

from __future__ import annotations

import numpy as np

from engine.datatypes import JointAngles, Lift, LiftEnd, Measurement, Subject, Task
from engine.ergonomics.base import Exposure
from tests.engine.ergonomics.figures import FPS, build_track, place_figure

START_S, END_S, LENGTH_S = 1.0, 2.5, 3.5
DEEPEST_DEG = 65.0
REACH_M, HIPS_M = 0.05, 0.80


def bend_at(time_s):
    """Return the trunk's bend: down until 1 s, up from 1 to 2.5 s."""
    return np.interp(time_s, [0.0, START_S, END_S, LENGTH_S], [0.0, DEEPEST_DEG, 10.0, 0.0])


def hands_at(time_s, turn_deg=0.0):
    """Return where the hands are, shape (3,): forward, up, to the right."""
    pose = place_figure(float(bend_at(time_s)), REACH_M, HIPS_M, turn_deg=turn_deg)
    return 0.5 * (pose["left_index"] + pose["right_index"])


def build_end(time_s, sigma=(2.0, 2.0, 5.0)):
    x, y, z = hands_at(time_s)
    return LiftEnd(
        time_s,
        Measurement(100 * float(np.hypot(x, z)), sigma[0]),
        Measurement(100 * float(y), sigma[1]),
        Measurement(0.0, sigma[2]),
    )


def build_bending(*, turn_deg=0.0, hidden=(), sigma=0.01, subject=None, conditions=(), **task):
    """Return the exposure of one whole movement with one lift."""
    time_s = np.arange(round(LENGTH_S * FPS)) / FPS
    bends = bend_at(time_s)
    poses = [place_figure(bend, REACH_M, HIPS_M, turn_deg=turn_deg) for bend in bends]
    track = build_track(poses, sigma=sigma, hidden=hidden)
    names = ("trunk_inclination", "trunk_flexion", "pelvis_tilt", "knee_flexion_r")
    value = np.stack([bends, bends, 0.3 * bends, np.full(time_s.size, 12.0)], axis=1)
    origin, destination = build_end(START_S), build_end(END_S)
    travel = abs(destination.V_cm.value - origin.V_cm.value)
    lift = Lift(
        START_S,
        END_S,
        origin,
        destination,
        Measurement(travel, 3.0),
        reach_start_s=0.0,
        return_end_s=LENGTH_S,
    )
    return Exposure(
        track=track,
        angles=JointAngles(time_s, value, names, np.full(value.shape, 3.0)),
        lifts=(lift,),
        subject=subject or Subject(stature_m=1.75, mass_kg=80.0, sex="male"),
        task=Task(
            **{
                "load_kg": 12.0,
                "coupling": "fair",
                "frequency_per_min": 1.0,
                "duration_h": 1.0,
                **task,
            }
        ),
        observed_s=LENGTH_S,
        conditions=tuple(conditions),
    )
