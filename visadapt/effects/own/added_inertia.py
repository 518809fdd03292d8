"""Inertia added to the joints of a system of one's own."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import fields, make_dataclass, replace
from functools import cache
from typing import Any

import torch
from torch import Tensor

from visadapt.effects.laws import JointEffect
from visadapt.systems import System
from visadapt.systems.rigid_body import beside


class AddedInertia(JointEffect):
    """A body fixed to the joint that adds inertia and no weight, such as a flywheel or a rotor behind a gear."""

    source = "Newton's second law"

    def alter(self, system: System) -> System:
        values = {f"{_ADDED}{self.joint}": getattr(self, self.table[0].name)}
        if isinstance(system, Inertial):
            return replace(system, **values)  # type: ignore[type-var]  # a dataclass
        kept = {field.name: getattr(system, field.name) for field in fields(system)}  # type: ignore[arg-type]
        altered: System = _inertial(type(system))(**kept, **values)
        return altered


_ADDED = "added_inertia_"  # ... and the joint: fields of systems with added inertia


class Inertial(System):
    """A system of one's own with inertia added to its joints: exact, since accelerations are linear in the loads."""

    def check_parameters(self, either_sign: Collection[str] = (), may_be_zero: Collection[str] = ()) -> None:
        added = [f"{_ADDED}{joint}" for joint in range(len(self.loads))]
        super().check_parameters(either_sign, (*may_be_zero, *added))

    def derivative(self, state: Tensor, command: Tensor, load: Tensor) -> Tensor:
        free = super().derivative(state, command, load)  # type: ignore[safe-super]
        inertia = [getattr(self, f"{_ADDED}{joint}") for joint in range(len(self.loads))]
        joints = [joint for joint, value in enumerate(inertia) if isinstance(value, Tensor) or value]
        own = [self.coordinates[joint][1] for joint in joints]
        units = load[None] + torch.eye(load.shape[1]).to(load)[joints, None]
        gain = torch.stack([super(Inertial, self).derivative(state, command, unit) - free for unit in units], -1)  # type: ignore[safe-super]
        added = beside([inertia[joint] for joint in joints], load)
        # The added inertia's reaction to the joints' accelerations, which it changes: a = free + gain (-inertia a).
        matrix = torch.eye(len(joints)).to(load) + gain[:, own] * added[..., None, :]
        acceleration = torch.linalg.solve(matrix, free[:, own])
        return free - (gain @ (added * acceleration)[..., None])[..., 0]


@cache
def _inertial(system: type[System]) -> type[Any]:
    added = [(f"{_ADDED}{joint}", Any, 0.0) for joint in range(len(system.loads))]
    return make_dataclass(system.__name__, added, bases=(Inertial, system), frozen=True)


def inertia_of(system: System, joint: int) -> float:
    """The joint's own inertia in the middle of the states' ranges."""
    state, command, load = (
        torch.tensor([[(one.low + one.high) / 2 for one in variables]], dtype=torch.float64)
        for variables in (system.states, system.actions, system.loads)
    )
    _, gain = system.response_to_loads(state, command, load)
    return 1 / float(gain[0, joint, joint])
