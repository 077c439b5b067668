"""A picture of a comparison: aligned curves with their bands, phase by phase."""

from __future__ import annotations

import io
import math

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from engine.form.compare import Comparison, order_angles
from engine.form.performance import side_of
from engine.form.phases import phase_bounds

__all__ = ["plot_comparison"]

COLORS = ("#0072b2", "#c24e00")
COVERAGE_FACTOR = 1.96
MOST_ANGLES = 8


def plot_comparison(comparison: Comparison) -> bytes:
    """Draw the angles that differ most over 0 to 100 % of the movement; return a PNG.

    Bands are about 95 % of that part of each clip's error which does not repeat in the other;
    hatching marks where the difference goes beyond the error, dotted lines part the phases.
    """
    names = order_angles(comparison)[:MOST_ANGLES]
    n_rows = math.ceil(len(names) / 2)
    figure = Figure(figsize=(10, 2.4 * n_rows + 0.9), layout="constrained")
    axes = figure.subplots(n_rows, 2, squeeze=False, sharex=True).ravel()
    for ax, name in zip(axes, names, strict=False):
        _plot_angle(ax, comparison, name)
    for ax in axes[len(names) :]:
        ax.set_axis_off()
    for ax in axes[max(len(names) - 2, 0) : len(names)]:
        ax.tick_params(labelbottom=True)
        ax.set_xlabel("Share of the movement (%)")
    handles, labels = axes[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=3, frameon=False)
    low, high = comparison.score.interval
    figure.suptitle(
        f"{comparison.attempt} against {comparison.reference}: score "
        f"{comparison.score.value:.0f} ({low:.0f} to {high:.0f})"
    )
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=120)
    return buffer.getvalue()


def _plot_angle(ax: Axes, comparison: Comparison, name: str) -> None:
    i = comparison.names.index(name)
    percent = comparison.percent
    rows = (
        ("Reference", comparison.reference_deg, comparison.reference_sigma_deg, "-"),
        ("Attempt", comparison.attempt_deg, comparison.attempt_sigma_deg, "--"),
    )
    for (title, value, sigma, dash), color in zip(rows, COLORS, strict=True):
        half = COVERAGE_FACTOR * comparison.own_error_share * sigma[:, i]
        ax.fill_between(
            percent, value[:, i] - half, value[:, i] + half, color=color, alpha=0.1, linewidth=0
        )
        ax.plot(percent, value[:, i], color=color, linestyle=dash, linewidth=1.8, label=title)
    difference = np.abs(comparison.difference_deg[:, i])
    is_beyond = difference > COVERAGE_FACTOR * comparison.difference_sigma_deg[:, i]
    ax.fill_between(
        percent,
        comparison.reference_deg[:, i],
        comparison.attempt_deg[:, i],
        where=is_beyond.tolist(),
        facecolor="none",
        edgecolor="0.45",
        hatch="////",
        linewidth=0,
        label="Beyond the error",
    )
    for at in phase_bounds(comparison.phases)[1:-1]:
        ax.axvline(at, color="0.5", linewidth=0.8, linestyle=":")
    parts = side_of(name)
    side = f", {parts['side']}" if parts["side"] else ""
    ax.set_title(parts["base"].replace("_", " ").capitalize() + side, fontsize=10, loc="left")
    ax.set_ylabel("deg")
    ax.set_xlim(0, 100)
    ax.margins(y=0.08)
    ax.spines[["top", "right"]].set_visible(False)
