"""The convention of every joint angle, and the geometry that defines the simple ones.

`ANGLES` is the only place where an angle's sign, zero and counterparts in other systems are
written down; `docs/angles.md` is printed from it. Axes: Y up; a body's X points forward and Z
to the subject's right. Points have shape (T, 3), in one common unit, NaN where missing; angles
are degrees and NaN where a point is missing or the geometry is singular.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from engine.datatypes import Array
from engine.errors import ConfigError, ShapeError

__all__ = [
    "ANGLES",
    "ANGLE_NAMES",
    "AngleDefinition",
    "ExternalAngle",
    "TrunkAngles",
    "compute_forward",
    "compute_hinge_flexion",
    "compute_hip_flexion",
    "compute_included_angle",
    "compute_neck_angle",
    "compute_shoulder_angles",
    "compute_trunk_angles",
    "compute_upper_arm_elevation",
    "describe_angle",
    "format_angle_table",
    "get_external_angle",
]

System = Literal["isb", "plug_in_gait", "opensim_hamner", "opensim_pose2sim"]
Group = Literal["trunk", "lumbar", "pelvis", "neck", "leg", "arm"]

UP = np.array([0.0, 1.0, 0.0])
MIN_SHARE = 0.05
"""A direction whose useful part is smaller than this share of its length (3 degrees) is noise."""


# --------------------------------------------------------------------------- convention table


@dataclass(frozen=True)
class ExternalAngle:
    """An angle's name in another system, and ``ours = sign * theirs``.

    In `name`, ``*`` stands for the side as that system writes it (`l`/`r`, or `L`/`R` in
    Plug-in Gait).
    """

    name: str
    sign: int


@dataclass(frozen=True)
class AngleDefinition:
    """One row of the convention table.

    `relative_to` says whether the angle is one between two body segments (`parent`) or one
    with the vertical or the heading (`world`). Rows with `is_bilateral` stand for two angles,
    ``<name>_l`` and ``<name>_r``. `is_geometric` tells whether the solver `geometric`
    provides the angle, `is_fitted` whether the body model of the solver `least-squares` does.
    """

    name: str
    title: str
    group: Group
    definition: str
    zero: str
    positive: str
    relative_to: Literal["parent", "world"]
    isb: ExternalAngle | None = None
    plug_in_gait: ExternalAngle | None = None
    opensim_hamner: ExternalAngle | None = None
    opensim_pose2sim: ExternalAngle | None = None
    is_bilateral: bool = False
    is_geometric: bool = False
    is_fitted: bool = True

    @property
    def names(self) -> tuple[str, ...]:
        """The angle's name, or both with their side."""
        return (f"{self.name}_l", f"{self.name}_r") if self.is_bilateral else (self.name,)


def _ext(name: str, sign: int = 1) -> ExternalAngle:
    return ExternalAngle(name, sign)


