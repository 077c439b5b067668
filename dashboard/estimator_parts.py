"""The parts of the page that shows several estimators on one clip."""

from __future__ import annotations

from collections.abc import Sequence

import streamlit as st

from dashboard import estimator_cache, estimator_charts, labels, state
from dashboard.labels import format_number
from dashboard.widgets import is_dark, table_html
from engine.errors import EngineError
from engine.estimators import EstimatorRun, list_lifters, mean_differences
from engine.storage.results import StoredResult

CHART = {"displaylogo": False, "displayModeBar": False}
MAIN_ANGLES = (
    "trunk_inclination",
    "hip_flexion_l",
    "hip_flexion_r",
    "knee_flexion_l",
    "knee_flexion_r",
    "shoulder_flexion_l",
    "shoulder_flexion_r",
    "elbow_flexion_l",
    "elbow_flexion_r",
)
HEAD = (
    ("Estimator", ""),
    ("Weights", "Whose weights are used: ours are trained on open motion capture."),
    ("Outlier frames", "Share of frames in which a body link jumps in length, before correction."),
    ("Body fit", "Mean distance of the fitted body's joints from the corrected keypoints."),
    ("Time", "To lift the keypoints to three dimensions, beyond finding them in the picture."),
    ("Lifts", "How many lifts are found."),
)


def choose_estimators(stored: StoredResult) -> tuple[tuple[str, ...], int]:
    """Let the user choose estimators, and the view of two."""
    infos = {info.name: info for info in list_lifters() if not info.missing}
    chosen = st.multiselect(
        "Estimators",
        list(infos),
        default=list(infos),
        format_func=lambda name: infos[name].title,
        key=state.estimator_key("names"),
        placeholder="Choose at least one",
    )
    view = 0
    if len(stored.views) > 1:
        view = st.radio(
            "View",
            range(len(stored.views)),
            format_func=lambda number: f"Video {number + 1}",
            horizontal=True,
            key=state.estimator_key("view"),
        )
    st.caption(
        "All start from the same points of the picture, which were kept with the trial; they "
        "differ in how they find the depth. Each goes through the same correction and the same fit "
        "of the body. The trial itself is not changed."
    )
    return tuple(chosen), int(view or 0)


def show_comparison(trial_id: str, names: tuple[str, ...], view: int) -> None:
    """Show what the estimators make of the trial."""
    if not names:
        st.info("Choose at least one estimator.", icon=":material/checklist:")
        return
    try:
        runs = estimator_cache.runs(trial_id, names, view)
    except EngineError as error:
        st.error(str(error), icon=":material/error:")
        return
    st.html(table_html(HEAD, [_row(run) for run in runs]))
    for run in runs:
        if run.refusal:
            st.warning(f"{run.info.title}: {run.refusal}", icon=":material/block:")
    usable = [run for run in runs if run.result is not None]
    if usable:
        _show_curves(usable)
        _show_differences(usable)


def _row(run: EstimatorRun) -> tuple[str, ...]:
    if run.result is None:
        return (run.info.title, run.info.licence, "not applicable", "", "", "")
    time = run.lifting_s_per_frame
    return (
        run.info.title,
        run.info.licence,
        f"{format_number(100 * run.outlier_ratio, 1)} %",
        f"{format_number(1000 * run.fit_residual_m)} mm",
        "with the picture" if time == 0 else f"{format_number(1000 * time, 1)} ms a frame",
        labels.count(len(run.result.lifts), "lift"),
    )


def _show_curves(runs: Sequence[EstimatorRun]) -> None:
    st.subheader("The curves", anchor=False)
    first = runs[0].result
    assert first is not None
    names = [name for name in MAIN_ANGLES if name in first.angles.names]
    names += [name for name in first.angles.names if name not in names]
    angle = st.selectbox(
        "Joint angle", names, format_func=labels.name_angle, key=state.estimator_key("angle")
    )
    figure = estimator_charts.plot_estimators(runs, angle, first.lifts, dark=is_dark())
    st.plotly_chart(figure, config=CHART, alt=f"{labels.name_angle(angle)} by every estimator")
    st.subheader("Frames with an outlier", anchor=False)
    st.caption(
        "A frame counts where the length of a body link jumps or stays off, which bones don't do. "
        "Counted before any correction."
    )
    figure = estimator_charts.plot_outliers(runs, dark=is_dark())
    st.plotly_chart(figure, config=CHART, alt="Share of frames with an outlier by estimator")


def _show_differences(runs: Sequence[EstimatorRun]) -> None:
    if len(runs) < 2:
        return
    first, *others = runs
    st.subheader(f"Mean difference from {first.info.title}", anchor=False)
    st.caption(
        "In degrees, over the frames both measured. A difference is no error: which one is right "
        "only a reference recording can tell."
    )
    differences = [mean_differences(run, first) for run in others]
    head = (("Joint angle", ""), *((run.info.title, "") for run in others))
    rows = [
        (
            labels.name_angle(name),
            *(f"{format_number(d.get(name, float('nan')), 1)}°" for d in differences),
        )
        for name in MAIN_ANGLES
        if any(name in d for d in differences)
    ]
    st.html(table_html(head, rows, css="ll-plain"))
