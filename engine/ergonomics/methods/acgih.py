"""ACGIH lifting threshold limit values, by the place of the load where the lift begins."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from engine.datatypes import Array, Lift, Measurement, Provenance, RiskInput, RiskResult
from engine.ergonomics.base import Exposure, MethodInfo, RiskLevel
from engine.ergonomics.methods.rnle import REFUSED_CONDITIONS
from engine.ergonomics.propagation import compute_interval, draw_inputs
from engine.ergonomics.work import (
    Repetitions,
    classify,
    combine_lifts,
    list_doubts,
    read_lifts,
    read_repetitions,
    refuse,
)

__all__ = ["LEVELS", "METHOD", "find_limit", "find_table"]

LEVELS: tuple[RiskLevel, ...] = (
    RiskLevel(
        "within the limit",
        1.0,
        "nearly all healthy workers can do it day after day",
        "none from this method",
    ),
    RiskLevel(
        "above the limit",
        math.inf,
        "above the limit value, or where no load is known to be safe",
        "lower the load, or bring it closer or to torso height",
    ),
)

# Table 1 [V2], kg: up to 2 h a day and 60 lifts an hour, or more than 2 h and 12 an hour. Rows from
# above to below; columns close, intermediate, extended; NaN: no known safe limit.
TABLE_1: Mapping[str, tuple[float, float, float]] = {
    "reach": (16.0, 7.0, math.nan),
    "torso": (32.0, 16.0, 9.0),
    "knee": (18.0, 14.0, 7.0),
    "ankle": (14.0, math.nan, math.nan),
}
ZONES = tuple(TABLE_1)
H_BOUNDS_CM = (30.0, 60.0, 80.0)
"""From the middle of the ankles: close is below the first; beyond the last there is no limit."""

SHORT_H = 2.0
SHORT_PER_H, LONG_PER_H = 60.0, 12.0
MAX_PER_H = 360.0

# Heights as shares of stature (Winter 2009, fig. 4.1): shoulder; knuckle of a hanging arm;
# middle of the shin.
SHOULDER_SHARE, KNUCKLE_SHARE, SHIN_SHARE = 0.818, 0.432, 0.162
SHARE_SIGMA = 0.015
"""Standard error of such a share between persons."""
BELOW_SHOULDER_CM, ABOVE_SHOULDER_CM, MAX_HEIGHT_CM = 8.0, 30.0, 180.0
MAX_ASYMMETRY_DEG = 30.0


def find_table(per_hour: float, duration_h: float) -> int | None:
    """Return which of the three tables holds; None above 360 lifts an hour."""
    if per_hour > MAX_PER_H:
        return None
    if duration_h <= SHORT_H:
        return 1 if per_hour <= SHORT_PER_H else 2
    if per_hour <= LONG_PER_H:
        return 1
    return 2 if per_hour <= 30.0 else 3


def _bounds_cm(stature_cm: float) -> tuple[float, float, float, float]:
    """Return the heights between the zones, from the top: end of reach, torso, knee, ankle."""
    shoulder = SHOULDER_SHARE * stature_cm
    top = min(shoulder + ABOVE_SHOULDER_CM, MAX_HEIGHT_CM)
    return top, shoulder - BELOW_SHOULDER_CM, KNUCKLE_SHARE * stature_cm, SHIN_SHARE * stature_cm


def find_limit(H_cm: Array, V_cm: Array, stature_cm: float) -> Array:
    """Look up the limit of table 1 in kg.

    Parameters
    ----------
    H_cm, V_cm
        Horizontal distance mid-ankle to load, and its height, at the origin; same shape.
    stature_cm
        Gives the heights of shoulder, knuckle and shin.

    Returns
    -------
    Array
        0 where no load is known to be safe or the load is outside all zones; NaN where unknown.
    """
    place = _find_zone(np.asarray(H_cm, float), np.asarray(V_cm, float), stature_cm)
    unknown = np.isnan(H_cm) | np.isnan(V_cm)
    return np.where(unknown, np.nan, _GRID[place])


# Table 1 with a row above and a column beyond all zones, and 0 for no safe limit.
_GRID = np.zeros((len(ZONES) + 1, len(H_BOUNDS_CM) + 1))
_GRID[1:, :3] = np.nan_to_num(np.array(list(TABLE_1.values())), nan=0.0)


def _find_zone(
    H_cm: Array, V_cm: Array, stature_cm: float
) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Return row and column of `_GRID`; bounds belong to the zone above and further out."""
    top, torso, knee, ankle = _bounds_cm(stature_cm)
    distance, height = np.broadcast_arrays(H_cm, V_cm)
    inside = [height > top, height > torso, height >= knee, height >= ankle]
    row = np.select(inside, [0, 1, 2, 3], default=4)
    column = np.searchsorted(H_BOUNDS_CM, distance, side="right")
    # The outermost zone has its outer end as well.
    return row, np.where(distance == H_BOUNDS_CM[-1], len(H_BOUNDS_CM) - 1, column)


