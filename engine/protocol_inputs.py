"""What the validation protocol reads: markers and their joint angles at the times of the pictures.

Everything that takes long is kept in a cache folder, by what it was made from, so that a run that
was interrupted goes on and another one need not look at the same videos again.
"""

from __future__ import annotations

import hashlib
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from engine.datatypes import Array, ProgressCallback
from engine.errors import DataError, EngineError
from engine.kinematics.markers import (
    MarkerFit,
    MarkerModel,
    MarkerRecording,
    filter_markers,
    fit_markers,
    read_marker_trc,
    resample_markers,
    table3_angles,
)
from engine.storage.atomic import explain_os_errors, write_aside
from engine.subject.detector import PersonDetector
from engine.validation.protocol.dataset import SubjectFiles, TrialFiles
from engine.validation.protocol.folds import TrialFrames
from engine.validation.protocol.statistics import StudyTrial
from engine.video.reader import probe_video, read_frames

__all__ = ["Cache", "PersonData", "name_angles", "read_person", "stamp", "write_arrays"]

CUTOFF_HZ = 8.0
BOX_EVERY = 10
"""The person is looked for in every so manieth picture; between them a crop has its margin."""
MAX_VIEW_DIFFERENCE = 0.05
"""Share of frames by which two videos of one trial may differ in length."""
MIN_COVERED = 0.8
"""Share of the pictures for which all markers are needed."""


@dataclass(frozen=True, eq=False)
class Cache:
    """Arrays by name in a folder; a name stands for everything its arrays were made from."""

    folder: Path

    def get(
        self, kind: str, label: str, made_from: Sequence[object], make: Callable[[], dict[str, Any]]
    ) -> dict[str, NDArray[Any]]:
        """Return arrays, made now or earlier."""
        path = self.path(kind, label, made_from)
        if not path.is_file():
            arrays = make()
            write_arrays(path, arrays)
        with np.load(path, allow_pickle=False) as stored:
            return {name: stored[name] for name in stored.files}

    def path(self, kind: str, label: str, made_from: Sequence[object]) -> Path:
        """Return the file of some arrays."""
        mark = hashlib.sha256(repr(tuple(made_from)).encode()).hexdigest()[:12]
        return self.folder / kind / f"{label}_{mark}.npz"


def write_arrays(path: Path, arrays: Mapping[str, Any]) -> None:
    """Write named arrays so that the file is whole or not there.

    Raises
    ------
    OutputError
        If it can't be written.
    """
    with explain_os_errors(path, "A part of the study"):
        path.parent.mkdir(parents=True, exist_ok=True)
        with write_aside(path) as aside, aside.open("wb") as file:
            np.savez(file, **arrays)


def stamp(path: Path) -> tuple[str, int, int]:
    """Return what tells a file from a changed one, without reading it."""
    facts = path.stat()
    return path.name, facts.st_size, facts.st_mtime_ns


# --------------------------------------------------------------------------- markers


@dataclass(frozen=True, eq=False)
class PersonData:
    """A person's trials with measured markers and angles at the times of the pictures.

    Parameters
    ----------
    files
        Where everything is.
    trials, frames
        In the same order: what was measured, and which frames have all markers.
    model
        The body scaled to the person.
    picture_px, boxes
        Of each view: width and height, and where the person was seen, shape (B, 4).
    rate_hz
        Frames per second.
    notes
        What was odd, in words.
    """

    files: SubjectFiles
    trials: tuple[StudyTrial, ...]
    frames: tuple[TrialFrames, ...]
    model: MarkerModel
    picture_px: tuple[tuple[int, int], ...]
    boxes: tuple[Array, ...]
    rate_hz: float
    notes: tuple[str, ...] = ()

    @property
    def label(self) -> str:
        """The person's pseudonym."""
        return self.files.label

    @cached_property
    def marker_m(self) -> Array:
        """All measured markers, one trial after the other, shape (N, M, 3), m."""
        return np.concatenate([trial.measured_m for trial in self.trials])


