"""Cameras that fly along, and the ground that they see."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib.colors import to_rgba_array

from visadapt.films.widgets import HAIRLINE, Floats

NEAREST_M, FARTHEST_PX = 0.2, 1e5
"""Nothing nearer to the camera is drawn, and nothing further from the middle of the picture."""


@dataclass(frozen=True)
class ChaseCamera:
    """A pinhole camera that moves with something, without turning."""

    position: tuple[float, float, float]
    """m, from what it moves with"""
    looks_at: tuple[float, float, float]
    """m, the point in the middle of the picture, from what it moves with"""
    focal: float
    """px"""

    def project(self, points: Floats, moving: Floats) -> tuple[Floats, Floats]:
        """Where points (..., 3) are seen (..., 2), px to the right and up from the middle, and how deep (...), m.

        Both are nan where a point is nearer than NEAREST_M. What the camera moves with is at `moving` (3,).
        """
        seen = (points - moving - np.array(self.position)) @ axes_towards(np.subtract(self.looks_at, self.position)).T
        depth = np.where(seen[..., 2] < NEAREST_M, np.nan, seen[..., 2])
        return (self.focal * seen[..., :2] / depth[..., None]).clip(-FARTHEST_PX, FARTHEST_PX), depth


FOLLOWING_CAMERA = ChaseCamera((-1.2, -2.6, 1.15), (0.0, 0.0, 0.0), 820.0)
"""Of a flight along a reference; moves with the reference's point, so that a vehicle beside the middle is an error."""
PASSING_STOPS_M = 4.0
PASSING_CAMERA = ChaseCamera((-4.8, -2.7, 1.9), (4.0, 0.3, 0.1), 560.0)
"""Of a flight through a point; moves with the vehicle, and stops PASSING_STOPS_M before the point."""


def axes_towards(ahead: Any) -> Floats:
    """(3, 3), rows: unit vectors to the right, up, and ahead of a camera that does not roll."""
    ahead = np.asarray(ahead) / np.linalg.norm(ahead)
    right = np.cross(ahead, (0.0, 0.0, 1.0))
    right /= np.linalg.norm(right)
    return np.stack([right, np.cross(right, ahead), ahead])


def ground_grid(step: float) -> tuple[Floats, Floats]:
    """Pieces (n, 2, 3) in m of a grid around the origin, `step` m wide; their colours (n, 4), which fade outwards."""
    along, across = step * np.array(np.meshgrid(np.arange(-14, 14), np.arange(-14, 15), indexing="ij"))
    pieces = np.stack([np.stack([along + shift, across, 0 * along], -1).reshape(-1, 3) for shift in (0.0, step)], 1)
    pieces = np.concatenate([pieces, pieces[..., [1, 0, 2]]])
    far = np.linalg.norm(pieces.mean(1), axis=1) / (14 * step)
    return pieces[far < 1], to_rgba_array(HAIRLINE, 1 - far[far < 1] ** 2)
