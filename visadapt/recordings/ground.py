"""Rows in which a vehicle stands on the ground, before it takes off and after it has landed: no load of its physics
holds it there."""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray

from visadapt.recordings.clock import Note, RawEpisode
from visadapt.systems import RigidBody, System

STILL_M = 0.05  # Distance from where it stands up to which a vehicle stands

FALLS = 0.5
"""Share of gravity by which a vehicle must accelerate down, if nothing holds it, to be taken to stand."""


def in_flight(raw: RawEpisode, system: System, note: Note) -> RawEpisode:
    """The episode of a vehicle without the rows in which it stands, at either end; another system's as it is."""
    if not isinstance(system, RigidBody) or not {"x", "y", "z"} <= {*raw.measured}:
        return raw
    rows = max(2, round(system.prediction_time / float(np.median(np.diff(raw.time))))) if len(raw.time) > 2 else 0
    if not 0 < 2 * rows < len(raw.time):
        return raw
    states = raw.states
    position = np.column_stack([np.convolve(states[name], np.full(rows, 1 / rows), "valid") for name in "xyz"])
    falls = _falls(raw, system)
    before, after = _standing(position, falls, rows), _standing(position[::-1], falls[::-1], rows)
    if before + after + rows > len(raw.time):
        return raw
    if before:
        note(f"{before} rows before the take-off are left out", raw.origin)
    if after:
        note(f"{after} rows after the landing are left out", raw.origin)
    return raw.part(before, len(raw.time) - after)


def _falls(raw: RawEpisode, system: RigidBody) -> NDArray[np.bool_]:
    """Whether the vehicle would accelerate down in each row (T,), at rest in its attitude, if nothing held it."""
    state = torch.zeros(len(raw.time), len(system.states), dtype=torch.float64)
    state[:, system.index("q_w")] = 1
    for name, values in raw.states.items():
        if name.startswith("q_"):
            state[:, system.index(name)] = torch.from_numpy(values)
    load = torch.zeros(len(state), len(system.loads), dtype=torch.float64)
    change = system.derivative(state, torch.from_numpy(raw.action), load)
    acceleration: NDArray[np.float64] = change[:, system.index("z_dot")].numpy()
    falls: NDArray[np.bool_] = ~(acceleration > -FALLS * float(system.gravity))  # NaN of a wing without airspeed
    return falls


def _standing(position: NDArray[np.float64], falls: NDArray[np.bool_], rows: int) -> int:
    """The number of rows at the start in which a vehicle stands: it is to fall in the first `rows`, and stays within
    STILL_M of where it is then, as means (T - rows + 1, 3) over so many rows show."""
    moved = np.linalg.norm(position - position[0], axis=1) > STILL_M
    if not falls[:rows].all() or moved[:rows].any():
        return 0
    return int(moved.argmax()) + rows - 1 if moved.any() else len(falls)
