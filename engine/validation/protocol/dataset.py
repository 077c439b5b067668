"""A data set of lifts with markers: where its files are, and what they say of themselves.

::

    DATASET/
        dataset.json            optional: title, note, is_synthetic
        SUBJECT/
            subject.json        optional: sex, height_m, mass_kg, calibration
            TRIAL/
                one or two videos, markers.trc
                trial.json      task, repetition; optional: videos, markers, marker_offset_s,
                                events_s
                truth.npz       optional, of computer-generated data only: exact joint angles, and
                                markers in place of markers.trc

`docs/datasets.md` describes every key. Nothing but text files is opened here.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal, get_args

import numpy as np

from engine.datatypes import Camera
from engine.errors import ConfigError, DataError, EngineError

__all__ = [
    "VIDEO_SUFFIXES",
    "Dataset",
    "SubjectFiles",
    "TrialFiles",
    "Views",
    "parse_views",
    "read_dataset",
]

Views = Literal["2", "first", "second"]
"""Which views of every trial are used."""

VIDEO_SUFFIXES = (".mp4", ".mov", ".avi", ".mkv", ".webm", ".m4v")
CALIBRATION_SUFFIXES = (".toml", ".txt")
CALIBRATION_STEM = "calibration"
LAYOUT = "docs/datasets.md describes the layout"
MAX_JSON_BYTES = 5_000_000
_NAME = re.compile(r"^(?P<subject>.+)_(?P<task>[^_]+)_(?P<repetition>\d+)$")


@dataclass(frozen=True)
class TrialFiles:
    """One recorded lift.

    Parameters
    ----------
    subject, label
        Together they tell trials apart; the label is the folder's name.
    task, repetition
        Such as FK, and 1 for the first time.
    folder, videos, markers
        `videos` in the order of the views, only those that are used; `markers` is a TRC file, or
        that of the truth where there is none.
    truth
        Exact joint angles, None for recordings of people.
    marker_offset_s
        Added to the times of the markers to get those of the videos.
    events_s
        Moments by name, s, on the clock of the videos; may be empty.
    """

    subject: str
    label: str
    task: str
    repetition: int
    folder: Path
    videos: tuple[Path, ...]
    markers: Path
    truth: Path | None = None
    marker_offset_s: float = 0.0
    events_s: Mapping[str, float] = field(default_factory=dict)


@dataclass(frozen=True, eq=False)
class SubjectFiles:
    """One person and their trials.

    `cameras` are those of the used views, empty where subject.json holds none; `calibration` is
    then a file of another program, or None.
    """

    label: str
    folder: Path
    trials: tuple[TrialFiles, ...]
    sex: Literal["female", "male"] | None = None
    stature_m: float | None = None
    mass_kg: float | None = None
    cameras: tuple[Camera, ...] = ()
    calibration: Path | None = None

    @property
    def tasks(self) -> tuple[str, ...]:
        """The tasks, in order of first appearance."""
        return tuple(dict.fromkeys(trial.task for trial in self.trials))


@dataclass(frozen=True, eq=False)
class Dataset:
    """Persons and trials that can be used, and in `problems` what is wrong with the others."""

    folder: Path
    title: str
    subjects: tuple[SubjectFiles, ...]
    is_synthetic: bool = False
    note: str = ""
    problems: tuple[str, ...] = ()

    @property
    def trials(self) -> tuple[TrialFiles, ...]:
        """All trials, person by person."""
        return tuple(trial for subject in self.subjects for trial in subject.trials)

    @property
    def tasks(self) -> tuple[str, ...]:
        """The tasks, in order of first appearance."""
        return tuple(dict.fromkeys(trial.task for trial in self.trials))


def parse_views(text: str) -> Views:
    """Return which views are meant.

    Raises
    ------
    ConfigError
        If it is none of 2, first, second.
    """
    for views in get_args(Views):
        if text.strip().lower() == views:
            return views  # type: ignore[no-any-return]
    raise ConfigError(f"--views must be one of {', '.join(get_args(Views))}, got {text!r}.")


def read_dataset(
    folder: Path,
    *,
    persons: Sequence[str] = (),
    views: Views = "2",
    skip_unusable: bool = False,
) -> Dataset:
    """Find the trials of a data set and check that everything needed is there.

    Parameters
    ----------
    folder
        The data set.
    persons
        Names of the persons' folders; empty for all.
    views
        Whether both views are needed, or the first or second alone.
    skip_unusable
        Leave unusable trials out and say so in `problems`, instead of raising.

    Raises
    ------
    ConfigError
        If a person is named that is not there.
    DataError
        If there is no data set, or a trial lacks something; the sentence says what and where.
    """
    folder = Path(folder).expanduser()
    if not folder.is_dir():
        raise DataError(f"Expected the folder of a data set, but {folder} is no folder; {LAYOUT}.")
    about = _read_json(folder / "dataset.json") | _read_json(folder / "index.json", keys=("name",))
    chosen = _choose_persons(folder, persons)
    problems: list[str] = []
    subjects = [_read_subject(one, views, problems) for one in chosen]
    kept = tuple(subject for subject in subjects if subject.trials)
    if problems and not skip_unusable:
        more = f" {len(problems) - 1} more trials can't be used." if problems[1:] else ""
        raise DataError(
            f"{problems[0]}{more} Complete the data set, or leave such trials out with "
            "--skip-unusable."
        )
    if not kept:
        first = f" {problems[0]}" if problems else ""
        raise DataError(f"{folder.name} holds no usable trial; {LAYOUT}.{first}")
    name = str(about.get("title") or about.get("name") or folder.name)
    has_truth = any(trial.truth is not None for subject in kept for trial in subject.trials)
    return Dataset(
        folder=folder.resolve(),
        title=name.replace("_", " "),
        subjects=kept,
        is_synthetic=bool(about.get("is_synthetic", has_truth or "synthetic" in name.lower())),
        note=str(about.get("note", "")),
        problems=tuple(problems),
    )


def _choose_persons(folder: Path, persons: Sequence[str]) -> list[Path]:
    there = [path for path in sorted(folder.iterdir()) if path.is_dir() and _is_person(path)]
    if not there:
        raise DataError(
            f"{folder.name} holds no data set: expected a folder per person, in it a folder per "
            f"trial with the videos and markers.trc; {LAYOUT}."
        )
    names = [path.name for path in there]
    unknown = [person for person in persons if person not in names]
    if unknown:
        raise ConfigError(f"{folder.name} has no person {unknown[0]!r}; it has {', '.join(names)}.")
    return [path for path in there if not persons or path.name in persons]


def _is_person(folder: Path) -> bool:
    return (folder / "subject.json").is_file() or any(_list_trials(folder))


def _list_trials(folder: Path) -> Iterator[Path]:
    """List the folders that look like trials: anything of one is enough, so that gaps are seen."""
    for path in sorted(folder.iterdir()):
        if path.is_dir() and (
            (path / "trial.json").is_file() or any(path.glob("*.trc")) or _list_videos(path)
        ):
            yield path


def _list_videos(folder: Path) -> list[Path]:
    found = [p for p in folder.iterdir() if p.suffix.lower() in VIDEO_SUFFIXES]
    return sorted(found, key=lambda p: _natural(p.name))


def _natural(name: str) -> list[tuple[int, str]]:
    """Order cam90 before cam135."""
    return [(int(part), "") if part.isdigit() else (-1, part) for part in re.split(r"(\d+)", name)]


# --------------------------------------------------------------------------- a person


def _read_subject(folder: Path, views: Views, problems: list[str]) -> SubjectFiles:
    facts = _read_json(folder / "subject.json")
    cameras = _read_cameras(facts.get("calibration"), folder)
    names = [camera.name for camera in cameras]
    trials = []
    for path in _list_trials(folder):
        try:
            trials.append(_read_trial(path, folder.name, names, views))
        except EngineError as error:
            problems.append(str(error))
    return SubjectFiles(
        label=folder.name,
        folder=folder,
        trials=tuple(trials),
        sex=_SEXES.get(str(facts.get("sex", "")).strip().lower()),
        stature_m=_optional_number(facts, "height_m", folder),
        mass_kg=_optional_number(facts, "mass_kg", folder),
        cameras=_pick(cameras, views),
        calibration=_find_calibration(folder) or _find_calibration(folder.parent),
    )


_SEXES: Mapping[str, Literal["female", "male"]] = {
    "f": "female", "female": "female", "m": "male", "male": "male",
}  # fmt: skip


def _find_calibration(folder: Path) -> Path | None:
    found = (
        path
        for path in sorted(folder.iterdir())
        if path.name.lower().startswith(CALIBRATION_STEM)
        and path.suffix.lower() in CALIBRATION_SUFFIXES
    )
    return next(found, None)


def _read_cameras(tables: Any, folder: Path) -> tuple[Camera, ...]:
    """Build the cameras of subject.json: K, R, t, dist, width, height per view."""
    if tables is None:
        return ()
    try:
        return tuple(
            Camera(
                name=str(one.get("name", f"view {number}")),
                size_px=(int(one["width"]), int(one["height"])),
                matrix=np.array(one["K"], dtype=np.float64),
                rotation=np.array(one["R"], dtype=np.float64),
                translation=np.array(one["t"], dtype=np.float64),
                distortion=np.array(one.get("dist", [0.0] * 5), dtype=np.float64),
            )
            for number, one in enumerate(tables, start=1)
        )
    except (KeyError, TypeError, AttributeError, ValueError) as error:
        raise DataError(
            f"The calibration in {folder.name}/subject.json can't be read ({error}); expected per "
            f"camera name, K, R, t, dist, width and height; {LAYOUT}."
        ) from error


def _pick(items: Sequence[Any], views: Views) -> tuple[Any, ...]:
    """Return those of two things per view that are used; nothing of less than two."""
    if len(items) < 2:
        return tuple(items) if views == "first" else ()
    return tuple(items[:2]) if views == "2" else (items[0 if views == "first" else 1],)


# --------------------------------------------------------------------------- a trial


def _read_trial(
    folder: Path, subject: str, camera_names: Sequence[str], views: Views
) -> TrialFiles:
    facts = _read_json(folder / "trial.json")
    place = f"{subject}/{folder.name}"
    named = _NAME.match(folder.name)
    task = facts.get("task") or (named["task"] if named else None)
    repetition = facts.get("repetition") or (named["repetition"] if named else None)
    if task is None or repetition is None:
        raise DataError(
            f"{place} does not say which task and repetition it is: expected them in trial.json, "
            f"or a folder name such as {subject}_FK_01."
        )
    truth = folder / "truth.npz"
    return TrialFiles(
        subject=subject,
        label=folder.name,
        task=str(task),
        repetition=_whole_number(repetition, "repetition", place),
        folder=folder,
        videos=_find_videos(folder, facts, camera_names, views, place),
        markers=_find_markers(folder, facts, place),
        truth=truth if truth.is_file() else None,
        marker_offset_s=_optional_number(facts, "marker_offset_s", folder) or 0.0,
        events_s=_read_events(facts.get("events_s"), place),
    )


def _find_videos(
    folder: Path, facts: Mapping[str, Any], names: Sequence[str], views: Views, place: str
) -> tuple[Path, ...]:
    if "videos" in facts:
        found = [_inside(folder, str(name), place) for name in facts["videos"]]
    else:
        found = _list_videos(folder)
        if len(names) >= 2 and {*names} & {path.stem for path in found}:
            found = _order_by_camera(found, names, place, views)
    if len(found) > 2:
        raise DataError(
            f"{place} holds {len(found)} videos and does not say which two belong to it; name them "
            "in trial.json under videos, the first view first."
        )
    if views == "2" and len(found) < 2:
        raise DataError(
            f"{place} has {len(found)} of its 2 videos: one view is missing. Add it, or use a "
            "single view with --views first or second."
        )
    used: tuple[Path, ...] = _pick(found, views)
    if not used:
        raise DataError(f"{place} has no video of the {views} view.")
    missing = [path.name for path in used if not path.is_file()]
    if missing:
        raise DataError(f"{place} lacks its video {missing[0]}.")
    return used


def _order_by_camera(
    found: Sequence[Path], names: Sequence[str], place: str, views: Views
) -> list[Path]:
    """Order videos as the cameras that they are named after."""
    by_stem = {path.stem: path for path in found}
    used = {"2": names[:2], "first": names[:1], "second": names[1:2]}[views]
    missing = [name for name in used if name not in by_stem]
    if missing:
        raise DataError(
            f"{place} has no video {missing[0]}: one view is missing. Add it, or use the other "
            "view alone with --views first or second."
        )
    return [by_stem.get(name, found[0].with_name(f"{name}.mp4")) for name in names[:2]]


def _find_markers(folder: Path, facts: Mapping[str, Any], place: str) -> Path:
    if "markers" in facts:
        path = _inside(folder, str(facts["markers"]), place)
        if not path.is_file():
            raise DataError(f"{place} lacks its marker file {path.name}.")
        return path
    found = sorted(folder.glob("*.trc"))
    usual = folder / "markers.trc"
    if usual in found:
        return usual
    truth = folder / "truth.npz"
    if not found and truth.is_file():
        return truth
    if len(found) != 1:
        raise DataError(
            f"{place} holds {len(found)} TRC files, expected markers.trc; export the markers as "
            "TRC, or name the file in trial.json under markers."
        )
    return found[0]


def _inside(folder: Path, name: str, place: str) -> Path:
    """Return a file named in trial.json; a data set from elsewhere may not lead out of itself."""
    path = (folder / name).resolve()
    if folder.resolve() not in path.parents:
        raise DataError(f"{place}/trial.json names {name!r}, which lies outside of its folder.")
    return path


def _read_events(value: Any, place: str) -> dict[str, float]:
    if value is None:
        return {}
    try:
        return {str(name): float(time_s) for name, time_s in value.items()}
    except (AttributeError, TypeError, ValueError) as error:
        raise DataError(
            f"events_s of {place}/trial.json must hold names and seconds, got {value!r}."
        ) from error


# --------------------------------------------------------------------------- text files


def _read_json(path: Path, *, keys: Sequence[str] | None = None) -> dict[str, Any]:
    """Return the table of a file, empty where there is none."""
    if not path.is_file():
        return {}
    place = f"{path.parent.name}/{path.name}"
    if path.stat().st_size > MAX_JSON_BYTES:
        raise DataError(f"{place} is too large for what it should hold; {LAYOUT}.")
    try:
        table = json.loads(path.read_text(encoding="utf-8"))
    except (ValueError, OSError) as error:
        raise DataError(f"{place} is no JSON file that can be read ({error}).") from error
    if not isinstance(table, dict):
        raise DataError(f"{place} must hold a JSON object, got {type(table).__name__}; {LAYOUT}.")
    return table if keys is None else {key: table[key] for key in keys if key in table}


def _optional_number(facts: Mapping[str, Any], key: str, folder: Path) -> float | None:
    value = facts.get(key)
    if value is None:
        return None
    try:
        return float(value)
    except (TypeError, ValueError) as error:
        raise DataError(f"{key} of {folder.name} must be a number, got {value!r}.") from error


def _whole_number(value: Any, key: str, place: str) -> int:
    try:
        return int(value)
    except (TypeError, ValueError) as error:
        raise DataError(f"The {key} of {place} must be a whole number, got {value!r}.") from error
