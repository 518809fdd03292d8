"""What acts of the commands as a row is read, for the sensors whose reading depends on it."""

from __future__ import annotations

import torch
from torch import Tensor

from visadapt.effects.base import ActuationEffect
from visadapt.systems.integrators import Duration


class LastApplied(ActuationEffect):
    """Remembers what acts of the commands, after all other actuation effects, and changes nothing.

    Args:
        substeps: in a period.
    """

    def __init__(self, substeps: int) -> None:
        super().__init__()
        self.substeps = substeps

    def memory(self, commands: Tensor, substep: float) -> Tensor:
        """(B, 2, n_action) as `applied` has it, of a row before which the command was zero."""
        return torch.zeros_like(commands[:, :1]).repeat(1, 2, 1)

    def apply_to(self, commands: Tensor, memory: Tensor, substep: Duration) -> tuple[Tensor, Tensor]:
        by_period = -1, self.substeps
        held = substep.unflatten(1, by_period).sum(2) if isinstance(substep, Tensor) else self.substeps * substep
        return commands, applied(commands.unflatten(1, by_period).mean(2), held, memory)[:, -1]


def applied(mean: Tensor, held: Duration, before: Tensor) -> Tensor:
    """What acts in the mean of the period before each of T rows, and its rate of change per s: (B, T, 2, n_action).

    Args:
        mean: (B, T, n_action) what acts in the mean of the period before each row.
        held: s that these periods last, or (B, T) s.
        before: (B, 2, n_action) the same as is returned, of the row before the first of them.
    """
    change = torch.cat((before[:, :1], mean), 1).diff(dim=1)
    return torch.stack((mean, change / (held[..., None] if isinstance(held, Tensor) else held)), 2)
