"""How smoothly the player moves its cursor, in headless Chromium with software 3D graphics.

    python -m benchmarks.player_fps

A made trial of 30 s (900 pictures, 33 joints, 12 angles) with a video is opened in the real
dashboard. In every animation frame the cursor is sent to the next picture (scrubbing), then the
video is played, whose clip has 15 pictures a second. Without a graphics card the player starts with
the figure on a plain canvas; the solid one (three.js) has to be asked for. `peer` is the same
browser and page with an empty animation loop: what this machine can do at most while it is as busy
as it is now. One row a run; the aim is 30 pictures a second while scrubbing.
"""

from __future__ import annotations

import argparse
import os
import platform
import socket
import statistics
import subprocess
import sys
import tempfile
import time
import urllib.request
from pathlib import Path
from typing import Any

from engine.cli_serve import build_command
from engine.storage.library import HOME_VARIABLE, Library
from engine.storage.results import write_result
from tests.builders import make_trial_result
from tests.conftest import find_chromium
from tests.dashboard.results import write_clip

ROOT = Path(__file__).parents[1]
RESULTS = Path(__file__).with_name("results") / "player_fps.txt"
SECONDS, FPS = 30, 30
WINDOW_S = 3.0
AIM_FPS = 30.0
FRAME = "liftlens_player"
COMMON = ["--no-sandbox", "--disable-quic", "--no-first-run", "--disable-background-networking"]
NO_CARD = ["--disable-gpu", "--enable-unsafe-swiftshader"]
EMULATED = ["--use-angle=swiftshader", "--enable-unsafe-swiftshader"]
"""A card emulated by the processor puts the whole page together too; no ordinary computer does."""
PAINTERS = {
    "as it starts": NO_CARD,
    "solid asked for": NO_CARD,
    "emulated card": EMULATED,
}
MEASURE = """async ({ kind, seconds }) => {
  const { clock, stats } = window.liftlensPlayer;
  const count = { frames: 0, draws: stats.draws, draw_ms: stats.draw_ms };
  clock.seek(0);
  if (kind === 'play') clock.play();
  const start = performance.now();
  await new Promise((done) => {
    const tick = (now) => {
      if (now - start > 1000 * seconds) return done();
      count.frames += 1;
      if (kind === 'scrub') clock.seek(clock.times[count.frames % clock.times.length]);
      requestAnimationFrame(tick);
    };
    requestAnimationFrame(tick);
  });
  const passed = (performance.now() - start) / 1000;
  clock.pause();
  const draws = stats.draws - count.draws;
  return {
    fps: (kind === 'idle' ? count.frames : draws) / passed,
    draw_ms: draws ? (stats.draw_ms - count.draw_ms) / draws : 0,
  };
}"""


def main() -> None:
    """Measure, print the table and keep it."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--runs", type=int, default=3)
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        home = Path(folder) / "home"
        _make_library(home, Path(folder))
        with _Server(home) as address:
            rows = [
                row for name in PAINTERS for row in _measure(address, name, runs=arguments.runs)
            ]
    text = _render(rows, arguments.runs)
    RESULTS.parent.mkdir(exist_ok=True)
    RESULTS.write_text(text, encoding="utf-8")
    sys.stdout.write(text)


def _make_library(home: Path, scratch: Path) -> None:
    made = make_trial_result(n_frames=SECONDS * FPS, lis=(1.4, 1.1, 2.0))
    clip = write_clip(scratch / "clip.mp4", seconds=SECONDS)
    Library(home).adopt(write_result(made, scratch / "result", overlay=clip), "bench")


class _Server:
    """The dashboard on a free port, for as long as the block lasts."""

    def __init__(self, home: Path) -> None:
        self.home = home

    def __enter__(self) -> str:
        with socket.socket() as probe:
            probe.bind(("127.0.0.1", 0))
            port = probe.getsockname()[1]
        self.process = subprocess.Popen(
            build_command(host="127.0.0.1", port=port, is_headless=True),
            cwd=ROOT,
            env={**os.environ, HOME_VARIABLE: str(self.home), "PYTHONPATH": str(ROOT)},
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        )
        address = f"http://127.0.0.1:{port}"
        for _ in range(300):
            try:
                with urllib.request.urlopen(f"{address}/_stcore/health", timeout=2):
                    return address
            except OSError:
                time.sleep(0.2)
        raise SystemExit("The dashboard did not start within a minute.")

    def __exit__(self, *_: object) -> None:
        self.process.terminate()
        self.process.wait(timeout=20)


def _measure(address: str, painter: str, *, runs: int) -> list[dict[str, Any]]:
    from playwright.sync_api import sync_playwright

    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(
            executable_path=find_chromium(), args=[*COMMON, *PAINTERS[painter]]
        )
        page = browser.new_page(viewport={"width": 1280, "height": 900})
        page.goto(f"{address}/trial?trial=bench")
        page.locator(f"iframe[title*={FRAME}]").wait_for(timeout=90_000)
        frame = next(f for f in page.frames if FRAME in f.url)
        frame.wait_for_function("document.documentElement.dataset.painter", timeout=90_000)
        frame.wait_for_function("document.querySelector('video')?.readyState === 4")
        if painter == "solid asked for":
            frame.get_by_role("button", name="Solid").click()
            frame.wait_for_function("document.documentElement.dataset.painter[0] === 'S'")
        page.wait_for_timeout(1500)
        rows = []
        for run in range(1, runs + 1):
            found = {
                kind: frame.evaluate(MEASURE, {"kind": kind, "seconds": WINDOW_S})
                for kind in ("idle", "scrub", "play")
            }
            rows.append({"painter": painter, "run": run, **found})
        browser.close()
    return rows


def _render(rows: list[dict[str, Any]], runs: int) -> str:
    load = os.getloadavg()[0]
    lines = [
        f"# python -m benchmarks.player_fps --runs {runs}",
        f"# made trial of {SECONDS} s at {FPS} pictures a second, no random numbers",
        f"# window of {WINDOW_S:g} s, page of 1280 x 900; aim {AIM_FPS:g} fps while scrubbing",
        f"# {platform.machine()}, {os.cpu_count()} cores, load {load:.1f}, no graphics card",
        "painter          run  peer fps  scrub fps  ratio  draw ms  play fps  aim",
    ]
    for row in rows:
        peer, scrub, play = (row[kind]["fps"] for kind in ("idle", "scrub", "play"))
        verdict = "met" if scrub >= AIM_FPS else "NOT met"
        lines.append(
            f"{row['painter']:<16} {row['run']:>3} {peer:>9.1f} {scrub:>10.1f} "
            f"{scrub / peer:>6.2f} {row['scrub']['draw_ms']:>8.2f} {play:>9.1f}  {verdict}"
        )
    for painter in PAINTERS:
        own = [row["scrub"]["fps"] for row in rows if row["painter"] == painter]
        lines.append(f"{painter:<16} median scrub fps {statistics.median(own):.1f}")
    return "\n".join(lines) + "\n"


if __name__ == "__main__":
    main()
