"""The list of trials: search, filter, open, name, delete; and the assessments that still run."""

import streamlit as st

from dashboard import cache, manage_cache, pages, state, trial_list

queue, library = cache.job_queue(), cache.library()
if doomed := state.take_deletion():
    library.delete(doomed)
    manage_cache.forget_summaries()

with st.container(horizontal=True, horizontal_alignment="distribute", vertical_alignment="bottom"):
    st.title("Trials", anchor=False, width="content")
    if st.button("New assessment", type="primary", icon=":material/add:"):
        st.switch_page(pages.NEW_ASSESSMENT)

is_busy = trial_list.show_jobs(queue)
if library.is_empty:
    if not is_busy:
        trial_list.show_empty(queue)
    st.stop()

trial_list.show_edit_problem()
choice = trial_list.choose()
found = choice.find(library, state.list_page())
if not found.total:
    st.info(
        f"No trial matches {choice.describe()}. Try fewer words or other filters.",
        icon=":material/search_off:",
    )
    st.stop()
trial_list.show_count(found)
wanted = trial_list.show_entries(found.entries)
trial_list.show_pages(found.total)
if wanted is not None:
    action, entry = wanted
    if action == "open":
        st.switch_page(pages.TRIAL, query_params=state.trial_parameters(entry.id))
    if action == "edit":
        trial_list.edit_entry(entry)
    if action == "delete":
        trial_list.confirm_deletion(entry)
