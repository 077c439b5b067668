"""A trial of the library is assessed anew: a new version of it, or nothing at all."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path
from typing import Any

import pytest

from engine.corrections import NO_CORRECTIONS, Corrections, read_corrections
from engine.datatypes import Subject
from engine.errors import Cancelled, ConfigError, DataError
from engine.jobs import worker
from engine.jobs.local import JobQueue, JobRequest, JobState
from engine.jobs.renewal import ask_again, renew
from engine.pipeline import assess_pose
from engine.storage.curation import EditConflict
from engine.storage.results import read_result, write_result
from tests.builders import make_trial, make_view_pose
from tests.engine.jobs.conftest import COMMAND

ADDED = Corrections().correct_lift(None, (0.5, 1.5), by="AB", on="2026-11-22T14:05:00+00:00")
OUTSIDE = Corrections().correct_lift(None, (50.0, 51.0))


@pytest.fixture(scope="module")
def result() -> Any:
    trial = make_trial(label="Crate", subject=Subject(label="P07", stature_m=1.75))
    return assess_pose(trial, make_view_pose(n_frames=60))


@pytest.fixture
def idle(queue: JobQueue, monkeypatch: pytest.MonkeyPatch, result: Any) -> JobQueue:
    """A queue that starts nothing by itself, on a library with one trial."""
    monkeypatch.setattr(JobQueue, "_start", lambda *_: None)
    write_result(result, queue.library.folder("one"))
    return queue


def ask(queue: JobQueue, corrections: Corrections = ADDED) -> JobRequest:
    version = queue.library.record("one").version
    return ask_again(queue.library, "one", corrections, version=version)


def work(queue: JobQueue, job_id: str) -> Any:
    worker.main([str(queue.root / job_id)], command=COMMAND)
    return queue.store.read(job_id)


def lifts(queue: JobQueue) -> list[float]:
    return [round(x.start_s, 1) for x in read_result(queue.library.folder("one")).lifts]


def test_a_request_to_correct_survives_the_disk(idle):
    request = ask(idle)
    back = JobRequest.from_json(request.as_json())
    assert (back.trial_id, back.based_on) == ("one", request.based_on)
    assert back.corrections == ADDED
    assert back.corrections.lifts[0].by == "AB"
    assert (back.label, back.subject.label, back.videos) == ("Crate", "P07", ())


def test_requests_from_before_corrections_are_still_read(tmp_path):
    plain = json.loads(JobRequest(videos=(tmp_path / "a.mp4",), label="L").as_json())
    for key in ("corrections", "trial_id", "based_on"):
        del plain[key]
    for version in (2, 1):
        back = JobRequest.from_json(json.dumps({**plain, "version": version}))
        assert (back.corrections, back.trial_id) == (NO_CORRECTIONS, "")


def test_damaged_corrections_of_a_request_are_one_sentence(tmp_path):
    plain = json.loads(JobRequest(videos=(tmp_path / "a.mp4",)).as_json())
    plain["corrections"] = {"lifts": [{"found": 3}]}
    with pytest.raises(DataError, match="can't be read"):
        JobRequest.from_json(json.dumps(plain))


def test_the_trial_gets_a_new_version_and_keeps_all_that_was_added(idle):
    library = idle.library
    (day,) = [entry.created for entry in library.entries()]
    library.add_note("one", "The floor was wet.")
    recording = library.folder("one") / "reference" / "markers.trc"
    recording.parent.mkdir()
    recording.write_text("kept")
    job_id = idle.submit(ask(idle))
    assert idle.store.read(job_id).trial_id == "one", "known while it waits"
    status = work(idle, job_id)
    assert (status.state, status.trial_id, status.message) == (JobState.DONE, "one", "")
    assert 0.5 in lifts(idle)
    record = library.record("one")
    assert [r.version for r in record.results] == [1, 2]
    assert record.notes[0].text == "The floor was wet."
    assert recording.read_text() == "kept"
    assert read_corrections(read_result(library.folder("one")).document) == ADDED
    (entry,) = library.entries()
    assert (entry.id, entry.label, entry.created) == ("one", "Crate", day)
    assert not library.has(job_id)
    assert [p for p in library.trials.iterdir() if p.name.startswith(".")] == []


def test_taking_back_gives_what_was_there(idle):
    before = lifts(idle)
    work(idle, idle.submit(ask(idle)))
    assert lifts(idle) != before
    work(idle, idle.submit(ask(idle, NO_CORRECTIONS)))
    assert lifts(idle) == before
    assert len(idle.library.record("one").results) == 3


def test_who_has_not_seen_the_newest_state_is_told_so(idle):
    version = idle.library.record("one").version
    ask_again(idle.library, "one", ADDED, version=version)
    with pytest.raises(EditConflict, match="Somebody else changed this trial"):
        ask_again(idle.library, "one", NO_CORRECTIONS, version=version)


def test_one_trial_is_assessed_anew_by_one_job_at_a_time(idle):
    first = idle.submit(ask(idle))
    with pytest.raises(ConfigError, match="being assessed anew already"):
        idle.submit(ask(idle))
    assert [job.id for job in idle.renewals("one")] == [first]
    idle.store.change(first, expected=tuple(JobState), state=JobState.CANCELLED)
    assert idle.submit(ask(idle)) != first


def test_a_result_that_changed_meanwhile_is_not_replaced(idle, result):
    job_id = idle.submit(ask(idle))
    other = dataclasses.replace(result, warnings=("assessed by somebody else",))
    write_result(other, idle.library.folder("one"))
    status = work(idle, job_id)
    assert status.state is JobState.FAILED
    assert "Somebody else assessed this trial anew" in status.message
    assert read_result(idle.library.folder("one")).warnings == other.warnings


def test_a_change_in_the_last_moment_is_noticed_too(idle, result):
    request = ask(idle)
    folder = idle.root / "job"
    folder.mkdir()

    def reassess(_stored: Any, _corrections: Any, out: Path, *_: Any) -> Path:
        other = dataclasses.replace(result, warnings=("assessed by somebody else",))
        write_result(other, idle.library.folder("one"))
        return write_result(result, out)

    with pytest.raises(DataError, match="Somebody else assessed"):
        renew(idle.library, folder, request, lambda *_: None, reassess)
    kept = read_result(idle.library.folder("one"))
    assert kept.warnings == ("assessed by somebody else",)
    assert [p.name for p in idle.library.trials.iterdir()] == ["one"]


def test_a_deleted_trial_is_not_brought_back(idle):
    request = ask(idle)
    job_id = idle.submit(request)
    idle.library.delete("one")
    with pytest.raises(ConfigError, match="deleted meanwhile"):
        renew(idle.library, idle.root / job_id, request, lambda *_: None, worker._reassess)
    assert worker.main([str(idle.root / job_id)], command=COMMAND) == ConfigError.exit_code
    assert not idle.library.has("one")
    assert idle.store.all() == (), "what was to be corrected is forgotten with the trial"


def test_what_can_not_be_followed_is_said_and_nothing_changes(idle):
    before = (idle.library.folder("one") / "trial.json").read_bytes()
    status = work(idle, idle.submit(ask(idle, OUTSIDE)))
    assert status.state is JobState.FAILED
    assert "A lift must lie within the clip" in status.message
    assert (idle.library.folder("one") / "trial.json").read_bytes() == before


def test_a_cancelled_correction_changes_nothing(idle, monkeypatch):
    before = (idle.library.folder("one") / "trial.json").read_bytes()
    job_id = idle.submit(ask(idle))

    def reassess(*given: Any) -> Path:
        idle.cancel(job_id)
        given[-1]("scene", 0, 0)
        raise AssertionError("nobody wants this any more")

    monkeypatch.setattr(worker, "_reassess", reassess)
    code = worker.main([str(idle.root / job_id)], command=COMMAND)
    assert code == Cancelled.exit_code
    assert idle.store.read(job_id).state is JobState.CANCELLED
    assert (idle.library.folder("one") / "trial.json").read_bytes() == before


@pytest.mark.parametrize("is_moved", [False, True])
def test_finished_work_is_not_done_twice(idle, monkeypatch, is_moved):
    """A worker was killed after it wrote the new version, before or after it was moved."""
    job_id = idle.submit(ask(idle))
    request = idle.request(job_id)
    folder = idle.root / job_id
    if is_moved:
        renew(idle.library, folder, request, lambda *_: None, worker._reassess)
    else:
        stored = read_result(idle.library.folder("one"))
        worker._reassess(stored, ADDED, folder / "result", (), lambda *_: None)
    monkeypatch.setattr(worker, "_reassess", lambda *_: pytest.fail("the work was done already"))
    assert work(idle, job_id).state is JobState.DONE
    assert 0.5 in lifts(idle)
    assert len(idle.library.record("one").results) == 2


def test_a_new_trial_can_be_told_its_lifts(idle, tmp_path, monkeypatch):
    seen = []
    monkeypatch.setattr(worker, "_assess_corrected", lambda c: seen.append(c) or _assess)
    (tmp_path / "a.mp4").write_text("")
    job_id = idle.submit(JobRequest(videos=(tmp_path / "a.mp4",), corrections=ADDED))
    assert work(idle, job_id).state is JobState.DONE
    assert seen == [ADDED]
    assert idle.library.has(job_id)


def _assess(trial: Any, _config: Any, folder: Path, _progress: Any) -> Path:
    return write_result(assess_pose(trial, make_view_pose(n_frames=60)), folder)
