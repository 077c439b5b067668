"""Whatever a database can't do now is one sentence, and no password is shown."""

from __future__ import annotations

import contextlib
import os
import shutil
import sqlite3
import sys
from collections.abc import Iterator
from datetime import UTC, datetime, timedelta, timezone
from pathlib import Path

import pytest
from sqlalchemy import event, select

from engine.errors import ConfigError, OutputError
from engine.storage.database import connection
from engine.storage.database.connection import URL_VARIABLE, close_databases, find_url
from engine.storage.database.failures import DatabaseDamaged, DatabaseUnavailable, DriverMissing
from engine.storage.database.models import LibraryIdentity
from engine.storage.library import Library
from engine.storage.results import write_result
from tests.builders import make_trial_result
from tests.engine.storage.trials import add
from tests.postgres import Server


def test_sqlite_is_set_up_for_many_and_for_privacy(library: Library) -> None:
    with library.database.writing() as session:
        raw = session.connection()
        found = {
            name: raw.exec_driver_sql(f"PRAGMA {name}").scalar()
            for name in ("journal_mode", "foreign_keys", "secure_delete")
        }
    assert found == {"journal_mode": "wal", "foreign_keys": 1, "secure_delete": 1}


def test_a_reader_does_not_wait_for_a_writer(library: Library) -> None:
    add(library, "a")
    with library.database.writing():
        assert [entry.id for entry in library.entries()] == ["a"]


@pytest.mark.parametrize("hold", ["BEGIN IMMEDIATE", "BEGIN EXCLUSIVE"])
def test_a_locked_database_is_one_sentence_and_loses_no_result(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, hold: str
) -> None:
    monkeypatch.setattr(connection, "BUSY_TIMEOUT_S", 0.05)
    library = Library.open(tmp_path / "home")
    other = sqlite3.connect(library.root / "library.db", isolation_level=None)
    with contextlib.closing(other):
        other.execute(hold)
        with pytest.raises(DatabaseUnavailable, match="another program is holding it"):
            library.set_agreement("P01")
        trial_id = add(library)  # the work of an hour: kept, and listed later
        assert library.folder(trial_id).is_dir()
        other.execute("ROLLBACK")
    assert [entry.id for entry in library.entries()] == [trial_id]


def test_a_full_disk_is_one_sentence_and_breaks_nothing(library: Library) -> None:
    trial_id = add(library)

    @event.listens_for(library.database.engine, "begin")
    def _limit(raw: object) -> None:
        raw.exec_driver_sql("PRAGMA max_page_count=60")  # type: ignore[attr-defined]

    with pytest.raises(DatabaseUnavailable, match="the disk is full; free some space"):
        library.add_note(trial_id, "x" * 1_000_000)
    close_databases()
    again = Library.open(library.root)
    assert again.record(trial_id).notes == ()
    again.add_note(trial_id, "y")


@contextlib.contextmanager
def reduced_rights(folder: Path) -> Iterator[None]:
    """Let this process read, but not change, what lies below `folder`."""
    for path in (folder, *folder.rglob("*")):
        path.chmod(0o555 if path.is_dir() else 0o444)
    above = [p for p in folder.parents if p.owner() == folder.owner() and p != Path("/")]
    modes = {p: p.stat().st_mode for p in above}
    is_root = os.geteuid() == 0
    try:
        if is_root:
            for path in above:
                path.chmod(modes[path] | 0o055)
            # The saved id stays root's, so that it can be taken back.
            os.setresuid(65534, 65534, 0)
        yield
    finally:
        if is_root:
            os.setresuid(0, 0, 0)
        for path, mode in modes.items():
            path.chmod(mode)
        for path in (folder, *folder.rglob("*")):
            path.chmod(0o755 if path.is_dir() else 0o644)


