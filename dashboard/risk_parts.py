"""The parts of the page that shows how risky a movement is, when, and why."""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Mapping, Sequence
from html import escape
from typing import Any

import streamlit as st

from dashboard import labels, pages, risk_charts, state
from dashboard.labels import format_interval, format_number
from dashboard.trial_parts import URGENCY
from dashboard.widgets import (
    chip_html,
    facts_html,
    is_dark,
    level_label,
    list_html,
    table_html,
    when,
)
from engine.datatypes import Flag, FlagLevel, RiskResult
from engine.ergonomics.base import MethodInfo, list_methods
from engine.storage.library import TrialEntry
from engine.storage.results import StoredResult

CHART = {"displaylogo": False, "displayModeBar": False}
LEAD_S = 0.5
"""The video starts so much before a moment, so that one sees it come."""
MOMENTS_EACH = 2
FRAME_ORDER = ("reba", "rula", "owas", "posture_zones")
FROM_START = "From the start"


def choose_trial(entries: Sequence[TrialEntry]) -> str | None:
    """Let the user choose a trial; the address may name one already."""
    usable = {entry.id: entry for entry in entries if not entry.is_damaged}
    named = state.trial_id()
    if not usable and named is None:
        st.info("There is no trial yet. Assess a video first.", icon=":material/list:")
        if st.button("Add a video", type="primary", icon=":material/add:"):
            st.switch_page(pages.NEW_ASSESSMENT)
        return None
    ids = list(usable)
    chosen = st.selectbox(
        "Trial",
        ids,
        index=ids.index(named) if named in usable else None,
        format_func=lambda one: _name_entry(usable[one]),
        placeholder="Choose a trial",
    )
    if chosen is None:
        # A damaged trial, or none of that name: reading it says so in one sentence.
        return named
    if chosen != named:
        state.set_trial_id(chosen)
    return str(chosen)


def _name_entry(entry: TrialEntry) -> str:
    name = entry.label or entry.job or "Untitled trial"
    return " · ".join(part for part in (name, entry.subject, when(entry.created)) if part)


def show_subject(result: StoredResult) -> None:
    """Show what is known of the work, and the way to the trial's page."""
    task = result.task
    facts = (
        f"Person {result.subject.label}",
        labels.count(len(result.lifts), "lift"),
        "Load not given" if task.load_kg is None else f"Load {task.load_kg:g} kg",
        "How often is not given"
        if task.frequency_per_min is None
        else f"{task.frequency_per_min:g} times a minute",
    )
    st.html(facts_html(facts))


def show_methods(result: StoredResult) -> None:
    """Show what every method says, side by side: disagreement stays visible."""
    infos = _infos()
    rows = "".join(
        _method_html(risk, infos.get(name), _level_of(result.flags, name))
        for name, risk in result.risk.items()
    )
    if not rows:
        st.info("No method was part of this assessment.", icon=":material/search_off:")
        return
    with st.container(border=True):
        st.html(f"<div>{rows}</div>")
    st.caption(
        "Methods look at different things: posture, load, distance, repetition. Where they "
        "disagree, both are shown; a mean of them would mean nothing."
    )


def _infos() -> dict[str, MethodInfo]:
    return {method.info.name: method.info for method in list_methods()}


def _level_of(flags: Sequence[Flag], method: str) -> FlagLevel | None:
    levels = [flag.level for flag in flags if flag.method == method]
    return min(levels, key=URGENCY.index, default=None)


def _method_html(risk: RiskResult, info: MethodInfo | None, level: FlagLevel | None) -> str:
    title = info.title if info else labels.name_method(risk.method)
    text = _describe_value(risk, info) if risk.is_applicable else _describe_refusal(risk)
    chip = chip_html(level_label(level if risk.is_applicable else None))
    single = " · single source" if info and info.verification == "V1" else ""
    about = escape(info.description if info else "")
    return (
        f'<div class="ll-flag"><div>{chip}</div><div><span title="{about}"><b>{escape(title)}</b>'
        f'<span class="ll-quiet ll-small">{single}</span></span>'
        f"<p>{escape(labels.typeset(text))}</p></div></div>"
    )


def _describe_refusal(risk: RiskResult) -> str:
    why = labels.sentence(risk.reasons[0]) if risk.reasons else ""
    return f"Not applicable here. {why}".strip()


