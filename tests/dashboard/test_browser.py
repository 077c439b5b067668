"""The whole way in a real browser: upload, form, progress, flag, download; and how it looks."""

from __future__ import annotations

import contextlib
import json
import os
import socket
import subprocess
import time
import urllib.request
import zipfile
from pathlib import Path

import pytest

from engine.cli_serve import build_command
from engine.storage.library import HOME_VARIABLE, Library

pytestmark = [pytest.mark.browser, pytest.mark.model, pytest.mark.slow]

ROOT = Path(__file__).parents[2]
CLIP = ROOT / "sample_data" / "floor_to_knuckle" / "cam90.mp4"
CHROMIUM_OPTIONS = [
    "--no-sandbox",
    "--disable-gpu",
    "--disable-quic",
    "--no-first-run",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
]
SIZES = {"wide": (1280, 900), "narrow": (390, 844)}
ASSESSMENT_MS = 150_000
PATIENCE_S = float(os.environ.get("LIFTLENS_TEST_PATIENCE_S", "120"))
"""How long anything may take; raise it on a machine that does much else."""


@pytest.fixture(scope="module")
def home(tmp_path_factory):
    return tmp_path_factory.mktemp("home")


@pytest.fixture(scope="module")
def address(home, tmp_path_factory):
    """The real server on an empty library."""
    with serve(home, tmp_path_factory.mktemp("log") / "server.txt") as base:
        yield base


@contextlib.contextmanager
def serve(home, log, *, command=None):
    """Run the real server, or a command that takes `--port`, on a library; give its address."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    own = build_command(host="127.0.0.1", port=port, is_headless=True)
    with log.open("wb") as file:
        server = subprocess.Popen(
            own if command is None else [*command, "--port", str(port)],
            cwd=ROOT,
            env={**os.environ, HOME_VARIABLE: str(home), "PYTHONPATH": str(ROOT), "CI": "true"},
            stdout=file,
            stderr=file,
        )
    base = f"http://127.0.0.1:{port}"
    try:
        _wait_until_up(base, server, log)
        yield base
    finally:
        server.terminate()
        server.wait(timeout=PATIENCE_S)


def _wait_until_up(base, server, log):
    end_s = time.monotonic() + PATIENCE_S
    while True:
        try:
            with urllib.request.urlopen(f"{base}/_stcore/health", timeout=2):
                return
        except OSError:
            assert server.poll() is None, log.read_text()
            assert time.monotonic() < end_s, log.read_text()
            time.sleep(0.2)


@pytest.fixture(scope="module")
def browser(chromium_path):
    from playwright.sync_api import sync_playwright

    with sync_playwright() as playwright:
        running = playwright.chromium.launch(executable_path=chromium_path, args=CHROMIUM_OPTIONS)
        yield running
        running.close()


@pytest.fixture(scope="module")
def shots(tmp_path_factory):
    """Where the pictures of the pages go."""
    given = os.environ.get("LIFTLENS_SCREENSHOTS")
    folder = Path(given) if given else tmp_path_factory.mktemp("screenshots")
    folder.mkdir(parents=True, exist_ok=True)
    return folder


@pytest.fixture
def open_page(browser, address):
    """Open pages; in the end: no fault in the browser, and nothing asked of another computer."""
    contexts, faults = [], []

    def open_one(path="/", *, size="wide", mode="light"):
        width, height = SIZES[size]
        context = browser.new_context(
            viewport={"width": width, "height": height}, color_scheme=mode, accept_downloads=True
        )
        contexts.append(context)
        page = context.new_page()
        page.on("pageerror", lambda error: faults.append(str(error)))
        page.on("request", lambda request: _note_stranger(request.url, address, faults))
        page.goto(address + path)
        return page

    yield open_one
    for context in contexts:
        context.close()
    assert not faults


def _note_stranger(url, address, faults):
    if not url.startswith((address, "data:", "blob:", address.replace("http", "ws", 1))):
        faults.append(f"asked of another computer: {url}")


@pytest.fixture(scope="module")
def trial(browser, address, shots):
    """Upload a clip, fill the form, start, wait for the verdict; return the trial's address."""
    context = browser.new_context(viewport={"width": 1280, "height": 900}, color_scheme="light")
    page = context.new_page()
    page.goto(address)
    page.get_by_text("No trials yet").wait_for()
    _shoot(page, shots / "trials-empty-light-wide.png")
    page.get_by_role("button", name="Add a video").click()
    page.locator("input[type=file]").set_input_files(CLIP)
    page.get_by_text("cam90.mp4: ").wait_for()
    _fill(page, "Pseudonym of the person", "P01")
    _fill(page, "Body height (m)", "1.725")
    _fill(page, "Load (kg)", "10")
    _fill(page, "Name of the trial", "Crate from the floor")
    page.get_by_text("Good: handles").click()
    page.get_by_role("radio", name="Yes, with care").or_(
        page.get_by_role("button", name="Yes, with care")
    ).click()
    _fill(page, "Lifts per minute", "2")
    _fill(page, "Lifting lasts (h)", "1")
    _shoot(page, shots / "new-filled-light-wide.png")
    page.get_by_role("button", name="Start", exact=True).click()
    page.get_by_role("button", name="Cancel").wait_for()
    page.wait_for_timeout(3000)
    _shoot(page, shots / "progress-light-wide.png")
    page.locator(".ll-verdict").wait_for(timeout=ASSESSMENT_MS)
    page.wait_for_url("**/trial?trial=*")
    yield page.url.removeprefix(address)
    context.close()


