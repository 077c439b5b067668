"""Reading the layout of a data set: what is found, and what is said when something lacks."""

import json

import numpy as np
import pytest

from engine.errors import ConfigError, DataError
from engine.validation.protocol.dataset import parse_views, read_dataset
from tests.engine.validation.protocol.studies import make_camera, write_dataset


def test_persons_trials_and_cameras_are_found(tmp_path):
    found = read_dataset(write_dataset(tmp_path / "lab", tasks=("FK", "KS")))
    assert [s.label for s in found.subjects] == ["S1", "S2"]
    assert found.tasks == ("FK", "KS")
    assert len(found.trials) == 8
    first = found.subjects[0]
    assert (first.sex, first.stature_m, first.mass_kg) == ("female", 1.7, 70.0)
    assert [c.name for c in first.cameras] == ["cam90", "cam135"]
    assert first.trials[0].events_s == {"place": 1.0}
    assert not found.is_synthetic


def test_views_stand_in_the_order_of_the_cameras_not_of_the_file_names(tmp_path):
    folder = write_dataset(tmp_path / "lab")
    (trial, *_) = read_dataset(folder).trials
    assert [v.name for v in trial.videos] == ["cam90.mp4", "cam135.mp4"]
    (one, *_) = read_dataset(folder, views="second").trials
    assert [v.name for v in one.videos] == ["cam135.mp4"]
    assert [c.name for c in read_dataset(folder, views="second").subjects[0].cameras] == ["cam135"]


def test_without_cameras_numbers_in_names_count_as_numbers(tmp_path):
    folder = write_dataset(tmp_path / "lab", with_cameras=False)
    (trial, *_) = read_dataset(folder).trials
    assert [v.name for v in trial.videos] == ["cam90.mp4", "cam135.mp4"]


def test_task_and_repetition_may_stand_in_the_folder_s_name(tmp_path):
    folder = write_dataset(tmp_path / "lab", persons=("S1",))
    for path in folder.rglob("trial.json"):
        path.unlink()
    assert [(t.task, t.repetition) for t in read_dataset(folder).trials] == [("FK", 1), ("FK", 2)]


def test_markers_of_the_truth_serve_where_there_is_no_trc(tmp_path):
    folder = write_dataset(tmp_path / "lab", persons=("S1",))
    trial = folder / "S1" / "S1_FK_01"
    (trial / "markers.trc").unlink()
    np.savez(trial / "truth.npz", time=np.arange(3))
    found = read_dataset(folder)
    assert found.trials[0].markers.name == "truth.npz"
    assert found.is_synthetic


def spoil_view(trial):
    (trial / "cam135.mp4").unlink()


def spoil_markers(trial):
    (trial / "markers.trc").unlink()


def spoil_json(trial):
    (trial / "trial.json").write_text("{")


def spoil_repetition(trial):
    (trial / "trial.json").write_text(json.dumps({"task": "FK", "repetition": "first"}))


def spoil_events(trial):
    (trial / "trial.json").write_text(
        json.dumps({"task": "FK", "repetition": 1, "events_s": {"place": "late"}})
    )


def spoil_escape(trial):
    (trial / "trial.json").write_text(
        json.dumps({"task": "FK", "repetition": 1, "videos": ["../../../a.mp4", "cam90.mp4"]})
    )


@pytest.mark.parametrize(
    ("spoil", "words"),
    [
        (spoil_view, "S1/S1_FK_01 has no video cam135: one view is missing"),
        (spoil_markers, "S1/S1_FK_01 holds 0 TRC files, expected markers.trc"),
        (spoil_json, "S1_FK_01/trial.json is no JSON file"),
        (spoil_repetition, "repetition of S1/S1_FK_01 must be a whole number"),
        (spoil_events, "events_s of S1/S1_FK_01"),
        (spoil_escape, "lies outside of its folder"),
    ],
    ids=["view", "markers", "json", "repetition", "events", "escape"],
)
def test_a_trial_that_lacks_something_is_named_with_what_to_do(tmp_path, spoil, words):
    folder = write_dataset(tmp_path / "lab")
    spoil(folder / "S1" / "S1_FK_01")
    with pytest.raises(DataError, match=words) as raised:
        read_dataset(folder)
    assert raised.value.exit_code == 3
    assert "--skip-unusable" in str(raised.value)
    found = read_dataset(folder, skip_unusable=True)
    assert len(found.trials) == 3
    assert words.split(":")[0] in found.problems[0]


def test_one_missing_view_can_be_done_without(tmp_path):
    folder = write_dataset(tmp_path / "lab")
    spoil_view(folder / "S1" / "S1_FK_01")
    assert len(read_dataset(folder, views="first").trials) == 4
    with pytest.raises(DataError, match="cam135"):
        read_dataset(folder, views="second")


def test_an_unknown_person_is_named_with_those_that_are_there(tmp_path):
    with pytest.raises(ConfigError, match=r"no person 'S9'; it has S1, S2"):
        read_dataset(write_dataset(tmp_path / "lab"), persons=("S9",))
    assert [s.label for s in read_dataset(tmp_path / "lab", persons=("S2",)).subjects] == ["S2"]


@pytest.mark.parametrize("name", ["missing", "empty", "file"])
def test_what_is_no_data_set_is_refused(tmp_path, name):
    (tmp_path / "empty").mkdir()
    (tmp_path / "file").touch()
    with pytest.raises(DataError, match=r"docs/datasets\.md"):
        read_dataset(tmp_path / name)


def test_a_camera_without_its_matrix_is_refused(tmp_path):
    folder = write_dataset(tmp_path / "lab", persons=("S1",))
    camera = make_camera("cam90")
    del camera["K"]
    (folder / "S1" / "subject.json").write_text(json.dumps({"calibration": [camera]}))
    with pytest.raises(DataError, match=r"calibration in S1/subject\.json"):
        read_dataset(folder)


def test_views_are_two_or_one_by_name():
    assert [parse_views(t) for t in ("2", "first", " Second ")] == ["2", "first", "second"]
    with pytest.raises(ConfigError, match="--views"):
        parse_views("3")
