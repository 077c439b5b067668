"""How quick the dashboard is with ten thousand trials, and how much memory ten users take.

Run from the project folder::

    .venv/bin/python benchmarks/dashboard.py

Needs Playwright and Chromium. Starts the real server on the library that
``benchmarks/library.py`` makes (10 000 trials, kept in ``.benchmark_cache``), opens pages
in a headless browser and takes the time from the request or click to what the user waits
for. The browser runs on the same machine, so its own work is in every number. An app that shows a
title only is the peer: what Streamlit and the browser take by themselves. Beside the clock stands
the processor time of the server and of the browser until the page is still, which other programs
on the machine lengthen less; every page is a new visitor's, with nothing kept from before.
"""

from __future__ import annotations

import argparse
import math
import os
import platform
import shutil
import socket
import statistics
import subprocess
import sys
import time
import urllib.request
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from library import make_folders

from engine.cli_serve import build_command
from engine.storage.library import HOME_VARIABLE, Library

ROOT = Path(__file__).parents[1]
OPTIONS = ["--no-sandbox", "--disable-gpu"]
WAIT_MS = 300_000
SETTLE_S = 1.0
"""How long after what the user waits for the page may go on drawing."""
TICKS_PER_S = os.sysconf("SC_CLK_TCK")
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
    "server with all sessions": "600 MB",
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


@dataclass(frozen=True)
class Spent:
    """Milliseconds of the clock, and of the processor in server and browser."""

    clock: float
    server: float = math.nan
    browser: float = math.nan


def read_cpu_ms(pid: int, *, with_children: bool) -> float:
    """Return the processor time of a process, or of all below it, from Linux's /proc."""
    used: dict[int, list[tuple[int, int]]] = {}
    for place in Path("/proc").iterdir():
        if not place.name.isdigit():
            continue
        try:
            fields = (place / "stat").read_text(encoding="ascii").rsplit(")", 1)[1].split()
        except OSError:  # ended meanwhile
            continue
        spent = int(fields[11]) + int(fields[12])
        if not with_children and int(place.name) == pid:
            return 1000 * spent / TICKS_PER_S
        used.setdefault(int(fields[1]), []).append((int(place.name), spent))
    total, waiting = 0, [pid]
    while waiting:
        for child, spent in used.get(waiting.pop(), []):
            total += spent
            waiting.append(child)
    return 1000 * total / TICKS_PER_S


class Stopwatch:
    """Takes the time of acts on one server; its browser and this process share the rest."""

    def __init__(self, servers: Sequence[subprocess.Popen[bytes]]) -> None:
        self.servers = servers

    def _browser_ms(self) -> float:
        servers = sum(read_cpu_ms(s.pid, with_children=False) for s in self.servers)
        return read_cpu_ms(os.getpid(), with_children=True) - servers

    def take(
        self,
        server: subprocess.Popen[bytes],
        act: Callable[[], object],
        wait: Callable[[], object],
    ) -> Spent:
        """Return what it takes from an act to what is waited for."""
        before, browser = read_cpu_ms(server.pid, with_children=False), self._browser_ms()
        start = time.perf_counter()
        act()
        wait()
        clock = 1000 * (time.perf_counter() - start)
        time.sleep(SETTLE_S)
        after = read_cpu_ms(server.pid, with_children=False)
        return Spent(clock, after - before, self._browser_ms() - browser)


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


Step = tuple[Callable[[], object], Callable[[], object]]
"""What the user does, and what they wait for."""


def open_list(page: Any, address: str) -> Step:
    """Open the list in a new session."""
    return (
        lambda: page.goto(address, wait_until="commit", timeout=WAIT_MS),
        lambda: page.locator(ENTRIES).first.wait_for(timeout=WAIT_MS),
    )


def open_empty(page: Any, address: str) -> Step:
    """Open an app that shows a title only."""
    return (
        lambda: page.goto(address, wait_until="commit", timeout=WAIT_MS),
        lambda: page.locator("h1").first.wait_for(timeout=WAIT_MS),
    )


def open_trial(page: Any) -> Step:
    """Open the first trial of the list; done when its verdict stands there."""
    return (
        page.get_by_role("button", name="Open", exact=True).first.click,
        lambda: page.locator(".ll-verdict").first.wait_for(timeout=WAIT_MS),
    )


