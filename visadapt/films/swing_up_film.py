"""A film of cart-poles that swing up, side by side: each seen whole on its track, with its angle and its cart's speed.

    write_swing_film("film.mp4", [SwingPanel("hanging", run), ...], due=5.0)

All panels share one clock and one set of scales. The cone of success travels with the cart: grey while the pole is
outside, teal while it is inside. Where the pole has been of late is left behind, paler and paler.
"""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from visadapt.films.canvas import BLUE, HAIRLINE, INK, MUTED, TEAL, TROUGH, Canvas, Colour, Picture
from visadapt.films.drawing3d import Floats
from visadapt.films.video import GUTTER, MARGIN, write_frames, write_picture
from visadapt.films.widgets import MINUS, Plot, banner, ceiling, headline
from visadapt.targets.rollout import Run

CONE = math.radians(10)
"""to either side of upright: within it the pole is up"""
LENGTH = 1.0
"""m, of the pole"""
CART = np.array([(-0.2, -0.24), (0.2, -0.24), (0.2, 0.0), (-0.2, 0.0)])
"""m, its corners from the hinge"""
TRAIL, BETWEEN = 16, 2
"""how many poses of late are left behind, and how many rows apart"""
WIDTH, TITLE, SCENE, CHART, GAP = 620, 40, 250, 128, 14
"""px, of a panel and its parts below each other, GAP apart"""
HEIGHT = TITLE + SCENE + GAP + CHART
ACROSS = 2
"""panels in a row"""


@dataclass(frozen=True)
class SwingPanel:
    """A run of a cart-pole from anywhere."""

    title: str
    run: Run

    @property
    def state(self) -> Floats:
        """(T, 4), SI units; the angle between -pi and pi"""
        state = self.run.episode.state
        assert state is not None
        x, x_dot, theta, theta_dot = state.T
        return np.stack([x, x_dot, np.arctan2(np.sin(theta), np.cos(theta)), theta_dot], -1)

    @property
    def up_from(self) -> int:
        """The row from which on the pole is up for good; the number of rows where it is not up at the end."""
        outside = np.flatnonzero(np.abs(self.state[:, 2]) >= CONE)
        return int(outside[-1]) + 1 if len(outside) else 0


@dataclass(frozen=True)
class Scales:
    """What all panels of a film share."""

    times: Floats
    """(T,) s"""
    due: float
    """s, by when the pole is to be up"""
    zoom: float
    """px/m"""
    speed: float
    """m/s, at the top of the chart"""

    @classmethod
    def of(cls, panels: Sequence[SwingPanel], due: float) -> Scales:
        """Scales that fit the panels: neither carts nor poles leave the scene."""
        if not panels or len({len(panel.run.episode.time) for panel in panels}) > 1:
            raise ValueError("a film of swing-ups needs panels, and all as long")
        x, x_dot, theta, _ = np.concatenate([panel.state for panel in panels]).T
        far, fastest = np.abs([x, x + LENGTH * np.sin(theta)]).max(), float(np.abs(x_dot).max())
        zoom = min(WIDTH / 2 / (far + 0.4), (SCENE / 2 - 20) / LENGTH)
        return cls(panels[0].run.episode.time, due, zoom, max(ceiling(fastest), 0.1))

    def row(self, t: float) -> int:
        """The last row at or before t s."""
        return max(int(np.searchsorted(self.times, t + 1e-6, side="right")) - 1, 0)

    def seen(self, points: Floats) -> Floats:
        """Where points (n, 2) in m, to the right and up from the hinge at x = 0, are in the scene, px."""
        return np.array([WIDTH / 2, SCENE / 2 - 6]) + self.zoom * points * (1, -1)


def swing_still(panels: Sequence[SwingPanel], t: float, due: float) -> Picture:
    """The film's frame (H, W, 3) at t s, height and width even."""
    return _frame(panels, t, Scales.of(panels, due))


def write_swing_still(path: str | os.PathLike[str], panels: Sequence[SwingPanel], t: float, due: float) -> None:
    """Write the film's frame at t s as a PNG."""
    write_picture(path, swing_still(panels, t, due))


def write_swing_film(
    path: str | os.PathLike[str],
    panels: Sequence[SwingPanel],
    due: float,
    progress: Callable[[int, int], None] | None = None,
) -> None:
    """Write an mp4 (H.264, yuv420p) in real time, a frame for every row; the poles are to be up from `due` s on.

    Raises:
        ValueError: no panels, or some longer than others.
        DiskFullError: the disk is full; nothing stands under the film's name that did not before.
        FilmError: ffmpeg gave up for another reason.
    """
    scales = Scales.of(panels, due)
    times = [float(t) for t in scales.times]
    write_frames(path, lambda t: _frame(panels, t, scales), times, times[1] - times[0], progress)


def _frame(panels: Sequence[SwingPanel], t: float, scales: Scales) -> Picture:
    columns, rows = min(len(panels), ACROSS), math.ceil(len(panels) / ACROSS)
    width = 2 * MARGIN + WIDTH * columns + GUTTER * (columns - 1)
    height = 2 * MARGIN - 12 + HEIGHT * rows + GAP * (rows - 1)
    canvas = Canvas(width + width % 2, height + height % 2)
    for k, panel in enumerate(panels):
        left, top = MARGIN + k % ACROSS * (WIDTH + GUTTER), MARGIN - 12 + k // ACROSS * (HEIGHT + GAP)
        _draw_panel(canvas.part(left, top, WIDTH, HEIGHT), panel, scales.row(t), scales)
    return canvas.pixels


