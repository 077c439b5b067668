import io

import pytest

from dashboard import labels, manage_cache
from dashboard.labels import format_bytes, format_measurement, format_value
from engine.datatypes import Measurement
from engine.errors import DataError
from engine.jobs.local import JobRequest
from engine.preferences import PREFERENCES_NAME, Preferences
from engine.sample_results import find_samples
from engine.storage.library import Library
from tests.dashboard.results import add_trial
from tests.dashboard.test_app import html


@pytest.fixture
def page(app):
    """The settings, once they are run."""
    app.switch_page("views/settings.py")
    return app


def key(field, number=0):
    return f"settings_{field}_{number}"


def test_choices_are_kept(page, library):
    page.run()
    assert not page.exception
    page.selectbox(key=key("units")).set_value("us").run()
    page.selectbox(key=key("solver")).set_value("least-squares").run()
    page.toggle(key=key("experimental_methods")).set_value(True).run()
    assert manage_cache.preferences() == Preferences(
        units="us", solver="least-squares", experimental_methods=True
    )


def test_new_assessments_follow_the_choices(library, tmp_path):
    manage_cache.save_preferences(Preferences(solver="least-squares", experimental_methods=True))
    settings = manage_cache.with_preferences(JobRequest(videos=(tmp_path / "a.mp4",))).settings
    assert settings.kinematics.solver == "least-squares"
    assert settings.risk.experimental
    own = JobRequest(videos=(), config={"kinematics": {"solver": "geometric"}})
    assert manage_cache.with_preferences(own).settings.kinematics.solver == "geometric"


def test_damaged_preferences_can_be_reset(page, library):
    (library.root / PREFERENCES_NAME).write_text("units = 'furlong'")
    page.run()
    assert "furlong" in page.error[0].value
    page.button(key="reset-preferences").click().run()
    assert not page.error
    assert manage_cache.preferences() == Preferences()


def test_place_size_and_space_are_shown(page, library, trial_id):
    page.run()
    shown = html(page)
    assert str(library.root) in shown
    assert "1 trial, " in shown
    assert "Free space" in shown
    assert "Apache-2.0" in shown


def test_old_trials_go_after_a_look_and_a_second_word(page, library, tmp_path, monkeypatch):
    old = add_trial(library, tmp_path, label="Old one")
    document = library.folder(old) / "trial.json"
    text = document.read_text()
    now = text[text.index('"created": "') + 12 :][:25]
    document.write_text(text.replace(now, "2024-01-01T00:00:00+00:00"))
    new = add_trial(library, tmp_path, label="New one")
    page.run()
    page.number_input(key=key("keep_days")).set_value(90).run()
    assert "1 trial would go: Old one (2024-01-01)" in page.warning[0].value
    assert page.button(key="do-retention").disabled
    page.checkbox(key=key("sure-retention")).check().run()
    page.button(key="do-retention").click().run()
    assert "1 trial deleted." in page.success[0].value
    assert (library.has(old), library.has(new)) == (False, True)
    assert manage_cache.preferences().keep_days == 90


def test_a_person_goes_with_everything(page, library, trial_id):
    page.run()
    page.selectbox(key=key("person")).set_value("P01").run()
    page.checkbox(key=key("sure-person")).check().run()
    page.button(key="do-person").click().run()
    assert "P01 was deleted, with 1 trial." in page.success[0].value
    assert not library.has(trial_id)
    assert library.people() == ()


def test_what_is_exported_can_be_imported_elsewhere(library, trial_id, tmp_path, monkeypatch):
    library.entries()
    archive = manage_cache.export_library(person="P01")
    monkeypatch.setenv("LIFTLENS_HOME", str(tmp_path / "other"))
    report = manage_cache.import_library(io.BytesIO(archive))
    assert list(report.imported) == [trial_id]
    assert Library.open().has(trial_id)
    assert manage_cache.import_library(io.BytesIO(archive)).already_there == (trial_id,)
    with pytest.raises(DataError):
        manage_cache.import_library(io.BytesIO(b"no zip"))


def test_samples_come_and_go_on_a_click(page, library, trial_id):
    page.run()
    page.button(key="samples").click().run(timeout=60)
    assert page.success[0].value == "4 samples added."
    assert len(find_samples(library)) == 4
    page.button(key="samples").click().run(timeout=60)
    assert page.success[0].value == "4 samples removed."
    assert [entry.id for entry in library.entries()] == [trial_id]


def test_models_are_listed_with_their_card():
    names = [path.name for path in manage_cache.model_files()]
    assert "pose_landmark_heavy.onnx" in names
    assert "Apache License 2.0" in manage_cache.model_card()


@pytest.mark.parametrize(
    ("size", "text"),
    [
        (0, "0 bytes"),
        (999, "999 bytes"),
        (1000, "1.0 kB"),
        (27_698_613, "27.7 MB"),
        (2.5e14, "250 TB"),
    ],
)
def test_sizes_are_said_in_plain_units(size, text):
    assert format_bytes(size) == text


@pytest.fixture
def us_units():
    labels.use_units("us")
    yield
    labels.use_units("metric")


@pytest.mark.parametrize(
    ("value", "unit", "text"),
    [
        (23.0, "kg", "23 ± 1 kg (51 lb)"),
        (51.0, "cm", "51 ± 1 cm (20 in)"),
        (5.0, "cm", "5 ± 1 cm (2.0 in)"),
        (60.0, "°", "60 ± 1°"),
    ],
)
def test_us_units_stand_beside_metric_ones(us_units, value, unit, text):
    assert format_measurement(Measurement(value, 1.0), unit) == text


def test_values_without_a_number_get_no_other_unit(us_units):
    assert format_measurement(Measurement(float("nan")), "kg") == "not seen"
    assert format_value("fair", "kg") == "fair kg"
    assert format_value(10.0, "kg") == "10 kg (22 lb)"


def test_metric_is_the_default():
    assert format_value(10.0, "kg") == "10 kg"


def test_the_choice_of_units_reaches_the_pages(page, library, trial_id):
    page.run()
    page.selectbox(key=key("units")).set_value("us").run()
    page.query_params["trial"] = trial_id
    page.switch_page("views/trial.py").run()
    assert " lb)" in html(page)
    manage_cache.save_preferences(Preferences())
    page.run()
    assert " lb)" not in html(page)
