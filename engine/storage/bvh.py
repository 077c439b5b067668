"""BVH files: a figure of rigid bones that animation programs load.

A bone keeps its mean length, since the format has no other; its direction is that of the
measured segment in every frame. What a video does not show stays undetermined: the turn of a
limb about its own axis follows from the shortest way out of the resting pose (arms to the
sides). Units are centimetres and degrees, Y up, Z to where the subject faces at the start, X to its
left; channels are ``Zrotation Xrotation Yrotation``, multiplied in this order.

The format knows no missing sample: a bone that is not seen for a while keeps its last direction
in the room, and one that is never seen is left out.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from engine.datatypes import Array, BodyFit, PoseTrack
from engine.errors import DataError, UnitError
from engine.skeletons import Skeleton, get_skeleton

__all__ = ["write_bvh"]

CM_PER_M = 100.0
TO_BVH = np.array([[0.0, 0.0, -1.0], [0.0, 1.0, 0.0], [1.0, 0.0, 0.0]])
"""World axes (front, up, right) to the format's usual ones (left, up, front)."""
LEFT, UP, FRONT = np.eye(3)
MAX_UNEVEN = 0.05
"""Share of a frame by which times may differ from even ones before they are resampled."""


@dataclass(frozen=True)
class _Bone:
    """One joint of the figure, and where the bone that starts there points.

    `point` is the keypoint or derived point where it ends. `rest` is its direction
    in the resting pose; a bone with `across` (from right to left) has a whole frame, its left
    axis along that line.
    """

    name: str
    parent: str
    start: str
    end: str
    rest: tuple[float, float, float] = (0.0, 1.0, 0.0)
    across: tuple[str, str] | None = None


def _limb(side: str, sign: float) -> tuple[_Bone, ...]:
    down, out, forth = (0.0, -1.0, 0.0), (sign, 0.0, 0.0), (0.0, 0.0, 1.0)
    word = side.capitalize()
    return (
        _Bone(f"{word}UpLeg", "Hips", f"{side}_hip", f"{side}_knee", down),
        _Bone(f"{word}Leg", f"{word}UpLeg", f"{side}_knee", f"{side}_ankle", down),
        _Bone(f"{word}Foot", f"{word}Leg", f"{side}_ankle", f"{side}_big_toe", forth),
        _Bone(f"{word}Arm", "Chest", f"{side}_shoulder", f"{side}_elbow", out),
        _Bone(f"{word}ForeArm", f"{word}Arm", f"{side}_elbow", f"{side}_wrist", out),
        _Bone(f"{word}Hand", f"{word}ForeArm", f"{side}_wrist", f"{side}_index", out),
    )


BONES: tuple[_Bone, ...] = (
    _Bone("Hips", "", "pelvis", "thorax", across=("right_hip", "left_hip")),
    _Bone("Spine", "Hips", "pelvis", "thorax"),
    _Bone("Chest", "Spine", "thorax", "thorax", across=("right_shoulder", "left_shoulder")),
    _Bone("Neck", "Chest", "thorax", "mid_ear"),
    *_limb("left", 1.0),
    *_limb("right", -1.0),
)


def write_bvh(track: PoseTrack, path: Path, *, body: BodyFit | None = None) -> None:
    """Write the movement as BVH.

    Parameters
    ----------
    track
        World track in metres.
    path
        The file.
    body
        The fitted body, whose segments have constant lengths already; preferred where given.

    Raises
    ------
    UnitError
        If the track is not in the world frame.
    DataError
        If hips and shoulders are never seen together.
    """
    if track.frame_of_reference != "world":
        raise UnitError(
            f"A BVH file needs a track in the world frame, got the {track.frame_of_reference} "
            "frame; give the world track of the result."
        )
    skeleton = get_skeleton(track.skeleton)
    time_s, position = _even_times(track.time_s, _positions(track, body))
    points = _points(skeleton, position)
    bones = tuple(_seen_bones(points))
    if not bones:
        raise DataError(
            "A BVH file needs hips and shoulders seen together in at least one frame, got none; "
            "film the whole person."
        )
    offsets = _offsets(bones, points)
    turns = _rotations(bones, points)
    root = _hold(points["pelvis"]) * CM_PER_M
    path.write_text(
        "\n".join([*_hierarchy(bones, offsets, points), *_motion(bones, turns, root, time_s)])
        + "\n",
        encoding="ascii",
    )


