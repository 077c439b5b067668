"""Bringing a database to the tables this program knows: made, migrated, or refused."""

from __future__ import annotations

import contextlib
import logging
import sqlite3
import time
from pathlib import Path
from typing import TYPE_CHECKING

from sqlalchemy import Connection, inspect, text

from engine.storage.atomic import explain_os_errors, write_aside
from engine.storage.database.connection import Database
from engine.storage.database.failures import (
    DatabaseDamaged,
    DatabaseUnavailable,
    explain_database_errors,
)
from engine.storage.locks import hold

if TYPE_CHECKING:
    from alembic.config import Config

__all__ = ["HEAD", "REVISIONS", "find_revision", "prepare", "remove_backups"]

logger = logging.getLogger(__name__)

MIGRATIONS = Path(__file__).with_name("migrations")
REVISIONS = ("0001", "0002")
"""Every state of the tables there was, oldest first; a test compares the list with the files."""
HEAD = REVISIONS[-1]
BACKUP_MARK = ".before-"
KEEP_BACKUPS_S = 30 * 24 * 3600.0


def prepare(database: Database, lock_path: Path) -> None:
    """Make the tables, or migrate those of an older program after a backup.

    Several processes may do so at once: one works, the others wait.

    Parameters
    ----------
    database
        The library's database; a read-only one is only looked at.
    lock_path
        A file of the library to lock meanwhile.

    Raises
    ------
    DatabaseDamaged
        If the database was made by a newer program, or by another one; nothing is touched.
    DatabaseUnavailable
        If it can't be read or migrated.
    """
    if database.is_scratch:
        with database.writing() as session:
            _upgrade(session.connection())
        return
    if _is_current(database):
        return
    if database.is_read_only:
        raise DatabaseUnavailable(
            f"The library's database {database.where} was made by an older LiftLens and may only "
            "be read here, so it can't be brought up to date; open it once where it may be changed."
        )
    with explain_os_errors(lock_path, "The library"), hold(lock_path):
        if _is_current(database):  # another process was faster
            return
        if database.path is not None:
            _set_up_file(database, database.path)
        _migrate(database)


def find_revision(connection: Connection) -> str | None:
    """Return which state the tables are in; None where there are none yet."""
    if not inspect(connection).has_table("alembic_version"):
        return None
    found: str | None = connection.execute(text("SELECT version_num FROM alembic_version")).scalar()
    return found


def remove_backups(path: Path, *, older_than_s: float = 0.0) -> None:
    """Remove copies that were made before migrations: they still hold what is deleted since."""
    for backup in path.parent.glob(f"{path.name}{BACKUP_MARK}*"):
        with contextlib.suppress(OSError):
            if time.time() - backup.stat().st_mtime >= older_than_s:
                backup.unlink()


def _is_current(database: Database) -> bool:
    if database.path is not None and not database.path.exists():
        return False
    with database.reading() as session:
        revision = find_revision(session.connection())
        if revision is None:
            _refuse_strangers(database, session.connection())
    if revision is not None and revision not in REVISIONS:
        raise DatabaseDamaged(
            f"The library's database {database.where} was made by a newer LiftLens (its tables "
            f"are of version {revision}, this program knows up to {HEAD}); update LiftLens. "
            "Nothing was changed."
        )
    return revision == HEAD


def _refuse_strangers(database: Database, connection: Connection) -> None:
    if inspect(connection).get_table_names():
        raise DatabaseDamaged(
            f"The database {database.where} holds tables of another program; give LiftLens an "
            "empty database of its own."
        )


def _set_up_file(database: Database, path: Path) -> None:
    """Make SQLite's file with a log beside it, so that readers and a writer don't wait."""
    with explain_database_errors(database.where):
        if path.exists() and path.stat().st_size:
            _back_up(path)
        with contextlib.closing(sqlite3.connect(path, timeout=5.0)) as raw:
            mode = raw.execute("PRAGMA journal_mode=WAL").fetchone()[0]
    if mode != "wal":
        logger.warning("The disk of %s has no shared memory; the library works, slower.", path)


def _back_up(path: Path) -> None:
    with contextlib.closing(sqlite3.connect(path, timeout=5.0)) as source:
        found = source.execute("SELECT version_num FROM alembic_version").fetchone()
        target = path.with_name(f"{path.name}{BACKUP_MARK}{HEAD}-from-{found[0]}")
        with (
            explain_os_errors(target, "The backup of the library"),
            write_aside(target) as aside,
            contextlib.closing(sqlite3.connect(aside)) as copy,
        ):
            source.backup(copy)
    logger.info("The library's database was copied to %s before it is migrated.", target)


def _migrate(database: Database) -> None:
    with database.writing() as session:
        _upgrade(session.connection())


def _upgrade(connection: Connection) -> None:
    # Imported late: needed once per version of the program.
    from alembic import command

    logging.getLogger("alembic").setLevel(logging.WARNING)
    command.upgrade(_configure(connection), "head")


def _configure(connection: Connection) -> Config:
    from alembic.config import Config

    config = Config()
    config.set_main_option("script_location", str(MIGRATIONS).replace("%", "%%"))
    config.set_main_option("path_separator", "os")
    config.attributes["connection"] = connection
    return config