ANGLES: tuple[AngleDefinition, ...] = (
    AngleDefinition(
        name="trunk_inclination",
        title="Trunk inclination",
        group="trunk",
        definition="Angle between the trunk line (mid-hip to mid-shoulder) and the vertical; "
        "no sign.",
        zero="trunk line vertical",
        positive="always",
        relative_to="world",
        is_geometric=True,
    ),
    AngleDefinition(
        name="trunk_flexion",
        title="Trunk flexion",
        group="trunk",
        definition="Angle of the trunk line with the vertical in the plane that holds the forward "
        "direction of the hips; first angle of Z-X-Y.",
        zero="trunk line vertical in that plane",
        positive="forward",
        relative_to="world",
        isb=_ext("thorax relative to ground, e1 (Z)", -1),
        plug_in_gait=_ext("LThoraxAngles.x"),
        is_geometric=True,
    ),
    AngleDefinition(
        name="trunk_lateral_bend",
        title="Trunk lateral bend",
        group="trunk",
        definition="Angle by which the trunk line leaves that plane; second angle of Z-X-Y.",
        zero="trunk line in that plane",
        positive="to the right",
        relative_to="world",
        isb=_ext("thorax relative to ground, e2 (X)"),
        plug_in_gait=_ext("LThoraxAngles.y"),
        is_geometric=True,
    ),
    AngleDefinition(
        name="trunk_twist",
        title="Trunk twist",
        group="trunk",
        definition="Turn of the shoulder line against the hip line about the trunk line, after "
        "flexion and lateral bend are undone; third angle of Z-X-Y.",
        zero="shoulder line parallel to the horizontal part of the hip line",
        positive="to the left (right shoulder forward)",
        relative_to="parent",
        is_geometric=True,
    ),
    AngleDefinition(
        name="lumbar_flexion",
        title="Lumbar flexion",
        group="lumbar",
        definition="Thorax (trunk line and shoulder line) relative to pelvis, first angle of "
        "Z-X-Y; needs a body model.",
        zero="thorax and pelvis aligned as in the neutral pose",
        positive="forward",
        relative_to="parent",
        isb=_ext("thorax relative to pelvis, e1 (Z)", -1),
        plug_in_gait=_ext("LSpineAngles.x"),
        opensim_hamner=_ext("lumbar_extension", -1),
        opensim_pose2sim=_ext("L5_S1_Flex_Ext", -1),
    ),
    AngleDefinition(
        name="lumbar_bending",
        title="Lumbar lateral bending",
        group="lumbar",
        definition="Thorax relative to pelvis, second angle of Z-X-Y; needs a body model.",
        zero="no lateral bend",
        positive="to the right",
        relative_to="parent",
        isb=_ext("thorax relative to pelvis, e2 (X)"),
        plug_in_gait=_ext("LSpineAngles.y", -1),
        opensim_hamner=_ext("lumbar_bending"),
        opensim_pose2sim=_ext("L5_S1_Lat_Bending"),
    ),
    AngleDefinition(
        name="lumbar_rotation",
        title="Lumbar axial rotation",
        group="lumbar",
        definition="Thorax relative to pelvis, third angle of Z-X-Y; needs a body model.",
        zero="no twist",
        positive="to the left",
        relative_to="parent",
        isb=_ext("thorax relative to pelvis, e3 (Y)"),
        plug_in_gait=_ext("LSpineAngles.z"),
        opensim_hamner=_ext("lumbar_rotation"),
        opensim_pose2sim=_ext("L5_S1_axial_rotation"),
    ),
    AngleDefinition(
        name="pelvis_tilt",
        title="Pelvic tilt",
        group="pelvis",
        definition="Pelvis relative to the world, first angle of Z-X-Y; needs a body model.",
        zero="pelvis as in the neutral pose",
        positive="backward (posterior), as in OpenSim",
        relative_to="world",
        isb=_ext("pelvis relative to ground, e1 (Z)"),
        plug_in_gait=_ext("LPelvisAngles.x", -1),
        opensim_hamner=_ext("pelvis_tilt"),
        opensim_pose2sim=_ext("pelvis_tilt"),
    ),
    AngleDefinition(
        name="pelvis_list",
        title="Pelvic list",
        group="pelvis",
        definition="Pelvis relative to the world, second angle of Z-X-Y; needs a body model.",
        zero="both hips level",
        positive="right side down",
        relative_to="world",
        isb=_ext("pelvis relative to ground, e2 (X)"),
        plug_in_gait=_ext("LPelvisAngles.y"),
        opensim_hamner=_ext("pelvis_list"),
        opensim_pose2sim=_ext("pelvis_list"),
    ),
    AngleDefinition(
        name="pelvis_rotation",
        title="Pelvic rotation",
        group="pelvis",
        definition="Pelvis relative to the world, third angle of Z-X-Y; needs a body model.",
        zero="facing as at the start of the trial",
        positive="to the left",
        relative_to="world",
        isb=_ext("pelvis relative to ground, e3 (Y)"),
        plug_in_gait=_ext("LPelvisAngles.z", -1),
        opensim_hamner=_ext("pelvis_rotation"),
        opensim_pose2sim=_ext("pelvis_rotation"),
    ),
    AngleDefinition(
        name="neck_flexion",
        title="Neck flexion",
        group="neck",
        definition="Line from mid-shoulder to mid-ear against the trunk line in the sagittal "
        "plane of the shoulders, minus its value while standing upright in the same trial.",
        zero="as while standing upright",
        positive="forward",
        relative_to="parent",
        plug_in_gait=_ext("LNeckAngles.x"),
        is_geometric=True,
    ),
    AngleDefinition(
        name="hip_flexion",
        title="Hip flexion",
        group="leg",
        definition="Thigh against the pelvis, first angle of Z-X-Y. From keypoints alone (solver "
        "`geometric`) the trunk line stands in for the pelvis, so that lumbar flexion is included.",
        zero="thigh in line with the trunk, seen from the side",
        positive="flexion (knee forward)",
        relative_to="parent",
        isb=_ext("hip e1"),
        plug_in_gait=_ext("*HipAngles.x"),
        opensim_hamner=_ext("hip_flexion_*"),
        opensim_pose2sim=_ext("hip_flexion_*"),
        is_bilateral=True,
        is_geometric=True,
    ),
    AngleDefinition(
        name="hip_adduction",
        title="Hip adduction",
        group="leg",
        definition="Thigh against the pelvis, second angle of Z-X-Y; needs a body model.",
        zero="thigh in the sagittal plane of the pelvis",
        positive="adduction (towards the midline)",
        relative_to="parent",
        isb=_ext("hip e2"),
        plug_in_gait=_ext("*HipAngles.y"),
        opensim_hamner=_ext("hip_adduction_*"),
        opensim_pose2sim=_ext("hip_adduction_*"),
        is_bilateral=True,
    ),
    AngleDefinition(
        name="hip_rotation",
        title="Hip rotation",
        group="leg",
        definition="Thigh against the pelvis, third angle of Z-X-Y; needs a body model.",
        zero="knee axis parallel to the hip line",
        positive="internal",
        relative_to="parent",
        isb=_ext("hip e3"),
        plug_in_gait=_ext("*HipAngles.z"),
        opensim_hamner=_ext("hip_rotation_*"),
        opensim_pose2sim=_ext("hip_rotation_*"),
        is_bilateral=True,
    ),
    AngleDefinition(
        name="knee_flexion",
        title="Knee flexion",
        group="leg",
        definition="180 degrees minus the angle hip-knee-ankle.",
        zero="straight leg",
        positive="flexion",
        relative_to="parent",
        isb=_ext("knee e1"),
        plug_in_gait=_ext("*KneeAngles.x"),
        opensim_hamner=_ext("knee_angle_*", -1),
        opensim_pose2sim=_ext("knee_angle_*"),
        is_bilateral=True,
        is_geometric=True,
    ),
    AngleDefinition(
        name="ankle_dorsiflexion",
        title="Ankle dorsiflexion",
        group="leg",
        definition="Line from heel to toe against the plane at right angles to the shank; needs a "
        "body model.",
        zero="foot at a right angle to the shank",
        positive="dorsiflexion (toes up)",
        relative_to="parent",
        isb=_ext("ankle e1"),
        plug_in_gait=_ext("*AnkleAngles.x"),
        opensim_hamner=_ext("ankle_angle_*"),
        opensim_pose2sim=_ext("ankle_angle_*"),
        is_bilateral=True,
    ),
    AngleDefinition(
        name="shoulder_flexion",
        title="Shoulder flexion",
        group="arm",
        definition="Upper arm against the thorax (trunk line and shoulder line), first angle of "
        "Z-X-Y, -90 to 270 degrees; undefined with the arm straight out to the side.",
        zero="arm hanging along the trunk",
        positive="flexion (elbow forward)",
        relative_to="parent",
        plug_in_gait=_ext("*ShoulderAngles.x"),
        opensim_hamner=_ext("arm_flex_*"),
        opensim_pose2sim=_ext("arm_flex_*"),
        is_bilateral=True,
        is_geometric=True,
    ),
    AngleDefinition(
        name="shoulder_adduction",
        title="Shoulder adduction",
        group="arm",
        definition="Upper arm against the thorax, second angle of Z-X-Y.",
        zero="arm in the sagittal plane through the shoulder",
        positive="adduction (abduction is negative)",
        relative_to="parent",
        plug_in_gait=_ext("*ShoulderAngles.y", -1),
        opensim_hamner=_ext("arm_add_*"),
        opensim_pose2sim=_ext("arm_add_*"),
        is_bilateral=True,
        is_geometric=True,
    ),
    AngleDefinition(
        name="shoulder_rotation",
        title="Shoulder rotation",
        group="arm",
        definition="Upper arm against the thorax, third angle of Z-X-Y; needs a body model, and "
        "can't be seen while the elbow is straight.",
        zero="elbow axis parallel to the shoulder line",
        positive="internal",
        relative_to="parent",
        plug_in_gait=_ext("*ShoulderAngles.z"),
        opensim_hamner=_ext("arm_rot_*"),
        opensim_pose2sim=_ext("arm_rot_*"),
        is_bilateral=True,
    ),
    AngleDefinition(
        name="elbow_flexion",
        title="Elbow flexion",
        group="arm",
        definition="180 degrees minus the angle shoulder-elbow-wrist.",
        zero="straight arm",
        positive="flexion",
        relative_to="parent",
        isb=_ext("elbow e1"),
        plug_in_gait=_ext("*ElbowAngles.x"),
        opensim_hamner=_ext("elbow_flex_*"),
        opensim_pose2sim=_ext("elbow_flex_*"),
        is_bilateral=True,
        is_geometric=True,
    ),
    AngleDefinition(
        name="forearm_pronation",
        title="Forearm pronation",
        group="arm",
        definition="Turn of the forearm about its length; needs a body model with a hand.",
        is_fitted=False,
        zero="palm forward (anatomical position)",
        positive="pronation",
        relative_to="parent",
        isb=_ext("elbow e3"),
        opensim_hamner=_ext("pro_sup_*"),
        opensim_pose2sim=_ext("pro_sup_*"),
        is_bilateral=True,
    ),
)
"""The convention `liftlens-1`. Signs of both OpenSim models were checked by moving each
coordinate; wherever our name is OpenSim's name, the sign is OpenSim's too. Plug-in Gait signs
follow its documentation: check them on one known movement before comparing."""

