"""Connections to the library's database: SQLite in the data folder, or PostgreSQL by address.

One process keeps its connections for as long as it uses a library, so opening a library again
costs a millisecond. All changes of one library happen one after the other, on both kinds of
database: SQLite has one writer by nature, and on PostgreSQL every change takes one advisory
lock first. So no change can fail because of another that runs beside it; it waits.
"""

from __future__ import annotations

import contextlib
import os
import sqlite3
import threading
from collections import OrderedDict
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from sqlalchemy import URL, Connection, Engine, create_engine, event, make_url, text
from sqlalchemy.exc import ArgumentError
from sqlalchemy.orm import Session
from sqlalchemy.pool import ConnectionPoolEntry, QueuePool, StaticPool

from engine.errors import ConfigError
from engine.storage.database.failures import (
    DatabaseUnavailable,
    DriverMissing,
    explain_database_errors,
)

__all__ = ["DATABASE_NAME", "URL_VARIABLE", "Database", "close_databases", "connect", "find_url"]

URL_VARIABLE = "LIFTLENS_DATABASE_URL"
DATABASE_NAME = "library.db"
BUSY_TIMEOUT_S = 15.0
"""How long a change waits for others before it gives up."""
MAX_OPEN = 4
"""How many libraries one process keeps connections to."""
WRITE_LOCK = 0x4C69_6674
"""Key of PostgreSQL's advisory lock around every change."""
_WRITES = "liftlens_writes"
_SETTINGS = (
    "PRAGMA foreign_keys=ON",
    # What is deleted is overwritten: notes and pseudonyms are personal data.
    "PRAGMA secure_delete=ON",
    "PRAGMA synchronous=FULL",
)


@dataclass(eq=False)
class Database:
    """One library's database.

    `where` names it in messages, without a password. `path` is SQLite's file, None elsewhere.
    `is_read_only` says that nothing can be changed; `is_scratch` that it lives in memory only,
    because the library has no database and may not be given one. `seen_ns` and `swept_at` are
    what this process remembers of its last look at the folders.
    """

    engine: Engine
    where: str
    path: Path | None = None
    is_read_only: bool = False
    is_scratch: bool = False
    identity: object = None
    seen_ns: int | None = None
    swept_at: tuple[float, ...] = ()
    _lock: threading.RLock = field(default_factory=threading.RLock)

    @property
    def is_sqlite(self) -> bool:
        """Whether this is SQLite."""
        return self.engine.dialect.name == "sqlite"

    @contextlib.contextmanager
    def reading(self) -> Iterator[Session]:
        """Give a session that sees one state of the library and changes nothing.

        Raises
        ------
        DatabaseUnavailable, DatabaseDamaged
            If the database can't be read.
        """
        with self._guard(), explain_database_errors(self.where), Session(self.engine) as session:
            yield session

    @contextlib.contextmanager
    def writing(self) -> Iterator[Session]:
        """Give a session whose changes are kept all or none, while nobody else changes anything.

        Raises
        ------
        DatabaseUnavailable
            If the database takes no changes: it is busy, full or may only be read.
        DatabaseDamaged
            If it is damaged.
        """
        if self.is_read_only and not self.is_scratch:
            raise DatabaseUnavailable(
                f"The library's database {self.where} can't be changed: it may only be read here; "
                "choose a folder of your own with LIFTLENS_HOME."
            )
        bound = self.engine.execution_options(**{_WRITES: True})
        with self._guard(), explain_database_errors(self.where), Session(bound) as session:
            # Begins now, not with the first statement: what the caller looks at on disk counts too.
            session.connection()
            if not self.is_sqlite:
                session.execute(text("SELECT pg_advisory_xact_lock(:key)"), {"key": WRITE_LOCK})
            yield session
            session.commit()

    def scrub(self) -> bool:
        """Remove what was deleted from the database's log as well; whether that worked now.

        SQLite keeps changes in a log beside the file until they are moved over. While somebody
        reads an older state that has to wait; the next opening does it then.
        """
        if not self.is_sqlite or self.is_read_only or self.is_scratch:
            return True
        with explain_database_errors(self.where), self.engine.connect() as connection:
            raw = connection.connection.driver_connection
            busy, *_ = raw.execute("PRAGMA wal_checkpoint(TRUNCATE)").fetchone()  # type: ignore[union-attr]
        return not busy

    def dispose(self) -> None:
        """Close all connections."""
        self.engine.dispose()

    @contextlib.contextmanager
    def _guard(self) -> Iterator[None]:
        """Let one thread at a time use the one connection of a database in memory."""
        with self._lock if self.is_scratch else contextlib.nullcontext():
            yield


# --------------------------------------------------------------------------- which database


