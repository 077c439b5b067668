"""The parts of the page that put several trials together: before and after, and a whole job."""

from __future__ import annotations

import math
from collections.abc import Sequence
from html import escape

import streamlit as st
from streamlit.delta_generator import DeltaGenerator

from dashboard import improve_cache, improve_charts, labels, pages
from dashboard.improve_parts import CHART
from dashboard.labels import format_interval, format_number
from dashboard.widgets import chip_html, is_dark, level_label, list_html, table_html, when
from engine.datatypes import Flag, FlagLevel, RiskResult
from engine.ergonomics.base import list_methods
from engine.ergonomics.before_after import BeforeAfter, MeasureChange, Verdict
from engine.ergonomics.job import JobResult, PartResult
from engine.errors import EngineError
from engine.storage.library import TrialEntry

SHOWN = ("li", "rwl", "compression", "trunk")
VERDICTS: dict[Verdict | None, tuple[FlagLevel | None, str]] = {
    Verdict.IMPROVED: (FlagLevel.OK, "Improved"),
    Verdict.NOT_DISTINGUISHABLE: (FlagLevel.REVIEW, "Not distinguishable"),
    Verdict.WORSE: (FlagLevel.HIGH, "Worse"),
    None: (None, "Not compared"),
}
HEADLINES = {
    Verdict.IMPROVED: "The change worked",
    Verdict.NOT_DISTINGUISHABLE: "No difference that could be told from chance",
    Verdict.WORSE: "It got worse",
    None: "These trials can't be compared",
}
ALTERNATING, ROTATING = "They alternate", "One after the other"
ALL_JOBS = "All jobs"


def _usable(entries: Sequence[TrialEntry]) -> dict[str, TrialEntry]:
    return {entry.id: entry for entry in entries if not entry.is_damaged}


def _name_all(usable: dict[str, TrialEntry]) -> dict[str, str]:
    """Name the trials as briefly as tells them apart."""
    short = {
        name: " · ".join(
            part for part in (entry.label or entry.job or "Untitled", entry.subject) if part
        )
        for name, entry in usable.items()
    }
    titles = list(short.values())
    return {
        name: title if titles.count(title) == 1 else f"{title} · {when(usable[name].created)}"
        for name, title in short.items()
    }


def _ask_more_videos(text: str) -> None:
    st.info(text, icon=":material/list:")
    if st.button("Add a video", type="primary", icon=":material/add:"):
        st.switch_page(pages.NEW_ASSESSMENT)


def _filter_by_job(usable: dict[str, TrialEntry]) -> dict[str, TrialEntry]:
    jobs = sorted({entry.job for entry in usable.values() if entry.job})
    if len(jobs) < 2:
        return usable
    chosen = st.selectbox("Job", [ALL_JOBS, *jobs], key="sets_job")
    if chosen == ALL_JOBS:
        return usable
    return {name: entry for name, entry in usable.items() if entry.job == chosen}


# --------------------------------------------------------------------------- before and after


def show_before_after(entries: Sequence[TrialEntry]) -> None:
    """Let the user choose trials before and after a change, and show what became of it."""
    usable = _usable(entries)
    if len(usable) < 2:
        _ask_more_videos("Before and after need at least two trials in the library.")
        return
    usable = _filter_by_job(usable)
    first, second = st.columns(2, gap="large")
    with first:
        before = _ask_trials("Before the change", usable, taken=(), key="sets_before")
    with second:
        after = _ask_trials("After the change", usable, taken=before, key="sets_after")
    if not (before and after):
        st.info(
            "Choose the trials of either side: the same person at the same task, best three or "
            "more each time, filmed from the same place.",
            icon=":material/compare:",
        )
        return
    found = improve_cache.before_after(tuple(before), tuple(after))
    _show_verdict(found)
    if not found.changes:
        return
    one, two = ([improve_cache.measures(name) for name in part] for part in (before, after))
    shown = [change for change in found.changes if change.measure.key in SHOWN]
    for change, column in zip(shown, st.columns(max(1, len(shown))), strict=False):
        figure = improve_charts.plot_trials(change, one, two, dark=is_dark())
        with column:
            st.plotly_chart(
                figure, config=CHART, alt=f"{change.measure.name} of every trial, and the means"
            )
    if shown:
        st.caption(
            "Marks are trials with their measuring errors (about 95 %); the line joins the means."
        )
    _show_changes(found)


