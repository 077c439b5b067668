"""The page that compares a trial with a reference recording."""

import io
import json
import zipfile

import numpy as np
import pytest

from dashboard import cache, labels, reference_charts
from engine.storage.results import read_result
from engine.validate import compare_results
from engine.validation.profiles import ImportProfile
from engine.validation.reference.files import read_reference
from tests.dashboard.test_app import html
from tests.engine.validation.pairs import MARKERS, OTHER_MARKERS, store_lift


@pytest.fixture
def lift(library):
    store_lift(library.folder("lift"))
    return "lift"


@pytest.fixture(scope="module")
def agreement(tmp_path_factory):
    folder = store_lift(tmp_path_factory.mktemp("result") / "lift")
    return compare_results([(read_result(folder), read_reference(MARKERS))])


def open_page(app, trial_id=None):
    app.run()
    if trial_id:
        app.query_params["trial"] = trial_id
    app.switch_page("views/reference.py").run()
    assert not app.exception
    return app


def keep(trial_id, path=MARKERS, name=None):
    with path.open("rb") as source:
        cache.save_reference(trial_id, name or path.name, source)


def words(app):
    """Return everything the page says."""
    parts = (app.markdown, app.caption, app.info, app.error, app.warning, app.subheader)
    return " ".join([html(app), *(e.value for kind in parts for e in kind)])


def test_without_trials_the_page_says_what_to_do(app):
    assert "There is no trial yet" in open_page(app).info[0].value


def test_a_trial_has_to_be_chosen_first(app, lift):
    shown = open_page(app)
    assert "Choose the trial" in words(shown)
    shown.selectbox[0].select(lift).run()
    assert not shown.exception
    assert "The reference recording" in words(shown)


def test_a_trial_of_the_address_is_chosen_already(app, lift):
    shown = open_page(app, lift)
    assert shown.selectbox[0].value == lift
    assert not shown.get("plotly_chart")


def test_the_bundled_markers_are_offered_for_a_bundled_lift_only(app, library, lift):
    assert cache.sample_reference(lift) is None
    path = library.folder(lift) / "trial.json"
    document = json.loads(path.read_text())
    sample = next(s for s in cache.samples() if s.key == "floor_to_knuckle")
    document["views"][0]["sha256"] = cache._sample_hash(str(sample.path))
    path.write_text(json.dumps(document))
    shown = open_page(app, lift)
    shown.button(key="sample-reference").click().run()
    assert not shown.exception
    assert cache.reference_file(lift).name == "markers.trc"
    assert "The 14 angles are" in words(shown)


def test_a_trials_page_leads_here(app, lift):
    app.run()
    app.query_params["trial"] = lift
    app.switch_page("views/trial.py").run()
    next(b for b in app.button if b.label.startswith("Compare with")).click().run()
    assert not app.exception
    assert app.title[0].value == "Compare with a reference"
    assert app.selectbox[0].value == lift


def test_the_outcome_is_shown_in_words_charts_and_tables(app, lift):
    keep(lift)
    shown = open_page(app, lift)
    text = words(shown)
    assert "most knee flexion (right) with 6.0°" in text
    assert "within" in text
    assert "in 95 % of the frames" in text
    assert len(shown.get("plotly_chart")) == 5
    assert "Limits of agreement" in text
    assert "cross-correlation of" in text
    assert "regression of Harrington" in text
    assert [b.label for b in shown.get("download_button")] == [
        "Whole comparison (zip)",
        "Import profile",
    ]


def test_every_angle_can_be_looked_at(app, lift):
    keep(lift)
    shown = open_page(app, lift)
    for key in ("angle-curves", "angle-limits"):
        shown.selectbox(key=key).select("knee_flexion_r").run()
        assert not shown.exception
    assert "Constant difference (median) 6.0°" in words(shown)


def test_the_reference_is_there_on_return_and_goes_with_the_trial(app, library, lift):
    keep(lift)
    assert "The 14 angles are" in words(open_page(app, lift))
    assert "The 14 angles are" in words(open_page(app, lift))
    library.delete(lift)
    assert not list(library.root.rglob("markers.trc"))


def test_another_reference_takes_the_place_of_the_first(lift):
    keep(lift)
    cache.save_reference_profile(lift, ImportProfile(length_unit="mm"))
    keep(lift, name="second one.trc")
    assert cache.reference_file(lift).name == "second_one.trc"
    assert cache.reference_profile(lift) is None


def test_what_was_found_out_can_be_confirmed_and_is_kept(app, lift):
    keep(lift)
    shown = open_page(app, lift)
    assert "45 markers of the synthetic lifts" in words(shown)
    next(b for b in shown.button if b.label == "Confirm and compare").click().run()
    assert not shown.exception
    profile = cache.reference_profile(lift)
    assert (profile.length_unit, profile.axes) == ("mm", ("x", "y", "z"))
    assert profile.labels["LASI"] == "left_asis"
    assert "The 14 angles are" in words(shown)