def find_url() -> URL | None:
    """Return the address `LIFTLENS_DATABASE_URL` names; None for SQLite in the data folder.

    Raises
    ------
    ConfigError
        If it is no address of a PostgreSQL database.
    DriverMissing
        If psycopg is not installed.
    """
    given = os.environ.get(URL_VARIABLE, "").strip()
    if not given:
        return None
    try:
        url = make_url(given)
    except (ArgumentError, ValueError):
        # The text is not repeated: it may hold a password.
        raise ConfigError(_expected("an address that can't be understood")) from None
    if url.get_backend_name() not in ("postgresql", "postgres"):
        raise ConfigError(_expected(f"one that starts with {url.drivername}://"))
    try:
        import psycopg  # noqa: F401 - only looked for
    except ImportError as error:
        raise DriverMissing(
            f"{URL_VARIABLE} names a PostgreSQL database, which needs the package psycopg; run: "
            'pip install "liftlens[postgres]"'
        ) from error
    return url.set(drivername="postgresql+psycopg")


def _expected(got: str) -> str:
    return (
        f"{URL_VARIABLE} needs an address like postgresql://user@host/name, got {got}; correct "
        "it, or unset it to use the data folder's own database."
    )


# --------------------------------------------------------------------------- connections

_open: OrderedDict[str, Database] = OrderedDict()
_open_lock = threading.Lock()


def connect(root: Path, url: URL | None) -> Database:
    """Return the database of the library at `root`, connected once per process.

    Nothing is made or checked here; see `engine.storage.database.schema`.
    """
    key = str(root) if url is None else url.render_as_string(hide_password=False)
    path = root / DATABASE_NAME
    identity = None if url is not None else _identify(path)
    with _open_lock:
        known = _open.get(key)
        if known is not None and known.identity == identity:
            _open.move_to_end(key)
            return known
        if known is not None:
            # A file in the place of another (a restored backup) must not be written past.
            _open.pop(key).dispose()
        if url is not None:
            made = _connect_postgres(url)
        else:
            made = _connect_sqlite(path, is_writable=_may_write(path))
            made.identity = identity
        # A file that is still to be made can't be recognised yet.
        if url is not None or path.exists() or made.is_scratch:
            _open[key] = made
            while len(_open) > MAX_OPEN:
                _open.popitem(last=False)[1].dispose()
        return made


def close_databases() -> None:
    """Close every connection of this process."""
    with _open_lock:
        while _open:
            _open.popitem()[1].dispose()


def _identify(path: Path) -> tuple[int, int, bool]:
    """Return what tells one file under a name from another."""
    try:
        found = path.stat()
    except OSError:
        return 0, 0, _may_write(path)
    return found.st_dev, found.st_ino, _may_write(path)


def _may_write(path: Path) -> bool:
    # SQLite keeps its log beside the file, so the folder counts too.
    return os.access(path.parent, os.W_OK) and (not path.exists() or os.access(path, os.W_OK))


def _connect_postgres(url: URL) -> Database:
    engine = create_engine(
        url,
        pool_pre_ping=True,
        pool_size=5,
        connect_args={
            "connect_timeout": 10,
            "options": f"-c timezone=UTC -c lock_timeout={int(1000 * BUSY_TIMEOUT_S)}",
        },
    )
    return Database(engine, url.render_as_string(hide_password=True))


def _connect_sqlite(path: Path, *, is_writable: bool) -> Database:
    if is_writable:
        return Database(_sqlite_engine(path), str(path), path)
    if path.exists():
        return Database(_reader_engine(path), str(path), path, is_read_only=True)
    engine = create_engine(
        "sqlite://", poolclass=StaticPool, connect_args={"check_same_thread": False}
    )
    _prepare(engine, settings=_SETTINGS[:1])
    return Database(engine, str(path), path, is_read_only=True, is_scratch=True)


def _sqlite_engine(path: Path) -> Engine:
    engine = create_engine(
        URL.create("sqlite", database=str(path)), connect_args={"timeout": BUSY_TIMEOUT_S}
    )
    _prepare(engine, settings=_SETTINGS)
    return engine


def _reader_engine(path: Path) -> Engine:
    """Open a file that may only be read; `immutable` where not even the log's index can be made."""
    address = f"{path.resolve().as_uri()}?mode=ro"
    try:
        with contextlib.closing(sqlite3.connect(address, uri=True)) as probe:
            probe.execute("SELECT count(*) FROM sqlite_master")
    except sqlite3.OperationalError:
        address += "&immutable=1"

    def open_file() -> sqlite3.Connection:
        return sqlite3.connect(address, uri=True, timeout=BUSY_TIMEOUT_S, check_same_thread=False)

    engine = create_engine("sqlite://", creator=open_file, poolclass=QueuePool)
    _prepare(engine, settings=("PRAGMA query_only=ON",))
    return engine


def _prepare(engine: Engine, *, settings: tuple[str, ...]) -> None:
    """Let SQLAlchemy, not the driver, begin transactions, so that a change locks from its start."""

    @event.listens_for(engine, "connect")
    def _set_up(connection: Any, _entry: ConnectionPoolEntry) -> None:
        connection.isolation_level = None
        for setting in settings:
            connection.execute(setting)

    @event.listens_for(engine, "begin")
    def _begin(connection: Connection) -> None:
        # A change that first reads and then finds another writer would fail at once.
        writes = connection.get_execution_options().get(_WRITES, False)
        connection.exec_driver_sql("BEGIN IMMEDIATE" if writes else "BEGIN")
