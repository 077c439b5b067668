"""What a risk method is, and how methods are found.

A method is one file in `engine/ergonomics/methods/` with a `METHOD` object; the folder
is listed, so nothing else is edited to add one.
"""

from __future__ import annotations

import importlib
import pkgutil
from dataclasses import dataclass
from typing import Protocol

import engine.ergonomics.methods as methods_package
from engine.datatypes import JointAngles, Lift, PoseTrack, RiskResult, Subject, Task
from engine.errors import ConfigError

__all__ = ["Exposure", "MethodInfo", "RiskLevel", "RiskMethod", "list_methods", "select_methods"]


@dataclass(frozen=True)
class RiskLevel:
    """One level of a method: its name, up to which value it reaches, what it means, what to do."""

    name: str
    upper: float
    meaning: str
    action: str


@dataclass(frozen=True)
class MethodInfo:
    """What a user should know of a method.

    `verification` is `V2` (two independent sources agree), `V1` (single source) or `R`
    (not checked against the publication: experimental, off by default). `value_name` is what the
    headline number is called, `decimals` how many a reader should see (None: as many as its
    band needs). Flags need no action up to the first of `flag_limits` and are urgent above the
    second; without them these are the end of the first level and the begin of the last.
    """

    name: str
    title: str
    reference: str
    verification: str
    levels: tuple[RiskLevel, ...]
    required_angles: tuple[str, ...] = ()
    description: str = ""
    value_name: str = ""
    decimals: int | None = None
    flag_limits: tuple[float, float] | None = None

    @property
    def is_experimental(self) -> bool:
        """Whether the method runs only when experimental methods are switched on."""
        return self.verification == "R"


@dataclass(frozen=True, eq=False)
class Exposure:
    """What the methods judge: the movement that was measured and the work it belongs to.

    `observed_s` is how long the person was watched (s). `warnings` are
    conditions found by the measuring steps that touch validity (for example a walking
    person), each a stable key.
    """

    track: PoseTrack
    angles: JointAngles
    lifts: tuple[Lift, ...]
    subject: Subject
    task: Task
    observed_s: float
    conditions: tuple[str, ...] = ()


class RiskMethod(Protocol):
    """A risk method."""

    info: MethodInfo

    def assess(self, exposure: Exposure) -> RiskResult:
        """Judge the exposure; never raises for missing data, but says `not applicable`."""


def list_methods() -> tuple[RiskMethod, ...]:
    """Return every method that is installed, ordered by name."""
    names = sorted(m.name for m in pkgutil.iter_modules(methods_package.__path__))
    return tuple(
        importlib.import_module(f"{methods_package.__name__}.{name}").METHOD
        for name in names
        if not name.startswith("_")
    )


def select_methods(names: tuple[str, ...], *, experimental: bool = False) -> tuple[RiskMethod, ...]:
    """Return the methods asked for; with no names, all that may run.

    Raises
    ------
    ConfigError
        If a name is unknown, or experimental without the switch.
    """
    known = {m.info.name: m for m in list_methods()}
    unknown = [n for n in names if n not in known]
    if unknown:
        raise ConfigError(
            f"Unknown risk method {unknown[0]!r}; known: {', '.join(known)}. "
            "`liftlens methods` describes them."
        )
    chosen = [known[n] for n in names] or list(known.values())
    blocked = [m.info.name for m in chosen if m.info.is_experimental and not experimental]
    if names and blocked:
        raise ConfigError(
            f"The method {blocked[0]!r} is experimental; set risk.experimental = true to use it."
        )
    return tuple(m for m in chosen if m.info.name not in blocked)
