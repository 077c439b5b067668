"""The whole ways of those who use it, in a real browser, on the samples of a first launch.

From an upload to a verdict: `test_browser.py`, as that needs an assessment.
"""

from __future__ import annotations

import contextlib
import json
import re
import shutil
import sys
from datetime import UTC, datetime, timedelta

import pytest
from pypdf import PdfReader

from engine.sample_results import find_samples
from engine.storage.library import Library
from tests.dashboard.test_browser import CHROMIUM_OPTIONS, PATIENCE_S, _note_stranger, serve

pytestmark = [pytest.mark.browser, pytest.mark.slow]

LIFT, LOW_LIFT, TWO_VIEWS = (
    "bundled-floor_to_shoulder",
    "bundled-floor_to_knuckle",
    "bundled-two_cameras",
)
CHANGED_ON = datetime(2026, 6, 1, tzinfo=UTC)
WATCH_RUNS = """() => {
  // Counts how often the page was drawn to its end: a choice is followed once one more has ended.
  if (window.endedRuns !== undefined) return window.endedRuns;
  window.endedRuns = 0;
  const app = document.querySelector("[data-testid=stApp]");
  new MutationObserver(() => {
    if (app.dataset.testScriptState === "notRunning") window.endedRuns += 1;
  }).observe(app, { attributeFilter: ["data-test-script-state"] });
  return window.endedRuns;
}"""
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


@contextlib.contextmanager
def drawn_anew(page):
    """Wait until the page has followed what is done within."""
    page.locator("[data-testid=stApp][data-test-script-state=notRunning]").wait_for()
    ended = page.evaluate(WATCH_RUNS)
    yield
    page.wait_for_function("ended => window.endedRuns > ended", arg=ended)


def pick(page, label, option):
    """Choose in a select box what is not chosen yet; a part of the option's words is enough."""
    box = page.get_by_role("combobox", name=label, exact=True)
    if option in box.input_value():
        return
    box.click()
    with drawn_anew(page):
        page.get_by_role("option", name=option).first.click()


def pdf_text(download, folder):
    """Return the text of a PDF that was downloaded, on one line."""
    path = folder / download.suggested_filename
    download.save_as(path)
    return " ".join(" ".join(page.extract_text() for page in PdfReader(path).pages).split())


# --------------------------------------------------------------------------- first launch


def test_a_first_launch_shows_finished_samples(open_page, home):
    page = open_page()
    page.get_by_text("Sample: Crate from the floor to knuckle height").wait_for()
    assert page.locator(".ll-entry").count() == len(find_samples(Library(home))) == 4
    assert page.get_by_text("No trials yet").count() == 0
    page.goto(page.url.rstrip("/") + "/manage")
    page.get_by_text("These are the bundled samples").wait_for()
    assert page.get_by_text("of the judged lifts").is_visible()


# --------------------------------------------------------------------------- reviewer


def test_a_reviewer_jumps_to_a_flag_answers_it_notes_the_moment_and_takes_the_page(
    open_page, home, tmp_path
):
    page = open_page("/?search=knuckle")
    page.get_by_role("button", name="Open", exact=True).click()
    page.wait_for_url(f"**/trial?trial={LOW_LIFT}")
    frame = page.frame_locator("iframe[title*=liftlens_player]")
    frame.locator(".readout", has_text="picture").wait_for()
    inner = next(f for f in page.frames if "liftlens_player" in f.url)
    inner.wait_for_function(
        "[...document.querySelectorAll('video')].every(v => v.readyState === 4)"
    )
    frame.locator(".bar button").first.click()
    inner.wait_for_function("!document.querySelector('.readout').textContent.endsWith(' 1')")
    frame.locator(".detail").wait_for()
    at_s = inner.evaluate("window.liftlensPlayer.clock.time")
    assert at_s > 1

    page.get_by_label("Why (needed to reject)").fill("Seen at the workplace too.")
    page.get_by_label("Your name or initials").fill("AB")
    page.get_by_role("button", name="Save the answer").click()
    page.get_by_text("Accepted by AB").wait_for()
    frame.locator(".bar button", has_text="accepted").wait_for()
    frame.get_by_role("button", name="Note at this moment").click()
    page.get_by_label(re.compile(r"Note at \d")).fill("The crate slips.")
    page.get_by_role("button", name="Add the note").click()
    frame.locator("button.note").wait_for()

    record = Library(home).record(LOW_LIFT)
    (said,) = record.reviews
    assert (said.verdict, said.reviewer) == ("accepted", "AB")
    assert said.reason == "Seen at the workplace too."
    (note,) = record.notes
    assert note.text == "The crate slips."
    assert note.at_s == pytest.approx(at_s, abs=0.02)

    with page.expect_download() as download:
        page.get_by_role("button", name="One page (PDF)").click()
    text = pdf_text(download.value, tmp_path)
    assert "Crate from the floor to knuckle height" in text
    assert "lifting index" in text.lower()


# --------------------------------------------------------------------------- manager


