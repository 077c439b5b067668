"""Files kept once under the hash of their content: `artefacts/ab/cdef...`.

What belongs to one result lies in its folder, under names other tools know. Here lies what several
trials share (one calibration of two cameras for a whole day) or what is no part of a
result (an original that somebody wants to keep). Kept by content, it takes its space once, and a
change of a single byte is noticed.
"""

from __future__ import annotations

import contextlib
import hashlib
import os
import shutil
import time
from dataclasses import dataclass
from pathlib import Path

from engine.errors import DataError
from engine.storage.atomic import PARTIAL_SUFFIX, explain_os_errors, hidden_sibling

__all__ = ["ArtefactStore", "HashedFile", "hash_file"]

CHUNK_BYTES = 1 << 20
_HASH_LENGTH = 64


@dataclass(frozen=True)
class HashedFile:
    """A file with its size in bytes and the SHA-256 of its content, in hexadecimal."""

    path: Path
    sha256: str
    size: int


def hash_file(path: Path) -> HashedFile:
    """Hash a file."""
    digest, size = hashlib.sha256(), 0
    with path.open("rb") as file:
        while chunk := file.read(CHUNK_BYTES):
            digest.update(chunk)
            size += len(chunk)
    return HashedFile(path, digest.hexdigest(), size)


class ArtefactStore:
    """The files below one folder.

    Parameters
    ----------
    root
        The folder; made when the first file comes.
    """

    def __init__(self, root: Path) -> None:
        self.root = root

    def path(self, sha256: str) -> Path:
        """Return where content lies, whether or not it is there.

        Raises
        ------
        DataError
            If that is no SHA-256 in hexadecimal.
        """
        if len(sha256) != _HASH_LENGTH or set(sha256) - set("0123456789abcdef"):
            raise DataError(f"Expected a SHA-256 of 64 lower-case hex digits, got {sha256!r}.")
        return self.root / sha256[:2] / sha256[2:]

    def bring(self, source: Path) -> HashedFile:
        """Copy a file beside the store, hashing it on the way; `keep` or `drop` it then.

        Raises
        ------
        OutputError
            If it can't be copied, for example because the disk is full; nothing is left behind.
        """
        digest, size = hashlib.sha256(), 0
        with explain_os_errors(self.root, "The file"):
            self.root.mkdir(parents=True, exist_ok=True)
            aside = hidden_sibling(self.root / "new")
            try:
                with source.open("rb") as given, aside.open("wb") as copy:
                    while chunk := given.read(CHUNK_BYTES):
                        digest.update(chunk)
                        size += len(chunk)
                        copy.write(chunk)
                    copy.flush()
                    os.fsync(copy.fileno())
            except BaseException:
                aside.unlink(missing_ok=True)
                raise
        return HashedFile(aside, digest.hexdigest(), size)

    def keep(self, brought: HashedFile) -> HashedFile:
        """Give brought content its place; the same content that is there already stays."""
        target = self.path(brought.sha256)
        with explain_os_errors(target, "The file"):
            if target.exists() and target.stat().st_size == brought.size:
                brought.path.unlink()
            else:
                target.parent.mkdir(parents=True, exist_ok=True)
                brought.path.replace(target)
        return HashedFile(target, brought.sha256, brought.size)

    def drop(self, brought: HashedFile) -> None:
        """Remove brought content that is not wanted after all."""
        brought.path.unlink(missing_ok=True)

    def copy_to(self, sha256: str, target: Path) -> None:
        """Copy content to where another program gets it under a name it knows.

        A hard link would take no space, but let that program change what several trials share.

        Raises
        ------
        DataError
            If it is not there.
        """
        source = self.path(sha256)
        if not source.is_file():
            raise DataError(f"The file {target.name} is missing from {source}; restore a backup.")
        with explain_os_errors(target, "The file"):
            shutil.copyfile(source, target)

    def check(self, sha256: str) -> Path:
        """Return where content lies, after a look at every byte.

        Raises
        ------
        DataError
            If it is missing or was changed.
        """
        path = self.path(sha256)
        if not path.is_file():
            raise DataError(f"The file {path} is missing; restore it from a backup.")
        if hash_file(path).sha256 != sha256:
            raise DataError(f"The file {path} was changed or damaged; restore it from a backup.")
        return path

    def remove(self, sha256: str) -> None:
        """Remove content, and its folder if it was the last there."""
        path = self.path(sha256)
        with explain_os_errors(path, "The deletion"):
            path.unlink(missing_ok=True)
        with contextlib.suppress(OSError):
            path.parent.rmdir()

    def strays(self, known: set[str], *, older_than_s: float) -> list[Path]:
        """Return old files that nothing refers to: what interrupted processes left."""
        if not self.root.is_dir():
            return []
        files = [p for p in self.root.glob("??/*") if f"{p.parent.name}{p.name}" not in known]
        files += self.root.glob(f".*{PARTIAL_SUFFIX}")
        limit_s = time.time() - older_than_s
        return [path for path in files if _modified_s(path) < limit_s]


def _modified_s(path: Path) -> float:
    try:
        return path.stat().st_mtime
    except OSError:
        return float("inf")
