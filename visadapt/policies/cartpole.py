"""Policies of the cart-pole: on frames, and on states."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from visadapt.history import HORIZON, LENGTH, History
from visadapt.policies.base import Policy, ignore_correction
from visadapt.policies.frame_encoder import N_FEATURES, FrameEncoder
from visadapt.policies.networks import mlp


class ImagePolicy(Policy):
    """A 4-layer CNN on the last 5 frames and 5 actions (the paper, section 3.2.3); only the feed-forward reads the
    correction.

    `perception` is the encoder as `learning.perception` trained it, from which a residual starts. Training the policy
    does not change it.
    """

    shown = "frame"

    def __init__(self, background: Tensor, contrast: float, n_state: int = 4, n_action: int = 1) -> None:
        # Made first: the weights that a seed gives depend on the order in which networks are made.
        perception = FrameEncoder(background, contrast, n_action).requires_grad_(False)
        given = {"background": background, "contrast": contrast, "n_state": n_state, "n_action": n_action}
        super().__init__(n_state, n_action, given, tuple(background.shape))
        self.perception = perception
        self.encoder = FrameEncoder(background, contrast, n_action)
        self.hidden = nn.Linear(N_FEATURES, 64)
        self.out = nn.Linear(64, HORIZON * n_action)

    def embed(self, history: History) -> Tensor:
        return self.encoder(history)

    def plan(self, inputs: Tensor, correction: Tensor) -> Tensor:
        return self.out(self.hidden(inputs).relu())


class StatePolicy(Policy):
    """The paper's MLP for balancing, 32-64-64-32-10, tanh (A.1.3), on the state, or on 5 states and actions."""

    def __init__(self, n_state: int, n_action: int = 1, with_history: bool = False) -> None:
        given = {"n_state": n_state, "n_action": n_action, "with_history": with_history}
        super().__init__(n_state, n_action, given)
        self.with_history = with_history
        inputs = LENGTH * (n_state + n_action) if with_history else n_state
        self.first = nn.Linear(inputs + n_state, 32)
        self.rest = mlp(32, 64, 64, 32, HORIZON * n_action)
        ignore_correction(self.first, n_state)

    def embed(self, history: History) -> Tensor:
        states, actions = history.observations, history.actions
        if states.shape[-1] != self.n_state:
            raise ValueError(f"the policy was trained on {self.n_state} numbers of state, got {states.shape[-1]}")
        return torch.cat((states.flatten(1), actions.flatten(1)), 1) if self.with_history else states[:, -1]

    def plan(self, inputs: Tensor, correction: Tensor) -> Tensor:
        return self.rest(self.first(torch.cat((inputs, correction), 1)).tanh())
