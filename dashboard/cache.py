"""Engine calls behind Streamlit's caches, and what belongs to the running server."""

from __future__ import annotations

import hashlib
import io
import re
import shutil
import tempfile
import tomllib
import zipfile
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any

import streamlit as st

from dashboard.components.player.payload import Payload, build_payload
from engine.cameras.files.own import format_calibration
from engine.cameras.files.reading import read_calibration
from engine.compare_form import read_performance
from engine.datatypes import Calibration, JointAngles, ViewInfo
from engine.errors import DataError, EngineError, OutputError
from engine.form import Comparison, Repetition, compare_every_repetition, find_repetitions
from engine.jobs.local import JobQueue
from engine.kinematics.fitting import geometric
from engine.storage.atomic import explain_os_errors, hidden_sibling, write_aside
from engine.storage.curation import TrialRecord
from engine.storage.exports import export_result
from engine.storage.library import Library
from engine.storage.results import CALIBRATION_NAME, RESULT_FILES, StoredResult, read_result
from engine.validate import compare_results
from engine.validation.outcome import render_outcome
from engine.validation.pooled import Agreement
from engine.validation.profiles import ImportProfile, format_profile, read_profile
from engine.validation.reference.base import Reference
from engine.validation.reference.files import describe_profile, read_reference
from engine.version import __version__
from engine.video.reader import probe_video

SAMPLES_FILE = Path(__file__).parents[1] / "sample_data" / "samples.toml"
CHUNK_BYTES = 1 << 20
CALIBRATION_FOLDER = "calibrations"
REFERENCE_FOLDER = "reference"
"""Inside a trial's folder, so that it is deleted with the trial."""
PROFILE_NAME = "profile.toml"
SAMPLE_MARKERS = "markers.trc"


@dataclass(frozen=True)
class Sample:
    """A bundled video with what is known of it."""

    key: str
    title: str
    path: Path
    values: dict[str, Any]
    note: str
    licence: str
    second_path: Path | None = None

    @property
    def videos(self) -> tuple[Path, ...]:
        """The video, or both."""
        return (self.path,) if self.second_path is None else (self.path, self.second_path)


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
def _read_result(folder: str, stamp_ns: int) -> StoredResult:
    # Streamlit leaves arguments with a leading underscore out of the key.
    return read_result(Path(folder))


def player_payload(trial_id: str) -> Payload:
    """Return what the player shows of a trial.

    Raises
    ------
    DataError
        If there is no such trial, or its result is damaged.
    """
    return _build_payload(trial_id, str(result(trial_id).document["created"]))


@st.cache_resource(max_entries=8, show_spinner=False)
def _build_payload(trial_id: str, created: str) -> Payload:
    return build_payload(result(trial_id))


def record(trial_id: str) -> TrialRecord:
    """Return what people added to a trial; never cached, since others add to it too.

    Raises
    ------
    ConfigError
        If there is no such trial.
    """
    return library().record(trial_id)


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


def export_bytes(folder: Path, suffix: str) -> bytes:
    """Return a result in the format of another tool."""
    with tempfile.TemporaryDirectory() as place:
        return export_result(folder, suffix, Path(place)).read_bytes()


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
    own = {"key", "title", "file", "second_file", "calibration", "note", "licence"}
    folder = SAMPLES_FILE.parent
    return tuple(
        Sample(
            key=row["key"],
            title=row["title"],
            path=folder / row["file"],
            values={
                **{name: value for name, value in row.items() if name not in own},
                "calibration": str(folder / row["calibration"]) if "calibration" in row else "",
            },
            note=row.get("note", ""),
            licence=row.get("licence", ""),
            second_path=folder / row["second_file"] if "second_file" in row else None,
        )
        for row in rows
    )


def calibrations() -> dict[str, str]:
    """Return the kept calibrations: path and name, in order of names."""
    folder = library().root / CALIBRATION_FOLDER
    return {str(path): path.stem for path in sorted(folder.glob("*.toml"))}


def calibration_text(stored: StoredResult) -> str:
    """Return the cameras of a trial as a file's text; empty with one view."""
    path = stored.folder / CALIBRATION_NAME
    return path.read_text(encoding="utf-8") if path.is_file() else ""


def read_kept_calibration(path: str) -> Calibration:
    """Return a kept calibration.

    Raises
    ------
    CalibrationError
        If it is damaged.
    """
    return read_calibration(Path(path))


