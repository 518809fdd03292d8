"""Films of flights: a close-up in three dimensions, the surroundings of the goal magnified, the distance over time.

    panels = [FlightPanel("source", run, flight.system, target.task, target.first[0]), ...]
    FlightFilm(panels).write("film.mp4")

All panels share one clock and one set of scales. A path is teal on its course and red far off it; a flight that failed
is marked from that moment on.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from visadapt.films.canvas import Canvas, Floats
from visadapt.films.colours import BLUE, INK, MUTED, ROSE, TEAL, VIOLET
from visadapt.films.film import Film
from visadapt.films.flight_panel import FlightPanel
from visadapt.films.flight_views import FlightScales, draw_box, draw_close_up, draw_overview
from visadapt.films.widgets import Plot, banner, bar, headline, reading

PANEL_WIDTH, TITLE_HEIGHT, SCENE_HEIGHT, BOX_SIDE = 480, 40, 360, 152
"""px"""
READINGS_HEIGHT, BARS_HEIGHT, CHART_HEIGHT, PART_GAP = 42, 68, 124, 14
"""px, of the other parts of a panel, and between parts"""
COMMAND_LABELS = {"rate_x": "roll rate", "rate_y": "pitch rate", "rate_z": "yaw rate"}
"""Labels of the commands whose names alone would not say what they are."""


@dataclass(frozen=True)
class FlightFilm(Film):
    """Flights side by side.

    Raises:
        ValueError: no panels, or flights along a reference beside flights through a point.
    """

    panels: Sequence[FlightPanel]
    period: float = 0.04
    end_shown: float = 1.5
    """s for which the last instant is shown"""

    panel_width = PANEL_WIDTH
    panel_height = TITLE_HEIGHT + SCENE_HEIGHT + BOX_SIDE + READINGS_HEIGHT + BARS_HEIGHT + CHART_HEIGHT + 4 * PART_GAP

    def __post_init__(self) -> None:
        if not self.panels:
            raise ValueError("a film needs at least one panel")
        if len({panel.follows for panel in self.panels}) > 1:
            raise ValueError("flights along a reference and through a point share no scales: film them apart")

    @property
    def times(self) -> list[float]:
        return [k * self.period for k in range(round((self.scales.duration + self.end_shown) / self.period) + 1)]

    @cached_property
    def scales(self) -> FlightScales:
        """Shared by all panels"""
        return FlightScales.of(self.panels)

    def draw_panel(self, canvas: Canvas, panel: FlightPanel, t: float) -> None:
        i, scales = panel.instant(t), self.scales
        headline(canvas, TITLE_HEIGHT - 14, PANEL_WIDTH, panel.title, f"t = {panel.times[i]:5.2f} s")
        top = TITLE_HEIGHT
        scene = canvas.part(0, top, PANEL_WIDTH, SCENE_HEIGHT)
        draw_close_up(scene, panel, i, scales)
        _draw_distance(scene, panel, i, scales)
        scene.frame(0, 0, PANEL_WIDTH, SCENE_HEIGHT)
        top += SCENE_HEIGHT + PART_GAP
        wide = PANEL_WIDTH - 2 * BOX_SIDE - 2 * 12
        draw_overview(canvas.part(0, top, wide, BOX_SIDE), panel, i, scales)
        boxes = (((0, 1), "from above"), ((0, 2), "from the side"))
        if not panel.follows:
            boxes = (((-1, 2), "target, from behind"), ((0, 2), "from the side"))
        for k, (axes, name) in enumerate(boxes):
            left = wide + 12 + k * (BOX_SIDE + 12)
            draw_box(canvas.part(left, top, BOX_SIDE, BOX_SIDE), panel, i, scales, axes, name)
        top += BOX_SIDE + PART_GAP
        _draw_readings(canvas.part(0, top, PANEL_WIDTH, READINGS_HEIGHT), panel, i, scales)
        top += READINGS_HEIGHT + PART_GAP
        _draw_commands(canvas.part(0, top, PANEL_WIDTH, BARS_HEIGHT), panel, i)
        top += BARS_HEIGHT + PART_GAP
        _draw_chart(canvas.part(0, top, PANEL_WIDTH, CHART_HEIGHT), panel, i, scales)


def _draw_distance(canvas: Canvas, panel: FlightPanel, i: int, scales: FlightScales) -> None:
    """The flight's distance from its course; a banner instead once it has failed."""
    t, failed = panel.times[i], panel.failed
    if failed is not None and t >= failed - 1e-6:
        if not panel.run.survived and i == len(panel.times) - 1:
            canvas.fade(0.6)
            text = f"LOST at t = {panel.end:.2f} s"
        else:
            text = f"STRAYED at t = {failed:.2f} s" if panel.follows else f"MISSED by {_length(panel.worst)}"
        banner(canvas, canvas.width / 2, 32, text)
        return
    if panel.follows:
        text, away = f"{_length(panel.away[i])} off", panel.away[i]
    elif t >= panel.passed:
        text, away = f"passed {_length(panel.worst)} off", panel.worst
    else:
        return
    canvas.text(14, 34, text, 22, scales.colour(float(away)), bold=True)