@pytest.fixture(scope="module")
def work(address, home):
    """Two sites with three jobs; one of them was changed in June and became better."""
    library = Library(home)
    source = library.folder(LIFT)
    plan = (
        *(("Hall 3", "Packing", "high", -40 + 8 * i) for i in range(4)),
        *(("Hall 3", "Packing", "ok", 5 + 8 * i) for i in range(4)),
        ("Hall 3", "Kitting", "ok", -3),
        ("Yard", "Loading", "high", -2),
        ("Yard", "Loading", "review", 3),
    )
    for number, (site, job, level, day) in enumerate(plan):
        made = CHANGED_ON + timedelta(days=day, hours=9)
        document = json.loads((source / "trial.json").read_text(encoding="utf-8"))
        document |= {
            "created": made.isoformat(timespec="seconds"),
            "label": f"{job} {number}",
            "site": site,
            "job": job,
        }
        document["subject"]["label"] = "P05"
        for flag in document["flags"]:
            flag["level"] = level if flag["lift_index"] is not None else "ok"
        folder = home / "coming" / f"work-{number:02d}"
        shutil.copytree(source, folder)
        (folder / "trial.json").write_text(json.dumps(document), encoding="utf-8")
        library.adopt(folder, folder.name)
    return plan


def test_a_manager_finds_the_worst_job_and_takes_it_to_the_meeting(work, open_page, tmp_path):
    page = open_page("/manage")
    # The samples no longer count: 11 trials with one lift each, 5 of them at high risk.
    page.locator(".ll-tile", has_text="11 judged, 0 not").wait_for()
    assert page.locator(".ll-tile", has_text="45%").is_visible()
    assert page.get_by_text("These are the bundled samples").count() == 0
    worst = page.locator(".ll-table tr", has_text="Hall 3 · Packing")
    assert "50%" in worst.inner_text()

    pick(page, "Site", "Yard")
    page.locator(".ll-tile", has_text="2 judged").wait_for()
    assert "site=Yard" in page.url
    assert page.locator(".ll-table tr", has_text="Packing").count() == 0
    page.reload()
    page.locator(".ll-tile", has_text="2 judged").wait_for()

    page.goto(page.url.split("?")[0])
    page.locator(".ll-tile", has_text="11 judged").wait_for()
    pick(page, "Which job", "Hall 3 · Packing")
    page.get_by_test_id("stDateInput").get_by_role("spinbutton", name=re.compile("year")).click()
    page.keyboard.type(f"{CHANGED_ON:%Y%m%d}")  # each part goes on to the next
    page.get_by_role("heading", name="The worst jobs").click()  # a date counts once it is left
    page.get_by_text("Before: 4 trials, 100% of the judged lifts").wait_for()
    assert page.get_by_text("After: 4 trials, 0% of the judged lifts").is_visible()
    with page.expect_download() as change:
        page.get_by_role("button", name="Before and after as PDF").click()
    text = pdf_text(change.value, tmp_path)
    assert "Packing" in text
    assert re.search(r"[Bb]efore", text)


@pytest.mark.parametrize(
    ("kind", "which", "said", "not_said"),
    [
        ("A job", "Hall 3 · Packing", "Packing", "Loading"),
        ("A site", "Yard", "Loading", "Packing"),
    ],
)
def test_a_job_and_a_department_become_pages_that_can_be_read(
    work, open_page, tmp_path, kind, which, said, not_said
):
    page = open_page("/manage")
    page.locator(".ll-tile", has_text="11 judged").wait_for()
    if kind != "A job":  # chosen at first
        with drawn_anew(page):
            page.get_by_test_id("stButtonGroup").get_by_text(kind, exact=True).click()
    pick(page, "Which one", which)
    with page.expect_download() as download:
        page.get_by_role("button", name="Summary as PDF").click()
    text = pdf_text(download.value, tmp_path)
    assert which.split(" · ")[0] in text
    assert said in text
    assert not_said not in text
    assert "lifting index" in text.lower()
    assert download.value.suggested_filename.endswith(".pdf")


# --------------------------------------------------------------------------- trainer


def test_a_trainer_compares_and_plays_both_on_one_cursor(address, open_page):
    page = open_page("/train")
    pick(page, "Reference: as it should be", "two cameras")
    pick(page, "Attempt", "shoulder height (synthetic)")
    assert f"against={TWO_VIEWS}" in page.url
    assert f"trial={LIFT}" in page.url
    page.locator(".ll-tile", has_text="of 100, between").wait_for()
    assert 1 <= page.locator("ol.ll-list li").count() <= 3
    table = page.locator(".ll-table", has_text="Range of forward bend")
    assert table.locator("tbody tr").count() == 1
    assert re.search(r"\d+ \(\d+ to \d+\)", table.inner_text())

    frame = page.frame_locator("iframe[title*=liftlens_pair]")
    frame.get_by_role("button", name="Lift", exact=True).click()
    inner = next(f for f in page.frames if "liftlens_pair" in f.url)
    inner.wait_for_function(
        "[...document.querySelectorAll('video')].every(v => v.readyState >= 2 && !v.seeking)"
    )
    before = inner.evaluate("[...document.querySelectorAll('video')].map(v => v.currentTime)")
    assert all(at > 0.5 for at in before), "both have jumped to the phase"
    frame.get_by_role("button", name="Play").click()
    inner.wait_for_function(
        "before => [...document.querySelectorAll('video')]"
        ".every((v, i) => v.currentTime > before[i] + 0.2)",
        arg=before,
    )
