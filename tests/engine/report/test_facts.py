"""What reports know of a result: the worst moment, changes, digits, levels."""

from __future__ import annotations

import dataclasses
import math
from datetime import UTC, datetime

import pytest

from engine.datatypes import FlagLevel
from engine.report.facts import _choose_digits, fingerprint, parse_time, read_facts, typeset
from tests.builders import make_flag, make_risk, make_trial_result
from tests.engine.report.results import LIFTS, make_assessed, store

HIGH, REVIEW, OK = FlagLevel.HIGH, FlagLevel.REVIEW, FlagLevel.OK


def facts_of(tmp_path, **changes):
    return read_facts(store(make_trial_result(n_frames=180, **changes), tmp_path / "r"))


@pytest.fixture(scope="module")
def assessed():
    return make_assessed()


def test_the_most_urgent_flag_leads(tmp_path):
    flags = [make_flag(level, what=level.value) for level in (OK, REVIEW, HIGH)]
    facts = facts_of(tmp_path, flags=tuple(flags))
    assert [flag.level for flag in facts.flags] == [HIGH, REVIEW, OK]
    assert facts.level is HIGH
    assert [facts.count(level) for level in (HIGH, REVIEW, OK)] == [1, 1, 1]


def test_without_flags_nothing_is_judged(tmp_path):
    assert facts_of(tmp_path, flags=()).level is None


@pytest.mark.parametrize(
    ("details", "time_s"),
    [
        ({"governing_end": "origin"}, LIFTS[1].origin.time_s),
        ({"governing_end": "destination"}, LIFTS[1].destination.time_s),
        ({"peak_s": 4.7}, 4.7),
        ({"worst_moments": [{"peak_s": 5.5}]}, 5.5),
    ],
    ids=["origin", "destination", "peak", "worst-moment"],
)
def test_the_worst_moment_is_where_the_leading_method_says(tmp_path, details, time_s):
    risk = {"rnle": dataclasses.replace(make_risk(2.0, lift_index=1), details=details)}
    flags = (make_flag(lift_index=1, what="Worst of all"), make_flag(REVIEW))
    facts = facts_of(tmp_path, lifts=LIFTS, risk=risk, flags=flags)
    assert facts.moment.time_s == pytest.approx(time_s)
    assert facts.moment.what == "Worst of all"


def test_without_any_time_the_largest_bend_is_the_moment(tmp_path):
    flag = make_flag(start_s=math.nan, end_s=math.nan, lift_index=None, method="methods")
    facts = facts_of(tmp_path, flags=(flag,))
    assert facts.moment.time_s == 0.0  # the figure straightens up from there


def test_a_change_asked_for_twice_is_named_once_for_the_worst_lift(tmp_path):
    flags = (
        make_flag(REVIEW, change="Bring it closer: 1.2 -> 1.0.", lift_index=0),
        make_flag(REVIEW, change="Bring it closer: 2.8 -> 2.0.", lift_index=1),
        make_flag(REVIEW, change="Bring it closer: 9 -> 4.", method="reba", lift_index=None),
        make_flag(OK, change="Nothing"),
    )
    risk = {
        "rnle": dataclasses.replace(
            make_risk(2.8),
            per_lift=(make_risk(1.2, lift_index=0), make_risk(2.8, lift_index=1)),
            details={"governing_lift": 1},
        )
    }
    (change,) = facts_of(tmp_path, lifts=LIFTS, risk=risk, flags=flags).changes
    assert change.text == "Bring it closer: 2.8 -> 2.0."
    assert change.action == "Bring it closer"
    assert change.methods == ("rnle", "reba")
    assert change.lift_number == 2


def test_lifts_have_the_level_of_the_worst_flag_about_them(tmp_path):
    flags = (make_flag(OK, lift_index=0), make_flag(HIGH, lift_index=1, method="l5s1"))
    facts = facts_of(tmp_path, lis=(0.8, 1.4), flags=flags)
    assert [lift.level for lift in facts.lifts] == [OK, HIGH]
    assert [lift.lifting_index for lift in facts.lifts] == [0.8, 1.4]


def test_every_method_is_there_but_the_equation(tmp_path, assessed):
    facts = read_facts(store(assessed, tmp_path / "r"))
    assert {method.name for method in facts.methods} == set(assessed.risk) - {"rnle"}
    usable = [method.is_applicable for method in facts.methods]
    assert usable == sorted(usable, reverse=True)


def test_the_index_of_a_job_of_one_lift_is_not_repeated(tmp_path):
    result = make_assessed(LIFTS[:1])
    assert result.risk["rnle_job"].value == pytest.approx(result.risk["rnle"].value)
    facts = read_facts(store(result, tmp_path / "r"))
    assert "rnle_job" not in {method.name for method in facts.methods}


@pytest.mark.parametrize(
    ("value", "digits"),
    [(1.0, 1), (1.04, 2), (1.0004, 4), (3.004, 3), (2.996, 1), (3.0, 1), (math.inf, 1)],
)
def test_digits_keep_an_index_on_its_side_of_the_limits(assessed, value, digits):
    from engine.ergonomics.methods.rnle import METHOD

    assert _choose_digits(value, METHOD.info) == digits


def test_typeset_gives_true_signs():
    assert typeset("1.7 -> 1.5 x 2 (x 0.41), 30 deg, 30 degrees, degree of 5 - 3") == (
        "1.7 → 1.5 × 2 (×\u00a00.41), 30°, 30°, degree of 5 − 3"
    )


def test_a_number_is_not_parted_from_its_unit():
    assert typeset("3.1 kN, 5 kg of 4 kgs, 20 %") == "3.1\u00a0kN, 5\u00a0kg of 4 kgs, 20\u00a0%"


@pytest.mark.parametrize("text", [None, 5, "", "yesterday", "2026-13-01", "9999999-01-01"])
def test_an_unreadable_date_is_none(text):
    assert parse_time(text) is None


def test_dates_are_utc():
    assert parse_time("2026-03-05T15:30:00+01:00") == datetime(2026, 3, 5, 14, 30, tzinfo=UTC)
    assert parse_time("2026-03-05T14:30:00") == datetime(2026, 3, 5, 14, 30, tzinfo=UTC)


def test_a_fingerprint_depends_on_values_not_on_their_order():
    assert fingerprint({"a": 1, "b": [2]}) == fingerprint({"b": [2], "a": 1})
    assert fingerprint({"a": 1}) != fingerprint({"a": 2})
