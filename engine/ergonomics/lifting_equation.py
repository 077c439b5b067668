"""The Revised NIOSH Lifting Equation as plain functions.

Centimetres, kilograms, degrees and lifts per minute. Nothing here knows about videos.
No intermediate value is rounded.

References
----------
.. [1] Waters, Putz-Anderson, Garg & Fine (1993), Ergonomics 36(7), 749-776.
.. [2] Waters, Putz-Anderson & Garg (1994, revised 2021), Applications Manual for the Revised
   NIOSH Lifting Equation, DHHS (NIOSH) Publication 94-110.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterable
from dataclasses import dataclass, replace
from enum import StrEnum

import numpy as np
from numpy.typing import ArrayLike

from engine.datatypes import Array, Coupling
from engine.errors import DataError

__all__ = [
    "METRIC",
    "US_CUSTOMARY",
    "Constants",
    "Duration",
    "LiftCase",
    "LiftPoint",
    "Rwl",
    "compute_asymmetry_multiplier",
    "compute_case",
    "compute_coupling_multiplier",
    "compute_distance_multiplier",
    "compute_frequency_multiplier",
    "compute_horizontal_multiplier",
    "compute_lifting_index",
    "compute_rwl",
    "compute_rwl_array",
    "compute_vertical_multiplier",
    "find_duration",
]


class Duration(StrEnum):
    """Duration class of the lifting work."""

    SHORT = "short"
    MODERATE = "moderate"
    LONG = "long"


@dataclass(frozen=True)
class Constants:
    """The constants of one unit system ([2], section 1.3, and table 1)."""

    load_constant: float
    h_min: float
    h_max: float
    v_best: float
    v_slope: float
    v_max: float
    d_min: float
    d_max: float
    d_offset: float
    d_scale: float


METRIC = Constants(
    load_constant=23.0,
    h_min=25.0,
    h_max=63.0,
    v_best=75.0,
    v_slope=0.003,
    v_max=175.0,
    d_min=25.0,
    d_max=175.0,
    d_offset=0.82,
    d_scale=4.5,
)
"""Centimetres and kilograms: what the product computes with."""

US_CUSTOMARY = Constants(
    load_constant=51.0,
    h_min=10.0,
    h_max=25.0,
    v_best=30.0,
    v_slope=0.0075,
    v_max=70.0,
    d_min=10.0,
    d_max=70.0,
    d_offset=0.82,
    d_scale=1.8,
)
"""Inches and pounds, only to reproduce published examples: no exact conversion of `METRIC`."""

A_SLOPE = 0.0032
A_MAX_DEG = 135.0

# Frequency multiplier, [2] table 5. Lifts per minute, then for each duration class the
# multiplier below and from the knuckle height of 75 cm.
FREQUENCY_TABLE: tuple[tuple[float, tuple[float, ...]], ...] = (
    #      short       moderate    long
    (0.2, (1.00, 1.00, 0.95, 0.95, 0.85, 0.85)),
    (0.5, (0.97, 0.97, 0.92, 0.92, 0.81, 0.81)),
    (1.0, (0.94, 0.94, 0.88, 0.88, 0.75, 0.75)),
    (2.0, (0.91, 0.91, 0.84, 0.84, 0.65, 0.65)),
    (3.0, (0.88, 0.88, 0.79, 0.79, 0.55, 0.55)),
    (4.0, (0.84, 0.84, 0.72, 0.72, 0.45, 0.45)),
    (5.0, (0.80, 0.80, 0.60, 0.60, 0.35, 0.35)),
    (6.0, (0.75, 0.75, 0.50, 0.50, 0.27, 0.27)),
    (7.0, (0.70, 0.70, 0.42, 0.42, 0.22, 0.22)),
    (8.0, (0.60, 0.60, 0.35, 0.35, 0.18, 0.18)),
    (9.0, (0.52, 0.52, 0.30, 0.30, 0.00, 0.15)),
    (10.0, (0.45, 0.45, 0.26, 0.26, 0.00, 0.13)),
    (11.0, (0.41, 0.41, 0.00, 0.23, 0.00, 0.00)),
    (12.0, (0.37, 0.37, 0.00, 0.21, 0.00, 0.00)),
    (13.0, (0.00, 0.34, 0.00, 0.00, 0.00, 0.00)),
    (14.0, (0.00, 0.31, 0.00, 0.00, 0.00, 0.00)),
    (15.0, (0.00, 0.28, 0.00, 0.00, 0.00, 0.00)),
)
_FREQUENCY_COLUMN = {Duration.SHORT: 0, Duration.MODERATE: 2, Duration.LONG: 4}

# Coupling multiplier, [2] table 7: below and from 75 cm.
COUPLING_TABLE: dict[Coupling, tuple[float, float]] = {
    Coupling.GOOD: (1.00, 1.00),
    Coupling.FAIR: (0.95, 1.00),
    Coupling.POOR: (0.90, 0.90),
}

# Duration classes, [2] section 1.2: up to which work time (h), and how much recovery it needs, as a
# share of the work time. The 2021 revision lowered the first share from 1.2 to 1.0.
DURATION_TABLE: tuple[tuple[Duration, float, float], ...] = (
    (Duration.SHORT, 1.0, 1.0),
    (Duration.MODERATE, 2.0, 0.3),
    (Duration.LONG, 8.0, 0.0),
)
MAX_DURATION_H = 8.0
_TOLERANCE_H = 1e-9


@dataclass(frozen=True)
class Rwl:
    """The recommended weight limit at one point of a lift, with its multipliers.

    `zero_reasons` name every multiplier that is 0, with the limit that was passed.
    """

    HM: float
    VM: float
    DM: float
    AM: float
    FM: float
    CM: float
    RWL: float
    zero_reasons: tuple[str, ...] = ()


@dataclass(frozen=True)
class LiftPoint:
    """Where the hands are: horizontal distance and height in cm, asymmetry angle in degrees."""

    H_cm: float
    V_cm: float
    A_deg: float


@dataclass(frozen=True)
class LiftCase:
    """Everything the equation needs to know of one lift.

    Without `destination` only the origin is evaluated.
    """

    origin: LiftPoint
    destination: LiftPoint | None
    D_cm: float
    frequency_per_min: float
    duration: Duration
    coupling: Coupling
    load_kg: float | None = None


def _input(name: str, values: ArrayLike) -> Array:
    array = np.asarray(values, dtype=np.float64)
    if np.any(array < 0):
        raise DataError(f"{name} can't be negative, got {float(np.nanmin(array)):g}.")
    return array


def compute_horizontal_multiplier(H: ArrayLike, constants: Constants = METRIC) -> Array:
    """Compute HM from the horizontal distance; 0 beyond `h_max`, NaN where H is NaN."""
    h = _input("H", H)
    value = constants.h_min / np.maximum(h, constants.h_min)
    return np.where(h > constants.h_max, 0.0, value)


def compute_vertical_multiplier(V: ArrayLike, constants: Constants = METRIC) -> Array:
    """Compute VM from the height of the hands; 0 above `v_max`, NaN where V is NaN."""
    v = _input("V", V)
    value = 1.0 - constants.v_slope * np.abs(v - constants.v_best)
    return np.where(v > constants.v_max, 0.0, value)


def compute_distance_multiplier(D: ArrayLike, constants: Constants = METRIC) -> Array:
    """Compute DM from the vertical travel; 0 beyond `d_max`, NaN where D is NaN."""
    d = _input("D", D)
    value = constants.d_offset + constants.d_scale / np.maximum(d, constants.d_min)
    return np.where(d > constants.d_max, 0.0, value)


def compute_asymmetry_multiplier(A: ArrayLike) -> Array:
    """Compute AM from the asymmetry angle in degrees; 0 beyond 135, NaN where A is NaN."""
    a = _input("A", A)
    return np.where(a > A_MAX_DEG, 0.0, 1.0 - A_SLOPE * a)


def compute_frequency_multiplier(
    frequency_per_min: ArrayLike,
    duration: Duration,
    V_origin: ArrayLike,
    constants: Constants = METRIC,
) -> Array:
    """Compute FM from frequency, duration class and the height of the hands at the origin.

    Between the rows of the table the multiplier is interpolated. Below 0.2 lifts per minute that
    of 0.2 holds. Beyond the last row of a column that is not zero, FM is 0: the manual doesn't
    say how to interpolate towards zero, and lifting faster than the fastest listed rate is
    outside it.
    """
    f, v = _input("Frequency", frequency_per_min), _input("V", V_origin)
    first = _FREQUENCY_COLUMN[duration]
    below, above = (_interpolate_frequency(f, first + k) for k in (0, 1))
    return np.where(np.isnan(v), np.nan, np.where(v < constants.v_best, below, above))


def _interpolate_frequency(f: Array, column: int) -> Array:
    rows = [(rate, values[column]) for rate, values in FREQUENCY_TABLE if values[column] > 0]
    rates, multipliers = zip(*rows, strict=True)
    return np.where(f > rates[-1], 0.0, np.interp(f, rates, multipliers))


def compute_coupling_multiplier(
    coupling: Coupling, V: ArrayLike, constants: Constants = METRIC
) -> Array:
    """Compute CM from the grip and the height of the hands at the point that is evaluated."""
    v = _input("V", V)
    below, above = COUPLING_TABLE[coupling]
    return np.where(np.isnan(v), np.nan, np.where(v < constants.v_best, below, above))


def _compute_multipliers(
    H: ArrayLike,
    V: ArrayLike,
    D: ArrayLike,
    A: ArrayLike,
    frequency_per_min: ArrayLike,
    duration: Duration,
    coupling: Coupling,
    V_origin: ArrayLike,
    constants: Constants,
) -> dict[str, Array]:
    return {
        "HM": compute_horizontal_multiplier(H, constants),
        "VM": compute_vertical_multiplier(V, constants),
        "DM": compute_distance_multiplier(D, constants),
        "AM": compute_asymmetry_multiplier(A),
        "FM": compute_frequency_multiplier(frequency_per_min, duration, V_origin, constants),
        "CM": compute_coupling_multiplier(coupling, V, constants),
    }


def compute_rwl_array(
    *,
    H: ArrayLike,
    V: ArrayLike,
    D: ArrayLike,
    A: ArrayLike,
    frequency_per_min: float,
    duration: Duration,
    coupling: Coupling,
    V_origin: ArrayLike,
    constants: Constants = METRIC,
) -> Array:
    """Compute the recommended weight limit of many lifts at once; see `compute_rwl`."""
    parts = _compute_multipliers(
        H, V, D, A, frequency_per_min, duration, coupling, V_origin, constants
    )
    return np.asarray(constants.load_constant * math.prod(parts.values()))


def compute_rwl(
    *,
    H: float,
    V: float,
    D: float,
    A: float,
    frequency_per_min: float,
    duration: Duration,
    coupling: Coupling,
    V_origin: float | None = None,
    constants: Constants = METRIC,
) -> Rwl:
    """Compute the recommended weight limit at one point of a lift.

    Parameters
    ----------
    H, V
        Horizontal distance mid-ankle to mid-hands and height of the hands above the floor,
        at the point that is evaluated (cm; in for `US_CUSTOMARY`).
    D
        Vertical travel from origin to destination (cm or in).
    A
        Asymmetry angle, degrees, unsigned.
    frequency_per_min, duration, coupling
        Lifts per minute, duration class and grip.
    V_origin
        Height of the hands at the origin, which selects the column of the frequency table.
        None if this is the origin.
    constants
        Unit system.

    Returns
    -------
    Rwl
        NaN where an input is NaN.

    Raises
    ------
    DataError
        If an input is negative.
    """
    parts = _compute_multipliers(
        H,
        V,
        D,
        A,
        frequency_per_min,
        duration,
        coupling,
        V if V_origin is None else V_origin,
        constants,
    )
    values = {name: float(value) for name, value in parts.items()}
    reasons = {
        "HM": f"H {H:.4g} is beyond {constants.h_max:g}",
        "VM": f"V {V:.4g} is above {constants.v_max:g}",
        "DM": f"D {D:.4g} is beyond {constants.d_max:g}",
        "AM": f"A {A:.4g} is beyond {A_MAX_DEG:g}",
        "FM": f"{frequency_per_min:.4g} lifts per minute are too many for {duration} duration",
    }
    return Rwl(
        **values,
        RWL=constants.load_constant * math.prod(values.values()),
        zero_reasons=tuple(f"{k} = 0: {reasons[k]}" for k, v in values.items() if v == 0.0),
    )


def compute_lifting_index(load: float | None, rwl: float) -> float:
    """Compute LI = load / RWL: infinite where the RWL is 0, NaN where the load is not known.

    Raises
    ------
    DataError
        If the load is negative.
    """
    if load is None or math.isnan(load) or math.isnan(rwl):
        return math.nan
    if load < 0:
        raise DataError(f"The load can't be negative, got {load:g} kg.")
    return load / rwl if rwl > 0 else math.inf


def compute_case(case: LiftCase) -> dict[str, Rwl]:
    """Evaluate a lift at its origin and, if the case has one, at its destination.

    Returns
    -------
    dict
        `origin`, and `destination`: both with the frequency multiplier of the origin's height.
    """
    points = {"origin": case.origin, "destination": case.destination}
    return {
        end: compute_rwl(
            H=point.H_cm,
            V=point.V_cm,
            D=case.D_cm,
            A=point.A_deg,
            frequency_per_min=case.frequency_per_min,
            duration=case.duration,
            coupling=case.coupling,
            V_origin=case.origin.V_cm,
        )
        for end, point in points.items()
        if point is not None
    }


def govern(case: LiftCase) -> tuple[float, float]:
    """Return the smaller RWL (kg) of the evaluated ends and its lifting index."""
    rwl = min(result.RWL for result in compute_case(case).values())
    return rwl, compute_lifting_index(case.load_kg, rwl)


def move(case: LiftCase, end: str, **changes: float) -> LiftCase:
    """Return the case with one end moved; the travel follows the heights where both are known."""
    ends = {"origin": case.origin, "destination": case.destination}
    point = ends[end]
    if point is None:
        return case
    before = case.destination
    ends[end] = replace(point, **changes)
    origin, destination = ends["origin"] or case.origin, ends["destination"]
    travel = case.D_cm
    if before is not None and destination is not None:
        # The measured travel may differ a little from the heights: keep that difference.
        change = abs(destination.V_cm - origin.V_cm) - abs(before.V_cm - case.origin.V_cm)
        travel = max(0.0, case.D_cm + change)
    return replace(case, origin=origin, destination=destination, D_cm=travel)


def find_duration(sessions: Iterable[tuple[float, float]]) -> Duration | None:
    """Find the duration class of a working day.

    Parameters
    ----------
    sessions
        Hours of lifting and hours of light work or rest after it, in order. Where the
        recovery is too short for the class, the next session's work is added ([2], section
        1.2). The recovery after the last session always counts as enough.

    Returns
    -------
    Duration or None
        The longest class of any block of work; None beyond 8 h, which the equation
        doesn't cover.

    Raises
    ------
    DataError
        If a time is negative.
    """
    day = list(sessions)
    classes: list[Duration] = [Duration.SHORT]
    block_h = 0.0
    for k, (work_h, recovery_h) in enumerate(day):
        _input("A working or recovery time", [work_h, recovery_h])
        block_h += work_h
        found = _classify_block(block_h, math.inf if k == len(day) - 1 else recovery_h)
        if found is not None:
            classes.append(found)
            block_h = 0.0
        elif block_h > MAX_DURATION_H + _TOLERANCE_H:
            return None
    if block_h > 0:
        return None
    order = [row[0] for row in DURATION_TABLE]
    return max(classes, key=order.index)


def _classify_block(work_h: float, recovery_h: float) -> Duration | None:
    """Return the class of one block if its recovery suffices, else None: it goes on."""
    for duration, upper_h, share in DURATION_TABLE:
        if work_h <= upper_h + _TOLERANCE_H:
            return duration if recovery_h + _TOLERANCE_H >= share * work_h else None
    return None


def repeat_session(work_h: float, recovery_h: float) -> list[tuple[float, float]]:
    """Return the sessions of a day that repeats one work and one recovery time.

    As many as it takes to leave the moderate class, should the recovery never suffice.
    """
    if work_h <= 0:
        return [(0.0, recovery_h)]
    limit = DURATION_TABLE[1][1]
    count = max(1, min(10_000, math.floor(limit / work_h) + 1))
    return list(itertools.repeat((work_h, recovery_h), count))
