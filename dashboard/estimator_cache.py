"""What the page about estimators asks of the engine, behind Streamlit's caches."""

from __future__ import annotations

import streamlit as st

from dashboard import cache
from engine.estimators import EstimatorRun, compare_on_stored


def runs(trial_id: str, names: tuple[str, ...], view: int) -> tuple[EstimatorRun, ...]:
    """Return what every estimator makes of one view of a trial.

    Raises
    ------
    DataError
        If there is no such trial, or its keypoints are not those the estimators start from.
    """
    return _run(trial_id, names, view, cache.result_stamp(trial_id))


@st.cache_resource(max_entries=24, show_spinner="Running the estimators …")
def _run(
    trial_id: str, names: tuple[str, ...], view: int, stamp_ns: int
) -> tuple[EstimatorRun, ...]:
    return compare_on_stored(cache.result(trial_id), names, view=view)
