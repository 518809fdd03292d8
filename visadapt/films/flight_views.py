"""Views of a flight: the vehicle close up, the whole course, and the surroundings of the goal magnified."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Self

import numpy as np

from visadapt.evaluation.scoring import FAR
from visadapt.films.canvas import Canvas, Floats, text_width
from visadapt.films.colours import (
    AMBER,
    BLUE,
    HAIRLINE,
    INK,
    MUTED,
    PAPER,
    RED,
    ROSE,
    TEAL,
    TROUGH,
    VIOLET,
    Colour,
    blend,
)
from visadapt.films.drawing3d import Pen, PinholeCamera, dropped
from visadapt.films.flight_panel import INSTANT_PERIOD_S, FlightPanel
from visadapt.films.vehicle_shapes import draw_vehicle, outline
from visadapt.films.widgets import ceiling
from visadapt.systems import Quadrotor

HIGHLIGHTED_S = 1.0
"""s of the reference ahead that are highlighted, and between marks on the whole course"""


@dataclass(frozen=True)
class ChaseView:
    """A camera that moves with something, without turning."""

    place: tuple[float, float, float]
    """m, of the camera from what it moves with, in world axes"""
    looks_at: tuple[float, float, float]
    """m, the point in the middle of the picture, from what it moves with"""
    focal: float
    """px"""

    def camera(self, moving: Floats, size: tuple[int, int]) -> PinholeCamera:
        """The camera when what it moves with is at `moving` (3,), for a picture of (width, height)."""
        return PinholeCamera.towards(moving + self.place, moving + self.looks_at, self.focal, size)


FOLLOWING_VIEW = ChaseView((-1.2, -2.6, 1.15), (0.0, 0.0, 0.0), 820.0)
"""Of a flight along a reference; moves with the reference's point."""
PASSING_VIEW = ChaseView((-4.8, -2.7, 1.9), (4.0, 0.3, 0.1), 560.0)
"""Of a flight through a point; moves with the vehicle."""


@dataclass(frozen=True)
class FlightScales:
    """The scales that all panels of a film share, so that they can be compared at a glance."""

    duration: float
    """s"""
    far: float
    """m, distance at the top of the plot; from half of it on a path is drawn red"""
    box: float
    """m, half the width of the magnified views"""
    force: float
    """N, the largest hidden force"""
    ground: float
    """m, height of the ground that is drawn"""

    @classmethod
    def of(cls, panels: Sequence[FlightPanel]) -> Self:
        """Scales that fit the flights that did not fail, so that these stay legible."""
        well = [panel.worst for panel in panels if panel.failed is None] or [FAR]
        low = min(float(panel.reference[:, 2].min()) for panel in panels)
        clearance, step = (0.7, 0.5) if panels[0].follows else (6.0, 1.0)
        far = max(ceiling(max(well)), 0.05)
        return cls(
            max(max(panel.end for panel in panels), INSTANT_PERIOD_S),
            far,
            min(max(1.2 * max(well), 0.1), FAR),
            max(*(float(np.linalg.norm(panel.force, axis=1).max()) for panel in panels), 0.1),
            float(np.floor((low - clearance) / step) * step),
        )

    def colour(self, away: float) -> Colour:
        """Colour of a path at a distance in m from its course: teal, then amber, then red."""
        share = min(2 * away / self.far, 1.0)
        return blend(TEAL, AMBER, 2 * share) if share < 0.5 else blend(AMBER, RED, 2 * share - 1)


def draw_close_up(canvas: Canvas, panel: FlightPanel, i: int, scales: FlightScales) -> None:
    """The vehicle in its true size and attitude with its thrust, the hidden force, and the course around it.

    Along a reference the camera keeps the reference's point in the middle, so that all panels look from the same place
    and a vehicle beside the middle is an error. Else it moves with the vehicle and stops 4 m before the point.
    """
    place, turned, goal = panel.position[i], panel.attitude[i], panel.goal[i]
    moving = goal
    if not panel.follows:
        moving = panel.position[: i + 1]
        arrived = np.flatnonzero(moving[:, 0] > goal[0] - 4.0)
        moving = moving[arrived[0] if len(arrived) else i]
    view = FOLLOWING_VIEW if panel.follows else PASSING_VIEW
    pen = Pen(canvas, view.camera(moving, (canvas.width, canvas.height)))
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
        pen.dot(goal, 5, PAPER)
        pen.dot(goal, 3.5, INK)
    _draw_forces(pen, panel, i, scales)
    canvas.text(canvas.width - 10, canvas.height - 10, f"grid {step:g} m", 11, MUTED, align="right")