# --------------------------------------------------------------------------- points


def _positions(track: PoseTrack, body: BodyFit | None) -> Array:
    """Return (T, K, 3): the fitted body's joints, and the track's where the model has none."""
    if body is None or body.joints.position.shape != track.position.shape:
        return track.position
    modelled = np.asarray(np.isfinite(body.joints.position).any(axis=(0, 2)))
    return np.where(modelled[None, :, None], body.joints.position, track.position)


def _even_times(time_s: Array, position: Array) -> tuple[Array, Array]:
    """Return samples at even times, between true neighbours where the video's are uneven."""
    if time_s.size < 3:
        return time_s, position
    even = np.linspace(time_s[0], time_s[-1], time_s.size)
    step = (time_s[-1] - time_s[0]) / (time_s.size - 1)
    if np.abs(even - time_s).max() <= MAX_UNEVEN * step:
        return time_s, position
    right = np.clip(np.searchsorted(time_s, even, side="left"), 1, time_s.size - 1)
    share = (even - time_s[right - 1]) / (time_s[right] - time_s[right - 1])
    weight = share[:, None, None]
    return even, (1 - weight) * position[right - 1] + weight * position[right]


def _points(skeleton: Skeleton, position: Array) -> dict[str, Array]:
    """Return every point the figure needs, (T, 3) in the format's axes."""
    wanted = {name for bone in BONES for name in (bone.start, bone.end, *(bone.across or ()))}
    return {
        name: skeleton.point(position, name) @ TO_BVH.T for name in wanted if skeleton.has(name)
    }


def _seen_bones(points: Mapping[str, Array]) -> Iterator[_Bone]:
    """Yield the bones that are seen in some frame and hang on others that are."""
    known = {""}
    for bone in BONES:
        needed = (bone.start, bone.end, *(bone.across or ()))
        if bone.parent not in known or not all(name in points for name in needed):
            continue
        total = np.asarray([points[name] for name in needed]).sum(axis=(0, 2))
        if np.isfinite(total).any():
            known.add(bone.name)
            yield bone


def _hold(values: Array) -> Array:
    """Return (T, ...) with missing samples as the last seen one, or the first at the start."""
    is_seen = np.isfinite(values.reshape(values.shape[0], -1).sum(axis=1))
    number = np.where(is_seen, np.arange(is_seen.size), -1)
    last = np.maximum.accumulate(number)
    return values[np.where(last < 0, int(np.argmax(is_seen)), last)]


# --------------------------------------------------------------------------- bones


def _mean_length(points: Mapping[str, Array], one: str, other: str) -> float:
    return float(np.nanmean(np.linalg.norm(points[one] - points[other], axis=1)))


def _offsets(bones: tuple[_Bone, ...], points: Mapping[str, Array]) -> dict[str, Array]:
    """Return where each joint lies from its parent in the resting pose, in cm."""
    by_name = {bone.name: bone for bone in bones}
    found = {}
    for bone in bones:
        parent = by_name.get(bone.parent)
        if parent is None or bone.start == parent.start:
            offset = np.zeros(3)
        elif parent.across and bone.start != parent.end:
            side = LEFT if bone.start == parent.across[1] else -LEFT
            offset = side * _mean_length(points, *parent.across) / 2
        else:
            offset = np.array(parent.rest) * _mean_length(points, parent.start, parent.end)
        found[bone.name] = offset * CM_PER_M
    return found


def _rotations(bones: tuple[_Bone, ...], points: Mapping[str, Array]) -> dict[str, Array]:
    """Return every bone's turn (T, 3, 3) relative to its parent."""
    n_frames = len(points["pelvis"])
    turned: dict[str, Array] = {"": np.broadcast_to(np.eye(3), (n_frames, 3, 3))}
    local = {}
    for bone in bones:
        above = turned[bone.parent]
        if bone.across:
            line = _hold(points[bone.across[1]] - points[bone.across[0]])
            spine = _hold(points["thorax"] - points["pelvis"])
            own = np.swapaxes(above, 1, 2) @ _frame(line, spine)
        else:
            along = _hold(points[bone.end] - points[bone.start])
            wanted = np.einsum("tji,tj->ti", above, along)
            own = _shortest_turn(np.array(bone.rest), wanted)
        local[bone.name], turned[bone.name] = own, above @ own
    return local


