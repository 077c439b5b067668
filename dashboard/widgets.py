"""Building blocks of the pages: small pieces of HTML and Streamlit, used by more than one page."""

from __future__ import annotations

import base64
from collections.abc import Iterable, Sequence
from datetime import datetime
from html import escape
from pathlib import Path

import streamlit as st

from dashboard.labels import (
    HELP,
    JOB_STATES,
    LEVELS,
    NOT_JUDGED,
    LevelLabel,
    count,
    format_index,
    format_interval,
    format_span,
    format_time,
    name_stage,
)
from engine.datatypes import FlagLevel
from engine.jobs.local import JobState, JobStatus
from engine.storage.library import TrialEntry

ASSETS = Path(__file__).with_name("assets")


def is_dark() -> bool:
    """Whether the page is shown dark."""
    return st.context.theme.type == "dark"


def show_brand() -> None:
    """Load the style and show the wordmark."""
    st.html(ASSETS / "style.css")
    mode = "dark" if is_dark() else "light"
    mark = str(ASSETS / f"wordmark-{mode}.svg")
    st.logo(mark, size="large", icon_image=mark)


def level_label(level: FlagLevel | None) -> LevelLabel:
    """Return how a level is shown; None: nothing could be judged."""
    return NOT_JUDGED if level is None else LEVELS[level]


def shape_html(label: LevelLabel) -> str:
    """Return the shape of a level."""
    return f'<i class="ll-shape ll-shape-{label.css}" aria-hidden="true"></i>'


def chip_html(label: LevelLabel, text: str = "") -> str:
    """Return a level as shape and word."""
    word = escape(text or label.word)
    return (
        f'<span class="ll-chip ll-{label.css}" title="{escape(label.meaning)}">'
        f"{shape_html(label)}{word}</span>"
    )


def list_html(lines: Iterable[str], css: str = "ll-list", tag: str = "ul") -> str:
    """Return lines as a list."""
    items = "".join(f"<li>{escape(line)}</li>" for line in lines)
    return f'<{tag} class="{css}">{items}</{tag}>'


def facts_html(facts: Iterable[str]) -> str:
    """Return short facts in one line, empty ones left out."""
    return f'<div class="ll-facts">{"".join(f"<span>{escape(f)}</span>" for f in facts if f)}</div>'


def table_html(
    head: Sequence[tuple[str, str]], rows: Iterable[Iterable[str]], css: str = ""
) -> str:
    """Return a table whose rows become small cards on a phone; `head` is (title, help text)."""
    titles = "".join(
        f'<th><abbr title="{escape(tip)}">{escape(title)}</abbr></th>'
        if tip
        else f"<th>{escape(title)}</th>"
        for title, tip in head
    )
    names = [escape(title) for title, _ in head]
    body = "".join(f"<tr>{_cells_html(names, row)}</tr>" for row in rows)
    return (
        f'<div class="ll-scroll"><table class="ll-table {css}"><thead><tr>{titles}</tr></thead>'
        f"<tbody>{body}</tbody></table></div>"
    )


def _cells_html(names: Sequence[str], row: Iterable[str]) -> str:
    return "".join(
        f'<td data-label="{name}">{escape(cell)}</td>'
        for name, cell in zip(names, row, strict=True)
    )


def show_problem(message: str | None) -> None:
    """Show what is wrong with the field above."""
    if message:
        shape = shape_html(LEVELS[FlagLevel.REVIEW])
        st.html(f'<div class="ll-problem" role="alert">{shape}<span>{escape(message)}</span></div>')


def image_html(path: Path | None) -> str:
    """Return a still picture inline, or a blank in its place."""
    if path is None or not path.is_file():
        return '<div class="ll-blank">no picture</div>'
    return f'<img class="ll-thumb" alt="" src="{image_uri(path)}">'


def image_uri(path: Path) -> str:
    """Return a picture as an address that holds its bytes."""
    kind = {".png": "png", ".svg": "svg+xml"}.get(path.suffix.lower(), "jpeg")
    return f"data:image/{kind};base64,{base64.b64encode(path.read_bytes()).decode()}"


def index_html(entry: TrialEntry) -> str:
    """Return the lifting index of a list entry with its interval."""
    tip = escape(HELP["lifting_index"])
    if entry.li is None:
        value, under = "–", "no lifting index"
    else:
        low, high = entry.li_interval
        span = "" if low is None or high is None else format_interval((low, high))
        value, under = format_index(entry.li), f"lifting index{f', {span}' if span else ''}"
    return (
        f'<div class="ll-li" title="{tip}"><b>{value}</b><br>'
        f'<span class="ll-quiet ll-small">{escape(under)}</span></div>'
    )


def entry_html(entry: TrialEntry) -> str:
    """Return title and facts of a list entry."""
    title = escape(entry.label or entry.job or "Untitled trial")
    if entry.is_damaged:
        why = f'<p class="ll-small ll-quiet">{escape(entry.message)}</p>'
        return f'<div class="ll-card"><h3>Damaged result</h3>{why}</div>'
    facts = (
        when(entry.created),
        count(entry.n_lifts, "lift"),
        f"person {entry.subject}" if entry.subject else "",
        " · ".join(part for part in (entry.site, entry.job) if part),
    )
    return f'<div class="ll-card"><h3>{title}</h3>{facts_html(facts)}</div>'


def when(created: str) -> str:
    """Return an ISO time as local words; empty where there is none."""
    try:
        return format_time(datetime.fromisoformat(created))
    except ValueError:
        return ""


def show_job_status(status: JobStatus) -> None:
    """Show how far a job is."""
    if status.state is JobState.QUEUED:
        ahead = count(status.jobs_ahead, "assessment")
        st.progress(0.0, text=f"**{JOB_STATES[status.state]}**: {ahead} ahead of this one.")
        return
    share = f" · {status.fraction:.0%}" if status.fraction else ""
    counted = f" · {status.done} of {status.total}" if status.total else ""
    st.progress(
        min(1.0, status.fraction),
        text=f"**{name_stage(status.stage)}**{counted}{share} · {format_span(status.elapsed_s)}",
    )
