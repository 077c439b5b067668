"""The parts of a trial's page: each shows one part of a stored result."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from functools import partial
from html import escape
from pathlib import Path
from typing import Any

import streamlit as st

from dashboard import cache, charts, labels, manage_cache
from dashboard.labels import format_measurement, format_number, format_window
from dashboard.widgets import (
    chip_html,
    facts_html,
    is_dark,
    level_label,
    list_html,
    table_html,
    when,
)
from engine.corrections import read_corrections
from engine.datatypes import Flag, FlagLevel, RiskResult
from engine.report import ReportOptions
from engine.storage.results import StoredResult

URGENCY = (FlagLevel.HIGH, FlagLevel.REVIEW, FlagLevel.OK)
LIFTING_INDEX_METHOD = "rnle"
SHOWN_FLAGS = 4
"""So many flags are open at once, the verdict among them; the others wait folded up."""


def show_title(result: StoredResult) -> None:
    """Show what was filmed, when, and of whom."""
    document = result.document
    st.title(document["label"] or "Untitled trial", anchor=False)
    person = f"Person {result.subject.label}"
    length = document["views"][0]["duration_s"]
    corrected = len(read_corrections(document).all)
    facts = (
        when(document["created"]),
        person,
        labels.count(len(result.lifts), "lift"),
        f"{length:.1f} s of video" if length else "",
        f"Load {result.task.load_kg:g} kg" if result.task.load_kg is not None else "Load not given",
        " · ".join(part for part in (document["site"], document["job"]) if part),
        f"{labels.count(corrected, 'correction')} by hand" if corrected else "",
    )
    st.html(facts_html(facts))


def show_flags(result: StoredResult) -> None:
    """Show the most urgent flag as the verdict, and the others below it."""
    show_verdict(result)
    show_other_flags(result)


def show_verdict(result: StoredResult) -> None:
    """Show the most urgent flag as the verdict."""
    flags = _by_urgency(result)
    st.html(_verdict_html(flags[0] if flags else None, result.risk.get(LIFTING_INDEX_METHOD)))


def show_other_flags(result: StoredResult) -> None:
    """Show the flags below the verdict, in words."""
    first, more = _by_urgency(result)[1:SHOWN_FLAGS], _by_urgency(result)[SHOWN_FLAGS:]
    if not first:
        return
    with st.container(border=True):
        st.html(f"<div>{''.join(map(_flag_html, first))}</div>")
    if more:
        with st.expander(labels.count(len(more), "more flag"), icon=":material/flag:"):
            st.html(f"<div>{''.join(map(_flag_html, more))}</div>")


def _by_urgency(result: StoredResult) -> list[Flag]:
    return sorted(result.flags, key=lambda flag: URGENCY.index(flag.level))


def _verdict_html(flag: Flag | None, risk: RiskResult | None) -> str:
    label = level_label(flag.level if flag else None)
    if flag is None:
        text = "<h3>No flag was raised</h3><p>Nothing in this video could be judged.</p>"
    else:
        text = f"<h3>{_words(flag.what)}</h3><p>{_words(flag.why)}</p>{_origin_html(flag)}"
        text += _change_html(flag)
    return (
        f'<section class="ll-verdict ll-tone-{label.css}" aria-label="Verdict">'
        f"<div>{chip_html(label)}{text}</div>{_score_html(risk)}</section>"
    )


def _words(text: str) -> str:
    return escape(labels.typeset(text))


def _change_html(flag: Flag) -> str:
    if not flag.change:
        return ""
    return f'<p class="ll-change"><b>What would change it</b><br>{_words(flag.change)}</p>'


def _origin_html(flag: Flag) -> str:
    lift = "" if flag.lift_index is None else f"Lift {flag.lift_index + 1}"
    parts = (lift, format_window(flag.start_s, flag.end_s), labels.name_method(flag.method))
    return f'<p class="ll-quiet ll-small">{escape(" · ".join(p for p in parts if p))}</p>'


def _score_html(risk: RiskResult | None) -> str:
    if risk is None or not risk.is_applicable or math.isnan(risk.value):
        return ""
    span = labels.format_interval(risk.interval)
    under = f"95 % range {span}" if span else ""
    return (
        f'<div class="ll-score" title="{escape(labels.HELP["lifting_index"])}">'
        f'<div class="ll-name">Lifting index</div>'
        f'<div class="ll-number">{labels.format_index(risk.value)}</div>'
        f'<div class="ll-quiet ll-small">{escape(under)}<br>{escape(risk.category)} '
        f"· goal: 1.0 or less</div></div>"
    )


def _flag_html(flag: Flag) -> str:
    change = f"<p>{_words(flag.change)}</p>" if flag.change else ""
    return (
        f'<div class="ll-flag"><div>{chip_html(level_label(flag.level))}</div>'
        f"<div><b>{_words(flag.what)}</b><p>{_words(flag.why)}</p>{change}{_origin_html(flag)}"
        "</div></div>"
    )


def show_lifts(result: StoredResult) -> None:
    """Show where the hands were at both ends of every lift."""
    if not result.lifts:
        st.info("No lift was found in this video.", icon=":material/search_off:")
        return
    head = (
        ("Lift", ""),
        ("When", "From lift-off to set-down."),
        ("Reach H", "Horizontal distance from the ankles to the hands (H), start → end."),
        ("Height V", "Height of the hands above the floor (V), start → end."),
        ("Side A", "Angle of the load to the side of straight ahead (A), start → end."),
        ("Travel D", "How far the load moves up or down (D)."),
        ("Hands", "How many hands moved with the load."),
    )
    rows = []
    for number, lift in enumerate(result.lifts, start=1):
        a, b = lift.origin, lift.destination
        rows.append(
            (
                str(number),
                f"{lift.start_s:.1f}–{lift.end_s:.1f} s",
                f"{format_measurement(a.H_cm, 'cm')} → {format_measurement(b.H_cm, 'cm')}",
                f"{format_measurement(a.V_cm, 'cm')} → {format_measurement(b.V_cm, 'cm')}",
                f"{format_measurement(a.A_deg, '°')} → {format_measurement(b.A_deg, '°')}",
                format_measurement(lift.D_cm, "cm"),
                str(lift.hands),
            )
        )
    st.html(table_html(head, rows))
    st.caption("Start → end of each lift. ± is one standard error.")


def show_angles(result: StoredResult) -> None:
    """Show the joint angles of one joint at a time."""
    there = {
        title: [name for name in names if name in result.angles.names]
        for title, names in labels.JOINTS.items()
    }
    there = {title: names for title, names in there.items() if names}
    if not there:
        st.info("No joint angle could be measured.", icon=":material/search_off:")
        return
    first = next(iter(there))
    # Pills wrap; a body model has more joints than fit beside each other.
    joint = st.pills(
        "Joint", list(there), default=first, required=True, label_visibility="collapsed"
    )
    names = there[joint or first]
    before = None
    if st.toggle("Show the curves before correction", help=labels.HELP["before"]):
        before = cache.uncorrected_angles(result.folder.name)
    figure = charts.plot_angles(result.angles, names, result.lifts, before=before, dark=is_dark())
    st.plotly_chart(
        figure, config={"displaylogo": False, "displayModeBar": False}, alt=f"{joint} angles"
    )
    missing = charts.share_missing(result.angles, names)
    gaps = f" Not seen for {missing:.0%} of the time: the curve stays open there." * (missing > 0)
    st.caption(
        f"The band is about 95 % (± 2 standard errors). Left and right are the person's.{gaps}"
    )


def show_equation(result: StoredResult) -> None:
    """Show the lifting equation of one lift with both ends side by side."""
    risk = result.risk.get(LIFTING_INDEX_METHOD)
    if risk is None:
        st.info("The lifting equation was not part of this assessment.")
        return
    if len(risk.per_lift) > 1:
        names = {index: f"Lift {index + 1}" for index in range(len(risk.per_lift))}
        worst = int(risk.details.get("governing_lift", 0))
        chosen = st.segmented_control(
            "Lift", list(names), format_func=names.__getitem__, default=worst, required=True,
            label_visibility="collapsed",
        )  # fmt: skip
        risk = risk.per_lift[worst if chosen is None else chosen]
    if not risk.is_applicable:
        st.warning("The lifting equation must not be used here.", icon=":material/block:")
        st.html(list_html(map(labels.sentence, risk.reasons)))
        return
    _show_ends(risk)
    if risk.reasons:
        with st.container(border=True):
            st.markdown("**Keep in mind**")
            st.html(list_html(map(labels.sentence, risk.reasons)))
    with st.expander("The calculation, step by step", icon=":material/calculate:"):
        st.html(list_html(map(labels.typeset, risk.steps), "ll-steps", "ol"))
    with st.expander("What went in, and where it comes from", icon=":material/input:"):
        st.html(table_html((("Input", ""), ("Value", ""), ("Source", "")), _input_rows(risk)))
    st.caption(risk.reference)


def _show_ends(risk: RiskResult) -> None:
    details = risk.details
    counted = details.get("counted_ends", ())
    columns = st.columns(2)
    for column, (end, title) in zip(
        columns, (("origin", "Start of the lift"), ("destination", "End of the lift")), strict=True
    ):
        if end in details:
            html = _end_html(title, end, details, is_counted=end in counted)
            column.html(html)


def _end_html(title: str, end: str, details: Mapping[str, Any], *, is_counted: bool) -> str:
    values = details[end]
    governs = is_counted and details.get("governing_end") == end
    note = "decides the result" if governs else "" if is_counted else "for the record only"
    costs = min(labels.FACTORS, key=lambda name: values[name])
    rows = "".join(
        _factor_html(name, values, details, is_costliest=name == costs and values[name] < 1)
        for name in labels.FACTORS
    )
    limit = f"{format_number(values['RWL_kg'], 1)} kg"
    index = values.get("LI")
    shown = "" if index is None or math.isnan(index) else f"Index {labels.format_index(index)}"
    return (
        f'<div class="ll-end{"" if is_counted else " ll-unused"}"><header><h4>{title}</h4>'
        f'<span class="ll-quiet ll-small">{note}</span></header>{rows}'
        f'<div class="ll-sum"><span>Recommended limit<br><b>{limit}</b></span>'
        f"<b>{shown}</b></div></div>"
    )


def _factor_html(
    name: str, values: Mapping[str, Any], details: Mapping[str, Any], *, is_costliest: bool
) -> str:
    title, tip = labels.FACTORS[name]
    size = labels.format_factor_input(name, values, details)
    share = max(0.0, min(1.0, values[name]))
    tag = '<span class="ll-tag">costs most</span>' if is_costliest else ""
    return (
        f'<div class="ll-factor{" ll-costs" if is_costliest else ""}" title="{escape(tip)}">'
        f'<div>{title}<br><span class="ll-in">{escape(size)}</span></div>'
        f'<div><div class="ll-bar"><i style="width:{100 * share:.1f}%"></i></div>{tag}</div>'
        f'<div class="ll-m">× {format_number(values[name], 2)}</div></div>'
    )


def _input_rows(risk: RiskResult) -> Iterable[tuple[str, str, str]]:
    for item in risk.inputs:
        name = labels.INPUTS.get(item.name, item.name.capitalize())
        yield name, labels.format_input(item), labels.PROVENANCE[item.provenance]


def show_confidence(result: StoredResult) -> None:
    """Show how much was seen, and what is not known of the scene."""
    st.html(_coverage_html(result.document["coverage"]))
    scene, subject = result.scene, result.document["subject"]
    stature = "entered" if subject["provenance"]["stature_m"] == "user" else "assumed"
    height = f"{subject['stature_m']:.2f} ± {subject['stature_sigma_m']:.2f} m"
    facts = (
        ("Body height", f"{height}, {stature}"),
        ("Scale of all lengths", _error(100 * scene.scale_sigma, "%")),
        ("Vertical (tilt of the camera)", _error(scene.tilt_sigma_deg, "°")),
        ("Direction the person faces", _error(scene.heading_sigma_deg, "°")),
        ("Height of the floor", _error(100 * scene.floor_sigma_m, "cm")),
        ("Seen from", labels.name_view(scene.view_azimuth_deg)),
        *_body_facts(result.document.get("body")),
    )
    head = (("What the measurement rests on", ""), ("± is one standard error", ""))
    st.html(table_html(head, facts, css="ll-plain"))
    if result.warnings:
        st.markdown("**Warnings of the measurement**")
        st.html(list_html(map(labels.sentence, result.warnings)))


def _body_facts(body: Mapping[str, Any] | None) -> Iterable[tuple[str, str]]:
    """Say how well the body model fits the joints that were seen."""
    if body is None:
        return
    median, most = (body["residual_cm"][key] for key in ("median", "p95"))
    distance = (
        "nowhere fitted"
        if median is None
        else f"{median:.1f} cm (median), below {most:.1f} cm in 95 % of the pictures"
    )
    yield "Distance of the joints from the body model", distance
    yield "Body model fitted", f"in {body['fitted']:.0%} of the pictures"


def _error(value: float, unit: str) -> str:
    return "unknown" if math.isnan(value) else f"± {value:.1f} {unit}".replace(" °", "°")


def _coverage_html(coverage: Mapping[str, float | None]) -> str:
    parts = [(key, coverage.get(key) or 0.0) for key in labels.COVERAGE]
    bar = "".join(
        f'<i class="ll-c-{key}" style="flex:{share:.4f}"></i>' for key, share in parts if share > 0
    )
    legend = "".join(
        f'<span title="{escape(labels.COVERAGE[key][1])}"><i class="ll-c-{key}"></i>'
        f"{share:.0%} {labels.COVERAGE[key][0]}</span>"
        for key, share in parts
    )
    return (
        '<div><div class="ll-small ll-quiet" style="margin-bottom:.35rem">Joint positions</div>'
        f'<div class="ll-cover" aria-hidden="true">{bar}</div>'
        f'<div class="ll-legend">{legend}</div></div>'
    )


def show_provenance(result: StoredResult) -> None:
    """Show how the result was made."""
    document = result.document
    view = document["views"][0]
    width, height = view["size_px"]
    rate = f"{view['fps']:.1f} pictures a second" if view["fps"] else ""
    rows = (
        ("Video", f"{view['file_name']}, {width} × {height}, {rate}"),
        ("Fingerprint (SHA-256)", f"{view['sha256'][:16]}…"),
        ("Estimator", document["backend"]),
        ("Joint angles by", document["solver"]),
        ("Correction", document["config"].get("correction", {}).get("preset", "")),
        ("LiftLens", document["liftlens_version"]),
        ("Computing time", labels.format_span(_computing_time_s(document["timings_s"]))),
    )
    st.html(table_html((("How it was made", ""), ("", "")), rows, css="ll-plain"))


def _computing_time_s(timings_s: Mapping[str, float | None]) -> float:
    """Return the time of all stages; that of the networks is a part of the pose's."""
    return sum(t or 0.0 for stage, t in timings_s.items() if stage != "networks")


