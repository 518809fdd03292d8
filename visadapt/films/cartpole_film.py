"""Films of cart-poles that balance: the scene, numbers, command and disturbance, and the cart's speed so far.

    film = CartPoleFilm([CartPolePanel.redrawn("before", run), CartPolePanel.redrawn("after", other)], period=0.05)
    film.write("film.mp4")

All panels share one clock; one whose episode has ended stays at its last frame.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import cv2
import numpy as np
from numpy.typing import NDArray

from renderers import Camera, DrawnCartPole
from visadapt.films.canvas import Canvas, Floats, Picture
from visadapt.films.colours import BLUE, INK, MUTED, ORANGE, TEAL, TROUGH
from visadapt.films.film import Film, last_row
from visadapt.films.widgets import Plot, banner, bar, ceiling, headline, reading, signed
from visadapt.targets.rollout import Run

PANEL_WIDTH, SCENE_HEIGHT = 480, 400
"""px"""
TITLE_HEIGHT, NUMBERS_HEIGHT, CHART_HEIGHT, PART_GAP = 40, 122, 128, 16
"""px, of the other parts of a panel, and between parts"""


@dataclass(frozen=True)
class CartPolePanel:
    """A run of a cart-pole and the pictures of it.

    Raises:
        ValueError: pictures that do not fit the run, or a run without states.
    """

    title: str
    run: Run
    pictures: NDArray[np.uint8]
    """(T, H, W) grey or (T, H, W, 3) red, green, blue; scaled to fit the scene"""
    cart: Floats | None = None
    """(T, 3) px in the pictures: column and row of the cart's centre, and half its width; None draws no force"""
    angle_limit: float = 0.3
    """rad; an episode that ended early fell if its last angle is beyond this, else the cart left the frame"""
    force_known: bool = True
    """whether the run's force is the target's true disturbance"""

    def __post_init__(self) -> None:
        rows, shape = len(self.run.episode.time), self.pictures.shape
        if self.pictures.dtype != np.uint8 or len(shape) not in (3, 4) or (len(shape) == 4 and shape[3] != 3):
            raise ValueError(
                f"panel {self.title!r}: the pictures must be uint8 (T, H, W) or (T, H, W, 3), "
                f"got {self.pictures.dtype} {shape}"
            )
        if len(self.pictures) != rows:
            raise ValueError(
                f"panel {self.title!r}: the run has {rows} rows, but there are {len(self.pictures)} pictures"
            )
        if self.run.episode.state is None:
            raise ValueError(f"panel {self.title!r}: the run has no states to show")
        if self.cart is not None and self.cart.shape != (rows, 3):
            raise ValueError(f"panel {self.title!r}: the cart's places must be {(rows, 3)}, got {self.cart.shape}")

    @classmethod
    def redrawn(
        cls, title: str, run: Run, scene: DrawnCartPole | None = None, angle_limit: float = 0.3
    ) -> CartPolePanel:
        """The run drawn from its true states, as `scene` draws it but as large as the panel."""
        if run.episode.state is None:
            raise ValueError(f"panel {title!r}: the run has no states to draw")
        small = scene or DrawnCartPole()
        zoom = min(PANEL_WIDTH / small.camera.width, SCENE_HEIGHT / small.camera.height)
        view = Camera(
            width=round(small.camera.width * zoom),
            height=round(small.camera.height * zoom),
            scale=small.camera.scale * zoom,
            column=(small.camera.column + 0.5) * zoom - 0.5,
            row=(small.camera.row + 0.5) * zoom - 0.5,
        )
        large = DrawnCartPole(view, small.pole_length, small.pole_width, small.cart_width, small.cart_height)
        x, theta = run.episode.state[:, 0].clip(-10, 10), run.episode.state[:, 2]
        column = view.column + view.scale * x
        row = np.full_like(column, view.row + view.scale * (0.04 + small.cart_height / 2))
        half = np.full_like(column, view.scale * small.cart_width / 2)
        return cls(title, run, large(x, theta), np.stack([column, row, half], -1), angle_limit)

    @property
    def state(self) -> Floats:
        """(T, n_state), SI units"""
        assert self.run.episode.state is not None
        return self.run.episode.state

    @property
    def speed(self) -> Floats:
        """(T,) m/s, |x_dot|"""
        return np.abs(self.state[:, 1])

    @property
    def end(self) -> float:
        """The time of the last row, s"""
        return float(self.run.episode.time[-1])

    @property
    def failure(self) -> str:
        """How the episode ended early; empty where it did not."""
        if self.run.survived:
            return ""
        return "FELL" if abs(self.state[-1, 2]) > self.angle_limit else "LEFT THE FRAME"


