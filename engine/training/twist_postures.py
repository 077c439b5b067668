"""Postures with known rotations: what the twist network is trained on.

A twist cannot be read off the positions of joints alone, so true rotations are needed. They come
from three places: the bone rotations of the synthetic lifts, postures of the jointed figure drawn
within the joints' ranges, and recorded people, of whom a bent knee or elbow tells how thigh and
upper arm are turned (a straight one does not: no target there).

Axes are the world's: X forward, Y up, Z to the right. Rotations are relative to the rest posture,
arms straight out to the sides with the palms forward.
"""

from __future__ import annotations

import json
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from engine.pose.swing_twist.inverse_kinematics import (
    compute_swings,
    fit_rotation,
    place_joints,
    rotate_about,
    twist_about,
)
from engine.pose.swing_twist.landmarks import body_size, joints_from_landmarks
from engine.pose.swing_twist.skeleton29 import (
    BRANCHING,
    CHILDREN,
    COLLAR_SHARE,
    JOINTS,
    N_TURNING,
    PARENTS,
    SPINE_SHARES,
    RestSkeleton,
    mirror_order,
)

__all__ = [
    "Segments",
    "TwistExamples",
    "draw_segments",
    "find_twists",
    "joint_rotations",
    "make_examples",
    "read_lift_segments",
    "read_mocap_segments",
    "read_seen_examples",
]

Floats = NDArray[np.float64]

SIDES = (("left", -1.0), ("right", 1.0))
BENT_DEG = 25.0
"""From this bend of knee or elbow on its plane tells how the segment above is turned."""
SEGMENT_NAMES = ("pelvis", "thorax", "head")


@dataclass(frozen=True, eq=False)
class Segments:
    """Rotations of the body's segments over T frames.

    Parameters
    ----------
    rotation
        Name of the segment (`left_thigh`, `thorax`, ...) -> shape (T, 3, 3), segment to world,
        from the anatomical position (arms hanging, palms forward).
    is_known
        Shape (T, 23): whether the twist of each joint but the pelvis is true.
    """

    rotation: dict[str, Floats]
    is_known: NDArray[np.bool_]


@dataclass(frozen=True, eq=False)
class TwistExamples:
    """`joints` (N, 29, 3) m, `twist` (N, 23) radians, `is_known` (N, 23)."""

    joints: Floats
    twist: Floats
    is_known: NDArray[np.bool_]

    @classmethod
    def join(cls, parts: Iterable[TwistExamples]) -> TwistExamples:
        """Put examples one after another."""
        parts = list(parts)
        return cls(
            *(
                np.concatenate([getattr(part, name) for part in parts])
                for name in ("joints", "twist", "is_known")
            )
        )


def _turn(axis: str, degrees: Floats) -> Floats:
    unit = np.eye(3)["xyz".index(axis)]
    return rotate_about(np.broadcast_to(unit, (len(degrees), 3)), np.radians(degrees))


def _zxy(flexion: Floats, second: Floats, third: Floats) -> Floats:
    """Return the rotations Rz Rx Ry of angles in degrees."""
    return np.asarray(_turn("z", flexion) @ _turn("x", second) @ _turn("y", third))


def build_segments(
    pelvis: Floats, thorax: Floats, head: Floats, angle: dict[str, Floats]
) -> Segments:
    """Chain joint angles (degrees, T each, names with _l and _r) to rotations of all segments."""
    rotation = {"pelvis": pelvis, "thorax": thorax, "head": head}
    for side, sign in SIDES:
        key = side[0]
        thigh = pelvis @ _zxy(
            angle[f"hip_flexion_{key}"],
            sign * angle[f"hip_adduction_{key}"],
            sign * angle[f"hip_rotation_{key}"],
        )
        shank = thigh @ _turn("z", -angle[f"knee_flexion_{key}"])
        upper = thorax @ _zxy(
            angle[f"arm_flexion_{key}"],
            sign * angle[f"arm_adduction_{key}"],
            sign * angle[f"arm_rotation_{key}"],
        )
        fore = upper @ _turn("z", angle[f"elbow_flexion_{key}"])
        rotation |= {
            f"{side}_thigh": thigh,
            f"{side}_shank": shank,
            f"{side}_foot": shank @ _turn("z", angle[f"ankle_dorsiflexion_{key}"]),
            f"{side}_upper_arm": upper,
            f"{side}_forearm": fore @ _turn("y", sign * angle[f"forearm_pronation_{key}"]),
        }
    return Segments(rotation, np.ones((len(pelvis), N_TURNING - 1), dtype=bool))


