"""What would make the work safer: try changes, check whether one worked, put a job together."""

import streamlit as st

from dashboard import cache, improve_parts, improve_sets, risk_parts

st.title("Improve", anchor=False)
part = improve_parts.choose_part()
entries = cache.library().entries()
if part == improve_parts.BEFORE_AFTER:
    improve_sets.show_before_after(entries)
    st.stop()
if part == improve_parts.JOB:
    improve_sets.show_job(entries)
    st.stop()

trial_id = risk_parts.choose_trial(entries)
if trial_id is None:
    st.stop()
risk_parts.show_subject(cache.result(trial_id))
lift = improve_parts.choose_lift(trial_id)
if lift is not None:
    improve_parts.show_what_if(trial_id, lift)
