"""What users and their computers do to a dashboard, and that nothing is lost by it."""

from __future__ import annotations

import io
import resource
import shutil
import sqlite3
import threading
import tracemalloc

import pytest

from dashboard import cache
from engine.errors import OutputError
from tests.dashboard.results import write_clip
from tests.dashboard.test_app import html, press
from tests.dashboard.test_new_assessment import upload

FULL_AT = 2_000_000


@pytest.fixture
def full_disk():
    """No file may grow beyond two megabytes, as if the disk were full there."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (FULL_AT, hard))
    yield
    resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))


@pytest.fixture
def form(app):
    return app.run().switch_page("views/new_assessment.py").run()


class Zeros(io.RawIOBase):
    """A long upload that takes no memory by itself."""

    def __init__(self, size):
        self.left = size

    def read(self, size=-1):
        size = min(self.left, size if size >= 0 else self.left)
        self.left -= size
        return bytes(size)


def test_a_long_upload_is_written_piece_by_piece(library):
    size = 200 << 20
    tracemalloc.start()
    path = cache.save_upload(Zeros(size), "long.mp4")
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert path.stat().st_size == size
    assert peak < 8 << 20


def test_two_uploads_of_one_name_at_once_are_two(library):
    paths = []

    def save(content):
        paths.append((cache.save_upload(io.BytesIO(content), "lift.mp4"), content))

    threads = [threading.Thread(target=save, args=(bytes([k]) * 3_000_000,)) for k in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert len({path for path, _ in paths}) == 4
    assert all(path.read_bytes() == content for path, content in paths)


@pytest.mark.parametrize(
    ("name", "kept"),
    [
        ("../../etc/lift.mp4", "lift.mp4"),
        ("C:\\Users\\me\\lift.MP4", "lift.mp4"),
        ("🏋️.mov", "video.mov"),
        ("Kiste 🏋️ heben.mp4", "Kiste_heben.mp4"),
        ("إلى الرف.mp4", "إلى_الرف.mp4"),
        (".mp4", "video.mp4"),
        ("a" * 300 + ".mp4", "a" * 60 + ".mp4"),
        ("lift.mp4\0.exe", "lift_mp4.exe"),
        ("con\nfirm.mp4", "con_firm.mp4"),
        ("..", "video"),
    ],
)
def test_a_name_leads_nowhere_else_and_stays_recognisable(library, name, kept):
    path = cache.save_upload(io.BytesIO(b"x"), name)
    assert path.name == kept
    assert path.parent.parent == library.uploads


def test_an_upload_without_room_is_one_sentence_and_leaves_nothing(form, library, full_disk):
    upload(form, "long.mp4", bytes(FULL_AT + 1))
    assert "larger than allowed" in form.error[0].value
    assert form.button(key="start").disabled
    assert not list(library.uploads.iterdir())


def test_a_recording_without_room_leaves_the_earlier_one(library, trial_id, full_disk):
    cache.save_reference(trial_id, "first.trc", io.BytesIO(b"first"))
    with pytest.raises(OutputError, match="The recording can't be written"):
        cache.save_reference(trial_id, "second.trc", Zeros(FULL_AT + 1))
    kept = cache.reference_file(trial_id)
    assert (kept.name, kept.read_bytes()) == ("first.trc", b"first")
    assert [path.name for path in library.folder(trial_id).glob(".*")] == []


def test_a_new_recording_takes_the_place_of_the_earlier_one(library, trial_id):
    cache.save_reference(trial_id, "first.trc", io.BytesIO(b"first"))
    cache.save_reference(trial_id, "second.trc", io.BytesIO(b"second"))
    assert [path.name for path in cache.reference_file(trial_id).parent.iterdir()] == ["second.trc"]


@pytest.mark.parametrize("name", ["overlay.mp4", "tracks.npz", "trial.json"])
def test_a_trial_that_lost_a_file_says_so(app, library, trial_id, name):
    (library.folder(trial_id) / name).unlink(missing_ok=True)
    app.query_params["trial"] = trial_id
    app.run().switch_page("views/trial.py").run()
    assert not app.exception
    if name != "overlay.mp4":
        assert app.error, "what can't be shown is said"


def test_a_trial_whose_folder_went_while_it_was_listed_does_not_open(app, library, trial_id):
    app.run()
    shutil.rmtree(library.folder(trial_id))
    press(app, "open", trial_id)
    assert not app.exception
    assert "Damaged result" in html(app) or app.error


def test_a_result_of_a_newer_program_is_listed_with_the_reason(app, library, trial_id):
    path = library.folder(trial_id) / "trial.json"
    path.write_text(path.read_text().replace('"schema_version": ', '"schema_version": 99'))
    app.run()
    shown = html(app)
    assert "Damaged result" in shown
    assert "newer" in shown or "version" in shown


def test_a_locked_library_still_lists_and_says_why_it_keeps_no_change(app, library, trial_id):
    before = library.record(trial_id).names.site
    app.run()
    press(app, "edit", trial_id)
    with sqlite3.connect(library.root / "library.db", isolation_level=None) as other:
        other.execute("BEGIN IMMEDIATE")
        app.text_input(key=f"edit_site_{trial_id}").set_value("Hall 4")
        app.button(key="edit-save").click().run(timeout=120)
        other.execute("ROLLBACK")
    assert not app.exception
    assert app.error, "the change was not kept, and that is said"
    assert library.record(trial_id).names.site == before


def test_a_clip_that_is_uploaded_while_another_is_assessed_stays(form, library, tmp_path):
    content = write_clip(tmp_path / "a.mp4").read_bytes()
    upload(form, "first.mp4", content)
    upload(form, "second.mp4", content)
    assert form.button(key="start").disabled is False
    assert "second.mp4" in form.success[0].value
