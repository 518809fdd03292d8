"""Effects on measurements: dropout on those of any system, the others on a cart-pole's (x, x_dot, theta, theta_dot)."""

from __future__ import annotations

from typing import ClassVar

import torch
from torch import Tensor

from visadapt.effects.base import Parameter, Reading, Role, SensingEffect, inside
from visadapt.effects.lossy import Lossy
from visadapt.systems import CartPole

__all__ = ["AngleOffset", "Dropout", "FrozenZone", "PositionOffset", "SensorScale"]


class FrozenZone(SensingEffect):
    """A worn potentiometer: while the angle is between start and end, the reading holds its last value from outside.

    Angle and angular velocity both hold. The edges are logistic, 10 % to 90 % in 4.4 mrad, across which the reading is
    a weighted mean; an empty zone does nothing.
    """

    name = "frozen_zone"
    order = 20
    repeats_readings = True
    systems = (CartPole,)
    equation = "measured_k = measured_(k-1) for start < theta_k < end, of theta and theta_dot"
    source = "Balaban et al. (2009), Modeling, detection, and disambiguation of sensor faults, section II"
    table = (
        Parameter("start", "rad", -0.5, 0.5, 0.0, role=Role.START),
        Parameter("end", "rad", -0.5, 0.5, 0.0, role=Role.END),
    )

    EDGE: ClassVar[float] = 0.001  # rad

    def memory(self, state: Tensor, period: float) -> Tensor:
        return state[:, None, _POLE]

    def apply_to(self, measured: Tensor, memory: Tensor, period: float, generator: torch.Generator | None) -> Reading:
        pole = measured[:, _POLE]
        start, end = self.value("start", measured), self.value("end", measured)
        frozen = inside(pole[:, 0], start, end, self.EDGE)[:, None]
        seen = pole + frozen * (memory[:, 0] - pole)
        out = measured.clone()
        out[:, _POLE] = seen
        return out, seen[:, None]


class SensorScale(SensingEffect):
    """Encoders whose counts per metre or turn differ from those assumed; velocities scale with their positions."""

    name = "sensor_scale"
    order = 30
    systems = (CartPole,)
    equation = "(x, x_dot) measured = position (x, x_dot), (theta, theta_dot) measured = angle (theta, theta_dot)"
    source = "Ding (2013), Model-Based Fault Diagnosis Techniques, section 3.5 (multiplicative sensor fault)"
    table = (
        Parameter("position", "1", 0.5, 2.0, 1.0, linear=True),
        Parameter("angle", "1", 0.5, 2.0, 1.0, linear=True),
    )

    def apply_to(self, measured: Tensor, memory: Tensor, period: float, generator: torch.Generator | None) -> Reading:
        position = self.value("position", measured).expand(len(measured))
        angle = self.value("angle", measured).expand(len(measured))
        return measured * torch.stack((position, position, angle, angle), 1), memory


class SensorGain(SensingEffect):
    """A sensor whose counts per unit differ from those assumed."""

    source = "Ding (2013), Model-Based Fault Diagnosis Techniques, section 3.5 (multiplicative sensor fault)"
    columns: ClassVar[list[int]]  # the states that it reads

    def apply_to(self, measured: Tensor, memory: Tensor, period: float, generator: torch.Generator | None) -> Reading:
        out = measured.clone()
        out[:, self.columns] = out[:, self.columns] * self.value("scale", measured)[..., None]
        return out, memory


class SensorEccentricity(SensingEffect):
    """An angle sensor whose error returns in every turn, as that of an encoder whose disc is not centred on its shaft.

    A velocity that is read from it has the error's rate.
    """

    source = "Ellin and Dolsak (2008), The design and application of rotary encoders, Sensor Review 28(2)"
    columns: ClassVar[list[int]]  # the angle that it reads, and its velocity where it reads that too

    def apply_to(self, measured: Tensor, memory: Tensor, period: float, generator: torch.Generator | None) -> Reading:
        waves, amplitude = self.value("waves", measured), self.value("amplitude", measured)
        angle = waves * measured[:, self.columns[0]] + self.value("phase", measured)
        out = measured.clone()
        out[:, self.columns[0]] = out[:, self.columns[0]] + amplitude * angle.cos()
        for velocity in self.columns[1:]:
            out[:, velocity] = out[:, velocity] * (1 - amplitude * waves * angle.sin())
        return out, memory


class SensorOffset(SensingEffect):
    """An offset, () or (B,), on the reading of one state."""

    source = "Ding (2013), Model-Based Fault Diagnosis Techniques, section 3.5 (additive sensor fault)"
    sensor: ClassVar[int]  # column of the state that it reads

    def apply_to(self, measured: Tensor, memory: Tensor, period: float, generator: torch.Generator | None) -> Reading:
        out = measured.clone()
        out[:, self.sensor] = out[:, self.sensor] + self.value("offset", measured)
        return out, memory


class AngleOffset(SensorOffset):
    """A pole that reads `offset` when it is upright."""

    name = "angle_offset"
    order = 40
    systems = (CartPole,)
    equation = "theta measured = theta + offset"
    table = (Parameter("offset", "rad", -0.2, 0.2, 0.0, linear=True),)
    sensor = CartPole.index("theta")


class PositionOffset(SensorOffset):
    """A position sensor whose zero is off.

    A cart-pole moves alike at every position, so that no recording shows this offset unless another effect (a spring,
    a friction patch) acts at a known position.
    """

    name = "position_offset"
    order = 50
    systems = (CartPole,)
    equation = "x measured = x + offset"
    table = (Parameter("offset", "m", -0.5, 0.5, 0.0, linear=True),)
    sensor = CartPole.index("x")


class Dropout(Lossy, SensingEffect):
    """Lost rows: with probability `rate`, a row repeats the whole row before it.

    The first row of an episode is never lost, as there is none before it.
    """

    name = "dropout"
    order = 60
    equation = "measured_k = measured_(k-1) with probability rate"
    no_gradient = "whether a row is lost is a random yes or no"

    def memory(self, state: Tensor, period: float) -> Tensor:
        # The row measured last, then a flag: 1 if there is one.
        return torch.cat((state, torch.zeros_like(state[:, :1])), 1)[:, None]

    def apply_to(self, measured: Tensor, memory: Tensor, period: float, generator: torch.Generator | None) -> Reading:
        lost = self.lost(measured, generator) & (memory[:, 0, -1] > 0)
        out = torch.where(lost[:, None], memory[:, 0, :-1], measured)
        return out, torch.cat((out, torch.ones_like(out[:, :1])), 1)[:, None]


_POLE = [CartPole.index("theta"), CartPole.index("theta_dot")]