def _describe_value(risk: RiskResult, info: MethodInfo | None) -> str:
    """Return value, range, level and action in one line."""
    if math.isnan(risk.value):
        return labels.sentence(risk.category)
    digits = 1 if info is None or info.decimals is None else info.decimals
    name = (info.value_name if info else "") or labels.VALUES.get(risk.method, "Value")
    unit = f" {risk.unit}" if risk.unit else ""
    span = format_interval(risk.interval, digits)
    sure = f" (95 % range {span})" if span else ""
    level = next((x for x in info.levels if risk.value <= x.upper), None) if info else None
    action = f" Action: {level.action}." if level else ""
    text = f"{name} {format_number(risk.value, digits)}{unit}{sure}: {risk.category}.{action}"
    return text[0].upper() + text[1:]


# --------------------------------------------------------------------------- over time


def show_moments(result: StoredResult) -> None:
    """Show the video, from the start or from one of the worst moments on."""
    if result.overlay_path is None:
        st.info("This trial was saved without its annotated video.", icon=":material/videocam_off:")
        return
    moments = {FROM_START: (0.0, ""), **dict(_list_moments(result))}
    slot = st.container()
    chosen = st.radio(
        "Play from",
        list(moments),
        captions=[posture for _, posture in moments.values()],
    )
    with slot:
        st.video(
            str(result.overlay_path),
            start_time=moments[chosen or FROM_START][0],
            muted=True,
            alt="The movement with the measured joints drawn on it; heads are blurred",
        )


def _list_moments(result: StoredResult) -> Iterator[tuple[str, tuple[float, str]]]:
    """Yield the worst moments by name: where the video starts, and the posture."""
    first_s = float(result.angles.time_s[0])
    for risk in _frame_results(result):
        for moment in risk.details["worst_moments"][:MOMENTS_EACH]:
            at_s = moment["peak_s"]
            name = f"{labels.name_method(risk.method)} {moment['score']} at {at_s:.1f} s"
            yield name, (max(0.0, at_s - first_s - LEAD_S), _typeset(moment["posture"]))


def _typeset(text: str) -> str:
    """Typeset arithmetic, negative numbers too."""
    return re.sub(r"(?<![\w.])-(?=\d)", "−", labels.typeset(text))


def _frame_results(result: StoredResult) -> list[RiskResult]:
    found = [risk for risk in result.risk.values() if risk_charts.has_frames(risk)]
    return sorted(found, key=_rank)


def _rank(risk: RiskResult) -> tuple[bool, int]:
    """Put methods that score every frame first, the whole body before its parts."""
    known = risk.method in FRAME_ORDER
    place = FRAME_ORDER.index(risk.method) if known else 0
    return not risk_charts.has_frames(risk), place if known else len(FRAME_ORDER)


def show_timeline(result: StoredResult) -> None:
    """Show the score of every frame, one row a method."""
    results = _frame_results(result)
    if not results:
        st.info(
            "No posture could be scored: the trunk was hardly seen, or these methods were not "
            "part of the assessment.",
            icon=":material/search_off:",
        )
        return
    figure = risk_charts.plot_scores(results, result.angles.time_s, result.lifts, dark=is_dark())
    st.plotly_chart(figure, config=CHART, alt="Posture scores over time with their action levels")
    st.caption(
        "The band is about 95 %, from the errors of the angles. Dashed lines: the load is lifted "
        "and set down. The line is open where nothing was scored."
    )


# --------------------------------------------------------------------------- one method


def choose_method(result: StoredResult) -> RiskResult | None:
    """Let the user choose a method; those that score every frame come first."""
    usable = {risk.method: risk for risk in sorted(result.risk.values(), key=_rank) if risk.steps}
    if not usable:
        st.info("No method could be worked out here.", icon=":material/search_off:")
        return None
    first = next(iter(usable))
    chosen = st.segmented_control(
        "Method",
        list(usable),
        format_func=labels.name_method,
        default=first,
        required=True,
        label_visibility="collapsed",
    )
    return usable[chosen or first]


