"""The report's figures as SVG; their colours are CSS variables of the page, light or dark."""

from __future__ import annotations

import html
import io
import re
import warnings
from collections.abc import Sequence
from typing import Any

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from visadapt.diagnosis.result import Chart, Prediction, RecordingSummary, Region
from visadapt.diagnosis.words import plain
from visadapt.systems import System

INK, MUTED, LINE = "#1f2933", "#6e7a88", "#d8dde3"
BEFORE, AFTER, BLACK_BOX = "#de7416", "#2f67c9", "#0e7a70"
CSS_VARIABLES = {INK: "ink", MUTED: "muted", LINE: "line", BEFORE: "before", AFTER: "after", BLACK_BOX: "black-box"}
"""Colours in matplotlib, and the page's CSS variables that replace them."""

MAX_STATES = 5  # States of a prediction that are plotted

FIGURE_WIDTH = 4.0  # inches; at the font size of STYLE, the text is readable on a phone
STYLE: dict[Any, Any] = {
    "svg.fonttype": "none",  # letters as text, not as paths
    "svg.hashsalt": "visadapt",  # fixed ids: equal diagnoses give equal pages
    "font.family": "sans-serif",
    "font.size": 9,
    "figure.facecolor": "none",  # transparent
    "axes.facecolor": "none",
    "axes.edgecolor": MUTED,
    "axes.labelcolor": INK,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "grid.color": LINE,
    "grid.linewidth": 0.7,
    "text.color": INK,
    "xtick.color": MUTED,
    "ytick.color": MUTED,
    "xtick.labelcolor": INK,
    "ytick.labelcolor": INK,
    "legend.frameon": False,
    "legend.fontsize": 8.5,
}


def prediction(one: Prediction, recording: RecordingSummary, system: type[System], corrected: bool) -> str:
    """A held-out window: its states as measured, and as predicted from its start."""
    shown = _most_wrong(
        one, [index for index in range(len(system.states)) if np.isfinite(one.measured[:, index]).any()]
    )
    with matplotlib.rc_context(STYLE):
        figure = Figure((FIGURE_WIDTH, 0.5 + 1.15 * len(shown)), layout="constrained")
        rows: list[Axes] = list(figure.subplots(len(shown), 1, sharex=True, squeeze=False)[:, 0])
        for axes, index in zip(rows, shown, strict=True):
            variable = system.states[index]
            axes.plot(one.time, one.source[:, index], color=BEFORE, linewidth=1.6, label="simulator")
            if corrected:
                axes.plot(one.time, one.corrected[:, index], color=AFTER, linewidth=1.6, label="with the causes")
            axes.plot(one.time, one.measured[:, index], ".", color=INK, markersize=4, label="measured")
            axes.set_ylabel(f"{variable.name} [{variable.unit}]")
            axes.yaxis.set_major_locator(MaxNLocator(4))
        episode = recording.episode(one.episode)
        rows[-1].set_xlabel(f"time in {episode} [s]", parse_math=False)  # a file's name may hold dollar signs
        _legend(figure, rows[0])
        return _svg(figure, f"measured and predicted states, {episode}")


def _most_wrong(one: Prediction, measured: Sequence[int]) -> list[int]:
    """The MAX_STATES measured states with the largest error of the source relative to its change from row to row, a
    measure of the noise."""
    error = (one.source - one.measured)[:, measured]
    with warnings.catch_warnings(action="ignore", category=RuntimeWarning):  # of a state without two readings in a row
        relative = np.sqrt(np.nanmean(error**2, 0) / np.nanmean(np.diff(error, axis=0) ** 2, 0).clip(1e-300))
    return sorted(measured[k] for k in np.argsort(-relative)[:MAX_STATES])


def profile(one: Chart, regions: Sequence[Region], corrected: bool) -> str:
    """The mean residual over a variable with 90 % confidence bands; regions are shaded."""
    with matplotlib.rc_context(STYLE):
        figure, axes = _one_plot(one)
        for region in regions:
            if region.variable == one.variable:
                axes.axvspan(region.start, region.end, color=LINE, alpha=0.7, zorder=0, linewidth=0)
        axes.axhline(0, color=MUTED, linewidth=0.8)
        for curve, colour in zip(one.curves[: 1 + corrected], (BEFORE, AFTER), strict=False):
            assert curve.error is not None
            low, high = curve.values - 1.645 * curve.error, curve.values + 1.645 * curve.error
            axes.fill_between(one.x, low, high, color=colour, alpha=0.22, linewidth=0)
            axes.plot(one.x, curve.values, color=colour, linewidth=1.6, marker="o", markersize=3, label=curve.label)
        _legend(figure, axes)
        return _svg(figure, f"residual {one.quantity} over {one.variable}")


def growth(one: Chart, corrected: bool) -> str:
    """The error over the horizon of prediction."""
    with matplotlib.rc_context(STYLE):
        figure, axes = _one_plot(one)
        styles = ((BEFORE, 1.8, "-"), (AFTER, 1.8, "-"), (BLACK_BOX, 1.4, "--"), (MUTED, 1.4, ":"))
        for k, (curve, (colour, width, dashes)) in enumerate(zip(one.curves, styles, strict=True)):
            if k != 1 or corrected:
                axes.plot(one.x, curve.values, color=colour, linewidth=width, linestyle=dashes, label=curve.label)
        axes.set_ylim(bottom=0)
        _legend(figure, axes)
        return _svg(figure, "error over the horizon of prediction")


def spectrum(one: Chart, corrected: bool) -> str:
    """The residual's power over frequency."""
    with matplotlib.rc_context(STYLE):
        figure, axes = _one_plot(one)
        for curve, colour in zip(one.curves[: 1 + corrected], (BEFORE, AFTER), strict=False):
            axes.semilogy(one.x, curve.values, color=colour, linewidth=1.6, label=curve.label)
        _legend(figure, axes)
        return _svg(figure, f"spectrum of the residual {one.quantity}")


def _one_plot(one: Chart) -> tuple[Figure, Axes]:
    figure = Figure((FIGURE_WIDTH, 2.7), layout="constrained")
    axes = figure.subplots()
    axes.set_xlabel(_labelled(one.variable, one.variable_unit))
    axes.set_ylabel(_labelled(one.quantity, one.quantity_unit))
    return figure, axes


def _labelled(name: str, unit: str) -> str:
    return plain(name) if unit in ("1", "") else f"{plain(name)} [{unit}]"


def _legend(figure: Figure, axes: Axes) -> None:
    handles, labels = axes.get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside upper center", ncols=len(handles), handlelength=1.5, columnspacing=1.2)


def _svg(figure: Figure, title: str) -> str:
    """The figure as an HTML element with a title for screen readers."""
    text = io.StringIO()
    figure.savefig(text, format="svg", metadata={"Date": None, "Creator": None})
    svg = text.getvalue()
    svg = re.sub(r"<metadata>.*?</metadata>", "", svg[svg.index("<svg") :], flags=re.DOTALL)
    # Without width and height, so that the page's CSS sets the size.
    view = re.search(r'viewBox="[^"]*"', svg)
    assert view is not None
    svg = f'<svg role="img" {view[0]}><title>{html.escape(title)}</title>{svg[svg.index(">") + 1 :]}'
    for colour, name in CSS_VARIABLES.items():
        svg = svg.replace(colour, f"var(--{name})")
    return svg
