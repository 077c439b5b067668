"""The dashboard's entry: ``streamlit run dashboard/app.py``."""

import streamlit as st

from dashboard import labels, manage_cache, pages
from dashboard.widgets import ASSETS, show_brand
from engine.errors import EngineError

st.set_page_config(
    page_title="LiftLens", page_icon=str(ASSETS / "icon.svg"), layout="wide", menu_items={}
)
page = st.navigation(pages.build(), position="top")
show_brand()
try:
    labels.use_units(manage_cache.units())
    page.run()
except EngineError as error:
    st.error(str(error), icon=":material/error:", title="This can't be shown")
    if st.button("Back to the trials", key="back"):
        st.switch_page(pages.TRIALS)
