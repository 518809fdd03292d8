"""Forces other than friction: two along x on any system, the others on a cart-pole. Positive forces act towards +x."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import ClassVar

import torch
from torch import Tensor
from torch.nn.functional import pad

from visadapt.effects.base import DynamicsEffect, Parameter, Role, expect, inside
from visadapt.systems import CartPole, RigidBody, System


class ForceAlongX(DynamicsEffect):
    """A force along x alone, on the cart or along the world's x on a vehicle; subclasses give its size."""

    systems: ClassVar[tuple[type[System], ...]] = (CartPole, RigidBody)

    def push(self, time: Tensor, state: Tensor, system: System) -> Tensor:
        """Force in N, (B,)."""
        raise NotImplementedError

    def load(self, time: Tensor, state: Tensor, system: System) -> Tensor:
        # Of all these systems the first load is the force along x.
        return pad(self.push(time, state, system)[:, None], (0, len(system.loads) - 1))


class CartForce(ForceAlongX):
    """A force on the cart alone; subclasses give its size."""

    systems = (CartPole,)

    def load(self, time: Tensor, state: Tensor, system: System) -> Tensor:
        # The two loads of a cart-pole: on a vehicle, where `push` would read wrong columns, the shapes do not fit.
        push = self.push(time, state, system)
        return torch.stack((push, torch.zeros_like(push)), -1)


class ConstantForce(ForceAlongX):
    """A constant force along x, such as a cable's pull.

    On a cart-pole it is indistinguishable from actuator_bias; on a vehicle it is not, since commands act elsewhere.
    """

    name = "constant_force"
    equation = "F = force"
    source = "Newton's second law; the paper, section 3.2.1"
    table = (Parameter("force", "N", -10.0, 10.0, 0.0, linear=True),)
    indistinguishable_from = ("actuator_bias",)
    separable_on = (RigidBody,)

    def push(self, time: Tensor, state: Tensor, system: System) -> Tensor:
        return self.value("force", state).expand_as(time)


class PeriodicForce(ForceAlongX):
    """A sinusoidal force along x, with an offset.

    The phase is that at the start of the episode. 2 (sin t + 1) N is amplitude 2, offset 2, phase -pi/2;
    2 cos t N is amplitude 2, offset 0, phase 0; both have frequency 1/(2 pi).
    """

    name = "periodic_force"
    equation = "F = amplitude cos(2 pi frequency t + phase) + offset"
    source = "the paper, section 3.2.2"
    table = (
        Parameter("amplitude", "N", 0.0, 10.0, 0.0, linear=True),
        Parameter("frequency", "Hz", 0.02, 5.0, None, role=Role.FREQUENCY),
        Parameter("phase", "rad", -math.pi, math.pi, None, role=Role.PHASE),
        Parameter("offset", "N", -10.0, 10.0, 0.0, linear=True),
    )

    def push(self, time: Tensor, state: Tensor, system: System) -> Tensor:
        angle = 2 * math.pi * self.value("frequency", state) * time + self.value("phase", state)
        return self.value("amplitude", state) * angle.cos() + self.value("offset", state)


class Gust(CartForce):
    """A constant force between two times, counted from the start of the episode.

    Its edges are logistic, 10 % to 90 % in 18 ms, so that integration steps of 12.5 ms resolve them; its impulse,
    force (end - start), is that of sharp edges.
    """

    name = "gust"
    abrupt = True
    equation = "F = force for start <= t < end"
    source = "Newton's second law; discrete gusts: Hoblit (1988), Gust Loads on Aircraft, chapter 2 (here on a cart)"
    table = (
        Parameter("start", "s", 0.0, 20.0, None, role=Role.START),
        Parameter("end", "s", 0.0, 20.0, None, role=Role.END),
        Parameter("force", "N", -15.0, 15.0, 0.0, linear=True),
    )

    EDGE: ClassVar[float] = 0.004  # s

    def push(self, time: Tensor, state: Tensor, system: System) -> Tensor:
        start, end = self.value("start", state), self.value("end", state)
        return self.value("force", state) * inside(time, start, end, self.EDGE)


class Spring(CartForce):
    """A spring, such as a cable or a rubber band, that pulls the cart to its rest position."""

    name = "spring"
    equation = "F = -stiffness (x - rest)"
    source = "Hooke's law"
    table = (Parameter("stiffness", "N/m", 0.0, 50.0, 0.0, linear=True), Parameter("rest", "m", -1.5, 1.5, None))

    def push(self, time: Tensor, state: Tensor, system: System) -> Tensor:
        return -self.value("stiffness", state) * (state[:, 0] - self.value("rest", state))


class TrackTilt(DynamicsEffect):
    """A track that rises towards +x by `angle`; theta is still measured from the track's normal.

    Gravity has a component along the track, which accelerates cart and pole downhill, and the pole is in equilibrium
    where it is vertical, at theta = angle; that separates a tilt from a constant force.
    """

    name = "track_tilt"
    equation = (
        "Q_x = -(M + m) g sin(angle), "
        "Q_theta = -m l g sin(angle) cos(theta) + m l g (cos(angle) - 1) sin(theta): gravity turned by angle"
    )
    source = "Lagrange's equations of the cart-pole with gravity along (-sin(angle), -cos(angle)) in the track's frame"
    table = (Parameter("angle", "rad", -0.3, 0.3, 0.0),)
    settled_by: ClassVar[Mapping[str, str]] = {
        "angle_offset": (
            "turn the rig round by 180 degrees on the table and record again: a tilt changes its sign, an offset does "
            "not"
        )
    }
    systems = (CartPole,)

    def load(self, time: Tensor, state: Tensor, system: System) -> Tensor:
        cart_pole = expect(system, self)
        tilt, theta = self.value("angle", state), state[:, 2]
        weight = (cart_pole.cart_mass + cart_pole.pole_mass) * cart_pole.gravity
        moment = cart_pole.pole_mass * cart_pole.pole_half_length * cart_pole.gravity
        along = -weight * tilt.sin()
        # cos - 1 as a square, which keeps its digits at small angles.
        torque = -moment * (tilt.sin() * theta.cos() + 2 * (tilt / 2).sin().square() * theta.sin())
        return torch.stack((along.expand_as(torque), torque), -1)
