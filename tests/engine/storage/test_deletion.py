"""What is deleted is gone: rows, files and bytes, whatever interrupts it."""

from __future__ import annotations

import os
import random
import shutil
import time
from datetime import date
from pathlib import Path

import pytest

from engine.datatypes import FlagLevel, Subject
from engine.errors import ConfigError, OutputError
from engine.jobs.request import JobRequest
from engine.jobs.store import JobState, JobStore
from engine.storage import library as library_module
from engine.storage.database.connection import close_databases
from engine.storage.database.models import Base
from engine.storage.library import Library
from tests.builders import make_flag
from tests.engine.storage.trials import add

SECRET = "Quetzalcoatl"


def fill(library: Library, trial_id: str, secret: str) -> None:
    """Put a word everywhere a user can put one."""
    add(library, trial_id, person=f"{secret}-person", label=f"{secret}-label", site=f"{secret}-s")
    version = library.edit(trial_id, version=1, label=f"{secret}-new", tags=(f"{secret}-tag",))
    note = library.add_note(trial_id, f"{secret} " * 400, author=f"{secret}-author")
    library.add_note(trial_id, f"{secret}-note")
    library.delete_note(trial_id, note.id)
    version = library.record(trial_id).version
    library.review(
        trial_id, make_flag(FlagLevel.HIGH), "rejected", version=version, reason=f"{secret}-why"
    )
    library.set_reference(f"{secret}-ref", trial_id)
    source = library.root.parent / f"{secret}-file.toml"
    source.write_text(f"{secret}-content")
    library.attach(trial_id, source, role="calibration")
    (library.upload_folder(trial_id) / f"{secret}.mp4").write_text(secret)
    video = source.with_suffix(".mp4")
    video.write_text("")
    request = JobRequest(videos=(video,), subject=Subject(label=f"{secret}-person"), label=secret)
    JobStore(library).add(trial_id, request, state=JobState.DONE, ended_s=time.time())
    (library.jobs / trial_id).mkdir()
    (library.jobs / trial_id / "worker.log").write_text(secret)


def traces(library: Library, secret: str) -> list[str]:
    """Return the files whose name or content has a word, and the tables that do."""
    found = [
        str(path)
        for path in library.root.rglob("*")
        if secret in path.name or (path.is_file() and secret.encode() in path.read_bytes())
    ]
    with library.database.reading() as session:
        for table in Base.metadata.tables.values():
            rows = session.execute(table.select()).all()
            found += [table.name for row in rows if secret.casefold() in str(row).casefold()]
    return found


@pytest.mark.parametrize("whom", ["trial", "person"])
def test_nothing_of_it_is_left(any_library: Library, whom: str) -> None:
    library = any_library
    fill(library, "kept", "Axolotl")
    fill(library, "gone", SECRET)
    library.set_agreement(f"{SECRET}-person", keep_until=date(2026, 1, 1))
    assert traces(library, SECRET)
    if whom == "trial":
        library.set_agreement(f"{SECRET}-person")
        library.delete("gone")
    else:
        assert library.delete_person(f"{SECRET}-person") == 1
        with pytest.raises(ConfigError, match="Nobody"):
            library.delete_person(f"{SECRET}-person")
    assert traces(library, SECRET) == []
    record = library.record("kept")
    assert record.tags == ("Axolotl-tag",)
    assert library.attachments("kept")[0].path.read_text() == "Axolotl-content"
    assert JobStore(library).read("kept").label == "Axolotl"


def test_no_byte_of_many_changes_is_left(library: Library) -> None:
    """Pages are split, joined and moved by thousands of rows of all sizes; none keeps a ghost."""
    rng = random.Random(20261122)
    for name in ("a", "b", "c"):
        add(library, name)
    for _ in range(150):
        name = rng.choice("abc")
        library.add_note(name, f"{SECRET}-{name} " * rng.randint(1, 120))
        if rng.random() < 0.4:
            notes = library.record(name).notes
            library.delete_note(name, rng.choice(notes).id)
        if rng.random() < 0.2:
            version = library.record(name).version
            library.edit(name, version=version, label=f"{SECRET}-{name}{rng.random()}" * 20)
    for name in ("a", "b"):
        library.delete(name)
        assert f"{SECRET}-{name}".encode() not in (library.root / "library.db").read_bytes()
        assert (library.root / "library.db-wal").stat().st_size == 0
    assert f"{SECRET}-c".encode() in (library.root / "library.db").read_bytes()


def test_a_killed_deletion_is_finished_by_the_next_opening(
    any_library: Library, monkeypatch: pytest.MonkeyPatch
) -> None:
    library = any_library
    for step in ("_remove_files", "_forget_rows"):
        add(library, "a")
        with monkeypatch.context() as patch:
            patch.setattr(Library, step, lambda *_: os._exit)
            patch.setattr(Library, "_forget_rows", lambda *_: None)
            library.delete("a")
        # Decided is decided: nobody lists or finds it again, though it is still on disk.
        assert library.entries() == ()
        with pytest.raises(ConfigError):
            library.record("a")
        library.database.swept_at = ()
        Library.open(library.root)
        assert not library.has("a")
        assert add(library, "a") == "a"
        library.delete("a")


