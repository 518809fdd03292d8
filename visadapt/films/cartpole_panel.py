"""One panel of a film: a run's scene, its numbers, its command and disturbance, and its cart speed so far."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from renderers import Camera, DrawnCartPole
from visadapt.films.canvas import BLUE, INK, MUTED, ORANGE, TEAL, TROUGH, Canvas, Picture
from visadapt.films.widgets import Plot, banner, bar, ceiling, headline, reading, signed
from visadapt.targets.rollout import Run

WIDTH, SCENE = 480, 400
"""px, of a panel and of the scene in it"""
TITLE, GAP, NUMBERS, CHART = 40, 16, 122, 128
"""px, heights of the parts below each other"""
HEIGHT = TITLE + SCENE + GAP + NUMBERS + GAP + CHART


@dataclass(frozen=True)
class Panel:
    """A run of a cart on a track and what it looked like.

    Raises:
        ValueError: a picture that does not fit the run, or a run without states.
    """

    title: str
    run: Run
    picture: NDArray[np.uint8]
    """(T, H, W) grey or (T, H, W, 3) red, green, blue; scaled to fit the scene"""
    cart: NDArray[np.floating] | None = None
    """(T, 3) px in the picture: the cart's centre, column and row, and half its width; the force is drawn at it"""
    angle_limit: float = 0.3
    """rad; an episode that ended beyond it is said to have fallen, any other that did not survive to have left"""
    force_known: bool = True
    """whether the target tells its disturbance"""

    def __post_init__(self) -> None:
        rows, shape = len(self.run.episode.time), self.picture.shape
        if self.picture.dtype != np.uint8 or len(shape) not in (3, 4) or (len(shape) == 4 and shape[3] != 3):
            raise ValueError(
                f"panel {self.title!r}: the picture must be uint8 (T, H, W) or (T, H, W, 3), "
                f"got {self.picture.dtype} {shape}"
            )
        if len(self.picture) != rows:
            raise ValueError(f"panel {self.title!r}: the run has {rows} rows, its picture {len(self.picture)}")
        if self.run.episode.state is None:
            raise ValueError(f"panel {self.title!r}: the run has no states to show")
        if self.cart is not None and self.cart.shape != (rows, 3):
            raise ValueError(f"panel {self.title!r}: the cart's places must be {(rows, 3)}, got {self.cart.shape}")

    @classmethod
    def redrawn(cls, title: str, run: Run, camera: DrawnCartPole | None = None, angle_limit: float = 0.3) -> Panel:
        """The scene that `camera` saw, drawn again from the true states, larger."""
        if run.episode.state is None:
            raise ValueError(f"panel {title!r}: the run has no states to draw")
        small = camera or DrawnCartPole()
        zoom = min(WIDTH / small.camera.width, SCENE / small.camera.height)
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
    def state(self) -> NDArray[np.floating]:
        """(T, n_state), SI units"""
        assert self.run.episode.state is not None
        return self.run.episode.state

    @property
    def speed(self) -> NDArray[np.floating]:
        """(T,) m/s, |x_dot|"""
        return np.abs(self.state[:, 1])

    @property
    def end(self) -> float:
        """The time of the last row, s"""
        return float(self.run.episode.time[-1])

    @property
    def verdict(self) -> str:
        """How the episode ended before its time; empty where it survived."""
        if self.run.survived:
            return ""
        return "FELL" if abs(self.state[-1, 2]) > self.angle_limit else "LEFT THE FRAME"

    def row(self, t: float) -> int:
        """The last row at or before t s."""
        return max(int(np.searchsorted(self.run.episode.time, t + 1e-6, side="right")) - 1, 0)


@dataclass(frozen=True)
class Scales:
    """Axes that all panels of a film share, so that they can be compared at a glance."""

    duration: float
    """s"""
    speed: float
    """m/s, at the top of the chart"""
    force: float
    """N, at the end of its bar"""
    ticks: tuple[float, ...]
    """s"""

    @classmethod
    def of(cls, panels: Sequence[Panel]) -> Scales:
        """Scales that fit the panels; the speed of a fall may go off the chart so that the rest is legible."""
        duration = max(max(panel.end for panel in panels), 1e-3)
        upright = [float(panel.speed.max()) for panel in panels if panel.run.survived]
        fastest = max(float(panel.speed.max()) for panel in panels)
        speed = min(fastest, max(*upright, 0.5)) if upright else fastest
        force = max(float(np.abs(panel.run.force).max()) for panel in panels)
        step = ceiling(duration / 7)
        return cls(
            duration,
            max(ceiling(speed), 0.1),
            max(ceiling(force), 1.0),
            tuple(float(t) for t in np.arange(0, duration * 1.0001, step)),
        )


def draw_panel(canvas: Canvas, panel: Panel, t: float, scales: Scales) -> None:
    """Draw a panel as it is at t s on a canvas of WIDTH x HEIGHT px; after its end it stands still, dimmed."""
    row = panel.row(t)
    over = bool(panel.verdict) and row == len(panel.state) - 1
    clock = f"t = {panel.end if over else t:5.2f} s"
    headline(canvas, TITLE - 14, WIDTH, panel.title, clock)
    _draw_scene(canvas.part(0, TITLE, WIDTH, SCENE), panel, row, scales, over)
    top = TITLE + SCENE + GAP
    _draw_numbers(canvas.part(0, top, WIDTH, NUMBERS), panel, row, scales, over)
    _draw_chart(canvas.part(0, top + NUMBERS + GAP, WIDTH, CHART), panel, row, scales)