def _ask_trials(
    title: str, usable: dict[str, TrialEntry], *, taken: Sequence[str], key: str
) -> list[str]:
    free = [name for name in usable if name not in taken]
    names = _name_all(usable)
    return list(
        st.multiselect(
            title,
            free,
            format_func=names.__getitem__,
            placeholder="Choose trials",
            key=key,
        )
    )


def _show_verdict(found: BeforeAfter) -> None:
    level, word = VERDICTS[found.verdict]
    label = level_label(level)
    counts = (
        f"{labels.count(found.n[0], 'trial')} before, {labels.count(found.n[1], 'trial')} after"
    )
    reasons = list_html(map(labels.sentence, found.reasons)) if found.reasons else ""
    st.html(
        f'<section class="ll-verdict ll-tone-{label.css}" aria-label="Verdict"><div>'
        f"{chip_html(label, word)}<h3>{escape(HEADLINES[found.verdict])}</h3>"
        f"<p>{escape(labels.typeset(_minus(found.sentence)))}</p>"
        f'<p class="ll-quiet ll-small">{escape(counts)}</p>{reasons}</div></section>'
    )


def _minus(text: str) -> str:
    return text.replace(" -", " −").replace("(-", "(−").replace("− >", "->").replace("−>", "->")


def _show_changes(found: BeforeAfter) -> None:
    head = (
        ("Measure", ""),
        ("Before", "Mean over the trials."),
        ("After", "Mean over the trials."),
        ("Difference", "After minus before, with its 95 % interval."),
        ("Verdict", "Whether the interval leaves out 0, and on which side."),
        ("Least change", "The smallest change between two single trials that is no error (MDC)."),
    )
    st.html(table_html(head, map(_change_row, found.changes)))
    st.caption(
        "The verdict above rests on the first row. With many rows, one in twenty differs by "
        "chance alone; heights are stated without a verdict."
    )


def _change_row(change: MeasureChange) -> tuple[str, ...]:
    measure, digits = change.measure, change.measure.decimals
    unit = {"": "", "deg": "°", "%": " %"}.get(measure.unit, f" {measure.unit}")
    span = format_interval(change.interval, digits)
    sign = "+" if change.difference > 0 else ""
    mdc = "–" if math.isnan(change.mdc) else f"{format_number(change.mdc, digits)}{unit}"
    verdict = VERDICTS[change.verdict][1] if measure.better else "–"
    return (
        f"{measure.name[:1].upper()}{measure.name[1:]}",
        f"{format_number(change.before, digits)}{unit}",
        f"{format_number(change.after, digits)}{unit}",
        f"{sign}{format_number(change.difference, digits)}{unit}" + (f" ({span})" if span else ""),
        verdict,
        mdc,
    )


# --------------------------------------------------------------------------- a job


def show_job(entries: Sequence[TrialEntry]) -> None:
    """Let the user put tasks together, and show what they amount to."""
    usable = _usable(entries)
    if not usable:
        _ask_more_videos("A job is put together from trials; there is none yet.")
        return
    usable = _filter_by_job(usable)
    chosen = _ask_trials("Tasks of the job", usable, taken=(), key="job_tasks")
    if not chosen:
        st.info("Choose the trials that show the tasks of the job.", icon=":material/work:")
        return
    parts, duration_h, recovery_h = _ask_work(chosen, usable)
    try:
        found = improve_cache.job(parts, duration_h, recovery_h)
    except EngineError as error:
        st.warning(str(error), icon=":material/error:")
        return
    _show_job_result(found)


Parts = tuple[tuple[str, str, float, float | None], ...]


def _ask_work(
    chosen: Sequence[str], usable: dict[str, TrialEntry]
) -> tuple[Parts, float | None, float | None]:
    """Ask how often and how long every task is done."""
    with st.container(border=True):
        way = _ask_way() if len(chosen) > 1 else ALTERNATING
        names = _distinct_names(chosen, usable)
        parts: list[tuple[str, str, float, float | None]] = []
        for k, name in enumerate(chosen):
            if k % 2 == 0 or way == ROTATING:
                columns = st.columns(2)
            parts.append(_ask_part(name, names[name], way, columns, k))
        first, second = st.columns(2)
        with first:
            duration_h = None
            if way == ALTERNATING:
                duration_h = st.number_input(
                    "Hours of this work at a stretch",
                    0.0,
                    24.0,
                    1.0,
                    0.5,
                    format="%g",
                    key="job_hours",
                )
        with second:
            recovery_h = st.number_input(
                "Hours of light work after it",
                0.0,
                24.0,
                None,
                0.5,
                format="%g",
                placeholder="enough, if not given",
                key="job_recovery",
                help=labels.HELP["recovery"],
            )
    return tuple(parts), duration_h, recovery_h