@pytest.mark.skipif(sys.platform != "linux", reason="needs Linux's user ids")
@pytest.mark.parametrize("has_database", [True, False])
def test_a_library_one_may_only_read_still_lists(tmp_path: Path, has_database: bool) -> None:
    home = tmp_path / "home"
    library = Library.open(home)
    add(library, "a")
    library.database.scrub()
    close_databases()
    if not has_database:
        for path in home.glob("library.db*"):
            path.unlink()
    with reduced_rights(home):
        seen = Library.open(home)
        assert seen.is_read_only
        assert [entry.label for entry in seen.entries()] == ["Crate to shelf"]
        assert seen.overview().lifts.n_lifts == 1
        with pytest.raises(OutputError, match=r"can't be (changed|written)"):
            seen.delete("a")
        if has_database:
            with pytest.raises(DatabaseUnavailable, match="may only be read"):
                seen.add_note("a", "x")
        close_databases()
    assert Library.open(home).entries()[0].status == "done"


def test_a_restored_backup_is_noticed(library: Library) -> None:
    add(library, "a")
    library.database.scrub()
    path = library.root / "library.db"
    shutil.copy(path, library.root / "copy.db")
    library.add_note("a", "later")
    library.database.scrub()
    (library.root / "copy.db").replace(path)
    again = Library.open(library.root)
    assert again.record("a").notes == ()
    again.add_note("a", "now")
    close_databases()
    assert [n.text for n in Library.open(library.root).record("a").notes] == ["now"]


class TestAddress:
    @pytest.mark.parametrize(
        "url", ["mysql://me:secret@host/db", "secret", "://", "sqlite:///secret.db"]
    )
    def test_what_is_no_postgresql_is_one_sentence(
        self, monkeypatch: pytest.MonkeyPatch, url: str
    ) -> None:
        monkeypatch.setenv(URL_VARIABLE, url)
        with pytest.raises(ConfigError, match="postgresql://user@host/name") as caught:
            find_url()
        assert "secret" not in str(caught.value)

    def test_without_psycopg_the_command_is_given(self, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.setenv(URL_VARIABLE, "postgresql://me@host/db")
        monkeypatch.setitem(sys.modules, "psycopg", None)
        with pytest.raises(DriverMissing, match=r"pip install .*liftlens\[postgres\]") as caught:
            find_url()
        assert caught.value.exit_code == 4

    def test_a_server_that_does_not_answer_is_one_sentence(
        self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        monkeypatch.setenv(URL_VARIABLE, "postgres://me:secret@127.0.0.1:1/db")
        with pytest.raises(DatabaseUnavailable, match="does not answer") as caught:
            Library(tmp_path)
        assert "secret" not in str(caught.value)

    def test_a_server_and_a_folder_belong_together(
        self, any_library: Library, tmp_path: Path
    ) -> None:
        add(any_library, "a")
        if any_library.database.is_sqlite:
            assert Library(tmp_path / "other").is_empty
            return
        with pytest.raises(DatabaseDamaged, match="belongs to another data folder"):
            Library(tmp_path / "other")
        assert [entry.id for entry in Library(any_library.root).entries()] == ["a"]

    def test_a_new_server_makes_its_tables(
        self,
        postgres: Server,
        tmp_path: Path,
        monkeypatch: pytest.MonkeyPatch,
    ) -> None:
        write_result(make_trial_result(n_frames=2), tmp_path / "trials" / "a")
        monkeypatch.setenv(URL_VARIABLE, postgres.url(postgres.make_database()))
        assert [entry.id for entry in Library.open(tmp_path).entries()] == ["a"]
        assert not (tmp_path / "library.db").exists()


def test_times_are_kept_in_utc_and_need_a_zone(any_library: Library) -> None:
    moment = datetime(2026, 3, 29, 2, 30, 0, 123456, tzinfo=timezone(timedelta(hours=2)))
    with any_library.database.writing() as session:
        session.add(LibraryIdentity(id="x", created_at=moment))
    with any_library.database.reading() as session:
        back = session.scalar(select(LibraryIdentity.created_at).where(LibraryIdentity.id == "x"))
    assert back == moment
    assert back is not None
    assert back.utcoffset() == timedelta(0)
    with (
        pytest.raises(Exception, match="needs its zone"),
        any_library.database.writing() as session,
    ):
        session.add(LibraryIdentity(id="y", created_at=datetime.now(UTC).replace(tzinfo=None)))