def _draw_scene(canvas: Canvas, panel: Panel, row: int, scales: Scales, over: bool) -> None:
    picture = _colour(panel.picture[row])
    zoom = min(WIDTH / picture.shape[1], SCENE / picture.shape[0])
    size = (round(picture.shape[1] * zoom), round(picture.shape[0] * zoom))
    # Whole multiples of a small camera frame stay the sharp pixels that they are.
    enlarge = cv2.INTER_NEAREST if zoom.is_integer() else cv2.INTER_CUBIC
    if zoom != 1:
        picture = np.asarray(cv2.resize(picture, size, interpolation=enlarge if zoom > 1 else cv2.INTER_AREA), np.uint8)
    left, top = (WIDTH - size[0]) // 2, (SCENE - size[1]) // 2
    canvas.fade(1.0, TROUGH)
    canvas.paste(left, top, picture)
    force = float(panel.run.force[row])
    length = 90 * abs(force) / scales.force
    if panel.cart is not None and length > 2 and not over:
        column, height, half = panel.cart[row] * zoom
        way = math.copysign(1, force)
        tip = left + column - way * (half + 4)
        canvas.arrow((tip - way * length, top + height), (tip, top + height), ORANGE, 8)
    if over:
        canvas.fade(0.6)
        banner(canvas, WIDTH / 2, 46, f"{panel.verdict} at t = {panel.end:.2f} s")
    elif panel.run.survived and row == len(panel.state) - 1 and panel.end < scales.duration - 1e-6:
        canvas.text(WIDTH / 2, 52, f"ends upright at t = {panel.end:.1f} s", 15, MUTED, align="centre")
    canvas.frame(0, 0, WIDTH, SCENE)


def _draw_numbers(canvas: Canvas, panel: Panel, row: int, scales: Scales, over: bool) -> None:
    """State, command and disturbance on the left; on the right the camera's frame, where it is not the scene."""
    seen = panel.run.episode.frame
    inset = seen is not None and not (seen.shape == panel.picture.shape and np.array_equal(seen, panel.picture))
    room = WIDTH
    if inset and seen is not None:
        tall = NUMBERS - 20
        wide = min(round(tall * seen.shape[2] / seen.shape[1]), 160)
        # Near its own size a frame is shown as it is, pixel by pixel.
        size = (seen.shape[2], seen.shape[1]) if seen.shape[2] <= 160 and seen.shape[1] <= tall else (wide, tall)
        room = WIDTH - size[0] - 28
        small = seen[row] if size == seen.shape[:0:-1] else cv2.resize(seen[row], size, interpolation=cv2.INTER_AREA)
        canvas.paste(WIDTH - size[0], 0, _colour(np.asarray(small, np.uint8)))
        canvas.frame(WIDTH - size[0], 0, WIDTH, size[1])
        canvas.text(WIDTH, size[1] + 17, "the policy's view", 12, MUTED, align="right")
    state = panel.state[row]
    readings = (
        ("position", signed(state[0], 2), "m"),
        ("speed", signed(state[1], 2), "m/s"),
        ("angle", signed(math.degrees(state[2]), 1), "\N{DEGREE SIGN}"),
    )
    for place, (name, value, unit) in enumerate(readings):
        reading(canvas, place * room / 3, name, value, unit, MUTED if over else INK)
    live = row < len(panel.state) - 1
    command = float(panel.run.episode.action[row, 0])
    bar(canvas, 66, room, "command", command if live else None, 1.0, "", BLUE)
    if panel.force_known:
        force = float(panel.run.force[row])
        bar(canvas, 102, room, "force", None if over else force, scales.force, " N", ORANGE)


def _draw_chart(canvas: Canvas, panel: Panel, row: int, scales: Scales) -> None:
    """The cart's speed until now, and its mean until now."""
    inside = Plot(WIDTH, CHART, scales.duration)
    time, speed = panel.run.episode.time[: row + 1], panel.speed[: row + 1]
    mean = np.cumsum(speed) / np.arange(1, row + 2)

    canvas.text(0, 12, "cart speed |v|", 12, TEAL, bold=True)
    canvas.text(WIDTH, 12, f"mean {mean[-1]:.2f} m/s", 12, INK, bold=True, align="right")
    inside.axes(canvas, {share: f"{scales.speed * share:g}" for share in (0.0, 0.5, 1.0)}, scales.ticks)
    line = inside.place(time, speed / scales.speed)
    inside.line(canvas, line, TEAL, 2)
    inside.line(canvas, inside.place(time, mean / scales.speed), INK, 1)
    inside.cursor(canvas, line[-1], TEAL, lost=bool(panel.verdict) and row == len(panel.state) - 1)


def _colour(picture: NDArray[np.uint8]) -> Picture:
    """(H, W, 3) of a grey (H, W) or coloured picture."""
    return np.repeat(picture[..., None], 3, 2) if picture.ndim == 2 else picture