ANGLE_NAMES: tuple[str, ...] = tuple(name for row in ANGLES for name in row.names)
_ROW_OF_NAME = {name: row for row in ANGLES for name in row.names}


def describe_angle(name: str) -> AngleDefinition:
    """Return the convention of one angle, for example of `knee_flexion_l`.

    Raises
    ------
    ConfigError
        If there is no such angle.
    """
    if name not in _ROW_OF_NAME:
        raise ConfigError(f"Unknown angle {name!r}; known: {', '.join(ANGLE_NAMES)}.")
    return _ROW_OF_NAME[name]


def get_external_angle(name: str, system: System) -> ExternalAngle | None:
    """Return the counterpart of an angle in another system, with its side; None if it has none."""
    row = describe_angle(name)
    external: ExternalAngle | None = getattr(row, system)
    if external is None:
        return None
    side = name[-1] if row.is_bilateral else ""
    letter = side.upper() if system == "plug_in_gait" else side
    return ExternalAngle(external.name.replace("*", letter), external.sign)


_INTRODUCTION = """\
# Joint angles

This page is printed from the table in `engine/kinematics/angles.py`; change it there.

All angles are degrees. Left and right are the subject's. Flexion, adduction, internal rotation
and dorsiflexion are positive; bending forward (trunk, lumbar spine), bending to the right and
turning to the left are positive. Wherever an angle has the same name as an OpenSim coordinate, it
has the same sign. The names with \\* exist twice, with the suffix `_l` and `_r`. "World" means
relative to the vertical or the heading, "parent" relative to the neighbouring body segment.

A minus sign in front of a foreign name means: our value is minus theirs. A dash means that the
system has no such angle (ISB describes the shoulder by another sequence, Y-X-Y). Plug-in Gait
signs follow its documentation; check them on one known movement before comparing.

The solver `geometric` computes the angles marked in the column *Keypoints* straight from
keypoints, without a body model. Knee and elbow flexion are then unsigned: noise on a straight
limb reads as a few degrees of flexion. Hip flexion is measured against the trunk line and so
contains the flexion of the lumbar spine.

The solver `least-squares` fits a body model of constant segment lengths to the whole clip and gives
the angles marked in the column *Body model*. Knee and elbow flexion then have a sign, and hip
flexion is measured against the pelvis. Keypoints at hips and shoulders alone can't tell how the
pitch of the trunk is shared between pelvis and lumbar spine: 60 % are given to the lumbar spine,
with a standard deviation of 20 %, which is part of the stated errors of `lumbar_flexion`,
`pelvis_tilt` and `hip_flexion`. The rotation of an upper arm is left out while the elbow is too
straight to show it, that of a thigh likewise unless the foot is seen, and shoulder flexion and
rotation are left out while the arm points straight out to the side.
"""


