"""Films of flights: a close-up in three dimensions, the surroundings of the goal magnified, the distance over time.

    panels = [FlightPanel("source", run, flight.system, target.task, target.first[0]), ...]
    FlightFilm(panels).write("film.mp4")

All panels share one clock and one set of scales. A path is teal on its course and red far off it; a flight that failed
is marked from that moment on.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection

from visadapt.films import widgets
from visadapt.films.camera import axes_towards, ground_grid
from visadapt.films.film import Film
from visadapt.films.flight_close_up import PANEL_WIDTH, SECOND, close_up
from visadapt.films.flight_panel import INSTANT_PERIOD_S, FlightPanel, length_text
from visadapt.films.flight_scales import FlightScales, moving_line
from visadapt.films.widgets import BLUE, GROUND, HAIRLINE, INK, MUTED, PAPER, RED, SKY, VIOLET, Floats

FRAME_PERIOD_S, LAST_INSTANT_S = 0.04, 1.5
"""s between frames, and s for which the last instant is shown longer"""
BOX_TOP, BOX_SIDE = 414, 152
"""px"""
READINGS_TOP, BARS_TOP, CHART_TOP = 578, 640, 706
"""px"""
COMMAND_LABELS = {"rate_x": "roll rate", "rate_y": "pitch rate", "rate_z": "yaw rate"}
"""Labels of the commands whose names alone would not say what they are."""
OVERVIEW_DIRECTION = (0.55, 1.0, -0.6)
"""direction of view of the whole course, in world axes"""


class FlightFilm(Film):
    """Flights side by side; the last instant is shown for another LAST_INSTANT_S.

    Raises:
        ValueError: no panels, or flights along a reference beside flights through a point.
    """

    panel_width, panel_height = PANEL_WIDTH, CHART_TOP + widgets.CHART_HEIGHT

    def __init__(self, panels: Sequence[FlightPanel]) -> None:
        super().__init__(panels, FRAME_PERIOD_S)
        self.scales = FlightScales(panels)
        self.follows = self.scales.follows
        self.duration = max(max(panel.end for panel in panels), INSTANT_PERIOD_S)

    @property
    def times(self) -> list[float]:
        return [k * self.period for k in range(round((self.duration + LAST_INSTANT_S) / self.period) + 1)]

    def draw_panel(self, page: Axes, panel: FlightPanel) -> Callable[[float], None]:
        set_clock = widgets.headline(page, panel.title)
        views = (self._overview, self._box, self._numbers, self._chart)
        moves = [close_up(page, panel, self.scales), *(view(page, panel) for view in views)]

        def move(t: float) -> None:
            i = min(max(int(t / INSTANT_PERIOD_S + 1e-6), 0), len(panel.times) - 1)
            set_clock(float(panel.times[i]))
            for each in moves:
                each(i)

        return move

    def _overview(self, page: Axes, panel: FlightPanel) -> Callable[[int], None]:
        """The whole course from afar, above its shadow on the ground."""
        course, position, size = panel.reference, panel.position, np.array([PANEL_WIDTH - BOX_SIDE - 12, BOX_SIDE])
        to_view = axes_towards(OVERVIEW_DIRECTION)[:2].T  # (3, 2) projects points
        view = widgets.framed(page, 0, BOX_TOP, *size, facecolor=GROUND)
        with_shadow = np.concatenate([course, self.scales.dropped(course)]) @ to_view
        low, high = with_shadow.min(0), with_shadow.max(0)
        half = ((high - low) / (size - 36)).max() * size / 2
        (left, bottom), (right, top) = (low + high) / 2 - half, (low + high) / 2 + half
        view.set(xlim=(left, right), ylim=(bottom, top))
        step = max(widgets.ceiling(float(np.ptp(course, axis=0).max()) / 8), 0.5)
        grid, colours = ground_grid(step)
        view.add_collection(
            LineCollection(list((grid + self.scales.dropped(course.mean(0))) @ to_view), colors=colours), autolim=False
        )
        marks = course[::SECOND] if self.follows else np.linspace(course[0], course[-1], 9)
        view.add_collection(LineCollection([self.scales.plumb(mark) @ to_view for mark in marks], colors=HAIRLINE))
        for points, colour in ((self.scales.dropped(course), MUTED), (course, INK)):
            view.plot(*(points @ to_view).T, color=colour, linewidth=1, alpha=0.6)
        draw_path, plumb = self.scales.path(view, panel), moving_line(view, MUTED, 1)
        dot = moving_line(view, BLUE, 0, marker="o", markersize=8)
        _name(view, f"whole course, grid {step:g} m")

        def move(i: int) -> None:
            draw_path(lambda points: points @ to_view, i)
            plumb.set_data(*(self.scales.plumb(position[i]) @ to_view).T)
            dot.set_data(*(position[i : i + 1] @ to_view).T)

        return move

    def _box(self, page: Axes, panel: FlightPanel) -> Callable[[int], None]:
        """The surroundings of the goal, magnified: seen from above, or from behind the point."""
        side, limits = self.scales.box, (-self.scales.box, self.scales.box)
        view = widgets.framed(
            page, PANEL_WIDTH - BOX_SIDE, BOX_TOP, BOX_SIDE, BOX_SIDE, xlim=limits, ylim=limits, facecolor=SKY
        )
        bar = widgets.ceiling(side / 2.5)
        view.plot([-0.9 * side, -0.9 * side + bar], [-0.88 * side] * 2, color=MUTED, linewidth=2)
        view.text(-0.82 * side + bar, -0.92 * side, length_text(bar, 0), fontsize=11, color=MUTED)
        _name(view, "from above" if self.follows else "target, from behind")
        course, draw_path, error = moving_line(view, MUTED, 1), self.scales.path(view, panel), moving_line(view, RED, 2)
        view.plot(0, 0, "o", color=INK, markersize=8, mec=PAPER)
        dot = moving_line(view, INK, 0, marker="o", markersize=10, mec=PAPER)
        columns, signs = ([0, 1], (1, 1)) if self.follows else ([1, 2], (-1, 1))

        def move(i: int) -> None:
            def seen(points: Floats) -> Floats:
                return (points - panel.goal[i])[..., columns] * signs

            course.set_data(*seen(panel.reference).T)
            draw_path(seen, i)
            visible = self.follows or panel.times[i] >= panel.passed
            x, y = seen(panel.position[i] if self.follows else panel.nearest).clip(-0.9 * side, 0.9 * side)
            error.set(data=((0, x), (0, y)), visible=visible)
            colour = self.scales.colours(panel.away[i] if self.follows else panel.worst)
            dot.set(data=([x], [y]), mfc=colour, visible=visible)

        return move

    def _numbers(self, page: Axes, panel: FlightPanel) -> Callable[[int], None]:
        """Speed, distance, score and hidden force; the commands."""
        names = ("off the reference", "mean so far") if self.follows else ("to the target", "nearest so far")
        headings = ((0, "speed"), (106, names[0]), (240, names[1]), (362, "hidden force"))
        readings = [widgets.reading(page, left, READINGS_TOP, name) for left, name in headings]
        readings[3].set_color(VIOLET)
        half = PANEL_WIDTH / 2
        bars = []
        for k, variable in enumerate(panel.vehicle.actions):
            label, left, middle = COMMAND_LABELS.get(variable.name, variable.name), k % 2 * (half + 7), k // 2 * 36
            bars.append(widgets.bar(page, left, BARS_TOP + middle, half - 7, label, 1.0, "", BLUE))

        def move(i: int) -> None:
            force = "\N{EN DASH}" if panel.run.force is None else f"{np.linalg.norm(panel.force[i]):.2f} N"
            words = (f"{panel.speed[i]:.2f} m/s", length_text(panel.away[i]), length_text(panel.score[i]), force)
            for text, value in zip(readings, words, strict=True):
                text.set_text(value)
            command = panel.command(i)
            for k, set_bar in enumerate(bars):
                set_bar(None if command is None else float(command[k]))

        return move

    def _chart(self, page: Axes, panel: FlightPanel) -> Callable[[int], None]:
        """The distance up to an instant, and the score up to it: the mean distance, or the least."""
        axes = widgets.chart(
            page, CHART_TOP, "distance to the reference" if self.follows else "distance to the target", self.duration
        )
        levels = np.linspace(0, self.scales.far, 3) if self.follows else 10.0 ** np.arange(-3, 3)
        if self.follows:
            axes.set_ylim(-0.05 * self.scales.far, 1.05 * self.scales.far)
        else:
            axes.set(yscale="log", ylim=(8e-4, 150))
            axes.minorticks_off()
        axes.set_yticks(levels, [length_text(level, None) for level in levels])
        score = "mean {}" if self.follows else "nearest {}"
        draw = widgets.trace(
            axes, panel.times, panel.away, panel.score, lambda metres: score.format(length_text(metres))
        )
        return lambda i: draw(i, panel.lost(i))


def _name(view: Axes, name: str) -> None:
    box = {"facecolor": PAPER, "pad": 4}
    view.annotate(name, (0, 1), (6, -6), "axes fraction", "offset points", fontsize=11, color=MUTED, va="top", bbox=box)
