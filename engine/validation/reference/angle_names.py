"""Names and signs of joint angles in other systems.

Mirrors the convention table of `engine.kinematics.angles`, which step packages don't import; a
test holds both alike.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

__all__ = ["ANGLE_SYSTEMS", "OUR_ANGLES", "AngleSource", "match_angles"]

OPENSIM = "opensim"
PLUG_IN_GAIT = "plug_in_gait"
OURS = "liftlens"

_BILATERAL = (
    "hip_flexion",
    "hip_adduction",
    "hip_rotation",
    "knee_flexion",
    "ankle_dorsiflexion",
    "shoulder_flexion",
    "shoulder_adduction",
    "shoulder_rotation",
    "elbow_flexion",
    "forearm_pronation",
)
_SINGLE = (
    "trunk_inclination",
    "trunk_flexion",
    "trunk_lateral_bend",
    "trunk_twist",
    "lumbar_flexion",
    "lumbar_bending",
    "lumbar_rotation",
    "pelvis_tilt",
    "pelvis_list",
    "pelvis_rotation",
    "neck_flexion",
)
OUR_ANGLES: tuple[str, ...] = (*_SINGLE, *(f"{n}_{s}" for n in _BILATERAL for s in "lr"))
"""Every angle of our convention."""


@dataclass(frozen=True)
class AngleSource:
    """Where one of our angles comes from: ``ours = sign * column``."""

    ours: str
    column: str
    sign: int


_OPENSIM_NAMES: Mapping[str, tuple[tuple[str, int], ...]] = {
    "lumbar_flexion": (("lumbar_extension", -1), ("L5_S1_Flex_Ext", -1)),
    "lumbar_bending": (("lumbar_bending", 1), ("L5_S1_Lat_Bending", 1)),
    "lumbar_rotation": (("lumbar_rotation", 1), ("L5_S1_axial_rotation", 1)),
    "pelvis_tilt": (("pelvis_tilt", 1),),
    "pelvis_list": (("pelvis_list", 1),),
    "pelvis_rotation": (("pelvis_rotation", 1),),
    "hip_flexion_*": (("hip_flexion_*", 1),),
    "hip_adduction_*": (("hip_adduction_*", 1),),
    "hip_rotation_*": (("hip_rotation_*", 1),),
    # Positive in most models, negative in Hamner's; told apart by the way the knee bends.
    "knee_flexion_*": (("knee_angle_*", 1), ("knee_flexion_*", 1)),
    "ankle_dorsiflexion_*": (("ankle_angle_*", 1), ("ankle_flexion_*", 1)),
    "shoulder_flexion_*": (("arm_flex_*", 1),),
    "shoulder_adduction_*": (("arm_add_*", 1),),
    "shoulder_rotation_*": (("arm_rot_*", 1),),
    "elbow_flexion_*": (("elbow_flex_*", 1), ("elbow_flexion_*", 1)),
    "forearm_pronation_*": (("pro_sup_*", 1), ("pro_sup_*_", 1)),
}
_PLUG_IN_GAIT_NAMES: Mapping[str, tuple[tuple[str, int], ...]] = {
    "trunk_flexion": (("LThoraxAngles.x", 1),),
    "trunk_lateral_bend": (("LThoraxAngles.y", 1),),
    "lumbar_flexion": (("LSpineAngles.x", 1),),
    "lumbar_bending": (("LSpineAngles.y", -1),),
    "lumbar_rotation": (("LSpineAngles.z", 1),),
    "pelvis_tilt": (("LPelvisAngles.x", -1),),
    "pelvis_list": (("LPelvisAngles.y", 1),),
    "pelvis_rotation": (("LPelvisAngles.z", -1),),
    "neck_flexion": (("LNeckAngles.x", 1),),
    "hip_flexion_*": (("*HipAngles.x", 1),),
    "hip_adduction_*": (("*HipAngles.y", 1),),
    "hip_rotation_*": (("*HipAngles.z", 1),),
    "knee_flexion_*": (("*KneeAngles.x", 1),),
    "ankle_dorsiflexion_*": (("*AnkleAngles.x", 1),),
    "shoulder_flexion_*": (("*ShoulderAngles.x", 1),),
    "shoulder_adduction_*": (("*ShoulderAngles.y", -1),),
    "shoulder_rotation_*": (("*ShoulderAngles.z", 1),),
    "elbow_flexion_*": (("*ElbowAngles.x", 1),),
}


def _expand(
    names: Mapping[str, tuple[tuple[str, int], ...]], *, upper: bool
) -> tuple[AngleSource, ...]:
    sources = []
    for ours, columns in names.items():
        for side in "lr" if ours.endswith("*") else "-":
            letter = side.upper() if upper else side
            for column, sign in columns:
                sources.append(
                    AngleSource(ours.replace("*", side), column.replace("*", letter), sign)
                )
    return tuple(sources)


ANGLE_SYSTEMS: Mapping[str, tuple[AngleSource, ...]] = {
    OURS: tuple(AngleSource(name, name, 1) for name in OUR_ANGLES),
    OPENSIM: _expand(_OPENSIM_NAMES, upper=False),
    PLUG_IN_GAIT: _expand(_PLUG_IN_GAIT_NAMES, upper=True),
}
"""Angle names by system. Names alone decide which system a file uses."""


def match_angles(columns: Sequence[str]) -> tuple[str, tuple[AngleSource, ...]]:
    """Find the system that explains most columns, and what each of our angles comes from.

    Returns
    -------
    tuple
        Name of the system and the sources found; an empty name if no column is known.
    """
    own = {column.rpartition(":")[2].lower(): column for column in columns}
    best: tuple[str, tuple[AngleSource, ...]] = ("", ())
    for system, sources in ANGLE_SYSTEMS.items():
        found: dict[str, AngleSource] = {}
        for source in sources:
            key = source.column.lower()
            if key in own:
                found.setdefault(source.ours, AngleSource(source.ours, own[key], source.sign))
        if len(found) > len(best[1]):
            best = (system, tuple(found.values()))
    return best
