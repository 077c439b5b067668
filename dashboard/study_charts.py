"""Figures of a validation study. No Streamlit here."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import plotly.graph_objects as go

from dashboard.charts import DARK, LIGHT, frame_figure
from engine.protocol_stored import TrialCurves
from engine.validation.protocol.tables import ROW_TITLES

__all__ = ["name_study_angle", "plot_angles", "plot_persons", "plot_study_curves"]

ZERO = "rgba(140,155,170,0.8)"
ROW_PX, FRAME_PX = 30, 130
PUBLISHED_MM = 9.52
SIDES = {"_r": ", right", "_l": ", left"}


def name_study_angle(name: str) -> str:
    """Return an angle of a study in the words of its tables."""
    side = SIDES.get(name[-2:], "")
    stem = name[:-2] if side else name
    return ROW_TITLES.get(stem, stem.replace("_", " ").capitalize()) + side


def plot_persons(means_mm: Mapping[str, Mapping[str, float]], *, dark: bool = False) -> go.Figure:
    """Plot every person's marker error for every method; method -> person -> mm.

    The paper's figure, of other people, is a line.
    """
    color, warm, _ = DARK if dark else LIGHT
    figure = go.Figure()
    figure.add_scatter(
        x=[value for persons in means_mm.values() for value in persons.values()],
        y=[method for method, persons in means_mm.items() for _ in persons],
        text=[person for persons in means_mm.values() for person in persons],
        mode="markers", marker={"color": color, "size": 10, "opacity": 0.8}, name="One person",
        hovertemplate="%{text}: %{x:.1f} mm<extra>%{y}</extra>",
    )  # fmt: skip
    figure.add_scatter(
        x=[sum(p.values()) / len(p) for p in means_mm.values()], y=list(means_mm), mode="markers",
        marker={"symbol": "line-ns", "size": 22, "line": {"width": 3, "color": _ink(dark=dark)}},
        name="Mean of the persons", hovertemplate="mean %{x:.1f} mm<extra>%{y}</extra>",
    )  # fmt: skip
    figure.add_vline(x=PUBLISHED_MM, line={"color": warm, "dash": "dash", "width": 1.6})
    figure.add_scatter(
        x=[None], y=[None], mode="lines", line={"color": warm, "dash": "dash", "width": 1.6},
        name="Mehrizi et al. (2018), other people",
    )  # fmt: skip
    _lay_down(figure, len(means_mm), "Marker error (mm)")
    figure.update_xaxes(rangemode="tozero")
    return figure


def plot_angles(rows: Sequence[Mapping[str, str]], *, dark: bool = False) -> go.Figure:
    """Plot the mean absolute difference of every angle with its SD; rows of the table angles."""
    color, _, _ = DARK if dark else LIGHT
    figure = go.Figure()
    figure.add_bar(
        x=[_number(row["mae_deg"]) for row in rows],
        y=[name_study_angle(row["angle"]) for row in rows],
        orientation="h", marker={"color": color}, showlegend=False,
        error_x={"type": "data", "array": [_number(row["sd_absolute_deg"]) for row in rows],
                 "arrayminus": [0.0] * len(rows), "color": _ink(dark=dark), "thickness": 1.3},
        hovertemplate="%{y}: %{x:.2f}° ± %{error_x.array:.2f}°<extra></extra>",
    )  # fmt: skip
    _lay_down(figure, len(rows), "Mean absolute difference and its SD (°)")
    figure.update_layout(bargap=0.35)
    return figure


def plot_study_curves(curves: TrialCurves, name: str, *, dark: bool = False) -> go.Figure:
    """Plot one angle of one trial, from the videos and from the measured markers."""
    video, reference, _ = DARK if dark else LIGHT
    column = curves.names.index(name)
    figure = go.Figure()
    for values, title, color, dash in (
        (curves.reference_deg, "From the measured markers", reference, "dash"),
        (curves.estimated_deg, "From the videos", video, "solid"),
    ):
        figure.add_scatter(
            x=curves.time_s, y=values[:, column], mode="lines", name=title,
            line={"color": color, "width": 2.4, "dash": dash}, hovertemplate="%{y:.1f}°",
        )  # fmt: skip
    frame_figure(figure, height=340)
    figure.update_layout(hovermode="x unified")
    figure.update_xaxes(title="Time (s)")
    figure.update_yaxes(title="Angle (°)")
    return figure


def _number(text: str) -> float | None:
    return float(text) if text else None


def _ink(*, dark: bool) -> str:
    return "#c9d4de" if dark else "#3d4b58"


def _lay_down(figure: go.Figure, n_rows: int, title: str) -> None:
    frame_figure(figure, height=FRAME_PX + ROW_PX * max(n_rows, 3))
    figure.update_xaxes(title=title)
    figure.update_yaxes(autorange="reversed")
