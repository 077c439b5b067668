"""What lists, overview and settings ask of the whole library, behind Streamlit's caches."""

from __future__ import annotations

import contextlib
import os
import shutil
import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import replace
from datetime import datetime
from pathlib import Path
from typing import IO, Any

import streamlit as st

import engine.pose
from dashboard import cache
from engine.cli_demo import read_samples
from engine.errors import ConfigError
from engine.jobs.local import JobRequest
from engine.preferences import Preferences, read_preferences, write_preferences
from engine.report import ReportOptions, render_job_report, render_trial_report
from engine.sample_results import SAMPLES_SITE
from engine.storage.atomic import explain_os_errors
from engine.storage.entries import Choices
from engine.storage.overview import Overview
from engine.storage.results import read_result
from engine.storage.transfer import ImportReport

SUMMARY_S = 20.0
"""How long counts over all trials may lag behind what others edit."""
MODELS = Path(engine.pose.__file__).with_name("models")
MOST_REPORTED = 200
"""Trials in one report; more of them would take minutes to read."""


def choices() -> Choices:
    """Return the sites, jobs, people and tags there are."""
    home = cache.library()
    return _choices(str(home.root), home.trials.stat().st_mtime_ns)


@st.cache_data(ttl=SUMMARY_S, max_entries=4, show_spinner=False)
def _choices(root: str, stamp_ns: int) -> Choices:
    return cache.library().choices()


def overview(
    *,
    site: str | None = None,
    job: str | None = None,
    since: datetime | None = None,
    until: datetime | None = None,
) -> Overview:
    """Return the library in numbers."""
    home = cache.library()
    return _overview(str(home.root), home.trials.stat().st_mtime_ns, site, job, since, until)


@st.cache_data(ttl=SUMMARY_S, max_entries=32, show_spinner=False)
def _overview(
    root: str,
    stamp_ns: int,
    site: str | None,
    job: str | None,
    since: datetime | None,
    until: datetime | None,
) -> Overview:
    return cache.library().overview(site=site, job=job, since=since, until=until)


def forget_summaries() -> None:
    """Count anew, after this user changed a trial."""
    _choices.clear()
    _overview.clear()


def find_ids(
    *,
    site: str | None = None,
    job: str | None = None,
    since: datetime | None = None,
    until: datetime | None = None,
) -> tuple[str, ...]:
    """Return the newest trials that can be read and match, as many as a report may hold."""
    found = cache.library().query(site=site, job=job, since=since, until=until, limit=MOST_REPORTED)
    return tuple(entry.id for entry in found.entries if not entry.is_damaged)


def trial_report(trial_id: str, options: ReportOptions) -> bytes:
    """Return a trial as PDF."""
    return render_trial_report(cache.result(trial_id), options)


def group_report(
    trial_ids: Sequence[str], options: ReportOptions, *, before: Sequence[str] = ()
) -> bytes:
    """Return a summary of several trials as PDF."""
    # Read past the cache: hundreds of results would push out what other pages show.
    home = cache.library()
    read, earlier = (
        [read_result(home.folder(name)) for name in part] for part in (trial_ids, before)
    )
    return render_job_report(read, options, before=earlier)


def preferences() -> Preferences:
    """Return what was chosen for this library.

    Raises
    ------
    ConfigError
        If the file of preferences is damaged.
    """
    return read_preferences(cache.library().root)


def units() -> str:
    """Return the units to show; metric as long as the preferences can't be read."""
    try:
        return preferences().units
    except ConfigError:  # the page of settings says so
        return Preferences.units


def save_preferences(chosen: Preferences) -> None:
    """Keep what was chosen for this library."""
    write_preferences(chosen, cache.library().root)


def export_library(**which: Any) -> bytes:
    """Return trials with all that belongs to them as a zip file; see `Library.export`."""
    with tempfile.TemporaryDirectory() as folder:
        return cache.library().export(Path(folder) / "export.zip", **which).read_bytes()


def import_library(source: IO[bytes]) -> ImportReport:
    """Take in what `export_library` gave, here or elsewhere.

    Raises
    ------
    DataError
        If it is no such file, or damaged.
    OutputError
        If there is no room for it.
    """
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "import.zip"
        with explain_os_errors(path, "The upload"), path.open("wb") as file:
            shutil.copyfileobj(source, file, cache.CHUNK_BYTES)
        return cache.library().import_archive(path)


def folder_sizes() -> dict[str, int]:
    """Return how many bytes each part of the library takes."""
    return _folder_sizes(str(cache.library().root))


@st.cache_data(ttl=SUMMARY_S, max_entries=2, show_spinner=False)
def _folder_sizes(root: str) -> dict[str, int]:
    parts = ("trials", "uploads", "jobs", "artefacts")
    sizes = {part: sum(_file_sizes(Path(root, part))) for part in parts}
    rest = (path for path in Path(root).iterdir() if path.is_file())
    return sizes | {"other": sum(path.stat().st_size for path in rest)}


def _file_sizes(folder: Path) -> Iterator[int]:
    for place, _, names in os.walk(folder):
        for name in names:
            with contextlib.suppress(FileNotFoundError):  # deleted by somebody meanwhile
                yield Path(place, name).stat().st_size


def model_files() -> tuple[Path, ...]:
    """Return the bundled networks."""
    return tuple(sorted(MODELS.glob("*.onnx")))


def model_card() -> str:
    """Return what is known of the bundled networks, as Markdown."""
    return (MODELS / "README.md").read_text(encoding="utf-8").replace("\n#", "\n###")


# --------------------------------------------------------------------------- samples


def sample_requests() -> tuple[JobRequest, ...]:
    """Return what assesses every bundled sample, with all that is known of it."""
    return tuple(
        JobRequest(
            videos=tuple(view.path for view in settings.trial.views),
            subject=settings.trial.subject,
            task=settings.trial.task,
            config={"two_view": {"calibration": settings.config.two_view.calibration}},
            label=settings.trial.label,
            site=SAMPLES_SITE,
            job=sample.key.replace("_", " ").capitalize(),
        )
        for sample in read_samples()
        for settings in (sample.settings(is_quiet=True),)
    )


def with_preferences(request: JobRequest) -> JobRequest:
    """Return a request that follows the preferences where it says nothing itself."""
    chosen = preferences().assessment
    tables = {
        name: {**chosen.get(name, {}), **request.config.get(name, {})}
        for name in {*chosen, *request.config}
    }
    return replace(request, config=tables)
