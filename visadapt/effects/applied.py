"""What acts of the commands as a row is read, for the sensors whose reading depends on it."""

from __future__ import annotations

import torch
from torch import Tensor

from visadapt.effects.base import ActuationEffect
from visadapt.systems.integrators import Duration


class LastApplied(ActuationEffect):
    """Remembers the mean over the last period of the commands after all other actuation effects, and their rate of
    change; changes nothing.

    Args:
        substeps: in a period.
    """

    def __init__(self, substeps: int) -> None:
        super().__init__()
        self.substeps = substeps

    def memory(self, commands: Tensor, substep: float) -> Tensor:
        """(B, 2, n_action) what acts, and its rate per s, as a row is read before which the command was zero."""
        return torch.zeros_like(commands[:, :1]).repeat(1, 2, 1)

    def apply_to(self, commands: Tensor, memory: Tensor, substep: Duration) -> tuple[Tensor, Tensor]:
        by_period = -1, self.substeps
        held = substep.unflatten(1, by_period).sum(2) if isinstance(substep, Tensor) else self.substeps * substep
        return commands, _with_rate(commands.unflatten(1, by_period).mean(2), held, memory)[:, -1]


def applied_along(acting: Tensor, held: Tensor) -> Tensor:
    """What acts (B, T, 2, n_action) as each row of whole episodes is read, and its rate of change per s.

    Args:
        acting: (B, T, substeps, n_action) what acts after each row, as `World.actuate` has it; before the first the
            command was zero.
        held: (B, T) s that it acts.
    """
    rest = acting.new_zeros(len(acting), 2, acting.shape[-1])
    return torch.cat((rest[:, None], _with_rate(acting[:, :-1].mean(2), held[:, :-1], rest)), 1)


def _with_rate(mean: Tensor, held: Duration, before: Tensor) -> Tensor:
    """The mean (B, T, n_action) over T periods, which last `held` s, with its rate of change: (B, T, 2, n_action).

    `before` (B, 2, n_action) is the same of the period before the first of them.
    """
    change = torch.cat((before[:, :1], mean), 1).diff(dim=1)
    return torch.stack((mean, change / (held[..., None] if isinstance(held, Tensor) else held)), 2)
