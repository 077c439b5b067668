"""One trial: the verdict first, then what was measured, how it was judged, and how sure we are."""

import streamlit as st

from dashboard import cache, camera_parts, correct_parts, pages, review_parts, state, trial_parts

if st.button("All trials", icon=":material/arrow_back:", type="tertiary"):
    st.switch_page(pages.TRIALS)
trial_id = state.trial_id()
if not trial_id:
    st.info("No trial is chosen. Open one from the list.", icon=":material/list:")
    st.stop()

result = cache.result(trial_id)
trial_parts.show_title(result)
correct_parts.show_renewal(trial_id)
trial_parts.show_verdict(result)
st.subheader("What happened, moment by moment", anchor=False)
review_parts.show_review(trial_id)
trial_parts.show_other_flags(result)
if st.button("Why and when: all methods, moment by moment", icon=":material/accessibility_new:"):
    st.switch_page(pages.RISK, query_params=state.trial_parameters(trial_id))

with st.expander("The angles in detail, and before the correction", icon=":material/show_chart:"):
    trial_parts.show_angles(result)

st.subheader("The lifts", anchor=False)
trial_parts.show_lifts(result)

st.subheader("How the lift was judged", anchor=False)
trial_parts.show_equation(result)

st.subheader("How sure we are", anchor=False)
confidence, provenance = st.columns([6, 5], gap="large")
with confidence:
    trial_parts.show_confidence(result)
with provenance:
    trial_parts.show_provenance(result)

camera_parts.show_two_views(result)

st.subheader("Take it with you", anchor=False)
trial_parts.show_downloads(result)
if st.button("Compare with a reference recording", icon=":material/compare_arrows:"):
    st.switch_page(pages.REFERENCE, query_params=state.trial_parameters(trial_id))
