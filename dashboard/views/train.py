"""How an attempt was performed beside a reference: words first, then curves, videos, tables."""

import streamlit as st

from dashboard import cache, train_parts

st.title("Compare form", anchor=False)
st.caption(train_parts.INTRODUCTION)
pair = train_parts.choose_pair(cache.library().entries())
if pair is None:
    st.stop()
comparison = train_parts.compute(pair)
if comparison is None:
    st.stop()
train_parts.show_score(comparison)

st.subheader("Side by side", anchor=False)
train_parts.show_videos(pair, comparison)

st.subheader("Curve by curve", anchor=False)
train_parts.show_curves(comparison)

st.subheader("Phase by phase", anchor=False)
train_parts.show_phases(comparison)

st.subheader("Every repetition", anchor=False)
train_parts.show_repetitions(pair)

st.subheader("Progress", anchor=False)
train_parts.show_progress(pair, cache.library().entries())

st.subheader("How it was compared", anchor=False)
train_parts.show_method(comparison)
