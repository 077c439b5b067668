"""Figures that show several estimators together. No Streamlit here."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import plotly.graph_objects as go

from dashboard.charts import BAND_FACTOR, GRID
from dashboard.labels import name_angle
from engine.datatypes import Lift
from engine.estimators import EstimatorRun

__all__ = ["plot_estimators", "plot_outliers"]

LIGHT = ("#0072b2", "#c24e00", "#007a59", "#8a3f8f", "#5b6570")
DARK = ("#6bc0f0", "#ff9e5e", "#4fd3a8", "#dd9be0", "#b6c0cb")
DASHES = ("solid", "dash", "dot", "dashdot", "longdash")
SHADE = "rgba(140,155,170,0.16)"
CLEAR = "rgba(0,0,0,0)"


def plot_estimators(
    runs: Sequence[EstimatorRun], angle: str, lifts: Sequence[Lift], *, dark: bool = False
) -> go.Figure:
    """Plot one joint angle as every estimator has it.

    Parameters
    ----------
    runs
        Those without a result, or without the angle, are left out.
    angle
        Name of the angle.
    lifts
        Shaded from lift-off to set-down.
    dark
        Whether the page is dark.
    """
    figure = go.Figure()
    for run, color, dash in zip(runs, DARK if dark else LIGHT, DASHES, strict=False):
        if run.result is None or angle not in run.result.angles.names:
            continue
        angles = run.result.angles
        figure.add_scatter(
            x=angles.time_s,
            y=angles[angle],
            mode="lines",
            line={"color": color, "width": 2.2, "dash": dash},
            name=run.info.title,
            connectgaps=False,
            customdata=np.round(BAND_FACTOR * angles.sigma(angle), 0),
            hovertemplate="%{y:.0f}° ± %{customdata:.0f}°",
        )
    for lift in lifts:
        figure.add_vrect(
            x0=lift.start_s, x1=lift.end_s, fillcolor="rgba(140,155,170,0.16)", line_width=0
        )
    figure.update_layout(
        height=400,
        margin={"l": 8, "r": 8, "t": 16, "b": 110},
        hovermode="x unified",
        legend={"orientation": "h", "y": 0, "yref": "container", "yanchor": "bottom", "x": 0},
        paper_bgcolor=CLEAR,
        plot_bgcolor=CLEAR,
        hoverlabel={"namelength": -1},
    )
    figure.update_xaxes(title="Time (s)", gridcolor=GRID, zeroline=False, automargin=True)
    figure.update_yaxes(title=f"{name_angle(angle)} (°)", gridcolor=GRID, automargin=True)
    return figure


def plot_outliers(runs: Sequence[EstimatorRun], *, dark: bool = False) -> go.Figure:
    """Plot the share of frames in which each estimator's links change their length."""
    shown = [run for run in runs if run.result is not None]
    percent = [100 * run.outlier_ratio for run in shown]
    figure = go.Figure(
        go.Bar(
            x=percent,
            y=[run.info.title for run in shown],
            orientation="h",
            marker={"color": (DARK if dark else LIGHT)[0]},
            text=[f"{value:.1f} %" for value in percent],
            textposition="outside",
            cliponaxis=False,
            hoverinfo="skip",
        )
    )
    figure.update_layout(
        height=70 + 44 * len(shown),
        margin={"l": 8, "r": 56, "t": 8, "b": 40},
        paper_bgcolor=CLEAR,
        plot_bgcolor=CLEAR,
        bargap=0.45,
    )
    figure.update_xaxes(
        title="Frames with an outlier (%)", gridcolor=GRID, rangemode="tozero", automargin=True
    )
    figure.update_yaxes(autorange="reversed", automargin=True)
    return figure
