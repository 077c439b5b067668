"""The page that shows how risky a movement is, when, and why."""

import ast
import dataclasses
import math
from pathlib import Path

import numpy as np
import pytest

from dashboard import labels, risk_charts, risk_parts
from engine.datatypes import JointAngles
from engine.ergonomics.assess import assess_risk
from engine.ergonomics.base import Exposure, list_methods
from engine.ergonomics.flags import raise_flags
from engine.storage.results import read_result, write_result
from tests.dashboard.results import make_shown_result, write_clip
from tests.dashboard.test_app import html

METHODS = ("rnle", "reba", "rula", "owas", "posture_zones")
FRAMED = METHODS[1:]


def make_judged(*, methods=METHODS, missing=()):
    """Make a result whose methods were really applied to its angles."""
    shown = make_shown_result()
    value = np.array(shown.angles.value_deg)
    value[:, [shown.angles.names.index(name) for name in missing]] = np.nan
    angles = JointAngles(
        shown.angles.time_s, value, shown.angles.names, shown.angles.sigma_deg, shown.angles.status
    )
    exposure = Exposure(
        shown.corrected, angles, shown.lifts, shown.trial.subject, shown.trial.task, observed_s=6.0
    )
    risk = assess_risk(exposure, methods=methods) if methods else {}
    flags = raise_flags(risk, shown.lifts, shown.coverage)
    return dataclasses.replace(shown, angles=angles, risk=risk, flags=flags)


@pytest.fixture(scope="module")
def judged():
    return make_judged()


@pytest.fixture
def judged_id(library, tmp_path, judged):
    write_result(judged, library.folder("one"), overlay=write_clip(tmp_path / "clip.mp4"))
    return "one"


def open_page(app, trial_id=None):
    app.run()
    if trial_id:
        app.query_params["trial"] = trial_id
    app.switch_page("views/risk.py").run()
    assert not app.exception
    return app


def words(app):
    parts = (app.markdown, app.caption, app.info, app.error, app.subheader)
    return " ".join([html(app), *(e.value for kind in parts for e in kind)])


def choose(app, label):
    chooser = next(g for g in app.button_group if "REBA" in g.options)
    chooser.set_value(label)
    app.run()
    assert not app.exception
    return words(app)


def test_without_trials_the_page_says_what_to_do(app):
    shown = open_page(app)
    assert "There is no trial yet" in shown.info[0].value
    assert any(b.label == "Add a video" for b in shown.button)


def test_a_trial_has_to_be_chosen_first(app, judged_id):
    shown = open_page(app)
    assert not shown.get("plotly_chart")
    shown.selectbox[0].select(judged_id).run()
    assert not shown.exception
    assert len(shown.get("plotly_chart")) == 1


def test_every_method_is_shown_with_value_range_level_and_action(app, judged, judged_id):
    shown = words(open_page(app, judged_id))
    for method in list_methods():
        if method.info.name in METHODS:
            assert method.info.title in shown
    reba = judged.risk["reba"]
    assert f"REBA score {reba.value:.0f} (95 % range" in shown
    assert "Action: " in shown
    assert "a mean of them would mean nothing" in shown
    assert "single source" in shown
    assert "safe" not in shown.lower()


def test_the_worst_moments_start_the_video(app, judged, judged_id):
    shown = open_page(app, judged_id)
    chooser = shown.radio[0]
    assert "trunk " in chooser.proto.captions[1]
    moment = judged.risk["reba"].details["worst_moments"][0]
    label = f"REBA {moment['score']} at {moment['peak_s']:.1f} s"
    assert label in chooser.options
    assert shown.get("video")[0].proto.start_time == 0
    chooser.set_value(label)
    shown.run()
    assert not shown.exception
    expected = max(0.0, moment["peak_s"] - 0.5)
    assert shown.get("video")[0].proto.start_time == pytest.approx(expected, abs=1.0)


def test_every_method_is_justified_line_by_line(app, judged, judged_id):
    open_page(app, judged_id)
    for method in METHODS:
        shown = choose(app, labels.name_method(method)).replace("&#x27;", "'")
        risk = judged.risk[method]
        for step in (risk.steps[0], risk.steps[-1]):
            assert risk_parts._typeset(step) in shown
        assert risk.reference in shown
        assert ("Time in each level" in shown) == (method in FRAMED)
        for word in OWN_WORDS.get(method, ()):
            assert word in shown


OWN_WORDS = {
    "reba": (
        "measured in the video",
        "entered by you",
        "[assumed]",
        "What raises the worst score",
        "What makes it unsure",
        "chance that the worst is here",
    ),
    "owas": ("By share of time, part by part",),
    "posture_zones": ("Moving (EN 1005-4)", "Holding (ISO 11226)"),
}


def test_a_hidden_trunk_leaves_no_timeline_and_says_so(app, library):
    blind = make_judged(missing=("trunk_flexion", "trunk_inclination"))
    write_result(blind, library.folder("blind"))
    shown = open_page(app, "blind")
    assert "the trunk was hardly seen" in words(shown)
    assert not shown.get("plotly_chart")


def test_a_result_without_methods_still_opens(app, library):
    write_result(make_judged(methods=()), library.folder("none"))
    shown = words(open_page(app, "none"))
    assert "No method was part of this assessment" in shown


def test_a_trial_that_is_gone_is_said_in_one_sentence(app, judged_id):
    app.run()
    app.query_params["trial"] = "20200101-000000-000000-aaaaaa"
    app.switch_page("views/risk.py").run()
    assert not app.exception
    assert "There is no trial" in app.error[0].value


def test_the_trial_leads_here(app, judged_id):
    app.run()
    app.query_params["trial"] = judged_id
    app.switch_page("views/trial.py").run()
    assert any(b.label.startswith("Why and when") for b in app.button)


class TestChart:
    def test_one_row_a_method_with_its_levels_named(self, judged):
        results = [judged.risk[name] for name in FRAMED]
        figure = risk_charts.plot_scores(results, judged.angles.time_s, judged.lifts)
        texts = [a.text for a in figure.layout.annotations]
        assert {"REBA", "RULA", "OWAS", "Posture zones"} <= set(texts)
        assert {"negligible", "acceptable", "normal", "outer zone"} <= set(texts)
        lines = [t for t in figure.data if t.name]
        assert [t.name for t in lines] == ["REBA", "RULA", "OWAS", "Posture zones"]
        assert all(len(t.x) == 180 for t in lines)

    def test_gaps_stay_open(self, judged):
        figure = risk_charts.plot_scores([judged.risk["reba"]], judged.angles.time_s, [])
        line = next(t for t in figure.data if t.name == "REBA")
        assert np.isnan(np.asarray(line.y)[70:88]).all()
        assert line.connectgaps is False

    def test_a_stored_result_is_drawn_like_a_fresh_one(self, judged, tmp_path):
        stored = read_result(write_result(judged, tmp_path / "r"))
        assert stored.risk["reba"].details["levels"][-1]["upper"] == math.inf
        results = [stored.risk[name] for name in FRAMED]
        figure = risk_charts.plot_scores(results, stored.angles.time_s, stored.lifts, dark=True)
        assert len(figure.layout.shapes) > 4 * 3

    def test_no_streamlit_in_it(self):
        tree = ast.parse(Path(risk_charts.__file__).read_text(encoding="utf-8"))
        names = {n.name for x in ast.walk(tree) if isinstance(x, ast.Import) for n in x.names}
        assert "streamlit" not in names
