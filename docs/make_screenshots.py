"""Photograph every page of the dashboard, light and dark, wide and narrow.

Run from the project folder::

    .venv/bin/python docs/make_screenshots.py

Starts the dashboard twice, as `liftlens serve` does: on a new library, which holds the bundled
samples, and on an invented one with sixty trials of a year, for the pages that sum up. Every page
is photographed in its whole length into ``docs/screenshots``. Needs a Chromium of the system and
the development extras. ``--only trial,risk`` photographs some pages only.
"""

from __future__ import annotations

import argparse
import contextlib
import io
import json
import os
import random
import shutil
import socket
import subprocess
import sys
import tempfile
import time
import urllib.request
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import TYPE_CHECKING

from PIL import Image

from engine.sample_results import add_samples
from engine.storage.library import HOME_VARIABLE, Library

if TYPE_CHECKING:
    from playwright.sync_api import Browser, Page

ROOT = Path(__file__).parents[1]
OUT = Path(__file__).with_name("screenshots")
BROWSERS = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable")
CHROMIUM_OPTIONS = (
    "--no-sandbox",
    "--disable-quic",
    "--no-first-run",
    "--disable-background-networking",
    "--disable-component-update",
    "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader",
    "--ignore-gpu-blocklist",
)
WIDTHS_PX = (1280, 420)
MODES = ("light", "dark")
WEBP_QUALITY = 72
BAR_PX = 70
MAX_HEIGHT_PX = 7800
"""Chromium repeats what is beyond 8192 px."""
TIMEOUT_MS = 300_000
MAIN = "[data-testid=stMain]"
AT_REST = "[data-testid=stApp][data-test-script-state=notRunning]"
LIFT, TWO_VIEWS, OTHER = (
    "bundled-floor_to_shoulder",
    "bundled-two_cameras",
    "bundled-floor_to_knuckle",
)
Prepare = Callable[["Page"], None]


@dataclass(frozen=True)
class Shot:
    """One page: where it is, what shows that it is ready, what to do before it is photographed."""

    name: str
    path: str
    sign: str
    prepare: Prepare | None = None


def _player_ready(page: Page) -> None:
    """Move the player to a telling moment, once its videos and curves are there."""
    frame = page.frame_locator("iframe[title*=liftlens_player]")
    frame.locator(".readout", has_text="picture").wait_for(timeout=TIMEOUT_MS)
    inner = next(f for f in page.frames if "liftlens_player" in f.url)
    inner.wait_for_function("document.documentElement.dataset.painter")
    inner.wait_for_function(
        "[...document.querySelectorAll('video')].every(v => v.readyState === 4)",
        timeout=TIMEOUT_MS,
    )
    frame.locator("button.lift").first.click()
    inner.wait_for_function("[...document.querySelectorAll('video')].every(v => !v.seeking)")


def _pair_ready(page: Page) -> None:
    inner = page.frame_locator("iframe[title*=liftlens_pair]")
    inner.locator("video").nth(1).wait_for(timeout=TIMEOUT_MS)


def _use_markers(page: Page) -> None:
    """Take the bundled markers as reference, unless an earlier picture did."""
    button = page.get_by_role("button", name="Use the markers bundled with this sample")
    if button.is_visible():
        button.click()
    page.get_by_role("button", name="Whole comparison (zip)").wait_for(timeout=TIMEOUT_MS)


def _open_tab(name: str) -> Prepare:
    def click(page: Page) -> None:
        page.get_by_role("tab", name=name).click()

    return click


def _choose(name: str) -> Prepare:
    def click(page: Page) -> None:
        page.get_by_test_id("stButtonGroup").get_by_text(name, exact=True).click()

    return click


def _fill_new(page: Page) -> None:
    page.get_by_text("Use a sample", exact=True).click()
    page.locator(AT_REST).wait_for()


