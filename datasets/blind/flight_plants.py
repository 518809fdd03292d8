"""The quadrotor and fixed wing that make the blind flights: code of its own, not the library's (numpy alone, float64).

A batch of N vehicles, each with its own effects: every effect is always in the equations, with neutral parameters (N,)
where it does not act. Attitude is a rotation matrix. The quadrotor's axes are x forward, y left, z up.
The wing's equations are the book's (Beard and McLain 2012, chapters 3 and 4): x forward, y right, z down; its states
are turned into the other axes, and back, by a half turn about x.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Parameters = dict[str, Array]
"""`effect.parameter` -> (N,)"""

GRAVITY = 9.81
FLIP = np.array([1.0, -1.0, -1.0])
"""a half turn about x"""


@dataclass
class Motion:
    """N rigid bodies: positions and velocities in world axes (z up), rotations from body to world axes, body rates."""

    place: Array
    """(N, 3) m"""
    velocity: Array
    """(N, 3) m/s"""
    turned: Array
    """(N, 3, 3)"""
    rates: Array
    """(N, 3) rad/s"""
    motors: Array
    """(N or 1, 4) what a quadrotor's motors give: thrust in m/s2, torques in N m; used where they lag"""

    def plus(self, other: Motion, h: float) -> Motion:
        """A step of `h` along a derivative."""
        return Motion(
            self.place + h * other.place,
            self.velocity + h * other.velocity,
            self.turned + h * other.turned,
            self.rates + h * other.rates,
            self.motors + h * other.motors,
        )


Plant = Callable[[Parameters, float, Motion, Array], Motion]
"""(parameters, time in s, motion, commands (N, 4)) -> its time derivative"""


def step(plant: Plant, p: Parameters, time: float, at: Motion, command: Array, h: float) -> Motion:
    """One step of the classical Runge-Kutta method; the rotation matrices are then made orthogonal again."""
    a = plant(p, time, at, command)
    b = plant(p, time + h / 2, at.plus(a, h / 2), command)
    c = plant(p, time + h / 2, at.plus(b, h / 2), command)
    d = plant(p, time + h, at.plus(c, h), command)
    for slope, weight in ((a, 1), (b, 2), (c, 2), (d, 1)):
        at = at.plus(slope, h * weight / 6)
    # One Newton iteration towards the nearest rotation, which leaves the square of the step's error.
    at.turned = at.turned @ (3 * np.eye(3) - at.turned.swapaxes(1, 2) @ at.turned) / 2
    return at


def _spun(turned: Array, rates: Array) -> Array:
    """R' = R [rates]x."""
    x, y, z = rates.T
    zero = np.zeros_like(x)
    skew = np.stack([zero, -z, y, z, zero, -x, -y, x, zero], -1).reshape(-1, 3, 3)
    return turned @ skew


def _wind(p: Parameters, t: float) -> Array:
    """(N, 3) m/s, of the air."""
    level = p["periodic_wind.amplitude"] * np.cos(
        2 * np.pi * p["periodic_wind.frequency"] * t + p["periodic_wind.phase"]
    )
    direction = p["periodic_wind.direction"]
    x = p["wind.velocity_x"] + level * np.cos(direction)
    y = p["wind.velocity_y"] + level * np.sin(direction)
    return np.stack([x, y, p["wind.velocity_z"]], -1)


def _pushes(p: Parameters, t: float, at: Motion) -> Array:
    """(N, 3) N in world axes: drags, forces along x, and foreign forces."""
    air = at.velocity - _wind(p, t)
    linear = p["linear_drag.coefficient"] + p["wind.coefficient"] + p["periodic_wind.coefficient"]
    speed = np.linalg.norm(air, axis=1)
    force = -(linear + p["quadratic_drag.coefficient"] * speed)[:, None] * air
    force[:, 0] += p["constant_force.force"] + p["periodic_force.offset"]
    angle = 2 * np.pi * p["periodic_force.frequency"] * t + p["periodic_force.phase"]
    force[:, 0] += p["periodic_force.amplitude"] * np.cos(angle)
    # Foreign: drag to one side only, a force with two spectral lines, a force field in a layer of heights.
    force[:, 1] -= p["one_way_drag.coefficient"] * np.maximum(at.velocity[:, 1], 0.0)
    force[:, 0] += p["beating_force.amplitude"] * np.cos(9.0 * t) * np.cos(1.9 * t + 1.0)
    away = at.place[:, 2] - 0.2
    force[:, 1] += p["layer.force"] * away * np.exp(-(away**2) / 0.18)
    return force