@dataclass(frozen=True)
class CartPoleFilm(Film):
    """Cart-poles side by side until the longest run has ended.

    Raises:
        ValueError: no panels, or a period that is not positive.
    """

    panels: Sequence[CartPolePanel]
    period: float

    panel_width = PANEL_WIDTH
    panel_height = TITLE_HEIGHT + SCENE_HEIGHT + NUMBERS_HEIGHT + CHART_HEIGHT + 2 * PART_GAP

    def __post_init__(self) -> None:
        if not self.panels:
            raise ValueError("a film needs at least one panel")
        if not self.period > 0:
            raise ValueError(f"the period of a film must be positive, got {self.period!r} s")

    @property
    def times(self) -> list[float]:
        return [i * self.period for i in range(round(max(panel.end for panel in self.panels) / self.period) + 1)]

    @cached_property
    def duration(self) -> float:
        """s, on the time axis of all panels"""
        return max(max(panel.end for panel in self.panels), 1e-3)

    @cached_property
    def full_speed(self) -> float:
        """m/s, at the top of all charts; the speed of a fall may exceed it, so that the other runs stay legible"""
        fastest = max(float(panel.speed.max()) for panel in self.panels)
        upright = [float(panel.speed.max()) for panel in self.panels if panel.run.survived]
        return max(ceiling(min(fastest, max(*upright, 0.5)) if upright else fastest), 0.1)

    @cached_property
    def full_force(self) -> float:
        """N, at the end of all force bars"""
        return max(ceiling(max(float(np.abs(panel.run.force).max()) for panel in self.panels)), 1.0)

    def draw_panel(self, canvas: Canvas, panel: CartPolePanel, t: float) -> None:
        row = last_row(panel.run.episode.time, t)
        last = row == len(panel.state) - 1
        failed = last and bool(panel.failure)
        headline(canvas, TITLE_HEIGHT - 14, PANEL_WIDTH, panel.title, f"t = {panel.end if failed else t:5.2f} s")
        scene = canvas.part(0, TITLE_HEIGHT, PANEL_WIDTH, SCENE_HEIGHT)
        _draw_scene(scene, panel, row, self.full_force, failed)
        if panel.run.survived and last and panel.end < self.duration - 1e-6:
            scene.text(PANEL_WIDTH / 2, 52, f"ends upright at t = {panel.end:.1f} s", 15, MUTED, align="centre")
        scene.frame(0, 0, PANEL_WIDTH, SCENE_HEIGHT)
        top = TITLE_HEIGHT + SCENE_HEIGHT + PART_GAP
        _draw_numbers(canvas.part(0, top, PANEL_WIDTH, NUMBERS_HEIGHT), panel, row, self.full_force, failed)
        top += NUMBERS_HEIGHT + PART_GAP
        self._draw_chart(canvas.part(0, top, PANEL_WIDTH, CHART_HEIGHT), panel, row, failed)

    def _draw_chart(self, canvas: Canvas, panel: CartPolePanel, row: int, failed: bool) -> None:
        """The cart's speed and its mean, up to a row."""
        plot = Plot(canvas.width, canvas.height, self.duration)
        canvas.text(0, 12, "cart speed |v|", 12, TEAL, bold=True)
        plot.axes(canvas, {share: f"{self.full_speed * share:g}" for share in (0.0, 0.5, 1.0)})
        time, speed = panel.run.episode.time[: row + 1], panel.speed[: row + 1]
        mean = plot.value_and_mean(canvas, time, speed, self.full_speed, TEAL, failed)
        canvas.text(canvas.width, 12, f"mean {mean:.2f} m/s", 12, INK, bold=True, align="right")


