import sys
import time
from pathlib import Path

import pytest

from dashboard import cache
from engine.jobs.local import JobQueue, JobState
from tests.dashboard.results import write_clip
from tests.dashboard.test_app import html

FAKE_WORKER = Path(__file__).parents[1] / "engine" / "jobs" / "fake_worker.py"


@pytest.fixture
def queue(library, monkeypatch):
    """A queue whose workers do what the words in the "video" tell them."""
    monkeypatch.setenv("PYTHONPATH", str(FAKE_WORKER.parents[3]))
    made = JobQueue(library, max_workers=1, command=(sys.executable, str(FAKE_WORKER)))
    monkeypatch.setattr(cache, "job_queue", lambda: made)
    yield made
    for job in made.jobs():
        made.cancel(job.id)
    wait(lambda: all(job.state.is_over for job in made.jobs()))


@pytest.fixture
def any_video(monkeypatch):
    """Take any bytes for a video, so that a test can tell the worker what to do."""
    info = cache.video_facts

    def pretend(path):
        return info(write_clip(path.with_name("real.mp4")))

    monkeypatch.setattr(cache, "video_facts", pretend)


@pytest.fixture
def form(app):
    return app.run().switch_page("views/new_assessment.py").run()


def wait(condition, timeout_s=20.0):
    end_s = time.monotonic() + timeout_s
    while not condition():
        assert time.monotonic() < end_s, "waited too long"
        time.sleep(0.05)


def field(form, label):
    kinds = (*form.number_input, *form.text_input, *form.radio, *form.button_group)
    return next(widget for widget in kinds if widget.label.startswith(label))


def upload(form, name="lift.mp4", content=b""):
    form.file_uploader[0].set_value((name, content, "video/mp4"))
    form.run()
    assert not form.exception


def test_start_waits_for_a_video(form):
    assert form.button(key="start").disabled
    assert any("Add a video first" in c.value for c in form.caption)
    assert not form.error


def test_a_second_camera_is_asked_for_and_reaches_the_job(form, queue, tmp_path):
    content = write_clip(tmp_path / "a.mp4").read_bytes()
    upload(form, content=content)
    cache.keep_calibration("Hall 2, packing", "up = [0, 1, 0]")
    form.toggle[0].set_value(True).run()
    assert form.button(key="start").disabled
    assert any("Add the second video too" in c.value for c in form.caption)
    form.file_uploader[1].set_value(("front.mp4", content, "video/mp4"))
    form.run()
    assert not form.button(key="start").disabled
    next(s for s in form.selectbox if s.label.startswith("Where")).set_value(
        next(iter(cache.calibrations()))
    )
    field(form, "Time between").set_value(0.35)
    field(form, "Site").set_value("Hall 2")
    field(form, "Job").set_value("packing")
    form.button(key="start").click().run()
    request = queue.request(queue.jobs()[0].id)
    assert [v.name for v in request.videos] == ["lift.mp4", "front.mp4"]
    assert (request.site, request.job) == ("Hall 2", "packing")
    assert request.settings.two_view.given_offset_s == 0.35
    assert Path(request.settings.two_view.calibration).stem == "Hall_2_packing"


def test_a_second_video_goes_when_the_second_camera_is_switched_off(form, library, tmp_path):
    content = write_clip(tmp_path / "a.mp4").read_bytes()
    upload(form, content=content)
    form.toggle[0].set_value(True).run()
    form.file_uploader[1].set_value(("front.mp4", content, "video/mp4"))
    form.run()
    form.toggle[0].set_value(False).run()
    assert [p.name for p in library.uploads.rglob("*.mp4")] == ["lift.mp4"]
    assert not form.button(key="start").disabled


@pytest.mark.parametrize(
    ("label", "value", "sentence"),
    [
        ("Body height", 175.0, "Stature must lie between 1 and 2.3 m, got 175."),
        ("Body height", 0.0, "Stature must lie between"),
        ("Body mass", 5.0, "Body mass must lie between 25 and 300 kg, got 5."),
        ("Load", -1.0, "Load must lie between 0 and 500 kg, got -1."),
        ("Lifts per minute", 90.0, "Lifting frequency must lie between"),
        ("Lifting lasts", 25.0, "Duration must lie between 0 and 24 hours, got 25."),
        ("Light work after it", -2.0, "Recovery must lie between"),
    ],
)
def test_a_wrong_value_is_said_next_to_its_field(form, tmp_path, label, value, sentence):
    upload(form, content=write_clip(tmp_path / "a.mp4").read_bytes())
    assert not form.button(key="start").disabled
    field(form, label).set_value(value)
    form.run()
    assert sentence in html(form)
    assert form.button(key="start").disabled
    field(form, label).set_value(None)
    form.run()
    assert sentence not in html(form)
    assert not form.button(key="start").disabled


def test_every_field_explains_itself(form):
    for widget in (*form.number_input, *form.text_input):
        assert widget.help, widget.label
    for label in ("How good is the grip", "Must the load", "Hands", "Sex"):
        assert field(form, label).help