def _draw_panel(canvas: Canvas, panel: SwingPanel, row: int, scales: Scales) -> None:
    headline(canvas, TITLE - 14, WIDTH, panel.title, f"t = {scales.times[row]:5.2f} s")
    scene = canvas.part(0, TITLE, WIDTH, SCENE)
    _draw_scene(scene, panel, row, scales)
    scene.frame(0, 0, WIDTH, SCENE)
    top, half = TITLE + SCENE + GAP, (WIDTH - 2 * GAP) // 2
    _draw_angle(canvas.part(0, top, half, CHART), panel, row, scales)
    _draw_speed(canvas.part(WIDTH - half, top, half, CHART), panel, row, scales)


def _draw_scene(canvas: Canvas, panel: SwingPanel, row: int, scales: Scales) -> None:
    """The track with its metres, the cone, the poles of late, then cart and pole as they are."""
    x, _, theta, _ = panel.state[row]
    up = abs(theta) < CONE
    metres = math.floor(WIDTH / 2 / scales.zoom)
    for mark in range(-metres, metres + 1):
        column = scales.seen(np.array([[mark, 0.0]]))[0, 0]
        canvas.box(column - (mark == 0) / 2, 0, column + 1, SCENE, HAIRLINE if mark else MUTED)
        said = f"{MINUS if mark < 0 else ''}{abs(mark)}" + (" m" if mark == 0 else "")
        canvas.text(column + 5, SCENE - 8, said, 11, MUTED)
    top, bottom = scales.seen(np.array([[0.0, CART[0, 1]], [0.0, CART[0, 1] - 0.03]]))[:, 1]
    canvas.box(0, top, WIDTH, bottom, MUTED)
    cone = np.array([(x, 0.0), *((x + 1.08 * np.sin(a), 1.08 * np.cos(a)) for a in np.linspace(-CONE, CONE, 9))])
    canvas.glass(scales.seen(cone), TEAL if up else MUTED, 0.3)
    for k in range(TRAIL, 0, -1):
        if row >= k * BETWEEN:
            then_x, _, then, _ = panel.state[row - k * BETWEEN]
            canvas.glass(scales.seen(_pole(then_x, then)), BLUE, 0.3 * (1 - k / (TRAIL + 1)))
    canvas.polygon(scales.seen(CART + np.array([x, 0])), INK)
    canvas.polygon(scales.seen(_pole(x, theta)), TEAL if up else BLUE)
    around = np.linspace(0, 2 * np.pi, 20, endpoint=False)
    canvas.polygon(scales.seen(0.05 * np.stack([np.cos(around), np.sin(around)], -1) + (x, 0)), TROUGH)
    since = panel.up_from
    if scales.times[row] >= scales.due and since > scales.row(scales.due):
        banner(canvas, WIDTH / 2, 30, f"not up at {scales.due:g} s")
    elif row >= since:
        canvas.text(12, 24, f"up since {scales.times[since]:.2f} s", 15, TEAL, bold=True)


def _draw_angle(canvas: Canvas, panel: SwingPanel, row: int, scales: Scales) -> None:
    """The angle until now; a line ends where the pole passes straight down."""
    theta = panel.state[: row + 1, 2]
    plot = _plot(canvas, scales, "angle from upright, degrees", {0.0: f"{MINUS}180", 0.5: "0", 1.0: "180"}, TEAL)
    for share in (-1, 1):
        y = plot.place(np.zeros(1), np.array([0.5 + share * CONE / 2 / math.pi]))[0, 1]
        canvas.dashes((plot.left, y), (plot.right, y), MUTED)
    line = plot.place(scales.times[: row + 1], 0.5 + theta / 2 / math.pi)
    for piece in np.split(line, np.flatnonzero(np.abs(np.diff(theta)) > math.pi) + 1):
        plot.line(canvas, piece, TEAL, 2)
    plot.cursor(canvas, line[-1], TEAL)


def _draw_speed(canvas: Canvas, panel: SwingPanel, row: int, scales: Scales) -> None:
    """The cart's speed until now, and its mean until now."""
    speed = np.abs(panel.state[: row + 1, 1])
    mean = np.cumsum(speed) / np.arange(1, row + 2)
    levels = {share: f"{scales.speed * share:g}" for share in (0.0, 0.5, 1.0)}
    plot = _plot(canvas, scales, "cart speed, m/s", levels, BLUE)
    canvas.text(plot.right, 12, f"mean {mean[-1]:.2f} m/s", 12, INK, bold=True, align="right")
    line = plot.place(scales.times[: row + 1], speed / scales.speed)
    plot.line(canvas, line, BLUE, 2)
    plot.line(canvas, plot.place(scales.times[: row + 1], mean / scales.speed), INK, 1)
    plot.cursor(canvas, line[-1], BLUE)


def _plot(canvas: Canvas, scales: Scales, name: str, levels: dict[float, str], colour: Colour) -> Plot:
    """Axes, and a line at the time when the pole is to be up."""
    height, width = canvas.pixels.shape[:2]
    duration = float(scales.times[-1])
    plot = Plot(width, height, duration)
    canvas.text(0, 12, name, 12, colour, bold=True)
    plot.axes(canvas, levels, [float(t) for t in np.arange(0, duration * 1.0001, ceiling(duration / 7))])
    column = plot.place(np.array([scales.due]), np.zeros(1))[0, 0]
    canvas.dashes((column, plot.top), (column, plot.bottom), MUTED)
    canvas.text(column + 5, plot.top + 11, "up from here on", 11, MUTED)
    return plot


def _pole(x: float, theta: float) -> Floats:
    """Corners (4, 2) in m."""
    along = np.array([math.sin(theta), math.cos(theta)])
    across = 0.03 * np.array([along[1], -along[0]])
    hinge = np.array([x, 0.0])
    tip = hinge + LENGTH * along
    return np.stack([hinge - across, hinge + across, tip + across, tip - across])
