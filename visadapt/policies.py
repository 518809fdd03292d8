"""Policies: what the last observations and actions say to the next HORIZON actions at once, in [-1, 1]."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from visadapt.history import LENGTH, History
from visadapt.networks import FEATURES, FrameEncoder, mlp

HORIZON = 10
"""Actions planned at once, k in the paper; only the first is executed before planning again."""


class Policy(nn.Module):
    """Base: `forward` plans (B, HORIZON, n_action)."""

    n_action: int

    def act(self, history: History) -> Tensor:
        """The action (B, n_action) to execute now."""
        plan: Tensor = self(history)
        return plan[:, 0]


class ImagePolicy(Policy):
    """A 4-layer CNN on the last 5 frames and 5 actions (the paper, section 3.2.3)."""

    def __init__(self, background: Tensor, contrast: float, n_action: int = 1) -> None:
        super().__init__()
        self.n_action = n_action
        self.encoder = FrameEncoder(background, contrast, n_action)
        self.plan = nn.Sequential(nn.Linear(FEATURES, 64), nn.ReLU(), nn.Linear(64, HORIZON * n_action), nn.Tanh())

    def forward(self, history: History) -> Tensor:
        out: Tensor = self.plan(self.encoder(history))
        return out.unflatten(-1, (HORIZON, self.n_action))


class StatePolicy(Policy):
    """The paper's MLP for balancing, 32-64-64-32-10, tanh (A.1.3), on the state, or on 5 states and actions."""

    def __init__(self, n_state: int, n_action: int = 1, with_history: bool = False) -> None:
        super().__init__()
        self.n_action = n_action
        self.with_history = with_history
        inputs = LENGTH * (n_state + n_action) if with_history else n_state
        self.layers = nn.Sequential(mlp(inputs, 32, 64, 64, 32, HORIZON * n_action), nn.Tanh())

    def forward(self, history: History) -> Tensor:
        if self.with_history:
            seen = torch.cat((history.observations.flatten(1), history.actions.flatten(1)), 1)
        else:
            seen = history.observations[:, -1]
        out: Tensor = self.layers(seen)
        return out.unflatten(-1, (HORIZON, self.n_action))
