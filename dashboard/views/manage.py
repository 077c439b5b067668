"""The overview for managers: levels by site and job, trend, worst jobs, reports."""

import streamlit as st

from dashboard import cache, manage_parts

st.title("Overview", anchor=False)
if cache.library().is_empty:
    manage_parts.show_empty(is_library_empty=True)
    st.stop()
scope = manage_parts.choose_scope()
overview = manage_parts.read_overview(scope)
if not overview.lifts.n_trials:
    manage_parts.show_empty(is_library_empty=False)
    st.stop()
manage_parts.say_if_samples(overview)
manage_parts.show_numbers(overview)
manage_parts.show_places(overview, scope)
manage_parts.show_trend(overview)
manage_parts.show_worst_jobs(overview)
manage_parts.show_before_after(overview)
manage_parts.show_reports(overview, scope)