def read_person(
    files: SubjectFiles,
    cache: Cache,
    *,
    ik: Literal["builtin", "opensim"] = "builtin",
    skip_unusable: bool = False,
    progress: ProgressCallback,
) -> PersonData:
    """Read the markers of a person's trials and work out their joint angles.

    Parameters
    ----------
    files
        Where they are.
    cache
        Where results are kept.
    ik
        What fits the body to the markers.
    skip_unusable
        Leave out trials whose videos or markers can't be used, with a note, instead of raising.
    progress
        Told of every trial; may raise `Cancelled`.

    Raises
    ------
    EngineError
        If a trial can't be used; the sentence names it and says what to do.
    """
    found: list[tuple[TrialFiles, _Look, MarkerRecording]] = []
    notes: list[str] = []
    for done, trial in enumerate(files.trials):
        progress(f"{files.label}: videos and markers", done, len(files.trials))
        try:
            found.append(_read_trial(trial, cache))
        except EngineError as error:
            if not skip_unusable:
                raise
            notes.append(f"Left out: {error}")
    if not found:
        raise DataError(f"{files.label} has no usable trial. {' '.join(notes[:1])}")
    _require_alike(found)
    notes += [note for _, _, recording in found for note in recording.notes]
    model = _scale(files, [recording for *_, recording in found], notes)
    trials = []
    for done, (trial, look, recording) in enumerate(found):
        progress(f"{files.label}: angles of the markers", done, len(found))
        trials.append(_measure(trial, look, recording, model, cache, ik))
    frames = tuple(
        TrialFrames(
            trial.subject, trial.label, trial.task, trial.repetition, trial.time_s,
            np.asarray(np.isfinite(trial.measured_m).all(axis=(1, 2))),
        )
        for trial in trials
    )  # fmt: skip
    look = found[0][1]
    return PersonData(
        files=replace(files, trials=tuple(trial for trial, *_ in found)),
        trials=tuple(trials),
        frames=frames,
        model=model,
        picture_px=look.picture_px,
        boxes=tuple(
            np.concatenate(view) for view in zip(*(one.boxes for _, one, _ in found), strict=False)
        ),
        rate_hz=look.rate_hz,
        notes=tuple(dict.fromkeys(notes)),
    )


@dataclass(frozen=True, eq=False)
class _Look:
    """A first look at a trial's videos: times (T,), and boxes of the person per view."""

    time_s: Array
    boxes: tuple[Array, ...]
    picture_px: tuple[tuple[int, int], ...]

    @property
    def rate_hz(self) -> float:
        return (self.time_s.size - 1) / float(self.time_s[-1] - self.time_s[0])


def _place(trial: TrialFiles) -> str:
    return f"{trial.subject}/{trial.label}"


def _read_trial(trial: TrialFiles, cache: Cache) -> tuple[TrialFiles, _Look, MarkerRecording]:
    look = _look_at(trial, cache)
    recording = _read_markers(trial)
    own = recording.time_s + trial.marker_offset_s
    spare = 1.5 / look.rate_hz
    if own[0] > look.time_s[0] + spare or own[-1] < look.time_s[-1] - spare:
        covered = max(0.0, min(own[-1], look.time_s[-1]) - max(own[0], look.time_s[0]))
        share = covered / float(look.time_s[-1] - look.time_s[0])
        sentence = (
            f"The markers of {_place(trial)} cover {own[0]:.2f} to {own[-1]:.2f} s, its videos "
            f"{look.time_s[0]:.2f} to {look.time_s[-1]:.2f} s"
        )
        if share < MIN_COVERED:
            raise DataError(
                f"{sentence}: {share:.0%} of the video, at least {MIN_COVERED:.0%} is needed. Cut "
                "the videos to the recording, or correct marker_offset_s in trial.json."
            )
        recording = replace(
            recording, notes=(*recording.notes, f"{sentence}; the rest is left out.")
        )
    moved = replace(recording, time_s=own)
    at_pictures = resample_markers(filter_markers(moved, cutoff_hz=CUTOFF_HZ), look.time_s)
    _require_complete(trial, at_pictures)
    return trial, look, at_pictures


