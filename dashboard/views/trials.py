"""The list of trials: search, open, delete; and the assessments that still run."""

import streamlit as st

from dashboard import cache, pages, state
from dashboard.trial_list import confirm_deletion, matches, show_empty, show_entry, show_jobs

queue, library = cache.job_queue(), cache.library()
if doomed := state.take_deletion():
    library.delete(doomed)
entries = library.entries()

with st.container(horizontal=True, horizontal_alignment="distribute", vertical_alignment="bottom"):
    st.title("Trials", anchor=False, width="content")
    if st.button("New assessment", type="primary", icon=":material/add:"):
        st.switch_page(pages.NEW_ASSESSMENT)

show_jobs(queue)
if not entries:
    show_empty(has_samples=bool(cache.samples()))
    st.stop()

words = st.text_input(
    "Search",
    placeholder="Search by name, person, site or job",
    icon=":material/search:",
    label_visibility="collapsed",
)
found = [entry for entry in entries if matches(entry, words)]
if not found:
    st.info(f"No trial matches “{words}”. Try fewer words.", icon=":material/search_off:")
for entry in found:
    action = show_entry(entry)
    if action == "open":
        st.switch_page(pages.TRIAL, query_params=state.trial_parameters(entry.id))
    if action == "delete":
        confirm_deletion(entry)
