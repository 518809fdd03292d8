"""A random policy."""

from __future__ import annotations

import torch
from torch import Tensor

from visadapt.history import HORIZON, History
from visadapt.policies.base import Policy


class AutoregressivePolicy(Policy):
    """A random policy: commands (n_action,) about `rest` that the noise of `rollout.run` drives, and that last a while.

    Each is the last one, nearer to rest by the factor `keep`: it has nothing to draw, so that a run that is interrupted
    and goes on draws the same.
    """

    rest: Tensor

    def __init__(self, n_state: int, rest: Tensor, keep: float) -> None:
        super().__init__(n_state, len(rest))
        self.register_buffer("rest", rest.clone())
        self.keep = keep

    def forward(self, history: History) -> Tensor:
        # Before an episode all actions are zero, which is nobody's command: it begins at rest.
        begun = history.actions.flatten(1).any(1, keepdim=True)
        away = torch.where(begun, history.actions[:, -1] - self.rest, 0.0)
        lasting = self.keep ** torch.arange(1, HORIZON + 1).to(away)
        return self.rest + away[:, None] * lasting[:, None]