def _draw_readings(canvas: Canvas, panel: FlightPanel, i: int, scales: FlightScales) -> None:
    force, width = float(np.linalg.norm(panel.force[i])), canvas.width
    away, so_far = _split(panel.away[i]), _split(panel.scored(i))
    names = ("off the reference", "mean so far") if panel.follows else ("to the target", "nearest so far")
    reading(canvas, 0, "speed", f"{panel.speed[i]:.2f}", "m/s")
    reading(canvas, 0.22 * width, names[0], *away)
    undecided = not panel.follows and panel.times[i] < panel.passed
    reading(canvas, 0.5 * width, names[1], *so_far, INK if undecided else scales.colour(panel.scored(i)))
    reading(canvas, 0.755 * width, "hidden force", f"{force:.2f}", "N", VIOLET if force >= 0.005 else MUTED)


def _draw_commands(canvas: Canvas, panel: FlightPanel, i: int) -> None:
    last, half = panel.row(i) == len(panel.run.episode.time) - 1, canvas.width // 2
    for k, (variable, value) in enumerate(zip(panel.vehicle.actions, panel.command(i), strict=True)):
        part = canvas.part(k % 2 * (half + 14), k // 2 * 36, half - 14, 36)
        label = COMMAND_LABELS.get(variable.name, variable.name)
        bar(part, 10, half - 14, label, None if last else float(value), 1.0, "", BLUE)


def _draw_chart(canvas: Canvas, panel: FlightPanel, i: int, scales: FlightScales) -> None:
    """The distance up to an instant, and the score up to it: the mean distance, or the least."""
    plot = Plot(canvas.width, canvas.height, scales.duration, left=34.0 if panel.follows else 48.0)
    if panel.follows:
        name, text = "distance to the reference, cm", f"mean {_length(panel.scored(i))}"
        levels = {share: f"{100 * share * scales.far:g}" for share in (0.0, 0.5, 1.0)}
    else:
        name, text = "distance to the target", f"nearest {_length(panel.scored(i))}"
        levels = {k / 5: label for k, label in enumerate(("1 mm", "1 cm", "10 cm", "1 m", "10 m", "100 m"))}

    def height(away: Floats) -> Floats:
        if panel.follows:
            return away / scales.far
        return np.asarray((np.log10(away.clip(1e-3, 1e4)) + 3) / 5)

    canvas.text(0, 12, name, 12, TEAL, bold=True)
    canvas.text(canvas.width, 12, text, 12, INK, bold=True, align="right")
    plot.axes(canvas, levels)
    if panel.earlier is not None:
        other = panel.earlier
        plot.line(canvas, plot.place(other.times, height(other.distances))[: i + 1], ROSE, 2)
    line = plot.place(panel.times, height(panel.distances))[: i + 1]
    plot.line(canvas, line, TEAL, 2)
    rows = panel.row(i) + 1
    times = np.arange(rows) * panel.task.period
    plot.line(canvas, plot.place(times, height(panel.score[:rows])), INK, 1)
    plot.cursor(canvas, line[-1], TEAL, failed=not panel.run.survived and i == len(panel.times) - 1)


def _length(metres: float) -> str:
    return " ".join(_split(metres))


def _split(metres: float) -> tuple[str, str]:
    """A length and its unit, cm below one metre."""
    if metres < 0.995:
        return f"{100 * metres:.1f}", "cm"
    return f"{metres:.2f}" if metres < 99.5 else f"{metres:.0f}", "m"
