"""Words of the posture methods: what was seen, entered or assumed in one frame."""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np

from engine.datatypes import Coupling, Provenance, RiskInput
from engine.ergonomics.posture import SIDE_NAMES, THRESHOLDS, Posture, Signal

__all__ = [
    "describe_activity",
    "describe_coupling",
    "describe_legs",
    "describe_load",
    "describe_posture",
    "format_signal",
    "list_work",
    "name_source",
]


def format_signal(signal: Signal) -> str:
    """Return value and standard error of a signal in one frame."""
    value, sigma = float(signal.value[0]), float(signal.sigma[0])
    if math.isnan(value):
        return "not seen"
    factor, unit, digits = (100.0, "cm", 0) if signal.unit == "m" else (1.0, "deg", 0)
    error = "" if math.isnan(sigma) else f" ± {factor * sigma:.{digits}f}"
    return f"{factor * value + 0.0:.{digits}f}{error} {unit}"


def describe_posture(moment: Posture) -> str:
    """Say in a few words how a person stands in one frame."""
    values = {name: float(signal.value[0]) for name, signal in moment.signals.items()}
    bend = values["trunk_flexion"]
    words = [f"trunk {abs(bend):.0f} deg {'backward' if round(bend) < 0 else 'forward'}"]
    for name, limit, word in (
        ("trunk_twist", THRESHOLDS.twist_deg, "twisted"),
        ("trunk_lateral_bend", THRESHOLDS.side_bend_deg, "bent sideways"),
    ):
        if abs(values[name]) > limit:
            words.append(f"{word} {abs(values[name]):.0f} deg")
    knees = [values[f"knee_flexion_{side}"] for side in SIDE_NAMES]
    arms = [values[f"shoulder_flexion_{side}"] for side in SIDE_NAMES]
    if np.isfinite(knees).any() and np.nanmax(knees) > 30:
        words.append(f"knees {np.nanmax(knees):.0f} deg")
    if np.isfinite(arms).any() and np.nanmax(arms) > 45:
        words.append(f"upper arm {np.nanmax(arms):.0f} deg raised")
    if moment.has_load[0] and moment.task.load_kg:
        words.append(f"{moment.task.load_kg:g} kg in the hands")
    return ", ".join(words)


def name_source(shown: str) -> str:
    """Say whether a shown value was measured or stands for one that was not seen."""
    return " [assumed neutral]" if shown == "not seen" else " [measured]"


def list_work(posture: Posture) -> Iterator[RiskInput]:
    """Return load, grip and repetition with where they come from."""
    task, user, assumed = posture.task, Provenance.USER, Provenance.ASSUMED
    if task.load_kg is None:
        yield RiskInput("load", "not given: scored as light", "", assumed)
    else:
        yield RiskInput("load", task.load_kg, "kg", user)
    grip = task.coupling or Coupling.FAIR
    yield RiskInput("coupling", grip.value, "", assumed if task.coupling is None else user)
    if math.isnan(posture.repeated_per_min):
        yield RiskInput("repetition", "less than 4 per minute", "", assumed)
    else:
        source = Provenance.MEASURED if task.frequency_per_min is None else user
        yield RiskInput("repetition", posture.repeated_per_min, "1/min", source)


def describe_load(posture: Posture) -> str:
    """Say what is in the hands in one frame."""
    if not posture.has_load[0]:
        return "nothing in the hands"
    if posture.task.load_kg is None:
        return "load not given, scored as light [assumed]"
    return f"{posture.task.load_kg:g} kg [entered]"


def describe_coupling(posture: Posture) -> str:
    """Say how the load is held in one frame."""
    if not posture.has_load[0]:
        return "nothing in the hands"
    given = posture.task.coupling
    return "fair [assumed]" if given is None else f"{given.value} [entered]"


def describe_activity(posture: Posture) -> str:
    """Say what adds to the score by going on or coming back."""
    parts = []
    if posture.is_static[0]:
        parts.append("a part held still for over a minute [measured]")
    if posture.is_repeated:
        parts.append(f"repeated {posture.repeated_per_min:.3g} times a minute")
    return " and ".join(parts) or "no long hold, not repeated over 4 times a minute"


def describe_legs(posture: Posture) -> str:
    """Say how the legs stand in one frame."""
    if posture.is_seated[0]:
        return "seated [measured]"
    knees = ", ".join(
        f"{SIDE_NAMES[side]} knee {format_signal(posture.signals[f'knee_flexion_{side}'])}"
        for side in SIDE_NAMES
    )
    ankles = format_signal(posture.signals["ankle_difference"])
    state = "walking, " if posture.is_walking[0] else ""
    return f"{state}{knees}, left ankle {ankles} above the right"
