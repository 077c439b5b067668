"""The progress of one assessment."""

from __future__ import annotations

import streamlit as st

from dashboard import form, state
from dashboard.widgets import show_job_status
from engine.jobs.local import JobQueue, JobState, JobStatus

POLL_S = 0.7


def follow(queue: JobQueue, status: JobStatus) -> None:
    """Show a job until it is over, with what can be done about it."""
    st.title(status.label or "New assessment", anchor=False)
    if not status.state.is_over:
        _poll(queue, status.id)
        return
    if status.state is JobState.FAILED:
        st.error(status.message, icon=":material/error:", title="This video could not be assessed")
    else:
        st.info("The assessment was cancelled; nothing was kept.", icon=":material/cancel:")
    with st.container(horizontal=True):
        if st.button("Change and try again", type="primary", key="again"):
            form.take_back(queue.withdraw(status.id))
            state.set_job_id(None)
            st.rerun()
        if st.button("Discard", key="discard"):
            queue.forget(status.id)
            state.set_job_id(None)
            st.rerun()


@st.fragment(run_every=POLL_S)
def _poll(queue: JobQueue, job_id: str) -> None:
    status = queue.read(job_id)
    if status.state.is_over:
        st.rerun()
    with st.container(border=True):
        show_job_status(status)
        with st.container(horizontal=True, vertical_alignment="center"):
            if st.button("Cancel", key="cancel", icon=":material/close:"):
                queue.cancel(job_id)
                st.rerun()
            st.caption("You can leave this page: the work goes on and the trial joins the list.")
