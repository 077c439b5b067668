"""Fatigue-failure tools: published examples and the documents' vectors."""

from __future__ import annotations

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from engine.ergonomics.fatigue import (
    DUET_DAMAGE,
    NEWTON_METRES_PER_FOOT_POUND,
    compute_back_damage,
    compute_duet_damage,
    compute_risk_percent,
    compute_shoulder_damage,
    compute_shoulder_moment,
)
from engine.errors import DataError

G = 9.80665


class TestLifft:
    @pytest.mark.parametrize(
        ("tasks", "damage", "percent"),
        [
            ([(13, 0.40, 400)], 0.004207, 32.96),
            ([(30 * 0.45359237, 16 * 0.0254, 760)], 0.009036, 40.85),
            ([(20, 0.45, 200)], 0.008621, 40.35),
            ([(10, 0.35, 1000)], 0.005596, 35.82),
            ([(5, 0.30, 2000)], 0.005327, 35.32),
            ([(25, 0.60, 50)], 0.019986, 49.58),
            ([(20, 0.45, 200), (10, 0.35, 1000), (25, 0.60, 50)], 0.034202, 55.53),
        ],
        ids=["L1", "L2", "L3", "L4", "L5", "L6", "L7"],
    )
    def test_vectors(self, tasks, damage, percent):
        found = sum(reps * compute_back_damage(kg * G * m) for kg, m, reps in tasks)
        assert found == pytest.approx(damage, abs=1.5e-6)
        assert compute_risk_percent(found, "lifft") == pytest.approx(percent, abs=0.01)

    def test_published_instructions_give_forty_percent(self):
        moment = 40.0 * NEWTON_METRES_PER_FOOT_POUND
        percent = compute_risk_percent(760 * compute_back_damage(moment), "lifft")
        assert round(percent) in (40, 41)

    @given(st.floats(0, 120))
    def test_both_published_forms_agree(self, moment):
        rounded = math.exp(0.038 * moment + 0.32) / 902_416
        assert compute_back_damage(moment) == pytest.approx(rounded, rel=0.02)


class TestDuet:
    @pytest.mark.parametrize(
        ("effort", "repetitions", "damage", "percent"),
        [(2, 5400, 0.007398, 26.53), (5, 1000, 0.03801, 38.04), (8, 100, 0.105374, 46.08)],
    )
    def test_vectors(self, effort, repetitions, damage, percent):
        found = repetitions * compute_duet_damage(effort)
        assert found == pytest.approx(damage, rel=1e-4)
        assert compute_risk_percent(found, "duet") == pytest.approx(percent, abs=0.01)

    def test_table_rises(self):
        assert len(DUET_DAMAGE) == 11
        assert list(DUET_DAMAGE) == sorted(DUET_DAMAGE)

    @pytest.mark.parametrize("effort", [-1, 11])
    def test_outside_the_scale(self, effort):
        with pytest.raises(DataError, match="from 0 to 10"):
            compute_duet_damage(effort)


class TestShoulder:
    @pytest.mark.parametrize(
        ("load", "reach", "repetitions", "damage", "percent"),
        [
            (2, 16, 2880, 0.00428, 20.84),
            (5, 18, 4800, 0.03331, 37.59),
            (10, 12, 500, 0.00356, 19.64),
            (20, 20, 100, 1.01489, 70.47),
        ],
    )
    def test_vectors(self, load, reach, repetitions, damage, percent):
        found = repetitions * compute_shoulder_damage(compute_shoulder_moment(load, reach))
        assert found == pytest.approx(damage, abs=1e-5)
        assert compute_risk_percent(found, "shoulder") == pytest.approx(percent, abs=0.02)

    def test_published_moment(self):
        assert compute_shoulder_moment(2, 16) == pytest.approx(8.40723, abs=1e-5)

    @pytest.mark.parametrize(
        ("reach", "arm"),
        [(1.714, 0.0), (1.715, (-8.27 + 4.8223 * 1.715) / 12), (26.99, 10.157), (27.0, 121.9 / 12)],
    )
    def test_both_sides_of_the_arms_limits(self, reach, arm):
        assert compute_shoulder_moment(0.0, reach) == pytest.approx(arm, abs=1e-3)

    def test_kinds_of_force(self):
        handle, push, down = (
            compute_shoulder_moment(10, 12, kind=kind) for kind in ("handle", "push", "push down")
        )
        assert push == pytest.approx(10.0)
        assert handle - push == pytest.approx(push - down)


class TestRisk:
    def test_no_damage_is_no_risk(self):
        assert compute_risk_percent(0.0, "lifft") == 0.0

    def test_endless_damage_is_certain(self):
        assert compute_risk_percent(math.inf, "shoulder") == 100.0

    def test_unknown_stays_unknown(self):
        assert math.isnan(compute_risk_percent(math.nan, "lifft"))

    def test_negative_damage_is_an_error(self):
        with pytest.raises(DataError, match="can't be negative"):
            compute_risk_percent(-1.0, "lifft")

    @given(st.floats(1e-9, 1e3), st.floats(1.01, 100))
    def test_more_damage_is_more_risk(self, damage, factor):
        for tool in ("lifft", "duet", "shoulder"):
            assert compute_risk_percent(damage * factor, tool) > compute_risk_percent(damage, tool)