def read_lift_segments(truth: Path, at_s: Floats | None = None) -> Segments:
    """Read the true rotations of one synthetic lift (`truth.npz`); the head's are not told.

    Parameters
    ----------
    truth
        The file.
    at_s
        Times wanted; by default every tenth sample (10 Hz).
    """
    with np.load(truth, allow_pickle=False) as data:
        values, names, time_s = data["angles"], list(data["angle_names"]), data["time"]
    at = time_s[::10] if at_s is None else at_s
    angle = {n: np.interp(at, time_s, values[:, i]) for i, n in enumerate(names)}
    pelvis = _zxy(angle["pelvis_tilt"], angle["pelvis_list"], angle["pelvis_rotation"])
    thorax = pelvis @ _zxy(
        angle["lumbar_extension"], angle["lumbar_bending"], angle["lumbar_rotation"]
    )
    segments = build_segments(pelvis, thorax, thorax, angle)
    for name in ("neck", "head"):
        segments.is_known[:, JOINTS.index(name) - 1] = False
    return segments


def read_seen_examples(truth: Path, keypoints: Path, camera: str) -> TwistExamples:
    """Read what BlazePose saw of one synthetic lift together with the true twists.

    Parameters
    ----------
    truth
        The trial's `truth.npz`.
    keypoints
        An .npz with `time_s` (T,) and `body` (T, 33, 3), m in camera axes.
    camera
        The camera's name in the person's `subject.json`.
    """
    person = json.loads((truth.parents[1] / "subject.json").read_text(encoding="utf-8"))
    to_camera = next(np.array(c["R"]) for c in person["calibration"] if c["name"] == camera)
    with np.load(keypoints, allow_pickle=False) as data:
        time_s, body = data["time_s"], data["body"].astype(np.float64)
    joints = joints_from_landmarks(body)
    is_seen = np.isfinite(joints).all(axis=(1, 2))
    segments = read_lift_segments(truth, time_s[is_seen])
    joints = joints[is_seen] / body_size(joints)
    twist = find_twists(joints, to_camera @ joint_rotations(segments))
    return TwistExamples(joints - joints[:, :1], twist, segments.is_known)


def draw_segments(n: int, rng: np.random.Generator) -> Segments:
    """Draw postures: two of three on the way from standing to stooping, squatting and reaching.

    The others lie anywhere within the joints' ranges, nearer to the middle than to the limits.
    """
    is_lift = rng.random(n) < 2 / 3
    depth, squat = rng.beta(1.0, 1.2, n), rng.uniform(0, 1, n)
    trunk = np.where(is_lift, depth * (110 - 65 * squat), rng.normal(10, 30, n))
    trunk += rng.normal(3, 5, n)
    lumbar = trunk * rng.uniform(0.2, 0.6, n)
    wide = np.where(is_lift, 1.0, 2.5)
    pelvis = _turn("y", rng.normal(0, 10, n)) @ _zxy(
        lumbar - trunk, wide * rng.normal(0, 4, n), wide * rng.normal(0, 10, n)
    )
    thorax = pelvis @ _zxy(-lumbar, wide * rng.normal(0, 7, n), wide * rng.normal(0, 12, n))
    head = thorax @ _zxy(rng.normal(10, 18, n), rng.normal(0, 8, n), rng.normal(0, 20, n))
    angle = {}
    for key in ("l", "r"):
        bend = np.where(is_lift, 75 * depth * squat, rng.uniform(0, 100, n))
        free_hip = rng.uniform(-20, 110, n)
        angle[f"hip_flexion_{key}"] = np.where(is_lift, bend + trunk - lumbar, free_hip)
        angle[f"hip_flexion_{key}"] += rng.normal(0, 6, n)
        angle[f"knee_flexion_{key}"] = np.abs(bend * rng.uniform(1.2, 1.8, n) + rng.normal(0, 6, n))
        angle[f"hip_adduction_{key}"] = -rng.normal(8, 8, n)
        angle[f"hip_rotation_{key}"] = wide * rng.normal(-7, 8, n)
        angle[f"ankle_dorsiflexion_{key}"] = rng.normal(0.3 * bend, 8, n)
        reach = np.where(is_lift, trunk + rng.uniform(-10, 90, n), rng.uniform(-40, 150, n))
        angle[f"arm_flexion_{key}"] = reach + rng.normal(0, 8, n)
        angle[f"arm_adduction_{key}"] = np.where(
            is_lift, -rng.normal(10, 12, n), -rng.uniform(-20, 110, n)
        )
        angle[f"arm_rotation_{key}"] = wide * rng.normal(15, 18, n)
        angle[f"elbow_flexion_{key}"] = np.minimum(rng.gamma(2.0, 20.0, n), 140)
        angle[f"forearm_pronation_{key}"] = rng.normal(75, 30, n)
    return build_segments(pelvis, thorax, head, angle)