def _draw_scene(canvas: Canvas, panel: CartPolePanel, row: int, full_force: float, failed: bool) -> None:
    """The picture, with the disturbance as an arrow at the cart; dimmed, with a banner, once the run has failed."""
    picture = _colour(panel.pictures[row])
    zoom = min(canvas.width / picture.shape[1], canvas.height / picture.shape[0])
    size = (round(picture.shape[1] * zoom), round(picture.shape[0] * zoom))
    # A frame enlarged by a whole number keeps its sharp pixels.
    enlarge = cv2.INTER_NEAREST if zoom.is_integer() else cv2.INTER_CUBIC
    if zoom != 1:
        picture = np.asarray(cv2.resize(picture, size, interpolation=enlarge if zoom > 1 else cv2.INTER_AREA), np.uint8)
    left, top = (canvas.width - size[0]) // 2, (canvas.height - size[1]) // 2
    canvas.fade(1.0, TROUGH)
    canvas.paste(left, top, picture)
    force = float(panel.run.force[row])
    length = 90 * abs(force) / full_force
    if panel.cart is not None and length > 2 and not failed:
        column, height, half = panel.cart[row] * zoom
        sign = math.copysign(1, force)
        tip = left + column - sign * (half + 4)
        canvas.arrow((tip - sign * length, top + height), (tip, top + height), ORANGE, 8)
    if failed:
        canvas.fade(0.6)
        banner(canvas, canvas.width / 2, 46, f"{panel.failure} at t = {panel.end:.2f} s")


def _draw_numbers(canvas: Canvas, panel: CartPolePanel, row: int, full_force: float, failed: bool) -> None:
    """State, command and disturbance; beside them the frame that the policy sees, unless it is the scene itself."""
    frames = panel.run.episode.frame
    room = canvas.width
    if frames is not None and not np.array_equal(frames, panel.pictures):
        room = _draw_frame(canvas, frames[row])
    state = panel.state[row]
    readings = (
        ("position", signed(state[0], 2), "m"),
        ("speed", signed(state[1], 2), "m/s"),
        ("angle", signed(math.degrees(state[2]), 1), "\N{DEGREE SIGN}"),
    )
    for column, (name, value, unit) in enumerate(readings):
        reading(canvas, column * room / 3, name, value, unit, MUTED if failed else INK)
    last = row == len(panel.state) - 1
    command = float(panel.run.episode.action[row, 0])
    bar(canvas, 66, room, "command", None if last else command, 1.0, "", BLUE)
    if panel.force_known:
        force = float(panel.run.force[row])
        bar(canvas, 102, room, "force", None if failed else force, full_force, " N", ORANGE)


def _draw_frame(canvas: Canvas, frame: NDArray[np.uint8]) -> int:
    """Draw a frame at the right edge; returns the px that are left beside it."""
    height, width = canvas.height - 20, 160
    size = (frame.shape[1], frame.shape[0])
    if size[0] > width or size[1] > height:
        size = (min(round(height * size[0] / size[1]), width), height)
        frame = np.asarray(cv2.resize(frame, size, interpolation=cv2.INTER_AREA), np.uint8)
    left = canvas.width - size[0]
    canvas.paste(left, 0, _colour(frame))
    canvas.frame(left, 0, canvas.width, size[1])
    canvas.text(canvas.width, size[1] + 17, "the policy's view", 12, MUTED, align="right")
    return left - 28


def _colour(picture: NDArray[np.uint8]) -> Picture:
    """(H, W, 3) of a grey (H, W) or coloured picture."""
    return np.repeat(picture[..., None], 3, 2) if picture.ndim == 2 else picture
