"""Forces on the cart of a cart-pole. Positive pushes towards +x."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from visadapt.effects.base import DynamicsEffect, Parameter


class CartForce(DynamicsEffect):
    """A force on the cart alone; subclasses give its size."""

    def push(self, time: Tensor, state: Tensor) -> Tensor:
        """Force in N, (B,)."""
        raise NotImplementedError

    def load(self, time: Tensor, state: Tensor) -> Tensor:
        push = self.push(time, state)
        return torch.stack((push, torch.zeros_like(push)), -1)


class ConstantForce(CartForce):
    """A push that never lets up: a cable's weight, say."""

    name = "constant_force"
    equation = "F = force"
    source = "Newton's second law; the paper, section 3.2.1"
    table = (Parameter("force", "N", -30.0, 30.0, 0.0),)
    indistinguishable_from = ("actuator_bias", "track_tilt")

    def push(self, time: Tensor, state: Tensor) -> Tensor:
        return self.value("force", state).expand_as(time)


class PeriodicForce(CartForce):
    """Phases count from the start of the episode; 2 (sin t + 1) N is amplitude 2, offset 2, phase -pi/2."""

    name = "periodic_force"
    equation = "F = amplitude cos(2 pi frequency t + phase) + offset"
    source = "the paper, section 3.2.2"
    table = (
        Parameter("amplitude", "N", 0.0, 30.0, 0.0),
        Parameter("frequency", "Hz", 0.02, 5.0, None),
        Parameter("phase", "rad", -math.pi, math.pi, None),
        Parameter("offset", "N", -30.0, 30.0, 0.0),
    )

    def push(self, time: Tensor, state: Tensor) -> Tensor:
        angle = 2 * math.pi * self.value("frequency", state) * time + self.value("phase", state)
        return self.value("amplitude", state) * angle.cos() + self.value("offset", state)


class ViscousFriction(CartForce):
    """Friction in proportion to the cart's speed."""

    name = "viscous_friction"
    equation = "F = -coefficient x_dot"
    source = "Olsson et al. (1998), Friction models and friction compensation, section 2"
    table = (Parameter("coefficient", "N s/m", 0.0, 50.0, 0.0),)

    def push(self, time: Tensor, state: Tensor) -> Tensor:
        return -self.value("coefficient", state) * state[..., 1]
