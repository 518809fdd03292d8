"""Inertia added to the joints of a system of one's own."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import make_dataclass, replace
from functools import cache
from typing import Any

import torch
from torch import Tensor

from visadapt.effects.laws import JointEffect
from visadapt.systems import System
from visadapt.systems.base import parameters


class AddedInertia(JointEffect):
    """A body fixed to the joint that adds inertia and no weight, such as a flywheel or a rotor behind a gear."""

    source = "Newton's second law"

    def alter(self, system: System) -> System:
        return with_inertia(system, self.joint, getattr(self, self.table[0].name))


_ADDED = "added_inertia_"  # ... and the joint: fields of systems with added inertia


class Inertial(System):
    """A system of one's own with inertia added to its joints: exact, since accelerations are linear in the loads."""

    def check_parameters(self, either_sign: Collection[str] = (), may_be_zero: Collection[str] = ()) -> None:
        added = [f"{_ADDED}{joint}" for joint in range(len(self.loads))]
        super().check_parameters(either_sign, (*may_be_zero, *added))

    def derivative(self, state: Tensor, command: Tensor, load: Tensor) -> Tensor:
        after = super().derivative(state, command, load)  # type: ignore[safe-super]
        inertia = [getattr(self, f"{_ADDED}{joint}") for joint in range(len(self.loads))]
        joints = [joint for joint, value in enumerate(inertia) if isinstance(value, Tensor) or value]
        units = [load + torch.eye(load.shape[1]).to(load)[joint] for joint in joints]
        gains = [super(Inertial, self).derivative(state, command, unit) - after for unit in units]  # type: ignore[safe-super]
        for k, joint in enumerate(joints):
            # The body loads its joint by -inertia a, so that the joint's acceleration is a = free + gain (-inertia a).
            own = self.coordinates[joint][1]
            reaction = inertia[joint] / (1 + inertia[joint] * gains[k][:, own])
            after = after - gains[k] * (reaction * after[:, own])[:, None]
            gains = [gain - gains[k] * (reaction * gain[:, own])[:, None] for gain in gains]
        return after


@cache
def _inertial(system: type[System]) -> type[Any]:
    added = [(f"{_ADDED}{joint}", Any, 0.0) for joint in range(len(system.loads))]
    return make_dataclass(system.__name__, added, bases=(Inertial, system), frozen=True)


def with_inertia(system: System, joint: int, inertia: float | Tensor) -> System:
    """The system with inertia added to one of its joints, beside what was added before."""
    field = f"{_ADDED}{joint}"
    values = {field: getattr(system, field, 0.0) + inertia}
    if isinstance(system, Inertial):
        return replace(system, **values)  # type: ignore[type-var]  # a dataclass
    altered: System = _inertial(type(system))(**dict(parameters(system)), **values)
    return altered


def inertia_of(system: System, joint: int) -> float:
    """The joint's own inertia, in units of load per acceleration, in the middle of the states' ranges."""
    state, command, load = (
        torch.tensor([[(one.low + one.high) / 2 for one in variables]], dtype=torch.float64)
        for variables in (system.states, system.actions, system.loads)
    )
    _, gain = system.response_to_loads(state, command, load)
    return 1 / float(gain[0, joint, joint])
