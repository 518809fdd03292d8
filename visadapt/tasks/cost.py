"""The control cost: distance to a reference that is interpolated from the state now to the goal.

C = sum_k |w (s_{t+k} - nu_{t+k})|^2 + r |a_{t+k}|^2 with nu_{t+k} = s_t + k / K (goal - s_t), k = 1..K.
The paper, section 3.1 and A.1.3. The reference is often infeasible, and works all the same.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor


@dataclass(frozen=True)
class Cost:
    """Weights of the squared distances, one per state, and of the squared commands. The goal is the origin."""

    state: tuple[float, ...]
    action: float = 0.01

    def __call__(self, states: Tensor, actions: Tensor, now: Tensor) -> Tensor:
        """Cost (B,) of planned states (B, K, n_state) and actions (B, K, n_action) from the state now (B, n_state)."""
        horizon = states.shape[1]
        left = 1 - torch.arange(1, horizon + 1, device=now.device, dtype=now.dtype) / horizon
        reference = left[:, None] * now[:, None]
        weights = torch.tensor(self.state, device=now.device, dtype=now.dtype)
        tracking = (weights * (states - reference).square()).sum((1, 2))
        return tracking + self.action * actions.square().sum((1, 2))


@dataclass(frozen=True)
class SettlingCost(Cost):
    """As `Cost`, and the last planned state (the reference is at the goal there) costs as much again, `end` times.

    What a plan that ends after K steps leaves behind is else free: near upright, drawing the cart back begins with a
    step away from the goal, so that a plan too short to gain from it runs away instead, the faster the more x weighs.
    """

    end: float = 0.0

    def __call__(self, states: Tensor, actions: Tensor, now: Tensor) -> Tensor:
        weights = torch.tensor(self.state, device=now.device, dtype=now.dtype)
        settled = (weights * states[:, -1].square()).sum(1)
        return super().__call__(states, actions, now) + self.end * settled


PAPER_CARTPOLE = Cost(state=(0.0, 3.0, 10.0, 1.0))
"""A.1.3: angle 10, cart velocity 3, angular velocity 1; the cart may be anywhere."""

CENTRED_CARTPOLE = Cost(state=(30.0, 6.0, 100.0, 1.0))
"""Ours for a camera that stands still: the cart is drawn back to the middle of the frame.

The linearised cart-pole under the resulting 10-step plan has eigenvalues of at most 0.985 per step, comes to rest
0.7 m off per N of a constant force left uncompensated, and moves at 0.16 m/s per N of a force at 1 rad/s. With a
weight of 1 on the velocity it would draw back faster, but resonate with such a force at 0.26 m/s per N.
"""
