"""What the user of a library has chosen: units, language, how long data is kept, methods.

Kept as `preferences.toml` in the library's folder, so that a copy of the folder keeps them and
every program that opens it agrees.
"""

from __future__ import annotations

import dataclasses
import tomllib
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

from engine.errors import ConfigError
from engine.storage.atomic import explain_os_errors, write_aside

__all__ = [
    "LANGUAGES",
    "PAPERS",
    "PREFERENCES_NAME",
    "SOLVERS",
    "UNITS",
    "Preferences",
    "read_preferences",
    "write_preferences",
]

PREFERENCES_NAME = "preferences.toml"
UNITS = ("metric", "us")
LANGUAGES = ("en",)
PAPERS = ("a4", "letter")
SOLVERS = ("geometric", "least-squares")
MAX_DAYS = 36_500


@dataclass(frozen=True)
class Preferences:
    """The choices; their defaults hold where nothing was chosen.

    Parameters
    ----------
    units
        `metric`, or `us`: pounds and inches stand beside every weight and length.
    language
        Of the dashboard and of reports.
    paper
        Of reports: `a4` or `letter`.
    keep_days
        Trials older than this are offered for deletion; None keeps them until somebody deletes.
    solver
        What new assessments turn keypoints into joint angles with.
    experimental_methods
        Whether methods that were not checked against their publication run too.

    Raises
    ------
    ConfigError
        If a value is none of those.
    """

    units: str = "metric"
    language: str = "en"
    paper: str = "a4"
    keep_days: int | None = None
    solver: str = "geometric"
    experimental_methods: bool = False

    def __post_init__(self) -> None:
        for name, known in (
            ("units", UNITS),
            ("language", LANGUAGES),
            ("paper", PAPERS),
            ("solver", SOLVERS),
        ):
            if getattr(self, name) not in known:
                raise ConfigError(
                    f"The preference {name} must be {' or '.join(known)}, "
                    f"got {getattr(self, name)!r}."
                )
        days = self.keep_days
        if days is not None and (type(days) is not int or not 1 <= days <= MAX_DAYS):
            raise ConfigError(
                f"The preference keep_days must be a whole number from 1 to {MAX_DAYS}, "
                f"got {days!r}; leave it out to keep everything."
            )
        if type(self.experimental_methods) is not bool:
            raise ConfigError(
                "The preference experimental_methods must be true or false, "
                f"got {self.experimental_methods!r}."
            )

    @property
    def assessment(self) -> dict[str, Any]:
        """What the choices mean for a new assessment, as tables of its configuration."""
        return {
            "kinematics": {"solver": self.solver},
            "risk": {"experimental": self.experimental_methods},
        }


def read_preferences(root: Path) -> Preferences:
    """Return what was chosen for the library at `root`; the defaults where nothing was.

    Raises
    ------
    ConfigError
        If the file is damaged, or holds what this program does not know.
    """
    path = root / PREFERENCES_NAME
    try:
        values = tomllib.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        return Preferences()
    except (OSError, UnicodeDecodeError, tomllib.TOMLDecodeError) as error:
        raise ConfigError(f"{path} can't be read ({error}); correct or delete it.") from error
    known = {field.name for field in fields(Preferences)}
    if unknown := sorted(set(values) - known):
        raise ConfigError(
            f"{path} has the unknown preference {unknown[0]!r}; known: {', '.join(sorted(known))}."
        )
    return Preferences(**values)


def write_preferences(preferences: Preferences, root: Path) -> Path:
    """Keep what was chosen for the library at `root`; return the file.

    Raises
    ------
    OutputError
        If it can't be written.
    """
    path = root / PREFERENCES_NAME
    lines = (
        f"{name} = {_as_toml(value)}"
        for name, value in dataclasses.asdict(preferences).items()
        if value is not None
    )
    with explain_os_errors(path, "The preferences"), write_aside(path) as aside:
        aside.write_text("\n".join(lines) + "\n", encoding="utf-8")
    return path


def _as_toml(value: str | int | bool) -> str:
    if isinstance(value, bool):
        return "true" if value else "false"
    return str(value) if isinstance(value, int) else f'"{value}"'
