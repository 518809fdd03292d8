"""Cart position and pole angle measured in frames of the drawn scene by classical computer vision.

Nothing here is fitted, so that it is an independent check of learnt renderers. From the scene's known greys, sizes and
camera it finds (1) the cart's two vertical edges, to a fraction of a pixel by the share of each column that the cart
covers, and (2) the line through the pole's pixels by total least squares, weighted by the share of each pixel that the
pole covers.
"""

from __future__ import annotations

import math

import cv2
import numpy as np
from numpy.typing import NDArray

from renderers.drawn import CART_GREY, POLE_GREY, SKY_GREY, DrawnCartPole

Floats = NDArray[np.float64]

LEAST_COVERAGE = 0.15
"""Share covered by the cart below which a column counts as empty, so that faint artefacts of a renderer are ignored."""
POLE_BAND_PX = 3
"""px to either side of the pole's line within which pixels are taken to be the pole's"""


def measure(frames: NDArray[np.uint8] | NDArray[np.floating], scene: DrawnCartPole) -> tuple[Floats, Floats]:
    """Cart positions (B,) in m and pole angles (B,) in rad in frames (B, H, W), uint8 or in [0, 1].

    NaN where no cart, or less than half of the pole, is visible. A cart cut by the frame's edge is located by its other
    edge. The pole must be above the cart (|theta| < 80 degrees): lower, it hides the cart and blends with the track.

    Raises:
        ValueError: frames of another size than the camera's.
    """
    camera = scene.camera
    if frames.ndim != 3 or frames.shape[1:] != (camera.height, camera.width):
        raise ValueError(f"frames are {frames.shape}, the camera's are (B, {camera.height}, {camera.width})")
    shades = frames.astype(float) * (1.0 if frames.dtype == np.uint8 else 255.0)
    columns = np.array([_cart(frame, scene) for frame in shades])
    angles = [_pole(frame, scene, float(column)) for frame, column in zip(shades, columns, strict=True)]
    return (columns - camera.column) / camera.scale, np.array(angles)


def _cart(frame: Floats, scene: DrawnCartPole) -> float:
    """Column of the cart's middle, NaN without a cart."""
    camera = scene.camera
    half = scene.cart_width / 2 * camera.scale
    # Rows that the cart covers completely, below the axle and above the track.
    top, bottom = camera.row + 0.09 * camera.scale, camera.row + (scene.cart_height + 0.04) * camera.scale
    rows = slice(math.ceil(top + 0.5), math.floor(bottom - 0.5) + 1)
    profile = np.clip((SKY_GREY - frame[rows]) / (SKY_GREY - CART_GREY), 0.0, 1.0).mean(0)
    size = 2 * round(half) + 1
    matched = cv2.filter2D(profile[None], -1, np.full((1, size), 1 / size), borderType=cv2.BORDER_CONSTANT)[0]
    middle = int((matched * profile).argmax())
    # A cart cut in half by the frame's edge still fills half of the box.
    if matched[middle] < 0.3 or profile[middle] <= 0.5:
        return math.nan
    covered = np.where(profile > LEAST_COVERAGE, profile, 0.0)
    right = middle - 0.5 + _run(covered[middle:])
    left = middle + 0.5 - _run(covered[middle::-1])
    if right - left > 2 * (half + POLE_BAND_PX):
        return math.nan
    if covered[: middle + 1].all() and covered[0] > 0.5:
        return right - half
    if covered[middle:].all() and covered[-1] > 0.5:
        return left + half
    return (left + right) / 2


def _run(covered: Floats) -> float:
    """Number of covered columns, with fractions, from the first one to the first empty one."""
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
    cover = np.clip((SKY_GREY - frame) / (SKY_GREY - POLE_GREY), 0.0, 1.0)
    distance = np.hypot(right, up)
    # Above the cart, everything but the axle is sky or pole.
    cover[(distance < near) | (distance > tip + 2) | (up < -0.5)] = 0.0
    if cover.sum() < 5:
        return math.nan
    sure = cover * (cover > 0.3)
    angle = math.atan2(float((sure * right).sum()), float((sure * up).sum()))
    for _ in range(4):
        reach = _visible(scene, column, angle)
        if reach < tip / 2:
            return math.nan
        # Only pixels along the present line, and only as far out as the pole's full width is in the frame.
        sine, cosine = math.sin(angle), math.cos(angle)
        away, along = right * cosine - up * sine, right * sine + up * cosine
        band = cover * (np.abs(away) < POLE_BAND_PX) * (along > 0) * (along < reach)
        total = band.sum()
        if total < 5:
            return math.nan
        centre_right, centre_up = float((band * right).sum() / total), float((band * up).sum() / total)
        a, b = right - centre_right, up - centre_up
        # The principal axis; its angle from the vertical follows from the second moments.
        spread = 0.5 * math.atan2(2 * float((band * a * b).sum()), float((band * (b * b - a * a)).sum()))
        if math.cos(spread - math.atan2(centre_right, centre_up)) < 0:
            spread += math.pi
        angle = math.remainder(spread, 2 * math.pi)
    return angle


def _visible(scene: DrawnCartPole, column: float, angle: float) -> float:
    """Distance in px from the hinge up to which the pole's full width is in the frame."""
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
