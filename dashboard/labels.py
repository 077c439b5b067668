"""Wording and units: what the pages say, in one place.

What reports and the command line say too stands in `engine.wording`. Plain words for users; the
field's terms stand in the help texts.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from dataclasses import dataclass
from datetime import datetime
from typing import Any

from engine.datatypes import CheckLevel, Coupling, FlagLevel, Measurement, RiskInput
from engine.errors import ConfigError
from engine.jobs.local import JobState
from engine.kinematics.angles import describe_angle
from engine.wording import ENGLISH, LevelWords

WORDS = ENGLISH
"""The words that reports and the command line use too."""
MISSING = "not seen"


@dataclass(frozen=True)
class LevelLabel:
    """How a level is shown: never by its colour alone, but by a shape and a word too.

    `css` names colour and shape in the style sheet.
    """

    word: str
    meaning: str
    css: str


_CSS = {FlagLevel.HIGH: "high", FlagLevel.REVIEW: "review", FlagLevel.OK: "ok", None: "none"}
_CHECK_CSS = {CheckLevel.GREEN: "ok", CheckLevel.AMBER: "review", CheckLevel.RED: "high"}


def _label(words: LevelWords, css: str) -> LevelLabel:
    return LevelLabel(words.word, words.meaning, css)


LEVELS: dict[FlagLevel, LevelLabel] = {
    level: _label(words, _CSS[level]) for level, words in WORDS.levels.items() if level is not None
}
NOT_JUDGED = _label(WORDS.levels[None], _CSS[None])

REVIEWS = WORDS.reviews
"""What a person said to a flag."""
ANSWERS: dict[str, str] = {
    "accepted": "I agree",
    "rejected": "I reject it",
    "open": "Take my answer back",
}
"""What a person can say to a flag."""

CORRECTIONS: dict[str, str] = {
    "lift": "A lift",
    "sides": "Left and right",
    "person": "The person",
}
"""What a person can put right."""
LIMBS: dict[str, str] = {
    "body": "The whole body",
    "arms": "The arms, with the shoulders",
    "forearms": "Elbows and hands",
    "legs": "The legs, with the hips",
    "shins": "Knees and feet",
}
"""What can change sides together."""

CHECK_LEVELS: dict[CheckLevel, LevelLabel] = {
    level: _label(words, _CHECK_CSS[level]) for level, words in WORDS.checks.items()
}
SOURCES: dict[str, str] = {
    "person": "from the moving person",
    "board": "with a printed board",
    "points": "from points of known size",
    "file": "taken from a file",
}
SYNC_METHODS: dict[str, str] = {
    "motion": "by the movement",
    "audio": "by the sound",
    "both": "by movement and sound",
    "user": "entered by you",
}
EXPORTS: dict[str, str] = {
    "csv": "Joint angles with their errors",
    "trc": "Joints for OpenSim and others",
    "mot": "Joint angles for OpenSim",
    "c3d": "Joints and angles for motion analysis",
    "bvh": "Moving figure for animation",
}
CAMERA_ADVICE = (
    "Two phones measure distances, twisting and the far arm much better than one. Usually nothing "
    "needs to be calibrated: LiftLens finds both cameras from the moving person and says how sure "
    "it is. Where cameras stay in place, or every centimetre counts, calibrate them once with a "
    "printed board (`liftlens calibrate`) and keep the file here."
)

COUPLINGS: dict[Coupling, str] = {
    Coupling.GOOD: "Good: handles or cut-outs that the whole hand fits into",
    Coupling.FAIR: "Fair: no handles, but the fingers bend under the load",
    Coupling.POOR: "Poor: bulky, slippery, sharp or sagging; hard to hold",
}

PROVENANCE = WORDS.provenance

JOB_STATES: dict[JobState, str] = {
    JobState.QUEUED: "Waiting for its turn",
    JobState.STARTING: "Starting",
    JobState.RUNNING: "Running",
    JobState.DONE: "Done",
    JobState.FAILED: "Failed",
    JobState.CANCELLED: "Cancelled",
}

JOINTS: dict[str, tuple[str, ...]] = {
    WORDS.joints["trunk"]: ("trunk_flexion", "trunk_lateral_bend", "trunk_twist"),
    WORDS.joints["lower_back"]: ("lumbar_flexion", "lumbar_bending", "lumbar_rotation"),
    WORDS.joints["pelvis"]: ("pelvis_tilt", "pelvis_list", "pelvis_rotation"),
    WORDS.joints["neck"]: ("neck_flexion",),
    WORDS.joints["hips"]: ("hip_flexion_l", "hip_flexion_r"),
    WORDS.joints["hips_sideways"]: ("hip_adduction_l", "hip_adduction_r"),
    WORDS.joints["knees"]: ("knee_flexion_l", "knee_flexion_r"),
    WORDS.joints["ankles"]: ("ankle_dorsiflexion_l", "ankle_dorsiflexion_r"),
    WORDS.joints["shoulders"]: ("shoulder_flexion_l", "shoulder_flexion_r"),
    WORDS.joints["shoulders_sideways"]: ("shoulder_adduction_l", "shoulder_adduction_r"),
    WORDS.joints["elbows"]: ("elbow_flexion_l", "elbow_flexion_r"),
}

PLAIN_ANGLES = WORDS.angles

PHASES: dict[str, str] = {
    "reach": "Reach",
    "lift_off": "Lift-off",
    "rise": "Lift",
    "set_down": "Set-down",
    "return": "Return",
    "descent": "Down",
    "bottom": "Deepest",
    "ascent": "Up",
}
PHASE_HELP: dict[str, str] = {
    "reach": "From standing until the load starts to move",
    "lift_off": "The moment the load starts to move",
    "rise": "While the load moves",
    "set_down": "The moment the load stops",
    "return": "From letting go until standing still",
    "descent": "From standing into the movement",
    "bottom": "Where at least 90 % of the depth is kept",
    "ascent": "Back to standing",
}

_COVERAGE_HELP = {
    "measured": "Samples the estimator saw and the checks kept.",
    "repaired": "Samples whose left and right had been swapped.",
    "filled": "Short gaps that were bridged.",
    "missing": "Left empty: nothing is invented.",
}
COVERAGE: dict[str, tuple[str, str]] = {
    key: (word, _COVERAGE_HELP[key]) for key, word in WORDS.coverage.items()
}

FACTORS: dict[str, tuple[str, str]] = {
    "HM": ("Reach (H)", "How far the hands are in front of the ankles."),
    "VM": ("Height (V)", "How high the hands are above the floor."),
    "DM": ("Travel (D)", "How far the load moves up or down."),
    "AM": ("To the side (A)", "How far the load is to the side of straight ahead."),
    "FM": ("Frequency (F)", "How often and how long the work goes on."),
    "CM": ("Grip (C)", "How well the hands can hold the load."),
}

VALUES: dict[str, str] = {"rnle": "Lifting index"}
"""What the number of a method is called, where the method itself does not say."""

INPUTS: dict[str, str] = {
    "D": "Travel (D)",
    "H at origin": "Reach at the start (H)",
    "V at origin": "Height at the start (V)",
    "A at origin": "To the side at the start (A)",
    "H at destination": "Reach at the end (H)",
    "V at destination": "Height at the end (V)",
    "A at destination": "To the side at the end (A)",
    "duration class": "Duration class",
    "significant control": "Placed with care (significant control)",
    "coupling": "Grip (coupling)",
}

HELP: dict[str, str] = {
    "keep_calibration": (
        "For later films with both phones left exactly where they are, at the same zoom."
    ),
    "calibration_file": (
        "Cameras calibrated by LiftLens, Pose2Sim, anipose, Qualisys or OpenCap; it is read on "
        "this computer only."
    ),
    "video": "One person who lifts, filmed from the side; a few seconds to a few minutes.",
    "two_cameras": (
        "A second phone, 70 to 110 degrees round the person from the first, makes distances, "
        "twisting and the far arm much more certain. Both must see the whole person."
    ),
    "calibration": (
        "Where the cameras stand and what their lenses do. Found from the moving person it needs "
        "nothing but the body height; cameras calibrated beforehand are more exact."
    ),
    "offset_s": (
        "Seconds to add to the times of the second video to get those of the first. Left empty, "
        "it is found from the movement and from the sound."
    ),
    "label": "Shown in the list of trials, for example: crate to shelf.",
    "site": "Where the work is done; the overview compares sites.",
    "job": "Which work it is; trials of one job are judged and compared together.",
    "subject": "A pseudonym, never the name of the person.",
    "stature": (
        "Body height in metres, without shoes. It sets the scale of everything that is "
        "measured. Left empty, 1.70 m is assumed and the stated errors grow."
    ),
    "mass": "Optional. Methods that estimate the load on the spine need it.",
    "sex": "Optional. Some methods have limits that differ between women and men.",
    "load": "Weight of what is lifted. Without it, only the limit is stated, not the index.",
    "hands": "The lifting equation holds for lifts with both hands.",
    "coupling": (
        "How well the hands can hold the load (coupling). In doubt choose the worse one. "
        "Left open, fair is assumed."
    ),
    "frequency": "Lifts per minute, averaged over 15 minutes of usual work.",
    "duration": "Hours of such lifting in one stretch, without the recovery after it.",
    "recovery": (
        "Hours of light work or rest that follow the stretch. Long enough, they allow the "
        "limits for short work."
    ),
    "control": (
        "Must the load be placed with care: guided, held still or gripped anew at the end "
        "(significant control)? Then the end of the lift is judged like its start."
    ),
    "before": (
        "The angles straight from the joints as they were seen: not cleaned, not filled, not "
        "smoothed. Marks on the thick curve show samples that were filled in, and samples whose "
        "left and right were exchanged."
    ),
    "form_score": (
        "100: every difference lies within the measurement error. Every 15° beyond it, root mean "
        "square over angles and time, halve the score."
    ),
    "lifting_index": (
        "Load divided by the recommended weight limit (Revised NIOSH Lifting Equation). Up to "
        "1 the design goal is met; the higher, the more workers are at raised risk. The range "
        "is about 95 %, from the errors of what was measured."
    ),
}


def format_number(value: float | None, digits: int = 0) -> str:
    """Return a number with a true minus sign, or a dash where there is none."""
    if value is None or math.isnan(value):
        return "–"
    if math.isinf(value):
        return "∞"
    text = f"{value:.{digits}f}"
    return text.replace("-", "−") if float(text) else f"{0:.{digits}f}"


US_UNITS: dict[str, tuple[float, str]] = {
    "kg": (2.204_622_6, "lb"),
    "cm": (1 / 2.54, "in"),
    "m": (39.370_079, "in"),
}
"""What one metric unit is in US customary ones."""
_shown = {"units": "metric"}


def use_units(units: str) -> None:
    """Choose what stands beside metric values: nothing (`metric`) or US customary ones (`us`).

    One server has one library and so one choice for all who use it.
    """
    _shown["units"] = units


def add_us_units(value: float | None, unit: str) -> str:
    """Return a value in US customary units in brackets, where they are wanted and there are any."""
    if _shown["units"] != "us" or unit not in US_UNITS or value is None or not math.isfinite(value):
        return ""
    factor, name = US_UNITS[unit]
    return f" ({format_number(factor * value, 0 if abs(factor * value) >= 10 else 1)} {name})"


def format_measurement(measured: Measurement, unit: str, digits: int = 0) -> str:
    """Return value ± standard error with the unit."""
    if measured.is_missing:
        return MISSING
    error = "" if math.isnan(measured.sigma) else f" ± {format_number(measured.sigma, digits)}"
    gap, beside = "" if unit == "°" else " ", add_us_units(measured.value, unit)
    return f"{format_number(measured.value, digits)}{error}{gap}{unit}{beside}"


def format_bytes(size: int) -> str:
    """Return a size in the largest unit that leaves at least 1."""
    number, unit = float(size), "bytes"
    for larger in ("kB", "MB", "GB", "TB"):
        if number < 1000:
            break
        number, unit = number / 1000, larger
    return f"{number:.0f} {unit}" if number >= 100 or unit == "bytes" else f"{number:.1f} {unit}"


def format_index(value: float) -> str:
    """Return a lifting index to one decimal."""
    return format_number(value, 1)


def format_interval(interval: tuple[float, float], digits: int = 1) -> str:
    """Return an interval, empty where it is unknown."""
    low, high = interval
    if math.isnan(low) or math.isnan(high):
        return ""
    if math.isinf(high):
        return "no limit left" if math.isinf(low) else f"{format_number(low, digits)} or more"
    return f"{format_number(low, digits)} to {format_number(high, digits)}"


def format_value(value: Any, unit: str = "") -> str:
    """Return any input of a method in words."""
    if value is None:
        return "–"
    if isinstance(value, bool):
        return "yes" if value else "no"
    is_number = isinstance(value, int | float)
    text = f"{value:.4g}" if is_number else str(value)
    return f"{text} {unit}".strip() + (add_us_units(value, unit) if is_number else "")


def format_input(item: RiskInput) -> str:
    """Return an input of a method with its error and unit."""
    unit = {"deg": "°", "1/min": "per minute"}.get(item.unit, item.unit)
    if isinstance(item.value, float) and not math.isnan(item.sigma):
        return format_measurement(Measurement(item.value, item.sigma), unit, 1)
    return format_value(item.value, unit)


def format_time(moment: datetime) -> str:
    """Return a local time of day and date."""
    return f"{moment.astimezone():%d %b %Y, %H:%M}".lstrip("0")


def format_span(seconds: float) -> str:
    """Return a length of time in words."""
    whole = round(seconds)
    return f"{whole} s" if whole < 60 else f"{whole // 60} min {whole % 60:02d} s"


def format_window(start_s: float, end_s: float) -> str:
    """Return when something happens in the video."""
    if math.isnan(start_s):
        return ""
    return f"{start_s:.1f} s to {end_s:.1f} s"


DEGREES = re.compile(r"(?<=\d) deg(rees)?\b")


def typeset(text: str) -> str:
    """Return plain-text arithmetic with its true signs."""
    text = text.replace(" -> ", " → ").replace(" x ", " × ").replace("(x ", "(×\u00a0")
    return DEGREES.sub("°", text.replace(" - ", " − "))


def sentence(text: str) -> str:
    """Return a reason as a sentence."""
    text = text.strip()
    if not text:
        return text
    return text[0].upper() + text[1:] + ("" if text[-1] in ".!?" else ".")


def count(number: int, noun: str) -> str:
    """Return a number with its noun, in the right number."""
    return f"{number} {noun}" if number == 1 else f"{number} {noun}s"


def name_angle(name: str) -> str:
    """Return what a curve is called: left and right are the subject's."""
    if name in PLAIN_ANGLES:
        return PLAIN_ANGLES[name]
    side = {"_l": "left", "_r": "right"}.get(name[-2:], "")
    try:
        title = describe_angle(name).title
    except ConfigError:
        title = name.removesuffix("_l").removesuffix("_r").replace("_", " ").capitalize()
    return f"{title}, {side}" if side else title


