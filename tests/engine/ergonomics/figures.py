"""A jointed figure whose points are known exactly, as a track, for the methods that need one."""

from __future__ import annotations

import dataclasses

import numpy as np

from engine.datatypes import JointAngles, PoseTrack, Subject, Task
from engine.ergonomics.base import Exposure
from engine.skeletons import MEDIAPIPE_33
from tests.engine.ergonomics.exposures import build_lift

FPS = 30.0
TRUNK_M, NECK_M, UPPER_ARM_M, FOREARM_M, HAND_M = 0.50, 0.20, 0.30, 0.27, 0.08
HALF_HIPS_M, HALF_SHOULDERS_M = 0.10, 0.18


def place_figure(trunk_deg=0.0, reach_m=0.0, hip_height_m=0.92, turn_deg=0.0):
    """Return point names and places of one pose: arms hang straight down, hands reach forward.

    `reach_m` shifts elbows, wrists and hands forward as a whole; `turn_deg` turns the figure about
    the vertical, to its left.
    """
    angle = np.radians(trunk_deg)
    along = np.array([np.sin(angle), np.cos(angle), 0.0])
    hips = np.array([0.0, hip_height_m, 0.0])
    shoulders = hips + TRUNK_M * along
    places = {"nose": shoulders + NECK_M * along + [0.1, 0.0, 0.0]}
    for side, z in (("left", -1.0), ("right", 1.0)):
        out = np.array([0.0, 0.0, z])
        shoulder = shoulders + HALF_SHOULDERS_M * out
        elbow = shoulder + np.array([reach_m, -UPPER_ARM_M, 0.0])
        wrist = elbow + np.array([0.0, -FOREARM_M, 0.0])
        hand = wrist + np.array([0.0, -HAND_M, 0.0])
        places |= {
            f"{side}_ear": shoulders + NECK_M * along + 0.07 * out,
            f"{side}_shoulder": shoulder,
            f"{side}_elbow": elbow,
            f"{side}_wrist": wrist,
            f"{side}_index": hand,
            f"{side}_pinky": hand,
            f"{side}_hip": hips + HALF_HIPS_M * out,
            f"{side}_knee": np.array([0.05, 0.5, HALF_HIPS_M * z]),
            f"{side}_ankle": np.array([0.0, 0.08, HALF_HIPS_M * z]),
            f"{side}_heel": np.array([-0.05, 0.03, HALF_HIPS_M * z]),
            f"{side}_big_toe": np.array([0.18, 0.03, HALF_HIPS_M * z]),
        }
    turn = np.radians(turn_deg)
    about = np.array(
        [[np.cos(turn), 0.0, np.sin(turn)], [0.0, 1.0, 0.0], [-np.sin(turn), 0.0, np.cos(turn)]]
    )
    return {name: about @ place for name, place in places.items()}


def build_track(poses, *, sigma=0.0, hidden=(), fps=FPS):
    """Return a track from one pose per frame; `hidden` keypoints are missing throughout."""
    position = np.full((len(poses), len(MEDIAPIPE_33.keypoints), 3), np.nan)
    for frame, places in enumerate(poses):
        for name, place in places.items():
            if name not in hidden:
                position[frame, MEDIAPIPE_33.index(name)] = place
    time_s = np.arange(len(poses)) / fps
    spread = np.where(np.isfinite(position).all(axis=2), sigma, np.nan)
    return PoseTrack(time_s, position, "m", "world", "mediapipe_33", sigma=spread)


def build_figure_exposure(
    *,
    n_frames=60,
    trunk_deg=45.0,
    reach_m=0.2,
    turn_deg=0.0,
    lifts=None,
    subject=None,
    sigma=0.0,
    hidden=(),
    conditions=(),
    observed_s=10.0,
    track=None,
    angles=None,
    **task,
):
    """Return the exposure of a figure that holds one pose; its lift lasts from 0.5 to 1.5 s."""
    if track is None:
        pose = place_figure(trunk_deg, reach_m, turn_deg=turn_deg)
        track = build_track([pose] * n_frames, sigma=sigma, hidden=hidden)
    if lifts is None:
        lifts = (dataclasses.replace(build_lift(start_s=0.5), end_s=1.5),)
    if angles is None:
        curve = np.full((track.n_frames, 1), trunk_deg)
        angles = JointAngles(track.time_s, curve, ("trunk_inclination",))
    return Exposure(
        track=track,
        angles=angles,
        lifts=tuple(lifts),
        subject=subject or Subject(stature_m=1.75, mass_kg=80.0, sex="male"),
        task=Task(**task),
        observed_s=observed_s,
        conditions=conditions,
    )
