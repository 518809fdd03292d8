"""The rotary pendulum of docs/own_system.md."""

from dataclasses import dataclass

import torch
from torch import Tensor

import visadapt as va


@dataclass(frozen=True)
class Furuta(va.System):
    """A rotary pendulum: a motor turns an arm, at whose end a pendulum swings."""

    arm_length: float = 0.085  # m
    arm_inertia: float = 2.3e-4  # kg m2 about the motor's axis
    pendulum_mass: float = 0.024  # kg, of a uniform rod
    half_length: float = 0.0645  # m, from the hinge to the rod's centre
    motor_constant: float = 0.042  # N m/A and V s/rad
    resistance: float = 8.4  # ohm
    gravity: float = 9.81  # m/s2

    name = "furuta"
    states = (
        va.Variable("arm", "rad", -2.0, 2.0),
        va.Variable("pendulum", "rad", -3.2, 3.2),  # 0 hangs down
        va.Variable("arm_rate", "rad/s", -20.0, 20.0),
        va.Variable("pendulum_rate", "rad/s", -30.0, 30.0),
    )
    actions = (va.Variable("voltage", "V", -10.0, 10.0),)
    loads = (va.Variable("arm_axis", "N m", -0.02, 0.02), va.Variable("hinge", "N m", -0.005, 0.005))
    coordinates = ((0, 2), (1, 3))  # the columns of position and velocity that each load acts on

    def derivative(self, state: Tensor, command: Tensor, load: Tensor) -> Tensor:
        _, angle, w, v = state.unbind(-1)
        sine, cosine = angle.sin(), angle.cos()
        moment = self.pendulum_mass * self.half_length
        inertia = 4 / 3 * moment * self.half_length  # of the pendulum about its hinge
        torque = self.motor_constant * (command[:, 0] - self.motor_constant * w) / self.resistance
        a = self.arm_inertia + self.pendulum_mass * self.arm_length**2 + inertia * sine**2
        b = -moment * self.arm_length * cosine
        on_arm = torque + load[:, 0] - 2 * inertia * sine * cosine * w * v - moment * self.arm_length * sine * v**2
        on_hinge = load[:, 1] + inertia * sine * cosine * w**2 - moment * self.gravity * sine
        whole = a * inertia - b**2
        return torch.stack((w, v, (inertia * on_arm - b * on_hinge) / whole, (a * on_hinge - b * on_arm) / whole), -1)
