"""The first launch in a real browser, as `liftlens serve` starts it."""

from __future__ import annotations

import sys

import pytest

from engine.sample_results import find_samples
from engine.storage.library import Library
from tests.dashboard.test_browser import CHROMIUM_OPTIONS, PATIENCE_S, _note_stranger, serve

pytestmark = [pytest.mark.browser, pytest.mark.slow]

PATIENCE_MS = 1000 * PATIENCE_S


@pytest.fixture(scope="module")
def home(tmp_path_factory):
    return tmp_path_factory.mktemp("home")


@pytest.fixture(scope="module")
def address(home, tmp_path_factory):
    """The dashboard as `liftlens serve` starts it, for the first time."""
    command = [sys.executable, "-m", "engine.cli_start", "serve", "--host", "127.0.0.1"]
    with serve(home, tmp_path_factory.mktemp("log") / "server.txt", command=command) as base:
        yield base


@pytest.fixture(scope="module")
def visit(chromium_path):
    """One visit for all ways, so that the browser loads the program's scripts once."""
    from playwright.sync_api import sync_playwright

    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=chromium_path, args=CHROMIUM_OPTIONS)
        context = browser.new_context(
            viewport={"width": 1280, "height": 900}, accept_downloads=True
        )
        context.set_default_timeout(PATIENCE_MS)
        yield context
        browser.close()


@pytest.fixture
def open_page(visit, address):
    """Open pages; in the end: no fault in the browser, and nothing asked of another computer."""
    pages, faults = [], []

    def open_one(path="/"):
        page = visit.new_page()
        pages.append(page)
        page.on("pageerror", lambda error: faults.append(str(error)))
        page.on("request", lambda request: _note_stranger(request.url, address, faults))
        page.goto(address + path)
        page.locator("h1").first.wait_for()
        return page

    yield open_one
    for page in pages:
        page.close()
    assert not faults


def test_a_first_launch_shows_finished_samples(open_page, home):
    page = open_page()
    page.get_by_text("Sample: Crate from the floor to knuckle height").wait_for()
    assert page.locator(".ll-entry").count() == len(find_samples(Library(home))) == 4
    assert page.get_by_text("No trials yet").count() == 0
    page.goto(page.url.rstrip("/") + "/manage")
    page.get_by_text("These are the bundled samples").wait_for()
    assert page.get_by_text("of the judged lifts").is_visible()
