"""Databases are made, migrated after a backup, or refused, also by many processes at once."""

from __future__ import annotations

import contextlib
import sqlite3
import subprocess
import sys
from pathlib import Path

import pytest
from alembic import command
from alembic.autogenerate import compare_metadata
from alembic.migration import MigrationContext
from alembic.script import ScriptDirectory
from sqlalchemy import insert

from engine.storage.database import schema
from engine.storage.database.connection import close_databases, connect
from engine.storage.database.failures import DatabaseDamaged
from engine.storage.database.models import Base, Site
from engine.storage.library import Library
from engine.storage.results import write_result
from tests.builders import make_trial_result
from tests.engine.storage.trials import add

ROOT = Path(__file__).parents[4]


def make_older(root: Path, revision: str = "0001") -> None:
    """Make a database as an older program left it."""
    root.mkdir()
    with contextlib.closing(sqlite3.connect(root / "library.db")) as raw:
        raw.execute("PRAGMA journal_mode=WAL")
    database = connect(root, None)
    with database.writing() as session:
        command.upgrade(schema._configure(session.connection()), revision)
        session.execute(insert(Site).values(name="Hall 3"))
    close_databases()


def tables(path: Path) -> set[str]:
    with contextlib.closing(sqlite3.connect(path)) as raw:
        return {name for (name,) in raw.execute("SELECT name FROM sqlite_master")}


def test_the_migrations_end_in_what_the_program_expects(any_library: Library) -> None:
    with any_library.database.reading() as session:
        context = MigrationContext.configure(session.connection(), opts={"compare_type": True})
        assert compare_metadata(context, Base.metadata) == []
        assert schema.find_revision(session.connection()) == schema.HEAD


def test_the_list_of_revisions_is_that_of_the_files() -> None:
    scripts = ScriptDirectory(str(schema.MIGRATIONS))
    found = [script.revision for script in scripts.walk_revisions()]
    assert tuple(reversed(found)) == schema.REVISIONS


def test_an_older_database_is_migrated_after_a_backup(tmp_path: Path) -> None:
    make_older(tmp_path / "home")
    library = Library.open(tmp_path / "home")
    assert library.entries() == ()
    assert "queue" in tables(tmp_path / "home" / "library.db")
    with library.database.reading() as session:
        assert session.query(Site.name).all() == [("Hall 3",)]
    (backup,) = (tmp_path / "home").glob("library.db.before-*")
    assert "queue" not in tables(backup)
    with contextlib.closing(sqlite3.connect(backup)) as raw:
        assert raw.execute("SELECT name FROM sites").fetchall() == [("Hall 3",)]


def test_a_backup_goes_with_the_next_deletion(tmp_path: Path) -> None:
    make_older(tmp_path / "home")
    library = Library.open(tmp_path / "home")
    library.delete(add(library))
    assert not list((tmp_path / "home").glob("library.db.before-*"))


def test_a_failed_migration_leaves_the_older_database(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    make_older(tmp_path / "home")
    upgrade = schema._upgrade

    def fail(connection: object) -> None:
        upgrade(connection)  # type: ignore[arg-type]
        raise KeyboardInterrupt

    monkeypatch.setattr(schema, "_upgrade", fail)
    with pytest.raises(KeyboardInterrupt):
        Library(tmp_path / "home")
    assert "queue" not in tables(tmp_path / "home" / "library.db")
    monkeypatch.undo()
    Library(tmp_path / "home")
    assert "queue" in tables(tmp_path / "home" / "library.db")


def test_a_newer_database_is_one_sentence_and_stays_as_it_is(library: Library) -> None:
    path = library.root / "library.db"
    with library.database.writing() as session:
        session.connection().exec_driver_sql("UPDATE alembic_version SET version_num = '0999'")
    library.database.scrub()
    close_databases()
    before = path.read_bytes()
    with pytest.raises(DatabaseDamaged, match=r"newer LiftLens .*0999.*update LiftLens"):
        Library.open(library.root)
    close_databases()
    assert path.read_bytes() == before
    assert not list(library.root.glob("library.db.before-*"))


def test_a_database_of_another_program_is_left_alone(tmp_path: Path) -> None:
    with contextlib.closing(sqlite3.connect(tmp_path / "library.db")) as raw:
        raw.execute("CREATE TABLE mine (x)")
    with pytest.raises(DatabaseDamaged, match="tables of another program"):
        Library(tmp_path)
    assert tables(tmp_path / "library.db") == {"mine"}


@pytest.mark.parametrize("content", [b"not a database at all" * 100, b"SQLite format 3\0" * 90])
def test_a_damaged_database_says_what_can_be_saved(tmp_path: Path, content: bytes) -> None:
    (tmp_path / "library.db").write_bytes(content)
    with pytest.raises(DatabaseDamaged, match="Move the file away"):
        Library(tmp_path)
    assert (tmp_path / "library.db").read_bytes() == content
    (tmp_path / "library.db").unlink()
    write_result(make_trial_result(n_frames=2), tmp_path / "trials" / "a")
    assert [entry.id for entry in Library(tmp_path).entries()] == ["a"]


@pytest.mark.parametrize("is_older", [False, True], ids=["new", "older"])
def test_many_processes_may_open_one_library_at_once(tmp_path: Path, is_older: bool) -> None:
    home = tmp_path / "home"
    if is_older:
        make_older(home)
    script = (
        "import sys; from pathlib import Path; from engine.storage.library import Library;"
        "sys.stdin.readline(); print(len(Library.open(Path(sys.argv[1])).entries()))"
    )
    running = [
        subprocess.Popen(
            [sys.executable, "-c", script, str(home)],
            cwd=ROOT,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )
        for _ in range(3)
    ]
    for process in running:
        assert process.stdin is not None
        process.stdin.write("go\n")
        process.stdin.flush()
    for process in running:
        assert process.communicate(timeout=60) == ("0\n", "")
    assert {"queue", "trials"} <= tables(home / "library.db")
