"""Films of flights: a close-up in three dimensions, the surroundings of the goal magnified, the distance over time.

    panels = [FlightPanel("source", run, flight.system, target.task, target.first[0]), ...]
    FlightFilm(panels).write("film.mp4")

All panels share one clock and one set of scales. A path is teal on its course and red far off it; a flight that failed
is marked from that moment on.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection, PolyCollection
from matplotlib.colors import LinearSegmentedColormap
from matplotlib.lines import Line2D
from matplotlib.patches import FancyArrowPatch, Polygon

from visadapt.evaluation.scoring import FAR
from visadapt.films import widgets
from visadapt.films.camera import FARTHEST_PX, FOLLOWING_CAMERA, PASSING_CAMERA, ChaseCamera, axes_towards, ground_grid
from visadapt.films.film import Film
from visadapt.films.flight_panel import INSTANT_PERIOD_S, FlightPanel, length
from visadapt.films.vehicle_shapes import ROUND, drawn_parts, hull, vehicle_parts
from visadapt.films.widgets import AMBER, BLUE, GROUND, HAIRLINE, INK, MUTED, PAPER, RED, SKY, TEAL, VIOLET, Floats
from visadapt.systems import Quadrotor

PANEL_WIDTH, SCENE_TOP, SCENE_HEIGHT, BOX_TOP, BOX_SIDE = 480, 40, 360, 414, 152
"""px"""
READINGS_TOP, BARS_TOP, CHART_TOP = 578, 640, 706
"""px"""
COMMAND_LABELS = {"rate_x": "roll rate", "rate_y": "pitch rate", "rate_z": "yaw rate"}
"""Labels of the commands whose names alone would not say what they are."""
SECOND = round(1 / INSTANT_PERIOD_S)
"""instants in 1 s, for which the reference ahead is highlighted"""
OVERVIEW_DIRECTION = (0.55, 1.0, -0.6)
"""direction of view of the whole course, in world axes"""
Seen = Callable[[Floats], Floats]
"""Points (..., 3) in m to where they are seen (..., 2)."""
ERROR_COLOURS = LinearSegmentedColormap.from_list("error", [TEAL, AMBER, RED])


class FlightFilm(Film):
    """Flights side by side; the last instant is shown for another 1.5 s.

    Raises:
        ValueError: no panels, or flights along a reference beside flights through a point.
    """

    panel_width, panel_height = PANEL_WIDTH, CHART_TOP + widgets.CHART_HEIGHT

    def __init__(self, panels: Sequence[FlightPanel]) -> None:
        super().__init__(panels, 0.04)
        if len({panel.follows for panel in panels}) > 1:
            raise ValueError("flights along a reference and through a point share no scales: film them apart")
        self.follows = panels[0].follows
        self.duration = max(max(panel.end for panel in panels), INSTANT_PERIOD_S)
        # The other scales fit the flights that did not fail, so that these stay legible.
        worst = max([panel.worst for panel in panels if panel.failed is None] or [FAR])
        self.far = max(widgets.ceiling(worst), 0.05)
        """m, distance at the top of the chart; from half of it on a path is drawn red"""
        self.box = min(max(1.2 * worst, 0.1), FAR)
        """m, half the width of the magnified view"""
        self.most_force = max(*(float(np.linalg.norm(panel.force, axis=1).max()) for panel in panels), 0.1)
        """N"""
        low = min(float(panel.reference[:, 2].min()) for panel in panels)
        self.ground = float(np.floor(2 * low - 1.4) / 2) if self.follows else float(np.floor(low - 6.0))
        """m, height of the ground that is drawn"""

    @property
    def times(self) -> list[float]:
        return [k * self.period for k in range(round((self.duration + 1.5) / self.period) + 1)]

    def draw_panel(self, page: Axes, panel: FlightPanel) -> Callable[[float], None]:
        set_clock = widgets.headline(page, panel.title)
        views = (self._close_up, self._overview, self._box, self._numbers, self._chart)
        moves = [view(page, panel) for view in views]

        def move(t: float) -> None:
            i = min(max(int(t / INSTANT_PERIOD_S + 1e-6), 0), len(panel.times) - 1)
            set_clock(float(panel.times[i]))
            for each in moves:
                each(i)

        return move

    def _close_up(self, page: Axes, panel: FlightPanel) -> Callable[[int], None]:
        """The vehicle in its true size and attitude with its thrust, the hidden force, and the course around it."""
        camera, half = FOLLOWING_CAMERA if self.follows else PASSING_CAMERA, np.array([PANEL_WIDTH, SCENE_HEIGHT]) / 2
        scene = widgets.framed(page, 0, SCENE_TOP, *(2 * half), xlim=(-half[0], half[0]), ylim=(-half[1], half[1]))
        _draw_sky(scene, camera, half)
        draw_grid = self._grid(scene, half)  # what is added later is drawn over what was added before
        draw_shadow = _shadow(scene)
        lines = self._lines(scene, panel)
        draw_path = self._path(scene, panel)
        draw_vehicle = _vehicle(scene, panel)
        draw_forces = self._forces(scene, panel)
        draw_words = self._words(scene, panel)

        def move(i: int) -> None:
            moving = self._camera_moves_with(panel, i)

            def seen(points: Floats) -> Floats:
                return camera.project(points, moving)[0]

            draw_grid(seen, moving)
            for line, points in lines:
                line.set_data(*seen(points(i)).T)
            draw_path(seen, i)
            corners = draw_vehicle(lambda points: camera.project(points, moving), i)
            draw_shadow(seen(self._dropped(corners)))
            draw_forces(seen, i)
            draw_words(i)

        return move

    def _camera_moves_with(self, panel: FlightPanel, i: int) -> Floats:
        """The point (3,) that the close-up's camera moves with at instant i: that of the reference; or the vehicle, up
        to 4 m before the point that it flies through."""
        if self.follows:
            return panel.goal[i]
        arrived = np.flatnonzero(panel.position[: i + 1, 0] > panel.goal[0, 0] - 4.0)
        return panel.position[arrived[0] if len(arrived) else i]

    def _grid(self, scene: Axes, half: Floats) -> Callable[[Seen, Floats], None]:
        """The grid on the ground around what the camera moves with; `half` (2,) px is half the scene's size."""
        step = 1.0 if self.follows else 5.0
        scene.text(half[0] - 10, 10 - half[1], f"grid {step:g} m", fontsize=11, color=MUTED, ha="right")
        grid, colours = ground_grid(step)
        tiles: Any = scene.add_collection(LineCollection([], animated=True), autolim=False)

        def draw(seen: Seen, moving: Floats) -> None:
            pieces: Any = seen(grid + np.array([*np.round(moving[:2] / step) * step, self.ground]))
            visible = np.isfinite(pieces).all((1, 2)) & (np.abs(pieces) < half).all(-1).any(-1)
            tiles.set(segments=pieces[visible], colors=colours[visible])

        return draw

    def _lines(self, scene: Axes, panel: FlightPanel) -> list[tuple[Line2D, Callable[[int], Floats]]]:
        """The course, the goal and their shadows: lines, and the points (n, 3) of each at an instant."""
        place, goal = panel.position, panel.goal
        lines: list[tuple[Line2D, Callable[[int], Floats]]] = [
            (_line(scene, HAIRLINE, 1), lambda i: self._dropped(panel.reference)),
            (_line(scene, MUTED, 1, alpha=0.5), lambda i: self._dropped(place[: i + 1])),
            (_line(scene, MUTED, 1, linestyle="--"), lambda i: self._plumb(place[i])),
            (_line(scene, MUTED, 1, linestyle="-" if self.follows else "--"), lambda i: panel.reference),
        ]
        if self.follows:
            return [
                *lines,
                (_line(scene, INK, 2), lambda i: panel.reference[i : i + SECOND + 1]),
                (_line(scene, RED, 2, zorder=4), lambda i: np.stack([place[i], goal[i]])),
                (_line(scene, INK, 0, marker="o", markersize=8, mec=PAPER, zorder=4), lambda i: goal[i : i + 1]),
            ]
        ring = np.column_stack([np.zeros(len(ROUND)), ROUND])
        return [
            *lines,
            (_line(scene, MUTED, 2), lambda i: self._plumb(goal[0] - (0, 0, FAR))),
            (_line(scene, INK, 3), lambda i: goal[0] + FAR * ring),
            (_line(scene, INK, 1), lambda i: goal[0] + 0.25 * FAR * ring),
            (_line(scene, RED, 0, marker="o", markersize=5), lambda i: goal[:1]),
        ]

    def _forces(self, scene: Axes, panel: FlightPanel) -> Callable[[Seen, int], None]:
        """Arrows of the commanded thrust and of the hidden force."""
        show_thrust, show_force = _arrow(scene, BLUE), _arrow(scene, VIOLET)
        longest = 0.45 if self.follows else 1.2  # m, of the largest hidden force

        def draw(seen: Seen, i: int) -> None:
            place = panel.position[i]
            newtons, way = _thrust(panel, i)
            show_thrust(seen(place + np.outer([0, newtons], way)), f"thrust {newtons:.1f} N")
            way = longest / self.most_force * panel.force[i]
            show_force(seen(place + np.outer([0, 1], way)), f"{np.linalg.norm(panel.force[i]):.2f} N")

        return draw

    def _words(self, scene: Axes, panel: FlightPanel) -> Callable[[int], None]:
        """How far off the vehicle is, or how far off it passed the point; from a failure on, what failed."""
        distance, show_failure = widgets.note(scene, 22), widgets.banner(scene)

        def draw(i: int) -> None:
            failed = panel.failed is not None and panel.times[i] >= panel.failed - 1e-6
            show_failure(panel.failure(i) if failed else "", panel.lost(i))
            off = panel.away[i] if self.follows else panel.worst
            words = f"{length(off)} off" if self.follows else f"passed {length(off)} off"
            distance.set(text=words, color=self._colours(off))
            distance.set_visible(not failed and (self.follows or panel.times[i] >= panel.passed))

        return draw

    def _overview(self, page: Axes, panel: FlightPanel) -> Callable[[int], None]:
        """The whole course from afar, above its shadow on the ground."""
        course, place, size = panel.reference, panel.position, np.array([PANEL_WIDTH - BOX_SIDE - 12, BOX_SIDE])
        across = axes_towards(OVERVIEW_DIRECTION)[:2].T
        view = widgets.framed(page, 0, BOX_TOP, *size, facecolor=GROUND)
        both = np.concatenate([course, self._dropped(course)]) @ across
        low, high = both.min(0), both.max(0)
        half = ((high - low) / (size - 36)).max() * size / 2
        (left, bottom), (right, top) = (low + high) / 2 - half, (low + high) / 2 + half
        view.set(xlim=(left, right), ylim=(bottom, top))
        step = max(widgets.ceiling(float(np.ptp(course, axis=0).max()) / 8), 0.5)
        grid, colours = ground_grid(step)
        view.add_collection(
            LineCollection(list((grid + self._dropped(course.mean(0))) @ across), colors=colours), autolim=False
        )
        marks = course[::SECOND] if self.follows else np.linspace(course[0], course[-1], 9)
        view.add_collection(LineCollection([self._plumb(mark) @ across for mark in marks], colors=HAIRLINE))
        for points, colour in ((self._dropped(course), MUTED), (course, INK)):
            view.plot(*(points @ across).T, color=colour, linewidth=1, alpha=0.6)
        draw_path, plumb = self._path(view, panel), _line(view, MUTED, 1)
        dot = _line(view, BLUE, 0, marker="o", markersize=8)
        _name(view, f"whole course, grid {step:g} m")

        def move(i: int) -> None:
            draw_path(lambda points: points @ across, i)
            plumb.set_data(*(self._plumb(place[i]) @ across).T)
            dot.set_data(*(place[i : i + 1] @ across).T)

        return move

    def _box(self, page: Axes, panel: FlightPanel) -> Callable[[int], None]:
        """The surroundings of the goal, magnified: seen from above, or from behind the point."""
        side, limits = self.box, (-self.box, self.box)
        view = widgets.framed(
            page, PANEL_WIDTH - BOX_SIDE, BOX_TOP, BOX_SIDE, BOX_SIDE, xlim=limits, ylim=limits, facecolor=SKY
        )
        bar = widgets.ceiling(side / 2.5)
        view.plot([-0.9 * side, -0.9 * side + bar], [-0.88 * side] * 2, color=MUTED, linewidth=2)
        view.text(-0.82 * side + bar, -0.92 * side, length(bar, 0), fontsize=11, color=MUTED)
        _name(view, "from above" if self.follows else "target, from behind")
        course, draw_path, error = _line(view, MUTED, 1), self._path(view, panel), _line(view, RED, 2)
        view.plot(0, 0, "o", color=INK, markersize=8, mec=PAPER)
        dot = _line(view, INK, 0, marker="o", markersize=10, mec=PAPER)
        columns, signs = ([0, 1], (1, 1)) if self.follows else ([1, 2], (-1, 1))

        def move(i: int) -> None:
            def seen(points: Floats) -> Floats:
                return (points - panel.goal[i])[..., columns] * signs

            course.set_data(*seen(panel.reference).T)
            draw_path(seen, i)
            over = self.follows or panel.times[i] >= panel.passed
            x, y = seen(panel.position[i] if self.follows else panel.nearest).clip(-0.9 * side, 0.9 * side)
            error.set(data=((0, x), (0, y)), visible=over)
            dot.set(data=([x], [y]), mfc=self._colours(panel.away[i] if self.follows else panel.worst), visible=over)

        return move

    def _numbers(self, page: Axes, panel: FlightPanel) -> Callable[[int], None]:
        """Speed, distance, score and hidden force; the commands."""
        names = ("off the reference", "mean so far") if self.follows else ("to the target", "nearest so far")
        places = ((0, "speed"), (106, names[0]), (240, names[1]), (362, "hidden force"))
        readings = [widgets.reading(page, left, READINGS_TOP, name) for left, name in places]
        readings[3].set_color(VIOLET)
        half = PANEL_WIDTH / 2
        bars = []
        for k, variable in enumerate(panel.vehicle.actions):
            label, left, middle = COMMAND_LABELS.get(variable.name, variable.name), k % 2 * (half + 7), k // 2 * 36
            bars.append(widgets.bar(page, left, BARS_TOP + middle, half - 7, label, 1.0, "", BLUE))

        def move(i: int) -> None:
            force = "\N{EN DASH}" if panel.run.force is None else f"{np.linalg.norm(panel.force[i]):.2f} N"
            words = (f"{panel.speed[i]:.2f} m/s", length(panel.away[i]), length(panel.score[i]), force)
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
        levels = np.linspace(0, self.far, 3) if self.follows else 10.0 ** np.arange(-3, 3)
        if self.follows:
            axes.set_ylim(-0.05 * self.far, 1.05 * self.far)
        else:
            axes.set(yscale="log", ylim=(8e-4, 150))
            axes.minorticks_off()
        axes.set_yticks(levels, [length(level, None) for level in levels])
        score = "mean {}" if self.follows else "nearest {}"
        draw = widgets.trace(axes, panel.times, panel.away, panel.score, lambda metres: score.format(length(metres)))
        return lambda i: draw(i, panel.lost(i))

    def _path(self, axes: Axes, panel: FlightPanel) -> Callable[[Seen, int], object]:
        """The path, coloured by its distance from the reference, or by how far off it passes the point."""
        colours = self._colours(panel.away if self.follows else np.full(len(panel.times), panel.worst))
        pieces = np.stack([panel.position[:-1], panel.position[1:]], 1)
        lines = LineCollection([], linewidths=3, capstyle="round", animated=True, zorder=2)
        axes.add_collection(lines, autolim=False)
        return lambda seen, i: lines.set(segments=seen(pieces[:i]), colors=colours[:i])

    def _colours(self, away: Any) -> Any:
        """Colours of a path at distances in m from its course."""
        return ERROR_COLOURS(2 * away / self.far)

    def _dropped(self, points: Floats) -> Floats:
        """Points (..., 3) moved straight down, or up, to the ground."""
        return np.where([True, True, False], points, self.ground)

    def _plumb(self, point: Floats) -> Floats:
        """(2, 3), from a point to the ground."""
        return np.stack([point, self._dropped(point)])