def _ask_way() -> str:
    return str(
        st.radio(
            "How the tasks follow each other",
            (ALTERNATING, ROTATING),
            captions=("within one stretch of work", "a rotation, each with its own time"),
            horizontal=True,
            key="job_way",
        )
    )


def _distinct_names(chosen: Sequence[str], usable: dict[str, TrialEntry]) -> dict[str, str]:
    """Return names of the tasks; those that are alike get a number."""
    plain = {name: usable[name].label or "Untitled trial" for name in chosen}
    titles = list(plain.values())
    return {
        name: title if titles.count(title) == 1 else f"{title} ({k + 1})"
        for k, (name, title) in enumerate(plain.items())
    }


def _ask_part(
    trial_id: str, name: str, way: str, columns: Sequence[DeltaGenerator], number: int
) -> tuple[str, str, float, float | None]:
    """Ask how often a task is done; in a rotation, for how long as well."""
    told = improve_cache.exposure(trial_id).task.frequency_per_min
    with columns[0 if way == ROTATING else number % 2]:
        rate = st.number_input(
            f"{name}: lifts per minute",
            0.0,
            60.0,
            1.0 if told is None else float(told),
            0.1,
            format="%g",
            key=f"job_rate_{trial_id}",
        )
    hours = None
    if way == ROTATING:
        with columns[1]:
            hours = st.number_input(
                "for how many hours", 0.1, 24.0, 1.0, 0.5, format="%g", key=f"job_hours_{trial_id}"
            )
    return trial_id, name, float(rate), hours


def _show_job_result(found: JobResult) -> None:
    infos = {method.info.name: method.info for method in list_methods()}
    with st.container(border=True):
        st.html("".join(_flag_html(flag) for flag in found.flags))
    for reason in found.reasons:
        st.caption(reason)
    st.subheader("What each task adds", anchor=False)
    increments = _increments(found.risk["rnle_job"])
    head = (
        ("Task", ""),
        ("Lifts a day", ""),
        ("Index alone", "Lifting index of the task alone, at the duration of the job."),
        ("Adds to the job", "What the task adds to the composite index; the worst one starts it."),
        ("Peak compression", "Largest compression of the low back, without accelerations."),
        ("Share of the damage", "Share of the day's damage of the low back (LiFFT)."),
    )
    total = sum(part.damage for part in found.parts if not math.isnan(part.damage))
    rows = [_part_row(part, increments.get(part.name), total) for part in found.parts]
    st.html(table_html(head, rows))
    index = found.risk["rnle_job"]
    if index.is_applicable:
        with st.expander("The calculation, line by line", icon=":material/calculate:"):
            st.html(list_html(map(labels.typeset, index.steps), "ll-steps", "ol"))
            st.caption(infos["rnle_job"].reference)
    dose = found.risk["l5s1"].details.get("moment_dose_nm_s", math.nan)
    if math.isfinite(dose):
        st.caption(f"Moment about L5/S1 times time, all lifts of the day: {dose / 3600:.1f} N m h.")


def _increments(index: RiskResult) -> dict[str, float]:
    """Return what each task adds to the composite index, all of its lifts together."""
    found: dict[str, float] = {}
    for task in index.details.get("tasks", ()):
        name = str(task["name"]).rpartition(", ")[0]
        found[name] = found.get(name, 0.0) + float(task["increment"])
    return found


def _part_row(part: PartResult, increment: float | None, damage: float) -> tuple[str, ...]:
    back = part.back
    compression = f"{format_number(back.value)} N" if back.is_applicable else "not seen"
    share = part.damage / damage if damage > 0 else math.nan
    return (
        part.name,
        format_number(part.lifts_per_day),
        format_number(part.rnle.value, 1) if part.rnle.is_applicable else "not judged",
        "–" if increment is None else format_number(increment, 2),
        compression,
        "–" if math.isnan(share) else f"{100 * share:.0f} %",
    )


def _flag_html(flag: Flag) -> str:
    return (
        f'<div class="ll-flag"><div>{chip_html(level_label(flag.level))}</div>'
        f"<div><b>{escape(labels.typeset(flag.what))}</b>"
        f"<p>{escape(labels.typeset(flag.why))}</p></div></div>"
    )
