"""Parts that show where cameras stood and whether their calibration may be trusted."""

from __future__ import annotations

import math
from collections.abc import Sequence
from html import escape

import streamlit as st

from dashboard import cache, camera_charts
from dashboard.labels import CHECK_LEVELS, HELP, SOURCES, SYNC_METHODS
from dashboard.widgets import chip_html, is_dark, list_html, show_problem, table_html
from engine.datatypes import Calibration, CalibrationCheck, CheckLevel, PoseTrack, SyncEstimate
from engine.errors import EngineError
from engine.storage.results import StoredResult

ORDER = (CheckLevel.RED, CheckLevel.AMBER, CheckLevel.GREEN)


def show_two_views(result: StoredResult) -> None:
    """Show cameras, checks and clock of a trial filmed from two sides."""
    if result.calibration is None or result.sync is None:
        return
    st.subheader("Where the cameras stood", anchor=False)
    picture, words = st.columns([5, 6], gap="large")
    with picture:
        show_cameras(result.calibration, result.corrected)
    with words:
        show_checks(result.checks)
        show_facts(result.calibration, result.sync)
        _keep(result)


def show_cameras(calibration: Calibration, track: PoseTrack | None = None) -> None:
    """Show cameras, floor and person in three dimensions."""
    figure = camera_charts.plot_cameras(calibration, track, dark=is_dark())
    words = camera_charts.describe_cameras(calibration)
    st.plotly_chart(figure, width="stretch", config={"displayModeBar": False}, alt=words)
    st.caption(words)


def show_checks(checks: Sequence[CalibrationCheck]) -> None:
    """Show the worst check as the verdict, the others below it."""
    ordered = sorted(checks, key=lambda check: ORDER.index(check.level))
    if not ordered:
        st.info("These cameras were not checked against a person yet.", icon=":material/info:")
        return
    worst = ordered[0]
    label = CHECK_LEVELS[worst.level]
    what = label.meaning if worst.level is CheckLevel.GREEN else worst.sentence
    st.html(f"<p>{chip_html(label)} {escape(what)} {escape(worst.action)}</p>")
    with st.expander(f"All {len(ordered)} checks", icon=":material/checklist:"):
        rows = "".join(
            f"<p>{chip_html(CHECK_LEVELS[c.level])} {escape(c.sentence)} {escape(c.action)}</p>"
            for c in ordered
        )
        st.html(f"<div>{rows}</div>")


def show_facts(calibration: Calibration, sync: SyncEstimate | None = None) -> None:
    """Show how the cameras were found and how sure that is."""
    rows = [
        ("Cameras found", SOURCES.get(calibration.source, calibration.source)),
        ("Angle between them", f"{camera_charts.angle_between(calibration):.0f}°"),
        ("Scale of all lengths", _error(100 * calibration.scale_sigma, "%")),
        ("Vertical", _error(calibration.tilt_sigma_deg, "°")),
        ("Height of the floor", _error(100 * calibration.floor_sigma_m, "cm")),
    ]
    if sync is not None:
        sure = "" if math.isnan(sync.sigma_s) else f" ± {sync.sigma_s:.3f}"
        rows.append(("Second video starts at", f"{_signed(sync.offset_s)}{sure} s"))
        rows.append(("Clocks matched", SYNC_METHODS.get(sync.method, sync.method)))
    head = (("How the cameras were placed", ""), ("± is one standard error", ""))
    st.html(table_html(head, rows, css="ll-plain"))
    if notes := calibration.provenance.get("notes"):
        st.html(list_html(str(note) for note in notes))


def _error(value: float, unit: str) -> str:
    return "unknown" if math.isnan(value) else f"± {value:.1f} {unit}".replace(" °", "°")


def _signed(value: float) -> str:
    return f"{value:+.3f}".replace("-", "−")


def _keep(result: StoredResult) -> None:
    """Offer to use these cameras for later films from the same places."""
    text = cache.calibration_text(result)
    if not text:
        return
    with st.popover("Use these cameras again", icon=":material/bookmark_add:"):
        st.caption(HELP["keep_calibration"])
        name = st.text_input("Name", placeholder="for example Hall 2, packing", max_chars=60)
        if st.button("Keep", type="primary", disabled=not name.strip()):
            cache.keep_calibration(name.strip(), text)
            st.success(f"Kept as “{name.strip()}”; choose it in a new assessment.")
    st.download_button(
        "Download the calibration",
        text,
        file_name="cameras.toml",
        mime="application/toml",
        icon=":material/download:",
    )


def show_kept() -> str | None:
    """Show the kept calibrations; return the path of the one chosen."""
    kept = cache.calibrations()
    if not kept:
        st.info(
            "No calibration is kept yet. Add a file here, or keep the cameras of a trial that was "
            "filmed from two sides.",
            icon=":material/videocam:",
        )
        return None
    return st.selectbox("Kept cameras", list(kept), format_func=kept.__getitem__)


def show_kept_one(path: str) -> None:
    """Show one kept calibration, with what can be done about it."""
    try:
        calibration = cache.read_kept_calibration(path)
    except EngineError as error:
        st.error(str(error), icon=":material/error:")
        calibration = None
    if calibration is not None:
        picture, words = st.columns([5, 6], gap="large")
        with picture:
            show_cameras(calibration)
        with words:
            show_facts(calibration)
    if st.button("Delete these cameras", icon=":material/delete:"):
        cache.remove_calibration(path)
        st.rerun()


def add_file() -> None:
    """Take a calibration file of any program and keep it."""
    arrived = st.file_uploader(
        "Calibration file", type=["toml", "txt", "xml", "json"], help=HELP["calibration_file"]
    )
    if arrived is None:
        return
    try:
        calibration, text = cache.import_calibration(arrived, arrived.name)
    except EngineError as error:
        show_problem(str(error))
        return
    count = len(calibration.cameras)
    st.success(f"{arrived.name}: {count} cameras.", icon=":material/check_circle:")
    name = st.text_input("Name", value=arrived.name.split(".")[0], max_chars=60)
    if st.button("Keep", type="primary", disabled=not name.strip()):
        cache.keep_calibration(name.strip(), text)
        st.rerun()
