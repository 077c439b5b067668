"""Lifts and exposures in one line."""

from __future__ import annotations

import numpy as np

from engine.datatypes import (
    JointAngles,
    Lift,
    LiftEnd,
    Measurement,
    PoseTrack,
    Subject,
    Task,
)
from engine.ergonomics.base import Exposure

OCCASIONAL = {
    "load_kg": 15.0,
    "coupling": "fair",
    "frequency_per_min": 0.2,
    "duration_h": 0.5,
    "recovery_h": 1.0,
    "destination_control": True,
}


def build_end(H, V, A, *, time_s=1.0, sigma=(0.0, 0.0, 0.0)):
    return LiftEnd(
        time_s, Measurement(H, sigma[0]), Measurement(V, sigma[1]), Measurement(A, sigma[2])
    )


def build_lift(
    origin=(40.0, 30.0, 0.0),
    destination=(42.4264, 90.0, 45.0),
    *,
    D=None,
    sigma=(0.0, 0.0, 0.0),
    start_s=1.0,
    **kwargs,
):
    travel = abs(destination[1] - origin[1]) if D is None else D
    return Lift(
        start_s=start_s,
        end_s=start_s + 1.2,
        origin=build_end(*origin, time_s=start_s, sigma=sigma),
        destination=build_end(*destination, time_s=start_s + 1.2, sigma=sigma),
        D_cm=Measurement(travel, sigma[1]),
        **kwargs,
    )


def build_exposure(*lifts, observed_s=10.0, conditions=(), **task):
    times = np.arange(2) / 30.0
    track = PoseTrack(times, np.zeros((2, 33, 3)), "m", "world", "mediapipe_33")
    return Exposure(
        track=track,
        angles=JointAngles(times, np.zeros((2, 1)), ("trunk_flexion",)),
        lifts=lifts,
        subject=Subject(),
        task=Task(**task),
        observed_s=observed_s,
        conditions=conditions,
    )