ARM, RATE_GAINS = 0.2, np.array([16.6, 16.6, 5.0])
LEAST, MOST = 2.21, 17.31
"""m/s2 of thrust at commands of -1 and 1"""
RESTING = np.array([[(LEAST + MOST) / 2, 0.0, 0.0, 0.0]])
"""thrust and torques of motors that have settled at a command of 0"""
INERTIA = ARM**2 / 12 * np.array([4.5, 4.5, 7.0])
"""kg m2 of a mass of 1 kg"""
ROLL = np.array([1.0, -1.0, -1.0, 1.0]) * ARM / np.sqrt(2)
PITCH = np.array([-1.0, -1.0, 1.0, 1.0]) * ARM / np.sqrt(2)
YAW = np.array([1.0, -1.0, 1.0, -1.0]) * 0.016
"""m: torques per N of each rotor; front left, front right, rear right, rear left"""
ALLOCATION = np.linalg.inv(np.stack([np.ones(4), ROLL, PITCH, YAW]))
"""thrust and torques to rotors"""


def quadrotor(p: Parameters, t: float, at: Motion, command: Array) -> Motion:
    """Flightmare's vehicle of 1 kg: collective thrust and body rates, carried out by a rate loop."""
    w = at.rates
    asked = (LEAST + MOST) / 2 + (MOST - LEAST) / 2 * command[:, 0]
    asked = asked * (1 + p["thrust_curve.share"] * command[:, 0] ** 2)
    rates = 0.5 * command[:, 1:]
    rates[:, 1] += p["crossed_rates.share"] * rates[:, 0]
    torque = INERTIA * RATE_GAINS * (rates - w) + np.cross(w, INERTIA * w)
    driven = np.concatenate([asked[:, None], torque], 1)
    constant = p["motor_lag.time_constant"][:, None]
    motors = np.where(constant > 0, (driven - at.motors) / np.maximum(constant, 1e-9), 0.0)
    given = np.where(constant > 0, at.motors, driven)
    thrust, torque = given[:, 0], given[:, 1:]
    thrust = thrust * p["thrust_gain.scale"] * np.exp(-p["battery_sag.rate"] * t) * _ground_factor(p, at)
    scales = np.stack([p[f"rotor_efficiency.scale_{k}"] for k in (1, 2, 3, 4)], -1)
    rotors = scales * (np.concatenate([thrust[:, None], torque], 1) @ ALLOCATION.T)
    thrust = rotors.sum(1)
    torque = np.stack([rotors @ ROLL, rotors @ PITCH, rotors @ YAW], -1)
    torque[:, 0] -= p["center_of_mass_offset.y"] * thrust
    torque[:, 1] += p["center_of_mass_offset.x"] * thrust
    torque = torque - INERTIA * np.stack([p[f"rate_damping.rate_{axis}"] for axis in "xyz"], -1) * w
    air = np.einsum("nij,ni->nj", at.turned, at.velocity - _wind(p, t))
    braked = -np.stack([p[f"rotor_drag.coefficient_{axis}"] for axis in "xyz"], -1) * air
    thrust = thrust + p["translational_lift.coefficient"] * (air[:, 0] ** 2 + air[:, 1] ** 2)
    inertia = INERTIA * np.stack([p[f"inertia.scale_{axis}"] for axis in "xyz"], -1)
    force = at.turned[:, :, 2] * thrust[:, None] + np.einsum("nij,nj->ni", at.turned, braked) + _pushes(p, t, at)
    acceleration = force / (1 + p["payload.mass"])[:, None] - [0, 0, GRAVITY]
    turning = (torque - np.cross(w, inertia * w)) / inertia
    return Motion(at.velocity, acceleration, _spun(at.turned, w), turning, motors)


