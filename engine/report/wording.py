"""What the reports say, per language, and how they write numbers.

A further language is one more entry of `LANGUAGES`. What the assessment itself wrote (flags,
reasons, warnings) stays in the words it was stored with.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from datetime import UTC, datetime

from engine import wording
from engine.datatypes import FlagLevel, Measurement
from engine.errors import ConfigError
from engine.wording import Vocabulary

__all__ = ["LANGUAGES", "NO_BREAK", "Words", "select_words"]

NO_BREAK = "\u00a0"


@dataclass(frozen=True)
class Words:
    """All fixed text of one language: the program's words, and what only reports say."""

    vocabulary: Vocabulary
    text: Mapping[str, str]

    @property
    def language(self) -> str:
        """Its code."""
        return self.vocabulary.language

    def __getitem__(self, key: str) -> str:
        """Return one text; in English where this language has none."""
        return self.text[key] if key in self.text else ENGLISH.text[key]

    def level(self, level: FlagLevel | None) -> str:
        """Return the word of a level; None: nothing could be judged."""
        return self.vocabulary.levels[level].word

    def meaning(self, level: FlagLevel | None) -> str:
        """Return what a level means."""
        return self.vocabulary.levels[level].meaning

    def method(self, name: str) -> str:
        """Return what a method is called."""
        return self.vocabulary.name_method(name)

    def count(self, number: int, noun: str) -> str:
        """Return a number with its noun, in the right number."""
        return f"{number} {self[noun if number == 1 else f'{noun}s']}"

    def number(self, value: float, digits: int = 0) -> str:
        """Return a number with a true minus sign; words where there is none."""
        if math.isnan(value):
            return self["missing"]
        if math.isinf(value):
            return self["infinite"]
        shown = f"{value:.{digits}f}"
        return shown.replace("-", "−") if float(shown) else f"{0:.{digits}f}"

    def quantity(self, value: float, unit: str = "", digits: int = 0) -> str:
        """Return a number with its unit; no unit after words."""
        shown = self.number(value, digits)
        if not math.isfinite(value) or not unit:
            return shown
        return f"{shown}{'' if unit == '°' else NO_BREAK}{unit}"

    def interval(self, interval: tuple[float, float], digits: int = 0) -> str:
        """Return an interval of about 95 %; words where it is unknown or without end."""
        low, high = interval
        if math.isnan(low) or math.isnan(high):
            return self["range_unknown"]
        if math.isinf(low):
            return self["infinite"]
        if math.isinf(high):
            return self["or_more"].format(low=self.number(low, digits))
        return self["from_to"].format(low=self.number(low, digits), high=self.number(high, digits))

    def measurement(self, measured: Measurement, unit: str, digits: int = 0) -> str:
        """Return a measured length or angle with its interval of about 95 %; never below 0."""
        if measured.is_missing:
            return self["missing"]
        shown = self.quantity(measured.value, unit, digits)
        low, high = measured.interval()
        if math.isnan(low):
            return shown
        return f"{shown} ({self.interval((max(0.0, low), max(0.0, high)), digits)})"

    def date(self, moment: datetime | None, *, with_time: bool = False) -> str:
        """Return a date; the time is UTC."""
        if moment is None:
            return self["no_date"]
        moment = moment.astimezone(UTC)
        day = f"{moment.day} {self.vocabulary.months[moment.month - 1]} {moment.year}"
        return f"{day}, {moment:%H:%M} UTC" if with_time else day

    def window(self, start_s: float, end_s: float) -> str:
        """Return when something happens in the video; empty where that is not known."""
        if math.isnan(start_s):
            return ""
        if math.isnan(end_s):
            return self["at_time"].format(time=self.number(start_s, 1))
        return self["window"].format(start=self.number(start_s, 1), end=self.number(end_s, 1))


