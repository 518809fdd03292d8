"""Plots: the losses of the joint loop, and results over the number of counted target samples."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator, NullLocator

from visadapt.films.widgets import BLUE, HAIRLINE, INK, MUTED, ORANGE, STYLE, TEAL, Floats
from visadapt.learning.rounds import Round
from visadapt.storage.atomic_files import replacing

REFERENCE_LEVELS = (("target", "before adaptation", ORANGE), ("source", "in the source", MUTED))
"""Domains of results without adaptation, drawn as levels: label and colour."""
METHOD_COLOURS = (TEAL, BLUE, INK, "#8a5fb5", "#b8487a", "#7d8c2c", "#4fa3a0", "#9a6a3c")
"""Of the methods in charts, in the order in which they first come."""
MOST_TICKS = 8  # Most sample counts labelled one by one; with more, labels would overlap: powers of ten are labelled


@matplotlib.rc_context(STYLE)
def plot_losses(path: str | os.PathLike[str], rounds: Sequence[Round]) -> None:
    """Write a PNG of grounding and policy losses over the iterations of the joint loop, in the order they were run.

    A round grounds the simulator first, then tunes the policy, so the two curves alternate. A linear residual is
    solved in one step: its loss is drawn as a vertical line down to a dot.
    """
    if not rounds:
        raise ValueError("no rounds to plot")
    figure = Figure(figsize=(9.0, 5.4), dpi=150, layout="constrained")
    upper, lower = figure.subplots(2, 1, sharex=True)
    start = 0.0
    whole = sum(_iterations(each) + len(each.policy) for each in rounds)
    for i, each in enumerate(rounds):
        for axes in (upper, lower):
            axes.axvline(start, color=HAIRLINE, linewidth=1, zorder=0)
        samples = f" {each.samples:,}" + ("" if i else " samples")
        upper.text(start, 1.02, samples, transform=upper.get_xaxis_transform(), color=MUTED, fontsize=8)
        for column, colour, name in ((1, BLUE, "training data"), (2, ORANGE, "held out")):
            points = np.array([(row[0], row[column]) for row in each.grounding], float).reshape(-1, 2)
            solved = len(points) == 2
            if solved:  # slightly apart, or one would hide the other
                points[:, 0] = 0.008 * column * whole
            dot, label = "o" if solved else None, None if i else name
            x = start + points[:, 0]
            upper.plot(x, points[:, 1], color=colour, linewidth=1.4, label=label, marker=dot, ms=4, markevery=[-1])
        start += _iterations(each)
        lower.plot(start + np.arange(len(each.policy)), each.policy, color=TEAL, linewidth=1.4)
        start += len(each.policy)
    for axes, name in ((upper, "grounding loss"), (lower, "policy loss")):
        _scale(axes)
        axes.set_ylabel(name)
    upper.legend(loc="upper right")
    lower.set(xlabel="iterations so far (grounding, then policy, round by round)", xlim=(0, max(start, 1.0)))
    save_figure(figure, path)


@matplotlib.rc_context(STYLE)
def plot_curve(
    path: str | os.PathLike[str], rows: Sequence[Mapping[str, Any]], paper: tuple[int, float] | None = (1000, 0.29)
) -> None:
    """Write a PNG of the mean cart speed after adaptation over counted target samples.

    Bands are the spread over seeds; each point is labelled with the share of the episodes that survived.

    Args:
        path: of the PNG.
        rows: of one table under results/ (numbers may be strings): `domain` (adapted; target is before adaptation,
            source is drawn for comparison), `samples`, `mean` and `std` in m/s (empty or nan where none survived),
            `episodes`, `failed`, and `method`, one line each.
        paper: samples and m/s of the paper's image policy after adaptation, drawn as a level line; None draws none.
    """
    adapted = [row for row in rows if row["domain"] == "adapted"]
    if not adapted:
        raise ValueError("no rows of domain 'adapted' to plot")
    figure = Figure(figsize=(7.2, 4.4), dpi=150, layout="constrained")
    axes = figure.subplots()
    for k, method in enumerate(dict.fromkeys(row["method"] for row in adapted)):
        members, colour, below = _of(adapted, method), (TEAL, BLUE, ORANGE, INK)[k % 4], k % 2
        samples, mean, std = _draw_method(axes, members, method or "adapted", colour)
        axes.fill_between(samples, mean - std, mean + std, color=colour, alpha=0.18)
        for row, x, y in zip(members, samples, np.nan_to_num(mean + (1 - 2 * below) * np.nan_to_num(std)), strict=True):
            axes.annotate(
                f"{_up(row)} up",
                (x, y),
                (0, -12 if below else 5),
                textcoords="offset points",
                ha="center",
                color=colour,
                fontsize=8,
            )
    for domain, label, colour in REFERENCE_LEVELS:
        for row in [row for row in rows if row["domain"] == domain][:1]:
            level = _number(row["mean"])
            found = f"{level:.2f} m/s, {_up(row)} up" if np.isfinite(level) else "none stays up"
            _level(axes, level, f"{label}: {found}", colour)
    if paper is not None:
        _level(axes, paper[1], f"the paper at {paper[0]:,}: {paper[1]:.2f} m/s", INK, ":")
    axes.set_xscale("log")
    _count_samples(axes, adapted)
    axes.set_ylabel("mean cart speed, m/s")
    axes.set_ylim(0, axes.get_ylim()[1] * 1.15)
    axes.legend(loc="best")
    save_figure(figure, path)


@dataclass(frozen=True)
class Chart:
    """One measure over counted target samples."""

    title: str
    label: str
    """of the measure, with its unit"""
    rows: Sequence[Mapping[str, Any]]
    """of a table under results/ (numbers may be strings): a line for each `method`, a band of `std` about its `mean`;
    rows with 0 samples are drawn as levels: `domain` target is before adaptation, source is for comparison"""


@matplotlib.rc_context(STYLE)
def plot_charts(path: str | os.PathLike[str], charts: Sequence[Chart], columns: int = 1) -> None:
    """Write a PNG of charts, `columns` in a row, on logarithmic axes; a method has the same colour in all of them."""
    methods = dict.fromkeys(row["method"] for chart in charts for row in chart.rows if float(row["samples"]) > 0)
    if not methods:
        raise ValueError("no rows of counted samples to plot")
    lines = -(-len(charts) // columns)
    figure = Figure(figsize=(4.8 * max(columns, 1.5), 0.6 + 3.0 * lines), dpi=150, layout="constrained")
    places = list(figure.subplots(lines, columns, squeeze=False).flat)
    for axes, chart in zip(places, charts, strict=False):
        _draw_chart(axes, chart, {method: METHOD_COLOURS[k % len(METHOD_COLOURS)] for k, method in enumerate(methods)})
    for spare in places[len(charts) :]:
        figure.delaxes(spare)
    keys = {name: line for axes in places for line, name in zip(*axes.get_legend_handles_labels(), strict=True)}
    figure.legend(keys.values(), keys, loc="outside lower center", ncols=min(len(keys), 5))
    save_figure(figure, path)


def _draw_chart(axes: Axes, chart: Chart, colours: Mapping[str, str]) -> None:
    for domain, label, colour in REFERENCE_LEVELS:
        for row in chart.rows:
            if float(row["samples"]) == 0 and row["domain"] == domain:
                _level(axes, _number(row["mean"]), label, colour)
    counted = [row for row in chart.rows if float(row["samples"]) > 0]
    drawn = [_draw_method(axes, _of(counted, method), method, colour) for method, colour in colours.items()]
    _scale(axes)
    bottom = axes.get_ylim()[0]
    for (samples, mean, std), colour in zip(drawn, colours.values(), strict=True):
        low = np.where(mean - std > 0, mean - std, bottom)  # a logarithmic axis has no zero
        axes.fill_between(samples, low, mean + std, color=colour, alpha=0.16)
    ticks = [float(row["samples"]) for row in counted]
    axes.set_xscale("log" if max(ticks) > 10 * min(ticks) else "linear")
    _count_samples(axes, counted)
    axes.set(ylabel=chart.label, title=chart.title)


def _draw_method(
    axes: Axes, rows: Sequence[Mapping[str, Any]], label: str, colour: str
) -> tuple[Floats, Floats, Floats]:
    """Draw the means of a method's rows; returns their samples, means and standard deviations, nan where none is."""
    samples, mean, std = (np.array([_number(row[key]) for row in rows]) for key in ("samples", "mean", "std"))
    mean[~np.isfinite(mean)] = np.nan
    axes.plot(samples, mean, color=colour, linewidth=2, marker="o", markersize=5, label=label)
    return samples, mean, std


