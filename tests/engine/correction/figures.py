"""A walking figure with bones of constant length, for tests of the correction."""

from __future__ import annotations

import numpy as np

from engine.datatypes import Array, PoseTrack
from engine.skeletons import get_skeleton

_HALF = {"shoulder": 0.18, "hip": 0.10}


def make_walker(
    *,
    n_frames: int = 120,
    fps: float = 30.0,
    skeleton: str = "h36m_17",
    noise_m: float = 0.0,
    seed: int = 0,
    time_s: Array | None = None,
) -> PoseTrack:
    """Make a person of 1.7 m who walks along +X, facing it, arms bent and swinging; Y up."""
    time_s = np.arange(n_frames) / fps if time_s is None else time_s
    phase = 2 * np.pi * 0.9 * time_s
    way = 1.2 * time_s
    names = get_skeleton(skeleton).keypoints
    points = {"pelvis": (way, 0.9, 0.0), "spine": (way, 1.15, 0.0), "thorax": (way, 1.4, 0.0)}
    points |= {"nose": (way + 0.1, 1.6, 0.0), "head": (way, 1.7, 0.0)}
    for side, z, turn in (("left", -1.0, 0.0), ("right", 1.0, np.pi)):
        points |= {f"{side}_{k}": v for k, v in _limbs(way, phase + turn, z).items()}
    columns = [np.stack(np.broadcast_arrays(*points[n], way)[:3], axis=1) for n in names]
    position = np.stack(columns, axis=1)
    position += noise_m * np.random.default_rng(seed).standard_normal(position.shape)
    shape = position.shape[:2]
    return PoseTrack(
        time_s,
        position,
        "m",
        "world",
        skeleton,
        confidence=np.full(shape, 0.9),
        sigma=np.full(shape, 0.02),
    )


def _limbs(way: Array, phase: Array, z: float) -> dict[str, tuple[Array, Array, float]]:
    """Place one side's joints from angles, so that no bone changes its length."""

    def below(start: tuple, length: float, angle: Array) -> tuple:
        return start[0] + length * np.sin(angle), start[1] - length * np.cos(angle), start[2]

    swing, bend = 0.4 * np.sin(phase), 0.5 + 0.3 * np.cos(phase)
    hip = (way, 0.9 + 0.0 * way, z * _HALF["hip"])
    knee = below(hip, 0.42, swing)
    ankle = below(knee, 0.42, swing - bend)
    shoulder = (way, 1.4 + 0.0 * way, z * _HALF["shoulder"])
    elbow = below(shoulder, 0.31, -swing)
    wrist = below(elbow, 0.25, -swing + 0.8)
    limb = {"hip": hip, "knee": knee, "ankle": ankle, "shoulder": shoulder, "elbow": elbow}
    limb |= {"wrist": wrist, "heel": (ankle[0] - 0.05, ankle[1] - 0.06, ankle[2])}
    limb["big_toe"] = (ankle[0] + 0.17, ankle[1] - 0.06, ankle[2])
    for name, ahead, up in (("pinky", 0.07, -0.01), ("index", 0.08, 0.0), ("thumb", 0.05, 0.03)):
        limb[name] = (wrist[0] + ahead, wrist[1] + up, wrist[2])
    face = {"ear": (0.0, 1.62, 0.07), "eye": (0.08, 1.64, 0.03), "mouth": (0.09, 1.56, 0.02)}
    face |= {"eye_inner": (0.09, 1.64, 0.02), "eye_outer": (0.07, 1.64, 0.04)}
    limb |= {name: (way + x, y + 0.0 * way, z * side) for name, (x, y, side) in face.items()}
    return limb


def photograph(track: PoseTrack, *, azimuth_deg: float = 30.0, noise_px: float = 0.0) -> PoseTrack:
    """Return the track as a picture from 4 m, 250 px a metre, without perspective."""
    angle = np.radians(azimuth_deg)
    x, y, z = np.moveaxis(np.asarray(track.position), 2, 0)
    seen = np.stack([x * np.sin(angle) + z * np.cos(angle), -y], axis=2) * 250.0
    seen += noise_px * np.random.default_rng(5).standard_normal(seen.shape)
    return PoseTrack(
        track.time_s,
        seen,
        "px",
        "image",
        track.skeleton,
        confidence=np.array(track.confidence),
        sigma=np.full(seen.shape[:2], 3.0),
    )