def name_stage(stage: str) -> str:
    """Return the running step in plain words."""
    return WORDS.name_stage(stage)


def name_method(method: str) -> str:
    """Return what a risk method is called."""
    return WORDS.name_method(method)


def format_value_cm(value: float | None) -> str:
    """Return a length in whole centimetres."""
    return f"{format_number(value)} cm{add_us_units(value, 'cm')}"


def format_factor_input(name: str, values: Mapping[str, Any], details: Mapping[str, Any]) -> str:
    """Return what a multiplier of the lifting equation follows from."""
    return {
        "HM": lambda: format_value_cm(values["H_cm"]),
        "VM": lambda: format_value_cm(values["V_cm"]),
        "DM": lambda: format_value_cm(details["D_cm"]),
        "AM": lambda: f"{format_number(values['A_deg'])}°",
        "FM": lambda: f"{details['frequency_per_min']:g}/min, {details['duration_class']}",
        "CM": lambda: str(details["coupling"]),
    }[name]()


def name_view(azimuth_deg: float) -> str:
    """Return from where the person was filmed; 0° is the front, 90° the right, 180° the back."""
    if math.isnan(azimuth_deg):
        return "unknown"
    turned = (azimuth_deg + 180) % 360 - 180
    side = "right" if turned > 0 else "left"
    words = (
        "the front",
        f"half the front, half the {side}",
        f"the {side}",
        f"half the back, half the {side}",
        "the back",
    )
    return f"{words[round(abs(turned) / 45)]} ({abs(turned):.0f}° from straight ahead)"


