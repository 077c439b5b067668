"""Start of the `liftlens` command, so small that Ctrl-C counts from the first moment on."""

from __future__ import annotations

import os
import signal
import threading
from types import FrameType

__all__ = ["guard_start", "ignore_interrupts", "is_own_handler", "main", "release_start"]

CANCELLED_EXIT_CODE = 130


def main() -> None:
    """Run the command line."""
    guard_start()
    from engine.cli import app

    app()


def guard_start() -> None:
    """Until a command runs, let Ctrl-C end the process in one sentence.

    Nothing was written yet, so there is nothing to clean up; an exception would surface in the
    middle of imports as a page of traceback.
    """
    if threading.current_thread() is threading.main_thread():
        signal.signal(signal.SIGINT, _end)


def release_start() -> None:
    """Give Ctrl-C back its usual meaning, once a command can answer it."""
    if signal.getsignal(signal.SIGINT) is _end:
        signal.signal(signal.SIGINT, _interrupt)


def is_own_handler(handler: object) -> bool:
    """Whether `main` set this handler: as a part of another program it is not ours to change."""
    return handler is _interrupt


def ignore_interrupts() -> None:
    """Let nothing disturb the last sentence of a command that is ending."""
    if is_own_handler(signal.getsignal(signal.SIGINT)):
        signal.signal(signal.SIGINT, signal.SIG_IGN)


def _interrupt(_number: int, _frame: FrameType | None) -> None:
    raise KeyboardInterrupt


def _end(_number: int, _frame: FrameType | None) -> None:
    os.write(2, b"\nError: Stopped before anything was done; nothing was kept.\n")
    os._exit(CANCELLED_EXIT_CODE)


if __name__ == "__main__":
    # Not this copy's `main`: the handlers must be those that the command line knows.
    from engine.cli_start import main as start

    start()
