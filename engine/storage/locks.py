"""A lock on a file that the operating system gives back when its holder dies."""

from __future__ import annotations

import contextlib
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import IO

__all__ = ["hold", "is_held"]


if sys.platform == "win32":  # pragma: no cover - other systems lock by flock
    import msvcrt

    def _try_lock(file: IO[bytes]) -> bool:
        try:
            msvcrt.locking(file.fileno(), msvcrt.LK_NBLCK, 1)
        except OSError:
            return False
        return True

    def _lock(file: IO[bytes]) -> None:
        while not _try_lock(file):
            pass  # LK_NBLCK sleeps nowhere; contention lasts microseconds here

else:
    import fcntl

    def _try_lock(file: IO[bytes]) -> bool:
        try:
            # Shared, so that two observers never take each other for a holder.
            fcntl.flock(file, fcntl.LOCK_SH | fcntl.LOCK_NB)
        except OSError:
            return False
        return True

    def _lock(file: IO[bytes]) -> None:
        fcntl.flock(file, fcntl.LOCK_EX)


@contextlib.contextmanager
def hold(path: Path) -> Iterator[None]:
    """Hold the lock on `path` for a while; wait for it if another process has it.

    A process that is killed gives it back at once, whatever killed it, so a lock that
    is held is proof of life, which a process number (reused after a while) is not.
    """
    with path.open("ab") as file:
        _lock(file)
        yield


def is_held(path: Path) -> bool:
    """Whether some process holds the lock on `path`."""
    if not path.exists():
        return False
    with path.open("ab") as file:
        return not _try_lock(file)
