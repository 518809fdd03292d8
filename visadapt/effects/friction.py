"""Friction and drag on a cart-pole: forces against the motion."""

from __future__ import annotations

from typing import ClassVar

import torch
from torch import Tensor

from visadapt.effects.base import DynamicsEffect, Parameter, expect, inside
from visadapt.effects.forces import CartForce
from visadapt.systems import CartPole, System


class ViscousFriction(CartForce):
    """Friction in proportion to the cart's speed."""

    name = "viscous_friction"
    equation = "F = -coefficient x_dot"
    source = "Olsson et al. (1998), Friction models and friction compensation, section 2"
    table = (Parameter("coefficient", "N s/m", 0.0, 15.0, 0.0, linear=True),)

    def push(self, time: Tensor, state: Tensor, system: System) -> Tensor:
        return -self.value("coefficient", state) * state[:, 1]


class CoulombFriction(CartForce):
    """Dry friction of the cart on its track, the same at every speed, the sign made smooth."""

    name = "coulomb_friction"
    equation = "F = -force sign(x_dot)"
    source = "Olsson et al. (1998), Friction models and friction compensation, section 2"
    table = (Parameter("force", "N", 0.0, 6.0, 0.0),)

    RATE: ClassVar[float] = 150.0
    """1/s, at which the smooth friction brings a slow cart to rest: what a Runge-Kutta step of 12.5 ms bears"""
    SLOWEST: ClassVar[float] = 1e-3
    """m/s, the width of the sign where the force tends to 0"""

    def push(self, time: Tensor, state: Tensor, system: System) -> Tensor:
        cart_pole = expect(system, CartPole, self)
        force = self.value("force", state)
        width = self.SLOWEST + force / (self.RATE * (cart_pole.cart_mass + cart_pole.pole_mass))
        return -force * (state[:, 1] / width).tanh()


class QuadraticDrag(CartForce):
    """Drag of the air on the cart."""

    name = "quadratic_drag"
    equation = "F = -coefficient x_dot |x_dot|"
    source = "Batchelor (1967), An Introduction to Fluid Dynamics, section 5.11"
    table = (Parameter("coefficient", "N s2/m2", 0.0, 20.0, 0.0, linear=True),)

    def push(self, time: Tensor, state: Tensor, system: System) -> Tensor:
        return -self.value("coefficient", state) * state[:, 1] * state[:, 1].abs()


class FrictionPatch(CartForce):
    """Viscous friction between two places of the track only: dirt, a worn stretch of the rail.

    Its edges are logistic, 10 % to 90 % in 13 mm.
    """

    name = "friction_patch"
    equation = "F = -coefficient x_dot for start <= x < end"
    source = "Olsson et al. (1998), Friction models and friction compensation, section 2, here only on a stretch"
    table = (
        Parameter("start", "m", -1.5, 1.5, None),
        Parameter("end", "m", -1.5, 1.5, None),
        Parameter("coefficient", "N s/m", 0.0, 40.0, 0.0, linear=True),
    )

    EDGE: ClassVar[float] = 0.003
    """m"""

    def push(self, time: Tensor, state: Tensor, system: System) -> Tensor:
        start, end = self.value("start", state), self.value("end", state)
        return -self.value("coefficient", state) * inside(state[:, 0], start, end, self.EDGE) * state[:, 1]


class PoleDamping(DynamicsEffect):
    """Friction in the hinge, in proportion to the pole's angular velocity."""

    name = "pole_damping"
    equation = "Q_theta = -coefficient theta_dot"
    source = "Barto, Sutton and Anderson (1983), appendix, the term mu_p"
    table = (Parameter("coefficient", "N m s/rad", 0.0, 0.3, 0.0, linear=True),)

    def load(self, time: Tensor, state: Tensor, system: System) -> Tensor:
        torque = -self.value("coefficient", state) * state[:, 3]
        return torch.stack((torch.zeros_like(torque), torque), -1)
