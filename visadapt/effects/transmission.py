"""A compliant transmission: the motor's encoder turns further than the joint, in proportion to the load transmitted."""

from __future__ import annotations

import copy
from typing import ClassVar, Self

import torch
from torch import Tensor

from visadapt.effects.base import Reading, SensingEffect
from visadapt.systems import System


class TransmissionCompliance(SensingEffect):
    """An encoder on the motor, with a belt, a gear or a shaft to the joint that gives under the motor's load.

    The motor turns ahead of the joint by compliance times its mean load over the period before the row, and faster by
    compliance times the rate of that load. The motor's own inertia and friction are neglected, which is right far below
    the frequency at which it resonates with the transmission.
    """

    # Before the late sensors, which show all of a reading later.
    order = 5
    source = "Spong (1987), Modeling and control of elastic joint robots, section 2"

    joint: ClassVar[int]
    """index of the load that the motor makes"""

    _drive: tuple[System, Tensor, Tensor] | None = None

    def under(self, system: System, command: Tensor, rate: Tensor) -> Self:
        bound = copy.copy(self)
        bound._drive = system, command, rate
        return bound

    def apply_to(self, measured: Tensor, memory: Tensor, period: float, generator: torch.Generator | None) -> Reading:
        if self._drive is None:
            return measured, memory
        system, command, rate = self._drive
        load, change = (system.motor_loads(measured, each)[:, self.joint] for each in (command, rate))
        out, compliance = measured.clone(), self.value("compliance", measured)
        position, velocity = system.coordinates[self.joint]
        out[:, position] = out[:, position] + compliance * load
        out[:, velocity] = out[:, velocity] + compliance * change
        return out, memory
