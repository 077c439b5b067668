"""Engine calls behind Streamlit's caches, and what belongs to the running server."""

from __future__ import annotations

import io
import re
import tomllib
import zipfile
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any

import streamlit as st

from engine.datatypes import JointAngles, ViewInfo
from engine.errors import DataError
from engine.jobs.local import JobQueue
from engine.kinematics.fitting import geometric
from engine.storage.library import Library
from engine.storage.results import RESULT_FILES, StoredResult, read_result
from engine.video.reader import probe_video

SAMPLES_FILE = Path(__file__).parents[1] / "sample_data" / "samples.toml"
CHUNK_BYTES = 1 << 20


@dataclass(frozen=True)
class Sample:
    """A bundled video with what is known of it."""

    key: str
    title: str
    path: Path
    values: dict[str, Any]
    note: str
    licence: str


def library() -> Library:
    """Return the user's library."""
    return Library.open()


def job_queue() -> JobQueue:
    """Return the queue of the user's library."""
    return JobQueue(library())


def result(trial_id: str) -> StoredResult:
    """Return a trial's result.

    Raises
    ------
    DataError
        If there is none, or it is damaged.
    """
    folder = library().folder(trial_id)
    document = folder / "trial.json"
    if not document.exists():
        raise DataError(f"There is no trial {trial_id!r} in the library; it may have been deleted.")
    return _read_result(str(folder), document.stat().st_mtime_ns)


@st.cache_resource(max_entries=8, show_spinner=False)
def _read_result(folder: str, _stamp_ns: int) -> StoredResult:
    return read_result(Path(folder))


@st.cache_resource(max_entries=8, show_spinner=False)
def uncorrected_angles(trial_id: str) -> JointAngles:
    """Return a trial's joint angles straight from the keypoints, before any correction.

    Angles that mean something else without a body model are left out where one was fitted.

    Raises
    ------
    DataError
        If there is no such trial, or its result is damaged.
    """
    stored = result(trial_id)
    found = geometric.SOLVER.fit(stored.raw, stored.subject).angles
    if stored.body is None:
        return found
    keep = [i for i, name in enumerate(found.names) if name not in geometric.WITHOUT_PELVIS]
    return JointAngles(
        time_s=found.time_s,
        value_deg=found.value_deg[:, keep],
        names=tuple(found.names[i] for i in keep),
    )


def zip_result(folder: Path) -> bytes:
    """Return the result folder as a zip file, the trial's id as its top folder."""
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", zipfile.ZIP_DEFLATED) as archive:
        for name in RESULT_FILES:
            if (folder / name).is_file() and name != "summary.json":
                archive.write(folder / name, f"{folder.name}/{name}")
    return buffer.getvalue()


@st.cache_data(show_spinner=False)
def samples() -> tuple[Sample, ...]:
    """Return the bundled videos; none where they are not installed."""
    if not SAMPLES_FILE.exists():
        return ()
    with SAMPLES_FILE.open("rb") as file:
        rows = tomllib.load(file)["sample"]
    own = {"key", "title", "file", "note", "licence"}
    return tuple(
        Sample(
            key=row["key"],
            title=row["title"],
            path=SAMPLES_FILE.parent / row["file"],
            values={name: value for name, value in row.items() if name not in own},
            note=row.get("note", ""),
            licence=row.get("licence", ""),
        )
        for row in rows
    )


def save_upload(source: IO[bytes], name: str) -> Path:
    """Write an upload into the library piece by piece; return where it lies."""
    home = library()
    folder = home.upload_folder(home.new_id())
    target = folder / sanitise_name(name)
    with target.open("wb") as file:
        while chunk := source.read(CHUNK_BYTES):
            file.write(chunk)
    return target


def sanitise_name(name: str) -> str:
    """Return a file name that is safe on every system and still recognisable."""
    base = re.split(r"[\\/]", name)[-1]
    stem, dot, suffix = base.rpartition(".")
    stem, suffix = (stem, suffix) if dot else (base, "")
    stem = re.sub(r"[^\w\-]+", "_", stem).strip("_")[:60] or "video"
    suffix = re.sub(r"[^A-Za-z0-9]", "", suffix)[:8].lower()
    return f"{stem}.{suffix}" if suffix else stem


def video_facts(path: Path) -> ViewInfo:
    """Return what a video file holds.

    Raises
    ------
    VideoError
        If it is no usable video.
    """
    return probe_video(path)
