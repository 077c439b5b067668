"""What every test gets, and how a run treats what it can't test."""

from __future__ import annotations

import os
import shutil
from collections.abc import Iterator
from importlib.util import find_spec
from pathlib import Path

import pytest
from hypothesis import settings

from engine.storage.library import HOME_VARIABLE

IS_CI = os.environ.get("CI", "").lower() == "true"
BROWSERS = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable")
NO_BROWSER = (
    "no Chromium or Chrome was found on the PATH; install one (as root: apt-get install chromium)"
)

# A busy machine is slow now and then; that is no finding. In CI every run tests the same examples.
settings.register_profile("local", deadline=None)
settings.register_profile("ci", deadline=None, derandomize=True, print_blob=True)
settings.load_profile("ci" if IS_CI else "local")


def find_chromium() -> str | None:
    """Return the path of the system's Chromium or Chrome."""
    return next(filter(None, map(shutil.which, BROWSERS)), None)


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Leave out tests of extras that are not installed, and skip browser tests without a browser.

    Tests of optional extras run by `make test-extras`; in CI browser tests run, and fail.
    """
    absent = [item for item in items if _lacks_extra(item)]
    if absent:
        items[:] = [item for item in items if item not in absent]
        config.hook.pytest_deselected(items=absent)
    if IS_CI or find_chromium():
        return
    for item in items:
        if item.get_closest_marker("browser"):
            item.add_marker(pytest.mark.skip(reason=NO_BROWSER))


def _lacks_extra(item: pytest.Item) -> bool:
    return any(find_spec(mark.args[0]) is None for mark in item.iter_markers("extra"))


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport(
    item: pytest.Item, call: pytest.CallInfo[None]
) -> Iterator[pytest.TestReport]:
    """In CI a skipped test is a failed one: nothing stays untested unnoticed."""
    report = yield
    return fail_if_skipped(report) if IS_CI else report


@pytest.hookimpl(wrapper=True)
def pytest_make_collect_report(collector: pytest.Collector) -> Iterator[pytest.CollectReport]:
    """In CI a skipped test file is a failed one."""
    report = yield
    return fail_if_skipped(report) if IS_CI else report


def fail_if_skipped(
    report: pytest.TestReport | pytest.CollectReport,
) -> pytest.TestReport | pytest.CollectReport:
    """Turn a skip into a failure; an expected failure stays one."""
    if report.skipped and not hasattr(report, "wasxfail"):
        reason = report.longrepr[2] if isinstance(report.longrepr, tuple) else report.longrepr
        report.outcome = "failed"
        report.longrepr = f"With CI=true nothing may be skipped, but this was: {reason}"
    return report


@pytest.fixture(scope="session")
def chromium_path() -> str:
    """Path of the system's Chromium, to give Playwright as `executable_path`."""
    path = find_chromium()
    if path is None:
        pytest.fail(f"The browser tests can't run: {NO_BROWSER}.")
    return path


@pytest.fixture(scope="session")
def sample_folder() -> Path:
    """The bundled clips."""
    return Path(__file__).parents[1] / "sample_data"


@pytest.fixture(autouse=True)
def own_library(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """Keep tests out of the user's library."""
    monkeypatch.setenv(HOME_VARIABLE, str(tmp_path / "liftlens_home"))
