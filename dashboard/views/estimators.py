"""Several estimators on one clip: their curves and outliers together."""

import streamlit as st

from dashboard import cache, estimator_parts, risk_parts

st.title("Estimators", anchor=False)
trial_id = risk_parts.choose_trial(cache.library().entries())
if trial_id is None:
    st.stop()
stored = cache.result(trial_id)
risk_parts.show_subject(stored)
names, view = estimator_parts.choose_estimators(stored)
estimator_parts.show_comparison(trial_id, names, view)
