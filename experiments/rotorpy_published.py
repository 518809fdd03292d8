"""What rotorpy publishes of its vehicle, in our parameters, to compare with what was fitted or diagnosed."""

from __future__ import annotations

import numpy as np

from visadapt.targets.rotorpy import RotorpyTarget


def published(target: RotorpyTarget) -> dict[str, float]:
    """What rotorpy's parameters give at the rotor speed of a hover; damping, in 1/s, is that of rotations."""
    own = target.vehicle
    flow = 4 * float(np.sqrt(own["mass"] * 9.81 / 4 / own["k_eta"])) / own["mass"]
    drag = {"drag_x": own["k_d"] * flow, "drag_y": own["k_d"] * flow, "drag_z": own["k_z"] * flow}
    # In a rotation a rotor at (x, y) moves: its drag along z damps rotations about x and y, its level drag about z.
    x, y = np.mean([np.square(place[:2]) for place in own["rotor_pos"].values()], 0)
    levers = {
        "x": own["k_z"] * y / own["Ixx"],
        "y": own["k_z"] * x / own["Iyy"],
        "z": own["k_d"] * (x + y) / own["Izz"],
    }
    damping = {f"damping_{axis}": float(lever) * flow * own["mass"] for axis, lever in levers.items()}
    wind = dict(zip(("wind_x", "wind_y"), target.air.steady[:2], strict=True))
    return {**drag, **damping, "lift": 4 * own["k_h"] / own["mass"], "lag": own["tau_m"], **wind}
