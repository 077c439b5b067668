"""All chosen risk methods, applied to one exposure."""

from __future__ import annotations

from engine.datatypes import RiskResult
from engine.ergonomics.base import Exposure, select_methods

__all__ = ["assess_risk"]


def assess_risk(
    exposure: Exposure, *, methods: tuple[str, ...] = (), experimental: bool = False
) -> dict[str, RiskResult]:
    """Judge an exposure by the methods asked for.

    Parameters
    ----------
    exposure
        What was measured, and the work it belongs to.
    methods
        Keys of methods; empty for all that may run.
    experimental
        Whether methods that were not checked against their publication may run.

    Returns
    -------
    dict
        One result per method, by its key.

    Raises
    ------
    ConfigError
        If a method is unknown, or experimental without the switch.
    """
    chosen = select_methods(methods, experimental=experimental)
    return {method.info.name: method.assess(exposure) for method in chosen}
