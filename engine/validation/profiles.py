"""Import profiles: what a laboratory's recordings mean, confirmed once and kept as TOML.

::

    name = "Gait laboratory"
    format = "trc"
    length_unit = "mm"
    angle_unit = "deg"
    # The file's axes that point to the subject's front, up, and to the subject's right.
    axes = ["x", "z", "-y"]
    swap_sides = false

    [labels]                      # label in the file = landmark
    "LKN_outer" = "left_lateral_knee"

    [angles]                      # our angle = column in the file, and ours = sign * theirs
    knee_flexion_l = { column = "KneeL", sign = -1 }

Every key may be left out; what is left out is detected.
"""

from __future__ import annotations

import json
import tomllib
from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any, get_args

from engine.errors import ConfigError
from engine.validation.reference.angle_names import OUR_ANGLES
from engine.validation.reference.base import AngleUnit, LengthUnit
from engine.validation.reference.naming import LANDMARKS

__all__ = [
    "AngleRule",
    "Axes",
    "ImportProfile",
    "format_profile",
    "parse_axes",
    "parse_profile",
    "read_profile",
]

Axes = tuple[str, str, str]
FORMATS = ("trc", "c3d", "mot", "vicon-csv", "csv")


@dataclass(frozen=True)
class AngleRule:
    """Where an angle comes from: ``ours = sign * column``."""

    column: str
    sign: int = 1


@dataclass(frozen=True)
class ImportProfile:
    """What is known of a kind of recording; None or empty where it is to be detected.

    `axes` are the file's axes that point to the subject's front, up and to the right, such as
    ``("x", "z", "-y")`` for a laboratory with Z up. `labels` maps labels to landmarks, `angles` our
    angles to columns. `swap_sides` exchanges left and right in all names.
    """

    name: str = ""
    format: str | None = None
    length_unit: LengthUnit | None = None
    angle_unit: AngleUnit | None = None
    axes: Axes | None = None
    swap_sides: bool = False
    labels: Mapping[str, str] = field(default_factory=dict)
    angles: Mapping[str, AngleRule] = field(default_factory=dict)

    def __post_init__(self) -> None:
        _require_choice("format", self.format, FORMATS)
        _require_choice("length_unit", self.length_unit, get_args(LengthUnit))
        _require_choice("angle_unit", self.angle_unit, get_args(AngleUnit))
        if self.axes is not None:
            parse_axes(self.axes)
        for label, landmark in self.labels.items():
            if landmark not in LANDMARKS:
                raise ConfigError(
                    f"Label {label!r} is mapped to {landmark!r}, which is no landmark; use names "
                    "such as left_asis, left_lateral_knee or left_knee (the joint centre)."
                )
        for angle, rule in self.angles.items():
            if angle not in OUR_ANGLES:
                raise ConfigError(f"There is no angle {angle!r}; known: {', '.join(OUR_ANGLES)}.")
            if rule.sign not in (-1, 1):
                raise ConfigError(f"The sign of {angle} must be 1 or -1, got {rule.sign!r}.")


def _require_choice(key: str, value: str | None, choices: tuple[str, ...]) -> None:
    if value is not None and value not in choices:
        raise ConfigError(f"{key} must be one of {', '.join(choices)}, got {value!r}.")


def parse_axes(axes: Axes) -> tuple[tuple[int, int], ...]:
    """Turn axis names into (column, sign) of our X, Y and Z.

    Raises
    ------
    ConfigError
        If they are not three different axes, or would mirror the body.
    """
    parsed = []
    for axis in axes:
        letter = str(axis).lower().lstrip("+-")
        if letter not in ("x", "y", "z"):
            raise ConfigError(f"An axis is x, y or z with an optional minus, got {axis!r}.")
        parsed.append(("xyz".index(letter), -1 if str(axis).startswith("-") else 1))
    columns = [column for column, _ in parsed]
    if sorted(columns) != [0, 1, 2]:
        raise ConfigError(f"axes needs x, y and z once each, got {', '.join(axes)}.")
    is_even = columns in ([0, 1, 2], [1, 2, 0], [2, 0, 1])
    if (1 if is_even else -1) * parsed[0][1] * parsed[1][1] * parsed[2][1] < 0:
        raise ConfigError(
            f"axes = {', '.join(axes)} would mirror left and right: front, up and right must be "
            "right-handed. Change the sign of one axis."
        )
    return tuple(parsed)


