"""The bundled samples: `sample_data/samples.toml` says what they are."""

from __future__ import annotations

import tomllib
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import engine
from engine.cli_settings import AssessSettings
from engine.config import Config, TwoViewConfig, build_section
from engine.datatypes import Subject, Task, Trial, View, parse_coupling
from engine.errors import BackendUnavailable, ConfigError

__all__ = ["SAMPLES_SITE", "SAMPLE_FOLDER", "Sample", "read_samples"]

SAMPLE_FOLDER = Path(engine.__file__).parents[1] / "sample_data"
LIST_NAME = "samples.toml"
SAMPLES_SITE = "Samples"
"""Where assessed samples are filed, so that nobody takes them for work at a site of theirs."""

SUBJECT_KEYS = ("stature_m", "mass_kg", "sex", "age_y")
TASK_KEYS = (
    "load_kg",
    "hands",
    "coupling",
    "frequency_per_min",
    "duration_h",
    "recovery_h",
    "destination_control",
    "notes",
)


class SamplesMissing(BackendUnavailable):
    """The bundled samples are not there."""


@dataclass(frozen=True)
class Sample:
    """One bundled clip with what is known about it."""

    key: str
    title: str
    video: Path
    subject: Subject
    task: Task
    licence: str = ""
    site: str = SAMPLES_SITE
    job: str = ""
    second_video: Path | None = None
    calibration: Path | None = None

    @property
    def trial_id(self) -> str:
        """The sample's id in the library."""
        return f"sample-{self.key}"

    def settings(self, *, is_quiet: bool) -> AssessSettings:
        """Return what an assessment needs, with default settings."""
        videos = [video for video in (self.video, self.second_video) if video]
        trial = Trial(
            views=tuple(View(video) for video in videos),
            subject=self.subject,
            task=self.task,
            label=self.title,
            site=self.site,
            job=self.job,
        )
        cameras = "" if self.calibration is None else str(self.calibration)
        config = Config(two_view=TwoViewConfig(calibration=cameras))
        return AssessSettings(trial=trial, config=config, out=Path(), is_quiet=is_quiet)

    @property
    def files(self) -> tuple[Path, ...]:
        """Every file the sample needs."""
        wanted = (self.video, self.second_video, self.calibration)
        return tuple(path for path in wanted if path is not None)


def read_samples(folder: Path | None = None) -> tuple[Sample, ...]:
    """Read the list of bundled samples.

    Raises
    ------
    SamplesMissing
        If the folder or a clip is not there (exit code 4).
    ConfigError
        If the list is not as expected.
    """
    folder = SAMPLE_FOLDER if folder is None else folder
    path = folder / LIST_NAME
    if not path.is_file():
        raise SamplesMissing(
            f"The demo needs the bundled samples, but {path} is not there; run it from a clone of "
            "the project, or assess a video of your own with `liftlens assess VIDEO`."
        )
    try:
        entries = tomllib.loads(path.read_text(encoding="utf-8"))["sample"]
        samples = tuple(_build_sample(folder, entry) for entry in entries)
    except (tomllib.TOMLDecodeError, UnicodeDecodeError, KeyError, TypeError) as error:
        raise ConfigError(f"{path} is not a list of samples ({error!r}); restore it.") from error
    for sample in samples:
        for path in sample.files:
            if not path.is_file():
                raise SamplesMissing(
                    f"The sample {sample.key!r} needs {path}, which is not there; get a whole "
                    "clone of the project."
                )
    return samples


def _build_sample(folder: Path, entry: dict[str, Any]) -> Sample:
    task = {key: entry[key] for key in TASK_KEYS if key in entry}
    if "coupling" in task:
        task["coupling"] = parse_coupling(task["coupling"])
    subject = {key: entry[key] for key in SUBJECT_KEYS if key in entry}
    return Sample(
        key=entry["key"],
        title=entry["title"],
        video=folder / entry["file"],
        subject=build_section(
            "sample", Subject, {"label": entry.get("subject", entry["key"]), **subject}
        ),
        second_video=folder / entry["second_file"] if "second_file" in entry else None,
        calibration=folder / entry["calibration"] if "calibration" in entry else None,
        task=build_section("sample", Task, task),
        licence=entry.get("licence", ""),
        site=entry.get("site", SAMPLES_SITE),
        job=entry.get("job", ""),
    )