def format_angle_table() -> str:
    """Return the convention table as a Markdown page, the text of `docs/angles.md`."""
    meaning = [
        "| Name | Angle | Definition | Zero | Positive | Relative to | Keypoints | Body model |"
    ]
    meaning.append("|---|---|---|---|---|---|---|---|")
    names = ["| Name | ISB | Plug-in Gait | OpenSim, Hamner | OpenSim, Pose2Sim |"]
    names.append("|---|---|---|---|---|")
    for row in ANGLES:
        name = f"`{row.name}`" + ("\\*" if row.is_bilateral else "")
        marks = " | ".join("yes" if m else "" for m in (row.is_geometric, row.is_fitted))
        meaning.append(
            f"| {name} | {row.title} | {row.definition} | {row.zero} | {row.positive} "
            f"| {row.relative_to} | {marks} |"
        )
        foreign = (row.isb, row.plug_in_gait, row.opensim_hamner, row.opensim_pose2sim)
        names.append(f"| {name} | " + " | ".join(map(_format_external, foreign)) + " |")
    parts = [_INTRODUCTION, "## Meaning\n", *meaning, "\n## Names in other systems\n", *names, ""]
    return "\n".join(parts)


def _format_external(external: ExternalAngle | None) -> str:
    if external is None:
        return "–"
    sign = "−" if external.sign < 0 else ""
    return f"{sign}`{external.name}`" if " " not in external.name else f"{sign}{external.name}"


