"""A trial beside a reference recording: how far it is off, in words first, then in figures."""

import streamlit as st

from dashboard import cache, reference_parts

st.title("Compare with a reference", anchor=False)
trial_id = reference_parts.choose_trial(cache.library().entries())
if trial_id is None:
    st.stop()
reference_parts.show_subject(trial_id)
if cache.reference_file(trial_id) is None:
    reference_parts.ask_reference(trial_id)
    st.stop()

reference_parts.show_reference(trial_id)
agreement = reference_parts.compute(trial_id)
if agreement is None:
    st.stop()
reference_parts.show_statements(agreement)

st.subheader("Curve by curve", anchor=False)
reference_parts.show_curves(agreement)

st.subheader("How large the errors are", anchor=False)
errors, sides = st.columns(2, gap="large")
with errors:
    reference_parts.show_errors(agreement)
with sides:
    reference_parts.show_sides(agreement)

st.subheader("How the differences spread", anchor=False)
reference_parts.show_spread(agreement)

st.subheader("Every angle in numbers", anchor=False)
reference_parts.show_tables(agreement)

st.subheader("How it was compared", anchor=False)
reference_parts.show_method(agreement)

st.subheader("Together with other trials", anchor=False)
reference_parts.show_pool(trial_id, cache.library().entries())

st.subheader("Take it with you", anchor=False)
reference_parts.show_downloads(trial_id)
