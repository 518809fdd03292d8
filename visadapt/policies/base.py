"""Policies: from the last observations and actions to the next HORIZON actions, all at once.

A policy may read a residual: the correction that the residual predicts for a zero action is one of its inputs. It is a
function of the same observations and actions, so it adds no privileged information, but the policy need not learn again
what grounding has learnt, and adapts in far fewer iterations.
"""

from __future__ import annotations

import os
from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor, nn

from visadapt.effects import Residual
from visadapt.history import HORIZON, History


class Policy(nn.Module):
    """Base of policies; subclasses give the layers that turn a history into a plan.

    The correction enters the plan directly as a feed-forward, which can oppose a predicted force, and in some policies
    also as an input beside the history; both have zero weights at first.
    `learning.feedforward.initialise_feedforward` gives the feed-forward its weights once there is a residual.

    >>> import torch, visadapt as va
    >>> from visadapt.history import History
    >>> policy = va.load_policy(va.shipped("cartpole_states"))
    >>> policy.act(History.start(torch.zeros(2, 4), n_action=1)).shape
    torch.Size([2, 1])
    """

    shown: str = "state"
    """what it is shown of a target: state, frame, or state and goal (`targets.rollout.SHOWN`)"""

    def __init__(
        self,
        n_state: int,
        n_action: int,
        arguments: Mapping[str, Any] | None = None,
        observation_shape: tuple[int, ...] | None = None,
    ) -> None:
        super().__init__()
        if n_state < 1 or n_action < 1:
            raise ValueError(f"a policy of {n_state} states and {n_action} actions; at least one of each is right")
        self.arguments = dict(arguments or {})
        """those of the constructor, with which a policy file makes the policy again"""
        self.grounded_in: dict[str, Any] | None = None
        """the world that its residual completes, as `setups.policy_file.describe` puts it; None without a residual"""
        self.trained_in: dict[str, Any] | None = None
        """the world that it was trained or tuned in, put the same way; None where that is not known"""
        self.observation_shape = observation_shape or (n_state,)
        """shape of one observation: a state, a state and a goal, or a frame"""
        self.n_state = n_state
        self.n_action = n_action
        self.feedforward = nn.Linear(n_state, HORIZON * n_action, bias=False)
        nn.init.zeros_(self.feedforward.weight)
        self.residual: Residual | None = None

    @property
    def trained_period(self) -> float | None:
        """s between the commands that it was trained for; None where that is not known."""
        return self.trained_in["period"] if self.trained_in else None

    @property
    def command_range(self) -> tuple[Tensor, Tensor]:
        """Lowest and highest commands, (n_action,) each; -1 and 1, unless a subclass has others."""
        most = self.feedforward.weight.new_ones(self.n_action)
        return -most, most

    def unwrapped(self, state: Tensor, before: Tensor | None) -> Tensor:
        """States (B, n_state) that a target shows, in the turns in which the policy reads angles; `before` are those of
        the instant before, None at first. Most policies read angles as they are."""
        return state

    def embed(self, history: History) -> Tensor:
        """Inputs (B, inputs) of `plan` beside the correction: the features of frames, or the history itself."""
        raise NotImplementedError

    def plan(self, inputs: Tensor, correction: Tensor) -> Tensor:
        """Commands (B, HORIZON * n_action) before the last tanh, from the inputs and the correction (B, n_state)."""
        raise NotImplementedError

    def decide(self, inputs: Tensor, correction: Tensor) -> Tensor:
        """Planned actions (B, HORIZON, n_action), in `command_range`."""
        out = (self.plan(inputs, correction) + self.feedforward(correction)).tanh()
        return out.unflatten(-1, (HORIZON, self.n_action))

    def forward(self, history: History) -> Tensor:
        """Planned actions (B, HORIZON, n_action)."""
        return self.decide(self.embed(history), self.correction(history))

    def act(self, history: History) -> Tensor:
        """The action (B, n_action) to execute now."""
        return self(history)[:, 0]

    def correction(self, history: History) -> Tensor:
        """The residual's correction (B, n_state) of a zero action, in units of its scale; 0 without a residual."""
        observations = history.observations
        if self.residual is None:
            return observations.new_zeros(len(observations), self.n_state)
        with torch.no_grad():
            return self.residual.network(history.acting(torch.zeros_like(history.actions[:, 0])))


class AutoregressivePolicy(Policy):
    """Commands that decay towards `rest` (n_action,): each differs from it `keep` times as much as the last one.

    With the noise that `rollout.run` adds to commands they are a first-order autoregressive process.
    """

    rest: Tensor

    def __init__(self, n_state: int, rest: Tensor, keep: float) -> None:
        super().__init__(n_state, len(rest))
        self.register_buffer("rest", rest.clone())
        self.keep = keep

    def forward(self, history: History) -> Tensor:
        # An episode begins at rest.
        away = torch.where(history.begins[:, None], 0.0, history.actions[:, -1] - self.rest)
        lasting = self.keep ** torch.arange(1, HORIZON + 1).to(away)
        return self.rest + away[:, None] * lasting[:, None]


def check_policy(given: object) -> None:
    """Raises TypeError where something else is given in the place of a policy: its file, say, or a run that made it."""
    if not isinstance(given, Policy):
        made = "one that visadapt.train makes is right; a run has one as its .policy"
        right = "load_policy reads a file" if isinstance(given, str | os.PathLike) else made
        raise TypeError(f"a {type(given).__name__} is no policy: {right}")


def ignore_correction(layer: nn.Linear, n_state: int) -> None:
    """Set the weights on the correction to 0: a residual changes nothing until the policy is tuned with it."""
    with torch.no_grad():
        layer.weight[:, -n_state:] = 0.0
