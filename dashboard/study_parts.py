"""The parts of the page of validation studies."""

from __future__ import annotations

import shlex
from collections.abc import Mapping, Sequence

import streamlit as st

from dashboard import state, study_cache, study_charts
from dashboard.labels import count
from dashboard.widgets import facts_html, is_dark, list_html, table_html
from engine.errors import EngineError
from engine.protocol_stored import PDF_NAME, StoredStudy
from engine.validation.protocol.report import REPORT_NAME

CHART = {"displaylogo": False, "displayModeBar": False}
PAPER_TABLES = ("table1", "table2", "table3")
TABS = ("Table 1: markers", "Table 2: angles", "Table 3: angle by angle")
SHOWN_STATEMENTS = 5
ESTIMATORS = (
    "nn", "wknn", "ridge", "gp", "gp-smooth", "tgp", "tgp-knn", "tgp-constrained",
    "tgp-constrained-gh",
)  # fmt: skip
FOLDS = {
    "trial": "whole repetitions",
    "block": "parts of recordings",
    "random": "random frames (leaky)",
    "subject": "leave one person out",
}


def choose_study() -> StoredStudy | None:
    """Let the user choose a finished study; the address may name one already."""
    found = study_cache.studies()
    finished = [name for name, is_finished in found.items() if is_finished]
    unfinished = [name for name, is_finished in found.items() if not is_finished]
    if unfinished:
        st.caption(
            f"Not finished: {', '.join(unfinished)}. The same command goes on where it stopped."
        )
    if not finished:
        st.info(
            "There is no finished study yet. A study judges the estimators on lifts that were "
            "filmed and measured with markers at the same time.",
            icon=":material/biotech:",
        )
        return None
    named = state.study_name()
    chosen: str = st.selectbox(
        "Study", finished, index=finished.index(named) if named in finished else 0
    )
    state.set_study_name(chosen)
    try:
        return study_cache.study(chosen)
    except EngineError as error:
        st.error(str(error), icon=":material/error:", title=f"{chosen} can't be shown")
        return None


def show_command(*, is_first: bool) -> None:
    """Put together the command that runs a study into the place where this page finds it."""
    with st.expander("Run a study", expanded=is_first, icon=":material/terminal:"):
        st.caption(
            "A study takes minutes to hours, so it runs from the command line. The layout of a "
            "data set is described in docs/datasets.md."
        )
        left, right = st.columns(2)
        folder = left.text_input(
            "Folder of the data set", placeholder="/data/lifts", key=state.study_key("dataset")
        )
        name = right.text_input("Name of the study", "study-1", key=state.study_key("name"))
        estimators = left.multiselect(
            "Estimators", ESTIMATORS, ["nn", "gp", "tgp", "tgp-constrained"],
            key=state.study_key("estimators"), placeholder="Choose at least one",
        )  # fmt: skip
        folds = right.selectbox(
            "Folds", list(FOLDS), format_func=FOLDS.__getitem__, key=state.study_key("folds")
        )
        if "/" in name or name in ("", ".", ".."):
            st.warning("A name has no slash and is not empty.", icon=":material/warning:")
            return
        st.code(build_command(folder, name, estimators, folds), language="bash", wrap_lines=True)


def build_command(folder: str, name: str, estimators: Sequence[str], folds: str) -> str:
    """Return the command line of a study."""
    out = study_cache.studies_folder() / name
    words = ["liftlens", "protocol", folder or "DATASET", "--estimator", ",".join(estimators),
             "--folds", folds, "--out", str(out)]  # fmt: skip
    return " ".join(shlex.quote(word) if word else "''" for word in words)


def show_statements(study: StoredStudy) -> None:
    """Say in words what was found; a leak comes first."""
    document = study.document
    settings, subjects = document["settings"], document["subjects"]
    st.html(
        facts_html(
            (
                f"{count(len(subjects), 'person')}: {', '.join(subjects)}",
                f"Folds: {FOLDS.get(document['folds'], document['folds'])}",
                f"Views: {settings.get('views', '2')}",
                f"LiftLens {document['liftlens_version']}",
            )
        )
    )
    for features, leak in document["leaks"].items():
        if leak["is_raised"]:
            st.warning(f"{features}: {leak['sentence']}", icon=":material/warning:")
    lead, *others = document["statements"]
    with st.container(border=True):
        st.markdown(f"**{lead}**")
        st.html(list_html(others[:SHOWN_STATEMENTS]))
        if others[SHOWN_STATEMENTS:]:
            with st.expander("More"):
                st.html(list_html(others[SHOWN_STATEMENTS:]))


