"""The pages, by name: one place for their files, addresses and titles."""

from __future__ import annotations

import streamlit as st
from streamlit.navigation.page import Page

TRIALS = "views/trials.py"
NEW_ASSESSMENT = "views/new_assessment.py"
TRIAL = "views/trial.py"
REFERENCE = "views/reference.py"
RISK = "views/risk.py"
IMPROVE = "views/improve.py"
CAMERAS = "views/cameras.py"
ESTIMATORS = "views/estimators.py"
MANAGE = "views/manage.py"
SETTINGS = "views/settings.py"
TRAIN = "views/train.py"
VALIDATION_STUDY = "views/validation_study.py"


def build() -> dict[str, list[Page]]:
    """Return the pages by section; a trial's page is reached through the list or its address."""
    return {
        "Review": [
            st.Page(
                TRIALS, title="Trials", icon=":material/list:", url_path="trials", default=True
            ),
            st.Page(NEW_ASSESSMENT, title="New assessment", icon=":material/add:", url_path="new"),
            st.Page(RISK, title="Risk", icon=":material/accessibility_new:", url_path="risk"),
            st.Page(IMPROVE, title="Improve", icon=":material/trending_down:", url_path="improve"),
            st.Page(
                REFERENCE, title="Reference", icon=":material/compare_arrows:", url_path="reference"
            ),
            st.Page(
                VALIDATION_STUDY,
                title="Validation study",
                icon=":material/biotech:",
                url_path="study",
            ),
            st.Page(CAMERAS, title="Cameras", icon=":material/videocam:", url_path="cameras"),
            st.Page(ESTIMATORS, title="Estimators", icon=":material/hub:", url_path="estimators"),
            st.Page(TRIAL, title="Trial", url_path="trial", visibility="hidden"),
        ],
        "Manage": [
            st.Page(MANAGE, title="Overview", icon=":material/bar_chart:", url_path="manage"),
        ],
        "Train": [
            st.Page(
                TRAIN, title="Compare form", icon=":material/fitness_center:", url_path="train"
            ),
        ],
        "Settings": [
            st.Page(SETTINGS, title="Settings", icon=":material/settings:", url_path="settings"),
        ],
    }
