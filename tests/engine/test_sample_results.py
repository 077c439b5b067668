"""Finished samples: there at the first start, gone for good when removed, apart from own trials."""

from __future__ import annotations

import hashlib
import json

import numpy as np
import pytest

from engine import cli_demo, cli_serve, sample_results
from engine.sample_results import (
    SAMPLE_TAG,
    SAMPLES_SITE,
    add_samples,
    find_samples,
    leave_out,
    remove_samples,
    retire_samples,
    shrink_result,
    welcome,
)
from engine.storage.library import Library
from engine.storage.results import RESULT_FILES, read_result, write_result
from tests.builders import make_trial, make_trial_result
from tests.dashboard.results import make_shown_result, write_clip

KEYS = ("one", "two")


@pytest.fixture
def samples(tmp_path, monkeypatch):
    """A folder of two small samples in the place of the bundled ones."""
    folder = tmp_path / "sample_data"
    folder.mkdir()
    rows = (f'[[sample]]\nkey = "{key}"\ntitle = "{key}"\nfile = "{key}.mp4"' for key in KEYS)
    (folder / "samples.toml").write_text("\n".join(rows))
    for key in KEYS:
        (folder / f"{key}.mp4").write_bytes(b"video")
        trial = make_trial(label=key, site=SAMPLES_SITE, job=key)
        made = write_result(make_trial_result(n_frames=8, trial=trial), tmp_path / key)
        shrink_result(made, folder / "results" / key)
    monkeypatch.setattr(cli_demo, "SAMPLE_FOLDER", folder)
    return folder


@pytest.fixture
def library(tmp_path):
    return Library.open(tmp_path / "home")


def test_an_empty_library_starts_with_marked_samples(samples, library):
    assert welcome(library) == 2
    entries = library.entries()
    assert {entry.label for entry in entries} == {"Sample: one", "Sample: two"}
    assert {(entry.site, entry.tags) for entry in entries} == {(SAMPLES_SITE, (SAMPLE_TAG,))}
    assert not any(entry.is_damaged for entry in entries)
    assert set(find_samples(library)) == {entry.id for entry in entries}


def test_an_installed_sample_has_every_file_of_a_result(samples, library):
    welcome(library)
    folder = library.folder("bundled-one")
    names = {path.name for path in folder.iterdir()}
    assert {"trial.json", "tracks.npz", "keypoints.trc", "angles.mot", "angles.csv"} <= names
    assert names <= set(RESULT_FILES)
    assert not list(library.root.glob(".sample-*"))


def test_what_was_removed_does_not_come_back_by_itself(samples, library):
    welcome(library)
    assert remove_samples(library) == 2
    assert library.is_empty
    assert welcome(library) == 0
    assert library.is_empty
    assert add_samples(library) == 2


def test_a_library_in_use_is_left_alone(samples, library):
    write_result(make_trial_result(n_frames=3), library.folder("own"))
    assert welcome(library) == 0
    assert [entry.id for entry in library.entries()] == ["own"]


def test_an_assessment_of_the_same_clip_takes_the_place_of_its_sample(samples, library):
    welcome(library)
    write_result(make_trial_result(n_frames=3), library.folder("sample-one"))
    assert retire_samples(library) == 1
    assert {entry.id for entry in library.entries()} == {"sample-one", "bundled-two"}


def test_a_half_done_start_is_made_whole(samples, library):
    add_samples(library)
    library.delete("bundled-two")
    assert add_samples(library) == 1


def test_samples_are_no_part_of_the_figures_unless_alone(samples, library):
    welcome(library)
    only = library.overview()
    of_samples = library.overview(site=SAMPLES_SITE)
    assert leave_out(only, of_samples) == only
    write_result(
        make_trial_result(n_frames=3, trial=make_trial(site="Hall 3")), library.folder("o")
    )
    whole = library.overview()
    assert whole.lifts.n_trials == 3
    own = leave_out(whole, of_samples)
    expected = library.overview(site="Hall 3")
    assert own == expected
    assert own.lifts.n_trials == 1


def test_nothing_to_leave_out_leaves_it_as_it_is(samples, library):
    write_result(make_trial_result(n_frames=3), library.folder("own"))
    whole = library.overview()
    assert leave_out(whole, library.overview(site=SAMPLES_SITE)) == whole


def test_without_shipped_results_nothing_happens(library, tmp_path, monkeypatch):
    monkeypatch.setattr(cli_demo, "SAMPLE_FOLDER", tmp_path / "nowhere")
    assert welcome(library) == 0
    assert retire_samples(library) == 0
    assert remove_samples(library) == 0


class TestServe:
    def test_it_shows_samples_at_the_first_start(self, samples, library):
        said: list[str] = []
        cli_serve._prepare_samples(said.append)
        assert not said
        assert len(Library.open().entries()) == 2

    def test_a_damaged_sample_is_no_reason_not_to_start(self, samples):
        (samples / "results" / "one" / "tracks.npz").write_bytes(b"")
        said: list[str] = []
        cli_serve._prepare_samples(said.append)
        assert len(said) == 1
        assert "samples can't be shown" in said[0]
        assert "tracks.npz" in said[0]


def test_the_small_form_keeps_the_curves(tmp_path):
    source = write_result(
        make_shown_result(), tmp_path / "source", overlay=write_clip(tmp_path / "o.mp4", seconds=2)
    )
    small = shrink_result(source, tmp_path / "small")
    before, after = read_result(source), read_result(small)
    for part in ("raw", "corrected"):
        old, new = getattr(before, part), getattr(after, part)
        np.testing.assert_array_equal(new.time_s, old.time_s)
        np.testing.assert_array_equal(new.status, old.status)
        np.testing.assert_allclose(new.position, old.position, rtol=2**-14)
    np.testing.assert_allclose(after.angles.value_deg, before.angles.value_deg, rtol=2**-14)
    assert after.risk == before.risk
    assert after.overlay_path is not None


class TestShipped:
    """The results that are part of the project."""

    def test_every_sample_has_one_that_can_be_read_and_is_small(self):
        for sample in cli_demo.read_samples():
            folder = cli_demo.SAMPLE_FOLDER / sample_results.RESULTS_NAME / sample.key
            stored = read_result(folder)
            assert stored.document["label"] == f"Sample: {sample.title}"
            assert stored.subject == sample.subject
            assert stored.task == sample.task
            assert (stored.document["site"], stored.document["job"]) == (sample.site, sample.job)
            assert sample.site == SAMPLES_SITE
            assert stored.overlay_path is not None
            assert stored.thumbnail_path is not None
            assert (stored.second_overlay_path is None) == (sample.second_video is None)
            assert sum(p.stat().st_size for p in folder.iterdir()) < 1.5e6

    def test_they_are_of_the_bundled_clips(self):
        for sample in cli_demo.read_samples():
            folder = cli_demo.SAMPLE_FOLDER / sample_results.RESULTS_NAME / sample.key
            document = json.loads((folder / "trial.json").read_text(encoding="utf-8"))
            given = [v for v in (sample.video, sample.second_video) if v is not None]
            hashes = [hashlib.sha256(video.read_bytes()).hexdigest() for video in given]
            assert [view["sha256"] for view in document["views"]] == hashes

    def test_the_manual_names_no_place_of_who_made_them(self):
        for path in (cli_demo.SAMPLE_FOLDER / sample_results.RESULTS_NAME).rglob("trial.json"):
            assert "/work" not in path.read_text(encoding="utf-8")