def _draw_sky(scene: Axes, camera: ChaseCamera, half: Floats) -> None:
    """The ground, which fades into the sky over the 150 px below the horizon; `half` (2,) px is half the scene's
    size."""
    ahead = np.subtract(camera.looks_at, camera.place)
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
    """The commanded thrust in N, and the way (3,) in which it is drawn, m/N."""
    vehicle, command = panel.vehicle, panel.command(i)
    share = 0.0 if command is None else (float(command[0]) + 1) / 2
    if isinstance(vehicle, Quadrotor):
        low, high = (float(vehicle.mass) * float(limit) for limit in (vehicle.min_thrust, vehicle.max_thrust))
        return low + (high - low) * share, 0.045 * panel.attitude[i][:, 2]
    return float(getattr(vehicle, "max_thrust", 1.0)) * share, 0.3 * panel.attitude[i][:, 0]


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


def _line(axes: Axes, colour: str, width: float, **properties: Any) -> Line2D:
    return axes.plot([], [], color=colour, linewidth=width, animated=True, **properties)[0]


def _name(view: Axes, name: str) -> None:
    box = {"facecolor": PAPER, "pad": 4}
    view.annotate(name, (0, 1), (6, -6), "axes fraction", "offset points", fontsize=11, color=MUTED, va="top", bbox=box)
