"""Libraries on both kinds of database."""

from __future__ import annotations

import shutil
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from engine.storage.database.connection import URL_VARIABLE, close_databases
from engine.storage.database.models import Base
from engine.storage.library import Library
from tests.postgres import Server, postgres  # noqa: F401 - a fixture

BOTH = ("sqlite", "postgres")


@pytest.fixture(autouse=True)
def _own_database(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Keep tests off a database somebody set, and close their connections."""
    monkeypatch.delenv(URL_VARIABLE, raising=False)
    yield
    close_databases()


@pytest.fixture(scope="session")
def empty_database(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """SQLite's file of a library nobody has used."""
    root = tmp_path_factory.mktemp("empty")
    Library(root).database.scrub()
    close_databases()
    return root / "library.db"


@pytest.fixture(scope="session")
def shared_database(
    postgres: Server,  # noqa: F811
    tmp_path_factory: pytest.TempPathFactory,
) -> str:
    """Name of a PostgreSQL database with LiftLens's tables, emptied before each test."""
    name = postgres.make_database()
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv(URL_VARIABLE, postgres.url(name))
        Library(tmp_path_factory.mktemp("postgres"))
        close_databases()
    return name


@pytest.fixture
def library(tmp_path: Path, empty_database: Path) -> Library:
    """An empty library with its own SQLite database."""
    (tmp_path / "home").mkdir()
    shutil.copy(empty_database, tmp_path / "home" / "library.db")
    return Library.open(tmp_path / "home")


@pytest.fixture(params=BOTH)
def any_library(
    request: pytest.FixtureRequest, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> Library:
    """An empty library, on SQLite and on PostgreSQL."""
    if request.param == "sqlite":
        return request.getfixturevalue("library")
    server: Server = request.getfixturevalue("postgres")
    name = request.getfixturevalue("shared_database")
    tables = ", ".join(f'"{table}"' for table in Base.metadata.tables)
    server.execute(f"TRUNCATE {tables} RESTART IDENTITY CASCADE", database=name)
    monkeypatch.setenv(URL_VARIABLE, server.url(name))
    return Library.open(tmp_path / "home")


@pytest.fixture
def other_library(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[[], Library]:
    """Make a second library, on SQLite: where exports go."""

    def make() -> Library:
        monkeypatch.delenv(URL_VARIABLE, raising=False)
        return Library.open(tmp_path / "elsewhere")

    return make
