"""Masses and mass centres of body segments, as shares of body mass and segment length.

References
----------
.. [1] de Leva (1996), Adjustments to Zatsiorsky-Seluyanov's segment inertia parameters,
   J. Biomechanics 29(9), 1223-1230, table 4 [V2].
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from engine.datatypes import Sex

__all__ = ["ABOVE_L5S1", "DE_LEVA", "Segment", "UpperBodyShares", "share_above_l5s1"]


@dataclass(frozen=True)
class Segment:
    """One segment: mean length (mm), mass as a share of the body's, centre from the first end.

    Of paired segments the mass is that of one side.
    """

    length_mm: float
    mass: float
    centre: float


# [1], table 4. Endpoints: head vertex to C7; trunk middle of the shoulders to middle of the hips;
# its parts suprasternale, xiphion, omphalion, middle of the hips; hand wrist to third knuckle;
# shank to the ankle's centre; foot heel to toe tip.
DE_LEVA: Mapping[Sex, Mapping[str, Segment]] = {
    "male": {
        "head": Segment(242.9, 0.0694, 0.5002),
        "trunk": Segment(515.5, 0.4346, 0.4310),
        "upper trunk": Segment(170.7, 0.1596, 0.2999),
        "middle trunk": Segment(215.5, 0.1633, 0.4502),
        "lower trunk": Segment(145.7, 0.1117, 0.6115),
        "upper arm": Segment(281.7, 0.0271, 0.5772),
        "forearm": Segment(268.9, 0.0162, 0.4574),
        "hand": Segment(86.2, 0.0061, 0.7900),
        "thigh": Segment(422.2, 0.1416, 0.4095),
        "shank": Segment(440.3, 0.0433, 0.4395),
        "foot": Segment(258.1, 0.0137, 0.4415),
    },
    "female": {
        "head": Segment(243.7, 0.0668, 0.4841),
        "trunk": Segment(497.9, 0.4257, 0.3782),
        "upper trunk": Segment(142.5, 0.1545, 0.2077),
        "middle trunk": Segment(205.3, 0.1465, 0.4512),
        "lower trunk": Segment(181.5, 0.1247, 0.4920),
        "upper arm": Segment(275.1, 0.0255, 0.5754),
        "forearm": Segment(264.3, 0.0138, 0.4559),
        "hand": Segment(78.0, 0.0056, 0.7474),
        "thigh": Segment(368.5, 0.1478, 0.3612),
        "shank": Segment(438.6, 0.0481, 0.4352),
        "foot": Segment(228.3, 0.0129, 0.4014),
    },
}


@dataclass(frozen=True)
class UpperBodyShares:
    """What lies above L5/S1: masses as shares of body mass, centres along the segments.

    Masses of arms are those of one side. `trunk_centre` and `l5s1_height` are shares of
    the line from the middle of the hips to that of the shoulders.
    """

    trunk: float
    head: float
    upper_arm: float
    forearm: float
    hand: float
    trunk_centre: float
    upper_arm_centre: float
    forearm_centre: float
    hand_centre: float
    l5s1_height: float

    @property
    def total(self) -> float:
        """Share of the body mass above L5/S1."""
        return self.trunk + self.head + 2 * (self.upper_arm + self.forearm + self.hand)


def _derive(sex: Sex, trunk_centre: float) -> UpperBodyShares:
    """Cut the trunk half-way up its lower part, which is where L5/S1 lies."""
    table = DE_LEVA[sex]
    lower = table["lower trunk"]
    return UpperBodyShares(
        trunk=table["upper trunk"].mass + table["middle trunk"].mass + 0.5 * lower.mass,
        head=table["head"].mass,
        upper_arm=table["upper arm"].mass,
        forearm=table["forearm"].mass,
        hand=table["hand"].mass,
        trunk_centre=trunk_centre,
        upper_arm_centre=table["upper arm"].centre,
        forearm_centre=table["forearm"].centre,
        hand_centre=table["hand"].centre,
        l5s1_height=0.5 * lower.length_mm / table["trunk"].length_mm,
    )


# The centre of the trunk above L5/S1 is derived from the three parts' centres in [1].
ABOVE_L5S1: Mapping[Sex, UpperBodyShares] = {
    "male": _derive("male", 0.646),
    "female": _derive("female", 0.712),
}


def share_above_l5s1(sex: Sex | None) -> UpperBodyShares:
    """Return the shares of a sex; their mean where the sex is not known."""
    if sex is not None:
        return ABOVE_L5S1[sex]
    women, men = ABOVE_L5S1["female"], ABOVE_L5S1["male"]
    return UpperBodyShares(
        **{name: 0.5 * (value + getattr(men, name)) for name, value in vars(women).items()}
    )