def read_mocap_segments(path: Path, split: str, *, every: int = 5) -> Segments:
    """Read recorded people (17 joints, Z up) and rebuild their segments' rotations.

    Thigh and upper arm are turned so that knee and elbow bend about their hinges; where these are
    straighter than 25 degrees the twist is unknown, as are those of forearms, feet and head.
    """
    with np.load(path, allow_pickle=False) as data:
        rows = np.concatenate(
            [
                np.arange(data["start"][i], data["start"][i] + data["length"][i], every)
                for i in np.flatnonzero(data["split"] == split)
            ]
        )
        x, y, z = np.moveaxis(data["pose"][rows].astype(np.float64), -1, 0)
    joint = np.stack([x, z, -y], axis=-1)
    up = _unit(joint[:, 8] - joint[:, 0])
    pelvis, thorax = _frame(up, joint[:, 1] - joint[:, 4]), _frame(up, joint[:, 14] - joint[:, 11])
    rotation = {"pelvis": pelvis, "thorax": thorax, "head": thorax}
    is_known = np.ones((len(joint), N_TURNING - 1), dtype=bool)
    columns = {"left": (4, 5, 6, 11, 12, 13), "right": (1, 2, 3, 14, 15, 16)}
    for side, _ in SIDES:
        hip, knee, ankle, shoulder, elbow, wrist = (joint[:, c] for c in columns[side])
        leg, leg_bent = _hinge(hip, knee, ankle, pelvis, sense=-1.0)
        arm, arm_bent = _hinge(shoulder, elbow, wrist, thorax, sense=1.0)
        rotation |= {
            f"{side}_thigh": leg[0],
            f"{side}_shank": leg[1],
            f"{side}_foot": leg[1],
            f"{side}_upper_arm": arm[0],
            f"{side}_forearm": arm[1],
        }
        is_known[:, JOINTS.index(f"{side}_hip") - 1] = leg_bent
        is_known[:, JOINTS.index(f"{side}_shoulder") - 1] = arm_bent
        for part in ("ankle", "foot", "elbow", "wrist", "hand"):
            is_known[:, JOINTS.index(f"{side}_{part}") - 1] = False
    for name in ("neck", "head"):
        is_known[:, JOINTS.index(name) - 1] = False
    return Segments(rotation, is_known)


def _unit(vector: Floats) -> Floats:
    return np.asarray(vector / np.maximum(np.linalg.norm(vector, axis=-1, keepdims=True), 1e-9))


def _frame(up: Floats, right: Floats) -> Floats:
    """Return rotations whose columns are forward, up (kept) and right."""
    forward = _unit(np.cross(up, right))
    return np.stack([forward, up, np.cross(forward, up)], axis=-1)


def _hinge(
    top: Floats, middle: Floats, end: Floats, above: Floats, *, sense: float
) -> tuple[tuple[Floats, Floats], NDArray[np.bool_]]:
    """Return the rotations of two segments joined by a hinge, and where it is bent enough."""
    first, second = _unit(top - middle), _unit(middle - end)
    normal = sense * np.cross(first, second)
    is_bent = np.linalg.norm(normal, axis=1) > np.sin(np.radians(BENT_DEG))
    right = np.where(is_bent[:, None], normal, above[:, :, 2])
    return (_frame(first, right), _frame(second, right)), is_bent


