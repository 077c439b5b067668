"""The cameras: how to place two, and calibrations that are kept for later films."""

import streamlit as st

from dashboard import camera_parts
from dashboard.labels import CAMERA_ADVICE
from dashboard.widgets import ASSETS

st.title("Cameras", anchor=False)
st.markdown(CAMERA_ADVICE)
st.image(str(ASSETS / "two-cameras.svg"), width=860)

st.subheader("Kept cameras", anchor=False)
chosen = camera_parts.show_kept()
if chosen:
    camera_parts.show_kept_one(chosen)

st.subheader("Add a calibration", anchor=False)
camera_parts.add_file()