def _look_at(trial: TrialFiles, cache: Cache) -> _Look:
    infos = [probe_video(path) for path in trial.videos]
    if len(infos) == 2:
        first, second = (info.n_frames for info in infos)
        if abs(first - second) > max(2, MAX_VIEW_DIFFERENCE * max(first, second)):
            raise DataError(
                f"The two videos of {_place(trial)} have {first} and {second} frames; they must "
                "show the same movement from the same moment on. Cut them alike."
            )
    found = [
        cache.get(
            "looks",
            f"{trial.subject}_{trial.label}_{path.stem}",
            (stamp(path), BOX_EVERY),
            lambda path=path: _look_at_view(path),  # type: ignore[misc]
        )
        for path in trial.videos
    ]
    return _Look(
        time_s=found[0]["time_s"],
        boxes=tuple(view["boxes"] for view in found),
        picture_px=tuple(info.size_px for info in infos),
    )


def _look_at_view(path: Path) -> dict[str, Any]:
    """Return the times of all pictures, and the largest person in some of them."""
    detector = PersonDetector(threads=1)
    time, boxes = [], []
    for frame in read_frames(path):
        time.append(frame.time_s)
        if frame.index % BOX_EVERY == 0:
            persons = detector(frame.image)
            sizes = [(p.right - p.left) * (p.bottom - p.top) for p in persons]
            if persons:
                p = persons[int(np.argmax(sizes))]
                boxes.append((p.left, p.top, p.right, p.bottom))
    return {"time_s": np.array(time), "boxes": np.array(boxes).reshape(-1, 4)}


def _read_markers(trial: TrialFiles) -> MarkerRecording:
    try:
        if trial.markers.suffix == ".npz":
            return _read_true_markers(trial.markers)
        return read_marker_trc(trial.markers)
    except DataError as error:
        raise type(error)(f"{_place(trial)}: {error}") from error


def _read_true_markers(path: Path) -> MarkerRecording:
    with np.load(path, allow_pickle=False) as data:
        missing = {"time", "markers", "marker_names"} - set(data.files)
        if missing:
            raise DataError(f"{path.name} holds no {sorted(missing)[0]}; add markers.trc.")
        time_s = np.asarray(data["time"], dtype=np.float64)
        position = np.asarray(data["markers"], dtype=np.float64)
        names = tuple(map(str, data["marker_names"]))
    # Times in single precision are not evenly spaced; the recording was.
    rate = round((time_s.size - 1) / float(time_s[-1] - time_s[0]), 1)
    return MarkerRecording(
        time_s[0] + np.arange(time_s.size) / rate, position, names, rate, "synthetic_45"
    )


def _require_complete(trial: TrialFiles, recording: MarkerRecording) -> None:
    there = np.asarray(np.isfinite(recording.position_m).all(axis=2))
    share = float(there.all(axis=1).mean())
    if share >= MIN_COVERED:
        return
    lost = [
        f"{name} ({1 - seen:.0%} missing)"
        for name, seen in zip(recording.names, there.mean(axis=0), strict=True)
        if seen < 1
    ]
    more = f" and {len(lost) - 5} more" if lost[5:] else ""
    raise DataError(
        f"In {_place(trial)} only {share:.0%} of the pictures have all markers, at least "
        f"{MIN_COVERED:.0%} are needed: {', '.join(lost[:5])}{more}. Fill the gaps in the motion "
        "capture program, or leave the trial out."
    )