def import_calibration(source: IO[bytes], name: str) -> tuple[Calibration, str]:
    """Return the cameras of any program's file, and the text to keep them by.

    Raises
    ------
    CalibrationError
        If it is none.
    """
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / sanitise_name(name)
        path.write_bytes(source.read())
        calibration = read_calibration(path)
    return calibration, format_calibration(calibration)


def keep_calibration(name: str, text: str) -> None:
    """Keep a calibration under a name, in the place of an earlier one of that name.

    Raises
    ------
    OutputError
        If it can't be written.
    """
    path = library().root / CALIBRATION_FOLDER / sanitise_name(f"{name}.toml")
    with explain_os_errors(path, "The calibration"):
        path.parent.mkdir(exist_ok=True)
        with write_aside(path) as aside:
            aside.write_text(text, encoding="utf-8")


def remove_calibration(path: str) -> None:
    """Delete a kept calibration."""
    Path(path).unlink(missing_ok=True)


def save_upload(source: IO[bytes], name: str) -> Path:
    """Write an upload into the library piece by piece; return where it lies.

    Raises
    ------
    OutputError
        If there is no room for it; nothing is left of it then.
    """
    home = library()
    folder = home.upload_folder(home.new_id())
    target = folder / sanitise_name(name)
    try:
        with explain_os_errors(target, "The upload"), write_aside(target) as aside:
            _copy(source, aside)
    except OutputError:
        shutil.rmtree(folder, ignore_errors=True)
        raise
    return target


def _copy(source: IO[bytes], target: Path) -> None:
    with target.open("wb") as file:
        shutil.copyfileobj(source, file, CHUNK_BYTES)


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


# --------------------------------------------------------------------------- form


def repetitions(trial_id: str) -> tuple[Repetition, ...]:
    """Return the lifts of a trial, or the repetitions of its exercise.

    Raises
    ------
    DataError
        If there is no such trial, or its clip is too short.
    """
    return _find_repetitions(trial_id, result_stamp(trial_id))


def form_comparisons(
    reference: str, attempt: str, reference_repetition: int
) -> tuple[Comparison, ...]:
    """Compare every repetition of an attempt with one of a reference.

    Raises
    ------
    EngineError
        If the movements can't be compared.
    """
    stamps = (result_stamp(reference), result_stamp(attempt))
    return _compare_form(reference, attempt, reference_repetition, stamps)


def result_stamp(trial_id: str) -> int:
    """Return what changes when a trial does."""
    result(trial_id)  # says in one sentence what is wrong with it
    return (library().folder(trial_id) / "trial.json").stat().st_mtime_ns


@st.cache_resource(max_entries=64, show_spinner=False)
def _find_repetitions(trial_id: str, stamp_ns: int) -> tuple[Repetition, ...]:
    return find_repetitions(read_performance(result(trial_id)))


@st.cache_resource(max_entries=256, show_spinner="Comparing …")
def _compare_form(
    reference: str, attempt: str, reference_repetition: int, stamps: tuple[int, int]
) -> tuple[Comparison, ...]:
    one, two = (read_performance(result(name)) for name in (reference, attempt))
    return compare_every_repetition(one, two, reference_repetition=reference_repetition)


# --------------------------------------------------------------------------- reference recordings


def reference_file(trial_id: str) -> Path | None:
    """Return the recording kept with a trial; None if there is none."""
    folder = library().folder(trial_id) / REFERENCE_FOLDER
    if not folder.is_dir():
        return None
    kept = (p for p in sorted(folder.iterdir()) if not p.name.startswith("."))
    return next((path for path in kept if path.name != PROFILE_NAME), None)


def save_reference(trial_id: str, name: str, source: IO[bytes]) -> None:
    """Keep a recording with a trial, in the place of an earlier one.

    Raises
    ------
    OutputError
        If there is no room for it; the earlier one stays then.
    """
    folder = library().folder(trial_id) / REFERENCE_FOLDER
    aside = hidden_sibling(folder)
    try:
        with explain_os_errors(folder, "The recording"):
            aside.mkdir()
            _copy(source, aside / sanitise_name(name))
            remove_reference(trial_id)
            aside.rename(folder)
    finally:
        shutil.rmtree(aside, ignore_errors=True)


