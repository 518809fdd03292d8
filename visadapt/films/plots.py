"""Plots: the losses of the joint loop, and results over the number of counted target samples."""

from __future__ import annotations

import os
from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator, NullLocator

from visadapt.films import colours
from visadapt.learning.joint import Round
from visadapt.storage.atomic_files import replacing

BLUE, ORANGE, TEAL, INK, MUTED, HAIRLINE = (
    colours.hexadecimal(colour)
    for colour in (colours.BLUE, colours.ORANGE, colours.TEAL, colours.INK, colours.MUTED, colours.HAIRLINE)
)
REFERENCE_LEVELS = (("target", "before adaptation", ORANGE), ("source", "in the source", MUTED))
"""Domains of results without adaptation, drawn as levels: label and colour."""


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
        first = i == 0
        for axes in (upper, lower):
            axes.axvline(start, color=HAIRLINE, linewidth=1, zorder=0)
        upper.annotate(
            f"{each.samples:,}" + (" samples" if first else ""),
            (start, 1.0),
            (3, 3),
            xycoords=("data", "axes fraction"),
            textcoords="offset points",
            color=MUTED,
            fontsize=8,
        )
        for column, colour, name in ((1, BLUE, "training data"), (2, ORANGE, "held out")):
            points = np.array([(row[0], row[column]) for row in each.grounding], float).reshape(-1, 2)
            label = name if first else None
            solved = len(points) == 2
            if solved:  # slightly apart, or one would hide the other
                points[:, 0] = 0.008 * column * whole
            dot = "o" if solved else None
            x = start + points[:, 0]
            upper.plot(x, points[:, 1], color=colour, linewidth=1.4, label=label, marker=dot, ms=4, markevery=[-1])
        start += _iterations(each)
        lower.plot(start + np.arange(len(each.policy)), each.policy, color=TEAL, linewidth=1.4)
        start += len(each.policy)
    for axes, title in ((upper, "grounding loss"), (lower, "policy loss")):
        _scale(axes)
        _dress(axes, title)
    upper.legend(frameon=False, fontsize=9, loc="upper right")
    lower.set_xlabel("iterations so far (grounding, then policy, round by round)", color=INK)
    lower.set_xlim(0, max(start, 1.0))
    _save(figure, path)


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
    adapted: dict[str, list[Mapping[str, Any]]] = defaultdict(list)
    for row in rows:
        if row["domain"] == "adapted":
            adapted[str(row.get("method", ""))].append(row)
    if not adapted:
        raise ValueError("no rows of domain 'adapted' to plot")
    figure = Figure(figsize=(7.2, 4.4), dpi=150, layout="constrained")
    axes = figure.subplots()
    for line, (method, members) in enumerate(adapted.items()):
        members.sort(key=lambda row: float(row["samples"]))
        _draw_method(axes, method, members, (TEAL, BLUE, ORANGE, INK)[line % 4], -12 if line % 2 else 5)
    for domain, label, colour in REFERENCE_LEVELS:
        for row in [row for row in rows if row["domain"] == domain][:1]:
            up = 1 - float(row["failed"]) / float(row["episodes"])
            mean = _number(row["mean"])
            if np.isfinite(mean):
                _level(axes, mean, f"{label}: {mean:.2f} m/s, {up:.0%} up", colour)
            else:
                axes.plot([], [], color=colour, linestyle="--", label=f"{label}: none stays up")
    if paper is not None:
        _level(axes, paper[1], f"the paper at {paper[0]:,}: {paper[1]:.2f} m/s", INK, ":")
    ticks = sorted({float(row["samples"]) for members in adapted.values() for row in members})
    axes.set_xscale("log")
    axes.set_xticks(ticks, [f"{tick:,.0f}" for tick in ticks])
    axes.set_xticks([], minor=True)
    axes.set_xlabel("counted target samples", color=INK)
    _dress(axes, "mean cart speed, m/s")
    axes.set_ylim(0, axes.get_ylim()[1] * 1.15)
    axes.legend(frameon=False, fontsize=9, loc="best")
    _save(figure, path)


@dataclass(frozen=True)
class Chart:
    """One measure over counted target samples."""

    title: str
    label: str
    """of the measure, with its unit"""
    rows: Sequence[Mapping[str, Any]]
    """of a table under results/ (numbers may be strings): a line for each `method`, a band of `std` about its `mean`;
    rows with 0 samples are drawn as levels: `domain` target is before adaptation, source is for comparison"""


