"""A hydraulic cylinder: a pressure, which belongs to no joint, follows the motion faster than a row lasts."""

from dataclasses import dataclass
from typing import ClassVar

import torch
from torch.nn.functional import softplus

from visadapt.systems import System, Variable


@dataclass(frozen=True)
class Cylinder(System):
    """A mass that a cylinder moves, whose valve is commanded."""

    mass: float | torch.Tensor = 60.0  # kg
    area: float | torch.Tensor = 1.2e-3  # m2
    damping: float | torch.Tensor = 400.0  # N s/m
    flow: float | torch.Tensor = 1e-4  # m3/s per square root of MPa
    leak: float | torch.Tensor = 2e-6  # m3/s/MPa
    compliance: float | torch.Tensor = 6e-7  # m3/MPa

    name = "hydraulic_cylinder"
    states: ClassVar[tuple[Variable, ...]] = (
        Variable("x", "m", -0.5, 0.5),
        Variable("v", "m/s", -0.6, 0.6),
        Variable("p", "MPa", -12.0, 12.0),
    )
    actions: ClassVar[tuple[Variable, ...]] = (Variable("valve", "1", -1.0, 1.0),)
    loads: ClassVar[tuple[Variable, ...]] = (Variable("rod", "N", -6000.0, 6000.0),)
    coordinates = ((0, 1),)

    def derivative(self, state, command, load):
        _, v, p = state.unbind(-1)
        valve = command[:, 0]
        head = softplus(12.0 - (valve / 0.02).tanh() * p, 5)  # MPa, over the valve
        inflow = self.flow * valve * head.sqrt() - self.leak * p - self.area * v
        force = 1e6 * self.area * p - self.damping * v + load[:, 0]
        return torch.stack((v, force / self.mass, inflow / self.compliance), -1)