def draw_overview(canvas: Canvas, panel: FlightPanel, i: int, scales: FlightScales) -> None:
    """The whole course from afar, above its shadow on the ground."""
    course = panel.reference
    size, both = (canvas.width, canvas.height), np.concatenate([course, dropped(course, scales.ground)])
    pen = Pen(canvas, PinholeCamera.around(both, np.array([-0.55, -1.0, 0.6]), size, 16))
    span = float(np.ptp(course, axis=0).max())
    step = max(ceiling(span / 8), 0.5)
    pen.ground(scales.ground, (course.min(0) + course.max(0)) / 2, step, 8 * step)
    pen.line(dropped(course, scales.ground), blend(MUTED, TROUGH, 0.6))
    marks = (
        course[:: round(HIGHLIGHTED_S / INSTANT_PERIOD_S)] if panel.follows else np.linspace(course[0], course[-1], 9)
    )
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


def draw_box(
    canvas: Canvas, panel: FlightPanel, i: int, scales: FlightScales, axes: tuple[int, int], name: str
) -> None:
    """The surroundings of the goal, magnified.

    `axes` are the world axes to the right and up; a negative first one is reversed.
    """
    width, height = canvas.width, canvas.height
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
        canvas.line(seen(panel.earlier.position[: i + 1]), ROSE, 2)
    for part, away in _pieces(panel, i):
        canvas.line(seen(part), scales.colour(away), 2)
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
    # A scale bar.
    length = ceiling(scales.box / 2.5)
    canvas.box(8, height - 10, 8 + zoom * length, height - 8, MUTED)
    label = f"{100 * length:g} cm" if length < 1 else f"{length:g} m"
    canvas.text(14 + zoom * length, height - 5, label, 11, MUTED)
    canvas.frame(0, 0, width, height)


def _draw_course(pen: Pen, panel: FlightPanel, i: int, thickness: int) -> None:
    """The reference, its next second highlighted; or the straight line to the target."""
    if not panel.follows:
        pen.dashes(panel.reference[0], panel.reference[-1], blend(MUTED, TROUGH, 0.2), 0.5)
        return
    pen.line(panel.reference, blend(INK, TROUGH, 0.55), 1)
    pen.line(panel.reference[i : i + round(HIGHLIGHTED_S / INSTANT_PERIOD_S) + 1], INK, thickness)


def _draw_path(pen: Pen, panel: FlightPanel, i: int, scales: FlightScales, thickness: int) -> None:
    if panel.earlier is not None:
        pen.line(panel.earlier.position[: i + 1], ROSE, thickness - 1)
    for part, away in _pieces(panel, i):
        pen.line(part, scales.colour(away), thickness)


def _pieces(panel: FlightPanel, i: int) -> list[tuple[Floats, float]]:
    """The path up to an instant in pieces, each with its distance in m from the course, by which it is coloured.

    A path through a point is one piece, whose distance is the one by which it misses the point.
    """
    if not panel.follows:
        return [(panel.position[: i + 1], panel.worst)]
    return [(panel.position[k : min(k + 6, i + 1)], float(panel.away[k])) for k in range(0, i, 5)]


def _draw_target(pen: Pen, panel: FlightPanel, i: int, scales: FlightScales) -> None:
    """A ring in the y-z plane, FAR in radius, with a smaller one inside, on a pole."""
    goal = panel.goal[i]
    angle = np.linspace(0, 2 * np.pi, 49)
    ring = np.stack([0 * angle, np.cos(angle), np.sin(angle)], -1)
    pen.line(np.stack([goal - (0, 0, FAR), dropped(goal[None], scales.ground)[0]]), MUTED, 2)
    pen.line(goal + FAR * ring, INK, 3)
    pen.line(goal + 0.25 * FAR * ring, INK, 1)
    pen.dot(goal, 2.5, RED)
    seen, depth = pen.camera.project(goal[None] + (0, 0, 1.3 * FAR))
    if depth[0] > 0:
        label = f"{panel.away[i]:.1f} m" if panel.times[i] < panel.passed else "target"
        pen.canvas.text(seen[0, 0], seen[0, 1] - 4, label, 13, INK, bold=True, align="centre")


def _draw_forces(pen: Pen, panel: FlightPanel, i: int, scales: FlightScales) -> None:
    """The commanded thrust and the hidden force."""
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


def _disc(canvas: Canvas, place: Floats, radius: float, colour: Colour) -> None:
    """A disc with a white rim."""
    canvas.disc(place, radius + 1.5, PAPER)
    canvas.disc(place, radius, colour)


def _name(canvas: Canvas, name: str) -> None:
    canvas.box(1, 1, text_width(name, 11) + 14, 19, PAPER)
    canvas.text(7, 14, name, 11, MUTED)
    canvas.frame(0, 0, canvas.width, canvas.height)
