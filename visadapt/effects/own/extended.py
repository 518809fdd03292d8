"""Systems of one's own with what effects add to them: inertia on joints, and drifts of states."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import make_dataclass, replace
from functools import cache
from typing import Any

import torch
from torch import Tensor

from visadapt.systems import System
from visadapt.systems.base import parameters

_INERTIA, _DRIFT = "added_inertia_", "drift_"  # ... and the joint, or the column of the state: fields, 0 unless set


class Extended(System):
    """A system of one's own with inertia added to its joints, exact since accelerations are linear in the loads, and
    with states that drift."""

    def check_parameters(self, either_sign: Collection[str] = (), may_be_zero: Collection[str] = ()) -> None:
        super().check_parameters((*either_sign, *_added(type(self))), may_be_zero)

    def derivative(self, state: Tensor, command: Tensor, load: Tensor) -> Tensor:
        after = super().derivative(state, command, load)  # type: ignore[safe-super]
        inertia = self._values(_INERTIA, len(self.loads))
        units = [load + torch.eye(load.shape[1]).to(load)[joint] for joint in inertia]
        gains = [super(Extended, self).derivative(state, command, unit) - after for unit in units]  # type: ignore[safe-super]
        for k, (joint, added) in enumerate(inertia.items()):
            # The body loads its joint by -inertia a, so that the joint's acceleration is a = free + gain (-inertia a).
            own = self.coordinates[joint][1]
            reaction = added / (1 + added * gains[k][:, own])
            after = after - gains[k] * (reaction * after[:, own])[:, None]
            gains = [gain - gains[k] * (reaction * gain[:, own])[:, None] for gain in gains]
        drift = self._values(_DRIFT, len(self.states))
        for column, rate in drift.items():
            after = after + torch.as_tensor(rate).to(after)[..., None] * torch.eye(after.shape[1]).to(after)[column]
        return after

    def _values(self, prefix: str, count: int) -> dict[int, Any]:
        """The fields of one kind, but for those that are 0, by their number."""
        values = {index: getattr(self, f"{prefix}{index}") for index in range(count)}
        return {index: value for index, value in values.items() if isinstance(value, Tensor) or value}


def _added(system: type[System]) -> list[str]:
    """The fields that `Extended` adds to a system."""
    joints, columns = range(len(system.loads)), range(len(system.states))
    return [*(f"{_INERTIA}{joint}" for joint in joints), *(f"{_DRIFT}{column}" for column in columns)]


@cache
def _extended(system: type[System]) -> type[Any]:
    added = [(name, Any, 0.0) for name in _added(system)]
    return make_dataclass(system.__name__, added, bases=(Extended, system), frozen=True)


def _with(system: System, field: str, amount: float | Tensor) -> System:
    """The system with an amount in one of these fields, beside what was there before."""
    values = {field: getattr(system, field, 0.0) + amount}
    if isinstance(system, Extended):
        return replace(system, **values)  # type: ignore[type-var]  # a dataclass
    made: System = _extended(type(system))(**dict(parameters(system)), **values)
    return made


def with_inertia(system: System, joint: int, inertia: float | Tensor) -> System:
    """The system with inertia added to one of its joints."""
    return _with(system, f"{_INERTIA}{joint}", inertia)


def with_drift(system: System, column: int, rate: float | Tensor) -> System:
    """The system with a state that changes at a rate, a number or (B,), beside what the system says."""
    return _with(system, f"{_DRIFT}{column}", rate)