def show_downloads(result: StoredResult) -> None:
    """Offer the result folder and its main files."""
    folder = result.folder
    with st.container(horizontal=True):
        st.download_button(
            "Whole result (zip)",
            lambda: cache.zip_result(folder),
            key="download-zip",
            file_name=f"{folder.name}.zip",
            mime="application/zip",
            type="primary",
            icon=":material/folder_zip:",
            on_click="ignore",
            help="Every file of the result: numbers, joint positions, angles, annotated video.",
        )
        st.download_button(
            "One page (PDF)",
            lambda: manage_cache.trial_report(folder.name, ReportOptions()),
            key="download-pdf",
            file_name=f"{folder.name}.pdf",
            mime="application/pdf",
            icon=":material/picture_as_pdf:",
            on_click="ignore",
            help="Picture, flags, limits with their intervals, and what to change.",
        )
        with st.popover("For other tools", icon=":material/download:"):
            _offer_exports(folder)


def _offer_exports(folder: Path) -> None:
    for suffix, what in labels.EXPORTS.items():
        st.download_button(
            f"{what} (.{suffix})",
            partial(cache.export_bytes, folder, suffix),
            key=f"download-{suffix}",
            file_name=f"{folder.name}.{suffix}",
            on_click="ignore",
            width="stretch",
        )
    st.download_button(
        "Everything as numbers (.json)",
        (folder / "trial.json").read_bytes(),
        file_name="trial.json",
        mime="application/json",
        on_click="ignore",
        width="stretch",
    )
