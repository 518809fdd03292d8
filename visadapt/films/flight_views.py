"""Views of a flight: the vehicle and its course close up, the whole course, and a box magnified around the goal."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Self

import numpy as np

from visadapt.evaluation.flight_score import FAR
from visadapt.films.canvas import BLUE, HAIRLINE, INK, MUTED, RED, TEAL, TROUGH, Canvas, Colour, text_width
from visadapt.films.drawing3d import Floats, Pen, PinholeCamera, blend, dropped
from visadapt.films.flight_panel import FINE, FlownPanel
from visadapt.films.vehicle_shapes import draw_vehicle, outline
from visadapt.films.widgets import ceiling
from visadapt.systems import Quadrotor

AMBER: Colour = (232, 168, 48)
VIOLET: Colour = (122, 62, 168)
"""of the hidden force"""
EARLIER: Colour = (226, 172, 168)
"""of the flight to compare with"""
NEXT = 1.0
"""s of the reference ahead that are highlighted"""
CLOSE: dict[bool, tuple[tuple[float, float, float], tuple[float, float, float], float]] = {
    True: ((-1.2, -2.6, 1.15), (0.0, 0.0, 0.0), 820.0),
    False: ((-4.8, -2.7, 1.9), (4.0, 0.3, 0.1), 560.0),
}
"""Close up, of a flight that follows (True) or flies through a point: where the camera is and where it looks, m from
what it moves with, and its focal length in px"""
STOPS = 4.0
"""m before the target the camera stops, and lets the vehicle fly on"""
DIRECTION = np.array([-0.55, -1.0, 0.6])
"""from the course to the camera that sees all of it"""


@dataclass(frozen=True)
class Scales:
    """What all panels of a film share, so that they can be compared at a glance."""

    duration: float
    """s"""
    far: float
    """m, at the top of the plot; a path that is half as far off is drawn red"""
    box: float
    """m, half the width of the magnified box"""
    force: float
    """N, the greatest"""
    ground: float
    """m, height of the ground that is drawn"""

    @classmethod
    def of(cls, panels: Sequence[FlownPanel]) -> Self:
        """Scales that fit the panels; failed flights may leave them, so that the rest is legible."""
        well = [panel.worst for panel in panels if panel.failed is None] or [FAR]
        low = min(float(panel.reference[:, 2].min()) for panel in panels)
        clearance, step = (0.7, 0.5) if panels[0].follows else (6.0, 1.0)
        far = max(ceiling(max(well)), 0.05)
        return cls(
            max(max(panel.end for panel in panels), FINE),
            far,
            min(max(1.2 * max(well), 0.1), FAR),
            max(*(float(np.linalg.norm(panel.force, axis=1).max()) for panel in panels), 0.1),
            float(np.floor((low - clearance) / step) * step),
        )

    def colour(self, away: float) -> Colour:
        """Of a path that is so many metres off: teal, amber, red."""
        share = min(2 * away / self.far, 1.0)
        return blend(TEAL, AMBER, 2 * share) if share < 0.5 else blend(AMBER, RED, 2 * share - 1)


def draw_close_up(canvas: Canvas, panel: FlownPanel, i: int, scales: Scales) -> None:
    """The vehicle in its true size and attitude with its thrust, the hidden force, and the course around it.

    A camera that follows a reference sees its point in the middle, whatever the vehicle does: so all panels look from
    the same place, and an error is a vehicle beside the middle. Else it follows the vehicle, and stops before a target.
    """
    place, turned, goal = panel.position[i], panel.attitude[i], panel.goal[i]
    moving = goal
    if not panel.follows:
        moving = panel.position[: i + 1]
        arrived = np.flatnonzero(moving[:, 0] > goal[0] - STOPS)
        moving = moving[arrived[0] if len(arrived) else i]
    offset, ahead, focal = CLOSE[panel.follows]
    size = (canvas.pixels.shape[1], canvas.pixels.shape[0])
    pen = Pen(canvas, PinholeCamera.towards(moving + np.array(offset), moving + np.array(ahead), focal, size))
    step = 1.0 if panel.follows else 5.0
    pen.ground(scales.ground, moving, step, 14 * step)
    pen.line(dropped(panel.reference, scales.ground), HAIRLINE)
    pen.line(dropped(panel.position[: i + 1], scales.ground), blend(MUTED, TROUGH, 0.5))
    shape = place + outline(panel.vehicle) @ turned.T
    pen.shadow(shape, scales.ground)
    pen.dashes(place, dropped(place[None], scales.ground)[0], blend(MUTED, TROUGH, 0.3), 0.06 * step)
    _draw_course(pen, panel, i, 2)
    if not panel.follows:
        _draw_target(pen, panel, i, scales)
    _draw_path(pen, panel, i, scales, 3)
    draw_vehicle(pen, panel.vehicle, place, turned)
    if panel.follows:
        pen.line(np.stack([place, goal]), RED, 2)
        pen.dot(goal, 5, (255, 255, 255))
        pen.dot(goal, 3.5, INK)
    _draw_forces(pen, panel, i, scales)
    canvas.text(size[0] - 10, size[1] - 10, f"grid {step:g} m", 11, MUTED, align="right")


def draw_overview(canvas: Canvas, panel: FlownPanel, i: int, scales: Scales) -> None:
    """The whole course from afar, above its shadow on the ground."""
    course = panel.reference
    size = (canvas.pixels.shape[1], canvas.pixels.shape[0])
    camera = PinholeCamera.around(np.concatenate([course, dropped(course, scales.ground)]), DIRECTION, size, 16)
    pen = Pen(canvas, camera)
    span = float(np.ptp(course, axis=0).max())
    step = max(ceiling(span / 8), 0.5)
    pen.ground(scales.ground, (course.min(0) + course.max(0)) / 2, step, 8 * step)
    pen.line(dropped(course, scales.ground), blend(MUTED, TROUGH, 0.6))
    marks = course[:: round(NEXT / FINE)] if panel.follows else np.linspace(course[0], course[-1], 9)
    for mark in marks:
        pen.line(np.stack([mark, dropped(mark[None], scales.ground)[0]]), HAIRLINE)
    _draw_course(pen, panel, i, 1)
    _draw_path(pen, panel, i, scales, 2)
    place = panel.position[i]
    pen.line(np.stack([place, dropped(place[None], scales.ground)[0]]), MUTED)
    if not panel.follows:
        pen.dot(panel.goal[i], 4, INK)
    pen.dot(place, 4, BLUE)
    _name(canvas, f"whole course, grid {step:g} m")


def draw_box(canvas: Canvas, panel: FlownPanel, i: int, scales: Scales, axes: tuple[int, int], name: str) -> None:
    """What is around the goal, magnified: two world axes, to the right and up, the first reversed where negative."""
    width, height = canvas.pixels.shape[1], canvas.pixels.shape[0]
    zoom = height / (2 * scales.box)
    sides = np.array([abs(axes[0]), axes[1]])
    signs = np.array([-1.0 if axes[0] < 0 else 1.0, -1.0])

    def seen(points: Floats) -> Floats:
        return np.array([width / 2, height / 2]) + zoom * signs * (points[:, sides] - panel.goal[i, sides])

    canvas.fade(1.0, (250, 251, 252))
    canvas.box(width / 2 - 0.5, 0, width / 2 + 0.5, height, HAIRLINE)
    canvas.box(0, height / 2 - 0.5, width, height / 2 + 0.5, HAIRLINE)
    canvas.line(seen(panel.reference), blend(INK, TROUGH, 0.35), 1)
    if panel.earlier is not None:
        canvas.line(_near(seen(panel.earlier.position[: i + 1])), EARLIER, 2)
    for part, away in _pieces(panel, i):
        canvas.line(_near(seen(part)), scales.colour(away), 2)
    spot, middle = seen(panel.position[i : i + 1])[0], np.array([width / 2, height / 2])
    place = np.clip(spot, 7, (width - 7, height - 7))
    there = panel.follows or np.array_equal(spot, place)
    if panel.follows:
        canvas.line(np.stack([middle, place]), RED, 2)
    elif panel.times[i] >= panel.passed:
        nearest = seen(panel.nearest[None])[0]
        canvas.line(np.stack([middle, np.clip(nearest, 0, (width, height))]), RED, 2)
        _disc(canvas, np.clip(nearest, 7, (width - 7, height - 7)), 4.5, scales.colour(panel.worst))
        there = False
    _disc(canvas, middle, 3.5, INK)
    if there:
        _disc(canvas, place, 4.5, scales.colour(float(panel.away[i]) if panel.follows else panel.worst))
    _name(canvas, name)
    # A bar of a round length, for scale.
    length = ceiling(scales.box / 2.5)
    canvas.box(8, height - 10, 8 + zoom * length, height - 8, MUTED)
    said = f"{100 * length:g} cm" if length < 1 else f"{length:g} m"
    canvas.text(14 + zoom * length, height - 5, said, 11, MUTED)
    canvas.frame(0, 0, width, height)


def _draw_course(pen: Pen, panel: FlownPanel, i: int, thickness: int) -> None:
    """The reference, its next second highlighted; or the straight line to the target."""
    if not panel.follows:
        pen.dashes(panel.reference[0], panel.reference[-1], blend(MUTED, TROUGH, 0.2), 0.5)
        return
    pen.line(panel.reference, blend(INK, TROUGH, 0.55), 1)
    pen.line(panel.reference[i : i + round(NEXT / FINE) + 1], INK, thickness)


def _draw_path(pen: Pen, panel: FlownPanel, i: int, scales: Scales, thickness: int) -> None:
    if panel.earlier is not None:
        pen.line(panel.earlier.position[: i + 1], EARLIER, thickness - 1)
    for part, away in _pieces(panel, i):
        pen.line(part, scales.colour(away), thickness)


def _pieces(panel: FlownPanel, i: int) -> list[tuple[Floats, float]]:
    """The path until now in pieces, and how far off each is; that through a point is as far off as it misses it."""
    if not panel.follows:
        return [(panel.position[: i + 1], panel.worst)]
    return [(panel.position[k : min(k + 6, i + 1)], float(panel.away[k])) for k in range(0, i, 5)]


def _draw_target(pen: Pen, panel: FlownPanel, i: int, scales: Scales) -> None:
    """A ring across x, FAR in radius, with a smaller one inside, on a pole."""
    goal = panel.goal[i]
    angle = np.linspace(0, 2 * np.pi, 49)
    ring = np.stack([0 * angle, np.cos(angle), np.sin(angle)], -1)
    pen.line(np.stack([goal - (0, 0, FAR), dropped(goal[None], scales.ground)[0]]), MUTED, 2)
    pen.line(goal + FAR * ring, INK, 3)
    pen.line(goal + 0.25 * FAR * ring, INK, 1)
    pen.dot(goal, 2.5, RED)
    seen, depth = pen.camera.project(goal[None] + (0, 0, 1.3 * FAR))
    if depth[0] > 0:
        said = f"{panel.away[i]:.1f} m" if panel.times[i] < panel.passed else "target"
        pen.canvas.text(seen[0, 0], seen[0, 1] - 4, said, 13, INK, bold=True, align="centre")


def _draw_forces(pen: Pen, panel: FlownPanel, i: int, scales: Scales) -> None:
    """Thrust, as it is commanded, and the hidden force."""
    command, vehicle, turned = float(panel.command(i)[0]), panel.vehicle, panel.attitude[i]
    last = panel.row(i) == len(panel.run.episode.time) - 1
    if isinstance(vehicle, Quadrotor):
        low, high = (float(vehicle.mass) * float(limit) for limit in (vehicle.min_thrust, vehicle.max_thrust))
        thrust, way, tail, unit = (low + (high - low) * (command + 1) / 2), turned[:, 2], 0.0, 0.045
    else:
        high = float(getattr(vehicle, "max_thrust", 1.0))
        thrust, way, tail, unit = high * (command + 1) / 2, turned[:, 0], 0.4, 0.2
    place = panel.position[i]
    if not last:
        pen.arrow(place + tail * way, unit * thrust * way, BLUE, f"thrust {thrust:.1f} N")
    force = panel.force[i]
    longest = 0.45 if panel.follows else 1.2
    pen.arrow(place, longest / scales.force * force, VIOLET, f"{np.linalg.norm(force):.2f} N")


def _near(points: Floats) -> Floats:
    """Points (n, 2) in px, held where OpenCV takes them."""
    return np.asarray(np.clip(points, -1e5, 1e5))


def _disc(canvas: Canvas, place: Floats, radius: float, colour: Colour) -> None:
    around = np.linspace(0, 2 * np.pi, 20, endpoint=False)
    round_it = np.stack([np.cos(around), np.sin(around)], -1)
    canvas.polygon(place + (radius + 1.5) * round_it, (255, 255, 255))
    canvas.polygon(place + radius * round_it, colour)


def _name(canvas: Canvas, name: str) -> None:
    canvas.box(1, 1, text_width(name, 11) + 14, 19, (255, 255, 255))
    canvas.text(7, 14, name, 11, MUTED)
    canvas.frame(0, 0, canvas.pixels.shape[1], canvas.pixels.shape[0])