def show_steps(risk: RiskResult) -> None:
    """Show the calculation line by line: measured, entered, assumed."""
    st.html(list_html(map(_typeset, risk.steps), "ll-steps", "ol"))
    if risk.reasons:
        with st.expander("Keep in mind", icon=":material/info:", expanded=True):
            st.html(list_html(map(labels.sentence, risk.reasons)))
    rows = [
        (
            labels.INPUTS.get(item.name, item.name[:1].upper() + item.name[1:]),
            labels.format_input(item),
            labels.PROVENANCE[item.provenance],
        )
        for item in risk.inputs
    ]
    if rows:
        with st.expander("What went in, and where it comes from", icon=":material/input:"):
            st.html(table_html((("Input", ""), ("Value", ""), ("Source", "")), rows))
    st.caption(risk.reference)


def show_levels(risk: RiskResult) -> None:
    """Show how long each level lasts, and how sure that is."""
    levels: Sequence[Mapping[str, Any]] = risk.details.get("levels", ())
    if not risk_charts.has_frames(risk):
        st.caption("This method judges lifts, not every moment.")
        return
    st.markdown("**Time in each level**")
    st.html("".join(map(_level_html, levels)))
    scored = risk.details["scored_share"]
    if scored < 1:
        st.caption(f"Shares of the time that could be scored ({scored:.0%} of the video).")
    _show_parts(risk)


def _level_html(level: Mapping[str, Any]) -> str:
    low, high = level["share_low"], level["share_high"]
    span = (
        "" if low is None or high is None else f", 95 % range {100 * low:.0f} to {100 * high:.0f} %"
    )
    chance = level["probability"]
    sure = "" if chance is None else f"; chance that the worst is here: {100 * chance:.0f} %"
    share = 100 * level["share"]
    under = f"{level['time_s']:.1f} s{span}{sure}"
    return (
        f'<div class="ll-factor"><div>{escape(str(level["name"]).capitalize())}</div>'
        f'<div><div class="ll-bar"><i style="width:{share:.1f}%"></i></div>'
        f'<span class="ll-in">{escape(under)}</span></div>'
        f'<div class="ll-m">{share:.0f} %</div></div>'
    )


def _show_parts(risk: RiskResult) -> None:
    """Show what else the method tells: parts of the body, standards."""
    body = risk.details.get("body_parts")
    if body:
        st.markdown("**By share of time, part by part** (single source)")
        rows = [
            (row["part"].capitalize(), row["posture"], f"{row['share']:.0%}", str(row["category"]))
            for row in body
        ]
        st.html(table_html((("Part", ""), ("Posture", ""), ("Time", ""), ("Category", "")), rows))
    parts = risk.details.get("parts")
    if parts:
        st.markdown("**By standard**")
        words = {None: "not seen", 1: "acceptable", 2: "conditional", 3: "not acceptable"}
        rows = [
            (row["part"].capitalize(), words[row["en_1005_4"]], words[row["iso_11226"]])
            for row in parts
        ]
        head = (
            ("Part", ""),
            ("Moving (EN 1005-4)", "How often the posture is taken."),
            ("Holding (ISO 11226)", "How long the posture is held."),
        )
        st.html(table_html(head, rows, css="ll-plain"))


def show_drivers(risk: RiskResult) -> None:
    """Show which inputs raise the score, which make it unsure, and what hangs on assumptions."""
    details = risk.details
    drivers, shares = details.get("drivers", ()), details.get("uncertainty_shares", {})
    if drivers:
        st.markdown("**What raises the worst score**")
        rows = [(row["part"].capitalize(), _describe_fall(row)) for row in drivers]
        head = (("Part of the body", ""), ("Score if it alone were neutral", ""))
        st.html(table_html(head, rows))
    known = {name: share for name, share in shares.items() if share and share >= 0.01}
    if known:
        st.markdown("**What makes it unsure**")
        rows = [
            (labels.INPUTS.get(name, name[:1].upper() + name[1:]), f"{share:.0%}")
            for name, share in sorted(known.items(), key=lambda item: -item[1])[:5]
        ]
        st.html(table_html((("Input", ""), ("Share of the doubt", "Of the variance.")), rows))
    if not drivers and not known:
        st.caption("No single input decides.")
    worst = details.get("worst_case")
    if risk_charts.has_frames(risk) and worst is not None and worst > risk.value:
        st.caption(
            f"If everything the video does not show were at its worst, the score would be {worst}."
        )


def _describe_fall(driver: Mapping[str, Any]) -> str:
    after = driver["score_without"]
    return f"{after} instead of {after + driver['falls_by']}"
