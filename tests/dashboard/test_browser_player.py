"""The player in a real browser: one time cursor for everything, by mouse and by keys."""

from __future__ import annotations

import os
import re
from dataclasses import replace
from pathlib import Path

import pytest

from engine.storage.library import Library
from engine.storage.results import write_result
from tests.builders import make_two_views
from tests.dashboard.results import make_shown_result, write_clip
from tests.dashboard.test_browser import CHROMIUM_OPTIONS, PATIENCE_S, _note_stranger, serve

pytestmark = [pytest.mark.browser, pytest.mark.slow]

SOFTWARE_3D = ["--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--ignore-gpu-blocklist"]
NO_3D = ["--disable-3d-apis"]
FRAME = "iframe[title*=liftlens_player]"
FPS = 30.0
PATIENCE_MS = 1000 * PATIENCE_S
SETTLED = """() => {
  // Curves are drawn anew while the page around the player finds its width.
  const plot = document.querySelector('.plot');
  if (plot !== window.seenPlot) [window.seenPlot, window.seenSince] = [plot, performance.now()];
  return plot && performance.now() - window.seenSince > 700;
}"""


@pytest.fixture(scope="module")
def home(tmp_path_factory):
    """A library with a trial of one view, one of two views, and one without a video."""
    folder = tmp_path_factory.mktemp("home")
    library, work = Library(folder), tmp_path_factory.mktemp("work")
    clip = lambda name: write_clip(work / name, seconds=6.0)  # noqa: E731
    one = make_shown_result(label="One view")
    two = replace(make_shown_result(label="Two views"), **make_two_views())
    for name, made, videos in (
        ("one", one, {"overlay": clip("a.mp4")}),
        ("two", two, {"overlay": clip("b.mp4"), "second_overlay": clip("c.mp4")}),
        ("none", one, {}),
    ):
        library.adopt(write_result(made, work / name, **videos), name)
    return folder


@pytest.fixture(scope="module")
def address(home, tmp_path_factory):
    with serve(home, tmp_path_factory.mktemp("log") / "server.txt") as base:
        yield base


@pytest.fixture(scope="module")
def chromium():
    from playwright.sync_api import sync_playwright

    with sync_playwright() as playwright:
        yield playwright.chromium


@pytest.fixture(scope="module")
def browser(chromium, chromium_path):
    options = [o for o in CHROMIUM_OPTIONS if o != "--disable-gpu"]
    running = chromium.launch(executable_path=chromium_path, args=[*options, *SOFTWARE_3D])
    yield running
    running.close()


@pytest.fixture
def open_player(browser, address):
    """Open a trial and return the page and the player's frame; no fault may happen in between."""
    contexts, faults = [], []

    def open_one(trial="one", *, width=1280, mode="light", within=None):
        context = (within or browser).new_context(
            viewport={"width": width, "height": 900}, color_scheme=mode
        )
        contexts.append(context)
        context.set_default_timeout(PATIENCE_MS)
        page = context.new_page()
        page.on("pageerror", lambda error: faults.append(str(error)))
        page.on("request", lambda request: _note_stranger(request.url, address, faults))
        page.goto(f"{address}/trial?trial={trial}")
        page.locator(FRAME).wait_for()
        frame = page.frame_locator(FRAME)
        frame.locator(".readout", has_text="picture").wait_for()
        inner = next(f for f in page.frames if "liftlens_player" in f.url)
        inner.wait_for_function("document.documentElement.dataset.painter")
        inner.wait_for_function(
            "[...document.querySelectorAll('video')].every(v => v.readyState === 4)"
        )
        inner.wait_for_function(SETTLED)
        return page, inner

    yield open_one
    for context in contexts:
        context.close()
    assert not faults


def picture(frame):
    return int(re.search(r"picture (\d+)", frame.inner_text(".readout"))[1])


def wait_for_picture(frame, number):
    frame.wait_for_function(
        f"document.querySelector('.readout').textContent.endsWith('picture {number}')"
    )


def film_times(frame):
    """Return where the videos are, once they have stopped seeking."""
    frame.wait_for_function("[...document.querySelectorAll('video')].every(v => !v.seeking)")
    return frame.evaluate("[...document.querySelectorAll('video')].map(v => v.currentTime)")


