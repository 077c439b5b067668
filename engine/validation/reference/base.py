"""What a reference recording is, before and after it was understood.

A reader turns a file into a `Recording`: numbers and names exactly as the file has them.
`engine.validation.reference.interpret` turns that into a `Reference`: metres, Y up, angles in our
convention, with a `Finding` for everything that was worked out rather than read.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from engine.datatypes import Array, JointAngles, frozen_array
from engine.errors import DataError, ShapeError

__all__ = ["AngleUnit", "Finding", "LengthUnit", "Markers", "Recording", "Reference"]

LengthUnit = Literal["m", "cm", "mm"]
AngleUnit = Literal["deg", "rad"]

SURE = 0.8
"""From this score on a finding needs no confirmation."""


@dataclass(frozen=True)
class Finding:
    """Something worked out about a recording, for a person to confirm.

    `score` runs from 0 (a guess) to 1 (stated by the file, or beyond doubt); `why` names the
    evidence.
    """

    what: str
    value: str
    score: float
    why: str

    @property
    def is_sure(self) -> bool:
        """Whether nobody needs to confirm it."""
        return self.score >= SURE


@dataclass(frozen=True, eq=False)
class _Frozen:
    """Keeps arrays read-only through pickling, which forgets the flag."""

    def __setstate__(self, state: dict[str, Any]) -> None:
        for name, value in state.items():
            if isinstance(value, np.ndarray):
                value.setflags(write=False)
            object.__setattr__(self, name, value)

    def _freeze(self, name: str) -> NDArray[Any]:
        array = frozen_array(getattr(self, name))
        object.__setattr__(self, name, array)
        return array


@dataclass(frozen=True, eq=False)
class Recording(_Frozen):
    """The content of a file: nothing converted, nothing guessed.

    Parameters
    ----------
    name, format
        File name; `trc`, `c3d`, `mot`, `vicon-csv` or `csv`.
    time_s
        Shape (T,), increasing.
    labels, position
        Marker names and shape (T, M, 3), in the file's unit and axes; NaN where missing.
    curves, value
        Names of other columns and shape (T, C), in the file's unit; NaN where missing.
    sigma
        Shape (T, C), the standard errors the file states; NaN where it states none.
    length_unit, angle_unit
        As stated; None where the file is silent.
    notes
        What was odd, in words.
    """

    name: str
    format: str
    time_s: Array
    labels: tuple[str, ...] = ()
    position: Array = field(default_factory=lambda: np.empty((0, 0, 3)))
    curves: tuple[str, ...] = ()
    value: Array = field(default_factory=lambda: np.empty((0, 0)))
    sigma: Array | None = None
    length_unit: LengthUnit | None = None
    angle_unit: AngleUnit | None = None
    notes: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        frames = self._freeze("time_s").shape[0]
        for name, shape in (
            ("position", (frames, len(self.labels), 3)),
            ("value", (frames, len(self.curves))),
        ):
            array = self._freeze(name)
            if array.shape == (0, *shape[1:]):
                array = frozen_array(np.full(shape, np.nan))
                object.__setattr__(self, name, array)
            if array.shape != shape:
                raise ShapeError(f"{name} needs shape {shape}, got {array.shape}.")
        if self.sigma is None:
            object.__setattr__(self, "sigma", np.full(self.value.shape, np.nan))
        if self._freeze("sigma").shape != self.value.shape:
            raise ShapeError("sigma needs the shape of value.")


@dataclass(frozen=True, eq=False)
class Markers(_Frozen):
    """Marker trajectories: `position` (T, M, 3) in metres, Y up; NaN where missing."""

    time_s: Array
    position: Array
    labels: tuple[str, ...]

    def __post_init__(self) -> None:
        shape = (self._freeze("time_s").shape[0], len(self.labels), 3)
        if self._freeze("position").shape != shape:
            raise ShapeError(f"position needs shape {shape}, got {self.position.shape}.")

    def __getitem__(self, label: str) -> Array:
        """Return one marker over time, shape (T, 3), m."""
        if label not in self.labels:
            raise DataError(f"There is no marker {label!r} here; known: {', '.join(self.labels)}.")
        return self.position[:, self.labels.index(label)]

    @property
    def rate_hz(self) -> float:
        """Frames per second: the reciprocal of the median interval; NaN for a single frame."""
        return float(1.0 / np.median(np.diff(self.time_s))) if self.time_s.size > 1 else np.nan


@dataclass(frozen=True, eq=False)
class Reference:
    """A recording in our units, axes, names and signs.

    Parameters
    ----------
    name, format
        File name and format.
    markers
        The trajectories under the file's own labels; None if the file has none.
    angles
        In our convention; None if the file has none.
    landmarks
        Anatomical landmark, such as `left_asis` or `right_knee` (a joint centre), to the label of
        its marker.
    findings
        Unit, axes, names, signs: what was found out and how sure it is.
    notes
        What to know before trusting the recording, in words.
    settings
        What was applied, in the keys of an import profile: enough to read the file alike again.
    """

    name: str
    format: str
    markers: Markers | None
    angles: JointAngles | None
    landmarks: Mapping[str, str] = field(default_factory=dict)
    findings: tuple[Finding, ...] = ()
    notes: tuple[str, ...] = ()
    settings: Mapping[str, Any] = field(default_factory=dict)

    @property
    def to_confirm(self) -> tuple[Finding, ...]:
        """What a person should confirm before the comparison counts."""
        return tuple(finding for finding in self.findings if not finding.is_sure)

    def finding(self, what: str) -> Finding | None:
        """Return the finding about `what`, if there is one."""
        return next((f for f in self.findings if f.what == what), None)

    @property
    def are_sides_swapped(self) -> bool:
        """Whether left and right look exchanged, judged by the way the body faces."""
        sides = self.finding("sides")
        return sides is not None and sides.value == "swapped"
