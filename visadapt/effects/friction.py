"""Friction on a cart-pole, and drag of the air: forces against the motion."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar

import torch
from torch import Tensor
from torch.nn.functional import pad

from visadapt.effects.aerial import VEHICLES, Vehicle, airspeed
from visadapt.effects.base import DynamicsEffect, Effect, Parameter, Role, inside
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


class CoulombFriction(DynamicsEffect):
    """Dry friction of the cart on its track, the same at every speed; a cart at rest sticks.

    Half a second ahead under a stabilising controller, with 6 N and steps of 12.5 ms, x and theta depart from the
    event-exact solution by 0.001 mm and 0.12 mrad (rms).
    """

    name = "coulomb_friction"
    abrupt = True
    equation = "F = -force sign(x_dot); at rest, what holds the cart, up to force"
    source = "Olsson et al. (1998), Friction models and friction compensation, section 2"
    table = (Parameter("force", "N", 0.0, 15.0, 0.0),)
    systems = (CartPole,)

    def dry_friction(self, time: Tensor, state: Tensor, system: System) -> Tensor:
        force = self.value("force", state).expand_as(time)
        return _of_the_cart(force, force)


class StribeckFriction(DynamicsEffect):
    """Dry friction of the cart that is larger near rest than at speed."""

    name = "stribeck_friction"
    abrupt = True
    equation = "F = -(force + (breakaway - force) exp(-(x_dot / velocity)^2)) sign(x_dot); at rest, up to breakaway"
    source = "Armstrong-Helouvry, Dupont and Canudas de Wit (1994), Automatica 30(7), section 2.2"
    table = (
        Parameter("force", "N", 0.0, 15.0, 0.0),
        Parameter("breakaway", "N", 0.0, 15.0, 0.0),
        Parameter("velocity", "m/s", 0.01, 1.0, None),
    )
    systems = (CartPole,)
    settled_by: ClassVar[Mapping[str, str]] = {
        "coulomb_friction": "record slow runs: near rest this friction grows, dry friction stays what it is at speed"
    }

    def dry_friction(self, time: Tensor, state: Tensor, system: System) -> Tensor:
        force, breakaway = self.value("force", state), self.value("breakaway", state)
        share = (-(state[:, 1] / self.value("velocity", state)).square()).exp()
        limit = force + (breakaway - force) * share
        return _of_the_cart(limit, limit)


class _OwnForward:
    """The parameter `forward`, which the method of that name of torch's modules would hide."""

    def __get__(self, effect: Effect | None, owner: type[Effect]) -> Any:
        return self if effect is None else effect._parameters["forward"]


class DirectionalFriction(DynamicsEffect):
    """Dry friction of the cart that differs between its two directions."""

    forward = _OwnForward()

    name = "directional_friction"
    abrupt = True
    equation = "F = -forward where x_dot > 0, backward where x_dot < 0; at rest, what holds the cart, up to these"
    source = "Armstrong-Helouvry, Dupont and Canudas de Wit (1994), Automatica 30(7), section 2"
    table = (Parameter("forward", "N", 0.0, 15.0, 0.0), Parameter("backward", "N", 0.0, 15.0, 0.0))
    systems = (CartPole,)

    def dry_friction(self, time: Tensor, state: Tensor, system: System) -> Tensor:
        forward, backward = (self.value(name, state).expand_as(time) for name in ("forward", "backward"))
        return _of_the_cart(forward, backward)


def _of_the_cart(forward: Tensor, backward: Tensor) -> Tensor:
    """Dry friction (B, 2, 2) of the cart alone, N (B,) against positive and against negative motion."""
    both = torch.stack((forward, backward), -1)
    return torch.stack((both, torch.zeros_like(both)), 1)


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