# --------------------------------------------------------------------------- geometry


class TrunkAngles(NamedTuple):
    """Angles of the trunk, each of shape (T,), degrees."""

    inclination: Array
    flexion: Array
    lateral_bend: Array
    twist: Array


class _Axes(NamedTuple):
    """Three unit vectors of shape (T, 3): forward, up, right."""

    x: Array
    y: Array
    z: Array


def _points(*points: ArrayLike) -> list[Array]:
    arrays = [np.asarray(p, dtype=np.float64) for p in points]
    for array in arrays:
        if array.ndim != 2 or array.shape != arrays[0].shape or array.shape[1] != 3:
            got = ", ".join(str(a.shape) for a in arrays)
            raise ShapeError(f"Points need one common shape (T, 3), got {got}.")
    return arrays


def _dot(a: Array, b: Array) -> Array:
    return np.asarray(np.sum(a * b, axis=-1))


def _unit(vector: Array, reference: Array | None = None) -> Array:
    """Return unit vectors; NaN where `vector` is but a trace of `reference` (or zero)."""
    length = np.linalg.norm(vector, axis=-1, keepdims=True)
    whole = length if reference is None else np.linalg.norm(reference, axis=-1, keepdims=True)
    usable = (length > MIN_SHARE * whole) & (length > 0)
    return np.asarray(np.divide(vector, length, out=np.full(vector.shape, np.nan), where=usable))