def _of(rows: Sequence[Mapping[str, Any]], method: str) -> list[Mapping[str, Any]]:
    return sorted((row for row in rows if row["method"] == method), key=lambda row: float(row["samples"]))


def _count_samples(axes: Axes, rows: Sequence[Mapping[str, Any]]) -> None:
    ticks = sorted({float(row["samples"]) for row in rows})
    if len(ticks) > MOST_TICKS and axes.get_xscale() == "log":
        axes.xaxis.set_major_locator(LogLocator())
    else:
        axes.set_xticks(ticks)
    axes.xaxis.set_major_formatter("{x:,.0f}")
    axes.set_xticks([], minor=True)
    axes.set_xlabel("counted target samples")


def _scale(axes: Axes) -> None:
    """Make the y axis logarithmic with plain numbers, if any curve has a positive value."""
    curves = [line for line in axes.get_lines() if line.get_zorder() > 0]  # the lines that mark rounds have 0
    if not any(np.any(np.asarray(line.get_ydata(), float) > 0) for line in curves):
        return
    axes.set_yscale("log", nonpositive="mask")
    low, high = axes.get_ylim()
    axes.yaxis.set_major_locator(LogLocator(subs=(1, 2, 5) if high > 5 * low else range(1, 10)))
    axes.yaxis.set_major_formatter("{x:g}")
    axes.yaxis.set_minor_locator(NullLocator())


def _level(axes: Axes, height: float, label: str, colour: str, style: str = "--") -> None:
    axes.axhline(height, color=colour, linewidth=1.2, linestyle=style, label=label, zorder=1)


def save_figure(figure: Figure, path: str | os.PathLike[str]) -> None:
    """Write a figure as a PNG."""
    FigureCanvasAgg(figure)
    with replacing(path) as temporary:
        figure.savefig(temporary, format="png")


def _up(row: Mapping[str, Any]) -> str:
    """The share of a row's episodes that survived"""
    return f"{1 - float(row['failed']) / float(row['episodes']):.0%}"


def _number(value: Any) -> float:
    """A number of a table's cell; nan where it is empty."""
    return float("nan") if value in (None, "") else float(value)


def _iterations(each: Round) -> float:
    """Iterations of a round's grounding, the first of which is number 0 or 1."""
    return float(max((row[0] for row in each.grounding), default=-1) + 1)
