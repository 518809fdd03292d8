"""What panels of films are made of: a headline, readings, bars, a plot that grows, a banner over what went wrong."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from visadapt.films.canvas import HAIRLINE, INK, MUTED, PAPER, RED, TROUGH, Canvas, Colour, text_width

MINUS = "\N{MINUS SIGN}"


def headline(canvas: Canvas, baseline: float, width: float, title: str, clock: str) -> None:
    """A title on the left, as large as there is room for, and the time on the right."""
    room = width - text_width(clock, 15) - 20
    size = next((size for size in range(20, 11, -1) if text_width(title, size, True) <= room), 11)
    canvas.text(0, baseline, title, size, bold=True)
    canvas.text(width, baseline, clock, 15, MUTED, align="right")


def banner(canvas: Canvas, x: float, y: float, said: str) -> None:
    """White on red, around a middle (x, y) in px."""
    half = text_width(said, 18, True) / 2 + 18
    canvas.box(x - half, y - 18, x + half, y + 18, RED)
    canvas.text(x, y + 6, said, 18, PAPER, bold=True, align="centre")


def reading(canvas: Canvas, x: float, name: str, value: str, unit: str, colour: Colour = INK) -> None:
    """A value under its name, 35 px tall; the unit stands beside it."""
    canvas.text(x, 12, name, 12, MUTED)
    canvas.text(x, 35, value, 18, colour)
    gap = 0 if unit == "\N{DEGREE SIGN}" else 5
    canvas.text(x + text_width(value, 18) + gap, 35, unit, 13 if gap else 18, MUTED)


def bar(
    canvas: Canvas, y: float, room: float, name: str, value: float | None, end: float, unit: str, colour: Colour
) -> None:
    """A bar from 0 in the middle towards -end or +end, with its value; None is shown as a dash."""
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
    loud = any(digit in shown for digit in "123456789")
    canvas.text(room, y + 5, shown, 14, colour if loud else MUTED, bold=loud, align="right")


@dataclass(frozen=True)
class Plot:
    """A plot over time in the lower part of an area of width x height px, under a line of text."""

    width: float
    height: float
    duration: float
    """s, from the left edge to the right"""
    left: float = 34.0
    """px, room for what is written beside the levels"""
    top: float = 26.0
    """px, room for what is written above"""

    @property
    def right(self) -> float:
        """px"""
        return self.width - 5.0

    @property
    def bottom(self) -> float:
        """px"""
        return self.height - 22.0

    def place(self, time: NDArray[np.floating], share: NDArray[np.floating]) -> NDArray[np.floating]:
        """Points (n, 2) in px of times (n,) in s and heights (n,), of which 1 is the plot's top."""
        x = self.left + (self.right - self.left) * time / self.duration
        return np.stack([x, self.bottom - (self.bottom - self.top) * share], -1)

    def axes(self, canvas: Canvas, levels: Mapping[float, str], ticks: Sequence[float]) -> None:
        """Level lines at shares of the height, with what is written beside them, and ticks in s."""
        for share, said in levels.items():
            y = round(self.bottom - (self.bottom - self.top) * share)
            canvas.box(self.left, y, self.right, y + 1, HAIRLINE)
            canvas.text(self.left - 7, y + 4, said, 11, MUTED, align="right")
        for tick in ticks:
            x = round(self.left + (self.right - self.left) * tick / self.duration)
            canvas.box(x, self.bottom, x + 1, self.bottom + 5, HAIRLINE)
            first, last = tick == ticks[0], x > self.right - 12
            said = f"{tick:g} s" if first else f"{tick:g}"
            canvas.text(x, self.bottom + 18, said, 11, MUTED, align="right" if last else "centre")

    def line(self, canvas: Canvas, points: NDArray[np.floating], colour: Colour, thickness: int) -> None:
        """A line through points of `place`; what is above the plot leaves it at its top."""
        above, inside = self._inside(canvas)
        inside.line(points - (0, above), colour, thickness)

    def cursor(self, canvas: Canvas, point: NDArray[np.floating], colour: Colour, lost: bool = False) -> None:
        """A dot at a point of `place`, or a red mark across the plot where something ended."""
        if lost:
            canvas.box(point[0] - 1, self.top, point[0] + 1, self.bottom, RED)
            return
        above, inside = self._inside(canvas)
        around = np.linspace(0, 2 * np.pi, 16, endpoint=False)
        inside.polygon(point + 4 * np.stack([np.cos(around), np.sin(around)], -1) - (0, above), colour)

    def _inside(self, canvas: Canvas) -> tuple[int, Canvas]:
        """The area below the line of text, and the row in which it begins."""
        above = round(self.top) - 4
        return above, canvas.part(0, above, round(self.width), round(self.height) - above)


def signed(value: float, digits: int) -> str:
    """A number that always has a sign, and the same sign for what rounds to zero."""
    rounded = round(float(value), digits) + 0.0
    return f"{MINUS if rounded < 0 else '+'}{abs(rounded):.{digits}f}"


def ceiling(value: float) -> float:
    """The next of ... 0.1, 0.2, 0.5, 1, 2, 4, 5, 10 ... at or above a value."""
    if value <= 0:
        return 0.0
    power = 10.0 ** math.floor(math.log10(value))
    return next(power * step for step in (1, 2, 4, 5, 10) if power * step >= value * (1 - 1e-6))
