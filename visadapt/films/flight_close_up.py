"""The close-up of a film of flights: the vehicle in three dimensions, and the course and the ground around it."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection, PolyCollection
from matplotlib.colors import LinearSegmentedColormap
from matplotlib.lines import Line2D
from matplotlib.patches import FancyArrowPatch, Polygon

from visadapt.evaluation.scoring import FAR
from visadapt.films import widgets
from visadapt.films.camera import (
    FARTHEST_PX,
    FOLLOWING_CAMERA,
    PASSING_CAMERA,
    PASSING_STOPS_M,
    ChaseCamera,
    ground_grid,
)
from visadapt.films.flight_panel import INSTANT_PERIOD_S, FlightPanel, length_text
from visadapt.films.flight_scales import FlightScales, Seen, moving_line
from visadapt.films.vehicle_shapes import ROUND, drawn_parts, hull, vehicle_parts
from visadapt.films.widgets import BLUE, GROUND, HAIRLINE, INK, MUTED, PAPER, RED, SKY, VIOLET, Floats
from visadapt.systems import Quadrotor

PANEL_WIDTH, SCENE_TOP, SCENE_HEIGHT = 480, 40, 360
"""px"""
SECOND = round(1 / INSTANT_PERIOD_S)
"""instants in 1 s, for which the reference ahead is highlighted"""
ROTOR_THRUST_M_PER_N, PROPELLER_THRUST_M_PER_N = 0.045, 0.3
"""length of the arrow of a thrust, of a quadrotor and of an aeroplane"""


def close_up(page: Axes, panel: FlightPanel, scales: FlightScales) -> Callable[[int], None]:
    """The vehicle in its true size and attitude with its thrust, the hidden force, and the course around it."""
    camera, half = FOLLOWING_CAMERA if scales.follows else PASSING_CAMERA, np.array([PANEL_WIDTH, SCENE_HEIGHT]) / 2
    scene = widgets.framed(page, 0, SCENE_TOP, *(2 * half), xlim=(-half[0], half[0]), ylim=(-half[1], half[1]))
    _draw_sky(scene, camera, half)
    draw_grid = _grid(scene, half, scales)  # what is added later is drawn over what was added before
    draw_shadow = _shadow(scene)
    lines = _lines(scene, panel, scales)
    draw_path = scales.path(scene, panel)
    draw_vehicle = _vehicle(scene, panel)
    draw_forces = _forces(scene, panel, scales)
    draw_words = _words(scene, panel, scales)

    def move(i: int) -> None:
        moving = _camera_moves_with(panel, i, scales)

        def seen(points: Floats) -> Floats:
            return camera.project(points, moving)[0]

        draw_grid(seen, moving)
        for line, points in lines:
            line.set_data(*seen(points(i)).T)
        draw_path(seen, i)
        corners = draw_vehicle(lambda points: camera.project(points, moving), i)
        draw_shadow(seen(scales.dropped(corners)))
        draw_forces(seen, i)
        draw_words(i)

    return move


def _camera_moves_with(panel: FlightPanel, i: int, scales: FlightScales) -> Floats:
    """The point (3,) that the close-up's camera moves with at instant i: that of the reference; or the vehicle, up
    to PASSING_STOPS_M before the point that it flies through."""
    if scales.follows:
        return panel.goal[i]
    arrived = np.flatnonzero(panel.position[: i + 1, 0] > panel.goal[0, 0] - PASSING_STOPS_M)
    return panel.position[arrived[0] if len(arrived) else i]


def _grid(scene: Axes, half: Floats, scales: FlightScales) -> Callable[[Seen, Floats], None]:
    """The grid on the ground around what the camera moves with; `half` (2,) px is half the scene's size."""
    step = 1.0 if scales.follows else 5.0
    scene.text(half[0] - 10, 10 - half[1], f"grid {step:g} m", fontsize=11, color=MUTED, ha="right")
    grid, colours = ground_grid(step)
    tiles: Any = scene.add_collection(LineCollection([], animated=True), autolim=False)

    def draw(seen: Seen, moving: Floats) -> None:
        pieces: Any = seen(grid + np.array([*np.round(moving[:2] / step) * step, scales.ground]))
        visible = np.isfinite(pieces).all((1, 2)) & (np.abs(pieces) < half).all(-1).any(-1)
        tiles.set(segments=pieces[visible], colors=colours[visible])

    return draw


def _lines(scene: Axes, panel: FlightPanel, scales: FlightScales) -> list[tuple[Line2D, Callable[[int], Floats]]]:
    """The course, the goal and their shadows: lines, and the points (n, 3) of each at an instant."""
    position, goal = panel.position, panel.goal
    lines: list[tuple[Line2D, Callable[[int], Floats]]] = [
        (moving_line(scene, HAIRLINE, 1), lambda i: scales.dropped(panel.reference)),
        (moving_line(scene, MUTED, 1, alpha=0.5), lambda i: scales.dropped(position[: i + 1])),
        (moving_line(scene, MUTED, 1, linestyle="--"), lambda i: scales.plumb(position[i])),
        (moving_line(scene, MUTED, 1, linestyle="-" if scales.follows else "--"), lambda i: panel.reference),
    ]
    if scales.follows:
        return [
            *lines,
            (moving_line(scene, INK, 2), lambda i: panel.reference[i : i + SECOND + 1]),
            (moving_line(scene, RED, 2, zorder=4), lambda i: np.stack([position[i], goal[i]])),
            (moving_line(scene, INK, 0, marker="o", markersize=8, mec=PAPER, zorder=4), lambda i: goal[i : i + 1]),
        ]
    ring = np.column_stack([np.zeros(len(ROUND)), ROUND])
    return [
        *lines,
        (moving_line(scene, MUTED, 2), lambda i: scales.plumb(goal[0] - (0, 0, FAR))),
        (moving_line(scene, INK, 3), lambda i: goal[0] + FAR * ring),
        (moving_line(scene, INK, 1), lambda i: goal[0] + 0.25 * FAR * ring),
        (moving_line(scene, RED, 0, marker="o", markersize=5), lambda i: goal[:1]),
    ]