def _name_zone(H_cm: float, V_cm: float, stature_cm: float) -> str:
    row, column = (int(k) for k in _find_zone(np.array(H_cm), np.array(V_cm), stature_cm))
    if row == 0 or column == len(H_BOUNDS_CM):
        return "outside all zones"
    return f"{ZONES[row - 1]}, {('close', 'intermediate', 'extended')[column]}"


class Acgih:
    """ACGIH threshold limit value for lifting, table 1."""

    info = MethodInfo(
        name="acgih",
        title="ACGIH lifting limit value",
        reference="ACGIH, TLV for lifting (2005 onward), table 1 and the choice of table [V2]; "
        "body heights from stature by Winter (2009), fig. 4.1.",
        verification="V2",
        levels=LEVELS,
        value_name="load over ACGIH limit",
        description="Load over the limit for the zone the lift starts in. Only table 1 (rare or "
        "short lifting) was verified; more frequent lifting is not judged.",
    )

    def assess(self, exposure: Exposure) -> RiskResult:
        """Judge every lift by its origin; the headline is the worst of them.

        Returns
        -------
        RiskResult
            `value` is load over limit, infinite where no load is known to be safe.
        """
        if not exposure.lifts:
            return refuse(self.info, "no lift was found in the video")
        if exposure.task.load_kg is None:
            return refuse(self.info, "the load is not given, and this method needs it")
        work = read_repetitions(exposure)
        per_hour = 60.0 * work.frequency_per_min
        table = find_table(per_hour, work.duration_h)
        if table != 1:
            return refuse(self.info, _explain_table(per_hour, work.duration_h, table))
        load_kg = exposure.task.load_kg
        results = [
            self._assess_lift(exposure, lift, k, work, load_kg)
            for k, lift in enumerate(read_lifts(exposure))
        ]
        return combine_lifts(self.info, results)

    def _assess_lift(
        self, exposure: Exposure, lift: Lift, index: int, work: Repetitions, load_kg: float
    ) -> RiskResult:
        H, V = lift.origin.H_cm, lift.origin.V_cm
        if H.is_missing or V.is_missing:
            reason = "hands or feet could not be measured where the lift starts"
            return replace(refuse(self.info, reason), lift_index=index)
        stature_cm = 100 * exposure.subject.stature.value
        V = Measurement(max(0.0, V.value), V.sigma)
        limit = float(find_limit(np.array(H.value), np.array(V.value), stature_cm))
        value = _ratio(load_kg, limit)
        level = classify(LEVELS, value)
        doubts = _list_doubts(exposure, lift)
        zone = _name_zone(H.value, V.value, stature_cm)
        return RiskResult(
            method=self.info.name,
            value=value,
            category="unknown" if level is None else level.name,
            inputs=_list_inputs(exposure, lift, work),
            steps=_explain(exposure, H.value, V.value, zone, limit, value),
            interval=_find_interval(H, V, exposure, load_kg),
            reference=self.info.reference,
            reasons=(*work.assumptions, *doubts),
            details={
                "zone": zone,
                "limit_kg": limit,
                "table": 1,
                "assumptions": list(work.assumptions),
                "doubts": doubts,
            },
            lift_index=index,
        )


def _ratio(load_kg: float, limit_kg: float) -> float:
    if math.isnan(limit_kg):
        return math.nan
    if limit_kg == 0:
        return math.inf if load_kg > 0 else 0.0
    return load_kg / limit_kg