def _require_alike(found: Sequence[tuple[TrialFiles, _Look, MarkerRecording]]) -> None:
    """Raise unless all trials of a person have the same pictures and markers."""
    first_trial, first_look, first = found[0]
    for trial, look, recording in found[1:]:
        if look.picture_px != first_look.picture_px:
            raise DataError(
                f"The pictures of {_place(trial)} have {_sizes(look)}, those of "
                f"{_place(first_trial)} {_sizes(first_look)}; a person must be filmed at one size, "
                "with fixed cameras. Export the videos alike, or leave the trial out."
            )
        if recording.names != first.names:
            raise DataError(
                f"The markers of {_place(trial)} are of another set than those of "
                f"{_place(first_trial)} ({recording.marker_set} and {first.marker_set}); name them "
                "alike."
            )


def _sizes(look: _Look) -> str:
    return " and ".join(f"{width} x {height} px" for width, height in look.picture_px)


# --------------------------------------------------------------------------- angles

_ROWS: Mapping[str, str] = {
    "ankle flexion": "ankle_dorsiflexion",
    "elbow rotation": "forearm_pronation",
}
"""Rows of Table 3 that this program calls otherwise."""
_SIDES: Mapping[str, str] = {" (left)": "_l", " (right)": "_r"}


def name_angles(fit: MarkerFit) -> tuple[tuple[str, ...], Array]:
    """Return the angles of Table 3 by this program's names, and their curves (T, 23), degrees."""
    titles, curves = table3_angles(fit)
    names = []
    for title in titles:
        side = next((s for words, s in _SIDES.items() if title.endswith(words)), "")
        row = title.removesuffix(" (left)").removesuffix(" (right)")
        names.append(_ROWS.get(row, row.replace(" ", "_")) + side)
    return tuple(names), curves


def _scale(
    files: SubjectFiles, recordings: Sequence[MarkerRecording], notes: list[str]
) -> MarkerModel:
    """Scale the body on the first trial that starts with standing."""
    reason = ""
    for recording in recordings:
        start = slice(0, max(2, round(2.0 * recording.rate_hz)))
        try:
            fit = fit_markers(
                recording.time_s[start],
                recording.position_m[start],
                recording.names,
                stature_m=files.stature_m,
                mass_kg=files.mass_kg,
            )
        except DataError as error:
            reason = reason or str(error)
            continue
        notes += fit.warnings
        return fit.model
    raise DataError(f"The body can't be scaled to {files.label}: {reason}")


def _measure(
    trial: TrialFiles,
    look: _Look,
    recording: MarkerRecording,
    model: MarkerModel,
    cache: Cache,
    ik: Literal["builtin", "opensim"],
) -> StudyTrial:
    made_from = (stamp(trial.markers), trial.marker_offset_s, ik, CUTOFF_HZ, look.time_s.size,
                 sorted(model.scale.items()))  # fmt: skip

    def make() -> dict[str, Any]:
        fit = fit_markers(
            recording.time_s, recording.position_m, recording.names, ik=ik, model=model
        )
        names, curves = name_angles(fit)
        return {"names": np.array(names), "reference_deg": curves}

    stored = cache.get("angles", f"{trial.subject}_{trial.label}", made_from, make)
    names = tuple(map(str, stored["names"]))
    return StudyTrial(
        subject=trial.subject,
        label=trial.label,
        task=trial.task,
        repetition=trial.repetition,
        time_s=look.time_s,
        marker_names=recording.names,
        measured_m=recording.position_m,
        angle_names=names,
        reference_deg=stored["reference_deg"],
        truth_deg=_read_true_angles(trial, look.time_s, names),
    )


def _read_true_angles(trial: TrialFiles, time_s: Array, names: Sequence[str]) -> Array:
    """Return exact angles at the times of the pictures; NaN where there are none."""
    curves = np.full((time_s.size, len(names)), np.nan)
    if trial.truth is None:
        return curves
    with np.load(trial.truth, allow_pickle=False) as data:
        if not {"time", "angles", "angle_names"} <= set(data.files):
            return curves
        time, true = data["time"].astype(np.float64), data["angles"].astype(np.float64)
        known = list(map(str, data["angle_names"]))
    for i, name in enumerate(names):
        if name in known:
            curves[:, i] = np.interp(time_s, time, true[:, known.index(name)], math.nan, math.nan)
    return curves
