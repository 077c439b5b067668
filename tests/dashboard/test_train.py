"""The page that compares how two movements were performed."""

import dataclasses
from datetime import UTC, datetime

import numpy as np
import pytest

from dashboard import train_charts, train_parts
from dashboard.components.pair import FRONTEND, build_pair
from engine.datatypes import JointAngles
from engine.form import compare_performances
from engine.form.score import compute_score
from engine.storage.results import write_result
from tests.builders import make_pose_track, make_trial, make_trial_result
from tests.dashboard.results import write_clip
from tests.dashboard.test_app import html
from tests.engine.form.performances import DEPTH_DEG, make_lift_clip, make_squats


def add(library, clip, label, tmp_path=None):
    """Put a trial that moves like `clip` into the library."""
    trial_id = label.lower().replace(" ", "_")
    n = len(clip.time_s)
    track = make_pose_track(time_s=clip.time_s, n_frames=n)
    result = make_trial_result(
        n_frames=n,
        trial=make_trial(label=label),
        angles=clip.angles,
        lifts=clip.lifts,
        raw=track,
        corrected=track,
    )
    overlay = None if tmp_path is None else write_clip(tmp_path / f"{trial_id}.mp4")
    write_result(result, library.folder(trial_id), overlay=overlay)
    return trial_id


def open_page(app, reference=None, attempt=None):
    app.run()
    if reference:
        app.query_params["against"] = reference
    if attempt:
        app.query_params["trial"] = attempt
    app.switch_page("views/train.py").run()
    assert not app.exception
    return app


def words(app):
    kinds = (app.markdown, app.caption, app.info, app.error, app.warning, app.subheader)
    return " ".join([html(app), *(e.value for kind in kinds for e in kind)])


@pytest.fixture
def two(library):
    deep = make_lift_clip(depth={**DEPTH_DEG, "trunk_flexion": 80.0}, stretch=1.5)
    return add(library, make_lift_clip(), "By the trainer"), add(library, deep, "First try")


def test_without_trials_the_page_says_what_to_do(app):
    shown = open_page(app)
    assert "There is no trial yet" in shown.info[0].value


def test_the_address_chooses_and_the_page_says_what_differs(app, two):
    shown = open_page(app, *two)
    assert [s.value for s in shown.selectbox[:2]] == list(two)
    text = words(shown)
    assert "your trunk leans" in text
    assert "further forward than in the reference" in text
    assert "● +" in text
    assert "Time taken" in text
    score = float(text.split('class="ll-number">')[1].split("<")[0])
    assert score < 100
    assert "Score of 100" not in text
    assert two[0] in shown.query_params["against"]


def test_changing_the_attempt_changes_the_result(app, two):
    shown = open_page(app, *two)
    shown.selectbox[1].set_value(two[0]).run()
    assert not shown.exception
    assert 'class="ll-number">100<' in words(shown)
    assert two[0] in shown.query_params["trial"]


def test_one_trial_is_compared_with_itself_and_says_so(app, library):
    add(library, make_lift_clip(), "Only one")
    text = words(open_page(app))
    assert "There is only one trial" in text
    assert 'class="ll-number">100<' in text
    assert "one session" in text


def test_every_repetition_has_a_row(app, library):
    one = add(library, make_squats(1), "One squat")
    many = add(library, make_squats(3), "Three squats")
    shown = open_page(app, one, many)
    text = words(shown)
    for number in (1, 2, 3):
        assert f"{number}, from" in text
    assert "Deepest" in text


def test_another_movement_is_refused_in_words(app, library):
    raised = {**dict.fromkeys(DEPTH_DEG, 0.0), "shoulder_flexion_l": 120.0}
    raised |= {"shoulder_flexion_r": 120.0}
    one = add(library, make_squats(1), "Squat")
    two = add(library, make_squats(1, depth=raised), "Arms")
    shown = open_page(app, one, two)
    assert "different movements" in shown.warning[0].value
    assert "Curve by curve" not in words(shown)


def test_a_clip_without_movement_is_explained(app, library):
    clip = make_squats(1)
    angles = JointAngles(clip.time_s, np.zeros_like(clip.angles.value_deg), clip.angles.names)
    still = add(library, dataclasses.replace(clip, angles=angles), "Still")
    shown = open_page(app, still, still)
    assert "Neither a lift nor a repeated movement" in shown.warning[0].value


def test_videos_need_both_trials_to_have_one(app, library, tmp_path, two):
    assert "no annotated video" in words(open_page(app, *two))
    filmed = add(library, make_lift_clip(), "Filmed", tmp_path)
    shown = open_page(app, filmed, filmed)
    assert "runs at its own speed" in words(shown)


def test_progress_shows_the_same_work_only(app, library, two):
    add(library, make_squats(2), "A squat")
    text = words(open_page(app, *two))
    assert "1 trial of this person left out" in text


def test_an_unknown_trial_in_the_address_falls_back(app, two):
    shown = open_page(app, "nobody", "nothing")
    assert set(two) >= {s.value for s in shown.selectbox[:2]}


@pytest.mark.parametrize("dark", [False, True])
def test_curves_differ_by_dash_and_the_difference_is_filled(dark):
    found = compare_performances(
        make_lift_clip(), make_lift_clip(depth={**DEPTH_DEG, "trunk_flexion": 80.0})
    )
    figure = train_charts.plot_aligned(found, "trunk_flexion", dark=dark)
    lines = {t.name: t for t in figure.data if t.name in ("Reference", "Attempt")}
    assert lines["Reference"].line.dash != lines["Attempt"].line.dash
    assert np.nanmax(lines["Attempt"].y) > np.nanmax(lines["Reference"].y) + 15
    filled = [t for t in figure.data if t.fillcolor == train_charts.BEYOND]
    assert filled
    same = train_charts.plot_aligned(found, "knee_flexion_l", dark=dark)
    assert not [t for t in same.data if t.fillcolor == train_charts.BEYOND]
    assert {a.text for a in figure.layout.annotations} == {"Reach", "Lift", "Return"}


def test_the_trial_shown_is_marked_in_the_progress_by_its_shape():
    score = compute_score(np.full((5, 2), 20.0), np.full((5, 2), 3.0))
    points = [
        train_charts.ScorePoint(datetime(2026, 1, day, tzinfo=UTC), score, str(day), day == 2)
        for day in (3, 1, 2)
    ]
    drawn = train_charts.plot_progress(points).data[0]
    assert list(drawn.text) == ["1", "2", "3"]
    assert list(drawn.marker.symbol) == ["circle-open", "diamond", "circle-open"]


def test_what_the_two_videos_need_is_plain_and_short():
    data = build_pair(np.array([0.0, 1.0]), np.array([0.5, 2.00004]), [("Reach", 0.0)])
    assert data == {
        "reference": [0.0, 1.0],
        "attempt": [0.5, 2.0],
        "phases": [{"name": "Reach", "at": 0.0}],
    }
    assert {p.name for p in FRONTEND.iterdir()} == {"index.html", "pair.css", "pair.js"}
    assert "http" not in (FRONTEND / "index.html").read_text()


def test_signs_are_true_signs():
    assert train_parts._signed(3.2, 0) == "+3"
    assert train_parts._signed(-3.2, 0) == "−3"
    assert train_parts._signed(0.2, 0) == "0"
