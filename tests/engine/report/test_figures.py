"""Charts keep peaks and gaps, and say in words what they show."""

from __future__ import annotations

import math
from datetime import UTC, datetime, timedelta

import numpy as np
import pytest

from engine.datatypes import FlagLevel
from engine.report.body import pose_at
from engine.report.figures import (
    Curve,
    CurveChart,
    TrendChart,
    TrendPoint,
    _nice_ticks,
    _thin,
    list_trunk_and_knees,
)
from engine.report.levels import LevelBar
from engine.report.sheet import Properties, Sheet
from engine.report.wording import ENGLISH
from engine.skeletons import get_skeleton
from tests.builders import make_angles, make_lift, make_trial_result
from tests.engine.report.results import record_text, store

DAY = datetime(2026, 3, 1, tzinfo=UTC)


def make_curve(value, sigma=2.0):
    value = np.asarray(value, dtype=float)
    return Curve("", np.arange(value.size) / 30, value, np.full(value.size, sigma), "#0072b2")


def draw(block, width=250.0):
    sheet = Sheet(paper="a4", properties=Properties("t", "s", "en"))
    block.draw(sheet, 50, 700, width)
    sheet.end_page()
    return sheet.to_bytes()


def test_thinning_keeps_ends_and_peaks():
    rng = np.random.default_rng(1)
    value = np.sin(np.arange(20_000) / 500) + 0.01 * rng.standard_normal(20_000)
    value[12_345] = 5.0
    kept = _thin(value, 100)
    assert kept.size <= 202
    assert {0, 12_345, 19_999} <= set(kept.tolist())
    assert (np.diff(kept) > 0).all()


def test_short_curves_are_kept_whole():
    assert _thin(np.arange(7.0), 100).tolist() == list(range(7))


@pytest.mark.parametrize(
    ("low", "high", "ticks"),
    [(0.0, 100.0, [0, 50, 100]), (-20.0, 40.0, [-20, 0, 20, 40]), (0.0, 3.2, [0, 2])],
)
def test_ticks_are_round_numbers(low, high, ticks):
    assert _nice_ticks(low, high, 3) == pytest.approx(ticks)


def test_gaps_stay_open(monkeypatch):
    value = np.full(90, 30.0)
    value[30:60] = np.nan
    lines = []
    original = Sheet.polyline

    def polyline(self, points, **style):
        if style["stroke"] == "#0072b2":
            lines.append(points)
        original(self, points, **style)

    monkeypatch.setattr(Sheet, "polyline", polyline)
    draw(CurveChart("Trunk", (make_curve(value),), (), (0.0, 3.0), math.nan, ENGLISH))
    assert len(lines) == 2
    gap = min(x for x, _ in lines[1]) - max(x for x, _ in lines[0])
    assert gap == pytest.approx((250 - 20) * 31 / 90, rel=0.02)


def test_a_chart_is_described_by_its_peak():
    value = 10 + 50 * np.exp(-(((np.arange(90) - 45) / 9) ** 2))
    chart = CurveChart("Trunk", (make_curve(value),), (), (0.0, 3.0), math.nan, ENGLISH)
    assert chart.describe() == "Trunk over time, highest 60° at 1.5 s."


def test_lifts_are_named_where_names_do_not_touch(monkeypatch):
    written = record_text(monkeypatch)
    lifts = tuple(make_lift(0.1 * i, 0.1 * i + 0.05) for i in range(30))
    draw(CurveChart("T", (make_curve(np.ones(90)),), lifts, (0.0, 3.0), 1.0, ENGLISH))
    names = [w for w in written if w.text.startswith("Lift ")]
    assert 3 < len(names) < 12
    assert not any(a.overlaps(b) for i, a in enumerate(names) for b in names[i + 1 :])


def test_angles_that_are_not_there_are_empty_curves():
    charts = list_trunk_and_knees(make_angles(names=("trunk_inclination",)), ENGLISH)
    (_, (trunk,)), (_, knees) = charts
    assert not trunk.is_empty
    assert all(knee.is_empty for knee in knees)


def test_a_level_bar_says_its_counts():
    counts = ((FlagLevel.HIGH, 2), (FlagLevel.REVIEW, 1), (FlagLevel.OK, 0), (None, 1))
    bar = LevelBar(counts, ENGLISH)
    assert bar.describe() == (
        "Lifts at each level: High risk 2, Needs review 1, No concern 0, Not judged 1."
    )
    assert draw(bar)


def test_a_trend_of_infinite_and_unknown_ranges_can_be_drawn():
    points = tuple(
        TrendPoint(DAY + timedelta(days=i), value, interval, FlagLevel.HIGH)
        for i, (value, interval) in enumerate(
            [(1.2, (1.0, math.inf)), (math.inf, (math.nan, math.nan)), (0.8, (math.nan, math.nan))]
        )
    )
    assert draw(TrendChart(points, ENGLISH))


def test_the_figure_stands_upright_as_the_camera_sees_it(tmp_path):
    stored = store(make_trial_result(n_frames=60), tmp_path / "r")
    points = pose_at(stored, float(stored.corrected.time_s[-1]))
    names = get_skeleton(stored.corrected.skeleton).keypoints
    head, foot = points[names.index("nose")], points[names.index("left_heel")]
    assert head[1] - foot[1] == pytest.approx(1.62 - 0.03, abs=0.02)
    assert head[0] < foot[0]  # filmed from the left, the figure faces the camera's left