def _reject(vector: Array, axis: Array) -> Array:
    """Return the part of `vector` at right angles to the unit vector `axis`."""
    return np.asarray(vector - _dot(vector, axis)[..., None] * axis)


def _angle_deg(sine: Array, cosine: Array, *, total: Array | float = 1.0) -> Array:
    """Return atan2 in degrees; NaN where both parts are but a trace of `total`."""
    usable = np.hypot(sine, cosine) > MIN_SHARE * np.asarray(total)
    return np.where(usable, np.degrees(np.arctan2(sine, cosine)), np.nan)


def _asin_deg(sine: Array) -> Array:
    return np.asarray(np.degrees(np.arcsin(np.clip(sine, -1.0, 1.0))))


def _length(vector: Array) -> Array:
    return np.asarray(np.linalg.norm(vector, axis=-1))


def _nonzero(length: Array) -> Array:
    return np.where(length > 0, length, np.nan)


def compute_forward(left_hip: ArrayLike, right_hip: ArrayLike) -> Array:
    """Compute the horizontal direction the hips face.

    Parameters
    ----------
    left_hip, right_hip
        Shape (T, 3).

    Returns
    -------
    Array
        Unit vectors of shape (T, 3), at right angles to the hip line and to the vertical; NaN
        where a hip is missing or the hip line is nearly vertical (within 3 degrees).
    """
    left, right = _points(left_hip, right_hip)
    hip_line = right - left
    to_right = _unit(_reject(hip_line, UP), hip_line)
    return np.cross(UP, to_right)


def _heading_axes(forward: Array) -> _Axes:
    x = _unit(_reject(forward, UP), forward)
    y = np.broadcast_to(UP, x.shape)
    return _Axes(x, y, np.cross(x, y))


def compute_trunk_angles(
    left_shoulder: ArrayLike,
    right_shoulder: ArrayLike,
    left_hip: ArrayLike,
    right_hip: ArrayLike,
    *,
    forward: ArrayLike | None = None,
) -> TrunkAngles:
    """Compute inclination, flexion, lateral bend and twist of the trunk.

    The trunk line runs from mid-hip to mid-shoulder; its angles are those of the Cardan
    sequence Z-X-Y in the heading frame, with flexion positive forward, lateral bend positive
    to the right and twist positive to the left.

    Parameters
    ----------
    left_shoulder, right_shoulder, left_hip, right_hip
        Shape (T, 3), world axes with Y up.
    forward
        Shape (3,) or (T, 3): the direction the subject faces, where it is known better than
        from the hips. Its vertical part is ignored; twist is then relative to it.

    Returns
    -------
    TrunkAngles
        Shape (T,) each; inclination needs no heading, the others are NaN where the heading is
        undefined, and flexion also where the trunk lies sideways.

    References
    ----------
    .. [1] Wu et al. (2002, 2005), ISB recommendations on joint coordinate systems.
    """
    ls, rs, lh, rh = _points(left_shoulder, right_shoulder, left_hip, right_hip)
    given = compute_forward(lh, rh) if forward is None else np.asarray(forward, dtype=np.float64)
    axes = _heading_axes(np.broadcast_to(given, ls.shape))
    trunk = (ls + rs) / 2 - (lh + rh) / 2
    length = _nonzero(_length(trunk))
    flexion = _angle_deg(_dot(trunk, axes.x), _dot(trunk, axes.y), total=length)
    bend = _asin_deg(_dot(trunk, axes.z) / length)
    return TrunkAngles(
        inclination=_angle_deg(_length(_reject(trunk, UP)), trunk[:, 1], total=length),
        flexion=flexion,
        lateral_bend=bend,
        twist=_twist_deg(rs - ls, axes, np.radians(flexion), np.radians(bend)),
    )


