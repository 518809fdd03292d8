"""Torques in the hinge of a cart-pole."""

from __future__ import annotations

from typing import ClassVar

from torch import Tensor

from visadapt.effects.base import Parameter
from visadapt.effects.laws import CoulombLaw, JointLoad, ViscousLaw
from visadapt.systems import CartPole, System

__all__ = ["PoleDamping", "PoleFriction", "PoleSpring"]

HINGE = 1  # The joint


class PoleDamping(ViscousLaw):
    """Friction in the hinge, proportional to the pole's angular velocity."""

    name = "pole_damping"
    equation = "Q_theta = -coefficient theta_dot"
    source = "Barto, Sutton and Anderson (1983), appendix, the term mu_p"
    table = (Parameter("coefficient", "N m s/rad", 0.0, 0.2, 0.0, linear=True),)
    systems: ClassVar[tuple[type[System], ...]] = (CartPole,)
    joint = HINGE


class PoleSpring(JointLoad):
    """A spring in the hinge, such as a stiff cable, that pulls the pole upright."""

    name = "pole_spring"
    equation = "Q_theta = -stiffness theta"
    source = "Hooke's law"
    table = (Parameter("stiffness", "N m/rad", 0.0, 5.0, 0.0, linear=True),)
    systems: ClassVar[tuple[type[System], ...]] = (CartPole,)
    joint = HINGE

    def push(self, time: Tensor, state: Tensor, system: System) -> Tensor:
        return -self.value("stiffness", state) * self.joint_position(state, system)


class PoleFriction(CoulombLaw):
    """Dry friction in the hinge; a pole at rest sticks."""

    name = "pole_friction"
    equation = "Q_theta = -torque sign(theta_dot); at rest, what holds the pole, up to torque"
    table = (Parameter("torque", "N m", 0.0, 0.5, 0.0),)
    systems: ClassVar[tuple[type[System], ...]] = (CartPole,)
    joint = HINGE