def test_what_cannot_be_deleted_stays_in_the_list(
    library: Library, monkeypatch: pytest.MonkeyPatch
) -> None:
    add(library, "a")

    def refuse(*_: object, **__: object) -> None:
        raise PermissionError(13, "no")

    with monkeypatch.context() as patch:
        patch.setattr(library_module, "_remove", refuse)
        with pytest.raises(OutputError, match="you may not write there"):
            library.delete("a")
    assert library.entries()[0].status == "done"


def test_what_is_being_made_is_not_deleted(library: Library, tmp_path: Path) -> None:
    (tmp_path / "v.mp4").write_text("")
    person = Subject(label="P07")
    JobStore(library).add("a", JobRequest(videos=(tmp_path / "v.mp4",), subject=person))
    for call in (lambda: library.delete("a"), lambda: library.delete_person("P07")):
        with pytest.raises(ConfigError, match="still being made; cancel that first"):
            call()


class TestArtefacts:
    def test_content_that_two_trials_share_is_kept_once(
        self, any_library: Library, tmp_path: Path
    ) -> None:
        library = any_library
        source = tmp_path / "Kamera 📷.toml"
        source.write_text("focal = 1")
        for name in ("a", "b"):
            add(library, name)
            library.attach(name, source, role="calibration")
        (entry,) = library.attachments("a", "calibration")
        assert entry.name == "Kamera 📷.toml"
        assert entry.path == library.root / "artefacts" / entry.sha256[:2] / entry.sha256[2:]
        assert len([p for p in (library.root / "artefacts").rglob("*") if p.is_file()]) == 1
        library.delete("a")
        assert library.artefacts.check(entry.sha256).read_text() == "focal = 1"
        library.detach("b", "calibration", entry.name)
        assert not entry.path.exists()
        assert library.attachments("b") == ()

    def test_a_new_file_takes_the_place_of_an_old_one(
        self, library: Library, tmp_path: Path
    ) -> None:
        add(library, "a")
        for text in ("one", "two"):
            (tmp_path / "f.toml").write_text(text)
            library.attach("a", tmp_path / "f.toml", role="calibration")
        (entry,) = library.attachments("a")
        assert entry.path.read_text() == "two"
        assert len([p for p in (library.root / "artefacts").rglob("*") if p.is_file()]) == 1

    def test_a_changed_or_lost_file_is_noticed(self, library: Library, tmp_path: Path) -> None:
        add(library, "a")
        (tmp_path / "f").write_text("one")
        sha256 = library.attach("a", tmp_path / "f", role="r")
        path = library.artefacts.path(sha256)
        path.write_text("two")
        with pytest.raises(Exception, match="was changed or damaged"):
            library.artefacts.check(sha256)
        path.unlink()
        with pytest.raises(Exception, match="is missing"):
            library.artefacts.check(sha256)
        with pytest.raises(Exception, match="64 lower-case hex digits"):
            library.artefacts.path("../../etc/passwd")

    def test_what_a_killed_process_left_is_swept(self, library: Library, tmp_path: Path) -> None:
        add(library, "a")
        (tmp_path / "f").write_text("kept")
        kept = library.artefacts.path(library.attach("a", tmp_path / "f", role="r"))
        (tmp_path / "f").write_text("stray")
        stray = library.artefacts.keep(library.artefacts.bring(tmp_path / "f")).path
        half = library.artefacts.bring(tmp_path / "f").path
        fresh = library.artefacts.root / "ff" / ("0" * 62)
        fresh.parent.mkdir(exist_ok=True)
        fresh.write_text("fresh")
        long_ago = time.time() - 7200
        for path in (kept, stray, half):
            os.utime(path, (long_ago, long_ago))
        library.database.swept_at = ()
        Library.open(library.root)
        assert [p.exists() for p in (kept, stray, half, fresh)] == [True, False, False, True]

    def test_a_full_disk_leaves_nothing(
        self, library: Library, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        add(library, "a")
        (tmp_path / "f").write_text("x")

        def full(_fd: int) -> None:
            raise OSError(28, "No space left on device")

        monkeypatch.setattr(os, "fsync", full)
        with pytest.raises(OutputError, match="the disk is full"):
            library.attach("a", tmp_path / "f", role="r")
        assert not [p for p in library.artefacts.root.rglob("*") if p.is_file()]
        assert library.attachments("a") == ()


def test_a_library_can_be_moved(library: Library, tmp_path: Path) -> None:
    add(library, "a")
    library.add_note("a", "here")
    library.database.scrub()
    close_databases()
    shutil.copytree(library.root, tmp_path / "moved")
    moved = Library.open(tmp_path / "moved")
    assert [entry.status for entry in moved.entries()] == ["done"]
    assert [(r.version, n.text) for r in moved.record("a").results for n in moved.record("a").notes]
    assert len(moved.record("a").results) == 1