# --------------------------------------------------------------------------- reference recordings

AXES: dict[tuple[str, str, str], str] = {
    ("x", "y", "z"): "(Y up)",
    ("z", "y", "-x"): "(Y up)",
    ("-x", "y", "-z"): "(Y up)",
    ("-z", "y", "x"): "(Y up)",
    ("x", "z", "-y"): "(Z up)",
    ("y", "z", "x"): "(Z up)",
    ("-x", "z", "y"): "(Z up)",
    ("-y", "z", "-x"): "(Z up)",
}
"""Usual axes of laboratories: those that point to the subject's front, up, and right."""

ANGLE_SOURCES = {
    "computed": (
        "computed from the markers' joint centres by the solver of the video ({solver}): the same "
        "definitions on both sides"
    ),
    "recorded": "as the recording has them, signs converted; definitions may differ",
}

POSITION_ALIGNMENTS = {
    "none": "after one rigid move of the whole trial",
    "root": "with both mid-hips on each other in every frame (MPJPE)",
    "procrustes": "moved, turned and scaled in every frame (PA-MPJPE)",
}

MAIN_STATISTICS = (
    ("Angle", ""),
    ("Mean difference", "Bias: mean of video minus reference over all frames."),
    ("Mean absolute", "Mean absolute error (MAE)."),
    ("RMSE", "Root mean square error: large errors count more."),
    ("without offset", "Centred RMSE: what is left after the constant difference is taken out."),
    ("Limits of agreement", "Bland-Altman: about 95 % of the frames differ by this much."),
    ("95 % within", "The difference that 95 % of the frames do not exceed."),
    ("Frames", "Frames in which both exist."),
    ("worth", "Effective sample size: neighbouring frames are near-copies of each other."),
)

