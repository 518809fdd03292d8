"""Films of flights side by side: a close-up in three dimensions, the goal magnified, and the distance over time.

    panels = [FlownPanel("source", run, flight.system, target.task, target.first[0]), ...]
    write_flight_film("film.mp4", panels)

All panels share one clock and one set of scales. A path is teal where it is on its course and red where it is far
off; a flight that failed is marked from the moment on at which it did.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence

import numpy as np

from visadapt.films.canvas import BLUE, INK, MUTED, TEAL, Canvas, Picture
from visadapt.films.drawing3d import Floats
from visadapt.films.flight_panel import FINE, FlownPanel
from visadapt.films.flight_views import EARLIER, VIOLET, Scales, draw_box, draw_close_up, draw_overview
from visadapt.films.video import GUTTER, MARGIN, write_frames, write_picture
from visadapt.films.widgets import Plot, banner, bar, ceiling, headline, reading

__all__ = ["FlownPanel", "flight_still", "write_flight_film", "write_flight_still"]

PERIOD = 2 * FINE
"""s between frames"""
HOLD = 1.5
"""s for which the end is shown"""
WIDTH, TITLE, SCENE, BOX, READINGS, BARS, CHART = 480, 40, 360, 152, 42, 68, 124
"""px, of a panel and its parts below each other, GAP apart"""
GAP = 14
HEIGHT = TITLE + SCENE + BOX + READINGS + BARS + CHART + 4 * GAP
COMMANDS = {"quadrotor": ("thrust", "roll rate", "pitch rate", "yaw rate")}
"""Names of commands, where they are not the system's own"""


def flight_still(panels: Sequence[FlownPanel], t: float) -> Picture:
    """The film's frame (H, W, 3) at t s, height and width even."""
    return _frame(panels, t, _scales(panels))


def write_flight_still(path: str | os.PathLike[str], panels: Sequence[FlownPanel], t: float) -> None:
    """Write the film's frame at t s as a PNG."""
    write_picture(path, flight_still(panels, t))


def write_flight_film(
    path: str | os.PathLike[str],
    panels: Sequence[FlownPanel],
    progress: Callable[[int, int], None] | None = None,
) -> None:
    """Write an mp4 (H.264, yuv420p) in real time, 25 frames a second, that rests on its end.

    Raises:
        ValueError: no panels, or some that follow a reference beside others that fly through a point.
        DiskFullError: the disk is full; nothing stands under the film's name that did not before.
        FilmError: ffmpeg gave up for another reason.
    """
    scales = _scales(panels)
    times = [k * PERIOD for k in range(round((scales.duration + HOLD) / PERIOD) + 1)]
    write_frames(path, lambda t: _frame(panels, t, scales), times, PERIOD, progress)


def _scales(panels: Sequence[FlownPanel]) -> Scales:
    if not panels:
        raise ValueError("a film needs at least one panel")
    if len({panel.follows for panel in panels}) > 1:
        raise ValueError("flights along a reference and through a point have no scales in common: film them apart")
    return Scales.of(panels)


