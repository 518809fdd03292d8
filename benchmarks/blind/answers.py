"""The baselines' fits as answers in the JSON of docs/diagnosis.md."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from benchmarks.blind.fitting import Data, Fit
from benchmarks.blind.onestep import Steps, Values
from benchmarks.blind.scoring import REGION, Answer

UNITS: dict[str, dict[str, str]] = {
    "actuator_gain": {"scale": "1"},
    "actuator_bias": {"offset": "1"},
    "actuator_delay": {"delay": "s"},
    "actuator_lag": {"time_constant": "s"},
    "actuator_deadzone": {"width": "1"},
    "actuator_saturation": {"limit": "1"},
    "actuator_backlash": {"width": "1"},
    "constant_force": {"force": "N"},
    "periodic_force": {"amplitude": "N", "frequency": "Hz", "phase": "rad", "offset": "N"},
    "gust": {"start": "s", "end": "s", "force": "N"},
    "viscous_friction": {"coefficient": "N s/m"},
    "coulomb_friction": {"force": "N"},
    "quadratic_drag": {"coefficient": "N s2/m2"},
    "friction_patch": {"start": "m", "end": "m", "coefficient": "N s/m"},
    "spring": {"stiffness": "N/m", "rest": "m"},
    "pole_damping": {"coefficient": "N m s/rad"},
    "track_tilt": {"angle": "rad"},
    "cart_mass": {"scale": "1"},
    "pole_mass": {"scale": "1"},
    "pole_length": {"scale": "1"},
    "angle_offset": {"offset": "rad"},
    "measurement_delay": {"delay": "s"},
    "sensor_scale": {"position": "1", "angle": "1"},
    "frozen_zone": {"start": "rad", "end": "rad"},
    "dropout": {"rate": "1"},
}
"""units of every parameter by effect"""

FLIGHT_UNITS: dict[str, dict[str, str]] = {
    **{name: UNITS[name] for name in UNITS if name.startswith("actuator_")},
    **{name: UNITS[name] for name in ("constant_force", "periodic_force", "quadratic_drag")},
    "linear_drag": {"coefficient": "N s/m"},
    "wind": {**{f"velocity_{axis}": "m/s" for axis in "xyz"}, "coefficient": "N s/m"},
    "periodic_wind": {
        "amplitude": "m/s",
        "frequency": "Hz",
        "phase": "rad",
        "direction": "rad",
        "coefficient": "N s/m",
    },
    "thrust_gain": {"scale": "1"},
}
FLIGHT: dict[str, dict[str, dict[str, str]]] = {
    "quadrotor": {
        **FLIGHT_UNITS,
        "payload": {"mass": "kg"},
        "battery_sag": {"rate": "1/s"},
        "center_of_mass_offset": {"x": "m", "y": "m"},
        "inertia": {f"scale_{axis}": "1" for axis in "xyz"},
        "rotor_efficiency": {f"scale_{k}": "1" for k in (1, 2, 3, 4)},
    },
    "fixed_wing": {
        **FLIGHT_UNITS,
        **{name: {"scale": "1"} for name in ("mass", "lift_slope", "drag")},
        "control_effectiveness": {f"scale_{name}": "1" for name in ("elevator", "aileron", "rudder")},
        "trim_offset": dict.fromkeys(("elevator", "aileron", "rudder"), "rad"),
    },
}
"""the same of the vehicles"""

DELAYS = {"actuator_delay": "measurement_delay", "measurement_delay": "actuator_delay"}
ALIKE: dict[str, dict[str, str]] = {
    "cartpole": {"actuator_bias": "constant_force", "constant_force": "actuator_bias", **DELAYS},
    "quadrotor": {"thrust_gain": "payload", "payload": "thrust_gain", **DELAYS},
    "fixed_wing": DELAYS,
}
"""pairs that fit all data of a system equally well"""


def units_of(system: str) -> dict[str, dict[str, str]]:
    """Units of every parameter by effect."""
    return FLIGHT.get(system, UNITS)


def answer_of(data: Data, fits: Sequence[Fit], verdict: str) -> Answer:
    """The lowest BIC is the answer, its exponential the probabilities (up to a common factor); fits[0] is the source.

    `closed` is in-sample and one step ahead, since the methods know nothing else: of the root mean squared residual
    (1 is the noise) what the set takes away.
    """
    ordered = sorted(fits, key=lambda f: f.bic)
    best, n = ordered[0], data.size
    weights = np.exp(-0.5 * np.array([f.bic - best.bic for f in ordered]))
    weights /= weights.sum()
    before, after = (float(np.sqrt(f.chi2 / n)) for f in (fits[0], best))
    causes: list[dict[str, Any]] = []
    if verdict == "identified":
        causes = [cause_of(e, best.values, best.deviations, data, float(weights[0])) for e in best.effects]
        if any(cause["indistinguishable_from"] for cause in causes):
            verdict = "ambiguous"
    return {
        "schema": 1,
        "system": data.system,
        "verdict": verdict,
        "where": {"regions": [region for cause in causes for region in _region(cause)]},
        "causes": causes,
        "ranking": [
            {"effects": f.effects, "probability": float(w), "gap_closed": None}
            for f, w in zip(ordered[:10], weights, strict=False)
        ],
        "gap": {
            "measure": "one-step residual over its noise, RMS, in sample",
            "before": before,
            "after": after,
            "floor": 1.0,
            "closed": (before - after) / (before - 1.0) if before > 1.0 else None,
        },
    }


def cause_of(effect: str, values: Values, deviations: Values, data: Data, probability: float) -> dict[str, Any]:
    """One cause; its intervals are 1.645 standard deviations to each side, without any where nothing was fitted."""
    own = {name.split(".")[1]: v for name, v in values.items() if name.startswith(f"{effect}.")}
    spread = {name.split(".")[1]: d for name, d in deviations.items() if name.startswith(f"{effect}.")}
    if effect == "periodic_force":
        # A cos(wt + phi) = A cos(phi) cos(wt) - A sin(phi) sin(wt).
        own["amplitude"], own["phase"] = (
            float(np.hypot(own["cosine"], own["sine"])),
            -float(np.arctan2(own["sine"], own["cosine"])),
        )
        spread["amplitude"] = max(spread.get("cosine", 0.0), spread.get("sine", 0.0))
    elif effect == "spring":
        own["rest"] = own["pull"] / own["stiffness"] if own["stiffness"] else 0.0
    elif effect == "dropout" and isinstance(data, Steps):
        own["rate"], spread["rate"] = data.rate, float(np.sqrt(data.rate * (1 - data.rate) / data.commands.size))
    elif effect == "frozen_zone" and isinstance(data, Steps):
        own["start"], own["end"] = data.zone or (0.0, 0.0)
    parameters: dict[str, Any] = {}
    for name, unit in units_of(data.system)[effect].items():
        interval = [own[name] - 1.645 * spread[name], own[name] + 1.645 * spread[name]] if name in spread else None
        parameters[name] = {"value": own[name], "unit": unit, "ci90": interval}
    alike = [name for own_name, name in ALIKE[data.system].items() if own_name == effect]
    return {
        "effect": effect,
        "parameters": parameters,
        "probability": probability / (1 + len(alike)),
        "gap_closed": None,
        "indistinguishable_from": alike,
    }


def _region(cause: dict[str, Any]) -> list[dict[str, Any]]:
    if cause["effect"] not in REGION:
        return []
    start, end = (cause["parameters"][name]["value"] for name in ("start", "end"))
    return [{"variable": REGION[cause["effect"]], "from": start, "to": end, "share": 1.0, "p_value": None}]