def _unit(vectors: Array) -> Array:
    length = np.linalg.norm(vectors, axis=-1, keepdims=True)
    return vectors / np.where(length > 0, length, 1.0)


def _frame(left: Array, up: Array) -> Array:
    """Return (T, 3, 3) whose first axis is `left` and whose second is nearest to `up`."""
    x = _unit(left)
    z = _unit(np.cross(x, up))
    return np.stack([x, np.cross(z, x), z], axis=2)


def _shortest_turn(rest: Array, wanted: Array) -> Array:
    """Return the turns (T, 3, 3) by the least angle that bring `rest` to `wanted` (T, 3)."""
    to = _unit(wanted)
    cosine = to @ rest
    axis = np.cross(rest, to)
    cross = np.zeros((len(to), 3, 3))
    for row, column, part, sign in ((0, 1, 2, -1), (0, 2, 1, 1), (1, 2, 0, -1)):
        cross[:, row, column] = sign * axis[:, part]
        cross[:, column, row] = -sign * axis[:, part]
    is_opposite = cosine < -1 + 1e-9
    factor = 1 / np.where(is_opposite, 1.0, 1 + cosine)
    turn = np.eye(3) + cross + cross @ cross * factor[:, None, None]
    about = FRONT if abs(rest @ FRONT) < 0.5 else UP
    turn[is_opposite] = 2 * np.outer(about, about) - np.eye(3)
    return turn


def _angles_zxy(turn: Array) -> Array:
    """Return (T, 3) degrees about Z, X and Y, whose turns multiply to `turn` in this order."""
    about_x = np.arcsin(np.clip(turn[:, 2, 1], -1, 1))
    is_locked = np.abs(turn[:, 2, 1]) > 1 - 1e-12
    about_z = np.where(
        is_locked,
        np.arctan2(turn[:, 1, 0], turn[:, 0, 0]),
        np.arctan2(-turn[:, 0, 1], turn[:, 1, 1]),
    )
    about_y = np.where(is_locked, 0.0, np.arctan2(-turn[:, 2, 0], turn[:, 2, 2]))
    return np.degrees(np.unwrap(np.stack([about_z, about_x, about_y], axis=1), axis=0))


# --------------------------------------------------------------------------- text


def _hierarchy(
    bones: tuple[_Bone, ...], offsets: Mapping[str, Array], points: Mapping[str, Array]
) -> list[str]:
    lines = ["HIERARCHY"]

    def add(bone: _Bone, depth: int) -> None:
        pad, turn = "\t" * depth, "Zrotation Xrotation Yrotation"
        channels = f"3 {turn}" if depth else f"6 Xposition Yposition Zposition {turn}"
        lines.extend([f"{pad}{'JOINT' if depth else 'ROOT'} {bone.name}", f"{pad}{{"])
        lines.append(f"{pad}\tOFFSET {_numbers(offsets[bone.name])}")
        lines.append(f"{pad}\tCHANNELS {channels}")
        children = [other for other in bones if other.parent == bone.name]
        for child in children:
            add(child, depth + 1)
        if not children:
            length = CM_PER_M * _mean_length(points, bone.start, bone.end)
            tip = _numbers(np.array(bone.rest) * length)
            lines.extend([f"{pad}\tEnd Site", f"{pad}\t{{", f"{pad}\t\tOFFSET {tip}", f"{pad}\t}}"])
        lines.append(f"{pad}}}")

    add(bones[0], 0)
    return lines


def _depth_first(bones: tuple[_Bone, ...], parent: str = "") -> Iterator[_Bone]:
    for bone in bones:
        if bone.parent == parent:
            yield bone
            yield from _depth_first(bones, bone.name)


def _motion(
    bones: tuple[_Bone, ...], turns: Mapping[str, Array], root: Array, time_s: Array
) -> list[str]:
    step_s = 1.0 if time_s.size < 2 else (time_s[-1] - time_s[0]) / (time_s.size - 1)
    angles = [_angles_zxy(turns[bone.name]) for bone in _depth_first(bones)]
    rows = np.concatenate([root, *angles], axis=1)
    head = ["MOTION", f"Frames: {len(rows)}", f"Frame Time: {step_s:.8f}"]
    return [*head, *(_numbers(row) for row in rows)]


def _numbers(values: Array) -> str:
    return " ".join(f"{value:.5f}" for value in values)
