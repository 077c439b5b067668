"""ISO 11228-1:2021: the lifting equation with a reference mass for the person.

The multipliers are those of `rnle`; only the mass at the ideal lift differs, so every limit is
that of the lifting equation times the ratio of the two masses.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

from engine.datatypes import Provenance, RiskInput, RiskResult, Sex, Subject
from engine.ergonomics.base import Exposure, MethodInfo, RiskLevel
from engine.ergonomics.lifting_equation import METRIC
from engine.ergonomics.methods.rnle import LEVELS as RNLE_LEVELS
from engine.ergonomics.methods.rnle import METHOD as RNLE
from engine.ergonomics.work import classify, combine_lifts, refuse

__all__ = ["LEVELS", "METHOD", "find_reference_mass"]

# Reference mass (kg) by sex: from 20 to 45 years, younger or older. ISO 11228-1:2021 [V2].
REFERENCE_MASS_KG: dict[Sex, tuple[float, float]] = {"male": (25.0, 20.0), "female": (20.0, 15.0)}
MIDDLE_AGE_Y = (20.0, 45.0)
ALL_WORKERS_KG = 15.0
MIN_LOAD_KG = 3.0
"""The standard is for objects of at least this mass."""

LEVELS: tuple[RiskLevel, ...] = tuple(
    replace(level, meaning=meaning)
    for level, meaning in zip(
        RNLE_LEVELS,
        (
            "within the mass limit for this person",
            "above the mass limit for this person",
            "clearly above the limit",
            "far above the limit",
            "several times the limit",
        ),
        strict=True,
    )
)


def find_reference_mass(subject: Subject) -> tuple[float, tuple[str, ...]]:
    """Return the reference mass (kg) of a person, and what was assumed.

    Where sex or age is not known, that of all workers (15 kg).
    """
    if subject.sex is None or subject.age_y is None:
        unknown = " and ".join(
            name for name, value in (("Sex", subject.sex), ("age", subject.age_y)) if value is None
        )
        note = (
            f"{unknown[:1].upper()}{unknown[1:]} not given: the reference mass for all workers, "
            f"{ALL_WORKERS_KG:g} kg, is used."
        )
        return ALL_WORKERS_KG, (note,)
    middle, other = REFERENCE_MASS_KG[subject.sex]
    is_middle = MIDDLE_AGE_Y[0] <= subject.age_y <= MIDDLE_AGE_Y[1]
    return (middle if is_middle else other), ()


class Iso11228:
    """Mass limit of ISO 11228-1:2021."""

    info = MethodInfo(
        name="iso11228",
        title="ISO 11228-1 mass limit",
        reference="ISO 11228-1:2021, reference masses by sex and age [V2], multipliers of the "
        "Revised NIOSH Lifting Equation, five bands [V2].",
        verification="V2",
        levels=LEVELS,
        value_name="load over ISO limit",
        description="Load over the limit for a person of this sex and age. One-handed lifting, "
        "lifting by several people and work beyond 8 h are not assessed: the standard's further "
        "multipliers were not verified.",
    )

    def assess(self, exposure: Exposure) -> RiskResult:
        """Judge every lift; the headline is the worst of them.

        Returns
        -------
        RiskResult
            `value` is load over limit; `details` has the limit and the reference mass.
        """
        load = exposure.task.load_kg
        if load is not None and load < MIN_LOAD_KG:
            return refuse(
                self.info,
                f"the load is {load:g} kg; the standard is for {MIN_LOAD_KG:g} kg or more",
            )
        whole = RNLE.assess(exposure)
        if not whole.per_lift:
            return refuse(self.info, *whole.reasons)
        return combine_lifts(self.info, [self._convert(p, exposure) for p in whole.per_lift])

    def _convert(self, part: RiskResult, exposure: Exposure) -> RiskResult:
        if not part.is_applicable:
            refused = refuse(self.info, *part.reasons)
            return replace(refused, lift_index=part.lift_index)
        subject = exposure.subject
        mass, notes = find_reference_mass(subject)
        ratio = mass / METRIC.load_constant
        value = part.value / ratio
        level = classify(LEVELS, value)
        limit = part.details["rwl_kg"] * ratio
        doubts = list(part.details["doubts"])
        assumptions = [*notes, *part.details["assumptions"]]
        unknown_load = "The load is not given: the limit, but no index."
        reasons = () if exposure.task.load_kg is not None else (unknown_load,)
        low, high = part.interval
        return RiskResult(
            method=self.info.name,
            value=value,
            category="load not given" if level is None else level.name,
            inputs=(
                *_list_person(subject, mass),
                *part.inputs,
            ),
            steps=_explain(part, mass, limit, value, exposure.task.load_kg),
            interval=(low / ratio, high / ratio),
            reference=self.info.reference,
            reasons=(*reasons, *assumptions, *doubts),
            details={**_details(part, mass, ratio), "assumptions": assumptions, "doubts": doubts},
            lift_index=part.lift_index,
        )


def _list_person(subject: Subject, mass: float) -> tuple[RiskInput, ...]:
    is_known = subject.sex is not None and subject.age_y is not None
    source = Provenance.DERIVED if is_known else Provenance.ASSUMED
    user, assumed = Provenance.USER, Provenance.ASSUMED
    return (
        RiskInput("sex", subject.sex, "", assumed if subject.sex is None else user),
        RiskInput("age", subject.age_y, "years", assumed if subject.age_y is None else user),
        RiskInput("reference mass", mass, "kg", source),
    )


def _explain(
    part: RiskResult, mass: float, limit: float, value: float, load_kg: float | None
) -> tuple[str, ...]:
    lines = [
        (
            f"Reference mass {mass:g} kg instead of the {METRIC.load_constant:g} kg of the lifting "
            "equation; multipliers as there"
        ),
        (
            f"Limit = {part.details['rwl_kg']:.2f} kg x {mass:g} / {METRIC.load_constant:g} = "
            f"{limit:.2f} kg"
        ),
    ]
    if load_kg is not None:
        lines.append(f"Load / limit = {load_kg:g} kg / {limit:.2f} kg = {value:.2f}")
    return tuple(lines)


def _details(part: RiskResult, mass: float, ratio: float) -> dict[str, Any]:
    shown = ("dominant_input", "uncertainty_shares", "frequency_per_min", "duration_class")
    low, high = part.details["rwl_interval_kg"]
    demanding = part.details["demanding_li"]
    return {
        **{name: part.details[name] for name in shown},
        "reference_mass_kg": mass,
        "limit_kg": part.details["rwl_kg"] * ratio,
        "limit_interval_kg": [low * ratio, high * ratio],
        "demanding_li": math.nan if demanding is None else demanding / ratio,
        "end": part.details["governing_end"],
    }


METHOD = Iso11228()
