"""How quick the dashboard is with ten thousand trials, and how much memory ten users take.

Run from the project folder::

    .venv/bin/python benchmarks/dashboard.py

Needs Playwright and Chromium. Starts the real server on the library that
``benchmarks/library.py`` makes (10 000 trials, kept in ``.benchmark_cache``), opens pages
in a headless browser and takes the time from the request or click to what the user waits
for. The browser runs on the same machine, so its own work is in every number.
"""

from __future__ import annotations

import argparse
import os
import platform
import shutil
import socket
import statistics
import subprocess
import sys
import time
import urllib.request
from collections.abc import Callable
from pathlib import Path
from typing import Any

from library import make_folders

from engine.cli_serve import build_command
from engine.storage.library import HOME_VARIABLE, Library

ROOT = Path(__file__).parents[1]
OPTIONS = ["--no-sandbox", "--disable-gpu"]
WAIT_MS = 60_000
EMPTY = "import streamlit as st\nst.title('Nothing')\n"
AIMS = {
    "first paint of an empty app": "(peer)",
    "first paint of the list": "1500 ms",
    "open a trial": "400 ms",
    "filter by level": "200 ms",
    "search": "200 ms",
    "next page": "",
    "overview of all trials": "",
    "server with no session": "",
    "server with 10 sessions": "600 MB",
}
ENTRIES = ".ll-item"


def start_server(home: Path, app: Path | None = None) -> tuple[subprocess.Popen[bytes], str]:
    """Start the dashboard, or another app, on a free port; return it with its address."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    command = build_command(host="127.0.0.1", port=port, is_headless=True)
    if app is not None:
        command = [str(app) if part.endswith("app.py") else part for part in command]
    server = subprocess.Popen(
        command,
        cwd=ROOT,
        env={**os.environ, HOME_VARIABLE: str(home), "PYTHONPATH": str(ROOT)},
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    )
    address, end_s = f"http://127.0.0.1:{port}", time.monotonic() + 60
    while True:
        try:
            with urllib.request.urlopen(f"{address}/_stcore/health", timeout=2):
                return server, address
        except OSError:
            if server.poll() is not None or time.monotonic() > end_s:
                raise
            time.sleep(0.1)


def read_memory_mb(pid: int) -> float:
    """Return the resident memory of a process, from Linux's /proc."""
    for line in Path(f"/proc/{pid}/status").read_text(encoding="ascii").splitlines():
        if line.startswith("VmRSS:"):
            return int(line.split()[1]) / 1000
    return float("nan")


def time_ms(act: Callable[[], object], wait: Callable[[], object]) -> float:
    """Return how long it takes from an act to what is waited for."""
    start = time.perf_counter()
    act()
    wait()
    return 1000 * (time.perf_counter() - start)


def wait_for_change(page: Any, before: str) -> None:
    """Wait until the line that counts the matches says something else."""
    page.wait_for_function(
        "before => { const p = document.querySelector('[data-testid=stCaptionContainer]');"
        " return p && p.innerText !== before; }",
        arg=before,
        timeout=WAIT_MS,
    )


def read_count(page: Any) -> str:
    """Return the line that counts the matches."""
    return str(page.locator("[data-testid=stCaptionContainer]").first.inner_text())


def open_list(page: Any, address: str) -> float:
    """Open the list in a new session."""
    return time_ms(
        lambda: page.goto(address), lambda: page.locator(ENTRIES).first.wait_for(timeout=WAIT_MS)
    )


def use_list(page: Any) -> dict[str, float]:
    """Filter, search and turn pages as a user does."""
    found = {}
    before = read_count(page)
    pill = page.get_by_role("button", name="High risk").first
    found["filter by level"] = time_ms(pill.click, lambda: wait_for_change(page, before))
    before = read_count(page)
    box = page.get_by_placeholder("Search by name")
    box.fill("crate hall")
    found["search"] = time_ms(lambda: box.press("Enter"), lambda: wait_for_change(page, before))
    found["next page"] = time_ms(
        lambda: page.get_by_role("button", name="Next").click(),
        lambda: page.get_by_text("Page 2 of").wait_for(timeout=WAIT_MS),
    )
    return found