def _forces(scene: Axes, panel: FlightPanel, scales: FlightScales) -> Callable[[Seen, int], None]:
    """Arrows of the commanded thrust and of the hidden force."""
    show_thrust, show_force = _arrow(scene, BLUE), _arrow(scene, VIOLET)
    longest = 0.45 if scales.follows else 1.2  # m, of the largest hidden force

    def draw(seen: Seen, i: int) -> None:
        position = panel.position[i]
        newtons, per_newton = _thrust(panel, i)
        show_thrust(seen(position + np.outer([0, newtons], per_newton)), f"thrust {newtons:.1f} N")
        arrow = longest / scales.most_force * panel.force[i]
        show_force(seen(position + np.outer([0, 1], arrow)), f"{np.linalg.norm(panel.force[i]):.2f} N")

    return draw


def _words(scene: Axes, panel: FlightPanel, scales: FlightScales) -> Callable[[int], None]:
    """How far off the vehicle is, or how far off it passed the point; from a failure on, what failed."""
    distance, show_failure = widgets.note(scene, 22), widgets.banner(scene)

    def draw(i: int) -> None:
        failed = panel.failed is not None and panel.times[i] >= panel.failed - 1e-6
        show_failure(panel.failure(i) if failed else "", panel.lost(i))
        off = panel.away[i] if scales.follows else panel.worst
        words = f"{length_text(off)} off" if scales.follows else f"passed {length_text(off)} off"
        distance.set(text=words, color=scales.colours(off))
        distance.set_visible(not failed and (scales.follows or panel.times[i] >= panel.passed))

    return draw


def _draw_sky(scene: Axes, camera: ChaseCamera, half: Floats) -> None:
    """The ground, which fades into the sky over the 150 px below the horizon; `half` (2,) px is half the scene's
    size."""
    ahead = np.subtract(camera.looks_at, camera.position)
    horizon = camera.project(1e6 * ahead * (1, 1, 0), np.zeros(3))[0][1]
    rows = ((horizon - np.linspace(half[1], -half[1], SCENE_HEIGHT)) / 150).clip(0, 1)[:, None]
    shades = LinearSegmentedColormap.from_list("ground", [SKY, GROUND])
    scene.imshow(rows, shades, vmin=0, vmax=1, extent=(-half[0], half[0], -half[1], half[1]), aspect="auto")


def _shadow(scene: Axes) -> Callable[[Floats], None]:
    """The vehicle's shadow around points (n, 2) px; none where one of them is not seen."""
    shadow = Polygon(np.zeros((3, 2)), facecolor=MUTED, alpha=0.16, animated=True)
    scene.add_patch(shadow)

    def draw(points: Floats) -> None:
        shadow.set_visible(bool(np.isfinite(points).all()))
        if shadow.get_visible():
            shadow.set_xy(hull(points))

    return draw


def _vehicle(scene: Axes, panel: FlightPanel) -> Callable[[Callable[[Floats], tuple[Floats, Floats]], int], Floats]:
    """The vehicle; what is returned draws it as a camera projects it, and gives its corners (n, 3)."""
    parts = vehicle_parts(panel.vehicle)
    vehicle = scene.add_collection(PolyCollection([], animated=True, zorder=3), autolim=False)

    def draw(project: Callable[[Floats], tuple[Floats, Floats]], i: int) -> Floats:
        corners, looks = drawn_parts(parts, panel.position[i], panel.attitude[i], project)
        vehicle.set(**looks)
        return corners

    return draw


def _thrust(panel: FlightPanel, i: int) -> tuple[float, Floats]:
    """The commanded thrust in N, and the vector (3,) by which 1 N is drawn, m/N."""
    vehicle, command = panel.vehicle, panel.command(i)
    share = 0.0 if command is None else (float(command[0]) + 1) / 2
    if isinstance(vehicle, Quadrotor):
        low, high = (float(vehicle.mass) * float(limit) for limit in (vehicle.min_thrust, vehicle.max_thrust))
        return low + (high - low) * share, ROTOR_THRUST_M_PER_N * panel.attitude[i][:, 2]
    return float(getattr(vehicle, "max_thrust", 1.0)) * share, PROPELLER_THRUST_M_PER_N * panel.attitude[i][:, 0]


def _arrow(scene: Axes, colour: str) -> Callable[[Floats, str], None]:
    """An arrow with a label at its tip; what is returned sets tail and tip (2, 2) in px, and the label."""
    arrow = FancyArrowPatch((0, 0), (1, 1), color=colour, shrinkA=0, shrinkB=0, zorder=5, animated=True)
    arrow.set_arrowstyle("simple,head_length=13,head_width=12,tail_width=4")
    scene.add_patch(arrow)
    text = scene.text(0, 0, "", fontsize=12, color=colour, zorder=6, clip_on=True, animated=True)
    text.set(fontweight="bold", bbox={"facecolor": PAPER, "alpha": 0.7, "pad": 2})

    def show(ends: Floats, label: str) -> None:
        (x, y), visible = ends[1] - ends[0], bool(8 < np.linalg.norm(ends[1] - ends[0]) < FARTHEST_PX)
        arrow.set_visible(visible)
        text.set_visible(visible)
        if visible:
            arrow.set_positions(*ends)
            text.set(text=label, position=ends[1] + np.copysign(8, (x, y)))
            text.set(ha="left" if x > 0 else "right", va="bottom" if y > 0 else "top")

    return show