def _twist_deg(shoulder_line: Array, axes: _Axes, flexion: Array, bend: Array) -> Array:
    """Turn the shoulder line back by flexion and lateral bend; its heading is the twist."""
    x, y, z = (_dot(shoulder_line, axis) for axis in axes)
    # Flexion leans Y towards X; undoing it brings the trunk line back into the frontal plane.
    x, y = np.cos(flexion) * x - np.sin(flexion) * y, np.sin(flexion) * x + np.cos(flexion) * y
    z = np.cos(bend) * z - np.sin(bend) * y
    return _angle_deg(x, z, total=_nonzero(_length(shoulder_line)))


def compute_included_angle(proximal: ArrayLike, vertex: ArrayLike, distal: ArrayLike) -> Array:
    """Compute the angle between the two segments that meet at `vertex`.

    Parameters
    ----------
    proximal, vertex, distal
        Shape (T, 3) each.

    Returns
    -------
    Array
        Shape (T,), degrees, 0 to 180; NaN if a point is missing or two coincide.

    Raises
    ------
    ShapeError
        If the shapes differ.
    """
    a, b, c = _points(proximal, vertex, distal)
    u, v = a - b, c - b
    # atan2 keeps its precision near 0 and 180 degrees, where acos loses half its digits.
    sine, cosine = _length(np.cross(u, v)), _dot(u, v)
    return _angle_deg(sine, cosine, total=_nonzero(_length(u) * _length(v)))


def compute_hinge_flexion(proximal: ArrayLike, vertex: ArrayLike, distal: ArrayLike) -> Array:
    """Compute the flexion of a hinge such as knee or elbow: 180 degrees minus the included angle.

    Shapes as in `compute_included_angle`; 0 is straight, and there is no sign.
    """
    return 180.0 - compute_included_angle(proximal, vertex, distal)


def compute_hip_flexion(
    hip: ArrayLike,
    knee: ArrayLike,
    *,
    left_hip: ArrayLike,
    right_hip: ArrayLike,
    mid_shoulder: ArrayLike,
) -> Array:
    """Compute hip flexion of one leg against the trunk line.

    Thigh and trunk line are seen along the line from the left to the right hip, that is in the
    sagittal plane of the pelvis; flexion is the angle from the downward continuation of the trunk
    line to the thigh, forward positive. A pelvis frame is not needed, so the flexion of the lumbar
    spine is part of it: it reads higher than a hip flexion against the pelvis when the back bends.

    Parameters
    ----------
    hip, knee
        Shape (T, 3): the thigh's ends.
    left_hip, right_hip, mid_shoulder
        Shape (T, 3).

    Returns
    -------
    Array
        Shape (T,), degrees, -90 to 270; NaN where a point is missing, or the thigh or the
        trunk points along the hip line.
    """
    h, k, lh, rh, top = _points(hip, knee, left_hip, right_hip, mid_shoulder)
    z = _unit(rh - lh)
    trunk = top - (lh + rh) / 2
    y = _unit(_reject(trunk, z), trunk)
    thigh = k - h
    return _sagittal_deg(thigh, np.cross(y, z), y)


def _sagittal_deg(segment: Array, x: Array, y: Array) -> Array:
    """Return the forward angle of a hanging segment in the plane of x and y, -90 to 270."""
    length = _nonzero(_length(segment))
    angle = _angle_deg(_dot(segment, x), -_dot(segment, y), total=length)
    # No limb extends beyond 90 degrees, but arms and thighs can pass 180 on the way up.
    return np.where(angle < -90.0, angle + 360.0, angle)


def _thorax_axes(left_shoulder: Array, right_shoulder: Array, mid_hip: Array) -> _Axes:
    y = _unit((left_shoulder + right_shoulder) / 2 - mid_hip)
    line = right_shoulder - left_shoulder
    z = _unit(_reject(line, y), line)
    return _Axes(np.cross(y, z), y, z)


