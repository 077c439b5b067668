"""What the page about improvements asks of the engine, behind Streamlit's caches."""

from __future__ import annotations

from dataclasses import dataclass

import streamlit as st

from dashboard import cache
from engine import improve
from engine.datatypes import RiskResult
from engine.ergonomics.base import Exposure
from engine.ergonomics.before_after import BeforeAfter, TrialMeasures
from engine.ergonomics.improvements import (
    RankedChange,
    Ranking,
    compare_change,
    find_governing_lift,
    rank_changes,
)
from engine.ergonomics.job import JobPart, JobResult, assess_job
from engine.ergonomics.what_if import Change, focus_on_lift, what_if


@dataclass(frozen=True)
class Answer:
    """A lift as filmed and as changed, by every method that judges lifts, and what it gains."""

    filmed: dict[str, RiskResult]
    changed: dict[str, RiskResult]
    gain: RankedChange


def exposure(trial_id: str) -> Exposure:
    """Return what the risk methods judged of a trial.

    Raises
    ------
    DataError
        If there is no such trial, or its result is damaged.
    """
    return _read_exposure(trial_id, cache.result_stamp(trial_id))


@st.cache_resource(max_entries=16, show_spinner=False)
def _read_exposure(trial_id: str, stamp: int) -> Exposure:
    return improve.read_exposure(cache.result(trial_id))


def worst_lift(trial_id: str) -> int:
    """Return the lift that allows the least weight."""
    return _find_worst(trial_id, cache.result_stamp(trial_id))


@st.cache_data(max_entries=64, show_spinner=False)
def _find_worst(trial_id: str, stamp: int) -> int:
    return find_governing_lift(exposure(trial_id))


def answer(trial_id: str, lift: int, change: Change) -> Answer:
    """Judge one lift as filmed and as changed."""
    return _answer(trial_id, cache.result_stamp(trial_id), lift, change)


@st.cache_resource(max_entries=128, show_spinner=False)
def _answer(trial_id: str, stamp: int, lift: int, change: Change) -> Answer:
    whole = exposure(trial_id)
    return Answer(
        _judge(trial_id, stamp, lift, Change(), frames=False),
        _judge(trial_id, stamp, lift, change, frames=False),
        compare_change(whole, change, lift_index=lift),
    )


def posture_scores(trial_id: str, lift: int, change: Change) -> dict[str, RiskResult]:
    """Judge every frame of a trial, as changed."""
    return _judge(trial_id, cache.result_stamp(trial_id), lift, change, frames=True)


@st.cache_resource(max_entries=128, show_spinner=False)
def _judge(
    trial_id: str, stamp: int, lift: int, change: Change, *, frames: bool
) -> dict[str, RiskResult]:
    single = focus_on_lift(exposure(trial_id), lift)
    return what_if(single, change, frames=frames)


def ranking(trial_id: str, lift: int, locks: frozenset[str]) -> Ranking:
    """Rank the plausible changes of one lift."""
    return _rank(trial_id, cache.result_stamp(trial_id), lift, tuple(sorted(locks)))


@st.cache_resource(max_entries=64, show_spinner="Trying changes …")
def _rank(trial_id: str, stamp: int, lift: int, locks: tuple[str, ...]) -> Ranking:
    return rank_changes(exposure(trial_id), frozenset(locks), lift_index=lift)


def before_after(before: tuple[str, ...], after: tuple[str, ...]) -> BeforeAfter:
    """Compare two sets of trials."""
    one, two = ([cache.result(name) for name in part] for part in (before, after))
    return improve.compare_results(one, two)


def measures(trial_id: str) -> TrialMeasures:
    """Return the numbers of one trial."""
    return improve.measure_result(cache.result(trial_id))


def job(
    parts: tuple[tuple[str, str, float, float | None], ...],
    duration_h: float | None,
    recovery_h: float | None,
) -> JobResult:
    """Judge several trials as one job: id, name, lifts per minute and own hours of each."""
    stamps = tuple(cache.result_stamp(name) for name, *_ in parts)
    return _judge_job(parts, stamps, duration_h, recovery_h)


@st.cache_resource(max_entries=32, show_spinner=False)
def _judge_job(
    parts: tuple[tuple[str, str, float, float | None], ...],
    stamps: tuple[int, ...],
    duration_h: float | None,
    recovery_h: float | None,
) -> JobResult:
    return assess_job(
        [JobPart(name, exposure(one), rate, hours) for one, name, rate, hours in parts],
        duration_h=duration_h,
        recovery_h=recovery_h,
    )
