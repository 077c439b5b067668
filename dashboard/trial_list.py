"""The parts of the list of trials."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import datetime, timedelta
from html import escape
from typing import Literal, cast, get_args

import streamlit as st

from dashboard import cache, manage_cache, pages, state
from dashboard.components.cards import Card, CardButton, show_cards
from dashboard.labels import JOB_STATES, LEVELS, NOT_JUDGED, count
from dashboard.widgets import (
    ASSETS,
    chip_html,
    entry_html,
    image_html,
    image_uri,
    index_html,
    level_label,
    show_job_status,
)
from engine.datatypes import FlagLevel
from engine.errors import EngineError
from engine.jobs.local import JobQueue, JobState, JobStatus
from engine.storage.entries import Order
from engine.storage.library import Library, TrialEntry, TrialPage

POLL_S = 2.0
PAGE_SIZE = 15
NOT_JUDGED_KEY = "none"
LEVEL_WORDS = {level.value: LEVELS[level].word for level in LEVELS} | {
    NOT_JUDGED_KEY: NOT_JUDGED.word
}
ORDERS: dict[Order, str] = {
    "newest": "Newest first",
    "oldest": "Oldest first",
    "level": "Most urgent first",
    "index": "Highest index first",
    "label": "By name",
}
PERIODS: dict[str, int | None] = {
    "Any time": None,
    "Last 7 days": 7,
    "Last 30 days": 30,
    "Last 12 months": 365,
}
Action = Literal["open", "edit", "delete"]


# --------------------------------------------------------------------------- finding


@dataclass(frozen=True)
class Choice:
    """What the user looks for; None or empty does not narrow."""

    words: str
    levels: tuple[str, ...]
    site: str | None
    job: str | None
    person: str | None
    tags: tuple[str, ...]
    days: int | None
    order: Order

    def describe(self) -> str:
        """Return what is looked for, in words."""
        words = self.words.strip()
        return f"“{words}”" if words else "these filters"

    def find(self, library: Library, page: int) -> TrialPage:
        """Return one page, counted from 1, of what matches."""
        levels = {None if one == NOT_JUDGED_KEY else FlagLevel(one) for one in self.levels}
        since = None if self.days is None else datetime.now().astimezone()
        return library.query(
            search=self.words,
            level=levels or None,
            site=self.site,
            job=self.job,
            person=self.person,
            tags=self.tags,
            since=None if since is None else since - timedelta(days=self.days or 0),
            order=self.order,
            limit=PAGE_SIZE,
            offset=(page - 1) * PAGE_SIZE,
        )


def choose() -> Choice:
    """Ask what to look for; the answers stand in the address."""
    words = st.text_input(
        "Search",
        placeholder="Search by name, person, site, job or tag",
        icon=":material/search:",
        label_visibility="collapsed",
        key=state.SEARCH_KEY,
        bind="query-params",
        on_change=state.turn_to_first_page,
    )
    with st.container(horizontal=True, horizontal_alignment="distribute"):
        levels = st.pills(
            "Level",
            list(LEVEL_WORDS),
            selection_mode="multi",
            format_func=LEVEL_WORDS.__getitem__,
            label_visibility="collapsed",
            key=state.LEVEL_KEY,
            bind="query-params",
            on_change=state.turn_to_first_page,
        )
        with st.popover("Filter and sort", icon=":material/tune:", key="more-filters"):
            site, job, person, tags, days, order = _choose_more()
    return Choice(words or "", tuple(levels), site, job, person, tags, days, order)


def _choose_more() -> tuple[str | None, str | None, str | None, tuple[str, ...], int | None, Order]:
    choices = manage_cache.choices()
    site = _pick("Site", list(choices.sites), "All sites", state.SITE_KEY)
    job = _pick("Job", list(choices.jobs), "All jobs", state.WORK_KEY)
    person = _pick("Person", list(choices.people), "Everybody", state.PERSON_KEY)
    tags = st.multiselect(
        "Tags, all of them",
        list(choices.tags),
        placeholder="Any",
        key=state.TAGS_KEY,
        bind="query-params",
        on_change=state.turn_to_first_page,
    )
    period = st.selectbox(
        "Assessed",
        list(PERIODS),
        key=state.PERIOD_KEY,
        bind="query-params",
        on_change=state.turn_to_first_page,
    )
    order = st.selectbox(
        "Sort",
        list(ORDERS),
        format_func=ORDERS.__getitem__,
        key=state.ORDER_KEY,
        bind="query-params",
        on_change=state.turn_to_first_page,
    )
    return site, job, person, tuple(tags), PERIODS[period], order


def _pick(title: str, options: Sequence[str], nothing: str, key: str) -> str | None:
    return st.selectbox(
        title,
        options,
        index=None,
        placeholder=nothing,
        key=key,
        bind="query-params",
        on_change=state.turn_to_first_page,
    )


def show_count(found: TrialPage) -> None:
    """Say how many match, and how many of each level."""
    parts = [
        f"{found.levels[level]} {level_label(level).word.lower()}"
        for level in (*LEVELS, None)
        if found.levels.get(level)
    ]
    st.caption(" · ".join([f"**{count(found.total, 'trial')}**", *parts]))


def show_pages(total: int) -> None:
    """Let the user turn the pages of the list."""
    n_pages, page = max(1, math.ceil(total / PAGE_SIZE)), state.list_page()
    if n_pages == 1:
        return
    with st.container(horizontal=True, horizontal_alignment="center", vertical_alignment="center"):
        for text, to, icon, is_end in (
            ("Back", page - 1, ":material/chevron_left:", page <= 1),
            ("Next", page + 1, ":material/chevron_right:", page >= n_pages),
        ):
            if to > page:
                st.markdown(f"Page {page} of {n_pages}")
            st.button(
                text,
                key=f"page-{text.lower()}",
                icon=icon,
                disabled=is_end,
                on_click=state.turn_to_page,
                args=(to,),
            )


# --------------------------------------------------------------------------- entries


OPEN = CardButton("open", "Open")
EDIT = CardButton("edit", "Edit", icon="edit", tip="Name, site, job, person and tags")
DELETE = CardButton("delete", "Delete", icon="delete", tip="Delete this trial")


def show_entries(entries: Sequence[TrialEntry]) -> tuple[Action, TrialEntry] | None:
    """Show trials; return what the user wants just now, and with which of them."""
    asked = show_cards(map(_build_card, entries), key="entries")
    if asked is None or asked.action not in get_args(Action):
        return None
    # Somebody may have deleted it since it was shown.
    entry = next((one for one in entries if one.id == asked.id), None)
    return None if entry is None else (cast("Action", asked.action), entry)


def _build_card(entry: TrialEntry) -> Card:
    buttons = (DELETE,) if entry.is_damaged else (OPEN, EDIT, DELETE)
    return Card(entry.id, _card_html(entry), buttons)


def _card_html(entry: TrialEntry) -> str:
    tags = "".join(f'<span class="ll-label">{escape(tag)}</span>' for tag in entry.tags)
    notes = f"<span>{count(entry.n_notes, 'note')}</span>" if entry.n_notes else ""
    under = f'<div class="ll-labels">{tags}{notes}</div>' if tags or notes else ""
    judged = (
        ""
        if entry.is_damaged
        else f"{index_html(entry)}<div>{chip_html(level_label(entry.worst_level))}</div>"
    )
    return (
        f'<div class="ll-entry">{image_html(entry.thumbnail_path)}'
        f"<div>{entry_html(entry)}{under}</div>{judged}</div>"
    )


EDITED = (
    ("label", "Name", "Crate to shelf", ""),
    ("site", "Site", "Hall 3", ""),
    ("job", "Job", "Depalletising", ""),
    ("person", "Person", "P07", "A pseudonym, never the name."),
)


@st.dialog("Name this trial", icon=":material/edit:")
def edit_entry(entry: TrialEntry) -> None:
    """Correct how a trial is called and where it belongs."""
    present = {"label": entry.label, "site": entry.site, "job": entry.job, "person": entry.subject}
    with st.form("edit-trial", border=False):
        for field, title, example, tip in EDITED:
            key = state.edit_key(entry.id, field)
            st.text_input(title, present[field], key=key, placeholder=example, help=tip or None)
        st.multiselect(
            "Tags",
            sorted({*manage_cache.choices().tags, *entry.tags}),
            default=entry.tags,
            accept_new_options=True,
            key=state.edit_key(entry.id, "tags"),
        )
        is_sent = st.form_submit_button(
            "Save", type="primary", key="edit-save", on_click=_save_names, args=(entry,)
        )
    if not is_sent:
        return
    if not show_edit_problem():
        st.rerun()


def _save_names(entry: TrialEntry) -> None:
    """Keep what was typed; a problem is shown where it was typed, so that nothing is lost."""
    names = {field: state.edit_value(entry.id, field).strip() for field, *_ in EDITED}
    tags = state.edit_value(entry.id, "tags")
    try:
        cache.library().edit(entry.id, version=entry.version, tags=tags, **names)
    except EngineError as error:
        state.set_edit_problem(str(error))
    else:
        manage_cache.forget_summaries()


def show_edit_problem() -> bool:
    """Say why a trial could not be named so; return whether there is a reason."""
    problem = state.take_edit_problem()
    if problem:
        st.error(problem, icon=":material/error:")
    return bool(problem)


@st.dialog("Delete this trial?", icon=":material/delete:")
def confirm_deletion(entry: TrialEntry) -> None:
    """Ask before a trial is deleted."""
    name = entry.label or entry.id
    st.write(
        f"“{name}” will be deleted with its annotated video and all measurements. "
        "This can't be undone."
    )
    with st.container(horizontal=True, horizontal_alignment="right"):
        if st.button("Keep it", key="keep"):
            st.rerun()
        # Deleted by the page, not here: there, an error becomes a message.
        if st.button(
            "Delete for good",
            key="confirm-delete",
            type="primary",
            on_click=state.order_deletion,
            args=(entry.id,),
        ):
            st.rerun()


def show_empty(queue: JobQueue) -> None:
    """Show what there is to try before the first own video."""
    samples = cache.samples()
    icon = image_uri(ASSETS / "icon.svg")
    offer = " Or see at once what comes out, on the samples below." if samples else ""
    with st.container(border=True):
        st.html(
            f'<div class="ll-empty"><img alt="" src="{icon}"><h2>No trials yet</h2>'
            "<p>Film somebody who lifts, from the side, with one phone. Add the video: LiftLens "
            f"measures the lift, says how sure it is, and flags what to change.{offer}</p></div>"
        )
        with st.container(horizontal=True, horizontal_alignment="center"):
            if st.button("Add a video", key="first-upload", type="primary"):
                st.switch_page(pages.NEW_ASSESSMENT)
            if samples and st.button("Choose a sample", key="first-sample"):
                state.choose_sample_source()
                st.switch_page(pages.NEW_ASSESSMENT)
        st.space("small")
    if samples:
        _show_samples(queue, samples)


def _show_samples(queue: JobQueue, samples: Sequence[cache.Sample]) -> None:
    with st.container(horizontal=True, horizontal_alignment="distribute"):
        st.subheader("Samples", anchor=False, width="content")
        if st.button("Assess all samples", key="first-demo", icon=":material/play_arrow:"):
            for request in manage_cache.sample_requests():
                queue.submit(request)
            st.rerun()
    for sample, column in zip(samples, st.columns(len(samples)), strict=True):
        with column.container(border=True, height="stretch"):
            st.video(str(sample.path), muted=True)
            st.markdown(f"**{_plain(sample.title)}**")
            st.caption(_plain(sample.note))


def show_jobs(queue: JobQueue) -> bool:
    """Show the assessments that wait, run or went wrong; return whether there is any."""
    jobs = [job for job in queue.jobs() if job.state not in (JobState.DONE, JobState.CANCELLED)]
    is_busy = any(not job.state.is_over for job in jobs)
    if is_busy:
        _poll_jobs(queue, len(jobs))
    elif jobs:
        _list_jobs(queue, jobs)
    return bool(jobs)


@st.fragment(run_every=POLL_S)
def _poll_jobs(queue: JobQueue, n_before: int) -> None:
    jobs = [job for job in queue.jobs() if job.state not in (JobState.DONE, JobState.CANCELLED)]
    if len(jobs) != n_before or all(job.state.is_over for job in jobs):
        st.rerun()  # a trial has joined the list, or nothing runs any more
    _list_jobs(queue, jobs)


def _list_jobs(queue: JobQueue, jobs: list[JobStatus]) -> None:
    for job in jobs:
        with st.container(border=True, key=f"job-{job.id}"):
            name, progress, buttons = st.columns([3, 4, 2], vertical_alignment="center")
            name.markdown(f"**{_plain(job.label) or 'New assessment'}**  \n{JOB_STATES[job.state]}")
            with progress:
                if job.state is JobState.FAILED:
                    st.error(_plain(job.message), icon=":material/error:")
                else:
                    show_job_status(job)
            with buttons.container(horizontal=True, horizontal_alignment="right"):
                if st.button("Show", key=f"show-{job.id}"):
                    st.switch_page(pages.NEW_ASSESSMENT, query_params=state.job_parameters(job.id))
                if job.state is JobState.FAILED and st.button("Dismiss", key=f"dismiss-{job.id}"):
                    queue.forget(job.id)
                    st.rerun()


def _plain(text: str) -> str:
    """Return text that Markdown leaves as it is."""
    return "".join(f"\\{c}" if c in r"\`*_{}[]()#+!|<>$:~" else c for c in text)
