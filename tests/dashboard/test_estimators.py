"""The page that shows several estimators on one clip."""

import numpy as np
import pytest

from dashboard import estimator_charts
from engine.estimators import EstimatorRun, compare_estimators, list_lifters
from engine.storage.results import write_result
from tests.builders import make_angles, make_trial, make_trial_result, make_view_pose
from tests.dashboard.test_app import html


@pytest.fixture
def trial_id(library):
    pose = make_view_pose(n_frames=60)
    write_result(make_trial_result(n_frames=60, views=(pose,)), library.folder("one"))
    return "one"


def open_page(app, trial_id=None):
    app.run()
    if trial_id:
        app.query_params["trial"] = trial_id
    app.switch_page("views/estimators.py").run()
    assert not app.exception
    return app


def choose(app, *names):
    app.multiselect[0].set_value(list(names))
    app.run()
    assert not app.exception
    return app


def test_without_trials_the_page_says_what_to_do(app):
    assert "There is no trial yet" in open_page(app).info[0].value


def test_a_trial_is_compared_by_every_estimator_there_is(app, trial_id):
    shown = open_page(app, trial_id)
    there = [info.title for info in list_lifters() if not info.missing]
    assert "MediaPipe Pose (BlazePose)" in there
    for title in there:
        assert title in html(shown)
    assert "Outlier frames" in html(shown)
    assert len(shown.get("plotly_chart")) == 2


def test_one_estimator_has_nothing_to_differ_from(app, trial_id):
    shown = choose(open_page(app, trial_id), "mediapipe")
    assert not any("Mean difference" in s.value for s in shown.subheader)


def test_no_estimator_chosen_asks_for_one(app, trial_id):
    shown = choose(open_page(app, trial_id))
    assert "Choose at least one estimator" in shown.info[-1].value


def test_keypoints_of_another_kind_are_explained(app, library):
    result = make_trial_result(n_frames=30, views=(make_view_pose(with_body=False),))
    write_result(result, library.folder("bare"))
    shown = choose(open_page(app, "bare"), "mediapipe")
    assert "not applicable" in html(shown) or shown.error
    assert not shown.exception


def test_curves_keep_their_gaps_and_errors():
    angles = make_angles(n_frames=30, missing=[(3, "knee_flexion_l")])
    run = EstimatorRun(list_lifters()[0], make_trial_result(angles=angles))
    figure = estimator_charts.plot_estimators((run,), "knee_flexion_l", ())
    assert len(figure.data) == 1
    assert np.isnan(figure.data[0].y[3])
    assert np.array_equal(figure.data[0].y, angles["knee_flexion_l"], equal_nan=True)
    assert figure.data[0].customdata[0] == round(1.96 * 4.0)


def test_the_bars_say_their_values():
    runs = compare_estimators(make_trial(), make_view_pose(n_frames=60), ("mediapipe",))
    figure = estimator_charts.plot_outliers(runs)
    assert list(figure.data[0].text) == [f"{100 * runs[0].outlier_ratio:.1f} %"]