CURVE_STATISTICS = (
    ("Angle", ""),
    ("r", "Correlation of both curves; blind to a constant difference and to scale."),
    ("CMC", "Coefficient of multiple correlation (Ferrari); none where the angle hardly moves."),
    ("LFM slope · R²", "Linear fit of the video on the reference."),
    ("Largest", "Largest absolute difference."),
    ("ROM error", "Range of motion of the video minus that of the reference."),
    ("Peak error", "Highest value of the video minus that of the reference."),
    ("Peak later by", "Time of the video's peak minus that of the reference."),
    ("of excursion", "Mean absolute error as a share of the reference's range of motion."),
    ("Slope of error", "Proportional bias: change of the difference per degree."),
)

TEST_STATISTICS = (
    ("Angle", ""),
    ("Mean difference, 95 %", "Interval of the bias by resampling persons or trials."),
    ("t-test p", "Paired t-test on the mean of each person or trial."),
    ("p, Holm", "The same, adjusted for the number of angles."),
    ("p on frames", "Paired t-test on frames with the effective sample size."),
    ("Equivalence p, 2° · 5°", "Two one-sided tests: small p shows agreement within the margin."),
    ("ICC(2,1)", "Intraclass correlation of the range of motion over trials."),
    ("MDC", "Minimal detectable change of the range of motion."),
    ("Curve test p", "Sign-flip permutation test of whole curves."),
)


