"""Friction on a cart-pole, and drag of the air: forces against the motion."""

from __future__ import annotations

from collections.abc import Mapping
from typing import ClassVar

import torch
from torch import Tensor
from torch.nn.functional import pad

from visadapt.effects.aerial import VEHICLES, Vehicle, airspeed
from visadapt.effects.base import DynamicsEffect, Parameter, Role, expect, inside
from visadapt.effects.forces import CartForce
from visadapt.systems import CartPole, System


class ViscousFriction(CartForce):
    """Friction proportional to the cart's speed."""

    name = "viscous_friction"
    equation = "F = -coefficient x_dot"
    source = "Olsson et al. (1998), Friction models and friction compensation, section 2"
    table = (Parameter("coefficient", "N s/m", 0.0, 30.0, 0.0, linear=True),)
    settled_by: ClassVar[Mapping[str, str]] = {
        "quadratic_drag": "record faster motions: drag grows with the square of the speed",
        "coulomb_friction": (
            "record slow reversals and fast runs: dry friction is as large at any speed and stops the cart near "
            "standstill"
        ),
    }

    def push(self, time: Tensor, state: Tensor, system: System) -> Tensor:
        return -self.value("coefficient", state) * state[:, 1]


class CoulombFriction(CartForce):
    """Dry friction of the cart on its track, the same at every speed.

    The sign is smoothed: below a speed of 1.5 widths the force falls to 0, so that a cart that should stick creeps at
    up to that speed. The width is the smallest for which Runge-Kutta steps of 12.5 ms are stable, and so it grows with
    the force: 6 mm/s at 1 N, 33 mm/s at 6 N. Half a second ahead under a stabilising controller, x departs from the
    event-exact solution by 0.4 mm (rms) at 0.5 N, 0.8 mm at 1 N, 1.5 mm at 2 N and 7 mm at 6 N: 1 % of the effect of
    the friction.
    """

    name = "coulomb_friction"
    abrupt = True
    equation = "F = -force sign(x_dot)"
    source = "Olsson et al. (1998), Friction models and friction compensation, section 2"
    table = (Parameter("force", "N", 0.0, 6.0, 0.0),)

    RATE: ClassVar[float] = 180.0  # 1/s, at which the smooth friction brings a slow cart to rest
    SLOWEST: ClassVar[float] = 5e-4  # m/s, the width where the force tends to 0

    def push(self, time: Tensor, state: Tensor, system: System) -> Tensor:
        cart_pole = expect(system, self)
        force = self.value("force", state)
        # The effective mass that a force on the cart accelerates while the pole is near upright and free to turn.
        mass = cart_pole.cart_mass + cart_pole.pole_mass / 4
        width = self.SLOWEST + force / (self.RATE * mass)
        # A cubic of slope 1 at rest, flat from 1.5 widths on.
        speed = (state[:, 1] / width).clamp(-1.5, 1.5)
        return -force * (speed - 4 / 27 * speed**3)


class QuadraticDrag(DynamicsEffect):
    """Drag of the air at high Reynolds numbers, on the cart or on a vehicle."""

    name = "quadratic_drag"
    equation = "F = -coefficient |v| v, v the velocity against the air (of the cart: x_dot)"
    source = "Batchelor (1967), An Introduction to Fluid Dynamics, section 5.11"
    table = (Parameter("coefficient", "N s2/m2", 0.0, 20.0, 0.0, linear=True),)
    systems = (CartPole, *VEHICLES)

    def load(self, time: Tensor, state: Tensor, system: System) -> Tensor:
        velocity = airspeed(state, system) if isinstance(system, Vehicle) else state[:, 1:2]
        force = -self.value("coefficient", state)[..., None] * velocity * velocity.norm(dim=-1, keepdim=True)
        return pad(force, (0, len(system.loads) - force.shape[1]))


class FrictionPatch(CartForce):
    """Viscous friction on a stretch of the track: dirt, or a worn rail.

    Its edges are logistic, 10 % to 90 % in 18 mm, so that integration steps of 12.5 ms resolve them; the speed lost in
    crossing, coefficient (end - start) / mass, is that of sharp edges.
    """

    name = "friction_patch"
    abrupt = True
    equation = "F = -coefficient x_dot for start <= x < end"
    source = "Olsson et al. (1998), Friction models and friction compensation, section 2, here only on a stretch"
    table = (
        Parameter("start", "m", -1.5, 1.5, None, role=Role.START),
        Parameter("end", "m", -1.5, 1.5, None, role=Role.END),
        Parameter("coefficient", "N s/m", 0.0, 40.0, 0.0, linear=True),
    )

    EDGE: ClassVar[float] = 0.004  # m

    def push(self, time: Tensor, state: Tensor, system: System) -> Tensor:
        start, end = self.value("start", state), self.value("end", state)
        return -self.value("coefficient", state) * inside(state[:, 0], start, end, self.EDGE) * state[:, 1]


class PoleDamping(DynamicsEffect):
    """Friction in the hinge, proportional to the pole's angular velocity."""

    name = "pole_damping"
    equation = "Q_theta = -coefficient theta_dot"
    source = "Barto, Sutton and Anderson (1983), appendix, the term mu_p"
    table = (Parameter("coefficient", "N m s/rad", 0.0, 0.2, 0.0, linear=True),)
    systems = (CartPole,)

    def load(self, time: Tensor, state: Tensor, system: System) -> Tensor:
        torque = -self.value("coefficient", state) * state[:, 3]
        return torch.stack((torch.zeros_like(torque), torque), -1)
