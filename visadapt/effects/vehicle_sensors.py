"""Effects on the sensors of quadrotors and fixed wings: axes that are turned, gyroscopes' offsets, late positions."""

from __future__ import annotations

from typing import ClassVar

import torch
from torch import Tensor

from visadapt.effects.base import Parameter, Reading, SensingEffect
from visadapt.effects.late_sensors import LateSensors
from visadapt.systems import FixedWing, Quadrotor
from visadapt.systems.rigid_body import ATTITUDE, RATES, from_angles, matvec, quaternion_rate, rotation

__all__ = ["AttitudeOffset", "PositioningDelay", "RateOffset"]


class AttitudeOffset(SensingEffect):
    """An attitude sensor whose axes are turned against the vehicle's: markers or an autopilot that are not level.

    Body rates are measured in the sensor's axes too.
    """

    name = "attitude_offset"
    order = 40
    systems = (Quadrotor, FixedWing)
    equation = "R measured = R R(roll, pitch, yaw), omega measured = R(roll, pitch, yaw)^T omega"
    source = "Stevens, Lewis and Johnson (2016), Aircraft Control and Simulation, section 1.3 (rotation matrices)"
    table = tuple(Parameter(angle, "rad", -0.3, 0.3, 0.0) for angle in ("roll", "pitch", "yaw"))

    def apply_to(self, measured: Tensor, memory: Tensor, period: float, generator: torch.Generator | None) -> Reading:
        angles = torch.stack([self.value(parameter.name, measured) for parameter in self.table], -1)
        turned = from_angles(angles).expand(len(measured), -1)
        out = measured.clone()
        # The product of q and (w, v) is w q + q (0, v), of which the latter is twice the rate of q under v.
        attitude = measured[:, ATTITUDE]
        out[:, ATTITUDE] = turned[:, :1] * attitude + 2 * quaternion_rate(attitude, turned[:, 1:])
        out[:, RATES] = matvec(rotation(turned).mT, measured[:, RATES])
        return out, memory


class RateOffset(SensingEffect):
    """Gyroscopes that read `x`, `y` and `z` at rest."""

    name = "rate_offset"
    order = 50
    systems = (Quadrotor, FixedWing)
    equation = "omega measured = omega + (x, y, z)"
    source = "Beard and McLain (2012), Small Unmanned Aircraft, section 7.2 (rate gyros)"
    table = tuple(Parameter(axis, "rad/s", -0.3, 0.3, 0.0, linear=True) for axis in "xyz")

    def apply_to(self, measured: Tensor, memory: Tensor, period: float, generator: torch.Generator | None) -> Reading:
        out = measured.clone()
        out[:, RATES] = out[:, RATES] + torch.stack([self.value(axis, measured) for axis in "xyz"], -1)
        return out, memory


class PositioningDelay(LateSensors):
    """Positions that are late against attitude and rates: motion capture or GNSS beside an inertial unit."""

    name = "positioning_delay"
    systems = (Quadrotor, FixedWing)
    equation = "(x, y, z, x_dot, y_dot, z_dot) measured(t) = (x, y, z, x_dot, y_dot, z_dot)(max(t - delay, 0))"
    table = (Parameter("delay", "s", 0.0, 0.2, 0.0),)
    positions: ClassVar[list[int]] = [Quadrotor.index(axis) for axis in "xyz"]
    velocities: ClassVar[list[int]] = [Quadrotor.index(f"{axis}_dot") for axis in "xyz"]
    late: ClassVar[list[int]] = [*positions, *velocities]
