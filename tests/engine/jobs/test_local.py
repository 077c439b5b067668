import os
import signal
import sys

import pytest

import engine.jobs.local as local
from engine.datatypes import Coupling, Subject, Task
from engine.errors import ConfigError
from engine.jobs.local import JobQueue, JobRequest, JobState
from engine.jobs.worker import find_fraction
from engine.storage.library import Library
from engine.storage.results import read_result
from tests.engine.jobs.conftest import COMMAND, wait_until


def wait_for(queue, job_id, *states):
    wait_until(lambda: queue.read(job_id).state in states)
    return queue.read(job_id)


def wait_for_stage(queue, job_id, stage):
    wait_until(lambda: queue.read(job_id).stage == stage)
    return queue.read(job_id)


def ask(tmp_path, words="", label="lift"):
    video = tmp_path / f"{label}.mp4"
    video.write_text(words)
    return JobRequest(videos=(video,), label=label)


def trials(queue):
    return sorted(p.name for p in queue.library.trials.iterdir())


def test_a_request_survives_the_disk(tmp_path):
    request = JobRequest(
        videos=(tmp_path / "a.mp4",),
        subject=Subject(label="P1", stature_m=1.8, sex="female", mass_kg=70),
        task=Task(load_kg=12, hands=2, coupling=Coupling.POOR, destination_control=True),
        config={"pose": {"variant": "full"}},
        label="L",
        site="S",
        job="J",
    )
    back = JobRequest.from_json(request.as_json())
    assert back.subject == request.subject
    assert back.task == request.task
    assert back.videos == (tmp_path.resolve() / "a.mp4",)
    assert (back.label, back.site, back.job) == ("L", "S", "J")
    assert back.settings.pose.variant == "full"
    assert back.settings.pose.backend == "mediapipe"
    assert back.trial.views[0].path == back.videos[0]


@pytest.mark.parametrize(
    "text",
    ["", "[]", "{}", '{"videos": [], "subject": {"height": 3}, "task": {}}'],
    ids=["empty", "list", "no keys", "unknown key"],
)
def test_a_damaged_request_is_one_sentence(text):
    with pytest.raises(ConfigError, match="can't be read"):
        JobRequest.from_json(text)


def test_a_job_ends_as_a_trial_of_the_library(queue, tmp_path):
    job_id = queue.submit(ask(tmp_path))
    status = wait_for(queue, job_id, JobState.DONE)
    assert status.exit_code == 0
    assert status.fraction == 1.0
    assert status.trial_id == job_id
    assert read_result(queue.library.folder(job_id)).document["label"] == "lift"
    assert [entry.label for entry in queue.library.entries()] == ["lift"]
    assert 0 < status.elapsed_s < 20


def test_the_share_that_is_done_only_grows(queue, tmp_path):
    job_id = queue.submit(ask(tmp_path, "slow"))
    wait_until(lambda: queue.read(job_id).done > 20)
    status = queue.read(job_id)
    assert status.total == 600
    assert status.fraction == pytest.approx(0.02 + 0.83 * status.done / 600, abs=1e-9)
    assert find_fraction("overlay", 0, 10) > find_fraction("pose", 10, 10)
    assert find_fraction("overlay", 10, 10) < 1
    assert find_fraction("no such stage", 5, 10) == find_fraction("pose", 0, 0) - 0.02 == 0


def test_another_process_or_tab_sees_the_same(queue, tmp_path):
    job_id = queue.submit(ask(tmp_path, "slow"))
    seen = wait_for_stage(queue, job_id, "pose")
    other = JobQueue(Library(queue.library.root), command=COMMAND)
    assert other.read(job_id).state is JobState.RUNNING
    assert other.read(job_id).pid == seen.pid
    assert other.request(job_id).label == "lift"


def test_jobs_wait_for_their_turn_in_order(queue, tmp_path):
    ids = [queue.submit(ask(tmp_path, label=name)) for name in ("a", "b", "c")]
    waiting = queue.read(ids[2])
    assert waiting.state is JobState.QUEUED
    assert waiting.jobs_ahead >= 1
    assert waiting.label == "c"
    # Nobody looks: each worker starts the next one itself.
    order = queue.root.parent / "order.txt"
    wait_until(lambda: order.exists() and order.read_text().split() == ["a", "b", "c"])
    assert wait_for(queue, ids[2], JobState.DONE).exit_code == 0


def test_two_workers_run_side_by_side(queue, tmp_path):
    queue.max_workers = 2
    ids = [queue.submit(ask(tmp_path, "slow", name)) for name in ("a", "b", "c")]
    states = [queue.read(i).state for i in ids]
    assert states[2] is JobState.QUEUED
    assert JobState.QUEUED not in states[:2]


def test_an_engine_error_arrives_as_its_sentence(queue, tmp_path):
    job_id = queue.submit(ask(tmp_path, "fail"))
    status = wait_for(queue, job_id, JobState.FAILED)
    assert status.message == "No person was found in clip.mp4; film the whole body."
    assert status.exit_code == 3
    assert trials(queue) == []


def test_a_fault_of_the_program_says_so(queue, tmp_path):
    job_id = queue.submit(ask(tmp_path, "bug"))
    status = wait_for(queue, job_id, JobState.FAILED)
    assert "did not foresee" in status.message
    assert "KeyError" in status.message
    assert status.exit_code == 1
    assert "Traceback" in (queue.root / job_id / "worker.log").read_text()


