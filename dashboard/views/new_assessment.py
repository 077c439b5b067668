"""A new assessment: video, person and work; then its progress."""

import streamlit as st

from dashboard import cache, form, manage_cache, pages, state
from dashboard.progress import follow

queue = cache.job_queue()
if job_id := state.job_id():
    status = queue.read(job_id)
    if status.trial_id:
        st.switch_page(pages.TRIAL, query_params=state.trial_parameters(status.trial_id))
    with st.container(width=form.WIDTH_PX):
        follow(queue, status)
    st.stop()

with st.container(width=form.WIDTH_PX):
    st.title("New assessment", anchor=False)
    with st.container(border=True):
        st.subheader("1. The video", anchor=False)
        videos = form.ask_videos()
    with st.container(border=True):
        st.subheader("2. The person", anchor=False)
        form.ask_person()
    with st.container(border=True):
        st.subheader("3. The work", anchor=False)
        st.caption("What a camera can't see. What you leave open is assumed, and said so.")
        form.ask_task()

    obstacle = form.find_obstacle(videos)
    with st.container(horizontal=True, vertical_alignment="center"):
        start = st.button(
            "Start",
            key="start",
            type="primary",
            icon=":material/play_arrow:",
            disabled=bool(obstacle),
        )
        if obstacle:
            st.caption(obstacle)
    st.caption(
        "Everything stays on this computer. After the assessment uploaded videos are deleted; "
        "what is kept are annotated copies with blurred heads."
    )
if start and videos:
    job_id = queue.submit(manage_cache.with_preferences(form.read_request(videos)))
    form.clear()
    state.set_job_id(job_id)
    st.rerun()
