"""What `two_view.py` measures on: cameras, true joints, disturbed views, and the real clip."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from engine.cameras.files import adapt_to_pictures, read_calibration
from engine.datatypes import Array, Calibration, Camera, PoseTrack, ViewPose
from engine.kinematics.angles import compute_shoulder_angles
from engine.skeletons import MEDIAPIPE_33
from engine.video.reader import read_frames

CAMERAS = ("cam90", "cam135")
REAL_CAMERAS = ("cam01", "cam02", "cam03", "cam04")
PARTS = ("shoulder", "elbow", "wrist", "hip", "knee", "ankle")
JOINTS = tuple(f"{side}_{part}" for part in PARTS for side in ("left", "right"))
COLUMNS = [MEDIAPIPE_33.index(name) for name in JOINTS]
NEAR = [i for i, name in enumerate(JOINTS) if name.startswith("right_")]
FAR = [i for i, name in enumerate(JOINTS) if name.startswith("left_")]
"""Both cameras see the right side."""


def list_trials(data: Path, persons: Sequence[str]) -> Iterator[Path]:
    """List the folders of the trials."""
    for person in persons:
        yield from sorted(p for p in (data / person).glob(f"{person}_*") if p.is_dir())


def read_given_calibration(person: Path) -> Calibration:
    """Read the exact cameras of a person's trials."""
    stored = json.loads((person / "subject.json").read_text())["calibration"]
    cameras = tuple(
        Camera(
            name=c["name"],
            size_px=(c["width"], c["height"]),
            matrix=np.array(c["K"]),
            rotation=np.array(c["R"]),
            translation=np.array(c["t"]),
        )
        for name in CAMERAS
        for c in stored
        if c["name"] == name
    )
    return Calibration(
        cameras=cameras,
        source="file",
        up=np.array([0.0, 1.0, 0.0]),
        floor_m=0.0,
        scale_sigma=0.0,
        rotation_sigma_deg=0.0,
        translation_sigma_m=0.0,
        tilt_sigma_deg=0.0,
        floor_sigma_m=0.0,
    )


def read_true_joints(folder: Path, time_s: Array) -> Array:
    """Read the true joint centres at some times, shape (T, 12, 3), m, in the order of `JOINTS`."""
    with np.load(folder / "truth.npz", allow_pickle=False) as data:
        known_s, joints = data["time"], data["joints"].astype(float)
        names = list(data["joint_names"])
    columns = [names.index(f"{n.split('_')[1]}_{n[0].upper()}") for n in JOINTS]
    flat = joints[:, columns].reshape(len(joints), -1)
    return np.stack([np.interp(time_s, known_s, c) for c in flat.T], axis=1).reshape(-1, 12, 3)


def read_pelvic_hip_flexion(folder: Path) -> dict[str, Array]:
    """Read the true hip flexion against the pelvis, which solvers with a body model give."""
    with np.load(folder / "truth.npz", allow_pickle=False) as data:
        names, angles = list(data["angle_names"]), data["angles"].astype(float)
    return {k: angles[:, names.index(k)] for k in ("hip_flexion_l", "hip_flexion_r")}


def true_shoulder_flexion(joints: Array) -> dict[str, Array]:
    """Return the product's shoulder flexion (T,) of both sides, of true joints (T, 12, 3)."""
    point = dict(zip(JOINTS, np.moveaxis(joints, 1, 0), strict=True))
    mid_hip = (point["left_hip"] + point["right_hip"]) / 2
    found = {}
    for side in ("left", "right"):
        flexion, _ = compute_shoulder_angles(
            point[f"{side}_shoulder"],
            point[f"{side}_elbow"],
            left_shoulder=point["left_shoulder"],
            right_shoulder=point["right_shoulder"],
            mid_hip=mid_hip,
            side="left" if side == "left" else "right",
        )
        found[f"shoulder_flexion_{side[0]}"] = flexion
    return found


def cut_view(view: ViewPose, part: slice, time_s: Array | None = None) -> ViewPose:
    """Return some of a view's frames, at other times if given."""

    def cut(track: PoseTrack) -> PoseTrack:
        return replace(
            track,
            time_s=track.time_s[part] if time_s is None else time_s,
            position=track.position[part],
            confidence=track.confidence[part],
            sigma=track.sigma[part],
            status=track.status[part],
        )

    image = cut(view.image)
    return replace(
        view,
        image=image,
        body=cut(view.body) if view.body is not None else None,
        box=view.box[part],
        state=view.state[part],
        others=view.others[part] if view.others else (),
        info=replace(view.info, n_frames=image.n_frames),
    )