def compute_shoulder_angles(
    shoulder: ArrayLike,
    elbow: ArrayLike,
    *,
    left_shoulder: ArrayLike,
    right_shoulder: ArrayLike,
    mid_hip: ArrayLike,
    side: Literal["left", "right"],
) -> tuple[Array, Array]:
    """Compute flexion and adduction of one upper arm in the thorax.

    The thorax frame has Y along the trunk line and Z as near as possible to the shoulder line;
    the angles are the first two of the Cardan sequence Z-X-Y.

    Parameters
    ----------
    shoulder, elbow
        Shape (T, 3): the upper arm's ends.
    left_shoulder, right_shoulder, mid_hip
        Shape (T, 3).
    side
        Whose arm it is.

    Returns
    -------
    tuple of Array
        Flexion (-90 to 270) and adduction (-90 to 90; abduction is negative), shape (T,),
        degrees. Flexion is NaN with the arm straight out to the side.
    """
    top, tip, ls, rs, mh = _points(shoulder, elbow, left_shoulder, right_shoulder, mid_hip)
    axes = _thorax_axes(ls, rs, mh)
    arm = tip - top
    outward = _dot(arm, axes.z) * (1.0 if side == "right" else -1.0)
    return _sagittal_deg(arm, axes.x, axes.y), -_asin_deg(outward / _nonzero(_length(arm)))


def compute_upper_arm_elevation(
    shoulder: ArrayLike, elbow: ArrayLike, *, trunk: ArrayLike | None = None
) -> Array:
    """Compute the angle of the upper arm from hanging down.

    Parameters
    ----------
    shoulder, elbow
        Shape (T, 3).
    trunk
        Shape (T, 3), the trunk line upwards: elevation is then relative to its downward
        continuation. Without it, to the vertical (ISO 11226, EN 1005-4).

    Returns
    -------
    Array
        Shape (T,), degrees, 0 (hanging) to 180 (overhead).
    """
    top, tip = _points(shoulder, elbow)
    up = np.broadcast_to(UP, top.shape) if trunk is None else np.asarray(trunk, dtype=np.float64)
    return compute_included_angle(top - up, top, tip)


def compute_neck_angle(
    mid_ear: ArrayLike,
    *,
    left_shoulder: ArrayLike,
    right_shoulder: ArrayLike,
    mid_hip: ArrayLike,
) -> Array:
    """Compute the forward angle of the line mid-shoulder to mid-ear against the trunk line.

    It is not zero in a neutral posture; neck flexion is its change from there (see
    `estimate_neutral_deg`).

    Parameters
    ----------
    mid_ear, left_shoulder, right_shoulder, mid_hip
        Shape (T, 3).

    Returns
    -------
    Array
        Shape (T,), degrees, forward positive, in the sagittal plane of the thorax.
    """
    ear, ls, rs, mh = _points(mid_ear, left_shoulder, right_shoulder, mid_hip)
    axes = _thorax_axes(ls, rs, mh)
    neck = ear - (ls + rs) / 2
    return _angle_deg(_dot(neck, axes.x), _dot(neck, axes.y), total=_nonzero(_length(neck)))


def find_upright(
    trunk_inclination_deg: ArrayLike, *, max_inclination_deg: float = 20.0
) -> NDArray[np.bool_]:
    """Mark the frames of shape (T,) in which the trunk is upright; a missing value is not."""
    inclination = np.asarray(trunk_inclination_deg, dtype=np.float64)
    return np.asarray(np.nan_to_num(inclination, nan=np.inf) <= max_inclination_deg)


def estimate_neutral_deg(
    angle_deg: Array, upright: NDArray[np.bool_], *, min_frames: int = 5
) -> float:
    """Return the median angle of the upright frames; NaN with fewer than `min_frames` of them."""
    values = angle_deg[upright & np.isfinite(angle_deg)]
    return float(np.median(values)) if values.size >= min_frames else float("nan")
