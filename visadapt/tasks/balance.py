"""The cart-pole's tasks: balance, and swing up and balance; and their cost.

The cost is the distance to a reference that is interpolated from the state now to the goal (the paper, section 3.1 and
A.1.3); it works although this reference is often infeasible:

    C = sum_k sum_i w_i (s_{t+k} - nu_{t+k})_i^2 + r |a_{t+k}|^2 with nu_{t+k} = s_t + k / K (goal - s_t), k = 1..K
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from visadapt.tasks.base import Task, curriculum
from visadapt.tasks.linear_quadratic import linear_quadratic
from visadapt.world import World

KICK_PROBABILITY = 0.05  # Of a random change of the state in a step of training


@dataclass(frozen=True)
class Cost:
    """Weights of the squared distances, one per state, and of the squared commands. The goal is the origin."""

    state: tuple[float, ...]
    action: float = 0.01

    def __call__(self, states: Tensor, actions: Tensor, now: Tensor) -> Tensor:
        """Cost (B,) of planned states (B, K, n_state) and actions (B, K, n_action) from the state now (B, n_state)."""
        horizon = states.shape[1]
        left = 1 - torch.arange(1, horizon + 1).to(now) / horizon
        reference = left[:, None] * now[:, None]
        tracking = (now.new_tensor(self.state) * (states - reference).square()).sum((1, 2))
        return tracking + self.action * actions.square().sum((1, 2))


@dataclass(frozen=True)
class SettlingCost(Cost):
    """As `Cost`, plus `end` times the weighted squared distance of the last planned state from the goal.

    Otherwise nothing after a plan's end has a cost. The cart's position is non-minimum phase: near upright, the cart
    must first move away from the goal before it can return. Under plans too short to include the return the cart runs
    away, the faster the larger the weight of x.
    """

    end: float = 0.0

    def __call__(self, states: Tensor, actions: Tensor, now: Tensor) -> Tensor:
        settled = (now.new_tensor(self.state) * states[:, -1].square()).sum(1)
        return super().__call__(states, actions, now) + self.end * settled


@dataclass(frozen=True)
class RegulatorCost(Cost):
    """Weighted squared distances to the goal itself, and a terminal cost s_{t+K}' V s_{t+K}.

    With the V of `cost_to_go` the best plan of K steps begins like the best one of infinite horizon. Without a terminal
    cost, a plan of half a second lets a force push the cart.
    """

    to_go: tuple[tuple[float, ...], ...] = ()
    """V, (n_state, n_state)"""

    def __call__(self, states: Tensor, actions: Tensor, now: Tensor) -> Tensor:
        last, weights, to_go = states[:, -1], now.new_tensor(self.state), now.new_tensor(self.to_go)
        tracking = (weights * states.square()).sum((1, 2)) + ((last @ to_go) * last).sum(1)
        return tracking + self.action * actions.square().sum((1, 2))


def cost_to_go(source: World, state: tuple[float, ...], action: float) -> tuple[tuple[float, ...], ...]:
    """V of `RegulatorCost` with these weights, for the source without effects, linearised at rest.

    s' V s is the least sum of the costs of all states and commands that follow a state s.
    """
    weights = torch.tensor(state, dtype=torch.float64)
    to_go = linear_quadratic(source, weights, weights.new_full((len(source.system.actions),), action)).to_go
    return tuple(tuple(row) for row in to_go.tolist())


PAPER_CARTPOLE = Cost(state=(0.0, 3.0, 10.0, 1.0))
"""A.1.3: angle 10, cart velocity 3, angular velocity 1; the cart may be anywhere."""

CENTRED_CARTPOLE = Cost(state=(30.0, 6.0, 100.0, 1.0))
"""Ours for a camera that stands still: the cart is drawn back to the middle of the frame.

The linearised cart-pole under the resulting 10-step plan has eigenvalues of at most 0.985 per step, comes to rest
0.7 m off per N of a constant force left uncompensated, and moves at 0.16 m/s per N of a force at 1 rad/s. With a
weight of 1 on the velocity it would draw back faster, but resonate with such a force at 0.26 m/s per N.
"""


@dataclass(frozen=True)
class Balance(Task):
    """Come to rest at the origin and stay there. The task state is empty: (B, 0)."""

    plan_cost: Cost
    start_spread: tuple[float, ...] = (0.5, 0.3, 0.15, 0.3)
    """half-widths of the uniform distribution of states that streams start from"""
    kick: tuple[float, ...] = (0.0, 0.3, 0.0, 0.5)
    """standard deviations of a random change of the state, in a share KICK_PROBABILITY of the steps: it widens the
    states seen in training"""
    divergence: tuple[float, ...] = (1.5, 4.0, 0.5, 10.0)
    """delta_div at the end of the curriculum: a stream starts anew where a state is beyond it"""
    first_divergence: float = 0.1
    """share of `divergence` that the curriculum begins with; it reaches 1 at half of the iterations"""

    def training_start(self, batch: int, progress: float, generator: torch.Generator) -> tuple[Tensor, Tensor]:
        spread = torch.minimum(torch.tensor(self.start_spread), self._limit(progress))
        state = spread * (2 * torch.rand(batch, len(spread), generator=generator) - 1)
        return state, state[:, :0]

    def cost(self, states: Tensor, plan: Tensor, now: Tensor, task_state: Tensor) -> Tensor:
        return self.plan_cost(states, plan, now)

    def diverged(self, state: Tensor, task_state: Tensor, progress: float) -> Tensor:
        return ~(state.abs() <= self._limit(progress).to(state)).all(1)  # also where a state is not a number

    def disturb(self, state: Tensor, generator: torch.Generator) -> Tensor:
        kicked = torch.rand(len(state), 1, generator=generator) < KICK_PROBABILITY
        kick = torch.tensor(self.kick) * torch.randn(state.shape, generator=generator)
        return state + (kicked * kick).to(state)

    def _limit(self, progress: float) -> Tensor:
        """delta_div now, (n_state,)."""
        return curriculum(self.first_divergence, progress) * torch.tensor(self.divergence)


@dataclass(frozen=True)
class SwingUp(Balance):
    """As `Balance`, but the pole may be anywhere (A.5): a turn more or less is the same angle."""

    def show(self, observed: Tensor, task_state: Tensor) -> Tensor:
        return within_a_turn(observed)

    def disturb(self, state: Tensor, generator: torch.Generator) -> Tensor:
        return within_a_turn(super().disturb(state, generator))


def within_a_turn(state: Tensor) -> Tensor:
    """States (B, 4) of a cart-pole with the angle between -pi and pi."""
    x, x_dot, theta, theta_dot = state.unbind(-1)
    return torch.stack((x, x_dot, torch.atan2(theta.sin(), theta.cos()), theta_dot), -1)
