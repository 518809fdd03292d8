"""Forces of the air on flying vehicles: drag, forces on rotors, and wind.

All depend on the velocity relative to the air, so that a wind changes each of them. Their forces add.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import TypeAlias

import torch
from torch import Tensor
from torch.nn.functional import pad

from visadapt.effects.base import DynamicsEffect, Parameter, Role, require_system
from visadapt.systems import FixedWing, Quadrotor, System
from visadapt.systems.rigid_body import ATTITUDE, VELOCITY, matvec, rotation, stack_parameters

__all__ = ["LinearDrag", "PeriodicWind", "RotorDrag", "TranslationalLift", "Wind"]

Vehicle: TypeAlias = Quadrotor | FixedWing
VEHICLES: tuple[type[System], ...] = (Quadrotor, FixedWing)  # The systems that have a wind


def airspeed(state: Tensor, vehicle: Vehicle) -> Tensor:
    """Velocity (B, 3) against the air in m/s, world axes, in states (B, 13)."""
    wind = (vehicle.wind_x, vehicle.wind_y, vehicle.wind_z)
    if not any(isinstance(value, Tensor) or value for value in wind):
        return state[:, VELOCITY]
    return state[:, VELOCITY] - stack_parameters(wind, state)


class AirDrag(DynamicsEffect):
    """Drag proportional to the velocity relative to the air."""

    systems = VEHICLES

    def load(self, time: Tensor, state: Tensor, system: System) -> Tensor:
        velocity = airspeed(state, require_system(system, self))
        return pad(-self.value("coefficient", state)[..., None] * velocity, (0, 3))


class LinearDrag(AirDrag):
    """Drag proportional to the speed, as of rotors in forward flight.

    The paper's v' = v' - r v, with r = 0.3 1/s, is coefficient = r mass, on both vehicles.
    """

    name = "linear_drag"
    equation = "F = -coefficient v, v the velocity against the air"
    source = "Faessler, Franchi and Scaramuzza (2017), Differential flatness of quadrotor dynamics; the paper, 3.2.1"
    table = (Parameter("coefficient", "N s/m", 0.0, 3.0, 0.0, linear=True),)


class RotorDrag(DynamicsEffect):
    """Drag of the rotors proportional to the velocity relative to the air, with a coefficient for each body axis.

    In the rotor plane it comes from flapping and bending blades, along the rotor axis from inflow that reduces thrust.
    With three equal coefficients it is linear_drag.
    """

    name = "rotor_drag"
    equation = "F = -R diag(coefficient_x, coefficient_y, coefficient_z) R^T v, v the velocity against the air"
    source = (
        "Faessler, Franchi and Scaramuzza (2018), Differential flatness of quadrotor dynamics subject to rotor drag"
    )
    table = tuple(Parameter(f"coefficient_{axis}", "N s/m", 0.0, 3.0, 0.0, linear=True) for axis in "xyz")
    systems = (Quadrotor,)

    def load(self, time: Tensor, state: Tensor, system: System) -> Tensor:
        turned = rotation(state[:, ATTITUDE])
        velocity = matvec(turned.mT, airspeed(state, require_system(system, self)))
        coefficients = torch.stack(torch.broadcast_tensors(*(self.value(p.name, state) for p in self.table)), -1)
        return pad(-matvec(turned, coefficients * velocity), (0, 3))


class TranslationalLift(DynamicsEffect):
    """Additional thrust in forward flight: air that flows across the rotors raises their mass flow."""

    name = "translational_lift"
    equation = "T = T_asked + coefficient (v_x^2 + v_y^2), v the velocity against the air in body axes"
    source = (
        "Faessler, Franchi and Scaramuzza (2018), Differential flatness of quadrotor dynamics subject to rotor drag"
    )
    table = (Parameter("coefficient", "N s2/m2", 0.0, 1.0, 0.0, linear=True),)
    systems = (Quadrotor,)

    def load(self, time: Tensor, state: Tensor, system: System) -> Tensor:
        turned = rotation(state[:, ATTITUDE])
        velocity = matvec(turned.mT, airspeed(state, require_system(system, self)))
        lift = self.value("coefficient", state) * velocity[:, :2].square().sum(1)
        return pad(lift[:, None] * turned[:, :, 2], (0, 3))


class Wind(AirDrag):
    """Air that moves at a steady velocity.

    The wing's aerodynamics use its velocity relative to the air. The source's quadrotor has no drag, so that wind
    alone would not act on it; this effect therefore has a drag coefficient of its own. On the wing, or together with a
    drag effect, which the wind changes too, the coefficient may be 0.
    """

    name = "wind"
    equation = "F = coefficient (w - v), w = (velocity_x, velocity_y, velocity_z); the wing's aerodynamics use v - w"
    source = "Beard and McLain (2012), Small Unmanned Aircraft, section 2.4; Faessler, Franchi and Scaramuzza (2017)"
    table = (
        *(Parameter(f"velocity_{axis}", "m/s", -10.0, 10.0, 0.0) for axis in "xyz"),
        Parameter("coefficient", "N s/m", 0.0, 3.0, 0.0),
    )

    def alter(self, system: System) -> System:
        air = require_system(system, self)
        return replace(air, **{f"wind_{k}": getattr(air, f"wind_{k}") + getattr(self, f"velocity_{k}") for k in "xyz"})


class PeriodicWind(AirDrag):
    """Horizontal wind that oscillates along one direction; it acts through a drag, as `wind` does.

    The phase is that at the start of the episode; a direction of 0 is along x, of pi/2 along y.
    """

    name = "periodic_wind"
    equation = (
        "F = coefficient (w - v), w = amplitude cos(2 pi frequency t + phase) (cos(direction), sin(direction), 0); "
        "the wing's aerodynamics use v - w"
    )
    source = "Hoblit (1988), Gust Loads on Aircraft, chapter 3 (one harmonic); Beard and McLain (2012), section 4.4"
    table = (
        Parameter("amplitude", "m/s", 0.0, 10.0, 0.0),
        Parameter("frequency", "Hz", 0.02, 5.0, None, role=Role.FREQUENCY),
        Parameter("phase", "rad", -math.pi, math.pi, None, role=Role.PHASE),
        Parameter("direction", "rad", -math.pi / 2, math.pi / 2, None),
        Parameter("coefficient", "N s/m", 0.0, 3.0, 0.0),
    )

    def vary(self, system: System, time: Tensor, state: Tensor) -> System:
        air = require_system(system, self)
        angle = 2 * math.pi * self.value("frequency", state) * time + self.value("phase", state)
        speed, direction = self.value("amplitude", state) * angle.cos(), self.value("direction", state)
        return replace(air, wind_x=air.wind_x + speed * direction.cos(), wind_y=air.wind_y + speed * direction.sin())