def open_overview(page: Any, address: str) -> Step:
    """Open the page of all sites and jobs, as a new visitor."""
    return (
        lambda: page.goto(f"{address}/manage", wait_until="commit", timeout=WAIT_MS),
        lambda: page.get_by_text("The worst jobs").wait_for(timeout=WAIT_MS),
    )


def filter_by_level(page: Any) -> Step:
    """Ask for the trials of high risk."""
    before = read_count(page)
    pill = page.get_by_role("button", name="High risk").first
    return pill.click, lambda: wait_for_change(page, before)


def search(page: Any) -> Step:
    """Search for two words."""
    before = read_count(page)
    box = page.get_by_placeholder("Search by name")
    box.fill("crate hall")
    return lambda: box.press("Enter"), lambda: wait_for_change(page, before)


def turn_page(page: Any) -> Step:
    """Go to the second page of the list."""
    return (
        page.get_by_role("button", name="Next").click,
        lambda: page.get_by_text("Page 2 of").wait_for(timeout=WAIT_MS),
    )


def run(step: Step) -> None:
    """Do a step without taking its time."""
    act, wait = step
    act()
    wait()


def measure(
    home: Path, repeats: int, sessions: int, chromium: str | None
) -> dict[str, list[Spent]]:
    """Time everything in fresh sessions; the last ones stay open for the memory."""
    from playwright.sync_api import sync_playwright

    rows: dict[str, list[Spent]] = {name: [] for name in AIMS}
    server, address = start_server(home)
    empty = home.parent / "empty.py"
    empty.write_text(EMPTY, encoding="utf-8")
    peer, peer_address = start_server(home, empty)
    watch = Stopwatch((server, peer))
    try:
        with sync_playwright() as playwright:
            browser = playwright.chromium.launch(executable_path=chromium, args=OPTIONS)
            warm = browser.new_page()
            run(open_list(warm, address))
            run(open_trial(warm))
            run(open_empty(warm, peer_address))
            warm.close()
            time.sleep(3)  # until the folders' time can be trusted
            rows["server with no session"].append(Spent(read_memory_mb(server.pid)))
            for _ in range(repeats):
                page = browser.new_page()
                rows["first paint of an empty app"].append(
                    watch.take(peer, *open_empty(page, peer_address))
                )
                page.close()
                page = browser.new_page()
                for name, step in (
                    ("first paint of the list", lambda page=page: open_list(page, address)),
                    ("filter by level", lambda page=page: filter_by_level(page)),
                    ("search", lambda page=page: search(page)),
                    ("next page", lambda page=page: turn_page(page)),
                    ("open a trial", lambda page=page: open_trial(page)),
                    ("overview of all trials", lambda page=page: open_overview(page, address)),
                ):
                    rows[name].append(watch.take(server, *step()))
                page.close()
            pages = [browser.new_page() for _ in range(sessions)]
            for page in pages:
                run(open_list(page, address))
                run(open_trial(page))
            rows["server with all sessions"].append(Spent(read_memory_mb(server.pid)))
            browser.close()
    finally:
        for process in (server, peer):
            process.terminate()
            process.wait(timeout=20)
    return rows


def render(rows: dict[str, list[Spent]]) -> list[str]:
    """Return the lines of the table."""
    head = ("median", "worst", "server", "browser", "aim")
    lines = [f"{'':<30}" + "".join(f"{word:>9}" for word in head) + "   (ms; MB for the server)"]
    for name, spent in rows.items():
        clock = [one.clock for one in spent]
        numbers = (
            statistics.median(clock),
            max(clock),
            statistics.median(one.server for one in spent),
            statistics.median(one.browser for one in spent),
        )
        shown = "".join("        -" if math.isnan(n) else f"{n:9.0f}" for n in numbers)
        lines.append(f"{name:<30}{shown}{AIMS[name]:>9}")
    return [*lines, "", "median and worst: the clock; server and browser: processor time, median"]


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
        *render(rows),
    ]
    text = "\n".join(lines) + "\n"
    given.out.parent.mkdir(parents=True, exist_ok=True)
    given.out.write_text(text, encoding="utf-8")
    sys.stdout.write(text)


if __name__ == "__main__":
    main()