def delay_second(views: Sequence[ViewPose], n_frames: int) -> tuple[ViewPose, ...]:
    """Return views of which the second shows what happens `n_frames` later."""
    if not n_frames:
        return tuple(views)
    count = views[0].image.n_frames - n_frames
    first = cut_view(views[0], slice(0, count))
    second = cut_view(views[1], slice(n_frames, n_frames + count), np.asarray(first.image.time_s))
    return first, second


# The points that an estimator means by a joint lie beside the joint's centre, fixed to the body.
_AXES: Mapping[str, tuple[str, str, str]] = {
    # part: the axis from one joint to another, and the line across that turns with it
    "shoulder": ("hip", "shoulder", "shoulder"),
    "hip": ("hip", "shoulder", "hip"),
    "knee": ("knee", "hip", "hip"),
    "ankle": ("ankle", "knee", "hip"),
    "elbow": ("elbow", "shoulder", "shoulder"),
    "wrist": ("wrist", "elbow", "shoulder"),
}


def _local_axes(joints: Array, name: str) -> Array:
    """Return the axes (columns) of the segment at a joint, shape (T, 3, 3)."""
    point = dict(zip(JOINTS, np.moveaxis(joints, 1, 0), strict=True))
    side, part = name.split("_")
    start, end, across = _AXES[part]
    if part in ("shoulder", "hip"):
        along = sum(point[f"{s}_{end}"] - point[f"{s}_{start}"] for s in ("left", "right"))
    else:
        along = point[f"{side}_{end}"] - point[f"{side}_{start}"]
    along = along / np.linalg.norm(along, axis=1, keepdims=True)
    right = point[f"right_{across}"] - point[f"left_{across}"]
    right = right - (right * along).sum(axis=1, keepdims=True) * along
    right = right / np.linalg.norm(right, axis=1, keepdims=True)
    return np.stack([np.cross(right, along), along, right], axis=2)


def learn_definition(pairs: Sequence[tuple[Array, Array]]) -> dict[str, Array]:
    """Learn where joint centres lie from the estimated points, in the axes of their segments.

    Parameters
    ----------
    pairs
        Estimated and true joints (T, 12, 3) of training trials.

    Returns
    -------
    dict
        Offset (3,) of every joint, m: the median over all frames.
    """
    offsets = {}
    for j, name in enumerate(JOINTS):
        local = [
            np.einsum("tji,tj->ti", _local_axes(found, name), true[:, j] - found[:, j])
            for found, true in pairs
        ]
        offsets[name] = np.nanmedian(np.concatenate(local), axis=0)
    return offsets


def make_symmetric(offsets: Mapping[str, Array]) -> dict[str, Array]:
    """Return the offsets that are the same on both sides, as anatomy is."""
    mirror = np.array([1.0, 1.0, -1.0])
    result = {}
    for name, offset in offsets.items():
        side, part = name.split("_")
        other = offsets[f"{'right' if side == 'left' else 'left'}_{part}"]
        result[name] = (offset + mirror * other) / 2
    return result


def correct_definition(joints: Array, offsets: Mapping[str, Array]) -> Array:
    """Move estimated joints (T, 12, 3) to where the joint centres are."""
    moved = [
        joints[:, j] + np.einsum("tij,j->ti", _local_axes(joints, name), offsets[name])
        for j, name in enumerate(JOINTS)
    ]
    return np.stack(moved, axis=1)


def align_rigidly(found: Array, true: Array) -> Array:
    """Turn and shift joints (T, J, 3) of a whole clip onto others, without scaling."""
    known = np.isfinite(found).all(axis=2) & np.isfinite(true).all(axis=2)
    a, b = found[known], true[known]
    left, _, right = np.linalg.svd((a - a.mean(axis=0)).T @ (b - b.mean(axis=0)))
    flip = np.diag([1.0, 1.0, np.sign(np.linalg.det(left @ right))])
    turn = left @ flip @ right
    return np.asarray((found - a.mean(axis=0)) @ turn + b.mean(axis=0))


def read_real_calibration(data: Path) -> Calibration:
    """Read the four cameras, adapted to the pictures; two of them were scaled and padded."""
    calibration = read_calibration(data / "Calib.qca.txt", names=REAL_CAMERAS)
    pictures = [next(iter(read_frames(data / f"{n}.mp4"))).image for n in REAL_CAMERAS]
    sizes = [(picture.shape[1], picture.shape[0]) for picture in pictures]
    return adapt_to_pictures(calibration, sizes, pictures)[0]
