"""The effects that blind flights may have: those of the catalogue on vehicles, and foreign ones.

Each kind draws its shape once and has one size, a positive number with which its strength grows.
"""

from __future__ import annotations

import numpy as np

from datasets.blind.kinds import Draw, Effects, Kind, Shape, plain, scale, sign, signed

BOTH, QUADROTOR, WING = ("quadrotor", "fixed_wing"), ("quadrotor",), ("fixed_wing",)

NEUTRAL: dict[str, float] = {
    **dict.fromkeys(
        (
            "actuator_bias.offset",
            "actuator_delay.delay",
            "actuator_lag.time_constant",
            "actuator_deadzone.width",
            "actuator_backlash.width",
            "constant_force.force",
            *(f"periodic_force.{name}" for name in ("amplitude", "frequency", "phase", "offset")),
            "linear_drag.coefficient",
            "quadratic_drag.coefficient",
            *(f"wind.{name}" for name in ("velocity_x", "velocity_y", "velocity_z", "coefficient")),
            *(f"periodic_wind.{name}" for name in ("amplitude", "frequency", "phase", "direction", "coefficient")),
            "payload.mass",
            "center_of_mass_offset.x",
            "center_of_mass_offset.y",
            "battery_sag.rate",
            *(f"trim_offset.{name}" for name in ("elevator", "aileron", "rudder")),
            "one_way_drag.coefficient",
            "beating_force.amplitude",
            "layer.force",
            "thrust_curve.share",
            "crossed_rates.share",
            "crossed_surfaces.share",
            *(f"rotor_drag.coefficient_{axis}" for axis in "xyz"),
            "translational_lift.coefficient",
            "motor_lag.time_constant",
            *(f"rate_damping.rate_{axis}" for axis in "xyz"),
            "ground_effect.radius",
            "ground_effect.ground",
            "dropout.rate",
            *(f"attitude_offset.{angle}" for angle in ("roll", "pitch", "yaw")),
            *(f"rate_offset.{axis}" for axis in "xyz"),
            "positioning_delay.delay",
        ),
        0.0,
    ),
    **dict.fromkeys(
        (
            "actuator_gain.scale",
            "actuator_saturation.limit",
            "thrust_gain.scale",
            "mass.scale",
            "lift_slope.scale",
            "drag.scale",
            *(f"inertia.scale_{axis}" for axis in "xyz"),
            *(f"rotor_efficiency.scale_{k}" for k in (1, 2, 3, 4)),
            *(f"control_effectiveness.scale_{name}" for name in ("elevator", "aileron", "rudder")),
        ),
        1.0,
    ),
}
"""Every parameter of every effect at the value without effect."""


def _directed(names: tuple[str, ...]) -> Draw:
    """Draws a direction in the space of some parameters."""

    def draw(rng: np.random.Generator, _: float) -> Shape:
        direction = rng.normal(size=len(names))
        direction /= np.linalg.norm(direction)
        return {name: float(value) for name, value in zip(names, direction, strict=True)}

    return draw


def _slowing(names: tuple[str, ...]) -> Draw:
    """Draws a direction with positive components."""
    return lambda rng, _: {name: abs(value) for name, value in _directed(names)(rng, 0.0).items()}


def _whole_steps(size: float, _: Shape) -> Shape:
    """A delay that is a multiple of the integration step."""
    return {"delay": 0.005 * max(1, round(size / 0.005))}


def _along(size: float, shape: Shape) -> Shape:
    return {name: size * value for name, value in shape.items()}


def _scales(size: float, shape: Shape) -> Shape:
    return {name: float(np.exp(size * value)) for name, value in shape.items()}


def _one_weak(names: tuple[str, ...]) -> Draw:
    """Draws which one of several parts is weaker than the source's."""
    return lambda rng, _: {name: -float(k == 0) for k, name in enumerate(rng.permutation(names).tolist())}


def _periodic(rng: np.random.Generator, _: float) -> Shape:
    phase = float(rng.uniform(-np.pi, np.pi))
    return {"frequency": float(np.exp(rng.uniform(np.log(0.25), np.log(2.0)))), "phase": phase}


def _windy(least: float, most: float) -> Draw:
    """Draws the direction of a wind, and the drag coefficient through which it acts."""

    def draw(rng: np.random.Generator, _: float) -> Shape:
        direction = _directed(("velocity_x", "velocity_y", "velocity_z"))(rng, 0.0)
        return direction | {"drag": float(rng.uniform(least, most))}

    return draw


def _wind(size: float, shape: Shape) -> Shape:
    return {name: size * shape[name] for name in shape if name != "drag"} | {"coefficient": shape["drag"]}


def _wavy(least: float, most: float) -> Draw:
    """The same for a wind that oscillates."""

    def draw(rng: np.random.Generator, _: float) -> Shape:
        direction, drag = float(rng.uniform(-np.pi / 2, np.pi / 2)), float(rng.uniform(least, most))
        return _periodic(rng, 0.0) | {"direction": direction, "drag": drag}

    return draw


def _waves(size: float, shape: Shape) -> Shape:
    return {"amplitude": size, "coefficient": shape["drag"]} | {n: v for n, v in shape.items() if n != "drag"}


ROTORS = tuple(f"scale_{k}" for k in (1, 2, 3, 4))
SURFACES = ("elevator", "aileron", "rudder")

