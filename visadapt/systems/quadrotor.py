"""A quadrotor commanded by collective thrust and body rates, with the rate loop of its flight controller.

The model of Flightmare: Song, Naji, Kaufmann, Loquercio and Scaramuzza (2020), arXiv:2009.00563. A command is the
mass-normalised thrust and three body rates; an inner loop turns the error of the rates into a torque and compensates
the gyroscopic torque. Rotors are much faster than the period of the commands and are taken to follow without delay.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar

import torch
from torch import Tensor

from visadapt.systems.base import Variable, holds
from visadapt.systems.rigid_body import RigidBody, as_column, constant, matvec, stack_parameters


@dataclass(frozen=True)
class Quadrotor(RigidBody):
    """Defaults are Flightmare's vehicle and the paper's ranges of commands (0.1 s between commands).

    >>> import visadapt as va
    >>> [variable.name for variable in va.Quadrotor.actions]
    ['thrust', 'rate_x', 'rate_y', 'rate_z']
    """

    mass: float | Tensor = 1.0  # kg
    arm_length: float | Tensor = 0.2  # m, from the centre to a rotor
    roll_gain: float | Tensor = 16.6  # 1/s, of the loops on roll and pitch rates
    yaw_gain: float | Tensor = 5.0  # 1/s
    min_thrust: float | Tensor = 2.21  # m/s2, mass-normalised, at a command of -1
    max_thrust: float | Tensor = 17.31  # m/s2, mass-normalised, at a command of 1
    max_rate: float | Tensor = 0.5  # rad/s at a command of 1
    gravity: float | Tensor = 9.81  # m/s2
    torque_to_thrust: float | Tensor = 0.016  # m, a rotor's torque about its axis for each newton of its thrust

    # Deviations that the flight controller does not know of; none by default. Effects and parameter files set them.
    payload: float | Tensor = 0.0  # kg, the part of `mass` that is a load at the centre
    centre_x: float | Tensor = 0.0  # m, position of the centre of mass ahead of the rotors' centre
    centre_y: float | Tensor = 0.0  # m, to the left of it
    inertia_scale_x: float | Tensor = 1.0  # true moment of inertia about x over the one that the rate loops assume
    inertia_scale_y: float | Tensor = 1.0  # the same about y
    inertia_scale_z: float | Tensor = 1.0  # the same about z
    damping_x: float | Tensor = 0.0  # 1/s, aerodynamic torque over the rate and the inertia that the rate loops assume
    damping_y: float | Tensor = 0.0  # the same about y
    damping_z: float | Tensor = 0.0  # the same about z
    rotor_1: float | Tensor = 1.0  # thrust of the front left rotor over the thrust commanded of it
    rotor_2: float | Tensor = 1.0  # of the front right rotor
    rotor_3: float | Tensor = 1.0  # of the rear right rotor
    rotor_4: float | Tensor = 1.0  # of the rear left rotor
    wind_x: float | Tensor = 0.0  # m/s, velocity of the air in world axes; only effects such as drag depend on it
    wind_y: float | Tensor = 0.0  # m/s
    wind_z: float | Tensor = 0.0  # m/s

    name: ClassVar[str] = "quadrotor"
    longest_step: ClassVar[float | None] = 0.07  # the rate loop decays at 16.6 1/s
    actions: ClassVar[tuple[Variable, ...]] = tuple(
        Variable(name, "1", -1.0, 1.0) for name in ("thrust", "rate_x", "rate_y", "rate_z")
    )

    def __post_init__(self) -> None:
        self.check_parameters(either_sign=_EITHER_SIGN, may_be_zero=_MAY_BE_ZERO)
        if not holds(self.max_thrust > self.min_thrust):
            raise ValueError(
                f"quadrotor: max_thrust must exceed min_thrust, got {self.max_thrust!r} and {self.min_thrust!r}"
            )
        if not holds(self.mass > self.payload):
            raise ValueError(f"quadrotor: mass must exceed payload, got {self.mass!r} and {self.payload!r}")

    def inertia(self, like: Tensor) -> Tensor:
        known = self.known_inertia(like)
        scales = (self.inertia_scale_x, self.inertia_scale_y, self.inertia_scale_z)
        return known * stack_parameters(scales, like)[..., None] if _differ(scales, 1.0) else known

    def known_inertia(self, like: Tensor) -> Tensor:
        """Moments of inertia that the rate loops assume, kg m2: (3, 3), or (B, 3, 3).

        Flightmare's plate with rotors: m l^2 / 12 times (4.5, 4.5, 7) about x, y and z.
        """
        size = stack_parameters(((self.mass - self.payload) * self.arm_length**2 / 12,), like)
        shape = constant((4.5, 0.0, 0.0, 0.0, 4.5, 0.0, 0.0, 0.0, 7.0), like.dtype, like.device).view(3, 3)
        return size[..., None] * shape

    def thrust(self, command: Tensor) -> Tensor:
        """Mass-normalised thrust (B,) in m/s2 at commands (B, 4)."""
        middle, half = (self.max_thrust + self.min_thrust) / 2, (self.max_thrust - self.min_thrust) / 2
        return middle + half * command[:, 0]

    def wrench(self, velocity: Tensor, rates: Tensor, command: Tensor) -> tuple[Tensor, Tensor]:
        commanded = as_column(self.max_rate) * command[:, 1:]
        gain = stack_parameters((self.roll_gain, self.roll_gain, self.yaw_gain), rates)
        inertia = self.known_inertia(rates)
        torque = matvec(inertia, gain * (commanded - rates)) + torch.linalg.cross(rates, matvec(inertia, rates))
        thrust = (self.mass - self.payload) * self.thrust(command)
        if _differ((self.rotor_1, self.rotor_2, self.rotor_3, self.rotor_4), 1.0):
            thrust, torque = self._delivered(thrust, torque)
        if _differ((self.centre_x, self.centre_y), 0.0):
            torque = torque + thrust[:, None] * stack_parameters((-self.centre_y, self.centre_x, 0.0), torque)
        damping = (self.damping_x, self.damping_y, self.damping_z)
        if _differ(damping, 0.0):
            torque = torque - matvec(inertia, stack_parameters(damping, rates) * rates)
        force = torch.zeros_like(velocity)
        force[:, 2] = thrust
        return force, torque

    def hover(self) -> float | Tensor:
        """The thrust command that balances the weight with rotors that deliver what is commanded."""
        middle, half = (self.max_thrust + self.min_thrust) / 2, (self.max_thrust - self.min_thrust) / 2
        return (self.gravity * (self.mass / (self.mass - self.payload)) - middle) / half

    def _delivered(self, thrust: Tensor, torque: Tensor) -> tuple[Tensor, Tensor]:
        """Thrust (B,) and torque (B, 3) where each rotor delivers a share of the thrust that is commanded of it."""
        lever = self.arm_length / math.sqrt(2)
        levers = stack_parameters((1.0, lever, lever, self.torque_to_thrust), torque)
        mixer = torque.new_tensor(_MIXER)
        shares = stack_parameters((self.rotor_1, self.rotor_2, self.rotor_3, self.rotor_4), torque)
        # The mixer's rows are orthogonal and of length 2: its transpose is 4 times its inverse.
        commanded = torch.cat((thrust[:, None], torque), 1) / levers @ mixer / 4
        delivered = (shares * commanded) @ mixer.mT * levers
        return delivered[:, 0], delivered[:, 1:]


_EITHER_SIGN = ("centre_x", "centre_y", "wind_x", "wind_y", "wind_z")  # Parameters that may be negative
_MAY_BE_ZERO = (
    *("min_thrust", "payload", "rotor_1", "rotor_2", "rotor_3", "rotor_4"),
    *("damping_x", "damping_y", "damping_z"),
)
"""Parameters that may be 0."""
_MIXER = ((1.0, 1.0, 1.0, 1.0), (1.0, -1.0, -1.0, 1.0), (-1.0, -1.0, 1.0, 1.0), (1.0, -1.0, 1.0, -1.0))
"""Signs with which rotors 1 to 4 add to the thrust and to the torques about x, y and z (Flightmare's allocation)."""


def _differ(values: Sequence[float | Tensor], nominal: float) -> bool:
    """Whether one of the parameters may differ from its nominal value; a tensor always may."""
    return any(isinstance(value, Tensor) or value != nominal for value in values)
