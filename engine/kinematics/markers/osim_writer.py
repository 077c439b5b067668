"""Writing a model for OpenSim: its markers, its size, and the pose it starts from.

The file it was read from is taken as it is, but for what changes here and for what inverse
kinematics does not need: pictures of bones, forces and contacts, whose missing files would only
raise warnings. Masses and inertias keep the values of the unscaled model.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from xml.etree import ElementTree
from xml.etree.ElementTree import Element, SubElement

from engine.errors import OutputError
from engine.kinematics.markers.osim import GROUND, ModelMarker

__all__ = ["write_osim"]

_LEFT_OUT = ("ForceSet", "ContactGeometrySet", "ControllerSet", "ProbeSet")


def write_osim(
    source: Path,
    path: Path,
    *,
    markers: Sequence[ModelMarker],
    scale: Mapping[str, float] | None = None,
    defaults: Mapping[str, float] | None = None,
    locked: Sequence[str] = (),
) -> None:
    """Write a model.

    Parameters
    ----------
    source
        The model file to start from.
    path
        The file to write.
    markers
        Replace those of the source; in the scaled bodies.
    scale
        Body to factor, alike in all directions; 1 where absent.
    defaults
        Coordinate to default value, rad or m.
    locked
        Coordinates to lock at their default.

    Raises
    ------
    OutputError
        If the file can't be written.
    """
    tree = ElementTree.parse(source)  # noqa: S314 - a model file of the user's own
    model = tree.getroot()[0]
    for tag in _LEFT_OUT:
        for part in model.findall(f"{tag}/objects"):
            part.clear()
    for geometry in model.iter("attached_geometry"):
        geometry.clear()
    for joint in model.findall("JointSet/objects/*"):
        _scale_joint(joint, scale or {})
        for coordinate in joint.findall("coordinates/*"):
            name = coordinate.get("name", "")
            if defaults and name in defaults:
                _set(coordinate, "default_value", f"{defaults[name]:.17g}")
            if name in locked:
                _set(coordinate, "locked", "true")
    _replace_markers(model, markers)
    try:
        tree.write(path, encoding="UTF-8", xml_declaration=True)
    except OSError as error:
        raise OutputError(f"{path} can't be written: {error.strerror or error}.") from error


def _set(element: Element, tag: str, text: str) -> None:
    child = element.find(tag)
    (SubElement(element, tag) if child is None else child).text = text


def _body_of(text: str | None) -> str:
    return (text or "").strip().rpartition("/")[2]


def _scale_joint(joint: Element, scale: Mapping[str, float]) -> None:
    body_of_frame: dict[str, str] = {}
    for frame in joint.findall("frames/*"):
        body = _body_of(frame.findtext("socket_parent"))
        body_of_frame[frame.get("name", "")] = body
        numbers = [float(word) for word in (frame.findtext("translation") or "0 0 0").split()]
        grown = [scale.get(body, 1.0) * number for number in numbers]
        _set(frame, "translation", " ".join(f"{number:.17g}" for number in grown))
    parent = _body_of(joint.findtext("socket_parent_frame"))
    parent = body_of_frame.get(parent, parent)
    factor = 1.0 if parent == GROUND else scale.get(parent, 1.0)
    for axis in joint.findall("SpatialTransform/TransformAxis"):
        if axis.get("name", "").startswith("translation") and factor != 1.0:
            _scale_function(axis, factor)


def _scale_function(axis: Element, factor: float) -> None:
    """Wrap the function of an axis in a multiple of it."""
    for child in list(axis):
        if child.tag in {"coordinates", "axis"}:
            continue
        axis.remove(child)
        inner = child[0] if child.tag == "function" and len(child) else child
        inner.attrib.pop("name", None)
        outer = SubElement(axis, "MultiplierFunction", {"name": "function"})
        SubElement(outer, "function").append(inner)
        SubElement(outer, "scale").text = f"{factor:.17g}"


def _replace_markers(model: Element, markers: Sequence[ModelMarker]) -> None:
    found = model.find("MarkerSet")
    marker_set = SubElement(model, "MarkerSet") if found is None else found
    marker_set.clear()
    marker_set.set("name", "markerset")
    objects = SubElement(marker_set, "objects")
    SubElement(marker_set, "groups")
    for marker in markers:
        element = SubElement(objects, "Marker", {"name": marker.name})
        SubElement(element, "socket_parent_frame").text = f"/bodyset/{marker.body}"
        SubElement(element, "location").text = " ".join(f"{x:.17g}" for x in marker.local)
        SubElement(element, "fixed").text = "false"
