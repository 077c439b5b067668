"""One dictionary for pages, reports and the command line."""

from __future__ import annotations

import dataclasses
import re
from pathlib import Path

import pytest

from dashboard import labels
from engine.cli_output import name_stage
from engine.datatypes import CheckLevel, FlagLevel, Provenance
from engine.ergonomics.base import list_methods
from engine.errors import ConfigError
from engine.kinematics.angles import describe_angle
from engine.report.levels import LEVEL_COLOURS as REPORT_COLOURS
from engine.report.wording import ENGLISH as REPORT
from engine.report.wording import LANGUAGES
from engine.wording import ENGLISH, LEVEL_COLOURS, VOCABULARIES, select_vocabulary

ROOT = Path(__file__).parents[2]
EVERY = pytest.mark.parametrize("words", VOCABULARIES.values(), ids=VOCABULARIES.keys())


@EVERY
def test_every_key_has_words(words):
    assert set(words.levels) == {*FlagLevel, None}
    assert set(words.checks) == set(CheckLevel)
    assert set(words.provenance) == set(Provenance)
    assert set(words.coverage) == {"measured", "repaired", "filled", "missing"}
    assert set(words.reviews) == {"accepted", "rejected", "open"}
    assert {method.info.name for method in list_methods()} <= set(words.methods)
    assert len(words.months) == 12
    for name in words.angles:
        assert describe_angle(name).title


@EVERY
def test_every_stage_the_engine_reports_has_words(words):
    reported = set()
    for path in ROOT.glob("engine/**/*.py"):
        reported |= set(re.findall(r'\bprogress\("(\w+)"', path.read_text(encoding="utf-8")))
    assert {"probe", "subject", "scene", "write", "overlay"} <= reported
    assert reported <= set(words.stages)


@EVERY
def test_no_word_is_empty(words):
    for field in dataclasses.fields(words):
        part = getattr(words, field.name)
        values = part.values() if hasattr(part, "values") else [part]
        assert all(values), field.name


def test_a_language_may_be_incomplete():
    half = ENGLISH.translate("xx", methods={"reba": "Reba!"}, stages={"pose": "Gelenke"})
    assert half.language == "xx"
    assert half.name_method("reba") == "Reba!"
    assert half.name_method("rula") == ENGLISH.methods["rula"]
    assert half.name_stage("pose") == "Gelenke"
    assert half.levels is ENGLISH.levels
    assert ENGLISH.methods["reba"] == "REBA"
    thin = dataclasses.replace(REPORT, vocabulary=half, text={"kind": "Bericht"})
    assert (thin["kind"], thin["person"], thin.language) == ("Bericht", REPORT["person"], "xx")


def test_unknown_keys_are_said_in_plain_letters():
    assert ENGLISH.name_method("new_method") == "new method"
    assert ENGLISH.name_stage("some_new_step") == "Some new step"


def test_an_unknown_language_is_refused():
    assert select_vocabulary(" EN ") is ENGLISH
    with pytest.raises(ConfigError, match="one of en, got 'tlh'"):
        select_vocabulary("tlh")


def test_pages_reports_and_command_line_say_the_same():
    for level in FlagLevel:
        assert labels.LEVELS[level].word == REPORT.level(level)
        assert labels.LEVELS[level].meaning == REPORT.meaning(level)
    assert labels.NOT_JUDGED.word == REPORT.level(None)
    for name in (*ENGLISH.methods, "new_method"):
        assert labels.name_method(name) == REPORT.method(name)
    for stage in (*ENGLISH.stages, "some_new_step"):
        assert labels.name_stage(stage) == name_stage(stage)
    assert set(LANGUAGES) == set(VOCABULARIES)


def test_levels_have_the_same_colours_everywhere():
    assert REPORT_COLOURS is LEVEL_COLOURS
    style = (ROOT / "dashboard/assets/style.css").read_text(encoding="utf-8")
    for name, level in {"high": FlagLevel.HIGH, "review": FlagLevel.REVIEW, "ok": FlagLevel.OK,
                        "none": None}.items():  # fmt: skip
        assert f"--ll-{name}: light-dark({LEVEL_COLOURS[level]}," in style