def test_keys_move_video_curves_and_cursor_together(open_player):
    page, frame = open_player()
    frame.click(".readout")
    for _ in range(3):
        page.keyboard.press("ArrowRight")
    wait_for_picture(frame, 4)
    page.keyboard.press("Shift+ArrowRight")
    wait_for_picture(frame, 14)
    page.keyboard.press("ArrowLeft")
    wait_for_picture(frame, 13)
    (at_s,) = film_times(frame)
    assert 12 / FPS <= at_s < 13 / FPS
    value = float(re.search(r"[\d.]+", frame.get_attribute(".scrubber", "aria-valuenow"))[0])
    assert value == pytest.approx(12 / FPS, abs=0.006)
    page.keyboard.press("End")
    wait_for_picture(frame, 180)
    page.keyboard.press("Home")
    wait_for_picture(frame, 1)


def test_a_flag_a_lift_and_a_curve_jump_there(open_player):
    page, frame = open_player()
    frame.click("button.lift >> nth=1")
    wait_for_picture(frame, 121)  # the second lift starts at 4.0 s
    frame.click(".bar button.ok")
    wait_for_picture(frame, 7)  # 0.2 s
    frame.click(".readout")
    page.keyboard.press("1")
    wait_for_picture(frame, 121)
    assert "far above the recommended limit" in frame.inner_text(".detail")
    assert "High risk" in frame.inner_text(".detail .chip")
    plot = frame.locator(".plot-field").first
    box = plot.bounding_box()
    page.mouse.click(box["x"] + box["width"] / 2, box["y"] + 40)
    frame.wait_for_function("!document.querySelector('.readout').textContent.endsWith(' 121')")
    assert 70 <= picture(frame) <= 100


def test_dragging_scrubs_and_missing_samples_say_so(open_player):
    page, frame = open_player()
    frame.locator(".plot").first.scroll_into_view_if_needed()
    lane = frame.locator(".plot-field").first.bounding_box()
    y = lane["y"] + 30
    page.mouse.move(lane["x"] + 100, y)
    page.mouse.down()
    seen = []
    for k in range(1, 30):
        page.mouse.move(lane["x"] + 100 + k * 25, y)
        frame.wait_for_timeout(20)
        seen.append(picture(frame))
    page.mouse.up()
    assert seen == sorted(seen)
    assert len(set(seen)) > 20
    frame.click(".readout")
    page.keyboard.press("Home")
    for _ in range(8):
        page.keyboard.press("Shift+ArrowRight")
    wait_for_picture(frame, 81)  # in the gap of the curves
    assert set(frame.locator(".key .number").all_inner_texts()) == {"not seen"}
    opacity = "[...document.querySelectorAll('.dot')].map(d => d.style.opacity)"
    assert set(frame.evaluate(opacity)) == {"0"}


def test_playing_keeps_cursor_and_video_in_step(open_player):
    page, frame = open_player()
    frame.click(".readout")
    page.keyboard.press("j")
    assert frame.input_value(".controls select") == "0.5"
    page.keyboard.press("l")
    page.keyboard.press(" ")
    frame.wait_for_function("window.liftlensPlayer.clock.time > 1.0")
    apart = frame.evaluate(
        "Math.abs(window.liftlensPlayer.clock.time - document.querySelector('video').currentTime)"
    )
    assert apart < 0.2, "the cursor shows the picture seen, the video's clock runs a little ahead"
    page.keyboard.press("k")
    frame.wait_for_function("document.querySelector('video').paused")
    (at_s,) = film_times(frame)
    shown_s = frame.evaluate("window.liftlensPlayer.clock.time")
    assert abs(at_s - shown_s) < 1 / FPS
    stopped = picture(frame)
    frame.wait_for_timeout(300)
    assert picture(frame) == stopped


def test_playing_ends_at_the_end(open_player):
    page, frame = open_player()
    frame.click(".readout")
    page.keyboard.press("End")
    page.keyboard.press("Shift+ArrowLeft")
    wait_for_picture(frame, 170)
    page.keyboard.press(" ")
    wait_for_picture(frame, 180)
    frame.wait_for_function("!document.querySelector('.play').classList.contains('playing')")


