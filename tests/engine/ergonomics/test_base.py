"""What every risk method must keep to."""

from __future__ import annotations

import math

import pytest

from engine.datatypes import Provenance
from engine.ergonomics.assess import assess_risk
from engine.ergonomics.base import list_methods, select_methods
from engine.errors import ConfigError
from tests.engine.ergonomics.exposures import build_exposure, build_lift

METHODS = {m.info.name: m for m in list_methods()}


@pytest.fixture(params=METHODS.values(), ids=METHODS)
def method(request):
    return request.param


class TestContract:
    def test_levels_rise_to_infinity(self, method):
        uppers = [level.upper for level in method.info.levels]
        assert uppers == sorted(set(uppers))
        assert uppers[-1] == math.inf
        assert all(level.name and level.meaning and level.action for level in method.info.levels)

    def test_says_where_it_comes_from(self, method):
        assert method.info.verification in ("V1", "V2", "R")
        assert any(ch.isdigit() for ch in method.info.reference)

    def test_nothing_measured_is_not_applicable_and_no_error(self, method):
        result = method.assess(build_exposure())
        assert result.method == method.info.name
        assert not result.is_applicable
        assert result.category == "not applicable"
        assert result.reasons

    def test_missing_values_never_raise(self, method):
        nan = (math.nan,) * 3
        result = method.assess(build_exposure(build_lift(nan, nan)))
        assert not result.is_applicable or math.isfinite(result.value)

    def test_a_result_carries_its_working(self, method):
        result = method.assess(build_exposure(build_lift(), load_kg=12.0))
        assert result.steps
        assert all(isinstance(i.provenance, Provenance) for i in result.inputs)


def test_all_methods_that_need_no_switch_run_by_default():
    expected = {name for name, m in METHODS.items() if not m.info.is_experimental}
    assert set(assess_risk(build_exposure(build_lift()))) == expected
    assert "rnle" in expected


def test_one_method_can_be_chosen():
    assert list(assess_risk(build_exposure(build_lift()), methods=("rnle",))) == ["rnle"]


def test_unknown_method_is_a_config_error_that_lists_the_known():
    with pytest.raises(ConfigError, match=r"'niosh'; known: .*rnle"):
        select_methods(("niosh",))