def show_methods(study: StoredStudy) -> None:
    """Show every method's error, person by person, and the table of all."""
    figure = study_charts.plot_persons(_means(study), dark=is_dark())
    st.plotly_chart(figure, config=CHART, alt="Marker error of every method, person by person")
    _show_table(study.document["tables"]["methods"])
    if "comparisons" in study.document["tables"]:
        with st.expander("Methods against each other"):
            _show_table(study.document["tables"]["comparisons"])


def _means(study: StoredStudy) -> dict[str, dict[str, float]]:
    found: dict[str, dict[str, float]] = {name: {} for name in study.methods}
    for row in study.table("table1"):
        if row["task"] == "all" and row["subject"] != "all" and row["mean_mm"]:
            found[row["method"]][row["subject"]] = float(row["mean_mm"])
    return {method: persons for method, persons in found.items() if persons}


def _show_table(table: Mapping[str, Sequence[Sequence[str]]]) -> None:
    st.html(table_html([(str(title), "") for title in table["head"]], table["rows"]))
    for note in table["notes"]:
        st.caption(str(note))


def show_tables(study: StoredStudy) -> None:
    """Show Tables 1 to 3 as in the paper, for the method it is about."""
    tables = study.document["tables"]
    st.caption(f"For {study.document['main_method']}; the files below have every method.")
    for tab, name in zip(st.tabs(TABS), PAPER_TABLES, strict=True):
        with tab:
            _show_table(tables[name])
    with st.expander("Limits of agreement and equivalence"):
        _show_table(tables["agreement"])


def _choose_method(study: StoredStudy, key: str) -> str:
    main = study.document["main_method"]
    chosen: str = st.selectbox(
        "Method",
        study.methods,
        index=study.methods.index(main),
        key=state.study_key(key),
        width=360,
    )
    return chosen


def show_angles(study: StoredStudy) -> None:
    """Show the error of every joint angle, both sides, of one method."""
    method = _choose_method(study, "angles")
    rows = [row for row in study.table("angles") if row["method"] == method]
    figure = study_charts.plot_angles(rows, dark=is_dark())
    st.plotly_chart(figure, config=CHART, alt=f"Joint-angle differences of {method}")
    st.caption("Against inverse kinematics of the measured markers.")


def show_curves(study: StoredStudy) -> None:
    """Show one angle of one trial, from the videos and from the markers."""
    left, middle, right = st.columns(3)
    with left:
        method = _choose_method(study, "curves")
    trial = middle.selectbox(
        "Trial", study.trials(), format_func=lambda one: one[1], key=state.study_key("trial")
    )
    angles = study.document["angles"]
    start = "knee_flexion_r"
    angle = right.selectbox(
        "Angle",
        angles,
        index=angles.index(start) if start in angles else 0,
        format_func=study_charts.name_study_angle,
        key=state.study_key("angle"),
    )
    try:
        curves = study.curves(method, *trial)
    except EngineError as error:
        st.error(str(error), icon=":material/error:")
        return
    figure = study_charts.plot_study_curves(curves, angle, dark=is_dark())
    words = f"{study_charts.name_study_angle(angle)} of {trial[1]}"
    st.plotly_chart(figure, config=CHART, alt=f"{words}: video and markers")


def show_figures(study: StoredStudy) -> None:
    """Show the printed figures; they are drawn for paper, so on white."""
    words = study.document["figures"]
    drawn = [(name, path) for name in words if (path := study.figure(name)) is not None]
    if not drawn:
        st.info("The study has no figures.", icon=":material/search_off:")
    for name, path in drawn:
        with st.expander(words[name], expanded=name == "figure2"):
            st.image(str(path), width="stretch")


def show_method(study: StoredStudy) -> None:
    """Say how the study was done."""
    with st.expander("Folds, reference, statistics and settings"):
        st.html(list_html(study.document["notes"]))


def show_downloads(study: StoredStudy) -> None:
    """Offer the report and everything it was made of."""
    name = study.folder.name
    with st.container(horizontal=True):
        st.download_button(
            "Whole study (zip)",
            lambda: study_cache.zip_study(name),
            key="download-study",
            file_name=f"{name}.zip",
            mime="application/zip",
            type="primary",
            icon=":material/folder_zip:",
            on_click="ignore",
            help="Report (PDF and HTML), study.json, tables (CSV) and figures (PNG).",
        )
        for file_name, title, mime in (
            (PDF_NAME, "Report (PDF)", "application/pdf"),
            (REPORT_NAME, "Report (HTML)", "text/html"),
        ):
            path = study.folder / file_name
            if path.is_file():
                st.download_button(
                    title,
                    path.read_bytes,
                    key=f"download-{file_name}",
                    file_name=f"{name}_{file_name}",
                    mime=mime,
                    icon=":material/download:",
                    on_click="ignore",
                )