# --------------------------------------------------------------------------- player

PLAYER: dict[str, Any] = {
    "title": "Video, skeleton, curves and flags on one time axis",
    "video": "Annotated video {n}; heads are blurred",
    "view": "View {n}",
    "video_lost": "This video can't be played here. Everything else still moves with the cursor.",
    "body": "Skeleton in three dimensions. Drag to turn it; the buttons give fixed views.",
    "views": "Where the skeleton is seen from",
    "view_oblique": "3/4",
    "view_side": "Side",
    "view_front": "Front",
    "view_top": "Top",
    "view_room": "Cameras",
    "nearer": "Nearer",
    "farther": "Farther",
    "left": "left",
    "right": "right",
    "doubtful": "uncertain or filled in",
    "solid": "Solid",
    "solid_help": "A solid figure; without a graphics card the cursor then moves slowly",
    "no_3d": "This browser shows no 3D graphics (WebGL); the skeleton is drawn flat.",
    "controls": "Playing",
    "play": "Play (space)",
    "pause": "Pause (space)",
    "back": "One picture back (left arrow)",
    "forward": "One picture on (right arrow)",
    "speed": "Speed",
    "readout": "{time} of {end} s · picture {frame}",
    "frame": "picture",
    "cursor": "Time",
    "time": "Time, s",
    "lifts": "Lifts",
    "flags": "Flags",
    "notes": "Notes",
    "note": "Note",
    "reach": "Reaching for the load",
    "return": "Coming back up",
    "no_lift": "No lift was found.",
    "whole_trial": "Whole video:",
    "at_flag": "{word}: {what}",
    "jump": "Jump there.",
    "joints": "Curves shown",
    "no_angle": "No joint angle could be measured.",
    "not_seen": MISSING,
    "curve": "{label}: from {low}° to {high}°, missing {missing} % of the time.",
    "curve_missing": "{label}: not seen.",
    "keys": "Keys",
    "key_list": [
        ["Space, K", "play or pause"],
        ["← →", "one picture back or on"],
        ["Shift + ← →", "ten pictures"],
        ["J L, ↓ ↑", "slower, faster"],
        ["Home, End", "start, end"],
        ["1 to 9", "jump to a flag"],
        ["?", "show or hide the keys"],
    ],
}
"""What the player says; the words in braces are filled in by it."""

PLAYER_ACTIONS: dict[str, str] = {
    "note": "Note at this moment",
    "from": "Correct from here",
    "to": "Correct to here",
}
"""What can be asked for at the time of the cursor."""
