"""Parts of the panels of all films: headline, readings, bars, a plot against time, a banner that marks failure."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from visadapt.films.canvas import Canvas, Floats, text_width
from visadapt.films.colours import HAIRLINE, INK, MUTED, PAPER, RED, TROUGH, Colour

MINUS = "\N{MINUS SIGN}"


def headline(canvas: Canvas, baseline: float, width: float, title: str, clock: str) -> None:
    """A title on the left, in the largest size from 20 px down to 11 px that fits, and the time on the right."""
    room = width - text_width(clock, 15) - 20
    size = next((size for size in range(20, 11, -1) if text_width(title, size, True) <= room), 11)
    canvas.text(0, baseline, title, size, bold=True)
    canvas.text(width, baseline, clock, 15, MUTED, align="right")


def banner(canvas: Canvas, x: float, y: float, text: str) -> None:
    """White text on red, centred at (x, y) px."""
    half = text_width(text, 18, True) / 2 + 18
    canvas.box(x - half, y - 18, x + half, y + 18, RED)
    canvas.text(x, y + 6, text, 18, PAPER, bold=True, align="centre")


def reading(canvas: Canvas, x: float, name: str, value: str, unit: str, colour: Colour = INK) -> None:
    """A value under its name, 35 px tall; the unit stands beside it."""
    canvas.text(x, 12, name, 12, MUTED)
    canvas.text(x, 35, value, 18, colour)
    gap = 0 if unit == "\N{DEGREE SIGN}" else 5
    canvas.text(x + text_width(value, 18) + gap, 35, unit, 13 if gap else 18, MUTED)


def bar(
    canvas: Canvas, y: float, room: float, name: str, value: float | None, end: float, unit: str, colour: Colour
) -> None:
    """A bar from 0 in the middle to `value`, on a scale from -end to +end; a value of None is shown as a dash."""
    left, right = 74.0, room - 66.0
    middle, half = (left + right) / 2, (right - left) / 2
    canvas.text(0, y + 5, name, 13, MUTED)
    canvas.box(left, y - 6, right, y + 6, TROUGH)
    if value is not None:
        edge = middle + half * min(max(value / end, -1.0), 1.0)
        canvas.box(min(middle, edge), y - 6, max(middle, edge), y + 6, colour)
    canvas.box(middle - 0.5, y - 9, middle + 0.5, y + 9, MUTED)
    canvas.text(left, y + 19, f"{MINUS}{end:g}", 10, MUTED)
    canvas.text(right, y + 19, f"{end:g}{unit}", 10, MUTED, align="right")
    shown = "\N{EN DASH}" if value is None else signed(value, 2 if end <= 1 else 1) + unit
    nonzero = any(digit in shown for digit in "123456789")
    canvas.text(room, y + 5, shown, 14, colour if nonzero else MUTED, bold=nonzero, align="right")


@dataclass(frozen=True)
class Plot:
    """A plot against time: its axes lie in an area of width x height px, below a line of text."""

    width: float
    height: float
    duration: float
    """s, from the left edge to the right"""
    left: float = 34.0
    """px, room for the labels of the levels"""
    top: float = 26.0
    """px, room for the line of text"""

    @property
    def right(self) -> float:
        """px"""
        return self.width - 5.0

    @property
    def bottom(self) -> float:
        """px"""
        return self.height - 22.0

    def place(self, time: Floats, share: Floats) -> Floats:
        """Points (n, 2) in px of times (n,) in s and shares (n,) of the plot's height, measured from the bottom."""
        x = self.left + (self.right - self.left) * time / self.duration
        return np.stack([x, self.bottom - (self.bottom - self.top) * share], -1)

    def axes(self, canvas: Canvas, levels: Mapping[float, str]) -> None:
        """Level lines at shares of the height, each with its label, and about seven ticks in s."""
        for share, label in levels.items():
            y = round(self.bottom - (self.bottom - self.top) * share)
            canvas.box(self.left, y, self.right, y + 1, HAIRLINE)
            canvas.text(self.left - 7, y + 4, label, 11, MUTED, align="right")
        for tick in np.arange(0, self.duration * 1.0001, ceiling(self.duration / 7)):
            x = round(self.left + (self.right - self.left) * tick / self.duration)
            canvas.box(x, self.bottom, x + 1, self.bottom + 5, HAIRLINE)
            label = f"{tick:g}" if tick else "0 s"
            canvas.text(x, self.bottom + 18, label, 11, MUTED, align="right" if x > self.right - 12 else "centre")

    def line(self, canvas: Canvas, points: Floats, colour: Colour, thickness: int) -> None:
        """A line through points of `place`, clipped at the plot's top."""
        top, inside = self._inside(canvas)
        inside.line(points - (0, top), colour, thickness)

    def value_and_mean(
        self, canvas: Canvas, time: Floats, values: Floats, full: float, colour: Colour, failed: bool = False
    ) -> float:
        """Values (n,) so far as a thick line with a cursor, their mean so far as a thin one; returns the latest mean.

        `full` is the value at the plot's top.
        """
        mean = np.cumsum(values) / np.arange(1, len(values) + 1)
        line = self.place(time, values / full)
        self.line(canvas, line, colour, 2)
        self.line(canvas, self.place(time, mean / full), INK, 1)
        self.cursor(canvas, line[-1], colour, failed)
        return float(mean[-1])

    def cursor(self, canvas: Canvas, point: Floats, colour: Colour, failed: bool = False) -> None:
        """A dot at a point of `place`, or, where the run has failed there, a red mark over the plot's height."""
        if failed:
            canvas.box(point[0] - 1, self.top, point[0] + 1, self.bottom, RED)
            return
        top, inside = self._inside(canvas)
        inside.disc(point - (0, top), 4, colour, corners=16)

    def _inside(self, canvas: Canvas) -> tuple[int, Canvas]:
        """The first row in px below the line of text, and the area from there on."""
        top = round(self.top) - 4
        return top, canvas.part(0, top, round(self.width), round(self.height) - top)


def signed(value: float, digits: int) -> str:
    """A number with its sign, + also where it rounds to zero."""
    rounded = round(float(value), digits) + 0.0
    return f"{MINUS if rounded < 0 else '+'}{abs(rounded):.{digits}f}"


def ceiling(value: float) -> float:
    """The smallest of ... 0.1, 0.2, 0.4, 0.5, 1, 2, 4, 5, 10 ... that is at least a value."""
    if value <= 0:
        return 0.0
    power = 10.0 ** math.floor(math.log10(value))
    return next(power * step for step in (1, 2, 4, 5, 10) if power * step >= value * (1 - 1e-6))
