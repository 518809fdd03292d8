"""The parts of films and plots that matplotlib draws: their colours and style, and what all panels are made of.

Each part of a panel draws itself once and returns what moves it; artists that move are `animated`.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.patches import Rectangle
from matplotlib.text import Text
from numpy.typing import NDArray

INK, MUTED, HAIRLINE, TROUGH, PAPER = "#1f2933", "#6e7a88", "#d8dde3", "#eceff3", "#ffffff"
BLUE, ORANGE, TEAL, RED, AMBER = "#2f67c9", "#de7416", "#0e7a70", "#be2a2a", "#e8a830"
VIOLET = "#7a3ea8"
"""The hidden force on a vehicle."""
SKY, GROUND, AIRFRAME = "#fafcfe", "#eef1f0", "#e2e7ee"

STYLE: Any = {
    "font.family": "DejaVu Sans",  # comes with matplotlib; its digits are equally wide: numbers do not jitter
    "text.color": INK,
    "axes.labelcolor": INK,
    "axes.edgecolor": MUTED,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "axes.grid.axis": "y",
    "axes.axisbelow": True,
    "axes.titlesize": 10,
    "axes.unicode_minus": True,
    "grid.color": HAIRLINE,
    "grid.linewidth": 0.6,
    "patch.linewidth": 0,
    "xtick.color": MUTED,
    "ytick.color": MUTED,
    "xtick.labelcolor": INK,
    "ytick.labelcolor": INK,
    "xtick.labelsize": 9,
    "ytick.labelsize": 9,
    "legend.frameon": False,
    "legend.fontsize": 9,
}
"""For `matplotlib.rc_context`"""

Floats = NDArray[np.floating]
MINUS = "\N{MINUS SIGN}"
CHART_HEIGHT = 128
"""px, with title and ticks"""


def inset(page: Axes, left: float, top: float, width: float, height: float, **properties: Any) -> Axes:
    """Axes on a part of a page, in px."""
    whole = page.bbox
    box = np.array([left, whole.height - top - height, width, height]) / np.tile(whole.size, 2)
    return page.inset_axes(tuple(box), **properties)


def framed(page: Axes, left: float, top: float, width: float, height: float, **properties: Any) -> Axes:
    """Axes in a thin frame on a part of a page, in px, without ticks."""
    axes = inset(page, left, top, width, height, xticks=[], yticks=[], **properties)
    axes.spines[:].set(visible=True, color=HAIRLINE)
    return axes


def headline(page: Axes, title: str) -> Callable[[float], None]:
    """A title, as large as fits between 11 px and 20 px, and a clock; what is returned sets the clock, in s."""
    width = page.get_xlim()[1]
    for size in range(20, 10, -1):
        text = page.text(0, 26, title, fontsize=size, fontweight="bold", clip_on=True, parse_math=False)
        if text.get_window_extent().width < width - 110 or size == 11:
            break
        text.remove()
    clock = page.text(width, 26, "", fontsize=15, color=MUTED, ha="right", animated=True)
    return lambda t: clock.set_text(f"t = {t:5.2f} s")


def note(axes: Axes, size: float, colour: str = INK) -> Text:
    """A line of text, `size` px tall, in the upper left corner; it moves."""
    text = axes.annotate("", (0, 1), (12, -12), "axes fraction", "offset points", va="top", fontsize=size, color=colour)
    text.set(fontweight="bold", zorder=9, animated=True)
    return text


def banner(scene: Axes) -> Callable[[str, bool], None]:
    """White text on red; what is returned sets the text, which may be empty, and whether the scene is dimmed."""
    box = {"facecolor": RED, "linewidth": 0, "boxstyle": "square,pad=0.6"}
    text = scene.annotate("", (0.5, 1), (0, -32), "axes fraction", "offset points", ha="center", va="center", bbox=box)
    text.set(fontsize=18, fontweight="bold", color=PAPER, zorder=9, animated=True)
    veil = Rectangle((0, 0), 1, 1, transform=scene.transAxes, facecolor=PAPER, alpha=0.6, zorder=8, animated=True)
    scene.add_patch(veil)

    def show(failure: str, dimmed: bool) -> None:
        text.set(text=failure, visible=bool(failure))
        veil.set_visible(dimmed)

    return show


def reading(page: Axes, left: float, top: float, name: str, **properties: Any) -> Text:
    """The text of a value under its name, 35 px tall."""
    page.text(left, top + 12, name, fontsize=12, color=MUTED)
    return page.text(left, top + 35, "", fontsize=18, animated=True, **properties)


def bar(
    page: Axes, left: float, middle: float, width: float, name: str, end: float, unit: str, colour: str
) -> Callable[[float | None], None]:
    """A bar from 0 in the middle, on a scale from -end to +end; what is returned sets its value, None for a dash."""
    start, room = left + 74, width - 140
    page.text(left, middle + 5, name, fontsize=13, color=MUTED)
    page.add_patch(Rectangle((start, middle - 6), room, 12, facecolor=TROUGH))
    page.plot([start + room / 2] * 2, [middle - 9, middle + 9], color=MUTED, linewidth=1)
    page.text(start, middle + 19, f"{MINUS}{end:g}", fontsize=10, color=MUTED)
    page.text(start + room, middle + 19, f"{end:g}{unit}", fontsize=10, color=MUTED, ha="right")
    filled = Rectangle((start + room / 2, middle - 6), 0, 12, facecolor=colour, animated=True)
    page.add_patch(filled)
    number = page.text(left + width, middle + 5, "", fontsize=14, color=colour, ha="right", animated=True)

    def show(value: float | None) -> None:
        filled.set_width(0.0 if value is None else room / 2 * min(max(value / end, -1.0), 1.0))
        number.set_text("\N{EN DASH}" if value is None else signed(value, 2 if end <= 1 else 1) + unit)

    return show


def chart(page: Axes, top: float, title: str, duration: float) -> Axes:
    """Axes for a plot against time in s, as wide as the page."""
    axes = inset(page, 40, top + 24, page.bbox.width - 45, CHART_HEIGHT - 44, xlim=(-0.01 * duration, 1.01 * duration))
    axes.set_title(title, loc="left", fontsize=12, color=TEAL, fontweight="bold")
    axes.xaxis.set_major_formatter(lambda t, _: f"{t:g}" if t else "0 s")
    axes.spines[:].set_visible(False)
    axes.tick_params(color=HAIRLINE, labelcolor=MUTED, labelsize=11)
    axes.tick_params("y", length=0)
    return axes


def trace(
    axes: Axes, time: Floats, values: Floats, score: Floats, words: Callable[[float], str]
) -> Callable[[int, bool], None]:
    """Curves of values (T,) and of a running score of them (T,); the function returned draws both up to a row.

    `words` turns the score at that row into the chart's right title. A dot marks the row; once the run has failed, a
    red line over the chart's height does.
    """
    (line,) = axes.plot([], [], color=TEAL, linewidth=3, animated=True)
    (thin,) = axes.plot([], [], color=INK, linewidth=1.2, animated=True)
    (dot,) = axes.plot([], [], "o", color=TEAL, markersize=8, animated=True)
    mark = axes.axvline(0, color=RED, linewidth=2, animated=True)
    right_title = axes.set_title("", loc="right", fontsize=12, fontweight="bold", animated=True)

    def draw(row: int, failed: bool) -> None:
        line.set_data(time[: row + 1], values[: row + 1])
        thin.set_data(time[: row + 1], score[: row + 1])
        right_title.set_text(words(float(score[row])))
        dot.set(data=([time[row]], [values[row]]), visible=not failed)
        mark.set(xdata=[time[row]] * 2, visible=failed)

    return draw


def last_row(times: Floats, t: float) -> int:
    """Index of the last of rising times (T,) in s at or before t s; 0 where there is none."""
    return max(int(np.searchsorted(times, t + 1e-6, side="right")) - 1, 0)


def running_mean(values: Floats) -> Floats:
    """(T,) means of the values (T,) so far."""
    return np.asarray(values.cumsum() / np.arange(1, len(values) + 1))


def signed(value: float, digits: int) -> str:
    """A number with its sign, + also where it rounds to zero."""
    return f"{round(float(value), digits) + 0.0:+.{digits}f}".replace("-", MINUS)


def ceiling(value: float) -> float:
    """The smallest of ... 0.1, 0.2, 0.4, 0.5, 1, 2, 4, 5, 10 ... that is at least a value."""
    if value <= 0:
        return 0.0
    power = 10.0 ** math.floor(math.log10(value))
    return next(power * step for step in (1, 2, 4, 5, 10) if power * step >= value * (1 - 1e-6))
