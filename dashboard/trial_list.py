"""The parts of the list of trials."""

from __future__ import annotations

from typing import Literal

import streamlit as st

from dashboard import pages, state
from dashboard.labels import JOB_STATES
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
from engine.jobs.local import JobQueue, JobState, JobStatus
from engine.storage.library import TrialEntry

POLL_S = 2.0


def matches(entry: TrialEntry, words: str) -> bool:
    """Whether every word of a search stands in an entry."""
    text = " ".join((entry.label, entry.subject, entry.site, entry.job, entry.category)).casefold()
    return all(word in text for word in words.casefold().split())


def show_entry(entry: TrialEntry) -> Literal["open", "delete"] | None:
    """Show one trial; return what the user wants with it."""
    action: Literal["open", "delete"] | None = None
    with st.container(border=True, key=f"entry-{entry.id}"):
        picture, facts, index, flag, buttons = st.columns(
            [1.3, 3.6, 1.7, 1.5, 1.7], vertical_alignment="center"
        )
        picture.html(image_html(entry.thumbnail_path))
        facts.html(entry_html(entry))
        if not entry.is_damaged:
            index.html(index_html(entry))
            flag.html(chip_html(level_label(entry.worst_level)))
        with buttons.container(horizontal=True, horizontal_alignment="right"):
            if not entry.is_damaged and st.button("Open", key=f"open-{entry.id}"):
                action = "open"
            if st.button(
                "",
                key=f"delete-{entry.id}",
                icon=":material/delete:",
                type="tertiary",
                help="Delete this trial",
            ):
                action = "delete"
    return action


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


def show_empty(*, has_samples: bool) -> None:
    """Invite to the first assessment."""
    offer = " or try a bundled sample" if has_samples else ""
    icon = image_uri(ASSETS / "icon.svg")
    with st.container(border=True):
        st.html(
            f'<div class="ll-empty"><img alt="" src="{icon}"><h2>No trials yet</h2>'
            "<p>Film somebody who lifts, from "
            f"the side, with one phone. Add the video{offer}: LiftLens measures the lift, says "
            "how sure it is, and flags what to change.</p></div>"
        )
        with st.container(horizontal=True, horizontal_alignment="center"):
            if st.button("Add a video", key="first-upload", type="primary"):
                st.switch_page(pages.NEW_ASSESSMENT)
            if has_samples and st.button("Try a sample", key="first-sample"):
                state.choose_sample_source()
                st.switch_page(pages.NEW_ASSESSMENT)
        st.space("small")


def show_jobs(queue: JobQueue) -> None:
    """Show the assessments that wait, run or went wrong."""
    jobs = [job for job in queue.jobs() if job.state not in (JobState.DONE, JobState.CANCELLED)]
    is_busy = any(not job.state.is_over for job in jobs)
    if is_busy:
        _poll_jobs(queue, len(jobs))
    elif jobs:
        _list_jobs(queue, jobs)


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
