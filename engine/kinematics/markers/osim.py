"""Reading the kinematic tree and the markers of an OpenSim model file (.osim, OpenSim 4).

Only what inverse kinematics needs is read: bodies, joints, coordinates and markers. Muscles, masses
and geometry stay aside.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from xml.etree import ElementTree
from xml.etree.ElementTree import Element

import numpy as np

from engine.datatypes import Array
from engine.errors import DataError
from engine.kinematics.markers.functions import JointFunction, constant, linear, parse_function

__all__ = ["Axis", "Coordinate", "Joint", "ModelMarker", "OsimModel", "read_osim"]

GROUND = "ground"
FIRST_VERSION = 40000
UNIT_AXES = np.eye(3)


@dataclass(frozen=True)
class Coordinate:
    """One degree of freedom; values in radians or metres."""

    name: str
    default: float
    low: float
    high: float
    is_clamped: bool
    is_locked: bool


@dataclass(frozen=True, eq=False)
class Axis:
    """A rotation about, or translation along, a fixed `axis` (3,) by a function of a coordinate.

    `coordinate` is empty where the function is constant.
    """

    axis: Array
    coordinate: str
    function: JointFunction


@dataclass(frozen=True, eq=False)
class Joint:
    """How a child body hangs on its parent.

    ``parent -> (parent_rotation, parent_translation) -> moved by the axes -> child frame``; the
    child frame sits in the child body at (child_rotation, child_translation). Rotations are
    body-fixed, in order; translations are along the axes of the parent's joint frame.
    """

    name: str
    parent: str
    child: str
    parent_rotation: Array
    parent_translation: Array
    child_rotation: Array
    child_translation: Array
    rotations: tuple[Axis, ...] = ()
    translations: tuple[Axis, ...] = ()


@dataclass(frozen=True, eq=False)
class ModelMarker:
    """A point fixed in a body, `local` (3,) in metres."""

    name: str
    body: str
    local: Array


@dataclass(frozen=True, eq=False)
class OsimModel:
    """The kinematics of a model; joints in an order that has parents before children."""

    name: str
    bodies: tuple[str, ...]
    joints: tuple[Joint, ...]
    coordinates: tuple[Coordinate, ...]
    markers: tuple[ModelMarker, ...] = ()
    masses_kg: Mapping[str, float] = field(default_factory=dict)

    def coordinate(self, name: str) -> Coordinate:
        """Return a coordinate by name.

        Raises
        ------
        DataError
            If the model has none of that name.
        """
        for coordinate in self.coordinates:
            if coordinate.name == name:
                return coordinate
        known = ", ".join(c.name for c in self.coordinates)
        raise DataError(f"The model {self.name} has no coordinate {name!r}; known: {known}.")


def read_osim(path: str | Path) -> OsimModel:
    """Read a model.

    Raises
    ------
    DataError
        If the file is no OpenSim 4 model or uses a joint that is not supported.
    """
    path = Path(path)
    try:
        root = ElementTree.parse(path).getroot()  # noqa: S314 - a model file of the user's own
    except FileNotFoundError:
        raise DataError(f"There is no model file {path}; check the path.") from None
    except (OSError, ElementTree.ParseError) as error:
        raise DataError(f"{path.name} can't be read as an OpenSim model: {error}.") from error
    model = root.find("Model")
    version = root.get("Version", "0")
    if root.tag != "OpenSimDocument" or model is None:
        raise DataError(f"{path.name} is no OpenSim model; expected an .osim file.")
    if not version.isdigit() or int(version) < FIRST_VERSION:
        raise DataError(
            f"{path.name} was written by OpenSim 3 or older (version {version}); open it in "
            "OpenSim 4 and save it again."
        )
    joints, coordinates = [], []
    for element in _objects(model, "JointSet"):
        joint, own = _read_joint(element)
        joints.append(joint)
        coordinates += own
    ordered = _sort_joints(joints, path.name)
    masses = {
        b.get("name", ""): float(b.findtext("mass") or 0.0) for b in _objects(model, "BodySet")
    }
    return OsimModel(
        name=model.get("name", path.stem),
        bodies=tuple(joint.child for joint in ordered),
        joints=ordered,
        coordinates=tuple(coordinates),
        markers=tuple(_read_marker(m) for m in _objects(model, "MarkerSet")),
        masses_kg=masses,
    )


def _objects(model: Element, tag: str) -> Iterator[Element]:
    found = model.find(f"{tag}/objects")
    yield from found if found is not None else ()


def _vector(element: Element, tag: str) -> Array:
    words = (element.findtext(tag) or "0 0 0").split()
    return np.array([float(word) for word in words])


def _body_of(socket: str | None) -> str:
    return (socket or "").strip().rpartition("/")[2]


def _rotation_xyz(angles: Array) -> Array:
    """Return the rotation by body-fixed angles about x, y and z, as OpenSim orients frames."""
    rotation = np.eye(3)
    for axis, angle in zip(UNIT_AXES, angles, strict=True):
        cross = np.cross(axis, np.eye(3)).T
        turn = np.eye(3) + np.sin(angle) * cross + (1.0 - np.cos(angle)) * cross @ cross
        rotation = rotation @ turn
    return rotation


def _read_marker(element: Element) -> ModelMarker:
    return ModelMarker(
        name=element.get("name", ""),
        body=_body_of(element.findtext("socket_parent_frame")),
        local=_vector(element, "location"),
    )


def _read_joint(element: Element) -> tuple[Joint, list[Coordinate]]:
    name = element.get("name", "")
    frames = {f.get("name", ""): f for f in element.findall("frames/*")}
    parent = _frame(element, "socket_parent_frame", frames)
    child = _frame(element, "socket_child_frame", frames)
    coordinates = [_read_coordinate(c) for c in element.findall("coordinates/*")]
    names = [c.name for c in coordinates]
    if element.tag == "CustomJoint":
        rotations, translations = _read_spatial_transform(element)
    else:
        rotations, translations = _simple_axes(element.tag, names, name)
    joint = Joint(name, parent[0], child[0], *parent[1:], *child[1:], rotations, translations)
    return joint, coordinates


def _frame(joint: Element, socket: str, frames: Mapping[str, Element]) -> tuple[str, Array, Array]:
    """Return body, rotation (3, 3) and translation (3,) of one side of a joint."""
    target = (joint.findtext(socket) or "").strip()
    frame = frames.get(target.rpartition("/")[2])
    if frame is None or target.startswith("/bodyset"):
        return _body_of(target), np.eye(3), np.zeros(3)
    rotation = _rotation_xyz(_vector(frame, "orientation"))
    return _body_of(frame.findtext("socket_parent")), rotation, _vector(frame, "translation")


def _read_coordinate(element: Element) -> Coordinate:
    low, high = (float(w) for w in (element.findtext("range") or "-1e9 1e9").split())

    def is_true(tag: str) -> bool:
        return (element.findtext(tag) or "false").strip().lower() == "true"

    return Coordinate(
        name=element.get("name", ""),
        default=float(element.findtext("default_value") or 0.0),
        low=low,
        high=high,
        is_clamped=is_true("clamped"),
        is_locked=is_true("locked"),
    )


def _read_spatial_transform(joint: Element) -> tuple[tuple[Axis, ...], tuple[Axis, ...]]:
    rotations: list[Axis] = []
    translations: list[Axis] = []
    for element in joint.findall("SpatialTransform/TransformAxis"):
        coordinate = (element.findtext("coordinates") or "").strip()
        axis = _vector(element, "axis")
        function = _function_of(element, is_moving=bool(coordinate))
        found = Axis(axis / np.linalg.norm(axis), coordinate, function)
        (rotations if element.get("name", "").startswith("rot") else translations).append(found)
    return tuple(rotations), tuple(translations)


def _function_of(axis: Element, *, is_moving: bool) -> JointFunction:
    wrapper = axis.find("function")
    if wrapper is not None and len(wrapper):
        return parse_function(wrapper[0])
    others = [child for child in axis if child.tag not in {"coordinates", "axis", "function"}]
    if others:
        return parse_function(others[0])
    return linear() if is_moving else constant(0.0)


_ROTATIONS: Mapping[str, str] = {
    "WeldJoint": "",
    "PinJoint": "z",
    "UniversalJoint": "xy",
    "GimbalJoint": "xyz",
    "BallJoint": "xyz",
    "FreeJoint": "xyz",
    "PlanarJoint": "z",
    "SliderJoint": "",
}
_TRANSLATIONS: Mapping[str, str] = {"FreeJoint": "xyz", "PlanarJoint": "xy", "SliderJoint": "x"}


def _simple_axes(
    kind: str, names: list[str], joint: str
) -> tuple[tuple[Axis, ...], tuple[Axis, ...]]:
    """Return the axes of a joint whose kind says them, in the order of its coordinates."""
    if kind not in _ROTATIONS:
        raise DataError(
            f"The joint {joint} is a {kind}, which is not supported; expected CustomJoint or one "
            f"of {', '.join(_ROTATIONS)}."
        )
    turns, slides = _ROTATIONS[kind], _TRANSLATIONS.get(kind, "")

    def axes(letters: str, coordinates: list[str]) -> tuple[Axis, ...]:
        return tuple(
            Axis(UNIT_AXES["xyz".index(letter)], name, linear())
            for letter, name in zip(letters, coordinates, strict=True)
        )

    return axes(turns, names[: len(turns)]), axes(slides, names[len(turns) :])


def _sort_joints(joints: list[Joint], name: str) -> tuple[Joint, ...]:
    """Order joints so that a body is placed before those that hang on it."""
    placed, ordered, left = {GROUND}, [], list(joints)
    while left:
        ready = [j for j in left if j.parent in placed]
        if not ready:
            raise DataError(
                f"The joints {', '.join(j.name for j in left)} of {name} hang on no body that "
                "reaches the ground; the model's tree is broken."
            )
        ordered += ready
        placed |= {j.child for j in ready}
        left = [j for j in left if j not in ready]
    return tuple(ordered)
