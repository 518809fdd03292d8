"""What policies and residuals are allowed to see: the last observations and actions, and nothing else."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from visadapt.batch import Batch

LENGTH = 5  # Observations and actions kept (the paper, section 3.2.2)

HORIZON = 10  # Actions planned at once, k in the paper; only the first is executed before planning again


@dataclass(frozen=True)
class History(Batch):
    """The last observations (B, L, ...), oldest first, and the last actions (B, L, n_action).

    For a policy the last action is the one before the last observation; for a residual (see `acting`) it is the
    one being executed. An observation is a frame (H, W) in [0, 1] or a state (n_state,).
    """

    observations: Tensor
    actions: Tensor

    @classmethod
    def start(cls, observation: Tensor, n_action: int) -> History:
        """At the start of an episode: the first observation (B, ...) repeated, and zero actions."""
        repeated = observation[:, None].expand(-1, LENGTH, *observation.shape[1:])
        return cls(repeated.clone(), observation.new_zeros(len(observation), LENGTH, n_action))

    @property
    def begins(self) -> Tensor:
        """(B,) whether an episode begins: all actions before it are exactly zero, which no policy commands."""
        return ~self.actions.flatten(1).any(1)

    def acting(self, action: Tensor) -> History:
        """The same observations, with `action` (B, n_action) as the last action."""
        return History(self.observations, torch.cat((self.actions[:, 1:], action[:, None]), 1))

    def observing(self, observation: Tensor) -> History:
        """The same actions, with `observation` (B, ...) as the last observation."""
        return History(torch.cat((self.observations[:, 1:], observation[:, None]), 1), self.actions)