def test_two_views_show_the_same_moment(open_player):
    page, frame = open_player("two")
    assert frame.locator("video").count() == 2
    frame.click("button.lift >> nth=0")
    wait_for_picture(frame, 31)
    frame.wait_for_function(
        "[...document.querySelectorAll('video')].every(v => !v.seeking && v.currentTime > 0.9)"
    )
    first, second = film_times(frame)
    assert first == second == pytest.approx(1.0, abs=1 / FPS)
    assert frame.get_by_role("button", name="Cameras").is_visible()
    frame.click(".readout")
    page.keyboard.press(" ")
    frame.wait_for_function("window.liftlensPlayer.clock.time > 2.0")
    page.keyboard.press(" ")
    first, second = film_times(frame)
    assert abs(first - second) < 1 / FPS


def test_without_a_video_the_clock_moves_the_cursor(open_player):
    page, frame = open_player("none")
    assert page.get_by_text("without its annotated video").is_visible()
    assert frame.locator("video").count() == 0
    frame.click(".play")
    frame.wait_for_function("window.liftlensPlayer.clock.time > 0.5")
    frame.click(".play")
    assert picture(frame) > 15


def test_without_3d_graphics_the_skeleton_is_drawn_flat(chromium, chromium_path, open_player):
    running = chromium.launch(executable_path=chromium_path, args=[*CHROMIUM_OPTIONS, *NO_3D])
    try:
        _, frame = open_player(within=running)
        assert frame.evaluate("document.documentElement.dataset.painter") == "FlatPainter"
        assert "drawn flat" in frame.inner_text(".body")
        wait_for_ink(frame)
    finally:
        running.close()


def test_the_solid_figure_can_be_asked_for(open_player):
    _, frame = open_player()
    if frame.evaluate("document.documentElement.dataset.painter") == "FlatPainter":
        wait_for_ink(frame)  # without a graphics card it starts flat, and fast
        frame.get_by_role("button", name="Solid").click()
    frame.wait_for_function("document.documentElement.dataset.painter === 'SolidPainter'")
    frame.click("button.lift >> nth=0")
    frame.wait_for_function(
        "window.liftlensPlayer.painter.joints.count + "
        "window.liftlensPlayer.painter.fadedJoints.count > 15"
    )
    assert frame.evaluate("window.liftlensPlayer.painter.renderer.info.render.triangles") > 1000


def wait_for_ink(frame):
    """Wait until the flat picture shows the blue left side of the figure."""
    frame.wait_for_function(
        """() => {
          const canvas = document.querySelector('.body canvas');
          const { data } = canvas.getContext('2d').getImageData(0, 0, canvas.width, canvas.height);
          let n = 0;
          for (let i = 0; i < data.length; i += 4)
            n += data[i + 3] > 200 && data[i] < 90 && data[i + 2] > 200;
          return n > 400;
        }"""
    )


def test_a_flag_is_answered_and_a_moment_noted(open_player, home):
    from playwright.sync_api import expect

    page, frame = open_player()
    frame.click(".bar button.ok")
    frame.click(".bar button.high")
    page.get_by_text("Do you agree with the flags?").wait_for()
    chosen = page.get_by_role("combobox", name="Flag")
    expect(chosen).to_have_value(re.compile("Lift 2 is far above"), timeout=PATIENCE_MS)
    page.get_by_label("Your name or initials").fill("AB")
    page.get_by_role("button", name="Save the answer").click()
    page.get_by_text("Accepted by AB").wait_for()
    frame.wait_for_selector(".bar button.high:has-text('accepted')")
    assert picture(frame) == 121, "an answer must not move the cursor"
    frame.get_by_role("button", name="Note at this moment").click()
    page.get_by_label("Note at 4.00 s").fill("The load slipped.")
    page.get_by_role("button", name="Add the note").click()
    frame.wait_for_selector("button.note")
    (note,) = Library(home).record("one").notes
    assert (note.text, note.at_s, note.author) == ("The load slipped.", 4.0, "AB")


@pytest.mark.parametrize("width", [1280, 420])
@pytest.mark.parametrize("mode", ["light", "dark"])
@pytest.mark.parametrize("trial", ["one", "two"])
def test_the_player_fits_and_follows_the_theme(open_player, tmp_path, trial, width, mode):
    page, frame = open_player(trial, width=width, mode=mode)
    assert frame.evaluate("document.documentElement.dataset.mode") == mode
    frame.wait_for_function("innerHeight >= document.body.scrollHeight")
    assert frame.evaluate("document.documentElement.scrollWidth <= innerWidth")
    folder = Path(os.environ.get("LIFTLENS_SCREENSHOTS", tmp_path))
    page.locator(FRAME).screenshot(path=folder / f"player-{trial}-{mode}-{width}.png")