def open_empty(page: Any, address: str) -> float:
    """Open an app that shows a title only: what Streamlit and the browser take by themselves."""
    return time_ms(
        lambda: page.goto(address), lambda: page.locator("h1").first.wait_for(timeout=WAIT_MS)
    )


def open_trial(page: Any) -> float:
    """Open the first trial of the list; done when its verdict stands there."""
    return time_ms(
        page.get_by_role("button", name="Open", exact=True).first.click,
        lambda: page.locator(".ll-verdict").first.wait_for(timeout=WAIT_MS),
    )


def measure(
    home: Path, repeats: int, sessions: int, chromium: str | None
) -> dict[str, list[float]]:
    """Time everything in fresh sessions; the last ones stay open for the memory."""
    from playwright.sync_api import sync_playwright

    rows: dict[str, list[float]] = {name: [] for name in AIMS}
    server, address = start_server(home)
    empty = home.parent / "empty.py"
    empty.write_text(EMPTY, encoding="utf-8")
    peer, peer_address = start_server(home, empty)
    try:
        with sync_playwright() as playwright:
            browser = playwright.chromium.launch(executable_path=chromium, args=OPTIONS)
            warm = browser.new_page()
            open_list(warm, address)
            open_trial(warm)
            open_empty(warm, peer_address)
            warm.close()
            time.sleep(3)  # until the folders' time can be trusted
            rows["server with no session"].append(read_memory_mb(server.pid))
            for _ in range(repeats):
                page = browser.new_page()
                rows["first paint of an empty app"].append(open_empty(page, peer_address))
                page.close()
                page = browser.new_page()
                rows["first paint of the list"].append(open_list(page, address))
                time.sleep(1)
                for name, spent in use_list(page).items():
                    rows[name].append(spent)
                time.sleep(1)
                rows["open a trial"].append(open_trial(page))
                rows["overview of all trials"].append(
                    time_ms(
                        lambda page=page: page.goto(f"{address}/manage"),
                        lambda page=page: page.get_by_text("The worst jobs").wait_for(
                            timeout=WAIT_MS
                        ),
                    )
                )
                page.close()
            pages = [browser.new_page() for _ in range(sessions)]
            for page in pages:
                open_list(page, address)
                open_trial(page)
            rows["server with 10 sessions"].append(read_memory_mb(server.pid))
            browser.close()
    finally:
        for process in (server, peer):
            process.terminate()
            process.wait(timeout=20)
    return rows


def main() -> None:
    """Make or reuse the library, time the pages, print and keep the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--trials", type=int, default=10_000)
    parser.add_argument("--repeats", type=int, default=7)
    parser.add_argument("--sessions", type=int, default=10)
    parser.add_argument("--seed", type=int, default=20261122)
    parser.add_argument("--cache", type=Path, default=Path(".benchmark_cache/library"))
    parser.add_argument("--chromium", default=shutil.which("chromium"), help="its program")
    parser.add_argument("--out", type=Path, default=Path("benchmarks/results/dashboard.txt"))
    given = parser.parse_args()
    home = (given.cache / f"{given.trials}").resolve()
    if not home.exists():
        make_folders(home, given.trials, given.seed)
    n_trials = Library.open(home).query(limit=1).total
    rows = measure(home, given.repeats, given.sessions, given.chromium)
    machine = f"{platform.machine()}, {os.cpu_count()} cores, Python {platform.python_version()}"
    lines = [
        f"Dashboard with {n_trials} trials, seed {given.seed}, {given.sessions} sessions",
        f"Command: benchmarks/dashboard.py --trials {given.trials} --repeats {given.repeats}",
        f"Machine: {machine}, load {os.getloadavg()[0]:.1f} (server and browser share it)",
        "",
        f"{'':<30}{'median':>10}{'worst':>10}{'aim':>10}   (ms; MB for the server)",
        *(
            f"{name:<30}{statistics.median(spent):10.0f}{max(spent):10.0f}{AIMS[name]:>10}"
            for name, spent in rows.items()
        ),
    ]
    text = "\n".join(lines) + "\n"
    given.out.parent.mkdir(parents=True, exist_ok=True)
    given.out.write_text(text, encoding="utf-8")
    sys.stdout.write(text)


if __name__ == "__main__":
    main()
