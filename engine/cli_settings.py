"""Options and the configuration file become one set of settings; options win."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

from engine.config import Config, build_config, build_section, read_config
from engine.corrections import CONFIG_TABLE, NO_CORRECTIONS, Corrections, Span
from engine.datatypes import Subject, Task, Trial, View, parse_coupling
from engine.errors import ConfigError

__all__ = ["OPTION_KEYS", "AssessSettings", "build_settings"]

OPTION_KEYS: Mapping[str, tuple[str, str]] = {
    "stature": ("person", "stature_m"),
    "mass": ("person", "mass_kg"),
    "sex": ("person", "sex"),
    "age": ("person", "age_y"),
    "load": ("task", "load_kg"),
    "hands": ("task", "hands"),
    "coupling": ("task", "coupling"),
    "frequency": ("task", "frequency_per_min"),
    "duration": ("task", "duration_h"),
    "recovery": ("task", "recovery_h"),
    "destination_control": ("task", "destination_control"),
    "label": ("trial", "label"),
    "calibration": ("two_view", "calibration"),
    "fusion": ("two_view", "fusion"),
    "sync": ("two_view", "sync"),
    "model": ("pose", "model"),
    "backend": ("pose", "backend"),
    "solver": ("kinematics", "solver"),
    "correction": ("correction", "preset"),
    "methods": ("risk", "methods"),
    "start": ("video", "start_s"),
    "stop": ("video", "stop_s"),
    "box": ("subject", "box"),
    "lift": (CONFIG_TABLE, "lifts"),
    "overlay": ("output", "overlay"),
    "blur": ("output", "blur_heads"),
    "surface": ("output", "surface"),
    "out": ("run", "out"),
    "quiet": ("run", "quiet"),
}
"""Where each option of `assess` stands in a configuration file: table and key."""

TWO_VIEW_OPTIONS = ("calibration", "fusion", "sync")
"""Options that say nothing of a single video."""


@dataclass(frozen=True)
class _TrialTable:
    """The table [trial]: what the trial is called and where it belongs."""

    label: str = ""
    site: str = ""
    job: str = ""


@dataclass(frozen=True)
class _RunTable:
    """The table [run]: what concerns this run only and is not stored."""

    out: str = ""
    quiet: bool = False


@dataclass(frozen=True)
class _CorrectionsTable:
    """The table [corrections]: the lifts of the video, start and end in s, and no others."""

    lifts: tuple[Span, ...] = ()


@dataclass(frozen=True)
class AssessSettings:
    """All that one `assess` needs."""

    trial: Trial
    config: Config
    out: Path
    is_quiet: bool
    corrections: Corrections = NO_CORRECTIONS


OWN_TABLES: Mapping[str, type[Any]] = {
    "person": Subject,
    "task": Task,
    "trial": _TrialTable,
    CONFIG_TABLE: _CorrectionsTable,
    "run": _RunTable,
}


def build_settings(
    video: Path,
    *,
    second_video: Path | None = None,
    config_path: Path | None = None,
    options: Mapping[str, Any] | None = None,
) -> AssessSettings:
    """Join a configuration file and options.

    Parameters
    ----------
    video, second_video
        The video, and a second one of the same movement from another side.
    config_path
        A TOML file.
    options
        Values by the names in `OPTION_KEYS`; None means not given.

    Raises
    ------
    ConfigError
        If anything is unknown, of the wrong type or out of range.
    """
    videos = (video,) if second_video is None else (video, second_video)
    _check_videos(videos)
    tables = {} if config_path is None else read_config(config_path)
    _check_tables(tables)
    for name, value in (options or {}).items():
        if value is not None:
            if name in TWO_VIEW_OPTIONS and second_video is None:
                raise ConfigError(
                    f"--{name} is for two videos of one movement, but only {video.name} is given; "
                    "name the second video after it, or leave the option out."
                )
            table, key = OPTION_KEYS[name]
            tables[table] = {**tables.get(table, {}), key: _as_setting(name, value)}
    own = {name: build_section(name, kind, _own_table(tables, name)) for name, kind in _own()}
    config = build_config({k: v for k, v in tables.items() if k not in OWN_TABLES})
    about, run = own["trial"], own["run"]
    return AssessSettings(
        trial=Trial(
            views=tuple(View(path) for path in videos),
            subject=own["person"],
            task=own["task"],
            label=about.label or video.stem,
            site=about.site,
            job=about.job,
        ),
        config=config,
        out=Path(run.out) if run.out else Path(f"liftlens_{video.stem}"),
        is_quiet=run.quiet,
        corrections=Corrections.of_lifts(own[CONFIG_TABLE].lifts),
    )


def _own() -> list[tuple[str, type[Any]]]:
    return list(OWN_TABLES.items())


def _check_videos(videos: tuple[Path, ...]) -> None:
    for video in videos:
        if not video.is_file():
            what = "is a folder" if video.is_dir() else "does not exist"
            raise ConfigError(f"Expected a video file, but {video} {what}; check the path.")
    if len(videos) == 2 and videos[0].samefile(videos[1]):
        raise ConfigError(
            f"Expected two videos from different sides, but both are {videos[0].name}; name the "
            "other camera's video, or give one video only."
        )


def _check_tables(tables: Mapping[str, Any]) -> None:
    known = [*OWN_TABLES, *(f.name for f in fields(Config))]
    for name, table in tables.items():
        if not isinstance(table, dict):
            raise ConfigError(
                f"{name!r} stands outside every table; put it below one of {', '.join(known)}."
            )
        if name not in known:
            raise ConfigError(
                f"Unknown table [{name}] in the configuration; known: {', '.join(known)}."
            )


def _own_table(tables: Mapping[str, Any], name: str) -> dict[str, Any]:
    table = dict(tables.get(name, {}))
    if name == "task" and "coupling" in table:
        table["coupling"] = parse_coupling(table["coupling"])
    return table


def _as_setting(name: str, value: Any) -> Any:
    """Return an option's value as a configuration file would hold it."""
    if name == "methods":
        return [part.strip() for part in str(value).split(",") if part.strip()]
    if name == "box":
        return _parse_numbers("--box", str(value), BOX_FORMAT)
    if name == "lift":
        return [_parse_numbers("--lift", str(text), LIFT_FORMAT) for text in value]
    return str(value) if isinstance(value, Path) else value


BOX_FORMAT = (4, "four numbers, left,top,right,bottom in px (120,80,420,700)")
LIFT_FORMAT = (2, "two numbers, start,end in s (2.1,3.4)")


def _parse_numbers(option: str, text: str, wanted: tuple[int, str]) -> list[float]:
    """Return the numbers of an option of so many, separated by commas."""
    count, description = wanted
    try:
        numbers = [float(part) for part in text.split(",")]
    except ValueError:
        numbers = []
    if len(numbers) != count:
        raise ConfigError(f"{option} needs {description}, got {text!r}.")
    return numbers
