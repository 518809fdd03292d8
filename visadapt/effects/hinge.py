"""Torques in the hinge of a cart-pole."""

from __future__ import annotations

import torch
from torch import Tensor

from visadapt.effects.base import DynamicsEffect, Parameter
from visadapt.systems import CartPole, System


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


class PoleSpring(DynamicsEffect):
    """A spring in the hinge, such as a stiff cable, that pulls the pole upright."""

    name = "pole_spring"
    equation = "Q_theta = -stiffness theta"
    source = "Hooke's law"
    table = (Parameter("stiffness", "N m/rad", 0.0, 5.0, 0.0, linear=True),)
    systems = (CartPole,)

    def load(self, time: Tensor, state: Tensor, system: System) -> Tensor:
        torque = -self.value("stiffness", state) * state[:, 2]
        return torch.stack((torch.zeros_like(torque), torque), -1)


class PoleFriction(DynamicsEffect):
    """Dry friction in the hinge; a pole at rest on it sticks."""

    name = "pole_friction"
    abrupt = True
    equation = "Q_theta = -torque sign(theta_dot); at rest, what holds the pole, up to torque"
    source = "Olsson et al. (1998), Friction models and friction compensation, section 2"
    table = (Parameter("torque", "N m", 0.0, 0.5, 0.0),)
    systems = (CartPole,)

    def dry_friction(self, time: Tensor, state: Tensor, system: System) -> Tensor:
        torque = self.value("torque", state).expand_as(time)
        return torch.stack((torch.zeros_like(torque), torque), 1)[..., None].expand(-1, -1, 2)
