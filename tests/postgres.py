"""A PostgreSQL server of the system, started for the tests in a folder of its own."""

from __future__ import annotations

import os
import shutil
import subprocess
import tempfile
import uuid
from collections.abc import Iterator, Sequence
from pathlib import Path

import pytest
from sqlalchemy import create_engine, text

BINARIES = "/usr/lib/postgresql/*/bin"
NO_SERVER = (
    "no PostgreSQL server was found in /usr/lib/postgresql; install one (as root: apt-get install "
    "postgresql)"
)
NO_RIGHTS = "PostgreSQL refuses to run as root, and there is no user postgres to run it as"


def find_binaries() -> Path | None:
    """Return the folder of the newest installed server."""
    found = sorted(Path("/usr/lib/postgresql").glob("*/bin/initdb"))
    return found[-1].parent if found else None


class Server:
    """A server that listens on a socket in its folder only."""

    def __init__(self, binaries: Path) -> None:
        self.binaries = binaries
        # Short: a socket's path has a hundred characters at most. Not below pytest's own folder,
        # which another user may not enter.
        self.folder = Path(tempfile.mkdtemp(prefix="llpg"))
        self.user = "postgres" if os.geteuid() == 0 else None
        if self.user:
            shutil.chown(self.folder, self.user)
        self.data = self.folder / "data"

    def start(self) -> None:
        """Make a new server and start it."""
        self._run("initdb", "-D", self.data, "-U", "tests", "-A", "trust", "--no-sync",
                  "--locale=C.UTF-8", "-E", "UTF8")  # fmt: skip
        options = f"-c listen_addresses='' -c fsync=off -k {self.folder}"
        self._run(
            "pg_ctl", "-D", self.data, "-w", "-l", self.folder / "log", "-o", options, "start"
        )

    def stop(self) -> None:
        """Stop it and remove all it wrote."""
        self._run("pg_ctl", "-D", self.data, "-m", "immediate", "stop")
        shutil.rmtree(self.folder, ignore_errors=True)

    def url(self, name: str) -> str:
        """Return the address of a database."""
        return f"postgresql://tests@/{name}?host={self.folder}"

    def make_database(self) -> str:
        """Make an empty database; return its name."""
        name = f"t{uuid.uuid4().hex}"
        self.execute(f"CREATE DATABASE {name}")
        return name

    def execute(self, statement: str, *, database: str = "postgres") -> None:
        """Run one statement outside any transaction."""
        url = self.url(database).replace("postgresql://", "postgresql+psycopg://")
        engine = create_engine(url, isolation_level="AUTOCOMMIT")
        try:
            with engine.connect() as connection:
                connection.execute(text(statement))
        finally:
            engine.dispose()

    def _run(self, program: str, *arguments: object) -> None:
        command: Sequence[str] = [str(self.binaries / program), *map(str, arguments)]
        # Not a pipe: the server keeps it open for as long as it lives.
        with (self.folder / "out").open("a") as out:
            done = subprocess.run(
                command,
                check=False,
                cwd=self.folder,
                stdin=subprocess.DEVNULL,
                stdout=out,
                stderr=subprocess.STDOUT,
                user=self.user,
                extra_groups=[] if self.user else None,
            )
        if done.returncode:
            pytest.fail(f"{program} failed: {(self.folder / 'out').read_text()[-2000:]}")


@pytest.fixture(scope="session")
def postgres() -> Iterator[Server]:
    """A running server; skipped where there is none (in CI that is a failure)."""
    binaries = find_binaries()
    if binaries is None:
        pytest.skip(NO_SERVER)
    if os.geteuid() == 0:
        import pwd

        if "postgres" not in {entry.pw_name for entry in pwd.getpwall()}:
            pytest.skip(NO_RIGHTS)
    server = Server(binaries)
    try:
        server.start()
        yield server
    finally:
        server.stop()
