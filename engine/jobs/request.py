"""What a job is asked to do, and how that is kept on disk."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from engine.config import Config, build_config
from engine.corrections import NO_CORRECTIONS, Corrections
from engine.datatypes import Subject, Task, Trial, View
from engine.errors import ConfigError, DataError

__all__ = ["REQUEST_VERSION", "JobRequest"]

REQUEST_VERSION = 3
"""Raised with every field that changes what an assessment gives; 1 had no number yet, 2 no
corrections."""


@dataclass(frozen=True, eq=False)
class JobRequest:
    """One assessment to run.

    `config` holds nested tables as in a configuration file; what is left out keeps its default.
    `corrections` are what a person saw otherwise. Where `trial_id` names a trial of the library,
    that one is assessed anew, with its own settings, from the result with the fingerprint
    `based_on`; `videos` are then only needed to follow another person.
    """

    videos: tuple[Path, ...]
    subject: Subject = field(default_factory=Subject)
    task: Task = field(default_factory=Task)
    config: Mapping[str, Any] = field(default_factory=dict)
    label: str = ""
    site: str = ""
    job: str = ""
    corrections: Corrections = NO_CORRECTIONS
    trial_id: str = ""
    based_on: str = ""

    @property
    def trial(self) -> Trial:
        """The trial to assess."""
        return Trial(
            views=tuple(View(path) for path in self.videos),
            subject=self.subject,
            task=self.task,
            label=self.label,
            site=self.site,
            job=self.job,
        )

    @property
    def settings(self) -> Config:
        """The complete configuration."""
        return build_config(dict(self.config))

    def as_json(self) -> str:
        """Return the request as text."""
        plain = {f.name: getattr(self, f.name) for f in dataclasses.fields(self)}
        plain["version"] = REQUEST_VERSION
        plain["videos"] = [str(Path(v).resolve()) for v in self.videos]
        plain["subject"] = dataclasses.asdict(self.subject)
        plain["task"] = dataclasses.asdict(self.task)
        plain["config"] = dict(self.config)
        plain["corrections"] = self.corrections.as_plain()
        return json.dumps(plain, indent=1)

    @classmethod
    def from_json(cls, text: str) -> JobRequest:
        """Rebuild a request.

        Raises
        ------
        ConfigError
            If the text is no request, holds values that can't be right, or was written by a
            program that knows settings this one would silently leave out.
        """
        try:
            plain = json.loads(text)
            _check_version(int(plain.pop("version", 1)))
            return cls(
                videos=tuple(Path(v) for v in plain.pop("videos")),
                subject=Subject(**plain.pop("subject")),
                task=Task(**plain.pop("task")),
                corrections=Corrections.from_plain(plain.pop("corrections", {})),
                **plain,
            )
        except (ValueError, TypeError, KeyError, AttributeError) as error:
            if isinstance(error, ConfigError | DataError):
                raise
            raise ConfigError(
                f"The job's request can't be read ({error}); start the assessment again."
            ) from error


def _check_version(version: int) -> None:
    if version > REQUEST_VERSION:
        raise ConfigError(
            f"The job was asked for by a newer LiftLens (version {version} of a request, this "
            f"program reads up to {REQUEST_VERSION}); update LiftLens, or start it again here."
        )
