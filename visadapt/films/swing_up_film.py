"""Films of cart-poles that swing up: each seen whole on its track, with its angle and its cart's speed.

    SwingUpFilm([SwingUpPanel("hanging", run), ...], due=5.0).write("film.mp4")

All panels share one clock and one set of scales. A cone within 10 degrees of upright travels with the cart: grey while
the pole is outside it, teal while inside. The pole's last poses stay behind it and fade.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from visadapt.films.canvas import Canvas, Floats
from visadapt.films.colours import BLUE, HAIRLINE, INK, MUTED, TEAL, TROUGH, Colour
from visadapt.films.film import Film, last_row
from visadapt.films.widgets import MINUS, Plot, banner, ceiling, headline
from visadapt.targets.rollout import Run

UPRIGHT_RAD = math.radians(10)
"""Up to this angle to either side of upright the pole counts as up."""
POLE_LENGTH_M = 1.0
CART_CORNERS_M = np.array([(-0.2, -0.24), (0.2, -0.24), (0.2, 0.0), (-0.2, 0.0)])
"""To the right and up from the hinge."""
PANEL_WIDTH, TITLE_HEIGHT, SCENE_HEIGHT, CHART_HEIGHT, PART_GAP = 620, 40, 250, 128, 14
"""px"""


@dataclass(frozen=True)
class SwingUpPanel:
    """A run of a cart-pole that starts at any angle; raises ValueError where it has no states."""

    title: str
    run: Run

    def __post_init__(self) -> None:
        if self.run.episode.state is None:
            raise ValueError(f"panel {self.title!r}: the run has no states to show")

    @cached_property
    def state(self) -> Floats:
        """(T, 4), SI units; the angle between -pi and pi"""
        assert self.run.episode.state is not None
        x, x_dot, theta, theta_dot = self.run.episode.state.T
        return np.stack([x, x_dot, np.arctan2(np.sin(theta), np.cos(theta)), theta_dot], -1)

    @property
    def up_from(self) -> int:
        """The row from which the pole stays up to the end; T where it is not up at the end."""
        outside = np.flatnonzero(np.abs(self.state[:, 2]) >= UPRIGHT_RAD)
        return int(outside[-1]) + 1 if len(outside) else 0


@dataclass(frozen=True)
class SwingUpFilm(Film):
    """Swing-ups two in a row, a frame for every row of the runs.

    Raises:
        ValueError: no panels, or runs of different lengths.
    """

    panels: Sequence[SwingUpPanel]
    due: float
    """s, from when on the poles are to be up"""

    panel_width = PANEL_WIDTH
    panel_height = TITLE_HEIGHT + SCENE_HEIGHT + PART_GAP + CHART_HEIGHT
    panels_in_row = 2

    def __post_init__(self) -> None:
        if not self.panels:
            raise ValueError("a film needs at least one panel")
        lengths = sorted({len(panel.run.episode.time) for panel in self.panels})
        if len(lengths) > 1:
            raise ValueError(f"runs of {lengths[0]} and {lengths[-1]} rows: a film of swing-ups needs equal lengths")

    @property
    def times(self) -> list[float]:
        return [float(t) for t in self._time]

    @property
    def period(self) -> float:  # type: ignore[override]
        """s between frames"""
        return float(self._time[1] - self._time[0])

    @property
    def _time(self) -> Floats:
        return self.panels[0].run.episode.time

    @cached_property
    def zoom(self) -> float:
        """px/m, such that neither carts nor poles leave the scene"""
        x, _, theta, _ = np.concatenate([panel.state for panel in self.panels]).T
        reach = np.abs([x, x + POLE_LENGTH_M * np.sin(theta)]).max()
        return float(min(PANEL_WIDTH / 2 / (reach + 0.4), (SCENE_HEIGHT / 2 - 20) / POLE_LENGTH_M))

    @cached_property
    def full_speed(self) -> float:
        """m/s, at the top of all charts"""
        return max(ceiling(max(float(np.abs(panel.state[:, 1]).max()) for panel in self.panels)), 0.1)

    def pixels(self, points: Floats) -> Floats:
        """Where points (n, 2) in m, to the right and up from the hinge at x = 0, are in the scene, px."""
        return np.array([PANEL_WIDTH / 2, SCENE_HEIGHT / 2 - 6]) + self.zoom * points * (1, -1)

    def draw_panel(self, canvas: Canvas, panel: SwingUpPanel, t: float) -> None:
        row = last_row(self._time, t)
        headline(canvas, TITLE_HEIGHT - 14, PANEL_WIDTH, panel.title, f"t = {self._time[row]:5.2f} s")
        scene = canvas.part(0, TITLE_HEIGHT, PANEL_WIDTH, SCENE_HEIGHT)
        self._draw_scene(scene, panel, row)
        scene.frame(0, 0, PANEL_WIDTH, SCENE_HEIGHT)
        top, half = TITLE_HEIGHT + SCENE_HEIGHT + PART_GAP, (PANEL_WIDTH - 2 * PART_GAP) // 2
        self._draw_angle(canvas.part(0, top, half, CHART_HEIGHT), panel, row)
        self._draw_speed(canvas.part(PANEL_WIDTH - half, top, half, CHART_HEIGHT), panel, row)

    def _draw_scene(self, canvas: Canvas, panel: SwingUpPanel, row: int) -> None:
        """The track with its metres, the cone, the pole's last 16 poses two rows apart, then cart and pole."""
        x, _, theta, _ = panel.state[row]
        up = abs(theta) < UPRIGHT_RAD
        metres = math.floor(PANEL_WIDTH / 2 / self.zoom)
        for mark in range(-metres, metres + 1):
            column = self.pixels(np.array([[mark, 0.0]]))[0, 0]
            canvas.box(column - (mark == 0) / 2, 0, column + 1, SCENE_HEIGHT, HAIRLINE if mark else MUTED)
            label = f"{MINUS if mark < 0 else ''}{abs(mark)}" + (" m" if mark == 0 else "")
            canvas.text(column + 5, SCENE_HEIGHT - 8, label, 11, MUTED)
        floor = CART_CORNERS_M[0, 1]
        top, bottom = self.pixels(np.array([[0.0, floor], [0.0, floor - 0.03]]))[:, 1]
        canvas.box(0, top, PANEL_WIDTH, bottom, MUTED)
        edge = np.linspace(-UPRIGHT_RAD, UPRIGHT_RAD, 9)
        cone = np.array([(x, 0.0), *((x + 1.08 * np.sin(a), 1.08 * np.cos(a)) for a in edge)])
        canvas.glass(self.pixels(cone), TEAL if up else MUTED, 0.3)
        for k in range(16, 0, -1):
            if row >= 2 * k:
                earlier_x, _, earlier, _ = panel.state[row - 2 * k]
                canvas.glass(self.pixels(_pole(earlier_x, earlier)), BLUE, 0.3 * (1 - k / 17))
        canvas.polygon(self.pixels(CART_CORNERS_M + np.array([x, 0])), INK)
        canvas.polygon(self.pixels(_pole(x, theta)), TEAL if up else BLUE)
        angle = np.linspace(0, 2 * np.pi, 20, endpoint=False)
        canvas.polygon(self.pixels(0.05 * np.stack([np.cos(angle), np.sin(angle)], -1) + (x, 0)), TROUGH)
        since = panel.up_from
        if self._time[row] >= self.due and since > last_row(self._time, self.due):
            banner(canvas, PANEL_WIDTH / 2, 30, f"not up at {self.due:g} s")
        elif row >= since:
            canvas.text(12, 24, f"up since {self._time[since]:.2f} s", 15, TEAL, bold=True)

    def _draw_angle(self, canvas: Canvas, panel: SwingUpPanel, row: int) -> None:
        """The angle up to a row; the line is interrupted where the pole passes straight down."""
        theta = panel.state[: row + 1, 2]
        levels = {0.0: f"{MINUS}180", 0.5: "0", 1.0: "180"}
        plot = self._plot(canvas, "angle from upright, degrees", levels, TEAL)
        for sign in (-1, 1):
            y = plot.place(np.zeros(1), np.array([0.5 + sign * UPRIGHT_RAD / 2 / math.pi]))[0, 1]
            canvas.dashes((plot.left, y), (plot.right, y), MUTED)
        line = plot.place(self._time[: row + 1], 0.5 + theta / 2 / math.pi)
        for piece in np.split(line, np.flatnonzero(np.abs(np.diff(theta)) > math.pi) + 1):
            plot.line(canvas, piece, TEAL, 2)
        plot.cursor(canvas, line[-1], TEAL)

    def _draw_speed(self, canvas: Canvas, panel: SwingUpPanel, row: int) -> None:
        """The cart's speed and its mean, up to a row."""
        levels = {share: f"{self.full_speed * share:g}" for share in (0.0, 0.5, 1.0)}
        plot = self._plot(canvas, "cart speed, m/s", levels, BLUE)
        speed = np.abs(panel.state[: row + 1, 1])
        mean = plot.value_and_mean(canvas, self._time[: row + 1], speed, self.full_speed, BLUE)
        canvas.text(plot.right, 12, f"mean {mean:.2f} m/s", 12, INK, bold=True, align="right")

    def _plot(self, canvas: Canvas, name: str, levels: Mapping[float, str], colour: Colour) -> Plot:
        """Axes, and a dashed line at the time from which the poles are to be up."""
        plot = Plot(canvas.width, canvas.height, float(self._time[-1]))
        canvas.text(0, 12, name, 12, colour, bold=True)
        plot.axes(canvas, levels)
        column = plot.place(np.array([self.due]), np.zeros(1))[0, 0]
        canvas.dashes((column, plot.top), (column, plot.bottom), MUTED)
        canvas.text(column + 5, plot.top + 11, "up from here on", 11, MUTED)
        return plot


def _pole(x: float, theta: float) -> Floats:
    """Corners (4, 2) in m."""
    along = np.array([math.sin(theta), math.cos(theta)])
    across = 0.03 * np.array([along[1], -along[0]])
    hinge = np.array([x, 0.0])
    tip = hinge + POLE_LENGTH_M * along
    return np.stack([hinge - across, hinge + across, tip + across, tip - across])
