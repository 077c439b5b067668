"""Putting a trial right on its page: what is asked, what is computed, what is taken back."""

from __future__ import annotations

import dataclasses
import shutil
from pathlib import Path

import numpy as np
import pytest

from dashboard import labels
from engine.corrections import (
    LIMBS,
    Corrections,
    read_corrections,
)
from engine.datatypes import PersonBox, Subject, SubjectState
from engine.jobs import worker
from engine.jobs.local import JobQueue, JobState
from engine.people_picture import draw_boxes, find_people, read_clocks, read_moment
from engine.pipeline import assess_pose
from engine.storage.results import read_result, write_result
from tests.builders import make_trial, make_trial_result, make_two_views, make_view_pose
from tests.dashboard.results import write_clip
from tests.dashboard.test_app import html
from tests.dashboard.test_trial import fill, open_trial, press


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A result as an assessment leaves it, with a person beside the one who is followed."""
    folder = tmp_path_factory.mktemp("made")
    pose = make_view_pose(n_frames=60)
    other = PersonBox(1000.0, 200.0, 1100.0, 600.0, state=SubjectState.TRACKED)
    box = np.tile([300.0, 100.0, 600.0, 700.0], (60, 1))
    pose = dataclasses.replace(pose, box=box, others=((other,),) * 60)
    trial = make_trial(label="Crate", subject=Subject(label="P07", stature_m=1.75))
    overlay = write_clip(folder / "overlay.mp4", seconds=2.0)
    return write_result(assess_pose(trial, pose), folder / "result", overlay=overlay)


@pytest.fixture
def trial_id(library, made, monkeypatch):
    """That result in a library whose queue starts nothing by itself."""
    monkeypatch.setattr(JobQueue, "_start", lambda *_: None)
    shutil.copytree(made, library.folder("one"))
    return "one"


def choose(app, kind):
    title = labels.CORRECTIONS[kind]
    next(g for g in app.button_group if title in g.options).set_value(title)
    app.run()


def put(app, label, value):
    next(n for n in app.number_input if n.label == label).set_value(value)


def lift_times(app, start, end):
    put(app, "The load leaves its place (s)", start)
    put(app, "The load is down (s)", end)


def texts(app):
    return [text.value for text in app.text]


def work(library):
    """Do what waits in the queue, in this process."""
    queue = JobQueue(library)
    (job,) = (job for job in queue.store.all() if not job.state.is_over)
    worker.main([str(queue.root / job.id)])
    return queue.store.read(job.id)


def stored(library):
    return read_result(library.folder("one"))


def add_lift(app, start=0.5, end=1.5):
    next(s for s in app.selectbox if s.label == "Which lift").set_value(-1)
    app.run()
    lift_times(app, start, end)
    press(app, "Add this lift")


def test_a_missed_lift_is_added_computed_and_taken_back(app, library, trial_id):
    before = len(stored(library).lifts)
    open_trial(app, trial_id)
    add_lift(app)
    assert not app.exception
    assert "A lift added from 0.50 to 1.50 s." in texts(app)
    assert any(caption.value == "Not computed yet" for caption in app.caption)
    fill(app, "Corrected by", "AB")
    press(app, "Compute anew")
    assert any("is being assessed anew" in text.value for text in app.markdown)
    assert work(library).state is JobState.DONE
    app.run()
    assert not app.exception
    result = stored(library)
    (fix,) = read_corrections(result.document).all
    assert (fix.by, fix.on != "") == ("AB", True)
    assert any(abs(x.start_s - 0.5) < 0.02 for x in result.lifts)
    assert any(caption.value.startswith("Corrected by AB, ") for caption in app.caption)
    shown = html(app)
    assert "Corrected by hand by AB" in shown
    assert "1 correction by hand" in shown
    press(app, "Take back")
    assert any("Taken back, not computed yet" in caption.value for caption in app.caption)
    press(app, "Compute anew")
    assert work(library).state is JobState.DONE
    assert len(stored(library).lifts) == before
    assert not read_corrections(stored(library).document).all


def test_a_false_lift_is_removed(app, library, trial_id):
    fix = Corrections().correct_lift(None, (0.5, 1.5))
    result = stored(library)
    worker._reassess(result, fix, library.folder("one"), (), lambda *_: None)
    open_trial(app, trial_id)
    chooser = next(s for s in app.selectbox if s.label == "Which lift")
    number = next(n for n, x in enumerate(stored(library).lifts) if abs(x.start_s - 0.5) < 0.02)
    chooser.set_value(number)
    app.run()
    press(app, "This is no lift")
    assert not texts(app), "what was added and removed needs no correction"
    press(app, "Discard")
    chooser.set_value(number)
    app.run()
    lift_times(app, 0.6, 1.4)
    press(app, "Set these times")
    assert "A lift added from 0.60 to 1.40 s." in texts(app)


@pytest.mark.parametrize(
    ("start", "end", "says"),
    [
        (1.5, 0.5, "needs a start before its end, got 1.5 s to 0.5 s"),
        (1.0, 1.0, "needs a start before its end"),
        (0.5, 99.0, "must lie within the clip"),
    ],
)
def test_absurd_times_are_one_sentence_and_keep_nothing(app, trial_id, start, end, says):
    open_trial(app, trial_id)
    add_lift(app, start, end)
    assert says in html(app)
    assert not texts(app)
    assert "Compute anew" not in [button.label for button in app.button]


def test_lifts_can_not_overlap(app, trial_id):
    open_trial(app, trial_id)
    add_lift(app, 0.2, 0.9)
    add_lift(app, 0.8, 1.5)
    assert "overlap" in html(app)
    assert len(texts(app)) == 1


def test_sides_are_exchanged(app, library, trial_id):
    before = stored(library).views[0].image.position
    open_trial(app, trial_id)
    choose(app, "sides")
    next(s for s in app.selectbox if s.label == "What is exchanged").set_value("shins")
    put(app, "From (s)", 0.5)
    put(app, "To (s)", 1.0)
    press(app, "Exchange left and right")
    assert "Left and right lower legs and feet exchanged from 0.50 to 1.00 s." in texts(app)
    press(app, "Compute anew")
    assert work(library).state is JobState.DONE
    assert not np.array_equal(stored(library).views[0].image.position, before)


def test_a_stretch_without_a_picture_is_refused(app, trial_id):
    open_trial(app, trial_id)
    choose(app, "sides")
    put(app, "From (s)", 50.0)
    put(app, "To (s)", 60.0)
    press(app, "Exchange left and right")
    assert "No picture lies between 50 s and 60 s" in html(app)


def test_another_person_is_chosen_and_the_video_is_asked_for(app, library, trial_id):
    open_trial(app, trial_id)
    choose(app, "person")
    assert not app.exception
    assert len(app.get("image")) == 1
    whom = next(r for r in app.radio if r.label == "Whom to follow")
    assert whom.options == ["1: followed now", "2", "Somebody else: draw a box"]
    assert whom.value == 1, "the one who is not followed yet"
    press(app, "Follow this person")
    assert "Another person is followed from 0.00 s on." in texts(app)
    assert any("keeps no original" in info.value for info in app.info)
    (compute,) = [button for button in app.button if button.label == "Compute anew"]
    assert compute.disabled


def test_a_box_can_be_drawn(app, trial_id):
    open_trial(app, trial_id)
    choose(app, "person")
    next(r for r in app.radio if r.label == "Whom to follow").set_value(-1)
    app.run()
    next(s for s in app.slider if s.label == "From left to right (px)").set_value((100, 100))
    app.run()
    press(app, "Follow this person")
    assert not app.exception
    assert "left &lt; right" in html(app)
    next(s for s in app.slider if s.label == "From left to right (px)").set_value((100, 300))
    app.run()
    press(app, "Follow this person")
    assert "Another person is followed from 0.00 s on." in texts(app)


def test_what_somebody_else_changed_meanwhile_is_not_overrun(app, library, trial_id):
    open_trial(app, trial_id)
    add_lift(app)
    library.edit(trial_id, version=library.record(trial_id).version, tags=["seen"])
    press(app, "Compute anew")
    assert "Somebody else changed this trial" in html(app)
    assert not JobQueue(library).store.all()
    assert "A lift added from 0.50 to 1.50 s." in texts(app), "nothing typed is lost"
    press(app, "Compute anew")
    assert len(JobQueue(library).store.all()) == 1


def test_a_correction_that_failed_says_why_until_it_is_dismissed(app, library, trial_id):
    open_trial(app, trial_id)
    add_lift(app)
    press(app, "Compute anew")
    document = library.folder("one") / "trial.json"
    document.write_text(document.read_text().replace('"Crate"', '"Box"'))
    assert work(library).state is JobState.FAILED
    app.run()
    assert any("Somebody else assessed this trial anew" in error.value for error in app.error)
    press(app, "Dismiss")
    assert not app.error


def test_a_running_correction_can_be_cancelled(app, library, trial_id):
    open_trial(app, trial_id)
    add_lift(app)
    press(app, "Compute anew")
    press(app, "Cancel")
    (job,) = JobQueue(library).store.all()
    assert job.cancel_requested_s is not None


def test_every_choice_has_words():
    assert set(labels.LIMBS) == set(LIMBS)
    assert set(labels.CORRECTIONS) == {"lift", "sides", "person"}


# --------------------------------------------------------------------------- one moment


def test_the_picture_of_a_moment_has_its_people(made):
    result = read_result(made)
    (clock,) = read_clocks(result)
    assert clock.to_view(1.25) == 1.25
    people = find_people(result, 0, 1.0)
    assert people.is_followed
    assert people.boxes[1] == (1000.0, 200.0, 1100.0, 600.0)
    picture = read_moment(result, 0, 1.0)
    assert picture.shape == (180, 320, 3)
    drawn = draw_boxes(picture, people.boxes, width_px=result.views[0].info.size_px[0], chosen=1)
    changed = np.argwhere((drawn != picture).any(axis=2))
    assert changed[:, 1].max() > 240, "the box stands where the picture's own px put it"
    assert not np.shares_memory(drawn, picture)


def test_two_videos_have_clocks_of_their_own(tmp_path):
    result = read_result(write_result(make_trial_result(**make_two_views()), tmp_path / "two"))
    first, second = read_clocks(result)
    offset = result.sync.offset_s
    moment = 0.4
    assert first.to_view(moment) - second.to_view(moment) == pytest.approx(offset, abs=0.05)
    for clock in (first, second):
        assert clock.to_trial(clock.to_view(moment)) == pytest.approx(moment)
