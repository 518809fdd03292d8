"""What every system states about itself: its variables, its parameters and its continuous-time derivative."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass, fields, replace
from typing import Any, ClassVar, Self

from torch import Tensor


@dataclass(frozen=True)
class Variable:
    """One entry of a state or action vector: its name, SI unit and the range a run is expected to stay in."""

    name: str
    unit: str
    low: float
    high: float


class System(ABC):
    """Source physics in continuous time, batched and differentiable.

    Subclasses are frozen dataclasses whose fields are the physical parameters in SI units: numbers, or tensors, () or
    (B,), where an effect has changed them.
    """

    name: ClassVar[str]
    states: ClassVar[tuple[Variable, ...]]
    actions: ClassVar[tuple[Variable, ...]]
    loads: ClassVar[tuple[Variable, ...]]
    """Generalised forces that a dynamics effect may add, one entry per degree of freedom."""

    @abstractmethod
    def derivative(self, state: Tensor, command: Tensor, load: Tensor) -> Tensor:
        """Time derivative (B, n_state) of a state (B, n_state) under a command (B, n_action) and a load (B, n_load)."""

    def to(self, like: Tensor) -> Self:
        """The same system, parameters that are tensors with the device and dtype of `like`."""
        itself: Any = self  # a dataclass, which this base is not
        values = {field.name: getattr(self, field.name) for field in fields(itself)}
        return replace(itself, **{k: value.to(like) for k, value in values.items() if isinstance(value, Tensor)})

    @classmethod
    def index(cls, name: str) -> int:
        """Column of the state called `name`; raises KeyError naming the states there are."""
        names = [variable.name for variable in cls.states]
        if name not in names:
            raise KeyError(f"{cls.name} has no state {name!r}; its states are {', '.join(names)}")
        return names.index(name)


def holds(condition: bool | Tensor) -> bool:
    """Whether a condition on a parameter, a number or a tensor, holds in every row."""
    return bool(condition.all()) if isinstance(condition, Tensor) else condition
