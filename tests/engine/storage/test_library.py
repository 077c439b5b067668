"""The library lists, adopts and deletes trials, also while others do."""

from __future__ import annotations

import json
import math
import os
import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

from engine.datatypes import FlagLevel
from engine.errors import ConfigError, DataError, OutputError
from engine.storage import catalogue
from engine.storage import library as library_module
from engine.storage.library import Library, default_root
from engine.storage.results import check_target, read_result, write_result
from tests.builders import make_flag, make_trial_result


@pytest.fixture
def library(any_library: Library) -> Library:
    return any_library


def add(library: Library, trial_id: str | None = None, **changes: object) -> str:
    folder = library.root.parent / f"work-{library.new_id()}"
    return library.adopt(write_result(make_trial_result(n_frames=2, **changes), folder), trial_id)


class TestRoot:
    def test_the_variable_wins(self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.setenv("LIFTLENS_HOME", str(tmp_path / "here"))
        assert Library.open().root == tmp_path.resolve() / "here"

    @pytest.mark.parametrize(
        ("platform", "part"), [("linux", "liftlens"), ("darwin", "LiftLens"), ("win32", "LiftLens")]
    )
    def test_else_the_place_of_the_system(
        self, monkeypatch: pytest.MonkeyPatch, platform: str, part: str
    ) -> None:
        for name in ("LIFTLENS_HOME", "XDG_DATA_HOME", "LOCALAPPDATA"):
            monkeypatch.delenv(name, raising=False)
        monkeypatch.setattr(library_module.sys, "platform", platform)
        assert default_root().name == part
        assert default_root().is_relative_to(Path.home())

    def test_a_root_that_is_a_file_is_explained(self, tmp_path: Path) -> None:
        (tmp_path / "home").write_text("mine")
        with pytest.raises(OutputError, match=r"The library can't be written"):
            Library.open(tmp_path / "home" / "library")


class TestEntries:
    def test_a_new_library_is_empty(self, library: Library) -> None:
        assert library.is_empty
        assert library.entries() == ()

    def test_an_entry_has_the_main_facts(self, library: Library) -> None:
        trial_id = add(library, lis=(1.4, 0.8))
        (entry,) = library.entries()
        assert not library.is_empty
        assert (entry.id, entry.status, entry.label) == (trial_id, "done", "Crate to shelf")
        assert (entry.subject, entry.site, entry.job) == ("P01", "Hall 3", "Packing")
        assert entry.li == 1.4
        assert entry.li_interval == pytest.approx((1.12, 1.82))
        assert (entry.n_lifts, entry.worst_level) == (2, FlagLevel.HIGH)
        assert entry.duration_s == pytest.approx(2 / 30)
        assert entry.created.endswith("+00:00")
        assert entry.thumbnail_path is None

    def test_an_infinite_index_is_infinite(self, library: Library) -> None:
        add(library, lis=(math.inf,))
        assert library.entries()[0].li == math.inf
        assert library.entries()[0].li_interval == (math.inf, math.inf)

    def test_a_trial_without_lifts_has_no_index(self, library: Library) -> None:
        add(library, lis=(), risk={}, flags=())
        (entry,) = library.entries()
        assert (entry.li, entry.worst_level, entry.n_lifts) == (None, None, 0)

    @pytest.mark.parametrize(
        ("levels", "worst"),
        [
            ((FlagLevel.OK, FlagLevel.REVIEW), FlagLevel.REVIEW),
            ((FlagLevel.REVIEW, FlagLevel.HIGH, FlagLevel.OK), FlagLevel.HIGH),
            ((FlagLevel.OK,), FlagLevel.OK),
        ],
    )
    def test_the_worst_level_counts(
        self, library: Library, levels: tuple[FlagLevel, ...], worst: FlagLevel
    ) -> None:
        add(library, flags=tuple(make_flag(level) for level in levels))
        assert library.entries()[0].worst_level is worst

    def test_newest_first(self, library: Library) -> None:
        ids = [add(library) for _ in range(3)]
        assert [entry.id for entry in library.entries()] == sorted(ids, reverse=True)

    def test_the_thumbnail_is_found(self, library: Library, tmp_path: Path) -> None:
        picture = tmp_path / "t.jpg"
        picture.write_bytes(b"picture")
        library.adopt(write_result(make_trial_result(), tmp_path / "r", thumbnail=picture), "a")
        assert library.entries()[0].thumbnail_path == library.folder("a") / "thumbnail.jpg"

    def test_the_second_look_reads_only_the_database(
        self, library: Library, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        add(library)
        first = library.entries()
        monkeypatch.setattr(catalogue, "read_folder", pytest.fail)
        assert library.entries() == first

    def test_a_changed_result_is_read_anew(self, library: Library) -> None:
        add(library, "a")
        library.entries()
        write_result(make_trial_result(lis=(3.0,)), library.folder("a"))
        assert library.entries()[0].li == 3.0

    def test_a_summary_of_an_older_program_does_not_stop_a_new_result(
        self, library: Library
    ) -> None:
        add(library, "a")
        (library.folder("a") / "summary.json").write_text("{}")
        assert check_target(library.folder("a")) == library.folder("a")

    @pytest.mark.parametrize(
        "content", ["", "{}", "[1]", '{"schema_version": 1}', '{"schema_version": 99}', None]
    )
    def test_damaged_folders_are_listed_not_raised(
        self, library: Library, content: str | None
    ) -> None:
        add(library, "good")
        bad = library.trials / "bad"
        bad.mkdir()
        if content is not None:
            (bad / "trial.json").write_text(content)
        entries = {entry.id: entry for entry in library.entries()}
        assert entries["good"].status == "done"
        assert entries["bad"].is_damaged
        assert str(bad) in entries["bad"].message
        library.delete("bad")
        assert [entry.id for entry in library.entries()] == ["good"]

    @pytest.mark.parametrize("key", ["risk", "flags", "views", "subject", "lifts"])
    @pytest.mark.parametrize("value", [None, 5, "x", [[]], [{}], {"rnle": 3}], ids=str)
    def test_nonsense_in_a_document_never_raises(
        self, library: Library, key: str, value: object
    ) -> None:
        add(library, "a")
        path = library.folder("a") / "trial.json"
        document = json.loads(path.read_text())
        document[key] = value
        path.write_text(json.dumps(document))
        assert [entry.id for entry in library.entries()] == ["a"]

    def test_a_lost_curve_file_is_damage(self, library: Library) -> None:
        add(library, "a")
        (library.folder("a") / "tracks.npz").unlink()
        assert library.entries()[0].is_damaged

    def test_files_and_hidden_folders_are_ignored(self, library: Library) -> None:
        (library.trials / "notes.txt").write_text("mine")
        (library.trials / ".x.partial").mkdir()
        assert library.entries() == ()
        assert library.is_empty


class TestChanges:
    def test_adopting_moves_the_result(self, library: Library, tmp_path: Path) -> None:
        folder = write_result(make_trial_result(), tmp_path / "result")
        trial_id = library.adopt(folder)
        assert not folder.exists()
        assert library.has(trial_id)
        assert read_result(library.folder(trial_id)).lifts

    def test_a_taken_id_keeps_both(self, library: Library, tmp_path: Path) -> None:
        add(library, "a")
        folder = write_result(make_trial_result(lis=(9.0,)), tmp_path / "result")
        with pytest.raises(ConfigError, match="already"):
            library.adopt(folder, "a")
        assert read_result(folder).risk["rnle"].value == 9.0
        assert read_result(library.folder("a")).risk["rnle"].value == 1.4

    def test_what_is_no_result_is_refused(self, library: Library, tmp_path: Path) -> None:
        (tmp_path / "photos").mkdir()
        with pytest.raises(DataError):
            library.adopt(tmp_path / "photos")
        assert (tmp_path / "photos").exists()

    def test_deleting_takes_all_that_belongs_to_the_trial(self, library: Library) -> None:
        for trial_id in ("gone", "kept"):
            add(library, trial_id)
            (library.upload_folder(trial_id) / "video.mp4").write_bytes(b"face")
            (library.jobs / trial_id).mkdir()
            (library.jobs / trial_id / "request.json").write_text("{}")
        library.delete("gone")
        assert not [p for p in library.root.rglob("*") if "gone" in p.name]
        assert library.has("kept")
        assert (library.uploads / "kept" / "video.mp4").exists()
        assert (library.jobs / "kept").exists()

    def test_deleting_nothing_says_so(self, library: Library) -> None:
        with pytest.raises(ConfigError, match="no trial"):
            library.delete("nothing")

    @pytest.mark.parametrize("trial_id", ["", "..", ".", "../x", "a/b", "/etc", ".hidden", "a\n"])
    def test_no_id_leads_outside(self, library: Library, trial_id: str) -> None:
        for call in (library.folder, library.delete, library.upload_folder, library.has):
            with pytest.raises(ConfigError, match="trial id"):
                call(trial_id)

    def test_ids_are_unique_and_sort_by_time(self, library: Library) -> None:
        ids = [library.new_id() for _ in range(200)]
        assert len(set(ids)) == 200
        assert library.folder(ids[0]).parent == library.trials

    def test_old_leftovers_are_removed_and_fresh_ones_kept(self, library: Library) -> None:
        old, fresh = library.trials / ".a.1.partial", library.trials / ".b.1.partial"
        for folder in (old, fresh):
            folder.mkdir()
            (folder / "overlay.mp4").write_bytes(b"face")
        long_ago = time.time() - 3 * 24 * 3600
        os.utime(old, (long_ago, long_ago))
        Library.open(library.root)
        assert not old.exists()
        assert fresh.exists()


class TestConcurrency:
    def test_listing_while_others_add_and_delete(self, library: Library) -> None:
        keep = {add(library) for _ in range(2)}

        def come_and_go(_: int) -> None:
            library.delete(add(library))

        with ThreadPoolExecutor(4) as pool:
            work = [pool.submit(come_and_go, i) for i in range(12)]
            while not all(job.done() for job in work):
                entries = library.entries()
                assert keep <= {entry.id for entry in entries}
                assert not [entry for entry in entries if entry.is_damaged]
        for job in work:
            job.result()
        assert {entry.id for entry in library.entries()} == keep

    @pytest.mark.skipif(sys.platform == "win32", reason="needs POSIX signals")
    def test_a_killed_writer_leaves_no_trial(self, library: Library) -> None:
        script = (
            "import os, signal, sys\n"
            "from pathlib import Path\n"
            "from engine.storage import results\n"
            "from tests.builders import make_trial_result\n"
            "results._replace = lambda *_: os.kill(os.getpid(), signal.SIGKILL)\n"
            "results.write_result(make_trial_result(), Path(sys.argv[1]))\n"
        )
        done = subprocess.run(
            [sys.executable, "-c", script, str(library.folder("a"))],
            check=False,
            cwd=Path(__file__).parents[3],
        )
        assert done.returncode == -9
        assert library.is_empty
        assert library.entries() == ()