ENGLISH = Words(
    vocabulary=wording.ENGLISH,
    text={
        # numbers
        "missing": "not measured",
        "infinite": "infinite",
        "range_unknown": "range not known",
        "or_more": "{low} or more",
        "from_to": "{low} to {high}",
        "no_date": "date not known",
        "window": "{start} s to {end} s",
        "at_time": "at {time} s",
        "and_more": "and {n} more in the full result",
        "not_shown": "and {n} more, not shown here",
        # nouns
        "lift": "lift",
        "lifts": "lifts",
        "trial": "trial",
        "trials": "trials",
        # head
        "kind": "Lifting assessment",
        "untitled": "Untitled trial",
        "person": "Person {label}",
        "load": "load {load} kg",
        "no_load": "load not given",
        "video_length": "{seconds} s of video",
        "site_unknown": "site not given",
        "job_unknown": "job not given",
        # verdict
        "no_flags": "No check could be made in this video.",
        "counts": "{high} high, {review} to review, {ok} without concern",
        "index": "Lifting index",
        "index_goal": "goal: 1.0 or less",
        "index_word": "{category} · goal: 1.0 or less",
        "range": "95 % range {range}",
        "limit": "Recommended limit",
        "index_infinite": "no weight is acceptable here",
        "not_judged": "not judged",
        "index_refused": "the equation can't be used here",
        "index_absent": "the equation was not part of it",
        "tried": (
            "LI: lifting index; compression: of the lowest disc. Tried out on the measured lift."
        ),
        "also": "{first}; also {others}",
        # sections
        "picture": "The worst moment",
        "picture_caption": "{time} s into the recording: {what}",
        "picture_no_video": "Drawn from the measured joints: {why}",
        "no_video": "the result holds no annotated video.",
        "not_blurred": "heads are not covered in the video.",
        "anonymous": "the picture was left out on request.",
        "unreadable_video": "the annotated video can't be read.",
        "no_figure": "No picture: the joints were not measured.",
        "changes": "What to change",
        "no_changes": "No change was worked out for this trial.",
        "flags": "What stands out",
        "equation": "NIOSH lifting equation",
        "equation_lift": "NIOSH lifting equation, lift {lift} (the worst of {n})",
        "other_lifts": "Index of each lift: {lifts}",
        "lift_index": "{index} (lift\u00a0{n})",
        "no_equation": "The lifting equation was not part of this assessment.",
        "equation_refused": "The lifting equation can't be used here: {why}",
        "origin": "Start of the lift",
        "destination": "End of the lift",
        "governs": "(decides)",
        "not_counted": "(not counted)",
        "reach": "Reach (H)",
        "height": "Height (V)",
        "travel": "Travel (D)",
        "side": "To the side (A)",
        "frequency": "Frequency (F)",
        "grip": "Grip (C)",
        "rwl": "Limit (RWL)",
        "li": "Index (LI)",
        "per_min": "{frequency}/min, {duration}",
        "curves": "Posture over time",
        "trunk": "Trunk against the vertical",
        "knees": "Knee flexion",
        "left": "left",
        "right": "right",
        "lift_n": "Lift {n}",
        "seconds": "Time (s)",
        "band": "Band: about 95 %. Grey: load in the hands. Dots: worst moment.",
        "methods_title": "What the other methods say",
        "method": "Method",
        "result": "Result",
        "range_title": "95 % range",
        "level": "Level",
        "in_words": "In words",
        "not_applicable": "can't be used",
        "all_refused": "{names} can't be used",
        "method_noun": "method",
        "method_nouns": "methods",
        "no_value": "no value",
        "no_methods": "No other method was part of this assessment.",
        "coverage": "How much was seen",
        "coverage_unknown": "How much of the body was seen is not known.",
        "warnings": "Warnings of the measurement",
        "notes": "Keep in mind",
        "note_range": (
            "Ranges are about 95 % and hold errors of measuring (camera, stature, joints), not of "
            "what was entered, such as load or frequency."
        ),
        "note_reference": "Source of the equation: {reference}",
        "note_glyphs": "▯ stands for a character that the font of this report lacks.",
        "closing": (
            "For a professional's judgement: a result alone never shows that work is safe."
        ),
        "provenance": (
            "LiftLens {version} · estimator {backend} · solver {solver} · correction {correction} "
            "· video SHA-256 {video} · settings {config} · assessed {date}"
        ),
        "unknown": "not known",
        "file_name": "video {name}",
        "page": "Page {page} of {pages}",
        # several trials
        "summary_kind": "Summary of lifting assessments",
        "summary_title": "Lifting at work",
        "all_trials": "All trials",
        "all_before": "Trials before the change",
        "trial_n": "Trial {n}",
        "date_title": "Date",
        "date_range": "{first} to {last}",
        "trial_title": "Trial",
        "job_title": "Job",
        "lift_title": "Lift",
        "lifts_title": "Lifts",
        "trials_title": "Trials",
        "index_title": "Lifting index (95 % range)",
        "index_range": "Index (95 %)",
        "finding": "Most urgent finding",
        "no_finding": "no flag was raised",
        "jobs": "By job",
        "no_job": "(no job named)",
        "at_level": "{level}: {n} of {total}",
        "highest_index": "Highest index",
        "shares": "Lifts at each level",
        "shares_note": (
            "A lift has the level of the most urgent flag about it; flags about a whole trial are "
            "not counted here."
        ),
        "no_lifts": "No lift was found in these trials.",
        "trend": "Over time",
        "trend_note": (
            "Lifting index of every trial with its 95 % range; the dashed line is the goal, 1.0."
        ),
        "no_trend": "A trend needs lifting indices from two days or more.",
        "worst": "The worst lifts",
        "no_indices": "No lifting index is known: the load was not given, or no lift was found.",
        "common_changes": "What to change most often",
        "in_trials": "in {n} of {total} trials",
        "comparison": "Before and after",
        "before": "Before",
        "after": "After",
        "measure": "Measure",
        "worst_index": "Highest lifting index",
        "share_high": "Lifts at high risk",
        "share_of": "{n} of {total} ({share})",
        "difference": "Difference (95 % range)",
        "outcome": "Outcome",
        "difference_of": "{difference} ({low} to {high})",
        "improved": "improved",
        "not distinguishable": "not distinguishable",
        "worse": "worse",
        "not_compared": "–",
        "unknown_measures": "Not known of all trials, so not compared: {names}.",
        "verdict_high": "Change before the work goes on: {n} of {total} trials.",
        "verdict_review": "None at high risk; to be looked at: {n} of {total} trials.",
        "verdict_ok": "Nothing to act on was found: {n} of {total} trials.",
        "verdict_none": "Nothing could be judged; trials: {total}.",
        "not_judged_trials": "Trials that could not be judged: {n} of {total}.",
        "person_noun": "person",
        "person_nouns": "persons",
        "summary_provenance": (
            "Written by LiftLens {version} from results of {results} · their fingerprint {hash}"
        ),
        "no_lifts_short": "no lift",
        "alt_picture": "Picture of the worst moment with the measured joints drawn on it.",
        "alt_figure": "Stick figure of the worst moment, drawn from the measured joints.",
        "alt_coverage": "Joint positions: {shares}.",
        "alt_curve": "{title} over time, highest {peak}° at {time} s.",
        "alt_curve_missing": "{title} was not measured.",
        "alt_shares": "Lifts at each level: {shares}.",
        "alt_trend": "Lifting index over time, {n} trials from {first} to {last}.",
    },
)

LANGUAGES: Mapping[str, Words] = {"en": ENGLISH}


def select_words(language: str) -> Words:
    """Return the texts of a language.

    Raises
    ------
    ConfigError
        If there are none.
    """
    words = LANGUAGES.get(language.strip().lower())
    if words is None:
        raise ConfigError(f"The language must be one of {', '.join(LANGUAGES)}, got {language!r}.")
    return words
