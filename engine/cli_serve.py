"""Starting the dashboard."""

from __future__ import annotations

import importlib.util
import os
import signal
import socket
import subprocess
import sys
from collections.abc import Callable, Mapping
from pathlib import Path

import engine
from engine.errors import BackendUnavailable, ConfigError, EngineError

__all__ = ["APP_PATH", "build_command", "has_display", "serve_dashboard"]

APP_PATH = Path(engine.__file__).parents[1] / "dashboard" / "app.py"


def serve_dashboard(*, host: str, port: int, say: Callable[[str], object]) -> int:
    """Run the dashboard until it ends; return its exit code, 0 after Ctrl-C.

    Raises
    ------
    BackendUnavailable
        If the dashboard or what it needs is not installed.
    ConfigError
        If the port is taken or the address can't be used.
    """
    if not APP_PATH.is_file():
        raise BackendUnavailable(
            f"The dashboard is not there (expected {APP_PATH}); install LiftLens again."
        )
    if importlib.util.find_spec("streamlit") is None:
        raise BackendUnavailable("The dashboard needs streamlit; run: pip install streamlit.")
    _check_address(host, port)
    _prepare_samples(say)
    say(f"Dashboard: http://{host}:{port} (Ctrl-C ends it)")
    process = subprocess.Popen(
        build_command(host=host, port=port, is_headless=not has_display(os.environ)),
        env=_build_environment(os.environ),
    )
    return _wait(process)


def build_command(*, host: str, port: int, is_headless: bool) -> list[str]:
    """Return the command that runs the dashboard."""
    options = {
        "server.address": host,
        "server.port": str(port),
        "server.headless": str(is_headless).lower(),
        "browser.gatherUsageStats": "false",
    }
    pairs = [part for name, value in options.items() for part in (f"--{name}", value)]
    return [sys.executable, "-m", "streamlit", "run", str(APP_PATH), *pairs]


def has_display(environment: Mapping[str, str]) -> bool:
    """Whether a browser could open here."""
    if environment.get("CI") or environment.get("SSH_CONNECTION"):
        return False
    if sys.platform in ("win32", "darwin"):
        return True
    return bool(environment.get("DISPLAY") or environment.get("WAYLAND_DISPLAY"))


def _prepare_samples(say: Callable[[str], object]) -> None:
    """Let an empty library start with finished samples; no trouble with them stops the start."""
    from engine.sample_results import retire_samples, welcome
    from engine.storage.library import Library

    try:
        library = Library.open()
        retire_samples(library)
        welcome(library)
    except EngineError as error:
        say(f"The samples can't be shown: {error}")


def _build_environment(environment: Mapping[str, str]) -> dict[str, str]:
    """Let the dashboard and its workers import what runs here, installed or not."""
    root = str(APP_PATH.parents[1])
    paths = os.pathsep.join(filter(None, (root, environment.get("PYTHONPATH"))))
    return {**environment, "PYTHONPATH": paths}


def _check_address(host: str, port: int) -> None:
    try:
        family, kind, protocol, _, address = socket.getaddrinfo(
            host, port, type=socket.SOCK_STREAM
        )[0]
        with socket.socket(family, kind, protocol) as probe:
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            probe.bind(address)
    except OSError as error:
        raise ConfigError(
            f"The dashboard can't listen on {host}:{port} ({error.strerror or error}); choose "
            "another address with --host or --port."
        ) from error


def _wait(process: subprocess.Popen[bytes]) -> int:
    """Wait for the dashboard; on Ctrl-C (which it gets too) or SIGTERM let it end."""

    def end(_number: int, _frame: object) -> None:
        process.terminate()

    earlier = signal.signal(signal.SIGTERM, end)
    try:
        while True:
            try:
                code = process.wait()
            except KeyboardInterrupt:
                process.terminate()
            else:
                return 0 if code in (-signal.SIGINT, -signal.SIGTERM) else code
    finally:
        signal.signal(signal.SIGTERM, earlier)
