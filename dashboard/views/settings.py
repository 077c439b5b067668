"""Settings: units, methods, data, people, models."""

import streamlit as st

from dashboard import settings_parts

st.title("Settings", anchor=False)
settings_parts.show_notice()
chosen = settings_parts.read_preferences()
display, data, people, models = st.tabs(["Display and methods", "Data", "People", "Models"])
with display:
    settings_parts.ask_display(chosen)
    settings_parts.ask_methods(chosen)
with data:
    settings_parts.show_place()
    settings_parts.ask_retention(chosen)
    settings_parts.ask_transfer()
    settings_parts.ask_samples()
with people:
    settings_parts.ask_people()
with models:
    settings_parts.show_models()