def _ground_factor(p: Parameters, at: Motion) -> Array:
    """The ground's factor on thrust: 1 / (1 - x) with x = (radius / 4 height)^2, which is kept below 1/4.

    The bound, x / (1 + (4 x)^4)^(1/4), is written so that neither a radius nor a height of 0 is divided by.
    """
    square, height = p["ground_effect.radius"] ** 2, np.maximum(at.place[:, 2] - p["ground_effect.ground"], 0.0)
    x = square / np.maximum((4 * height) ** 8 + (4 * square) ** 4, 1e-30) ** 0.25
    return np.asarray(1 / (1 - x))


MASS, AREA, SPAN, CHORD, DENSITY = 1.01, 0.276, 1.54, 0.185, 1.225
J = np.array([[0.04766, 0.0, 0.00105], [0.0, 0.05005, 0.0], [0.00105, 0.0, 0.09558]])
"""kg m2, x forward, y right, z down"""
J_INVERSE = np.linalg.inv(J)
SURFACES = np.deg2rad([20.0, 2.5, 20.0])
"""elevator, aileron, rudder at a command of 1"""
HELD = np.deg2rad(10.0)
"""rad, beyond which coefficients no longer grow with angle of attack and sideslip"""


def fixed_wing(p: Parameters, t: float, at: Motion, command: Array) -> Motion:
    """Waldock's aeroplane."""
    air = FLIP * np.einsum("nij,ni->nj", at.turned, at.velocity - _wind(p, t))
    u, v, w = air.T
    speed = np.linalg.norm(air, axis=1)
    pressure = 0.5 * DENSITY * speed**2 * AREA
    alpha, beta = np.arctan2(w, u), np.arctan2(v, np.hypot(u, w))
    along, up = np.cos(alpha), np.sin(alpha)
    alpha, beta = np.clip(alpha, -HELD, HELD), np.clip(beta, -HELD, HELD)
    rates = FLIP * at.rates
    roll, pitch, yaw = (rates * np.array([SPAN, CHORD, SPAN]) / (2 * speed[:, None])).T
    names = ("elevator", "aileron", "rudder")
    scales = np.stack([p[f"control_effectiveness.scale_{name}"] for name in names], -1)
    offsets = np.stack([p[f"trim_offset.{name}"] for name in names], -1)
    elevator, aileron, rudder = (SURFACES * scales * command[:, 1:] + offsets).T
    elevator = elevator + p["crossed_surfaces.share"] * SURFACES[0] * np.abs(command[:, 3])
    lift = 0.39 + 4.5321 * p["lift_slope.scale"] * alpha + 0.318 * pitch + 0.527 * elevator
    drag = 0.0765 * p["drag.scale"] + 0.3346 * alpha + 0.354 * pitch + 0.004 * elevator
    side = -0.033 * beta - 0.1 * roll + 0.039 * yaw + 0.225 * rudder
    moment = np.stack(
        [
            SPAN * (-0.081 * beta - 0.529 * roll + 0.159 * yaw - 0.453 * aileron + 0.005 * rudder),
            CHORD * (0.02 - 1.4037 * alpha - 0.1324 * pitch - 0.4236 * elevator),
            SPAN * (0.189 * beta - 0.083 * roll - 0.948 * yaw - 0.041 * aileron - 0.077 * rudder),
        ],
        -1,
    )
    thrust = 7.0 * p["thrust_gain.scale"] * (command[:, 0] + 1) / 2
    thrust = thrust * (1 + p["thrust_curve.share"] * command[:, 0] ** 2)
    force = pressure[:, None] * np.stack([lift * up - drag * along, side, -lift * along - drag * up], -1)
    force[:, 0] += thrust
    world = np.einsum("nij,nj->ni", at.turned, FLIP * force) + _pushes(p, t, at)
    acceleration = world / (MASS * p["mass.scale"])[:, None] - [0, 0, GRAVITY]
    turning = (pressure[:, None] * moment - np.cross(rates, rates @ J.T)) @ J_INVERSE.T
    still = np.zeros_like(at.motors)
    return Motion(at.velocity, acceleration, _spun(at.turned, at.rates), FLIP * turning, still)


PLANTS: dict[str, Plant] = {"quadrotor": quadrotor, "fixed_wing": fixed_wing}
