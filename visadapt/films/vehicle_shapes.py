"""Vehicles in their true size: a quadrotor of four rotors on an X, and a simple aeroplane.

Front rotors, wing tips and fin are blue, so that ahead and behind differ.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import cv2
import numpy as np
from matplotlib.colors import to_rgba

from visadapt.films.widgets import AIRFRAME, BLUE, INK, MUTED, Floats
from visadapt.systems import FixedWing, Quadrotor, RigidBody

ROUND = np.stack([f(np.linspace(0, 2 * np.pi, 41)) for f in (np.cos, np.sin)], -1)
"""(41, 2), of a closed unit circle"""


@dataclass(frozen=True)
class Part:
    """A convex part of a vehicle."""

    corners: Floats
    """(n, 3) m, in body axes"""
    colour: str
    edge: str = MUTED
    width: float = 1.0
    """px, of the edge"""
    opacity: float = 1.0


def vehicle_parts(vehicle: RigidBody) -> list[Part]:
    """The parts of a vehicle; what is not a quadrotor is an aeroplane, with span and chord of a fixed wing."""
    if isinstance(vehicle, Quadrotor):
        arm = float(vehicle.arm_length)
        rim = 0.55 * arm * np.column_stack([ROUND, np.zeros(len(ROUND))])
        parts = [
            Part(0.2 * arm * np.array([(x, y, z) for x in (-1.2, 1.2) for y in (-1, 1) for z in (-0.5, 0.6)]), INK)
        ]
        for ahead, left in ((1, 1), (1, -1), (-1, -1), (-1, 1)):
            hub, colour = arm * np.array([ahead / np.sqrt(2), left / np.sqrt(2), 0.15]), BLUE if ahead > 0 else INK
            parts += [Part(np.stack([0 * hub, hub]), INK, INK, 3), Part(rim + hub, colour, colour, 2, 0.28)]
        return parts
    model = vehicle if isinstance(vehicle, FixedWing) else FixedWing()
    half, chord = float(model.span) / 2, float(model.chord)
    parts = []
    for side in (-1.0, 1.0):
        for inner, outer, colour in ((0.0, 0.78, AIRFRAME), (0.78, 1.0, BLUE)):
            # The wing tapers and rises towards its tips.
            around = ((inner, 0.5), (inner, -0.5), (outer, -0.5), (outer, 0.5))
            wing = [
                (chord * ((1 - 0.3 * s) * e - 0.1 * s), side * half * s, 0.35 * chord + 0.05 * half * s)
                for s, e in around
            ]
            parts.append(Part(np.array(wing), colour))
        tail = [(-4.1, 0.0), (-4.8, 0.0), (-4.8, 2.0), (-4.3, 2.0)]
        parts.append(Part(chord * np.array([(x, side * y, 0.25) for x, y in tail]), AIRFRAME))
    fin = [(-4.0, 0.2), (-4.8, 0.2), (-4.9, 1.5), (-4.5, 1.5)]
    parts.append(Part(chord * np.array([(x, 0.0, z) for x, z in fin]), BLUE))
    stations = [(2.0, 0.12, 0.0), (1.4, 0.34, 0.0), (-0.8, 0.38, 0.05), (-4.8, 0.1, 0.2)]
    rings = [
        chord * (np.column_stack([np.full(len(ROUND), x), radius * ROUND]) + np.array([0, 0, z]))
        for x, radius, z in stations
    ]
    return parts + [Part(np.concatenate(two), AIRFRAME) for two in pairwise(rings)]


def hull(points: Floats) -> Floats:
    """The corners (m, 2) of the convex hull of points (n, 2)."""
    return np.asarray(cv2.convexHull(points.astype(np.float32))[:, 0], float)


def drawn_parts(
    parts: list[Part], position: Floats, attitude: Floats, project: Callable[[Floats], tuple[Floats, Floats]]
) -> tuple[Floats, dict[str, Any]]:
    """Corners (n, 3) of a vehicle at `position` (3,) turned by `attitude` (3, 3), and what a PolyCollection is to show.

    `project` gives where points (n, 3) are seen (n, 2) and how deep (n,), nan where they are not.
    """
    corners, drawn = [position + part.corners @ attitude.T for part in parts], []
    for part, points in zip(parts, corners, strict=True):
        seen, depth = project(points)
        if np.isfinite(depth).all():
            # Level faces are lightest; neighbouring corners give the normal.
            normal = np.cross(points[1] - points[0], points[-2] - points[0])
            lit = 0.75 + 0.25 * abs(normal[2]) / max(float(np.linalg.norm(normal)), 1e-9)
            face = (*(lit * channel for channel in to_rgba(part.colour)[:3]), part.opacity)
            drawn.append((-float(depth.mean()), hull(seen), face, part.edge, part.width))
    drawn.sort(key=lambda each: each[0])  # the furthest part is drawn first
    names = ("verts", "facecolors", "edgecolors", "linewidths")
    return np.concatenate(corners), {name: [each[k] for each in drawn] for k, name in enumerate(names, 1)}
