"""Systems of one's own: a pendulum, a winch, a drive and others; and the code of docs/own_system.md."""

import re
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

import torch

from visadapt.systems import System, Variable

PAGE = Path(__file__).parents[1] / "docs" / "own_system.md"


@dataclass(frozen=True)
class Pendulum(System):
    """A pendulum on a motor that is commanded a torque in N m; 0 hangs down."""

    inertia: float | torch.Tensor = 0.05  # kg m2
    moment: float | torch.Tensor = 0.1  # kg m
    gravity: float | torch.Tensor = 9.81

    name = "pendulum"
    states: ClassVar[tuple[Variable, ...]] = (
        Variable("angle", "rad", -3.0, 3.0),
        Variable("rate", "rad/s", -12.0, 12.0),
    )
    actions: ClassVar[tuple[Variable, ...]] = (Variable("torque", "N m", -2.0, 2.0),)
    loads = (Variable("joint", "N m", -1.0, 1.0),)
    coordinates = ((0, 1),)

    def derivative(self, state, command, load):
        angle, rate = state.unbind(-1)
        (push,) = load.unbind(-1)
        weight = self.moment * self.gravity * angle.sin()
        return torch.stack((rate, (command[:, 0] + push - weight) / self.inertia), -1)


def page_code(language: str = "python") -> list[str]:
    """The page's code: the class, a script that records, one that diagnoses, a target, a script that adapts to it, and
    the class of a real machine; in TOML, a task."""
    return re.findall(rf"```{language}\n(.*?)```", PAGE.read_text(), re.DOTALL)


@dataclass(frozen=True)
class Winch(System):
    """A drum on a spring of several turns, which lifts faster than it lowers: its angle is no angle modulo a turn."""

    inertia: float | torch.Tensor = 0.01  # kg m2
    stiffness: float | torch.Tensor = 0.05  # N m/rad

    name = "winch"
    states: ClassVar[tuple[Variable, ...]] = (
        Variable("drum", "rad", 0.0, 40.0),
        Variable("speed", "rad/s", -40.0, 4.0),
    )
    actions: ClassVar[tuple[Variable, ...]] = (Variable("torque", "N m", -2.0, 2.0),)
    loads = (Variable("axis", "N m", -1.0, 1.0),)
    coordinates = ((0, 1),)

    def derivative(self, state, command, load):
        drum, speed = state.unbind(-1)
        return torch.stack((speed, (command[:, 0] + load[:, 0] - self.stiffness * drum) / self.inertia), -1)


@dataclass(frozen=True)
class Drive(System):
    """A motor that turns a disc by a compliant coupling."""

    inertia: float | torch.Tensor = 1e-4  # kg m2, of the motor
    disc: float | torch.Tensor = 4e-4  # kg m2
    stiffness: float | torch.Tensor = 0.15  # N m/rad
    damping: float | torch.Tensor = 4e-4  # N m s/rad, of the coupling
    friction: float | torch.Tensor = 1.3e-3  # N m s/rad, of the motor

    name = "drive"
    states: ClassVar[tuple[Variable, ...]] = (
        Variable("motor", "rad", -40.0, 40.0),
        Variable("disc", "rad", -40.0, 40.0),
        Variable("motor_rate", "rad/s", -60.0, 60.0),
        Variable("disc_rate", "rad/s", -60.0, 60.0),
    )
    actions: ClassVar[tuple[Variable, ...]] = (Variable("torque", "N m", -0.2, 0.2),)
    loads = (Variable("motor_shaft", "N m", -0.05, 0.05), Variable("disc_shaft", "N m", -0.05, 0.05))
    coordinates = ((0, 2), (1, 3))

    def derivative(self, state, command, load):
        motor, disc, motor_rate, disc_rate = state.unbind(-1)
        shaft = self.stiffness * (motor - disc) + self.damping * (motor_rate - disc_rate)
        first = (command[:, 0] - shaft - self.friction * motor_rate + load[:, 0]) / self.inertia
        return torch.stack((motor_rate, disc_rate, first, (shaft + load[:, 1]) / self.disc), -1)


