"""Base of systems: variables, physical parameters and continuous-time derivative."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Collection, Sequence
from dataclasses import dataclass, fields, replace
from functools import cached_property
from typing import Any, ClassVar, Self

import torch
from torch import Tensor


@dataclass(frozen=True)
class Variable:
    """One entry of a state, action or load: its name, SI unit and expected range.

    >>> import visadapt as va
    >>> va.Variable("theta", "rad", -0.3, 0.3).unit
    'rad'
    """

    name: str
    unit: str
    low: float
    high: float

    @property
    def largest(self) -> float:
        """The largest size in its range."""
        return max(abs(self.low), abs(self.high))

    @property
    def scale(self) -> float:
        """The size against which errors are small or not: the largest, but half a turn at most of a shaft that turns
        on."""
        return min(self.largest, math.pi) if self.unit == "rad" else self.largest


class System(ABC):
    """Physics of the source simulator in continuous time, batched and differentiable.

    Subclasses are frozen dataclasses whose fields are the physical parameters in SI units: each a number or a tensor,
    () or (B,), which an effect may have changed.

    >>> from dataclasses import dataclass
    >>> import torch, visadapt as va
    >>> @dataclass(frozen=True)
    ... class Slider(va.System):
    ...     mass: float = 2.0
    ...     name = "slider"
    ...     states = (va.Variable("x", "m", -1.0, 1.0), va.Variable("x_dot", "m/s", -1.0, 1.0))
    ...     actions = (va.Variable("command", "1", -1.0, 1.0),)
    ...     loads = (va.Variable("force", "N", -10.0, 10.0),)
    ...     def derivative(self, state, command, load):
    ...         return torch.stack((state[:, 1], (command[:, 0] + load[:, 0]) / self.mass), 1)
    >>> world = va.World(Slider(), period=0.1)
    >>> world.step(world.start(torch.zeros(1, 2)), torch.ones(1, 1)).state
    tensor([[0.0025, 0.0500]])
    """

    name: ClassVar[str]
    states: ClassVar[tuple[Variable, ...]]
    actions: ClassVar[tuple[Variable, ...]]
    loads: ClassVar[tuple[Variable, ...]]
    """Generalised forces that a dynamics effect may add, one entry per degree of freedom."""
    coordinates: ClassVar[tuple[tuple[int | None, int], ...]] = ()
    """For each load the columns of the position and the velocity that it acts on; dry friction needs them. A velocity
    that is the rate of no state, as the forward speed of a robot on wheels, has None for its position."""
    prediction_time: ClassVar[float] = 0.5
    """s ahead that predictions are compared with a recording. The other times of a diagnosis follow from it: rows are
    at most a third of it apart, delays are searched up to 0.4 of it. Longer for a machine that moves slowly: 10 for a
    boat."""
    longest_step: ClassVar[float | None] = None
    """s, the longest Runge-Kutta step that follows the dynamics with the default parameters; None: found from the
    derivative"""

    @abstractmethod
    def derivative(self, state: Tensor, command: Tensor, load: Tensor) -> Tensor:
        """Time derivative (B, n_state) of a state (B, n_state) under a command (B, n_action) and a load (B, n_load)."""

    def accelerations(self, state: Tensor, command: Tensor, load: Tensor) -> Tensor:
        """Accelerations (B, J) of the joints; arguments as in `derivative`."""
        return self.derivative(state, command, load)[:, [velocity for _, velocity in self.coordinates]]

    def rates_per_load(
        self, state: Tensor, command: Tensor, load: Tensor, chosen: Sequence[int]
    ) -> tuple[Tensor, list[Tensor]]:
        """Rates (B, n_state) of the states, and their change (B, n_state) per unit of each of the `chosen` loads."""
        rates, units = self.derivative(state, command, load), torch.eye(load.shape[1]).to(load)
        return rates, [self.derivative(state, command, load + units[k]) - rates for k in chosen]

    def response_to_loads(self, state: Tensor, command: Tensor, load: Tensor) -> tuple[Tensor, Tensor]:
        """Accelerations (B, J) of the joints, and their change (B, J, J) per unit of each load, the last axis."""
        rates, by_load = self.rates_per_load(state, command, load, range(load.shape[1]))
        velocities = [velocity for _, velocity in self.coordinates]
        return rates[:, velocities], torch.stack([change[:, velocities] for change in by_load], -1)

    def motor_loads(self, state: Tensor, command: Tensor) -> Tensor:
        """The loads (B, J) that would move the system as the command does.

        They are not finite where the state is so far off, in a trial of a search, that no load changes accelerations.
        """
        none = state.new_zeros(len(state), len(self.loads))
        free, by_load = self.response_to_loads(state, torch.zeros_like(command), none)
        return torch.linalg.solve_ex(by_load, self.accelerations(state, command, none) - free).result

    def __post_init__(self) -> None:
        self.check_parameters()

    def load_scale(self, unit: str) -> float:
        """Factor on the ranges searched of parameters with this unit, at least 1.

        How much larger loads are to be expected than with the default parameters.
        """
        return 1.0

    @cached_property
    def is_constant(self) -> bool:
        """Whether no parameter is a tensor, so that what depends on parameters alone need be computed only once."""
        return not any(isinstance(value, Tensor) for _, value in parameters(self))

    def to(self, like: Tensor) -> Self:
        """The same system; parameters that are tensors get the device and dtype of `like`."""
        itself: Any = self  # subclasses are dataclasses, this base is not
        return replace(itself, **{k: value.to(like) for k, value in parameters(self) if isinstance(value, Tensor)})

    def of_rows(self, rows: Tensor) -> Self:
        """The same system for the `rows`, a mask (B,), of a batch alone: with their parameters, where rows differ."""
        itself: Any = self  # as in `to`
        differing = {k: value[rows] for k, value in parameters(self) if isinstance(value, Tensor) and value.dim()}
        return replace(itself, **differing) if differing else self

    def check_parameters(self, either_sign: Collection[str] = (), may_be_zero: Collection[str] = ()) -> None:
        """Raise ValueError if a parameter is not finite, or is negative or 0 where it may not be."""
        for name, value in parameters(self):
            right, least = "positive", torch.finfo(torch.float32).tiny
            if name in either_sign:
                right, least = "finite", -math.inf
            elif name in may_be_zero:
                right, least = "0 or positive", 0.0
            if not holds(value >= least):
                raise ValueError(f"{self.name}: {name} must be {right}, got {value!r}")
            if not holds(abs(value) < math.inf):
                raise ValueError(f"{self.name}: {name} must be finite, got {value!r}")

    def __init_subclass__(cls, **kwargs: object) -> None:
        super().__init_subclass__(**kwargs)
        if "name" in cls.__dict__:
            NAMED[cls.name] = cls

    @classmethod
    def within_range(cls, command: Tensor) -> Tensor:
        """Commands (..., n_action), each limited to its range."""
        ranges = [(action.low, action.high) for action in cls.actions]
        if len(set(ranges)) == 1:
            return command.clamp(*ranges[0])
        low, high = command.new_tensor(ranges).unbind(-1)
        return command.clamp(low, high)

    @classmethod
    def rate_of(cls, name: str) -> str | None:
        """The state that is the rate of change of the state `name`; None where there is none."""
        names = [variable.name for variable in cls.states]
        for position, velocity in cls.velocity_of().items():
            if names[position] == name:
                return names[velocity]
        return f"{name}_dot" if f"{name}_dot" in names else None

    @classmethod
    def velocity_of(cls) -> dict[int, int]:
        """The column of each joint's position to the column of its velocity, for joints that have a position."""
        return {position: velocity for position, velocity in cls.coordinates if position is not None}

    @classmethod
    def outside_joints(cls) -> list[int]:
        """The columns of the states that belong to no joint, such as the position of a vehicle that shows its speed."""
        return [k for k in range(len(cls.states)) if all(k not in pair for pair in cls.coordinates)]

    @classmethod
    def index(cls, name: str) -> int:
        """Column of the state `name`; raises KeyError, which lists the states, if there is none."""
        names = [variable.name for variable in cls.states]
        if name not in names:
            raise KeyError(f"{cls.name} has no state {name!r}; its states are {', '.join(names)}")
        return names.index(name)


NAMED: dict[str, type[System]] = {}  # Every system by its name, also the user's own


Parameters = tuple[tuple[str, Any], ...]
"""Names and values of a system's parameters."""


def parameters(system: System) -> Parameters:
    """All parameters of a system, in the order of the class's fields."""
    itself: Any = system  # a dataclass, as its base is not
    return tuple((field.name, getattr(system, field.name)) for field in fields(itself))


def holds(condition: bool | Tensor) -> bool:
    """Whether a condition on a parameter holds: if it is a tensor, in every row."""
    return bool(condition.all()) if isinstance(condition, Tensor) else condition
