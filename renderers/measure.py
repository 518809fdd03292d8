"""Cart position and pole angle read from frames by classical computer vision.

Independent of every learnt renderer: nothing here is fitted. It knows how the scene is drawn (its greys and sizes)
and where the camera stands, and finds in each frame (1) the cart's two vertical edges, to a fraction of a pixel from
how much of each column the cart covers, and (2) the line through the pole's pixels by total least squares, weighted
by how much of each pixel the pole covers.
"""

from __future__ import annotations

import math

import cv2
import numpy as np
from numpy.typing import NDArray

from renderers.drawn import CART, POLE, SKY, DrawnCartPole

Floats = NDArray[np.float64]

FAINT = 0.15
"""Coverage by the cart below which a column counts as empty: what a learnt renderer leaves behind does not pull."""
EDGE = 3
"""px to either side of the pole's line in which its pixels are looked for"""


def measure(frames: NDArray[np.uint8] | NDArray[np.floating], scene: DrawnCartPole) -> tuple[Floats, Floats]:
    """Cart positions (B,) in m and pole angles (B,) in rad, seen in frames (B, H, W), uint8 or in [0, 1].

    NaN where no cart is seen, or less than half of the pole. A cart cut by the frame's edge is placed by its other
    edge. The pole must stand above the cart (|theta| < 80 degrees): in front of cart and track little is seen of it,
    and it hides the cart.
    """
    camera = scene.camera
    if frames.ndim != 3 or frames.shape[1:] != (camera.height, camera.width):
        raise ValueError(f"frames are {frames.shape}, the camera's are (B, {camera.height}, {camera.width})")
    shades = frames.astype(float) * (1.0 if frames.dtype == np.uint8 else 255.0)
    seen = [_measure(frame, scene) for frame in shades]
    return np.array([x for x, _ in seen]), np.array([theta for _, theta in seen])


def _measure(frame: Floats, scene: DrawnCartPole) -> tuple[float, float]:
    camera = scene.camera
    column = _cart(frame, scene)
    return (column - camera.column) / camera.scale, _pole(frame, scene, column)


def _cart(frame: Floats, scene: DrawnCartPole) -> float:
    """Column of the cart's middle, NaN without a cart."""
    camera = scene.camera
    half = scene.cart_width / 2 * camera.scale
    # Rows that the cart covers whole, below the axle and above the track.
    top, bottom = camera.row + 0.09 * camera.scale, camera.row + (scene.cart_height + 0.04) * camera.scale
    rows = slice(math.ceil(top + 0.5), math.floor(bottom - 0.5) + 1)
    profile = np.clip((SKY - frame[rows]) / (SKY - CART), 0.0, 1.0).mean(0)
    size = 2 * round(half) + 1
    matched = cv2.filter2D(profile[None], -1, np.full((1, size), 1 / size), borderType=cv2.BORDER_CONSTANT)[0]
    middle = int((matched * profile).argmax())
    # A cart cut in half by the frame's edge still fills half of the box.
    if matched[middle] < 0.3 or profile[middle] <= 0.5:
        return math.nan
    covered = np.where(profile > FAINT, profile, 0.0)
    right = middle - 0.5 + _run(covered[middle:])
    left = middle + 0.5 - _run(covered[middle::-1])
    if right - left > 2 * (half + EDGE):
        return math.nan
    if covered[: middle + 1].all() and covered[0] > 0.5:
        return right - half
    if covered[middle:].all() and covered[-1] > 0.5:
        return left + half
    return (left + right) / 2


def _run(covered: Floats) -> float:
    """Columns covered from the first one on, up to the first empty one, with fractions."""
    empty = np.flatnonzero(covered == 0)
    return float(covered[: empty[0] if len(empty) else None].sum())


def _pole(frame: Floats, scene: DrawnCartPole, column: float) -> float:
    """Angle in rad of the pole that is hinged at a column, NaN where it is not seen."""
    camera = scene.camera
    if not math.isfinite(column):
        return math.nan
    rows, columns = np.mgrid[: camera.height, : camera.width].astype(float)
    right, up = columns - column, camera.row - rows
    near, tip = 0.1 * camera.scale, scene.pole_length * camera.scale
    cover = np.clip((SKY - frame) / (SKY - POLE), 0.0, 1.0)
    distance = np.hypot(right, up)
    # All above the cart but the axle is sky or pole.
    cover[(distance < near) | (distance > tip + 2) | (up < -0.5)] = 0.0
    if cover.sum() < 5:
        return math.nan
    sure = cover * (cover > 0.3)
    angle = math.atan2(float((sure * right).sum()), float((sure * up).sum()))
    for _ in range(4):
        reach = _visible(scene, column, angle)
        if reach < tip / 2:
            return math.nan
        # Only what lies along the line so far, and only as far out as the frame shows the pole's whole width.
        away, along = _about_line(camera.row, column, angle, rows, columns)
        band = cover * (np.abs(away) < EDGE) * (along > 0) * (along < reach)
        total = band.sum()
        if total < 5:
            return math.nan
        centre_right, centre_up = float((band * right).sum() / total), float((band * up).sum() / total)
        a, b = right - centre_right, up - centre_up
        # The axis of largest spread: its angle from the vertical is half that of the second moments.
        spread = 0.5 * math.atan2(2 * float((band * a * b).sum()), float((band * (b * b - a * a)).sum()))
        if math.cos(spread - math.atan2(centre_right, centre_up)) < 0:
            spread += math.pi
        angle = math.remainder(spread, 2 * math.pi)
    return angle


def _about_line(row: float, column: float, angle: float, rows: Floats, columns: Floats) -> tuple[Floats, Floats]:
    """How far pixels are from a line through the hinge, in px, and how far along it."""
    right, up = columns - column, row - rows
    sine, cosine = math.sin(angle), math.cos(angle)
    return right * cosine - up * sine, right * sine + up * cosine


def _visible(scene: DrawnCartPole, column: float, angle: float) -> float:
    """Px from the hinge up to which the pole is in the frame in its whole width."""
    camera, sine, cosine = scene.camera, math.sin(angle), math.cos(angle)
    half = scene.pole_width / 2 * camera.scale + 1
    limit = scene.pole_length * camera.scale + 2
    for speed, start, across, end in (
        (sine, column, abs(cosine), camera.width - 0.5),
        (-sine, -column, abs(cosine), 0.5),
        (-cosine, camera.row, abs(sine), camera.height - 0.5),
        (cosine, -camera.row, abs(sine), 0.5),
    ):
        if speed > 1e-6:
            limit = min(limit, (end - start - half * across) / speed)
    return limit
