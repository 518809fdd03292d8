"""The pictures of the blind films: a cart-pole drawn by code of its own (numpy alone), not by the library's renderers.

Every shape is given by its signed distance in m; a pixel is covered by the share 1/2 - distance, in px, clipped to
[0, 1]. A camera that is moved looks elsewhere: the scene is drawn where each of its pixels looks, so that nothing is
interpolated, and what comes into the frame is the scene itself.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from datasets.blind.plant import HALF_LENGTH, Array

WIDTH, HEIGHT = 120, 100
"""px"""
COLUMN, ROW, SCALE = 58.7, 73.3, 39.0
"""px, where the hinge is seen at x = 0, and px a metre"""


@dataclass(frozen=True)
class Look:
    """Greys in [0, 1] of a scene, its light and its texture."""

    wall: float
    rail: float
    cart: float
    pole: float
    wheel: float
    axle: float
    texture: float
    """largest change of the wall's grey by its pattern"""
    lamp: float
    """share by which the light grows over 1.5 m to the right"""
    marks: bool
    """whether the rail is marked every 0.25 m; otherwise it is the same everywhere"""
    cart_width: float = 0.42
    """m"""
    pole_width: float = 0.07
    """m, at the hinge"""


LOOKS = {
    "plain": Look(0.86, 0.35, 0.25, 0.5, 0.12, 0.95, texture=0.0, lamp=0.0, marks=False),
    "textured": Look(0.42, 0.2, 0.7, 0.92, 0.1, 0.3, texture=0.1, lamp=0.06, marks=True),
}
"""by name; films of one have one renderer"""


def pixels() -> tuple[Array, Array]:
    """Columns and rows (H, W) of the pixels' centres."""
    columns, rows = np.meshgrid(np.arange(WIDTH, dtype=float), np.arange(HEIGHT, dtype=float))
    return columns, rows


def draw(look: Look, places: Array, columns: Array, rows: Array, magnified: float = 1.0) -> Array:
    """Frames (B, H, W) in [0, 1] of places (B, 2) in m and rad, seen at columns and rows (H, W) of the scene.

    `magnified` is the size of the scene's pixel in pixels of the frame.
    """
    x, theta = places.T[..., None, None]
    across, up = (columns - COLUMN) / SCALE, (ROW - rows) / SCALE
    picture = np.broadcast_to(_wall(look, across, up), (len(places), *columns.shape))

    def paint(distance: Array, grey: float) -> None:
        nonlocal picture
        picture = picture + np.clip(0.5 - distance * SCALE * magnified, 0.0, 1.0) * (grey - picture)

    paint(np.abs(up + 0.32) - 0.025, look.rail)
    if look.marks:
        paint(np.maximum(np.abs((across + 0.125) % 0.25 - 0.125) - 0.015, np.abs(up + 0.36) - 0.03), look.rail)
    beside = across - x
    for wheel in (-0.13, 0.13):
        paint(np.hypot(beside - wheel, up + 0.245) - 0.05, look.wheel)
    paint(_box(beside, up + 0.12, 0.5 * look.cart_width, 0.08, 0.03), look.cart)
    along, aside = beside * np.sin(theta) + up * np.cos(theta), beside * np.cos(theta) - up * np.sin(theta)
    within = np.clip(along, 0.0, 2 * HALF_LENGTH)
    paint(np.hypot(aside, along - within) - look.pole_width * (0.5 - 0.2 * within), look.pole)
    paint(np.hypot(beside, up) - 0.03, look.axle)
    return picture * (1 + look.lamp * across / 1.5)


def _box(across: Array, up: Array, half_width: float, half_height: float, corner: float) -> Array:
    """Signed distance to a box with round corners."""
    beyond = np.abs(across) - half_width + corner, np.abs(up) - half_height + corner
    outside = np.hypot(np.maximum(beyond[0], 0.0), np.maximum(beyond[1], 0.0))
    return np.asarray(outside + np.minimum(np.maximum(*beyond), 0.0) - corner)


def _wall(look: Look, across: Array, up: Array) -> Array:
    pattern = np.sin(7.1 * across + 2.3 * up) + np.sin(3.7 * across - 9.2 * up + 1.0) + np.sin(14.0 * across + 6.0 * up)
    return look.wall + 0.05 * up + look.texture * pattern / 3