def _explain_table(per_hour: float, duration_h: float, table: int | None) -> str:
    asked = f"{per_hour:.0f} lifts an hour for {duration_h:g} h a day"
    if table is None:
        return f"{asked} are more than the limit values cover"
    return f"{asked} need table {table}, which was not verified against the publication"


def _list_doubts(exposure: Exposure, lift: Lift) -> list[str]:
    """List what the publication says should lower the limit by judgement."""
    doubts = list_doubts(exposure, lift)
    keys = {*exposure.conditions, *lift.notes}
    cautions = [REFUSED_CONDITIONS[k].split(";")[0] for k in REFUSED_CONDITIONS if k in keys]
    if lift.hands == 1 and "one_handed" not in keys:
        cautions.append("the load is lifted with one hand")
    if lift.origin.A_deg.value > MAX_ASYMMETRY_DEG:
        cautions.append("the load is more than 30 degrees to the side")
    if exposure.task.duration_h is not None and exposure.task.duration_h > 8.0:
        cautions.append("the work lasts more than 8 h")
    if exposure.task.coupling == "poor":
        cautions.append("the grip is poor")
    if cautions:
        doubts.append(f"the limit should be lower than stated: {'; '.join(cautions)}")
    if math.isnan(lift.origin.H_cm.sigma) or math.isnan(lift.origin.V_cm.sigma):
        doubts.append("the measuring error is not known, so that no interval can be given")
    return doubts


def _find_interval(
    H: Measurement, V: Measurement, exposure: Exposure, load_kg: float
) -> tuple[float, float]:
    """Return the interval from the errors of place and of the body heights of the zones."""
    stature = exposure.subject.stature
    if not (math.isfinite(H.sigma) and math.isfinite(V.sigma)):
        return math.nan, math.nan
    # An error of the zones' heights acts like one of the load's height.
    heights = math.hypot(SHARE_SIGMA * stature.value, SHOULDER_SHARE * stature.sigma)
    wide = Measurement(V.value, math.hypot(V.sigma, 100 * heights))
    drawn = draw_inputs({"H": H, "V": wide})
    limits = find_limit(drawn["H"], drawn["V"], 100 * stature.value)
    low, high = _step_interval(limits)
    return _ratio(load_kg, high), _ratio(load_kg, low)


def _step_interval(limits: Array) -> tuple[float, float]:
    """Return drawn limits at the ends of the interval, never between two steps of the table."""
    low, high = compute_interval(limits)
    return float(limits[limits <= low].max()), float(limits[limits >= high].min())


def _list_inputs(exposure: Exposure, lift: Lift, work: Repetitions) -> tuple[RiskInput, ...]:
    end, subject = lift.origin, exposure.subject
    measured = Provenance.MEASURED
    stature_from = subject.provenance["stature_m"] or Provenance.ASSUMED
    return (
        RiskInput("H at origin", end.H_cm.value, "cm", measured, end.H_cm.sigma),
        RiskInput("V at origin", end.V_cm.value, "cm", measured, end.V_cm.sigma),
        RiskInput("stature", subject.stature.value, "m", stature_from, subject.stature.sigma),
        RiskInput("load", exposure.task.load_kg, "kg", Provenance.USER),
        RiskInput("frequency", work.frequency_per_min, "1/min", work.frequency_from),
        RiskInput("duration", work.duration_h, "h", work.duration_from),
    )


def _explain(
    exposure: Exposure, H_cm: float, V_cm: float, zone: str, limit: float, value: float
) -> tuple[str, ...]:
    top, torso, knee, ankle = _bounds_cm(100 * exposure.subject.stature.value)
    load_kg = exposure.task.load_kg or 0.0
    allowed = f"{limit:g} kg" if limit > 0 else "no load is known to be safe here"
    lines = [
        (
            f"Heights from stature: shin {ankle:.0f}, knuckle {knee:.0f}, torso up to {torso:.0f}, "
            f"reach up to {top:.0f} cm"
        ),
        f"The lift starts at H {H_cm:.0f} cm, V {V_cm:.0f} cm: zone {zone}",
        f"Limit, table 1: {allowed}",
    ]
    if limit > 0:
        lines.append(f"Load / limit = {load_kg:g} kg / {limit:g} kg = {value:.2f}")
    return tuple(lines)


METHOD = Acgih()