def test_an_upload_is_on_disk_at_once_under_a_safe_name(form, library, tmp_path):
    content = write_clip(tmp_path / "a.mp4").read_bytes()
    upload(form, "../My lift (1)%.MP4", content)
    found = list(library.uploads.rglob("*.mp4"))
    assert [path.name for path in found] == ["My_lift_1.mp4"]
    assert found[0].read_bytes() == content
    assert "320 × 180" in form.success[0].value


def test_an_upload_the_user_takes_back_is_deleted(form, library, tmp_path):
    upload(form, content=write_clip(tmp_path / "a.mp4").read_bytes())
    form.file_uploader[0].set_value(None)
    form.run()
    assert not list(library.uploads.rglob("*.mp4"))
    assert form.button(key="start").disabled


@pytest.mark.parametrize(
    "content", [b"", b"this is text, not a video", b"\0" * 4096], ids=["empty", "text", "zeros"]
)
def test_a_bad_upload_is_refused_in_the_engines_words(form, library, content):
    upload(form, "bad.mp4", content)
    assert "bad.mp4" in form.error[0].value
    assert form.button(key="start").disabled
    assert not list(library.uploads.rglob("bad.mp4"))
    form.run()
    assert "bad.mp4" in form.error[0].value, "the reason stays until the file is taken back"


def test_a_sample_fills_the_form(form):
    field(form, "Where is the video").set_value("Use a sample")
    form.run()
    assert not form.exception
    sample = cache.samples()[0]
    assert field(form, "Body height").value == sample.values["stature_m"]
    assert field(form, "Load").value == sample.values["load_kg"]
    assert field(form, "Name of the trial").value == sample.title
    assert not form.button(key="start").disabled
    last = cache.samples()[-1]
    form.radio(key="sample").set_value(last.key).run()
    assert field(form, "Name of the trial").value == last.title
    assert field(form, "Load").value == last.values.get("load_kg")


def test_the_request_holds_what_the_form_says(form, queue, any_video):
    upload(form, content=b"slow")
    field(form, "Pseudonym").set_value("P07")
    field(form, "Body height").set_value(1.82)
    field(form, "Sex").set_value("female")
    field(form, "Name of the trial").set_value("Crate")
    field(form, "Load").set_value(14.5)
    field(form, "Hands").set_value(2)
    field(form, "How good").set_value("poor")
    field(form, "Lifts per minute").set_value(3.0)
    field(form, "Lifting lasts").set_value(2.0)
    field(form, "Light work").set_value(1.0)
    field(form, "Must the load").set_value(True)
    form.run()
    form.button(key="start").click().run()
    assert not form.exception
    request = queue.request(form.query_params["job"])
    assert (request.label, request.subject.label) == ("Crate", "P07")
    assert request.subject.stature_m == 1.82
    assert request.subject.sex == "female"
    task = request.task
    assert (task.load_kg, task.hands, task.coupling) == (14.5, 2, "poor")
    assert (task.frequency_per_min, task.duration_h, task.recovery_h) == (3.0, 2.0, 1.0)
    assert task.destination_control is True


def test_a_job_that_ends_shows_its_trial(form, queue, any_video):
    upload(form, content=b"go")
    field(form, "Name of the trial").set_value("Crate")
    form.run()
    form.button(key="start").click().run()
    job_id = form.query_params["job"]
    wait(lambda: queue.read(job_id).state is JobState.DONE)
    form.run()
    assert form.query_params["trial"] == job_id
    assert form.title[0].value == "Crate"
    assert "ll-verdict" in html(form)


def test_a_running_job_shows_its_step_and_can_be_cancelled(form, queue, any_video, library):
    upload(form, content=b"slow")
    form.button(key="start").click().run()
    job_id = form.query_params["job"]
    wait(lambda: queue.read(job_id).stage == "pose")
    form.run()
    assert not form.exception
    assert "Following the person" in form.progress[0].text
    form.button(key="cancel").click().run()
    wait(lambda: queue.read(job_id).state is JobState.CANCELLED)
    form.run()
    assert "cancelled; nothing was kept" in form.info[0].value
    assert library.is_empty


def test_a_job_that_fails_says_why_and_keeps_what_was_entered(form, queue, any_video):
    upload(form, "clip.mp4", b"fail")
    field(form, "Load").set_value(11.0)
    form.run()
    form.button(key="start").click().run()
    job_id = form.query_params["job"]
    wait(lambda: queue.read(job_id).state is JobState.FAILED)
    form.run()
    assert form.error[0].value == "No person was found in clip.mp4; film the whole body."
    form.button(key="again").click().run()
    assert not form.exception
    assert field(form, "Load").value == 11.0
    assert "clip.mp4" in form.success[0].value
    assert not form.button(key="start").disabled


def test_the_form_is_empty_after_a_start(form, queue, any_video):
    upload(form, content=b"slow")
    field(form, "Load").set_value(11.0)
    form.run()
    form.button(key="start").click().run()
    form.query_params.pop("job")
    form.run()
    assert field(form, "Load").value is None
    assert form.button(key="start").disabled


def test_a_job_nobody_knows_is_one_sentence(form):
    form.query_params["job"] = "nothing"
    form.run()
    assert "There is no job" in form.error[0].value
    assert not form.exception
