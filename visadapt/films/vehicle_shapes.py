"""Vehicles drawn in their true size and attitude: a quadrotor of four rotors on an X, and a simple aeroplane.

Front rotors, wing tips and fin are blue, so that ahead and behind differ.
"""

from __future__ import annotations

from itertools import pairwise

import numpy as np

from visadapt.films.canvas import Floats
from visadapt.films.colours import AIRFRAME, BLUE, INK, MUTED, Colour, blend
from visadapt.films.drawing3d import Pen
from visadapt.systems import FixedWing, Quadrotor, RigidBody


def outline(vehicle: RigidBody) -> Floats:
    """Points (n, 3) in m, in body axes, whose convex hull is the vehicle's outline."""
    if isinstance(vehicle, Quadrotor):
        return np.concatenate([rotor for rotor, _ in _rotors(vehicle)])
    return np.concatenate([shape for shape, _ in _parts(vehicle)])


def draw_vehicle(pen: Pen, vehicle: RigidBody, place: Floats, rotation: Floats) -> None:
    """Draw a vehicle at `place` (3,), turned by `rotation` (3, 3) from body to world axes, in its true size."""
    if isinstance(vehicle, Quadrotor):
        _draw_quadrotor(pen, vehicle, place, rotation)
    else:
        _draw_aeroplane(pen, vehicle, place, rotation)


def _draw_quadrotor(pen: Pen, vehicle: Quadrotor, place: Floats, rotation: Floats) -> None:
    arm = float(vehicle.arm_length)
    rotors = [(place + rotor @ rotation.T, colour) for rotor, colour in _rotors(vehicle)]
    core = 0.2 * arm * np.array([(x, y, z) for x in (-1.2, 1.2) for y in (-1, 1) for z in (-0.5, 0.6)])
    # Furthest from the camera first; arms and core are drawn between the two further and the two nearer rotors.
    rotors.sort(key=lambda rotor: -float(pen.camera.project(rotor[0])[1].mean()))
    for number, (rotor, colour) in enumerate(rotors):
        if number == 2:
            for ring, shade in rotors:
                pen.line(np.stack([place, ring.mean(0)]), blend(INK, shade, 0.15), 3)
            pen.face(place + core @ rotation.T, INK)
        pen.face(rotor, colour, 0.28)
        pen.line(np.concatenate([rotor, rotor[:1]]), colour, 2)


def _rotors(vehicle: Quadrotor) -> list[tuple[Floats, Colour]]:
    """Rims (24, 3) in m, in body axes, 0.55 arms in radius, and their colours."""
    arm = float(vehicle.arm_length)
    angle = np.linspace(0, 2 * np.pi, 24, endpoint=False)
    rim = 0.55 * arm * np.stack([np.cos(angle), np.sin(angle), 0 * angle], -1)
    reach = arm / np.sqrt(2)
    places = ((reach, reach), (reach, -reach), (-reach, -reach), (-reach, reach))
    return [(rim + np.array([x, y, 0.15 * arm]), BLUE if x > 0 else INK) for x, y in places]


def _draw_aeroplane(pen: Pen, vehicle: RigidBody, place: Floats, rotation: Floats) -> None:
    shapes = [(place + shape @ rotation.T, colour) for shape, colour in _parts(vehicle)]
    shapes.sort(key=lambda shape: -float(pen.camera.project(shape[0])[1].mean()))
    for shape, colour in shapes:
        # Level faces are lightest; the first three corners give the normal.
        normal = np.cross(shape[1] - shape[0], shape[2] - shape[0])
        lit = abs(float(normal[2])) / max(float(np.linalg.norm(normal)), 1e-9)
        pen.face(shape, blend(colour, INK, 0.3 * (1 - lit)), edge=blend(INK, MUTED, 0.5))


def _parts(vehicle: RigidBody) -> list[tuple[Floats, Colour]]:
    """Corners (n, 3) in m, in body axes, of the convex parts, and their colours; span and chord are the vehicle's."""
    model = vehicle if isinstance(vehicle, FixedWing) else FixedWing()
    half, chord = float(model.span) / 2, float(model.chord)
    parts: list[tuple[Floats, Colour]] = []
    for side in (-1.0, 1.0):
        for inner, outer, colour in ((0.0, 0.78, AIRFRAME), (0.78, 1.0, BLUE)):
            corners = [_wing(half, chord, side, share, edge) for share in (inner, outer) for edge in (0.5, -0.5)]
            parts.append((np.array(corners)[[0, 1, 3, 2]], colour))
        tail = [(-4.1, 0.0), (-4.8, 0.0), (-4.8, 2.0), (-4.3, 2.0)]
        parts.append((chord * np.array([(x, side * y, 0.25) for x, y in tail]), AIRFRAME))
    fin = [(-4.0, 0.2), (-4.8, 0.2), (-4.9, 1.5), (-4.5, 1.5)]
    parts.append((chord * np.array([(x, 0.0, z) for x, z in fin]), BLUE))
    angle = np.linspace(0, 2 * np.pi, 14, endpoint=False)
    ring = np.stack([0 * angle, np.cos(angle), np.sin(angle)], -1)
    stations = [(2.0, 0.12, 0.0), (1.4, 0.34, 0.0), (-0.8, 0.38, 0.05), (-4.8, 0.1, 0.2)]
    rings = [chord * (radius * ring + np.array([x, 0.0, z])) for x, radius, z in stations]
    parts += [(np.concatenate(two), AIRFRAME) for two in pairwise(rings)]
    return parts


def _wing(half: float, chord: float, side: float, share: float, edge: float) -> tuple[float, float, float]:
    """A point of the wing's outline, which tapers and rises towards the tips."""
    ahead = chord * ((1 - 0.3 * share) * edge - 0.1 * share)
    return ahead, side * half * share, 0.35 * chord + 0.05 * half * share
