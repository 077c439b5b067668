import re
import time

import pytest

from dashboard import cache, manage_cache
from dashboard.trial_list import PAGE_SIZE
from engine.errors import ConfigError
from engine.jobs.local import JobRequest, JobState
from engine.storage.results import write_result
from tests.builders import make_trial_result
from tests.dashboard.results import add_trial
from tests.dashboard.test_app import cards, html, press


def test_an_empty_library_invites_to_a_first_assessment(app):
    app.run()
    assert "No trials yet" in html(app)
    app.button(key="first-upload").click().run()
    assert app.title[0].value == "New assessment"


def test_an_empty_library_offers_the_samples(app):
    assert cache.samples(), "the project ships samples"
    app.run()
    app.button(key="first-sample").click().run()
    assert app.title[0].value == "New assessment"
    assert app.radio(key="sample").value == cache.samples()[0].key
    assert app.number_input[0].value == cache.samples()[0].values["stature_m"]


def test_a_trial_is_listed_with_index_interval_and_flag(app, trial_id):
    app.run()
    shown = html(app)
    assert "Crate to shelf" in shown
    assert "2 lifts" in shown
    assert "<b>2.3</b>" in shown
    assert "lifting index, 1.9" in shown
    assert "ll-shape-high" in shown
    assert "High risk" in shown


def test_a_trial_without_load_has_no_index(app, library, tmp_path):
    add_trial(library, tmp_path, load_kg=None)
    app.run()
    assert "no lifting index" in html(app)


def test_a_trial_without_flags_is_not_called_fine(app, library):
    write_result(make_trial_result(lis=(float("nan"),)), library.folder("plain"))
    app.run()
    assert "Not judged" in html(app)
    assert "No concern" not in html(app)


def test_names_are_shown_as_they_are_written(app, library, tmp_path):
    add_trial(library, tmp_path, label="<b>A & B</b>")
    app.run()
    assert "&lt;b&gt;A &amp; B&lt;/b&gt;" in html(app)
    assert not app.exception


def test_a_trial_opens(app, trial_id):
    app.run()
    press(app, "open", trial_id)
    assert app.title[0].value == "Crate to shelf"
    assert app.query_params["trial"] == trial_id


def test_search_narrows_the_list(app, library, tmp_path, trial_id):
    add_trial(library, tmp_path, label="Sack onto pallet")
    app.run()
    app.text_input[0].set_value("sack PALLET").run()
    assert "Sack onto pallet" in html(app)
    assert "Crate to shelf" not in html(app)
    app.text_input[0].set_value("nothing like it").run()
    assert "No trial matches" in app.info[0].value


def test_filters_stand_in_the_address_and_narrow(app, library, trial_id):
    write_result(make_trial_result(lis=(float("nan"),)), library.folder("plain"))
    app.query_params["level"] = "Not judged"
    app.run()
    assert opened(app) == {"plain"}
    assert "**1 trial** · 1 high risk · 1 not judged" in captions(app)


def test_a_trial_is_found_by_what_people_called_it(app, library, trial_id):
    app.run()
    library.edit(trial_id, version=1, site="Hall 3", job="Packing", tags=["pilot"])
    manage_cache.forget_summaries()
    app.run()
    assert "Hall 3 · Packing" in html(app)
    assert '<span class="ll-label">pilot</span>' in html(app)
    app.text_input(key="search").set_value("packing PILOT").run()
    assert "Crate to shelf" in html(app)


@pytest.mark.parametrize(
    ("filters", "expected"),
    [
        ({"site": "Hall 4"}, {"a"}),
        ({"work": "Loading"}, {"b"}),
        ({"person": "P02"}, {"b"}),
        ({"tags": "pilot"}, {"a"}),
        ({"site": "Hall 4", "work": "Loading"}, set()),
    ],
)
def test_filters_of_the_address_hold(app, library, filters, expected):
    for name in "ab":
        write_result(make_trial_result(), library.folder(name))
    library.entries()
    library.edit("a", version=1, site="Hall 4", tags=["pilot"])
    library.edit("b", version=1, job="Loading", person="P02")
    manage_cache.forget_summaries()
    for name, value in filters.items():
        app.query_params[name] = value
    app.run()
    assert opened(app) == expected


def test_a_long_list_has_pages(app, library, tmp_path):
    result = make_trial_result()
    for number in range(PAGE_SIZE + 2):
        write_result(result, library.folder(f"t{number:03d}"))
    app.run()
    assert len(opened(app)) == PAGE_SIZE
    first = opened(app)
    app.button(key="page-next").click().run()
    assert len(opened(app)) == 2
    assert not first & opened(app)
    assert app.query_params["page"] == "2"
    assert app.button(key="page-next").disabled
    app.text_input(key="search").set_value("e").run()
    assert "page" not in app.query_params


