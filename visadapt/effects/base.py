"""The one idea: everything that separates the target from the source is an Effect.

An effect acts at one stage along a step (actuation, dynamics, sensing, camera, or any). It states, in one place,
its equation, its source, its parameters with unit and searched range, and what it cannot be told apart from.
Subclasses register themselves by name, so adding an effect is adding a class.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum
from typing import ClassVar

import torch
from torch import Tensor, nn


class Stage(StrEnum):
    """Where along a step an effect acts."""

    ACTUATION = "actuation"
    DYNAMICS = "dynamics"
    ANY = "any"


@dataclass(frozen=True)
class Parameter:
    """One parameter of an effect: its unit, the range searched, and the value at which the effect vanishes.

    `neutral` is None for a parameter (a phase, say) that shapes the effect and cannot switch it off.
    """

    name: str
    unit: str
    low: float
    high: float
    neutral: float | None


class Effect(nn.Module):
    """Base of all effects. Parameters are tensors in physical units: scalars, or one value per batch row (B,)."""

    name: ClassVar[str]
    stage: ClassVar[Stage]
    equation: ClassVar[str]
    source: ClassVar[str]
    table: ClassVar[tuple[Parameter, ...]] = ()
    indistinguishable_from: ClassVar[tuple[str, ...]] = ()
    """Effects that passive data cannot separate from this one."""

    def __init_subclass__(cls, **kwargs: object) -> None:
        super().__init_subclass__(**kwargs)
        if "name" in cls.__dict__:
            taken = EFFECTS.get(cls.name)
            if taken is not None and taken.__qualname__ != cls.__qualname__:
                raise ValueError(f"the effect name {cls.name!r} is taken by {taken.__module__}.{taken.__qualname__}")
            EFFECTS[cls.name] = cls

    def __init__(self, **values: float | Tensor) -> None:
        super().__init__()
        known = {parameter.name for parameter in self.table}
        if values.keys() != known:
            raise ValueError(
                f"{self.name} takes the parameters {', '.join(sorted(known)) or 'none'}; "
                f"got {', '.join(sorted(values)) or 'none'}"
            )
        for key, value in values.items():
            self.register_parameter(key, nn.Parameter(torch.as_tensor(value, dtype=torch.get_default_dtype())))

    def value(self, name: str, like: Tensor) -> Tensor:
        """The parameter `name` with the device and dtype of `like`."""
        # Not get_parameter, which torch.func.functional_call's tensors do not pass.
        values: Tensor = getattr(self, name)
        return values.to(like)


class ActuationEffect(Effect):
    """Changes the command on its way to the physics."""

    stage = Stage.ACTUATION

    def memory(self, commands: Tensor, substep: float) -> Tensor:
        """What the effect remembers at the start of an episode; `commands` (B, S, n_action) gives shape and dtype."""
        return commands[:, :0]

    def apply_to(self, commands: Tensor, memory: Tensor, substep: float) -> tuple[Tensor, Tensor]:
        """What acts of the commands (B, S, n_action) over the S substeps, each `substep` s long, and the new memory."""
        raise NotImplementedError


class DynamicsEffect(Effect):
    """Adds a load, a generalised force per degree of freedom, to the physics."""

    stage = Stage.DYNAMICS

    def load(self, time: Tensor, state: Tensor) -> Tensor:
        """Load (B, n_load) at the time (B,) since the start of the episode, in a state (B, n_state)."""
        raise NotImplementedError


EFFECTS: dict[str, type[Effect]] = {}
"""Every effect by its standard name."""