NAMED: tuple[tuple[Kind, tuple[str, ...]], ...] = (
    (Kind("actuator_gain", "actuation", 0.01, 0.6, scale, sign), BOTH),
    (Kind("actuator_bias", "actuation", 0.001, 0.2, signed("offset"), sign), BOTH),
    (Kind("actuator_delay", "actuation", 0.005, 0.15, _whole_steps), BOTH),
    (Kind("actuator_lag", "actuation", 0.005, 0.2, plain("time_constant")), BOTH),
    (Kind("actuator_deadzone", "actuation", 0.003, 0.2, plain("width")), BOTH),
    (Kind("actuator_saturation", "actuation", 0.3, 2.5, lambda s, _: {"limit": float(np.exp(-s))}), BOTH),
    (Kind("actuator_backlash", "actuation", 0.005, 0.3, plain("width")), BOTH),
    (Kind("constant_force", "dynamics", 0.01, 3.0, signed("force"), sign), BOTH),
    (Kind("periodic_force", "dynamics", 0.02, 4.0, lambda s, f: {"amplitude": s, "offset": 0.0, **f}, _periodic), BOTH),
    (Kind("linear_drag", "dynamics", 0.01, 1.0, plain("coefficient")), BOTH),
    (Kind("quadratic_drag", "dynamics", 0.005, 1.0, plain("coefficient")), BOTH),
    # On the wing, wind acts without a drag coefficient.
    (Kind("wind", "dynamics", 0.5, 5.0, _wind, _windy(0.1, 0.5)), QUADROTOR),
    (Kind("wind", "dynamics", 0.05, 5.0, _wind, _windy(0.0, 0.0)), WING),
    (Kind("periodic_wind", "dynamics", 0.5, 6.0, _waves, _wavy(0.1, 0.5)), QUADROTOR),
    (Kind("periodic_wind", "dynamics", 0.05, 5.0, _waves, _wavy(0.0, 0.0)), WING),
    (Kind("thrust_gain", "dynamics", 0.005, 0.3, scale, sign), BOTH),
    (Kind("payload", "dynamics", 0.005, 0.35, plain("mass")), QUADROTOR),
    (Kind("center_of_mass_offset", "dynamics", 0.0003, 0.01, _along, _directed(("x", "y"))), QUADROTOR),
    (Kind("inertia", "dynamics", 0.05, 0.9, _scales, _directed(("scale_x", "scale_y", "scale_z"))), QUADROTOR),
    (Kind("battery_sag", "dynamics", 0.001, 0.04, plain("rate")), QUADROTOR),
    (Kind("rotor_efficiency", "dynamics", 0.005, 0.15, _scales, _one_weak(ROTORS)), QUADROTOR),
    (Kind("mass", "dynamics", 0.01, 0.4, scale, sign), WING),
    (Kind("lift_slope", "dynamics", 0.02, 0.7, scale, sign), WING),
    (Kind("drag", "dynamics", 0.03, 1.2, scale, sign), WING),
    (
        Kind("control_effectiveness", "dynamics", 0.03, 1.2, _scales, _one_weak(tuple(f"scale_{s}" for s in SURFACES))),
        WING,
    ),
    (Kind("trim_offset", "dynamics", 0.0005, 0.06, _along, _directed(SURFACES)), WING),
)
"""The core of the catalogue, from which the sets 2032 are drawn, and on which vehicle."""

REST: tuple[tuple[Kind, tuple[str, ...]], ...] = (
    (
        Kind("rotor_drag", "dynamics", 0.01, 1.5, _along, _slowing(tuple(f"coefficient_{axis}" for axis in "xyz"))),
        QUADROTOR,
    ),
    (Kind("translational_lift", "dynamics", 0.003, 0.6, plain("coefficient")), QUADROTOR),
    (Kind("motor_lag", "actuation", 0.008, 0.15, plain("time_constant")), QUADROTOR),
    (
        Kind("rate_damping", "dynamics", 0.1, 18.0, _along, _slowing(tuple(f"rate_{axis}" for axis in "xyz"))),
        QUADROTOR,
    ),
    # The ground is below nearly all targets.
    (
        Kind(
            "ground_effect",
            "dynamics",
            0.1,
            1.0,
            lambda size, shape: {"radius": size, **shape},
            lambda rng, _: {"ground": float(rng.uniform(-1.8, -1.2))},
        ),
        QUADROTOR,
    ),
    (Kind("dropout", "sensing", 0.003, 0.5, plain("rate")), BOTH),
    (Kind("attitude_offset", "sensing", 0.001, 0.25, _along, _directed(("roll", "pitch", "yaw"))), BOTH),
    (Kind("rate_offset", "sensing", 0.0005, 0.25, _along, _directed(("x", "y", "z"))), BOTH),
    (Kind("positioning_delay", "sensing", 0.01, 0.15, _whole_steps), QUADROTOR),
    # A wing flies nearly straight: a short delay shows as little but an offset of its position.
    (Kind("positioning_delay", "sensing", 0.03, 0.15, _whole_steps), WING),
)
"""The rest of the catalogue."""

FOREIGN: tuple[tuple[Kind, tuple[str, ...]], ...] = (
    (Kind("one_way_drag", "dynamics", 0.05, 3.0, plain("coefficient")), BOTH),
    (Kind("beating_force", "dynamics", 0.1, 6.0, plain("amplitude")), BOTH),
    (Kind("layer", "dynamics", 0.3, 20.0, signed("force"), sign), BOTH),
    (Kind("thrust_curve", "dynamics", 0.02, 2.0, plain("share")), BOTH),
    (Kind("crossed_rates", "dynamics", 0.02, 1.0, signed("share"), sign), QUADROTOR),
    (Kind("crossed_surfaces", "dynamics", 0.02, 1.0, signed("share"), sign), WING),
)
"""Kinds that no effect of the catalogue describes."""


def named(effects: Effects, system: str) -> list[Kind]:
    """The kinds of the catalogue that a set of a vehicle is drawn from."""
    groups = {"core": NAMED, "rest": REST, "all": NAMED + REST}
    return [kind for kind, systems in groups[effects] if system in systems]