SAMPLE_SHOTS = (
    Shot("trials", "/", ".ll-card"),
    Shot("new", "/new", "[data-testid=stFileUploader]"),
    Shot("new-sample", "/new", "[data-testid=stFileUploader]", _fill_new),
    Shot("trial", f"/trial?trial={LIFT}", ".ll-end", _player_ready),
    Shot("trial-two-views", f"/trial?trial={TWO_VIEWS}", ".ll-end", _player_ready),
    Shot("trial-no-lift", "/trial?trial=bundled-real_walkway", ".ll-verdict"),
    Shot("risk", f"/risk?trial={LIFT}", ".ll-table"),
    Shot("improve", f"/improve?trial={LIFT}", ".ll-table"),
    Shot("improve-change", f"/improve?trial={LIFT}", "h1", _choose("Before and after")),
    Shot("improve-job", f"/improve?trial={LIFT}", "h1", _choose("A whole job")),
    Shot("reference", f"/reference?trial={OTHER}", "h1", _use_markers),
    Shot("cameras", "/cameras", "h1"),
    Shot("estimators", f"/estimators?trial={LIFT}", "h1"),
    Shot("study", "/study", "h1"),
    Shot("train", f"/train?against={TWO_VIEWS}&trial={LIFT}", ".ll-table", _pair_ready),
    Shot("manage-samples", "/manage", ".ll-tile"),
    Shot("settings", "/settings", "h1"),
    Shot("settings-data", "/settings", "h1", _open_tab("Data")),
    Shot("settings-people", "/settings", "h1", _open_tab("People")),
    Shot("settings-models", "/settings", "h1", _open_tab("Models")),
)
INVENTED_SHOTS = (
    Shot("trials-many", "/", ".ll-card"),
    Shot("manage", "/manage", ".ll-tile"),
)
CROPS = {
    "guide-trial": ("trial-light-1280", 90, 1660),
    "guide-improve": ("improve-light-1280", 90, 1500),
    "guide-train": ("train-light-1280", 90, 1300),
}
"""Parts of pictures for the user guide: of which one, from and to which line."""
EMPTY_SHOTS = tuple(
    Shot(f"empty-{name}", path, "h1")
    for name, path in (
        ("trials", "/"),
        ("trial", "/trial"),
        ("trial-gone", "/trial?trial=gone"),
        ("risk", "/risk"),
        ("improve", "/improve"),
        ("reference", "/reference"),
        ("estimators", "/estimators"),
        ("manage", "/manage"),
        ("train", "/train"),
        ("people", "/settings"),
    )
)


# --------------------------------------------------------------------------- libraries


def invent(home: Path, *, n_trials: int = 60, seed: int = 20261122) -> None:
    """Fill a library with copies of a sample under invented names, dates and levels."""
    rng = random.Random(seed)  # noqa: S311 - for pictures
    library = Library.open(home)
    add_samples(library)
    source = library.folder(LIFT)
    jobs = {
        ("North plant", "Depalletising"): (0.6, 2.6),
        ("North plant", "Packing"): (0.1, 0.9),
        ("North plant", "Machine feeding"): (0.3, 1.4),
        ("South plant", "Loading"): (0.45, 2.1),
        ("South plant", "Kitting"): (0.05, 0.7),
    }
    for number in range(n_trials):
        (site, job), (share, index) = rng.choice(list(jobs.items()))
        made = datetime(2026, 1, 8, 9, tzinfo=UTC) + timedelta(days=5.2 * number)
        is_better = job == "Depalletising" and made.month > 6
        level = "high" if rng.random() < share * (0.4 if is_better else 1) else "review"
        document = json.loads((source / "trial.json").read_text(encoding="utf-8"))
        document |= {
            "created": made.isoformat(timespec="seconds"),
            "label": f"{job}, {rng.choice(('crate', 'sack', 'tray', 'drum'))} {number + 1}",
            "site": site,
            "job": job,
        }
        document["subject"]["label"] = f"P{rng.randint(1, 9):02d}"
        risk = document["risk"]["rnle"]
        risk["value"] = round(index * rng.uniform(0.7, 1.3) * (0.6 if is_better else 1), 2)
        risk["interval"] = [round(risk["value"] * 0.85, 2), round(risk["value"] * 1.2, 2)]
        risk["interval_is_infinite"] = [False, False]
        for flag in document["flags"]:
            flag["level"] = level if flag["lift_index"] is not None else "ok"
        if risk["value"] < 0.9:
            for flag in document["flags"]:
                flag["level"] = "ok"
        folder = home / "invented" / f"{made:%Y%m%d}-{number:03d}"
        shutil.copytree(source, folder)
        (folder / "trial.json").write_text(json.dumps(document), encoding="utf-8")
        library.adopt(folder, folder.name)


# --------------------------------------------------------------------------- server and browser