def _fill(page, label, text):
    field = page.get_by_label(label, exact=True)
    field.fill(text)
    field.press("Tab")
    page.wait_for_timeout(400)


def _shoot(page, path):
    """Take a picture of the whole page."""
    page.wait_for_timeout(400)
    size = page.viewport_size
    height = page.evaluate("document.querySelector('[data-testid=stMain]').scrollHeight")
    page.set_viewport_size({"width": size["width"], "height": max(size["height"], height + 70)})
    page.wait_for_timeout(500)
    page.screenshot(path=path)
    page.set_viewport_size(size)


def test_the_flag_is_seen_and_the_result_downloaded(trial, open_page, home, tmp_path):
    page = open_page(trial)
    verdict = page.locator(".ll-verdict")
    verdict.wait_for()
    assert verdict.locator(".ll-chip").inner_text() in ("High risk", "Needs review", "No concern")
    assert page.locator("h1").inner_text() == "Crate from the floor"
    video = page.frame_locator("iframe[title*=liftlens_player]").locator("video")
    video.wait_for()
    from playwright.sync_api import expect

    expect(video).to_have_js_property("readyState", 4, timeout=30_000)
    with page.expect_download() as download:
        page.get_by_role("button", name="Whole result (zip)").click()
    download.value.save_as(tmp_path / "result.zip")
    with zipfile.ZipFile(tmp_path / "result.zip") as packed:
        assert packed.testzip() is None
        name = next(n for n in packed.namelist() if n.endswith("/trial.json"))
        document = json.loads(packed.read(name))
    assert document["task"]["load_kg"] == 10
    assert document["task"]["destination_control"] is True
    assert document["task"]["coupling"] == "good"
    assert document["subject"]["stature_m"] == 1.725
    assert document["lifts"], "the sample shows a lift"
    trial_id = trial.partition("=")[2]
    entries = {entry.id: entry for entry in Library(home).entries()}
    assert entries[trial_id].label == "Crate from the floor"
    assert not list((home / "uploads").rglob("*.mp4")), "uploads go once they are assessed"
    assert not list((home / "jobs").rglob("*.mp4"))


