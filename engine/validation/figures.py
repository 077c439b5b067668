"""Printable figures of a comparison, as PNG.

Drawn without Matplotlib's global state, so that they can be made anywhere, also in a thread.
"""

from __future__ import annotations

import io
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.ticker import AutoLocator, MaxNLocator

from engine.datatypes import Array
from engine.validation.agreement import AngleSummary
from engine.validation.compare import TrialComparison
from engine.validation.pooled import (
    Agreement,
    bland_altman_points,
    find_sides,
    pooled_differences,
)
from engine.validation.wording import title_angle

__all__ = [
    "draw_bland_altman",
    "draw_boxes",
    "draw_curves",
    "draw_errors",
    "draw_figures",
    "draw_sides",
]

RESULT, REFERENCE, DIFFERENCE = "#0072b2", "#c24e00", "#3d4b58"
SIDES = ("#0072b2", "#c24e00")
GRID = "#d6dee6"
DPI = 110
COLUMNS = 4
Z95 = 1.96


def draw_figures(agreement: Agreement) -> Mapping[str, bytes]:
    """Draw every figure; name to PNG."""
    figures = {
        "errors": draw_errors(agreement),
        "boxes": draw_boxes(agreement),
        "bland_altman": draw_bland_altman(agreement),
    }
    if find_sides(agreement):
        figures["sides"] = draw_sides(agreement)
    for number, trial in enumerate(agreement.trials, start=1):
        figures[f"curves_{number:02d}"] = draw_curves(trial)
    return {name: _to_png(figure) for name, figure in figures.items()}


def _to_png(figure: Figure) -> bytes:
    buffer = io.BytesIO()
    FigureCanvasAgg(figure)
    figure.savefig(buffer, format="png", dpi=DPI)
    return buffer.getvalue()


def _style(axes: Axes) -> None:
    axes.grid(color=GRID, linewidth=0.6)
    axes.set_axisbelow(True)
    axes.tick_params(labelsize=7, length=2, color=GRID)
    # Ticks cost most of the drawing time.
    for axis in (axes.xaxis, axes.yaxis):
        if isinstance(axis.get_major_locator(), AutoLocator):
            axis.set_major_locator(MaxNLocator(4))
    for spine in axes.spines.values():
        spine.set_color(GRID)


def _seen(agreement: Agreement) -> tuple[AngleSummary, ...]:
    return tuple(s for s in agreement.angles if s.pooled.n_samples)


# --------------------------------------------------------------------------- curves


