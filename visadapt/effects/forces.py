"""Forces other than friction, on a cart-pole; two also on vehicles. Positive forces act towards +x."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import ClassVar

import torch
from torch import Tensor

from visadapt.effects.base import DynamicsEffect, Parameter, Role, require_system
from visadapt.effects.laws import ConstantLaw, JointLoad, PeriodicLaw, PulseLaw, SpringLaw
from visadapt.systems import CartPole, RigidBody, System

__all__ = ["CartForce", "ConstantForce", "Gust", "PeriodicForce", "Spring", "TrackTilt"]


class CartForce(JointLoad):
    """A force on the cart alone; subclasses give its size in `push`, N."""

    systems: ClassVar[tuple[type[System], ...]] = (CartPole,)


class ConstantForce(ConstantLaw):
    """A constant force along x, such as a cable's pull.

    On a cart-pole it is indistinguishable from actuator_bias; on a vehicle it is not, since commands act elsewhere.
    """

    name = "constant_force"
    systems: ClassVar[tuple[type[System], ...]] = (CartPole, RigidBody)
    equation = "F = force"
    table = (Parameter("force", "N", -10.0, 10.0, 0.0, linear=True),)
    indistinguishable_from = ("actuator_bias",)
    separable_on = (RigidBody,)


class PeriodicForce(PeriodicLaw):
    """A sinusoidal force along x, with an offset.

    The phase is that at the start of the episode. 2 (sin t + 1) N is amplitude 2, offset 2, phase -pi/2;
    2 cos t N is amplitude 2, offset 0, phase 0; both have frequency 1/(2 pi).
    """

    name = "periodic_force"
    systems: ClassVar[tuple[type[System], ...]] = (CartPole, RigidBody)
    equation = "F = amplitude cos(2 pi frequency t + phase) + offset"
    table = (
        Parameter("amplitude", "N", 0.0, 10.0, 0.0, linear=True),
        Parameter("frequency", "Hz", 0.02, 5.0, None, role=Role.FREQUENCY),
        Parameter("phase", "rad", -math.pi, math.pi, None, role=Role.PHASE),
        Parameter("offset", "N", -10.0, 10.0, 0.0, linear=True),
    )
    settled_by: ClassVar[Mapping[str, str]] = {
        "constant_force": "record episodes of several seconds: a periodic force comes and goes, a constant one stays"
    }


class Gust(PulseLaw):
    """A constant force between two times, counted from the start of the episode.

    Its edges are logistic, 10 % to 90 % in 18 ms, so that integration steps of 12.5 ms resolve them; its impulse,
    force (end - start), is that of sharp edges.
    """

    name = "gust"
    systems: ClassVar[tuple[type[System], ...]] = (CartPole,)
    equation = "F = force for start <= t < end"
    source = "Newton's second law; discrete gusts: Hoblit (1988), Gust Loads on Aircraft, chapter 2 (here on a cart)"
    table = (
        Parameter("start", "s", 0.0, 20.0, None, role=Role.START),
        Parameter("end", "s", 0.0, 20.0, None, role=Role.END),
        Parameter("force", "N", -15.0, 15.0, 0.0, linear=True),
    )


class Spring(SpringLaw):
    """A spring, such as a cable or a rubber band, that pulls the cart to its rest position."""

    name = "spring"
    systems: ClassVar[tuple[type[System], ...]] = (CartPole,)
    equation = "F = -stiffness (x - rest)"
    table = (Parameter("stiffness", "N/m", 0.0, 50.0, 0.0, linear=True), Parameter("rest", "m", -1.5, 1.5, None))


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
        cart_pole = require_system(system, self)
        tilt, theta = self.value("angle", state), state[:, 2]
        weight = (cart_pole.cart_mass + cart_pole.pole_mass) * cart_pole.gravity
        moment = cart_pole.pole_mass * cart_pole.pole_half_length * cart_pole.gravity
        along = -weight * tilt.sin()
        # cos - 1 as a square, which keeps its digits at small angles.
        torque = -moment * (tilt.sin() * theta.cos() + 2 * (tilt / 2).sin().square() * theta.sin())
        return torch.stack((along.expand_as(torque), torque), -1)