def _frame(panels: Sequence[FlownPanel], t: float, scales: Scales) -> Picture:
    width = 2 * MARGIN + WIDTH * len(panels) + GUTTER * (len(panels) - 1)
    canvas = Canvas(width + width % 2, (2 * MARGIN + HEIGHT - 12) // 2 * 2)
    for k, panel in enumerate(panels):
        part = canvas.part(MARGIN + k * (WIDTH + GUTTER), MARGIN - 12, WIDTH, HEIGHT)
        _draw_panel(part, panel, t, scales)
    return canvas.pixels


def _draw_panel(canvas: Canvas, panel: FlownPanel, t: float, scales: Scales) -> None:
    """A panel as it is at t s; after its end it stands still."""
    i = panel.instant(t)
    headline(canvas, TITLE - 14, WIDTH, panel.title, f"t = {panel.times[i]:5.2f} s")
    top = TITLE
    scene = canvas.part(0, top, WIDTH, SCENE)
    draw_close_up(scene, panel, i, scales)
    _draw_verdict(scene, panel, i, scales)
    scene.frame(0, 0, WIDTH, SCENE)
    top += SCENE + GAP
    side, wide = BOX, WIDTH - 2 * BOX - 2 * 12
    draw_overview(canvas.part(0, top, wide, BOX), panel, i, scales)
    boxes = (((0, 1), "from above"), ((0, 2), "from the side"))
    if not panel.follows:
        boxes = (((-1, 2), "target, from behind"), ((0, 2), "from the side"))
    for k, (axes, name) in enumerate(boxes):
        left = wide + 12 + k * (side + 12)
        draw_box(canvas.part(left, top, side, BOX), panel, i, scales, axes, name)
    top += BOX + GAP
    _draw_readings(canvas.part(0, top, WIDTH, READINGS), panel, i, scales)
    top += READINGS + GAP
    _draw_commands(canvas.part(0, top, WIDTH, BARS), panel, i)
    top += BARS + GAP
    _draw_chart(canvas.part(0, top, WIDTH, CHART), panel, i, scales)


def _draw_verdict(canvas: Canvas, panel: FlownPanel, i: int, scales: Scales) -> None:
    """How far off the flight is; and how it failed, if it did by now."""
    t, failed = panel.times[i], panel.failed
    if failed is not None and t >= failed - 1e-6:
        if not panel.run.survived and i == len(panel.times) - 1:
            canvas.fade(0.6)
            said = f"LOST at t = {panel.end:.2f} s"
        else:
            said = f"STRAYED at t = {failed:.2f} s" if panel.follows else f"MISSED by {_length(panel.worst)}"
        banner(canvas, WIDTH / 2, 32, said)
        return
    if panel.follows:
        said, away = f"{_length(panel.away[i])} off", panel.away[i]
    elif t >= panel.passed:
        said, away = f"passed {_length(panel.worst)} off", panel.worst
    else:
        return
    canvas.text(14, 34, said, 22, scales.colour(float(away)), bold=True)


def _draw_readings(canvas: Canvas, panel: FlownPanel, i: int, scales: Scales) -> None:
    force = float(np.linalg.norm(panel.force[i]))
    far, so_far = _split(panel.away[i]), _split(panel.scored(i))
    names = ("off the reference", "mean so far") if panel.follows else ("to the target", "nearest so far")
    reading(canvas, 0, "speed", f"{panel.speed[i]:.2f}", "m/s")
    reading(canvas, 0.22 * WIDTH, names[0], *far)
    open_still = not panel.follows and panel.times[i] < panel.passed
    reading(canvas, 0.5 * WIDTH, names[1], *so_far, INK if open_still else scales.colour(panel.scored(i)))
    reading(canvas, 0.755 * WIDTH, "hidden force", f"{force:.2f}", "N", VIOLET if force >= 0.005 else MUTED)


def _draw_commands(canvas: Canvas, panel: FlownPanel, i: int) -> None:
    names = COMMANDS.get(panel.vehicle.name, tuple(variable.name for variable in panel.vehicle.actions))
    live = panel.row(i) < len(panel.run.episode.time) - 1
    for k, (name, value) in enumerate(zip(names, panel.command(i), strict=True)):
        part = canvas.part(k % 2 * (WIDTH // 2 + 14), k // 2 * 36, WIDTH // 2 - 14, 36)
        bar(part, 10, WIDTH / 2 - 14, name, float(value) if live else None, 1.0, "", BLUE)


def _draw_chart(canvas: Canvas, panel: FlownPanel, i: int, scales: Scales) -> None:
    """The distance until now, and its mean, or the nearest, until now."""
    plot = Plot(WIDTH, CHART, scales.duration, left=34.0 if panel.follows else 48.0)
    step = ceiling(scales.duration / 7)
    ticks = [float(t) for t in np.arange(0, scales.duration * 1.0001, step)]
    if panel.follows:
        name, said = "distance to the reference, cm", f"mean {_length(panel.scored(i))}"
        levels = {share: f"{100 * share * scales.far:g}" for share in (0.0, 0.5, 1.0)}
    else:
        name, said = "distance to the target", f"nearest {_length(panel.scored(i))}"
        levels = {k / 5: said for k, said in enumerate(("1 mm", "1 cm", "10 cm", "1 m", "10 m", "100 m"))}

    def height(away: Floats) -> Floats:
        if panel.follows:
            return away / scales.far
        return np.asarray((np.log10(away.clip(1e-3, 1e4)) + 3) / 5)

    canvas.text(0, 12, name, 12, TEAL, bold=True)
    canvas.text(WIDTH, 12, said, 12, INK, bold=True, align="right")
    plot.axes(canvas, levels, ticks)
    if panel.earlier is not None:
        other = panel.earlier
        plot.line(canvas, plot.place(other.times, height(other.distances))[: i + 1], EARLIER, 2)
    line = plot.place(panel.times, height(panel.distances))[: i + 1]
    plot.line(canvas, line, TEAL, 2)
    rows = panel.row(i) + 1
    times = np.arange(rows) * panel.task.period
    plot.line(canvas, plot.place(times, height(panel.score[:rows])), INK, 1)
    lost = not panel.run.survived and i == len(panel.times) - 1
    plot.cursor(canvas, line[-1], TEAL, lost)


def _length(metres: float) -> str:
    return " ".join(_split(metres))


def _split(metres: float) -> tuple[str, str]:
    """A length and its unit, cm below one metre."""
    if metres < 0.995:
        return f"{100 * metres:.1f}", "cm"
    return f"{metres:.2f}" if metres < 99.5 else f"{metres:.0f}", "m"