def draw_curves(trial: TrialComparison) -> Figure:
    """Draw both curves of every angle on one time axis, and below it the difference.

    The band of the difference holds mean ± 1.96 SD over the trial.
    """
    n = len(trial.names)
    rows = -(-n // COLUMNS)
    figure = Figure(figsize=(3.0 * COLUMNS, 2.5 * rows + 0.8), dpi=DPI)
    top = 1 - 0.75 / (2.5 * rows + 0.8)
    outer = figure.add_gridspec(
        rows, COLUMNS, left=0.045, right=0.99, top=top, bottom=0.45 / (2.5 * rows + 0.8),
        hspace=0.32, wspace=0.22,
    )  # fmt: skip
    for i, name in enumerate(trial.names):
        inner = outer[i // COLUMNS, i % COLUMNS].subgridspec(2, 1, height_ratios=(3, 2), hspace=0.1)
        upper = figure.add_subplot(inner[0])
        lower = figure.add_subplot(inner[1], sharex=upper)
        _draw_pair(upper, lower, trial, i)
        upper.set_title(title_angle(name), fontsize=9, loc="left", pad=3)
        if i + COLUMNS >= n:
            lower.set_xlabel("Time (s)", fontsize=8)
    handles, labels = figure.axes[0].get_legend_handles_labels()
    more, words = figure.axes[1].get_legend_handles_labels()
    figure.legend(
        handles + more, labels + words, loc="upper right", ncols=5, fontsize=8, frameon=False
    )
    figure.text(0.045, 0.985, _title(trial), va="top", fontsize=10)
    return figure


def _title(trial: TrialComparison) -> str:
    # Matplotlib reads dollar signs as formulas.
    return f"{trial.label} and {trial.reference.name}, degrees".replace("$", r"\$")


def _draw_pair(upper: Axes, lower: Axes, trial: TrialComparison, column: int) -> None:
    time, difference = trial.pairs.time_s, trial.difference_deg[:, column]
    reference = trial.pairs.reference_deg[:, column]
    upper.plot(time, reference, color=REFERENCE, linewidth=1.3, dashes=(4, 2), label="reference")
    upper.plot(
        time, trial.estimated_deg[:, column], color=RESULT, linewidth=1.3, label="from the video"
    )
    upper.tick_params(labelbottom=False)
    known = difference[np.isfinite(difference)]
    mean, sd = float(known.mean()), float(known.std(ddof=1))
    lower.axhline(0.0, color="#9fb0bf", linewidth=0.8)
    lower.axhspan(mean - Z95 * sd, mean + Z95 * sd, color=DIFFERENCE, alpha=0.12, linewidth=0,
                  label="mean ± 1.96 SD")  # fmt: skip
    lower.plot(time, difference, color=DIFFERENCE, linewidth=1.0, label="difference")
    for axes in (upper, lower):
        _style(axes)


# --------------------------------------------------------------------------- bars and boxes


def draw_errors(agreement: Agreement) -> Figure:
    """Draw the root mean square error of every angle, with its interval where there is one."""
    summaries = _seen(agreement)
    figure, axes = _lying_axes(len(summaries))
    y = np.arange(len(summaries))
    rmse = np.array([s.rmse.estimate for s in summaries])
    mae = np.array([s.pooled.mae_deg for s in summaries])
    axes.barh(y, rmse, color=RESULT, height=0.62, label="root mean square error")
    axes.scatter(mae, y, color="white", edgecolor="black", zorder=3, s=22, label="mean absolute")
    low = np.array([s.rmse.interval.low for s in summaries])
    high = np.array([s.rmse.interval.high for s in summaries])
    known = np.isfinite(low) & np.isfinite(high)
    if known.any():
        arms = np.vstack([rmse - low, high - rmse])[:, known]
        axes.errorbar(
            rmse[known], y[known], xerr=np.maximum(arms, 0.0), fmt="none", ecolor="black",
            elinewidth=1.0, capsize=3, label="95 % interval over units",
        )  # fmt: skip
    _name_rows(axes, summaries)
    axes.set_xlabel("Error (°)", fontsize=9)
    axes.set_xlim(left=0)
    axes.legend(fontsize=8, frameon=False, loc="lower left", bbox_to_anchor=(-0.02, 1), ncols=3)
    return figure


def draw_sides(agreement: Agreement) -> Figure:
    """Draw the root mean square error of left and right side by side."""
    sides = find_sides(agreement)
    figure, axes = _lying_axes(2 * len(sides))
    y = np.arange(len(sides))
    for shift, word, color, side in ((-0.2, "left", SIDES[0], 1), (0.2, "right", SIDES[1], 2)):
        values = [row[side].pooled.rmse_deg for row in sides]  # type: ignore[union-attr]
        hatch = "" if side == 1 else "///"
        axes.barh(y + shift, values, color=color, height=0.36, label=word, hatch=hatch,
                  edgecolor="white")  # fmt: skip
    axes.set_yticks(y, [title_angle(name) for name, _, _ in sides], fontsize=8)
    axes.invert_yaxis()
    axes.set_xlabel("Root mean square error (°)", fontsize=9)
    axes.legend(fontsize=8, frameon=False, loc="lower left", bbox_to_anchor=(-0.02, 1), ncols=3)
    return figure


def draw_boxes(agreement: Agreement) -> Figure:
    """Draw the differences of all frames: median, quartiles, and 2.5 to 97.5 % as whiskers."""
    summaries = _seen(agreement)
    figure, axes = _lying_axes(len(summaries))
    boxes: list[dict[str, Any]] = []
    for s in summaries:
        low, q1, median, q3, high = np.percentile(
            pooled_differences(agreement.trials, s.name), [2.5, 25, 50, 75, 97.5]
        )
        boxes.append(
            {"whislo": low, "q1": q1, "med": median, "q3": q3, "whishi": high, "fliers": []}
        )
    # The estimate's spread around zero is what counts, so zero is drawn.
    axes.axvline(0.0, color="#566472", linewidth=0.9)
    axes.bxp(
        boxes, positions=list(range(len(boxes))), orientation="horizontal", widths=0.55,
        showfliers=False, patch_artist=True,
        boxprops={"facecolor": "#cfe3f1", "edgecolor": RESULT},
        medianprops={"color": REFERENCE, "linewidth": 1.6},
        whiskerprops={"color": RESULT}, capprops={"color": RESULT},
    )  # fmt: skip
    _name_rows(axes, summaries)
    axes.set_xlabel("Difference, video minus reference (°)", fontsize=9)
    return figure


def _lying_axes(n_rows: int) -> tuple[Figure, Axes]:
    height = 0.27 * max(n_rows, 3) + 1.0
    figure = Figure(figsize=(7.2, height), dpi=DPI)
    axes = figure.add_axes((0.28, 0.55 / height, 0.69, 1 - 0.9 / height))
    _style(axes)
    return figure, axes


def _name_rows(axes: Axes, summaries: Sequence[AngleSummary]) -> None:
    axes.set_yticks(range(len(summaries)), [title_angle(s.name) for s in summaries], fontsize=8)
    axes.invert_yaxis()


# --------------------------------------------------------------------------- Bland and Altman


def draw_bland_altman(agreement: Agreement) -> Figure:
    """Draw difference against mean with bias and limits of agreement, one plot per angle."""
    summaries = _seen(agreement)
    rows = -(-len(summaries) // COLUMNS)
    height = 2.2 * rows + 0.5
    figure = Figure(figsize=(3.0 * COLUMNS, height), dpi=DPI)
    grid = figure.add_gridspec(
        rows, COLUMNS, left=0.055, right=0.99, top=1 - 0.3 / height, bottom=0.45 / height,
        hspace=0.36, wspace=0.24,
    )  # fmt: skip
    for i, summary in enumerate(summaries):
        axes = figure.add_subplot(grid[i // COLUMNS, i % COLUMNS])
        mean, difference = bland_altman_points(agreement.trials, summary.name)
        axes.scatter(mean, difference, s=4, color=RESULT, alpha=0.35, linewidth=0)
        limits = summary.bland_altman
        for value, interval in (
            (limits.bias, limits.bias_interval),
            (limits.lower, limits.lower_interval),
            (limits.upper, limits.upper_interval),
        ):
            color = DIFFERENCE if value == limits.bias else REFERENCE
            axes.axhline(value, color=color, linewidth=1.1, linestyle="-" if color == DIFFERENCE
                         else "--")  # fmt: skip
            if interval.is_known:
                # At the edge, where it hides no dots.
                axes.plot([0.985] * 2, interval, color=color, linewidth=2.5, alpha=0.7,
                          transform=axes.get_yaxis_transform())  # fmt: skip
        axes.set_title(title_angle(summary.name), fontsize=9, loc="left", pad=3)
        _style(axes)
        _fit_height(axes, difference, limits.lower, limits.upper)
        if i + COLUMNS >= len(summaries):
            axes.set_xlabel("Mean of both (°)", fontsize=8)
        if i % COLUMNS == 0:
            axes.set_ylabel("Difference (°)", fontsize=8)
    return figure


def _fit_height(axes: Axes, difference: Array, lower: float, upper: float) -> None:
    """Show dots and limits; wide intervals of the limits may leave the picture."""
    low = min(float(difference.min()), lower)
    high = max(float(difference.max()), upper)
    margin = 0.12 * (high - low) or 1.0
    axes.set_ylim(low - margin, high + margin)
