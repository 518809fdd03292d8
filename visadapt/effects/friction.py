"""Friction on a cart-pole, and drag of the air: forces against the motion."""

from __future__ import annotations

from collections.abc import Mapping
from typing import ClassVar

from torch import Tensor
from torch.nn.functional import pad

from visadapt.effects.aerial import VEHICLES, Vehicle, airspeed
from visadapt.effects.base import DynamicsEffect, Parameter, Role, inside
from visadapt.effects.forces import CartForce
from visadapt.effects.laws import CoulombLaw, DirectionalLaw, LoadDependentLaw, StribeckLaw, ViscousLaw
from visadapt.systems import CartPole, System

__all__ = [
    "CoulombFriction",
    "DirectionalFriction",
    "FrictionPatch",
    "LoadDependentFriction",
    "QuadraticDrag",
    "StribeckFriction",
    "ViscousFriction",
]


class ViscousFriction(ViscousLaw):
    """Friction proportional to the cart's speed."""

    name = "viscous_friction"
    systems = (CartPole,)
    equation = "F = -coefficient x_dot"
    table = (Parameter("coefficient", "N s/m", 0.0, 30.0, 0.0, linear=True),)
    settled_by: ClassVar[Mapping[str, str]] = {
        "quadratic_drag": "record faster motions: drag grows with the square of the speed",
        "coulomb_friction": (
            "record slow reversals and fast runs: dry friction is as large at any speed and stops the cart near "
            "standstill"
        ),
    }


class CoulombFriction(CoulombLaw):
    """Dry friction of the cart on its track, the same at every speed; a cart at rest sticks.

    Half a second ahead under a stabilising controller, with 6 N and steps of 12.5 ms, x and theta depart from the
    event-exact solution by 0.001 mm and 0.12 mrad (rms).
    """

    name = "coulomb_friction"
    equation = "F = -force sign(x_dot); at rest, what holds the cart, up to force"
    table = (Parameter("force", "N", 0.0, 15.0, 0.0),)
    systems = (CartPole,)


class StribeckFriction(StribeckLaw):
    """Dry friction of the cart that is larger near rest than at speed."""

    name = "stribeck_friction"
    equation = (
        "F = -(force + max(breakaway - force, 0) exp(-(x_dot / velocity)^2)) sign(x_dot); at rest, up to breakaway"
    )
    table = (
        Parameter("force", "N", 0.0, 15.0, 0.0),
        Parameter("breakaway", "N", 0.0, 15.0, 0.0),
        Parameter("velocity", "m/s", 0.01, 1.0, None),
    )
    systems = (CartPole,)
    settled_by: ClassVar[Mapping[str, str]] = {
        "coulomb_friction": "record slow runs: near rest this friction grows, dry friction stays what it is at speed"
    }


class DirectionalFriction(DirectionalLaw):
    """Dry friction of the cart that differs between its two directions."""

    name = "directional_friction"
    equation = "F = -forward where x_dot > 0, backward where x_dot < 0; at rest, what holds the cart, up to these"
    table = (Parameter("forward", "N", 0.0, 15.0, 0.0), Parameter("backward", "N", 0.0, 15.0, 0.0))
    systems = (CartPole,)


class LoadDependentFriction(LoadDependentLaw):
    """Dry friction of a gear between motor and cart, a share of the motor's force."""

    name = "load_dependent_friction"
    equation = "F = -share |motor force| sign(x_dot); at rest, what holds the cart, up to share |motor force|"
    table = (Parameter("share", "1", 0.0, 0.8, 0.0),)
    systems = (CartPole,)


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
