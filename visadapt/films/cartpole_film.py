"""Films of cart-poles: the scene, numbers, command and disturbance, and the cart's speed so far.

    film = CartPoleFilm([CartPolePanel("before", run), CartPolePanel("after", other)], period=0.05)
    film.write("film.mp4")

All panels share one clock; one whose episode has ended stays at its last frame. Where a pole is to swing up, a cone
within 10 degrees of upright travels with the cart, and the pole's last poses stay behind it and fade.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import PolyCollection
from matplotlib.colors import to_rgba_array
from matplotlib.patches import Circle, FancyArrowPatch, Polygon, Rectangle, Wedge
from numpy.typing import NDArray

from renderers import DrawnCartPole
from visadapt.films import widgets
from visadapt.films.film import Film
from visadapt.films.widgets import BLUE, INK, MINUS, MUTED, ORANGE, TEAL, TROUGH, Floats
from visadapt.targets.rollout import Run

PANEL_WIDTH, SCENE_TOP, SCENE_HEIGHT, NUMBERS_TOP, CHART_TOP = 480, 40, 400, 462, 594
"""px"""
EARLIER_POSES, EARLIER_POSES_EVERY = 16, 2
"""Poses that a pole that swings up leaves behind, and the rows from one to the next."""
UPRIGHT_RAD = math.radians(10)
"""A pole that swings up counts as up to this angle to either side of upright."""


@dataclass(frozen=True)
class CartPolePanel:
    """A run of a cart-pole.

    Raises:
        ValueError: pictures that do not fit the run, or a run without states.
    """

    title: str
    run: Run
    pictures: NDArray[np.uint8] | None = None
    """(T, H, W) grey or (T, H, W, 3) red, green, blue, scaled to fit the scene; None draws the states"""
    drawn: DrawnCartPole = field(default_factory=DrawnCartPole)
    """sizes of what is drawn, and the part of the track that is shown"""
    angle_limit: float = 0.3
    """rad; an episode that ended early counts as a fall if its last angle is beyond this. Infinite means a swing-up,
    for which the track is shown as far as the carts go"""
    position_limit: float | None = None
    """m; an episode that ended early without a fall counts as having left the frame if its last position is beyond
    this. None: the limit is as far as `drawn` shows; infinite: there is no frame"""

    def __post_init__(self) -> None:
        if self.run.episode.state is None:
            raise ValueError(f"panel {self.title!r}: the run has no states to show")
        if self.pictures is not None:
            rows, kind, shape = len(self.run.episode.time), self.pictures.dtype, self.pictures.shape
            if kind != np.uint8 or len(shape) not in (3, 4) or shape[3:] not in ((), (3,)):
                raise ValueError(
                    f"panel {self.title!r}: the pictures must be uint8 (T, H, W) or (T, H, W, 3), got {kind} {shape}"
                )
            if len(self.pictures) != rows:
                raise ValueError(f"panel {self.title!r}: the run has {rows} rows, but there are {shape[0]} pictures")

    @cached_property
    def state(self) -> Floats:
        """(T, 4), SI units; the angle between -pi and pi"""
        assert self.run.episode.state is not None
        x, x_dot, theta, theta_dot = self.run.episode.state.T
        return np.stack([x, x_dot, np.arctan2(np.sin(theta), np.cos(theta)), theta_dot], -1)

    @property
    def speed(self) -> Floats:
        """(T,) m/s, |x_dot|"""
        return np.abs(self.state[:, 1])

    @property
    def end(self) -> float:
        """The time of the last row, s"""
        return float(self.run.episode.time[-1])

    @property
    def swings_up(self) -> bool:
        """Whether the pole may start at any angle"""
        return math.isinf(self.angle_limit)

    @property
    def up_from(self) -> int:
        """The row from which the pole stays within UPRIGHT_RAD to the end; T where it is not up at the end."""
        outside = np.flatnonzero(np.abs(self.state[:, 2]) >= UPRIGHT_RAD)
        return int(outside[-1]) + 1 if len(outside) else 0

    def failure(self, row: int, due: float) -> str:
        """How the episode ended early, or that the pole is not up when it is due, s; empty up to that row."""
        time = self.run.episode.time
        if not self.run.survived and row == len(time) - 1:
            x, _, theta, _ = abs(self.state[-1])
            limit = self.drawn.camera.reach if self.position_limit is None else self.position_limit
            how = "FELL" if theta > self.angle_limit else "LEFT THE FRAME" if x > limit else "ENDED"
            return f"{how} at t = {self.end:.2f} s"
        late = self.swings_up and time[row] >= due and self.up_from > widgets.last_row(time, due)
        return f"not up at {due:g} s" if late else ""


class CartPoleFilm(Film):
    """Cart-poles side by side until the longest run has ended.

    Args:
        panels: at least one.
        period: s between frames.
        due: s, the time by which poles that swing up must be up.

    Raises:
        ValueError: no panels, or a period that is not positive.
    """

    panel_width, panel_height = PANEL_WIDTH, CHART_TOP + widgets.CHART_HEIGHT

    def __init__(self, panels: Sequence[CartPolePanel], period: float, due: float = 5.0) -> None:
        super().__init__(panels, period)
        self.due, self.duration = due, max(max(panel.end for panel in panels), 1e-3)
        fastest = max(float(panel.speed.max()) for panel in panels)
        upright = [float(panel.speed.max()) for panel in panels if panel.run.survived]
        self.full_speed = max(widgets.ceiling(min(fastest, max(*upright, 0.5)) if upright else fastest), 0.1)
        """m/s, at the top of all charts; the speed of a fall may exceed it, so that the other runs stay legible"""
        forces = [float(np.abs(panel.run.force).max()) for panel in panels if panel.run.force is not None]
        self.full_force = max(widgets.ceiling(max(forces, default=0.0)), 1.0)
        """N, at the end of all force bars"""
        x, _, theta, _ = np.concatenate([panel.state for panel in panels]).T
        length = panels[0].drawn.pole_length
        wide = float(np.abs([x, x + length * np.sin(theta)]).max()) + 0.4
        self.half_width = max(wide, 1.15 * length * PANEL_WIDTH / SCENE_HEIGHT)
        """m to either side of the middle, such that neither carts nor poles that swing up leave the scene"""
        self.roams = any(bool((np.abs(panel.state[:-1, 0]) > panel.drawn.camera.reach).any()) for panel in panels)
        """whether a cart went on beyond what `drawn` shows, so that the track is shown as far as the carts go"""

    @property
    def times(self) -> list[float]:
        return [i * self.period for i in range(round(self.duration / self.period) + 1)]

    def draw_panel(self, page: Axes, panel: CartPolePanel) -> Callable[[float], None]:
        time, full = panel.run.episode.time, self.full_speed
        set_clock, set_numbers = widgets.headline(page, panel.title), self._numbers(page, panel)
        scene = widgets.framed(page, 0, SCENE_TOP, PANEL_WIDTH, SCENE_HEIGHT)
        move_scene = self._states(scene, panel) if panel.pictures is None else _picture(scene, panel.pictures)
        show_failure, words = widgets.banner(scene), widgets.note(scene, 15, TEAL)
        axes = widgets.chart(page, CHART_TOP, "cart speed, m/s", self.duration)
        axes.set(ylim=(-0.05 * full, 1.05 * full), yticks=np.linspace(0, full, 3))
        draw_speed = widgets.trace(axes, time, panel.speed, widgets.running_mean(panel.speed), "mean {:.2f} m/s".format)

        def move(t: float) -> None:
            row = widgets.last_row(time, t)
            failure, last = panel.failure(row, self.due), row == len(time) - 1
            ended = last and not panel.run.survived
            set_clock(panel.end if ended else t)
            for part in (move_scene, set_numbers, draw_speed):
                part(row, ended)
            show_failure(failure, ended)
            ending = ""
            if panel.swings_up and row >= panel.up_from and not failure:
                ending = f"up since {time[panel.up_from]:.2f} s"
            elif last and not panel.swings_up and not failure and panel.end < self.duration - 1e-6:
                ending = f"ends upright at t = {panel.end:.1f} s"
            words.set_text(ending)

        return move

    def _states(self, scene: Axes, panel: CartPolePanel) -> Callable[[int, bool], None]:
        """The track with its metres, cart and pole, and the disturbance as an arrow; or the cone and earlier poses."""
        sizes, camera = panel.drawn, panel.drawn.camera
        left, bottom, wide = -self.half_width, -self.half_width * SCENE_HEIGHT / PANEL_WIDTH, 2 * self.half_width
        if not panel.swings_up and not self.roams:
            left, bottom = (-0.5 - camera.column) / camera.scale, (camera.row - camera.height + 0.5) / camera.scale
            wide = camera.width / camera.scale
        scene.set(xlim=(left, left + wide), ylim=(bottom, bottom + wide * SCENE_HEIGHT / PANEL_WIDTH))
        scene.set_xticks(np.arange(math.ceil(left), left + wide))
        scene.xaxis.set_major_formatter("{x:g} m")
        scene.tick_params("x", length=0, labelsize=11, labelcolor=MUTED)
        scene.grid(axis="x")
        base = sizes.cart_height + 0.04
        scene.axhspan(-base - 0.03, -base, color=MUTED)
        cone = Wedge((0, 0), 1.08 * sizes.pole_length, 80, 100, alpha=0.3, visible=panel.swings_up)
        earlier = PolyCollection(
            [], facecolors=to_rgba_array([BLUE] * EARLIER_POSES, np.linspace(0.28, 0.02, EARLIER_POSES))
        )
        cart = Rectangle((0, -base), sizes.cart_width, base, facecolor=INK)
        pole = Polygon(sizes.pole(0.0, 0.0))
        hinge = Circle((0, 0), 0.05, facecolor=TROUGH)
        arrow = FancyArrowPatch((0, 0), (1, 0), color=ORANGE, shrinkA=0, shrinkB=0)
        arrow.set_arrowstyle("simple,head_length=18,head_width=22,tail_width=8")
        for artist in (cone, earlier, cart, pole, hinge, arrow):
            scene.add_artist(artist)
            artist.set(animated=True, zorder=2)

        def move(row: int, ended: bool) -> None:
            x, _, theta, _ = panel.state[row]
            up = panel.swings_up and abs(theta) < UPRIGHT_RAD
            cone.set(center=(x, 0), facecolor=TEAL if up else MUTED)
            cart.set_x(x - sizes.cart_width / 2)
            pole.set(xy=sizes.pole(x, float(theta)), facecolor=TEAL if up else BLUE)
            hinge.set_center((x, 0))
            if panel.swings_up:
                rows = [row - EARLIER_POSES_EVERY * k for k in range(1, EARLIER_POSES + 1)]
                earlier.set_verts([sizes.pole(*panel.state[each, [0, 2]].tolist()) for each in rows if each >= 0])
            force = 0.0 if panel.run.force is None else float(panel.run.force[row]) / self.full_force
            tip = x - math.copysign(sizes.cart_width / 2 + 0.03, force)
            arrow.set_positions((tip - 0.19 * wide * force, -base / 2), (tip, -base / 2))
            arrow.set_visible(abs(force) > 0.02 and not ended)

        return move

    def _numbers(self, page: Axes, panel: CartPolePanel) -> Callable[[int, bool], None]:
        """State, command and disturbance; beside them the frame that the policy sees, unless it is the scene itself."""
        episode, room, top = panel.run.episode, PANEL_WIDTH, NUMBERS_TOP
        parts: list[Callable[[int, bool], None]] = []
        if episode.frame is not None and episode.frame is not panel.pictures:
            room -= 150
            parts.append(_picture(widgets.framed(page, room + 30, top, 120, 100), episode.frame))
            page.text(PANEL_WIDTH, top + 117, "the policy's view", fontsize=12, color=MUTED, ha="right")
        names = ("position, m", "speed, m/s", "angle, \N{DEGREE SIGN}")
        readings = [widgets.reading(page, k * room / 3, top, name) for k, name in enumerate(names)]
        set_command = widgets.bar(page, 0, top + 66, room, "command", 1.0, "", BLUE)
        set_force = widgets.bar(page, 0, top + 102, room, "force", self.full_force, " N", ORANGE)

        def show(row: int, ended: bool) -> None:
            x, x_dot, theta = panel.state[row, :3]
            values = (f"{x:+.2f}", f"{x_dot:+.2f}", f"{math.degrees(theta):+.1f}")
            for text, value in zip(readings, values, strict=True):
                text.set(text=value.replace("-", MINUS), color=MUTED if ended else INK)
            set_command(None if row == len(episode.time) - 1 else float(episode.action[row, 0]))
            set_force(None if ended or panel.run.force is None else float(panel.run.force[row]))
            for part in parts:
                part(row, ended)

        return show


def _picture(axes: Axes, pictures: NDArray[np.uint8]) -> Callable[[int, bool], None]:
    """Fill axes with one of several pictures (T, H, W) or (T, H, W, 3); the function returned chooses it by row."""
    image = axes.imshow(pictures[0], "gray", vmin=0, vmax=255, animated=True)
    return lambda row, ended: image.set_data(pictures[row])