def test_a_wrong_correction_is_explained_and_can_be_undone(app, lift):
    keep(lift)
    shown = open_page(app, lift)
    shown.checkbox[0].check()
    next(b for b in shown.button if b.label == "Confirm and compare").click().run()
    assert not shown.exception
    assert "exchanged" in shown.error[0].value
    assert not shown.get("plotly_chart")
    next(b for b in shown.button if b.label == "Detect anew").click().run()
    assert "The 14 angles are" in words(shown)


def test_a_file_that_is_no_recording_is_refused_in_one_sentence(app, lift, tmp_path):
    text = tmp_path / "notes.trc"
    text.write_text("this is no recording")
    keep(lift, text)
    shown = open_page(app, lift)
    assert len(shown.error) == 1
    assert "notes.trc" in shown.error[0].value
    next(b for b in shown.button if b.label == "Remove this recording").click().run()
    assert cache.reference_file(lift) is None
    assert "The reference recording" in words(shown)


def test_another_movement_is_refused_in_one_sentence(app, lift, tmp_path):
    lines = OTHER_MARKERS.read_text().splitlines()
    short = tmp_path / "short.trc"
    short.write_text("\n".join(lines[:40]) + "\n")
    keep(lift, short)
    shown = open_page(app, lift)
    assert len(shown.error) == 1
    assert shown.error[0].value.count(".") < 12
    assert not shown.get("plotly_chart")


def test_the_download_is_what_the_command_writes(app, lift, monkeypatch):
    monkeypatch.setattr("engine.validation.figures.draw_figures", lambda _: {"errors": b"png"})
    keep(lift)
    packed = zipfile.ZipFile(io.BytesIO(cache.zip_agreement(lift)))
    names = {name.removeprefix("lift_agreement/") for name in packed.namelist()}
    assert {"agreement.json", "summary.html", "tables/angles.csv", "figures/errors.png"} <= names
    assert packed.testzip() is None


def test_the_pair_of_curves_shows_the_difference_with_its_band(agreement):
    figure = reference_charts.plot_pair(agreement.trials[0], "knee_flexion_r")
    video, reference, difference = figure.data
    assert np.nanmean(np.asarray(video.y) - np.asarray(reference.y)) == pytest.approx(6, abs=0.1)
    assert np.nanmedian(difference.y) == pytest.approx(6, abs=0.1)
    assert video.line.dash != reference.line.dash
    assert figure.layout.shapes


@pytest.mark.parametrize("dark", [False, True])
def test_every_chart_has_a_row_for_every_angle(agreement, dark):
    n = len(agreement.angles)
    errors = reference_charts.plot_errors(agreement, dark=dark)
    assert len(errors.data[0].y) == n
    assert errors.data[0].x[list(errors.data[0].y).index("Knee flexion, right")] == pytest.approx(
        6.0, abs=0.1
    )
    boxes = reference_charts.plot_boxes(agreement, dark=dark).data[0]
    assert len(boxes.median) == n
    assert all(a <= b <= c for a, b, c in zip(boxes.q1, boxes.median, boxes.q3, strict=True))
    sides = reference_charts.plot_sides(agreement, dark=dark).data
    assert [trace.name for trace in sides] == ["Left", "Right"]
    assert "Knee flexion" in sides[0].y
    limits = reference_charts.plot_bland_altman(agreement, "knee_flexion_r", dark=dark)
    assert [a.text for a in limits.layout.annotations][1] == "mean +6.0°"


def test_axes_offered_are_right_handed():
    for axes in labels.AXES:
        ImportProfile(axes=axes)


def test_alone_the_page_says_that_pooling_needs_more_trials(app, lift):
    keep(lift)
    assert "No other trial has a reference yet" in words(open_page(app, lift))


def test_several_trials_are_pooled_by_task(app, library, lift):
    keep(lift)
    store_lift(library.folder("other"), markers=OTHER_MARKERS)
    keep("other", OTHER_MARKERS)
    shown = open_page(app, lift)
    shown.multiselect[0].select("other").run()
    assert not shown.exception
    assert "2 trials" in words(shown)
    agreement = cache.pooled_agreement((lift, "other"))
    assert len(agreement.trials) == 2
    names = zipfile.ZipFile(io.BytesIO(cache.zip_agreement(lift, "other"))).namelist()
    assert "pooled_agreement/agreement.json" in names


def test_a_trial_whose_reference_does_not_fit_stops_the_pool_in_one_sentence(app, library, lift):
    keep(lift)
    store_lift(library.folder("other"), markers=OTHER_MARKERS)
    (library.folder("other") / "reference").mkdir()
    (library.folder("other") / "reference" / "bad.trc").write_text("nothing")
    shown = open_page(app, lift)
    shown.multiselect[0].select("other").run()
    assert not shown.exception
    assert "bad.trc" in shown.error[0].value