def test_a_trial_gets_name_site_job_and_tags(app, library, trial_id):
    app.run()
    press(app, "edit", trial_id)
    app.text_input(key=f"edit_label_{trial_id}").set_value("Crate to rack")
    app.text_input(key=f"edit_site_{trial_id}").set_value(" Hall 4 ")
    app.text_input(key=f"edit_job_{trial_id}").set_value("Loading")
    app.button(key="edit-save").click().run()
    assert not app.exception
    known = library.record(trial_id)
    assert (known.names.label, known.names.site, known.names.job) == (
        "Crate to rack",
        "Hall 4",
        "Loading",
    )
    assert "Crate to rack" in html(app)


def test_an_edit_of_two_people_is_noticed(app, library, trial_id):
    app.run()
    press(app, "edit", trial_id)
    library.edit(trial_id, version=1, site="Hall 9")
    app.text_input(key=f"edit_site_{trial_id}").set_value("Hall 4")
    app.button(key="edit-save").click().run()
    assert "changed" in app.error[0].value
    assert library.record(trial_id).names.site == "Hall 9"


def opened(app):
    """Which trials can be opened."""
    return set(re.findall(r'data-action="open" data-id="([^"]+)"', " ".join(cards(app))))


def captions(app):
    return [caption.value for caption in app.caption]


def test_all_samples_are_assessed_on_one_click(app, monkeypatch):
    monkeypatch.setattr("engine.jobs.local.JobQueue.advance", lambda _self: None)
    app.run()
    app.button(key="first-demo").click().run()
    waiting = cache.job_queue().jobs()
    assert len(waiting) == len(cache.samples())
    request = cache.job_queue().request(waiting[0].id)
    assert request.site == "Samples"
    assert request.subject.stature_m == cache.samples()[0].values["stature_m"]
    assert "No trials yet" not in html(app)


def test_a_trial_is_deleted_only_after_a_second_word(app, library, trial_id):
    app.run()
    press(app, "delete", trial_id)
    assert library.has(trial_id)
    app.button(key="confirm-delete").click().run()
    assert not library.has(trial_id)
    assert "No trials yet" in html(app)


def test_a_deletion_can_be_called_off(app, library, trial_id):
    app.run()
    press(app, "delete", trial_id)
    app.button(key="keep").click().run()
    assert library.has(trial_id)
    assert not app.exception


def test_a_damaged_result_is_listed_and_can_be_deleted(app, library):
    folder = library.folder("broken")
    folder.mkdir()
    (folder / "trial.json").write_text("{")
    app.run()
    assert "Damaged result" in html(app)
    assert not opened(app)
    press(app, "delete", "broken")
    app.button(key="confirm-delete").click().run()
    assert not folder.exists()


@pytest.fixture
def failed_job(library, tmp_path, monkeypatch):
    """A job that failed, as its worker left it."""
    video = library.upload_folder("u") / "clip.mp4"
    video.write_bytes(b"video")
    monkeypatch.setattr("engine.jobs.local.JobQueue.advance", lambda _self: None)
    queue = cache.job_queue()
    job_id = queue.submit(JobRequest(videos=(video,), label="Crate"))
    queue.store.change(
        job_id,
        expected=(JobState.QUEUED,),
        state=JobState.FAILED,
        message="No person was found in clip.mp4; film the whole body.",
        exit_code=3,
        ended_s=time.time(),
    )
    return job_id


def test_a_failed_job_is_shown_with_its_reason_until_it_is_dismissed(app, failed_job):
    app.run()
    assert "No person was found" in app.error[0].value
    app.button(key=f"dismiss-{failed_job}").click().run()
    assert not app.error
    with pytest.raises(ConfigError):
        cache.job_queue().read(failed_job)


def test_a_failed_job_can_be_changed_and_tried_again(app, failed_job):
    app.run()
    app.button(key=f"show-{failed_job}").click().run()
    assert app.query_params["job"] == failed_job
    assert "No person was found" in app.error[0].value
    app.button(key="again").click().run()
    assert "job" not in app.query_params
    assert app.text_input[1].value == "Crate"
    assert "clip.mp4" in app.success[0].value
    assert not app.button(key="start").disabled


def test_a_failed_job_can_be_discarded(app, library, failed_job):
    app.run()
    app.button(key=f"show-{failed_job}").click().run()
    app.button(key="discard").click().run()
    assert app.title[0].value == "New assessment"
    assert not list(library.root.rglob("clip.mp4"))