def plot_charts(path: str | os.PathLike[str], charts: Sequence[Chart], columns: int = 1) -> None:
    """Write a PNG of charts, `columns` in a row, on logarithmic axes; a method has the same colour in all of them."""
    methods = dict.fromkeys(row["method"] for chart in charts for row in chart.rows if float(row["samples"]) > 0)
    if not methods:
        raise ValueError("no rows of counted samples to plot")
    method_colours = {method: (TEAL, BLUE, INK)[k % 3] for k, method in enumerate(methods)}
    lines = -(-len(charts) // columns)
    figure = Figure(figsize=(4.8 * max(columns, 1.5), 0.6 + 3.0 * lines), dpi=150, layout="constrained")
    grid = figure.subplots(lines, columns, squeeze=False)
    places = list(grid.flat)
    for axes, chart in zip(places, charts, strict=False):
        _draw_chart(axes, chart, method_colours)
    for spare in places[len(charts) :]:
        figure.delaxes(spare)
    keys = {name: line for axes in grid.flat for line, name in zip(*axes.get_legend_handles_labels(), strict=True)}
    figure.legend(keys.values(), keys, loc="outside lower center", ncols=len(keys), frameon=False, fontsize=9)
    _save(figure, path)


def _draw_chart(axes: Axes, chart: Chart, method_colours: Mapping[str, str]) -> None:
    before = [row for row in chart.rows if float(row["samples"]) == 0]
    for domain, label, colour in REFERENCE_LEVELS:
        for row in [row for row in before if row["domain"] == domain]:
            _level(axes, _number(row["mean"]), label, colour)
    bands = []
    counted = sorted((row for row in chart.rows if float(row["samples"]) > 0), key=lambda row: float(row["samples"]))
    for method, colour in method_colours.items():
        rows = [row for row in counted if row["method"] == method]
        samples, mean, std = (np.array([_number(row[key]) for row in rows]) for key in ("samples", "mean", "std"))
        mean[~np.isfinite(mean)] = np.nan
        axes.plot(samples, mean, color=colour, linewidth=2, marker="o", markersize=5, label=method)
        bands.append((samples, mean - std, mean + std))
    _scale(axes)
    bottom = axes.get_ylim()[0]
    for (samples, low, high), colour in zip(bands, method_colours.values(), strict=True):
        low = np.where(low > 0, low, bottom)  # a logarithmic axis has no zero
        axes.fill_between(samples, low, high, color=colour, alpha=0.16, linewidth=0)
    ticks = sorted({float(row["samples"]) for row in counted})
    if ticks[-1] > 10 * ticks[0]:
        axes.set_xscale("log")
    axes.set_xticks(ticks, [f"{tick:,.0f}" for tick in ticks])
    axes.set_xticks([], minor=True)
    axes.set_xlabel("counted target samples", color=INK)
    _dress(axes, chart.label)
    axes.set_title(chart.title, color=INK, fontsize=10)


def _draw_method(axes: Axes, method: str, rows: Sequence[Mapping[str, Any]], colour: str, offset: float) -> None:
    samples = np.array([float(row["samples"]) for row in rows])
    mean, std = (np.array([_number(row[name]) for row in rows]) for name in ("mean", "std"))
    axes.fill_between(samples, mean - std, mean + std, color=colour, alpha=0.18, linewidth=0)
    axes.plot(samples, mean, color=colour, linewidth=2, marker="o", markersize=5, label=method or "adapted")
    edge = np.nan_to_num(mean + np.sign(offset) * np.nan_to_num(std))
    for row, x, y in zip(rows, samples, edge, strict=True):
        up = 1 - float(row["failed"]) / float(row["episodes"])
        axes.annotate(
            f"{up:.0%} up", (x, y), (0, offset), textcoords="offset points", ha="center", fontsize=8, color=colour
        )


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


def _dress(axes: Axes, title: str) -> None:
    axes.set_ylabel(title, color=INK)
    axes.grid(True, axis="y", color=HAIRLINE, linewidth=0.6)
    axes.set_axisbelow(True)
    axes.spines[["top", "right"]].set_visible(False)
    axes.spines[["left", "bottom"]].set_color(MUTED)
    axes.tick_params(colors=MUTED, labelcolor=INK, labelsize=9)


def _save(figure: Figure, path: str | os.PathLike[str]) -> None:
    FigureCanvasAgg(figure)
    with replacing(path) as temporary:
        figure.savefig(temporary, format="png", facecolor="white")


def _number(value: Any) -> float:
    """A number of a table's cell; nan where it is empty."""
    return float("nan") if value in (None, "") else float(value)


def _iterations(each: Round) -> float:
    """Iterations of a round's grounding, the first of which is number 0 or 1."""
    return float(max((row[0] for row in each.grounding), default=-1) + 1)