def test_a_killed_worker_is_noticed_and_the_next_job_runs(queue, tmp_path):
    victim = queue.submit(ask(tmp_path, "slow", "victim"))
    heir = queue.submit(ask(tmp_path, "", "heir"))
    first = wait_for_stage(queue, victim, "pose").pid
    os.kill(first, signal.SIGKILL)
    # Most often the computer was switched off: it is tried once more, before those behind it.
    wait_until(lambda: (now := queue.read(victim)).stage == "pose" and now.pid not in (None, first))
    second = queue.read(victim)
    assert second.attempts == 2
    os.kill(second.pid, signal.SIGKILL)
    status = wait_for(queue, victim, JobState.FAILED)
    assert "stopped 2 times without a word" in status.message
    assert wait_for(queue, heir, JobState.DONE).trial_id == heir
    assert trials(queue) == [heir]


def test_a_worker_that_cannot_start_is_noticed(tmp_path):
    for command in ((sys.executable, "-c", "import no_such_module"), (str(tmp_path / "nothing"),)):
        queue = JobQueue(Library(tmp_path / "home"), max_workers=1, command=command)
        job_id = queue.submit(ask(tmp_path))
        assert wait_for(queue, job_id, JobState.FAILED).message


def test_a_running_job_can_be_cancelled(queue, tmp_path):
    job_id = queue.submit(ask(tmp_path, "slow"))
    wait_for_stage(queue, job_id, "pose")
    queue.cancel(job_id)
    status = wait_for(queue, job_id, JobState.CANCELLED)
    assert status.exit_code == 130
    assert status.message == ""
    assert trials(queue) == []


def test_a_waiting_job_that_is_cancelled_never_starts(queue, tmp_path):
    first = queue.submit(ask(tmp_path, "slow", "first"))
    second = queue.submit(ask(tmp_path, "", "second"))
    queue.cancel(second)
    assert queue.read(second).state is JobState.CANCELLED
    wait_for_stage(queue, first, "pose")
    queue.cancel(first)
    wait_for(queue, first, JobState.CANCELLED)
    assert queue.read(second).started_s is None
    assert "second" not in (queue.root.parent / "order.txt").read_text()


def test_a_worker_that_does_not_listen_is_ended(queue, tmp_path, monkeypatch):
    monkeypatch.setattr(local, "CANCEL_GRACE_S", 0.2)
    job_id = queue.submit(ask(tmp_path, "hang"))
    wait_for_stage(queue, job_id, "pose")
    queue.cancel(job_id)
    assert wait_for(queue, job_id, JobState.CANCELLED).exit_code == 130
    assert trials(queue) == []


def test_cancelling_what_has_ended_changes_nothing(queue, tmp_path):
    job_id = queue.submit(ask(tmp_path))
    wait_for(queue, job_id, JobState.DONE)
    queue.cancel(job_id)
    assert queue.read(job_id).state is JobState.DONE


def upload(queue, words):
    video = queue.library.uploads / "5f" / "clip.mp4"
    video.parent.mkdir(parents=True)
    video.write_text(words)
    return video


def test_an_uploaded_video_is_deleted_once_it_is_assessed(queue):
    video = upload(queue, "")
    job_id = queue.submit(JobRequest(videos=(video,), label="u"))
    wait_for(queue, job_id, JobState.DONE)
    assert not video.parent.exists()
    wait_until(lambda: not list(queue.root.rglob("clip.mp4")))


def test_a_failed_job_gives_its_upload_back(queue):
    video = upload(queue, "fail")
    job_id = queue.submit(JobRequest(videos=(video,), label="u"))
    wait_for(queue, job_id, JobState.FAILED)
    request = queue.withdraw(job_id)
    assert request.label == "u"
    assert request.videos[0].read_text() == "fail"
    assert queue.library.uploads in request.videos[0].parents
    assert queue.jobs() == ()


def test_an_upload_that_was_never_assessed_goes_after_a_while(queue, monkeypatch):
    video = upload(queue, "")
    queue.advance()
    assert video.exists()
    monkeypatch.setattr(local, "KEEP_UPLOADS_S", -1.0)
    queue.advance()
    assert list(queue.library.uploads.iterdir()) == []


def test_other_videos_are_left_where_they_are(queue, tmp_path):
    request = ask(tmp_path)
    wait_for(queue, queue.submit(request), JobState.DONE)
    assert request.videos[0].exists()


def test_a_video_that_is_gone_is_said_at_once(queue, tmp_path):
    with pytest.raises(ConfigError, match=r"gone\.mp4 is not there any more"):
        queue.submit(JobRequest(videos=(tmp_path / "gone.mp4",)))
    assert queue.jobs() == ()


@pytest.mark.parametrize("name", ["nothing", "..", ".hidden", ""])
def test_an_unknown_job_is_one_sentence(queue, name):
    with pytest.raises(ConfigError, match="There is no job"):
        queue.read(name)


def test_ended_jobs_can_be_cleared_and_old_ones_go_by_themselves(queue, tmp_path, monkeypatch):
    first = queue.submit(ask(tmp_path, "fail", "first"))
    second = queue.submit(ask(tmp_path, "fail", "second"))
    for job_id in (first, second):
        wait_for(queue, job_id, JobState.FAILED)
    queue.forget(first)
    assert [job.id for job in queue.jobs()] == [second]
    monkeypatch.setattr(local, "KEEP_JOBS_S", -1.0)
    queue.advance()
    assert queue.jobs() == ()


def test_a_job_at_work_cannot_be_cleared(queue, tmp_path):
    job_id = queue.submit(ask(tmp_path, "slow"))
    queue.forget(job_id)
    assert not queue.read(job_id).state.is_over
    with pytest.raises(ConfigError, match="still at work"):
        queue.withdraw(job_id)
