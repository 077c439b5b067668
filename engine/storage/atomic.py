"""Writing so that nobody ever sees half of it."""

from __future__ import annotations

import contextlib
import errno
import shutil
import uuid
from collections.abc import Iterator
from pathlib import Path

from engine.errors import OutputError

__all__ = [
    "PARTIAL_SUFFIX",
    "explain_os_errors",
    "hidden_sibling",
    "scratch_folder",
    "write_aside",
]

PARTIAL_SUFFIX = ".partial"
"""Names of files and folders being written or removed end so, and start with a dot."""

_REASONS = {
    errno.ENOSPC: ("the disk is full", "free some space"),
    errno.EDQUOT: ("the disk quota is used up", "free some space"),
    errno.EFBIG: ("its files would be larger than allowed", "raise the limit"),
    errno.EACCES: ("you may not write there", "choose a folder of your own"),
    errno.EPERM: ("you may not write there", "choose a folder of your own"),
    errno.EROFS: ("the disk is read-only", "choose another disk"),
    errno.ENOENT: ("nothing can be made there", "choose a folder of your own"),
    errno.ENOTDIR: ("a part of its path is a file", "choose another folder"),
    errno.ENAMETOOLONG: ("its name is too long", "choose a shorter name"),
}


def hidden_sibling(path: Path) -> Path:
    """Return an unused hidden name beside `path`, on the same disk."""
    return path.with_name(f".{path.name[:80]}.{uuid.uuid4().hex[:12]}{PARTIAL_SUFFIX}")


@contextlib.contextmanager
def write_aside(path: Path) -> Iterator[Path]:
    """Give a name to write a file under; it takes the place of `path` once it is whole."""
    aside = hidden_sibling(path)
    try:
        yield aside
        aside.replace(path)
    finally:
        aside.unlink(missing_ok=True)


@contextlib.contextmanager
def scratch_folder(target: Path) -> Iterator[Path]:
    """Give a hidden folder beside `target` that vanishes at the end, whatever happens.

    Folders above it that are missing are made, and removed again while they are empty.

    Raises
    ------
    OutputError
        If nothing can be made there.
    """
    new_parents = [parent for parent in target.parents if not parent.exists()]
    scratch = hidden_sibling(target)
    try:
        with explain_os_errors(target):
            scratch.mkdir(parents=True)
        yield scratch
    except OutputError as error:
        # A user knows the folder that was asked for, not the one beside it.
        raise OutputError(str(error).replace(str(scratch), str(target))) from error
    finally:
        shutil.rmtree(scratch, ignore_errors=True)
        for parent in new_parents:
            with contextlib.suppress(OSError):
                parent.rmdir()


@contextlib.contextmanager
def explain_os_errors(target: Path, what: str = "The result") -> Iterator[None]:
    """Turn what the operating system says into one sentence for a user.

    Raises
    ------
    OutputError
        In the place of any `OSError`.
    """
    try:
        yield
    except OSError as error:
        fallback = (error.strerror or str(error), "choose another folder")
        why, todo = _REASONS.get(error.errno or 0, fallback)
        raise OutputError(f"{what} can't be written to {target}: {why}; {todo}.") from error