def remove_reference(trial_id: str) -> None:
    """Delete the recording of a trial, with its profile."""
    shutil.rmtree(library().folder(trial_id) / REFERENCE_FOLDER, ignore_errors=True)


def reference_profile(trial_id: str) -> ImportProfile | None:
    """Return what a user confirmed or corrected about the recording."""
    path = library().folder(trial_id) / REFERENCE_FOLDER / PROFILE_NAME
    return read_profile(path) if path.exists() else None


def save_reference_profile(trial_id: str, profile: ImportProfile | None) -> None:
    """Keep what a user confirmed; None forgets it."""
    path = library().folder(trial_id) / REFERENCE_FOLDER / PROFILE_NAME
    if profile is None:
        path.unlink(missing_ok=True)
        return
    with write_aside(path) as aside:
        aside.write_text(format_profile(profile), encoding="utf-8")


def reference_profile_text(trial_id: str) -> str:
    """Return an import profile of the recording, as TOML."""
    return format_profile(describe_profile(reference(trial_id)))


def reference(trial_id: str) -> Reference:
    """Return the recording of a trial, understood.

    Raises
    ------
    DataError
        If there is none, or it can't be used.
    """
    path = _require_reference(trial_id)
    return _read_reference(str(path), _reference_stamp(path))


def is_reference_readable(trial_id: str) -> bool:
    """Whether the recording of a trial can be understood."""
    try:
        reference(trial_id)
    except EngineError:
        return False
    return True


def _require_reference(trial_id: str) -> Path:
    path = reference_file(trial_id)
    if path is None:
        raise DataError("No reference recording is kept with this trial; add one.")
    return path


def _reference_stamp(path: Path) -> tuple[int, int]:
    """Return what changes when the recording or its profile does."""
    profile = path.with_name(PROFILE_NAME)
    return path.stat().st_mtime_ns, profile.stat().st_mtime_ns if profile.exists() else 0


@st.cache_resource(max_entries=8, show_spinner=False)
def _read_reference(path: str, stamp: tuple[int, int]) -> Reference:
    profile = Path(path).with_name(PROFILE_NAME)
    return read_reference(Path(path), read_profile(profile) if profile.exists() else None)


def agreement(trial_id: str) -> Agreement:
    """Return the comparison of a trial with the recording kept with it.

    Raises
    ------
    EngineError
        If the recording can't be used, or does not fit the trial.
    """
    return pooled_agreement((trial_id,))


def pooled_agreement(trial_ids: tuple[str, ...]) -> Agreement:
    """Return the comparison of several trials with the recordings kept with them.

    Raises
    ------
    EngineError
        If a recording can't be used, or does not fit its trial.
    """
    return _compare(trial_ids, tuple(_comparison_stamp(trial_id) for trial_id in trial_ids))


def _comparison_stamp(trial_id: str) -> tuple[str, int, int, int]:
    """Return what changes when a trial or its recording does."""
    path = _require_reference(trial_id)
    document = library().folder(trial_id) / "trial.json"
    return (str(path), document.stat().st_mtime_ns, *_reference_stamp(path))


@st.cache_resource(max_entries=8, show_spinner=False)
def _compare(
    trial_ids: tuple[str, ...], stamps: tuple[tuple[str, int, int, int], ...]
) -> Agreement:
    return compare_results([(result(name), reference(name)) for name in trial_ids])


def zip_agreement(*trial_ids: str) -> bytes:
    """Return everything that `liftlens validate` writes, as a zip file."""
    outcome = render_outcome(pooled_agreement(trial_ids), version=__version__)
    folder = f"{trial_ids[0]}_agreement" if len(trial_ids) == 1 else "pooled_agreement"
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, content in outcome.items():
            archive.writestr(f"{folder}/{name}", content)
    return buffer.getvalue()


def sample_reference(trial_id: str) -> Path | None:
    """Return the bundled markers of a bundled lift; None for any other trial."""
    filmed = {view["sha256"] for view in result(trial_id).document["views"]}
    for sample in samples():
        markers = sample.path.with_name(SAMPLE_MARKERS)
        if markers.exists() and _sample_hash(str(sample.path)) in filmed:
            return markers
    return None


@st.cache_data(show_spinner=False)
def _sample_hash(path: str) -> str:
    return hashlib.sha256(Path(path).read_bytes()).hexdigest()