def read_profile(path: Path) -> ImportProfile:
    """Read an import profile.

    Raises
    ------
    ConfigError
        If the file is missing, no TOML, or holds unknown keys or values.
    """
    try:
        text = path.read_text(encoding="utf-8")
    except OSError as error:
        raise ConfigError(f"The import profile {path} can't be read: {error.strerror}.") from error
    except UnicodeDecodeError:
        raise ConfigError(f"The import profile {path} is no text; write it as TOML.") from None
    return parse_profile(text, source=path.name)


def parse_profile(text: str, *, source: str = "the profile") -> ImportProfile:
    """Turn TOML text into a profile.

    Raises
    ------
    ConfigError
        If the text is no TOML, or holds unknown keys or values.
    """
    try:
        values = tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        raise ConfigError(f"{source} is no valid TOML: {error}.") from error
    known = {f.name for f in fields(ImportProfile)}
    unknown = sorted(set(values) - known)
    if unknown:
        raise ConfigError(
            f"{source} has the unknown key {unknown[0]!r}; known: {', '.join(sorted(known))}."
        )
    return _build_profile(values, source)


def _build_profile(values: Mapping[str, Any], source: str) -> ImportProfile:
    given = dict(values)
    if "axes" in given:
        axes = given["axes"]
        if not isinstance(axes, list) or len(axes) != 3:
            raise ConfigError(f"{source}: axes needs three entries such as ['x', 'z', '-y'].")
        given["axes"] = (str(axes[0]), str(axes[1]), str(axes[2]))
    for table in ("labels", "angles"):
        if not isinstance(given.get(table, {}), dict):
            raise ConfigError(f"{source}: [{table}] must be a table of names.")
    rules = {}
    for angle, rule in given.get("angles", {}).items():
        if isinstance(rule, str):
            rules[angle] = AngleRule(rule)
        elif isinstance(rule, dict) and set(rule) <= {"column", "sign"} and "column" in rule:
            rules[angle] = AngleRule(str(rule["column"]), rule.get("sign", 1))
        else:
            raise ConfigError(f"{source}: {angle} needs {{ column = '...', sign = 1 or -1 }}.")
    given["angles"] = rules
    if not isinstance(given.get("swap_sides", False), bool):
        raise ConfigError(f"{source}: swap_sides must be true or false.")
    return ImportProfile(**given)


def format_profile(profile: ImportProfile) -> str:
    """Write a profile as TOML text; `parse_profile` reads it back."""
    lines = []
    for key in ("name", "format", "length_unit", "angle_unit"):
        value = getattr(profile, key)
        if value:
            lines.append(f"{key} = {_quote(value)}")
    if profile.axes is not None:
        lines.append("# The file's axes that point to the subject's front, up, and to the right.")
        lines.append(f"axes = [{', '.join(map(_quote, profile.axes))}]")
    lines.append(f"swap_sides = {str(profile.swap_sides).lower()}")
    if profile.labels:
        lines += ["", "[labels]"]
        lines += [f"{_quote(k)} = {_quote(v)}" for k, v in profile.labels.items()]
    if profile.angles:
        lines += ["", "[angles]"]
        lines += [
            f"{k} = {{ column = {_quote(v.column)}, sign = {v.sign} }}"
            for k, v in profile.angles.items()
        ]
    return "\n".join(lines) + "\n"


def _quote(text: str) -> str:
    # JSON strings are TOML basic strings, but for DEL, which TOML wants escaped.
    return json.dumps(text, ensure_ascii=False).replace("\x7f", "\\u007f")