@contextlib.contextmanager
def serve(home: Path) -> Iterator[str]:
    """Run the dashboard on a library; give its address."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    command = (sys.executable, "-m", "engine.cli_start", "serve", "--host", "127.0.0.1")
    server = subprocess.Popen(
        (*command, "--port", str(port)),
        cwd=ROOT,
        env={**os.environ, HOME_VARIABLE: str(home), "CI": "true"},
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    )
    base = f"http://127.0.0.1:{port}"
    try:
        _wait_until_up(base, server)
        yield base
    finally:
        server.terminate()
        server.wait(timeout=20)


def _wait_until_up(base: str, server: subprocess.Popen[bytes]) -> None:
    end_s = time.monotonic() + 300
    while True:
        try:
            with urllib.request.urlopen(f"{base}/_stcore/health", timeout=2):  # noqa: S310
                return
        except OSError as error:
            if server.poll() is not None or time.monotonic() > end_s:
                raise SystemExit("The dashboard did not start; try `liftlens serve`.") from error
            time.sleep(0.2)


def photograph(
    browser: Browser, base: str, shots: tuple[Shot, ...], out: Path, modes: tuple[str, ...]
) -> None:
    """Photograph pages in every mode and width; say which are wider than the screen."""
    for shot in shots:
        for mode in modes:
            _photograph(browser, base + shot.path, shot, mode, out)
        sys.stdout.write(f"{shot.name}\n")
        sys.stdout.flush()


def _photograph(browser: Browser, address: str, shot: Shot, mode: str, out: Path) -> None:
    context = browser.new_context(
        viewport={"width": WIDTHS_PX[0], "height": 900},
        color_scheme="dark" if mode == "dark" else "light",
        reduced_motion="reduce",
    )
    context.set_default_timeout(TIMEOUT_MS)
    page = context.new_page()
    page.on("pageerror", lambda error: sys.stdout.write(f"  {shot.name}-{mode}: {error}\n"))
    page.goto(address)
    # The first one of a kind may stand in an expander that is closed.
    page.locator(shot.sign).locator("visible=true").first.wait_for()
    page.locator(AT_REST).wait_for()
    if shot.prepare:
        shot.prepare(page)
        page.locator(AT_REST).wait_for()
    for width in WIDTHS_PX:
        _fit_height(page, width)
        name = f"{shot.name}-{mode}-{width}"
        wide = page.evaluate(f"document.querySelector('{MAIN}').scrollWidth")
        if wide > width:
            sys.stdout.write(f"  {name}: {wide} px wide\n")
        picture = _take(page)
        picture.save(out / f"{name}.webp", quality=WEBP_QUALITY, method=6)
    context.close()


def _take(page: Page) -> Image.Image:
    """Return a picture of the whole page, put together where it is higher than a texture may be."""
    size = page.viewport_size
    height = _content_px(page)
    if height <= MAX_HEIGHT_PX:
        return Image.open(io.BytesIO(page.screenshot())).convert("RGB")
    page.set_viewport_size({"width": size["width"], "height": MAX_HEIGHT_PX})
    whole = Image.new("RGB", (size["width"], height))
    for top in (0, height - MAX_HEIGHT_PX):
        page.evaluate(f"document.querySelector('{MAIN}').scrollTo(0, {top})")
        page.wait_for_timeout(900)
        part = Image.open(io.BytesIO(page.screenshot())).convert("RGB")
        skipped = BAR_PX if top else 0  # the bar stays where it is
        whole.paste(part.crop((0, skipped, *part.size)), (0, top + skipped))
    return whole


def crop(out: Path) -> None:
    """Cut the parts that the user guide shows."""
    for name, (source, top, bottom) in CROPS.items():
        path = out / f"{source}.webp"
        if path.is_file():
            picture = Image.open(path)
            part = picture.crop((0, top, picture.width, min(bottom, picture.height)))
            part.save(out / f"{name}.webp", quality=WEBP_QUALITY, method=6)


def _fit_height(page: Page, width: int) -> None:
    """Make the window as high as the page, until charts drawn for that width move nothing more."""
    page.set_viewport_size({"width": width, "height": 900})
    height, seen = 0, -1
    while height != seen:
        page.wait_for_timeout(900)
        seen = height
        height = _content_px(page)
        page.set_viewport_size({"width": width, "height": min(height, MAX_HEIGHT_PX)})
    page.wait_for_timeout(500)


def _content_px(page: Page) -> int:
    """Return how high the page is with its bar; what it scrolls in is never below the window."""
    block = "document.querySelector('.stMainBlockContainer').getBoundingClientRect().height"
    return max(400, round(page.evaluate(block)) + BAR_PX)


def main() -> None:
    """Photograph all pages, or those that were asked for."""
    from playwright.sync_api import sync_playwright

    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--only", help="names of pages, with commas")
    parser.add_argument("--out", type=Path, default=OUT)
    parser.add_argument("--modes", default=",".join(MODES), help="light, dark or both")
    parser.add_argument("--empty", action="store_true", help="the empty states instead")
    given = parser.parse_args()
    wanted = given.only.split(",") if given.only else None
    chromium = next(filter(None, map(shutil.which, BROWSERS)), None)
    if chromium is None:
        raise SystemExit("No Chromium or Chrome was found; install one.")
    given.out.mkdir(parents=True, exist_ok=True)
    groups = (EMPTY_SHOTS,) if given.empty else (SAMPLE_SHOTS, INVENTED_SHOTS)
    with sync_playwright() as playwright, tempfile.TemporaryDirectory() as work:
        browser = playwright.chromium.launch(executable_path=chromium, args=CHROMIUM_OPTIONS)
        for number, group in enumerate(groups):
            shots = tuple(s for s in group if wanted is None or s.name in wanted)
            if not shots:
                continue
            home = Path(work) / str(number)
            if group is INVENTED_SHOTS:
                invent(home)
            if group is EMPTY_SHOTS:
                Library.open(home)
                (home / ".samples-added").touch()
            with serve(home) as base:
                photograph(browser, base, shots, given.out, tuple(given.modes.split(",")))
        browser.close()
    crop(given.out)


if __name__ == "__main__":
    main()
