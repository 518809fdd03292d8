"""The cart-pole drawn with OpenCV: what the synthetic target's camera sees."""

from __future__ import annotations

from dataclasses import dataclass, field

import cv2
import numpy as np
from numpy.typing import NDArray

SUPERSAMPLING = 6
"""Factor by which the scene is drawn larger and then averaged down, so that motion of a fraction of a pixel shows."""

SKY_GREY, TRACK_GREY, CART_GREY, POLE_GREY, AXLE_GREY = 245, 120, 60, 150, 20
"""Grey levels, 0 to 255."""


@dataclass(frozen=True)
class Camera:
    """A fixed camera, its image plane parallel to the plane of motion: metres to pixels.

    Pixel centres are at whole numbers, rows count downwards.
    """

    width: int = 120
    """px"""
    height: int = 100
    """px"""
    scale: float = 40.0
    """px per m"""
    column: float = 59.5
    """px, column of x = 0"""
    row: float = 74.5
    """px, row of the pole's hinge"""

    @property
    def reach(self) -> float:
        """Largest |x| in m at which the hinge is in the frame on either side of x = 0."""
        return min(self.column + 0.5, self.width - 0.5 - self.column) / self.scale


@dataclass(frozen=True)
class DrawnCartPole:
    """Draws cart, pole and track in grey; sizes are in m, `pole_length` from the hinge to the tip."""

    camera: Camera = field(default_factory=Camera)
    pole_length: float = 1.0
    pole_width: float = 0.06
    cart_width: float = 0.36
    cart_height: float = 0.20

    def __call__(self, x: NDArray[np.floating], theta: NDArray[np.floating]) -> NDArray[np.uint8]:
        """Frames (B, H, W) uint8 of cart positions (B,) in m and pole angles (B,) in rad."""
        return np.stack([self._draw(float(a), float(b)) for a, b in zip(x, theta, strict=True)])

    def _draw(self, x: float, theta: float) -> NDArray[np.uint8]:
        camera, zoom = self.camera, SUPERSAMPLING
        canvas = np.full((camera.height * zoom, camera.width * zoom), SKY_GREY, np.uint8)
        base = self.cart_height + 0.04
        self._fill(canvas, _box(-10.0, 10.0, -base - 0.03, -base), TRACK_GREY)
        self._fill(canvas, _box(x - self.cart_width / 2, x + self.cart_width / 2, -base, -0.04), CART_GREY)
        self._fill(canvas, self.pole(x, theta), POLE_GREY)
        around = np.linspace(0, 2 * np.pi, 24, endpoint=False)
        self._fill(canvas, np.array([x, 0.0]) + 0.05 * np.stack([np.cos(around), np.sin(around)], -1), AXLE_GREY)
        return np.asarray(cv2.resize(canvas, (camera.width, camera.height), interpolation=cv2.INTER_AREA))

    def pole(self, x: float, theta: float) -> NDArray[np.floating]:
        """Corners (4, 2) in m of the pole, x to the right and z up from the hinge at x = 0; theta in rad."""
        along = np.array([np.sin(theta), np.cos(theta)])
        across = np.array([along[1], -along[0]]) * self.pole_width / 2
        hinge = np.array([x, 0.0])
        tip = hinge + along * self.pole_length
        return np.array([hinge - across, hinge + across, tip + across, tip - across])

    def _fill(self, canvas: NDArray[np.uint8], corners: NDArray[np.floating], grey: int) -> None:
        """Fill a polygon of corners (n, 2) in m, x to the right and z up from the hinge."""
        camera, zoom, fraction_bits = self.camera, SUPERSAMPLING, 8
        columns = camera.column + camera.scale * corners[:, 0]
        rows = camera.row - camera.scale * corners[:, 1]
        pixels = np.stack([columns, rows], -1) * zoom + (zoom - 1) / 2
        points = np.round(pixels * 2**fraction_bits).astype(np.int32)
        cv2.fillConvexPoly(canvas, points, grey, cv2.LINE_AA, fraction_bits)


def _box(left: float, right: float, bottom: float, top: float) -> NDArray[np.floating]:
    return np.array([[left, bottom], [right, bottom], [right, top], [left, top]])