def make_examples(segments: Segments, rng: np.random.Generator) -> TwistExamples:
    """Give skeletons of many sizes the postures, mirrored or not, as landmarks would show them.

    Returns
    -------
    TwistExamples
        As many as there are frames.
    """
    world = joint_rotations(segments)
    local = world.copy()
    local[:, 1:] = np.swapaxes(world[:, list(PARENTS[1:N_TURNING])], 2, 3) @ world[:, 1:]
    reference = RestSkeleton.from_stature(1.0)
    joints = np.empty((len(world), len(JOINTS), 3))
    mirror = mirror_order()
    for part in np.array_split(np.arange(len(world)), max(1, len(world) // 500)):
        factor = np.exp(rng.normal(0.0, 0.06, len(JOINTS)))
        rest = reference.with_lengths(reference.lengths * 0.5 * (factor + factor[mirror]))
        joints[part] = place_joints(rest, local[part]).joints
    _straighten_spine(joints)
    twist, is_known = find_twists(joints, world), segments.is_known.copy()
    flip = rng.random(len(world)) < 0.5
    joints[flip] = joints[flip][:, mirror] * (1.0, 1.0, -1.0)
    # A mirrored rotation about a mirrored bone: the twist changes its sign.
    order = mirror[1:N_TURNING] - 1
    twist[flip], is_known[flip] = -twist[flip][:, order], is_known[flip][:, order]
    return TwistExamples(joints, twist, is_known)


def _straighten_spine(joints: Floats) -> None:
    """Put the spine on the line from hips to shoulders, where landmarks put it, in place."""
    columns = [JOINTS.index(f"{side}_shoulder") for side in ("left", "right")]
    thorax = joints[:, columns].mean(axis=1)
    for name, share in SPINE_SHARES.items():
        joints[:, JOINTS.index(name)] = joints[:, 0] + share * (thorax - joints[:, 0])
    for side in ("left", "right"):
        shoulder = joints[:, JOINTS.index(f"{side}_shoulder")]
        joints[:, JOINTS.index(f"{side}_collar")] = thorax + COLLAR_SHARE * (shoulder - thorax)


def find_twists(joints: Floats, world: Floats) -> Floats:
    """Return the twists that lead the inverse kinematics of seen joints to the true rotations.

    Pelvis and spine of landmarks are not quite those of the body; a twist counts from them, so it
    is found going down the same tree.

    Parameters
    ----------
    joints
        Shape (T, 29, 3), as seen.
    world
        Shape (T, 24, 3, 3), true rotations in the same axes.

    Returns
    -------
    array
        Shape (T, 23), radians.
    """
    offsets = RestSkeleton.from_stature(1.0).offsets
    twist, turned = np.zeros((len(joints), N_TURNING - 1)), np.empty_like(world)
    for joint in range(N_TURNING):
        above = (
            turned[:, PARENTS[joint]] if joint else np.broadcast_to(np.eye(3), world[:, 0].shape)
        )
        children = list(CHILDREN[joint])
        wanted = np.einsum("tji,tcj->tci", above, joints[:, children] - joints[:, [joint]])
        if joint in BRANCHING:
            turned[:, joint] = above @ fit_rotation(offsets[children], wanted)
            continue
        bone = offsets[children[0]]
        twist[:, joint - 1] = twist_about(bone, np.swapaxes(above, 1, 2) @ world[:, joint])
        axis = np.broadcast_to(bone / np.linalg.norm(bone), (len(joints), 3))
        swing = compute_swings(bone, wanted[:, 0])
        turned[:, joint] = above @ swing @ rotate_about(axis, twist[:, joint - 1])
    return twist


def joint_rotations(segments: Segments) -> Floats:
    """Return the joints' rotations to the world (T, 24, 3, 3), from the rest posture.

    The spine's joints share the rotation of thorax in pelvis evenly.
    """
    rotation = segments.rotation
    pelvis, thorax, head = (rotation[name] for name in SEGMENT_NAMES)
    bend = np.swapaxes(pelvis, 1, 2) @ thorax
    joint = {"pelvis": pelvis, "neck": thorax, "head": head}
    for share, name in zip((1, 2, 3), ("spine_low", "spine_mid", "spine_high"), strict=True):
        joint[name] = pelvis @ _part_of(bend, share / 3)
    for side, sign in SIDES:
        # From arms out to arms hanging: a quarter turn about the forward axis.
        hang = _turn("x", np.full(len(pelvis), 90.0 * sign))
        fore = rotation[f"{side}_forearm"] @ hang
        joint |= {
            f"{side}_hip": rotation[f"{side}_thigh"],
            f"{side}_knee": rotation[f"{side}_shank"],
            f"{side}_ankle": rotation[f"{side}_foot"],
            f"{side}_foot": rotation[f"{side}_foot"],
            f"{side}_collar": thorax,
            f"{side}_shoulder": rotation[f"{side}_upper_arm"] @ hang,
            f"{side}_elbow": fore,
            f"{side}_wrist": fore,
            f"{side}_hand": fore,
        }
    return np.stack([joint[name] for name in JOINTS[:N_TURNING]], axis=1)


def _part_of(rotation: Floats, share: float) -> Floats:
    """Return a share of each rotation (T, 3, 3), about the same axis."""
    skew = np.stack(
        [
            rotation[:, 2, 1] - rotation[:, 1, 2],
            rotation[:, 0, 2] - rotation[:, 2, 0],
            rotation[:, 1, 0] - rotation[:, 0, 1],
        ],
        axis=1,
    )
    sine = 0.5 * np.linalg.norm(skew, axis=1)
    angle = np.arctan2(sine, 0.5 * (np.trace(rotation, axis1=1, axis2=2) - 1.0))
    axis = np.where(sine[:, None] > 1e-9, skew / np.maximum(2 * sine, 1e-9)[:, None], (1.0, 0, 0))
    return rotate_about(axis, share * angle)
