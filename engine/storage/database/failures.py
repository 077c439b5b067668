"""What a database says when it can't, as one sentence for a user."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator

from sqlalchemy.exc import DataError as BadValue
from sqlalchemy.exc import DBAPIError, IntegrityError, ProgrammingError
from sqlalchemy.exc import TimeoutError as PoolTimeout

from engine.errors import BackendUnavailable, DataError, OutputError

__all__ = ["DatabaseDamaged", "DatabaseUnavailable", "DriverMissing", "explain_database_errors"]


class DatabaseUnavailable(OutputError):  # noqa: N818 - reads as a state
    """The database takes nothing now: busy, full, read-only or not reachable."""


class DatabaseDamaged(DataError):  # noqa: N818
    """The database can't be read by this program: damaged, or made by a newer one."""


class DriverMissing(BackendUnavailable):
    """The package that talks to this kind of database is not installed (exit code 4)."""


_CAUSES = (
    (
        ("database is locked", "database table is locked", "lock timeout", "lock_not_available"),
        "another program is holding it; try again in a moment",
    ),
    (("disk is full", "no space left", "disk full"), "the disk is full; free some space"),
    (
        ("readonly database", "read-only transaction", "read-only database"),
        "it may only be read here; choose a folder of your own with LIFTLENS_HOME",
    ),
    (
        ("unable to open database file",),
        "its file can't be opened; look at the permissions of the folder",
    ),
    (("disk i/o error",), "the disk reports an error; check it before you go on"),
    (
        ("connection refused", "could not connect", "connection failed", "connection timeout"),
        "its server does not answer; start it, or unset LIFTLENS_DATABASE_URL",
    ),
    (
        ("server closed the connection", "terminating connection", "connection is closed"),
        "its server ended the connection; try again",
    ),
)
"""What drivers say (in lower case), and what to tell the user."""

_OWN_FAULTS = (ProgrammingError, IntegrityError, BadValue)
"""What a mistake of this program looks like: no user can help it, so it is not explained away."""
_DAMAGE = ("file is not a database", "disk image is malformed")


@contextlib.contextmanager
def explain_database_errors(where: str) -> Iterator[None]:
    """Turn what a database driver says into one sentence.

    Raises
    ------
    DatabaseUnavailable
        If the database takes nothing now.
    DatabaseDamaged
        If its file is no database, or a damaged one.
    """
    try:
        yield
    except _OWN_FAULTS:
        raise
    except DBAPIError as error:
        raise _explain(where, str(error.orig)) from error
    except PoolTimeout as error:
        raise _explain(where, "lock timeout") from error


def _explain(where: str, said: str) -> DatabaseUnavailable | DatabaseDamaged:
    low = said.lower()
    if any(word in low for word in _DAMAGE):
        return DatabaseDamaged(
            f"The library's database {where} is damaged ({said}). Move the file away: LiftLens "
            "makes a new one from the result folders; notes, tags and reviews come back only from "
            "a backup or an export."
        )
    for words, advice in _CAUSES:
        if any(word in low for word in words):
            return DatabaseUnavailable(f"The library's database {where} can't be used: {advice}.")
    return DatabaseUnavailable(f"The library's database {where} failed: {said.strip()}.")