@dataclass(frozen=True)
class Motor(System):
    """A motor that turns a wheel, whose speed alone is a state."""

    inertia: float = 0.01  # kg m2
    resistance: float = 1.0  # ohm
    constant: float = 0.05  # N m/A
    damping: float = 0.002  # N m s/rad

    name = "motor_of_a_wheel"
    states: ClassVar[tuple[Variable, ...]] = (Variable("speed", "rad/s", -150.0, 150.0),)
    actions: ClassVar[tuple[Variable, ...]] = (Variable("voltage", "V", -12.0, 12.0),)
    loads = (Variable("shaft", "N m", -0.2, 0.2),)
    coordinates = ((None, 0),)

    def __post_init__(self):
        self.check_parameters(may_be_zero=("damping",))

    def derivative(self, state, command, load):
        current = (command[:, 0] - self.constant * state[:, 0]) / self.resistance
        torque = self.constant * current + load[:, 0] - self.damping * state[:, 0]
        return torch.stack((torque / self.inertia,), -1)


@dataclass(frozen=True)
class DoublePendulum(System):
    """Two uniform links on motors at shoulder and elbow; 0 hangs down, the second angle is relative to the first."""

    mass: float | torch.Tensor = 0.6  # kg, of each link
    length: float | torch.Tensor = 0.25  # m
    gravity: float | torch.Tensor = 9.81

    name = "double_pendulum"
    states: ClassVar[tuple[Variable, ...]] = (
        Variable("angle_1", "rad", -3.2, 3.2),
        Variable("angle_2", "rad", -3.2, 3.2),
        Variable("velocity_1", "rad/s", -20.0, 20.0),
        Variable("velocity_2", "rad/s", -20.0, 20.0),
    )
    actions: ClassVar[tuple[Variable, ...]] = (
        Variable("torque_1", "N m", -6.0, 6.0),
        Variable("torque_2", "N m", -6.0, 6.0),
    )
    loads = (Variable("shoulder", "N m", -3.0, 3.0), Variable("elbow", "N m", -3.0, 3.0))
    coordinates: ClassVar[tuple[tuple[int | None, int], ...]] = ((0, 2), (1, 3))

    def derivative(self, state, command, load):
        q1, q2, v1, v2 = state.unbind(-1)
        t1, t2 = (command + load).unbind(-1)
        unit = self.mass * self.length**2
        m22, m12, m11 = unit / 3, unit * (1 / 3 + q2.cos() / 2), unit * (5 / 3 + q2.cos())
        weight = self.mass * self.gravity * self.length / 2
        upper, lower = 3 * weight * q1.sin(), weight * (q1 + q2).sin()
        f1 = t1 + unit / 2 * q2.sin() * (2 * v1 * v2 + v2**2) - upper - lower
        f2 = t2 - unit / 2 * q2.sin() * v1**2 - lower
        det = m11 * m22 - m12**2
        return torch.stack((v1, v2, (m22 * f1 - m12 * f2) / det, (m11 * f2 - m12 * f1) / det), -1)


@dataclass(frozen=True)
class Rover(System):
    """A robot on two driven wheels: its forward speed is the rate of no state."""

    mass: float | torch.Tensor = 10.0  # kg
    inertia: float | torch.Tensor = 0.5  # kg m2
    half_track: float | torch.Tensor = 0.2  # m, from the middle to a wheel
    radius: float | torch.Tensor = 0.1  # m
    damping: float | torch.Tensor = 4.0  # N s/m

    name = "rover"
    states: ClassVar[tuple[Variable, ...]] = (
        Variable("x", "m", -20.0, 20.0),
        Variable("y", "m", -20.0, 20.0),
        Variable("yaw", "rad", -3.2, 3.2),
        Variable("speed", "m/s", -3.0, 3.0),
        Variable("yaw_rate", "rad/s", -6.0, 6.0),
    )
    actions: ClassVar[tuple[Variable, ...]] = (
        Variable("left", "N m", -2.0, 2.0),
        Variable("right", "N m", -2.0, 2.0),
    )
    loads = (Variable("forward", "N", -10.0, 10.0), Variable("turn", "N m", -3.0, 3.0))
    coordinates: ClassVar[tuple[tuple[int | None, int], ...]] = ((None, 3), (2, 4))

    def derivative(self, state, command, load):
        _, _, yaw, speed, yaw_rate = state.unbind(-1)
        left, right = (wheel / self.radius for wheel in command.unbind(-1))
        force, torque = load.unbind(-1)
        force = force + left + right - self.damping * speed
        torque = torque + self.half_track * (right - left) - self.damping * self.half_track**2 * yaw_rate
        rates = (speed * yaw.cos(), speed * yaw.sin(), yaw_rate, force / self.mass, torque / self.inertia)
        return torch.stack(rates, -1)
