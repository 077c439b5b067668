"""How risky a movement is: flags, every method, the worst moments, and the working behind them."""

import streamlit as st

from dashboard import cache, pages, risk_parts, state, trial_parts

st.title("Risk", anchor=False)
trial_id = risk_parts.choose_trial(cache.library().entries())
if trial_id is None:
    st.stop()
result = cache.result(trial_id)
risk_parts.show_subject(result)
with st.container(horizontal=True):
    if st.button("Open the trial", icon=":material/open_in_new:", type="tertiary"):
        st.switch_page(pages.TRIAL, query_params=state.trial_parameters(trial_id))
    if st.button("What would help?", icon=":material/trending_down:", type="tertiary"):
        st.switch_page(pages.IMPROVE, query_params=state.trial_parameters(trial_id))
trial_parts.show_flags(result)

st.subheader("Through the movement", anchor=False)
video, timeline = st.columns([5, 6], gap="large")
with video:
    risk_parts.show_moments(result)
with timeline:
    risk_parts.show_timeline(result)

st.subheader("What each method says", anchor=False)
risk_parts.show_methods(result)

st.subheader("Why, line by line", anchor=False)
risk = risk_parts.choose_method(result)
if risk is None:
    st.stop()
steps, levels = st.columns([6, 5], gap="large")
with steps:
    risk_parts.show_steps(risk)
with levels:
    risk_parts.show_levels(risk)
    risk_parts.show_drivers(risk)
