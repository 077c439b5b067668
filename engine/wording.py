"""What users read: the words for levels, methods, stages, angles and states, in one place.

Dashboard, reports and the command line take them from here. A further language is one more entry of
`VOCABULARIES`; what it leaves out stands in English, so that a half translated program still
speaks. Keys are those of the engine's types.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from engine.datatypes import CheckLevel, FlagLevel, Provenance
from engine.errors import ConfigError

__all__ = [
    "ENGLISH",
    "LEVEL_COLOURS",
    "VOCABULARIES",
    "LevelWords",
    "Vocabulary",
    "select_vocabulary",
]


@dataclass(frozen=True)
class LevelWords:
    """A level in a word, and in a sentence."""

    word: str
    meaning: str


@dataclass(frozen=True)
class Vocabulary:
    """All words of one language.

    Parameters
    ----------
    language
        Its code, as in ISO 639-1.
    levels
        Of flags; None: nothing could be judged.
    checks
        Of checks of a calibration.
    reviews
        What a person said to a flag.
    methods
        What the risk methods are called, and the further sources of flags.
    stages
        What an assessment does, by the key it reports.
    provenance
        Where a value comes from.
    coverage
        What became of the joint samples.
    angles
        Angles that have a plainer name than the table of angles gives them.
    joints
        What the joints are called under which angles are grouped.
    months
        Short names, January first.
    """

    language: str
    levels: Mapping[FlagLevel | None, LevelWords]
    checks: Mapping[CheckLevel, LevelWords]
    reviews: Mapping[str, str]
    methods: Mapping[str, str]
    stages: Mapping[str, str]
    provenance: Mapping[Provenance, str]
    coverage: Mapping[str, str]
    angles: Mapping[str, str]
    joints: Mapping[str, str]
    months: tuple[str, ...]

    def name_method(self, method: str) -> str:
        """Return what a method is called; its key in plain letters where it has no name."""
        return self.methods.get(method, method.replace("_", " "))

    def name_stage(self, stage: str) -> str:
        """Return what is being done; its key in plain letters where it has no name."""
        return self.stages.get(stage, stage.replace("_", " ").capitalize())

    def translate(self, language: str, **parts: Any) -> Vocabulary:
        """Return the vocabulary of another language; what `parts` leave out stays as here.

        Parameters
        ----------
        language
            Its code.
        parts
            Mappings by the names of the fields, whole or not; `months` all twelve.
        """
        merged: dict[str, Any] = {
            name: {**getattr(self, name), **part} if isinstance(part, Mapping) else tuple(part)
            for name, part in parts.items()
        }
        return dataclasses.replace(self, language=language, **merged)


ENGLISH = Vocabulary(
    language="en",
    levels={
        FlagLevel.HIGH: LevelWords("High risk", "Change the work before it goes on."),
        FlagLevel.REVIEW: LevelWords("Needs review", "A professional should look at this."),
        FlagLevel.OK: LevelWords("No concern", "Nothing to act on was found."),
        None: LevelWords("Not judged", "There is not enough to judge this."),
    },
    checks={
        CheckLevel.GREEN: LevelWords("Trusted", "The cameras agree with the world."),
        CheckLevel.AMBER: LevelWords("With care", "Something about the cameras is doubtful."),
        CheckLevel.RED: LevelWords("Not trusted", "These cameras can't be right."),
    },
    reviews={"accepted": "accepted", "rejected": "rejected", "open": "not reviewed"},
    methods={
        "rnle": "NIOSH lifting equation",
        "rnle_job": "Lifting index of the job",
        "rnle_vli": "Variable lifting index",
        "reba": "REBA",
        "rula": "RULA",
        "owas": "OWAS",
        "posture_zones": "Posture zones",
        "acgih": "ACGIH limit",
        "iso11228": "ISO 11228-1",
        "kim_lhc": "Key indicator method",
        "l5s1": "Low-back load",
        "l5s1_disc": "Low-back load, disc",
        "lifft": "LiFFT",
        "lm_mmh": "Liberty Mutual",
        "lmm": "Lumbar motion",
        "shoulder_tool": "Shoulder Tool",
        "coverage": "Measurement",
        "lifts": "Lifts",
        "methods": "Methods",
        "disagreement": "All methods",
    },
    stages={
        "": "Waiting",
        "start": "Starting",
        "probe": "Looking at the video",
        "video": "Reading the video",
        "subject": "Finding the person",
        "pose": "Following the person's joints",
        "cameras": "Placing the person in the room",
        "scene": "Placing the person in the room",
        "correction": "Cleaning the movement",
        "kinematics": "Working out the joint angles",
        "events": "Finding the lifts",
        "ergonomics": "Judging the lifts",
        "risk": "Judging the lifts",
        "overlay": "Drawing the annotated video",
        "write": "Saving the result",
        "calibrating": "Finding out where the cameras stand",
        "estimators": "Comparing the estimators",
    },
    provenance={
        Provenance.MEASURED: "measured in the video",
        Provenance.USER: "entered by you",
        Provenance.DERIVED: "calculated",
        Provenance.ASSUMED: "assumed",
    },
    coverage={
        "measured": "seen",
        "repaired": "sides put right",
        "filled": "filled in",
        "missing": "not seen",
    },
    angles={
        "trunk_flexion": "Forward bend",
        "trunk_lateral_bend": "Sideways bend",
        "trunk_twist": "Twist",
        "lumbar_flexion": "Forward bend of the lower back",
        "lumbar_bending": "Sideways bend of the lower back",
        "lumbar_rotation": "Twist of the lower back",
    },
    joints={
        "trunk": "Trunk",
        "lower_back": "Lower back",
        "pelvis": "Pelvis",
        "neck": "Neck",
        "hips": "Hips",
        "hips_sideways": "Hips, sideways",
        "knees": "Knees",
        "ankles": "Ankles",
        "shoulders": "Shoulders",
        "shoulders_sideways": "Shoulders, sideways",
        "elbows": "Elbows",
    },
    months=("Jan", "Feb", "Mar", "Apr", "May", "Jun", "Jul", "Aug", "Sep", "Oct", "Nov", "Dec"),
)

VOCABULARIES: Mapping[str, Vocabulary] = {"en": ENGLISH}

LEVEL_COLOURS: Mapping[FlagLevel | None, str] = {
    FlagLevel.HIGH: "#b3350a",
    FlagLevel.REVIEW: "#8a5a00",
    FlagLevel.OK: "#00704f",
    None: "#566472",
}
"""By day, dark enough for text on white; a shape and a word always stand beside them."""


def select_vocabulary(language: str) -> Vocabulary:
    """Return the words of a language.

    Raises
    ------
    ConfigError
        If there are none.
    """
    found = VOCABULARIES.get(language.strip().lower())
    if found is None:
        raise ConfigError(
            f"The language must be one of {', '.join(VOCABULARIES)}, got {language!r}."
        )
    return found
