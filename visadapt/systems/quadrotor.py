"""A quadrotor that takes a collective thrust and body rates, as a flight controller's rate loop carries them out.

The model of Flightmare: Song, Naji, Kaufmann, Loquercio and Scaramuzza (2020), arXiv:2009.00563. A command is the
mass-normalised thrust and three body rates; an inner loop turns the error of the rates into a torque and undoes the
gyroscopic torque. Rotors are fast beside the period of the commands, and follow at once.
"""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import ClassVar

import torch
from torch import Tensor

from visadapt.systems.base import Variable
from visadapt.systems.rigid_body import RigidBody, columns, times


@dataclass(frozen=True)
class Quadrotor(RigidBody):
    """Defaults are Flightmare's vehicle and the paper's ranges of commands (0.1 s between commands)."""

    mass: float | Tensor = 1.0
    """kg"""
    arm_length: float | Tensor = 0.2
    """m, from the centre to a rotor"""
    roll_gain: float | Tensor = 16.6
    """1/s, of the loops on roll and pitch rates"""
    yaw_gain: float | Tensor = 5.0
    """1/s"""
    min_thrust: float | Tensor = 2.21
    """m/s2, mass-normalised, at a command of -1"""
    max_thrust: float | Tensor = 17.31
    """m/s2, mass-normalised, at a command of 1"""
    max_rate: float | Tensor = 0.5
    """rad/s at a command of 1"""
    gravity: float | Tensor = 9.81
    """m/s2"""

    name: ClassVar[str] = "quadrotor"
    actions: ClassVar[tuple[Variable, ...]] = (
        Variable("thrust", "1", -1.0, 1.0),
        *(Variable(name, "1", -1.0, 1.0) for name in ("rate_x", "rate_y", "rate_z")),
    )

    def __post_init__(self) -> None:
        for field in fields(self):
            value = getattr(self, field.name)
            least = 0.0 if field.name == "min_thrust" else torch.finfo(torch.float32).tiny
            if not bool(torch.as_tensor(value >= least).all()):
                raise ValueError(f"quadrotor: {field.name} must be positive, got {value!r}")
        if not bool(torch.as_tensor(self.max_thrust > self.min_thrust).all()):
            raise ValueError(
                f"quadrotor: max_thrust must be beyond min_thrust, got {self.max_thrust!r} and {self.min_thrust!r}"
            )

    def inertia(self, like: Tensor) -> Tensor:
        """Of a plate with rotors, as Flightmare has it: m l^2 / 12 times (4.5, 4.5, 7) about x, y and z."""
        size = torch.as_tensor(self.mass * self.arm_length**2 / 12).to(like)
        return size[..., None, None] * torch.diag(like.new_tensor((4.5, 4.5, 7.0)))

    def thrust(self, command: Tensor) -> Tensor:
        """Mass-normalised thrust (B,) in m/s2 at commands (B, 4)."""
        middle, half = (self.max_thrust + self.min_thrust) / 2, (self.max_thrust - self.min_thrust) / 2
        return middle + half * command[:, 0]

    def wrench(self, velocity: Tensor, rates: Tensor, command: Tensor) -> tuple[Tensor, Tensor]:
        force = torch.zeros_like(velocity)
        force[:, 2] = self.mass * self.thrust(command)
        asked = columns(self.max_rate) * command[:, 1:]
        gain = torch.stack([torch.as_tensor(g).to(rates) for g in (self.roll_gain, self.roll_gain, self.yaw_gain)], -1)
        inertia = self.inertia(rates)
        return force, times(inertia, gain * (asked - rates)) + torch.linalg.cross(rates, times(inertia, rates))

    def hover(self) -> float | Tensor:
        """The thrust command that carries the weight."""
        middle, half = (self.max_thrust + self.min_thrust) / 2, (self.max_thrust - self.min_thrust) / 2
        return (self.gravity - middle) / half
