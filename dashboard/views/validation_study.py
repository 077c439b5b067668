"""A validation study on lifts with markers: how far every method is off, angle by angle."""

import streamlit as st

from dashboard import study_parts

st.title("Validation study", anchor=False)
study = study_parts.choose_study()
if study is None:
    study_parts.show_command(is_first=True)
    st.stop()

study_parts.show_statements(study)

st.subheader("Methods", anchor=False)
study_parts.show_methods(study)

st.subheader("Tables of the lifting paper", anchor=False)
study_parts.show_tables(study)

st.subheader("Joint by joint", anchor=False)
study_parts.show_angles(study)

st.subheader("Curve by curve", anchor=False)
study_parts.show_curves(study)

st.subheader("Figures", anchor=False)
study_parts.show_figures(study)

st.subheader("How it was done", anchor=False)
study_parts.show_method(study)

st.subheader("Take it with you", anchor=False)
study_parts.show_downloads(study)
study_parts.show_command(is_first=False)
