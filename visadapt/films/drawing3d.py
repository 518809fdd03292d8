"""Drawing in three dimensions on a canvas: a pinhole camera, and a pen that draws world points as it sees them.

World axes are the vehicles': metres, z up. The camera never rolls, so the horizon is level.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Self

import cv2
import numpy as np

from visadapt.films.canvas import FARTHEST_PX, Canvas, Floats, text_width
from visadapt.films.colours import GROUND, HAIRLINE, MUTED, PAPER, SKY, Colour, blend

NEAREST_M = 0.2
"""Distance in front of the camera below which nothing is drawn."""


@dataclass(frozen=True)
class PinholeCamera:
    """A pinhole camera: p m away from it is seen at `centre + focal (right . p, down . p) / ahead . p`."""

    place: Floats
    """(3,) m"""
    axes: Floats
    """(3, 3), rows: unit vectors to the right, down, and ahead"""
    focal: float
    """px"""
    centre: Floats
    """(2,) px, column and row of what is straight ahead"""

    @classmethod
    def towards(cls, place: Floats, point: Floats, focal: float, size: tuple[int, int]) -> Self:
        """At `place` (3,), looking at `point` (3,), not straight above or below it; size is (width, height) in px."""
        ahead = (point - place) / np.linalg.norm(point - place)
        right = np.cross(ahead, (0.0, 0.0, 1.0))
        right /= np.linalg.norm(right)
        axes = np.stack([right, np.cross(ahead, right), ahead])
        return cls(place, axes, focal, np.array(size, float) / 2)

    @classmethod
    def around(cls, points: Floats, direction: Floats, size: tuple[int, int], margin: float) -> Self:
        """From afar, in a direction (3,) from points (n, 3), which fill the picture up to a margin in px."""
        low, high = points.min(0), points.max(0)
        middle = (low + high) / 2
        distance = 3 * float(np.linalg.norm(high - low)) + 1.0
        place = middle + distance * direction / np.linalg.norm(direction)
        first = cls.towards(place, middle, 1.0, size)
        seen = first.project(points)[0] - first.centre
        spread = np.maximum(seen.max(0) - seen.min(0), 1e-6)
        focal = float(((np.array(size) - 2 * margin) / spread).min())
        return cls(place, first.axes, focal, first.centre - focal * (seen.max(0) + seen.min(0)) / 2)

    def project(self, points: Floats) -> tuple[Floats, Floats]:
        """Columns and rows (n, 2) in px of points (n, 3), and their depths (n,) in m in front of the camera."""
        seen = (points - self.place) @ self.axes.T
        depth = seen[:, 2]
        safe = np.where(np.abs(depth) < 1e-9, 1e-9, depth)
        return self.centre + self.focal * seen[:, :2] / safe[:, None], depth

    @property
    def horizon(self) -> float:
        """Row in px of the horizon."""
        ahead, down = self.axes[2], self.axes[1]
        return float(self.centre[1] - self.focal * ahead[2] / down[2])


@dataclass(frozen=True)
class Pen:
    """Draws world points (n, 3) as a camera sees them."""

    canvas: Canvas
    camera: PinholeCamera

    def line(self, points: Floats, colour: Colour, thickness: int = 1) -> None:
        """A polyline, clipped at NEAREST_M in front of the camera."""
        for piece in _in_front((points - self.camera.place) @ self.camera.axes[2], points):
            self.canvas.line(self.camera.project(piece)[0], colour, thickness)

    def dashes(self, start: Floats, end: Floats, colour: Colour, length: float) -> None:
        """A straight dashed line, its dashes about `length` m long."""
        count = int(np.clip(np.linalg.norm(end - start) / (2 * length), 1, 100))
        marks = np.linspace(start, end, 2 * count)
        for a, b in zip(marks[:-1:2], marks[1::2], strict=True):
            self.line(np.stack([a, b]), colour)

    def face(self, corners: Floats, colour: Colour, opacity: float = 1.0, edge: Colour | None = None) -> None:
        """The convex hull of points as they are seen, filled; nothing where one is nearer than NEAREST_M."""
        seen, depth = self.camera.project(corners)
        if depth.min() < NEAREST_M:
            return
        hull = np.asarray(cv2.convexHull(seen.astype(np.float32)), float)[:, 0]
        if opacity < 1:
            self.canvas.glass(hull, colour, opacity)
        else:
            self.canvas.polygon(hull, colour)
        if edge is not None:
            self.canvas.line(np.concatenate([hull, hull[:1]]), edge)

    def arrow(self, tail: Floats, vector: Floats, colour: Colour, label: str) -> None:
        """An arrow from `tail` (3,) along `vector` (3,) in m, with a label beside its tip."""
        seen, depth = self.camera.project(np.stack([tail, tail + vector]))
        way = seen[1] - seen[0]
        length = float(np.linalg.norm(way))
        if depth.min() < NEAREST_M or not 2 < length < FARTHEST_PX:
            return
        way = way / length
        across = np.array([-way[1], way[0]])
        head = min(13.0, length)
        neck = seen[1] - head * way
        self.canvas.polygon(
            np.stack([seen[0] - 2 * across, seen[0] + 2 * across, neck + 2 * across, neck - 2 * across]), colour
        )
        self.canvas.polygon(np.stack([seen[1], neck + 0.45 * head * across, neck - 0.45 * head * across]), colour)
        if length > 1.2 * head:
            self._label(seen[1] + (8 if way[0] > -0.3 else -8, 4 + 5 * np.sign(way[1])), label, colour, way[0] > -0.3)

    def _label(self, at: Floats, label: str, colour: Colour, rightwards: bool) -> None:
        """Text to the right or left of a place (2,) in px, moved into the canvas, on a pale background."""
        wide = text_width(label, 12, bold=True)
        left = float(np.clip(at[0] - (0 if rightwards else wide), 6, self.canvas.width - wide - 6))
        first, last, top, bottom = left - 3, left + wide + 3, at[1] - 12, at[1] + 4
        self.canvas.glass(np.array([(first, top), (last, top), (last, bottom), (first, bottom)]), PAPER, 0.7)
        self.canvas.text(left, at[1], label, 12, colour, bold=True)

    def dot(self, point: Floats, radius: float, colour: Colour) -> None:
        """A disc of `radius` px at a point (3,)."""
        seen, depth = self.camera.project(point[None])
        if depth[0] > NEAREST_M:
            self.canvas.disc(seen[0], radius, colour)

    def ground(self, height: float, middle: Floats, step: float, reach: float) -> None:
        """Level ground at a height in m, its grid `step` m wide and fading out `reach` m around a middle (3,)."""
        # The ground fades into the sky over the 150 px below the horizon.
        rows = np.arange(self.canvas.height)
        nearer = ((rows - self.camera.horizon) / 150).clip(0, 1)[:, None]
        shades = np.array(SKY) + nearer * (np.array(GROUND) - np.array(SKY))
        self.canvas.pixels[:] = np.round(shades)[:, None]
        centre = np.round(middle[:2] / step) * step
        count = round(reach / step)
        along, across = np.linspace(-reach, reach, 13), step * np.arange(-count, count + 1)
        lines = np.empty((2, len(across), len(along), 3))
        for axis in (0, 1):
            lines[axis, ..., axis] = centre[axis] + across[:, None]
            lines[axis, ..., 1 - axis] = centre[1 - axis] + along
        lines[..., 2] = height
        flat = lines.reshape(-1, len(along), 3)
        pieces = np.stack([flat[:, :-1], flat[:, 1:]], 2).reshape(-1, 2, 3)
        far = np.linalg.norm(pieces.mean(1)[:, :2] - middle[:2], axis=1) / reach
        seen, depth = (part.reshape(len(pieces), 2, -1) for part in self.camera.project(pieces.reshape(-1, 3)))
        size = (self.canvas.width, self.canvas.height)
        inside = (depth[..., 0] >= NEAREST_M).all(1) & ((seen.max(1) >= 0) & (seen.min(1) <= size)).all(1)
        for k in np.flatnonzero(inside & (far < 1)):
            self.canvas.line(seen[k], blend(HAIRLINE, GROUND, float(far[k] ** 2)))
        # Pieces that end nearer than NEAREST_M are clipped there.
        for k in np.flatnonzero((depth[..., 0].min(1) < NEAREST_M) & (depth[..., 0].max(1) >= NEAREST_M) & (far < 1)):
            self.line(pieces[k], blend(HAIRLINE, GROUND, float(far[k] ** 2)))

    def shadow(self, points: Floats, height: float) -> None:
        """The convex hull of points, dropped to the ground at a height in m."""
        self.face(dropped(points, height), MUTED, 0.16)


def dropped(points: Floats, height: float) -> Floats:
    """Points (n, 3) moved straight down, or up, to a height in m."""
    out = np.array(points, float)
    out[:, 2] = height
    return out


def _in_front(depth: Floats, points: Floats) -> list[Floats]:
    """The pieces of a polyline that are at least NEAREST_M in front of the camera, with new ends at that distance."""
    inside = depth >= NEAREST_M
    if inside.all():
        return [points]
    pieces: list[Floats] = []
    for run in np.split(np.arange(len(points)), np.flatnonzero(np.diff(inside)) + 1):
        if not inside[run[0]]:
            continue
        piece = [points[run]]
        for end, beyond, at in ((run[0], run[0] - 1, 0), (run[-1], run[-1] + 1, len(piece))):
            if 0 <= beyond < len(points):
                share = (depth[end] - NEAREST_M) / (depth[end] - depth[beyond])
                piece.insert(at, (points[end] + share * (points[beyond] - points[end]))[None])
        pieces.append(np.concatenate(piece))
    return pieces
