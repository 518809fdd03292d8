"""A pole hinged on a cart that a motor pushes along a track.

Barto, Sutton and Anderson (1983), "Neuronlike adaptive elements that can solve difficult learning control
problems", appendix, without their friction terms (friction is an effect). A positive force or command pushes towards
+x; a positive angle leans towards +x; 0 is upright.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import torch
from torch import Tensor

from visadapt.systems.base import System, Variable


@dataclass(frozen=True)
class CartPole(System):
    """A uniform pole on a cart. Defaults are the paper's CartPole (0.05 s between commands).

    >>> import visadapt as va
    >>> va.CartPole(cart_mass=0.5).cart_mass
    0.5
    >>> [variable.name for variable in va.CartPole.states]
    ['x', 'x_dot', 'theta', 'theta_dot']
    """

    cart_mass: float | Tensor = 1.0  # kg
    pole_mass: float | Tensor = 0.1  # kg
    pole_half_length: float | Tensor = 0.5  # m, from the hinge to the pole's centre of mass
    max_force: float | Tensor = 30.0  # N on the cart at a command of 1
    gravity: float | Tensor = 9.8  # m/s2

    name: ClassVar[str] = "cartpole"
    states: ClassVar[tuple[Variable, ...]] = (
        Variable("x", "m", -1.5, 1.5),
        Variable("x_dot", "m/s", -5.0, 5.0),
        Variable("theta", "rad", -0.3, 0.3),
        Variable("theta_dot", "rad/s", -10.0, 10.0),
    )
    actions: ClassVar[tuple[Variable, ...]] = (Variable("command", "1", -1.0, 1.0),)
    loads: ClassVar[tuple[Variable, ...]] = (
        Variable("cart_force", "N", -100.0, 100.0),
        Variable("pivot_torque", "N m", -100.0, 100.0),
    )
    coordinates: ClassVar[tuple[tuple[int, int], ...]] = ((0, 1), (2, 3))

    def load_scale(self, unit: str) -> float:
        """Ratio to the default cart-pole, at least 1: for forces, of the weight of cart and pole; for torques, of the
        pole's weight times half-length. 1 for other units."""
        default = CartPole()

        def weight(one: CartPole) -> float:
            if unit.startswith("N m"):
                return float(one.gravity * one.pole_mass * one.pole_half_length)
            return float(one.gravity * (one.cart_mass + one.pole_mass)) if unit.startswith("N") else 1.0

        return max(1.0, weight(self) / weight(default))

    def motor_loads(self, state: Tensor, command: Tensor) -> Tensor:
        """The loads (B, 2) that would move the system as the command does: a force on the cart alone."""
        force = self.max_force * command[:, 0]
        return torch.stack((force, torch.zeros_like(force)), -1)

    def derivative(self, state: Tensor, command: Tensor, load: Tensor) -> Tensor:
        """Equations of Barto et al. with a force on the cart (N) and a torque at the pivot (N m) as loads."""
        _, velocity, angle, angular_velocity = state.unbind(-1)
        force, torque = load.unbind(-1)
        total_mass = self.cart_mass + self.pole_mass
        pole_moment = self.pole_mass * self.pole_half_length
        sine, cosine = angle.sin(), angle.cos()
        push = (self.max_force * command[..., 0] + force + pole_moment * angular_velocity.square() * sine) / total_mass
        angular_acceleration = (self.gravity * sine - cosine * push + torque / pole_moment) / (
            self.pole_half_length * (4.0 / 3.0 - self.pole_mass * cosine.square() / total_mass)
        )
        acceleration = push - pole_moment * angular_acceleration * cosine / total_mass
        return torch.stack((velocity, acceleration, angular_velocity, angular_acceleration), -1)
