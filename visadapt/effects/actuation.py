"""Effects on the command between the controller and the motor."""

from __future__ import annotations

import torch
from torch import Tensor

from visadapt.effects.base import ActuationEffect, Parameter


class ActuatorDelay(ActuationEffect):
    """A pure delay of any length, also a fraction of a substep.

    The command is held constant over each substep, so a delayed command can change inside one; what acts is its
    mean over the substep. That is exact in the limit of fine substeps and differentiable in the delay. Before an
    episode begins the command was zero.
    """

    name = "actuator_delay"
    equation = "u(t) = command(t - delay)"
    source = "Franklin, Powell and Workman (1998), Digital Control of Dynamic Systems, section 4.3.3"
    table = (Parameter("delay", "s", 0.0, 0.3, 0.0),)

    def memory(self, commands: Tensor, substep: float) -> Tensor:
        return torch.zeros_like(commands[:, :1]).expand(-1, self._reach(commands, substep), -1)

    def apply_to(self, commands: Tensor, memory: Tensor, substep: float) -> tuple[Tensor, Tensor]:
        batch, count, width = commands.shape
        shift = self._shift(commands, substep).expand(batch)
        past = torch.cat((memory, commands), 1)
        whole = shift.detach().floor()
        part = (shift - whole)[:, None, None]
        now = torch.arange(count, device=commands.device) + memory.shape[1]
        index = (now - whole.long()[:, None])[..., None].expand(batch, count, width)
        delayed = (1 - part) * past.gather(1, index) + part * past.gather(1, index - 1)
        return delayed, past[:, count:]

    def _shift(self, commands: Tensor, substep: float) -> Tensor:
        """The delay in substeps, one for each row or one for all, in the precision of the commands."""
        return self.value("delay", commands) / substep

    def _reach(self, commands: Tensor, substep: float) -> int:
        """Substeps of the past that the delay can reach."""
        shift = self._shift(commands, substep).detach()
        if not bool((shift >= 0).all()):
            raise ValueError(f"actuator_delay: delay must not be negative, got {float(shift.min()) * substep:g} s")
        return int(shift.max().floor()) + 1