def test_a_bad_upload_is_refused_in_one_sentence(open_page, tmp_path):
    text = tmp_path / "notes.mp4"
    text.write_text("this is no video")
    page = open_page("/new")
    page.locator("input[type=file]").set_input_files(text)
    message = page.get_by_role("alert").filter(has_text="notes.mp4")
    message.wait_for()
    assert page.get_by_role("button", name="Start", exact=True).is_disabled()


@pytest.mark.parametrize("size", SIZES)
@pytest.mark.parametrize("mode", ["light", "dark"])
def test_pages_fit_the_screen_in_light_and_dark(address, trial, open_page, shots, size, mode):
    page = open_page(size=size, mode=mode)
    for name, path, sign in (
        ("trials", "/", ".ll-card"),
        ("new", "/new", "[data-testid=stFileUploader]"),
        ("trial", trial, ".ll-end"),
    ):
        page.goto(address + path)
        page.locator(sign).first.wait_for()
        page.wait_for_load_state("networkidle")
        main = "document.querySelector('[data-testid=stMain]')"
        assert page.evaluate(f"{main}.scrollWidth") <= SIZES[size][0], f"{name} is too wide"
        background = page.evaluate("getComputedStyle(document.querySelector('.stApp')).color")
        is_light_ink = sum(map(int, background[4:-1].split(",")[:3])) > 380
        assert is_light_ink == (mode == "dark")
        _shoot(page, shots / f"{name}-{mode}-{size}.png")


@pytest.fixture(scope="module")
def compared(trial, browser, address):
    """Take the bundled markers of the assessed clip as its reference; return the address."""
    context = browser.new_context(viewport={"width": 1280, "height": 900})
    page = context.new_page()
    page.goto(address + trial)
    page.get_by_role("button", name="Compare with a reference recording").click()
    page.get_by_role("button", name="Use the markers bundled with this sample").click()
    page.get_by_role("button", name="Whole comparison (zip)").wait_for()
    yield page.url.removeprefix(address)
    context.close()


def test_the_comparison_can_be_downloaded(compared, open_page, browser, tmp_path):
    page = open_page(compared)
    with page.expect_download(timeout=120_000) as download:
        page.get_by_role("button", name="Whole comparison (zip)").click()
    download.value.save_as(tmp_path / "agreement.zip")
    with zipfile.ZipFile(tmp_path / "agreement.zip") as packed:
        assert packed.testzip() is None
        names = packed.namelist()
        document = json.loads(packed.read(next(n for n in names if n.endswith("agreement.json"))))
        pictures = [n for n in names if n.endswith(".png")]
    assert document["trials"][0]["time_alignment"]["correlation"] > 0.9
    assert abs(document["trials"][0]["time_alignment"]["lag_s"]) < 0.05
    assert len(pictures) == 5
    # The summary looks right in a browser too, and needs nothing else.
    with zipfile.ZipFile(tmp_path / "agreement.zip") as packed:
        packed.extractall(tmp_path)
    summary = browser.new_page()
    asked = []
    summary.on("request", lambda request: asked.append(request.url))
    summary.goto(next(tmp_path.rglob("summary.html")).as_uri())
    assert summary.locator("table").count() == 2
    assert summary.evaluate("[...document.images].every(i => i.naturalWidth > 300)")
    summary.close()
    assert not [url for url in asked[1:] if not url.startswith("data:")]


@pytest.mark.parametrize("size", SIZES)
@pytest.mark.parametrize("mode", ["light", "dark"])
def test_the_comparison_fits_the_screen(compared, open_page, shots, size, mode):
    page = open_page(compared, size=size, mode=mode)
    page.get_by_role("button", name="Whole comparison (zip)").wait_for()
    page.wait_for_function("document.querySelectorAll('.js-plotly-plot').length === 5")
    main = "document.querySelector('[data-testid=stMain]')"
    assert page.evaluate(f"{main}.scrollWidth") <= SIZES[size][0]
    _shoot(page, shots / f"reference-{mode}-{size}.png")
