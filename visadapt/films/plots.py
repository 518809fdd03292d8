"""Pictures of numbers: the losses of the joint loop, and what was measured over the samples that were counted."""

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

from visadapt.learning.joint import Round
from visadapt.storage.atomic_files import replacing

BLUE, ORANGE, TEAL, INK, MUTED, HAIRLINE = "#2f67c9", "#de7416", "#0e7a70", "#1f2933", "#6e7a88", "#d8dde3"
PAPER_VALUE = (1000, 0.29)
"""Samples and m/s: the paper's image policy in the target after adaptation, its checkpoint chosen on the target."""


def plot_losses(path: str | os.PathLike[str], rounds: Sequence[Round]) -> None:
    """Both losses over the iterations of the joint loop, in the order in which they were run.

    A round grounds the simulator first, then tunes the policy, so the two curves take turns. A linear residual is
    solved for: its loss falls in one step, drawn straight down to a dot.
    """
    if not rounds:
        raise ValueError("no rounds to plot")
    figure = Figure(figsize=(9.0, 5.4), dpi=150, layout="constrained")
    upper, lower = figure.subplots(2, 1, sharex=True)
    start = 0.0
    whole = sum(_span([row[0] for row in each.grounding]) + _span(range(len(each.policy))) for each in rounds)
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
            points = np.array([_floats(row[0], row[column]) for row in each.grounding]).reshape(-1, 2)
            label = name if first else None
            solved = len(points) == 2
            if solved:  # beside each other, or one would hide the other
                points[:, 0] = 0.008 * column * whole
            dot = "o" if solved else None
            x = start + points[:, 0]
            upper.plot(x, points[:, 1], color=colour, linewidth=1.4, label=label, marker=dot, ms=4, markevery=[-1])
        start += _span([row[0] for row in each.grounding])
        points = np.array([_floats(*row) for row in enumerate(each.policy)]).reshape(-1, 2)
        lower.plot(start + points[:, 0], points[:, 1], color=TEAL, linewidth=1.4)
        start += _span(range(len(each.policy)))
    for axes, title in ((upper, "grounding loss"), (lower, "policy loss")):
        _scale(axes)
        _dress(axes, title)
    upper.legend(frameon=False, fontsize=9, loc="upper right")
    lower.set_xlabel("iterations so far (grounding, then policy, round by round)", color=INK)
    lower.set_xlim(0, max(start, 1.0))
    _save(figure, path)


def plot_curve(
    path: str | os.PathLike[str], rows: Sequence[Mapping[str, Any]], paper: tuple[int, float] | None = PAPER_VALUE
) -> None:
    """Mean cart speed after adaptation over counted target samples, with the spread over seeds and the survivors.

    Args:
        path: of the PNG.
        rows: of one table under results/ (numbers may be strings): `domain` (adapted; target is before adaptation,
            source is drawn for comparison), `samples`, `mean` and `std` in m/s (empty or nan where none survived),
            `episodes`, `failed`, and `method`, one line each.
        paper: the paper's samples and m/s, drawn as a level line; None draws none.
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
    for domain, said, colour in (("target", "before adaptation", ORANGE), ("source", "in the source", MUTED)):
        for row in [row for row in rows if row["domain"] == domain][:1]:
            up = 1 - float(row["failed"]) / float(row["episodes"])
            mean = _number(row["mean"])
            if np.isfinite(mean):
                _level(axes, mean, f"{said}: {mean:.2f} m/s, {up:.0%} up", colour)
            else:
                axes.plot([], [], color=colour, linestyle="--", label=f"{said}: none stays up")
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
class Panel:
    """One measure over counted samples."""

    title: str
    label: str
    """of the measure, with its unit"""
    rows: Sequence[Mapping[str, Any]]
    """of a table under results/ (numbers may be strings): a line for each `method`, a band of `std` about its `mean`;
    rows of no samples are levels, those of the `domain` target before adaptation, those of source for comparison"""


def plot_panels(path: str | os.PathLike[str], panels: Sequence[Panel], columns: int = 1) -> None:
    """Panels side by side, `columns` in a line, each logarithmic; a method has its colour in all of them."""
    methods = dict.fromkeys(row["method"] for panel in panels for row in panel.rows if float(row["samples"]) > 0)
    if not methods:
        raise ValueError("no rows of counted samples to plot")
    colours = {method: (TEAL, BLUE, INK)[k % 3] for k, method in enumerate(methods)}
    lines = -(-len(panels) // columns)
    figure = Figure(figsize=(4.8 * max(columns, 1.5), 0.6 + 3.0 * lines), dpi=150, layout="constrained")
    grid = figure.subplots(lines, columns, squeeze=False)
    places = list(grid.flat)
    for axes, panel in zip(places, panels, strict=False):
        _draw_panel(axes, panel, colours)
    for spare in places[len(panels) :]:
        figure.delaxes(spare)
    told = {name: line for axes in grid.flat for line, name in zip(*axes.get_legend_handles_labels(), strict=True)}
    figure.legend(told.values(), told, loc="outside lower center", ncols=len(told), frameon=False, fontsize=9)
    _save(figure, path)


def _draw_panel(axes: Axes, panel: Panel, colours: Mapping[str, str]) -> None:
    before = [row for row in panel.rows if float(row["samples"]) == 0]
    for domain, said, colour in (("target", "before adaptation", ORANGE), ("source", "in the source", MUTED)):
        for row in [row for row in before if row["domain"] == domain]:
            _level(axes, _number(row["mean"]), said, colour)
    bands = []
    counted = sorted((row for row in panel.rows if float(row["samples"]) > 0), key=lambda row: float(row["samples"]))
    for method, colour in colours.items():
        rows = [row for row in counted if row["method"] == method]
        samples, mean, std = (np.array([_number(row[key]) for row in rows]) for key in ("samples", "mean", "std"))
        mean[~np.isfinite(mean)] = np.nan
        axes.plot(samples, mean, color=colour, linewidth=2, marker="o", markersize=5, label=method)
        bands.append((samples, mean - std, mean + std))
    _scale(axes)
    bottom = axes.get_ylim()[0]
    for (samples, low, high), colour in zip(bands, colours.values(), strict=True):
        low = np.where(low > 0, low, bottom)  # there is no zero on a logarithmic axis
        axes.fill_between(samples, low, high, color=colour, alpha=0.16, linewidth=0)
    ticks = sorted({float(row["samples"]) for row in counted})
    if ticks[-1] > 10 * ticks[0]:
        axes.set_xscale("log")
    axes.set_xticks(ticks, [f"{tick:,.0f}" for tick in ticks])
    axes.set_xticks([], minor=True)
    axes.set_xlabel("counted target samples", color=INK)
    _dress(axes, panel.label)
    axes.set_title(panel.title, color=INK, fontsize=10)


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
    """A logarithmic axis with plain numbers, where there is anything to show on one."""
    curves = [line for line in axes.get_lines() if line.get_zorder() > 0]  # and not the marks of the rounds
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


def _floats(*values: float | None) -> tuple[float, ...]:
    return tuple(float("nan") if value is None else float(value) for value in values)


def _span(iterations: Sequence[int]) -> float:
    """Iterations that a phase took, its first one being number 0 or 1."""
    return float(max(iterations) + 1) if iterations else 0.0
