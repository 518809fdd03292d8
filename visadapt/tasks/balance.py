"""The cart-pole's tasks: balance, and swing up and balance."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from visadapt.tasks.base import Task, curriculum
from visadapt.tasks.cost import Cost


@dataclass(frozen=True)
class Balance(Task):
    """Come to rest at the origin and stay there. The task state is empty: (B, 0)."""

    cost_of: Cost
    start_spread: tuple[float, ...] = (0.5, 0.3, 0.15, 0.3)
    """half-widths of the uniform distribution of states that streams start from"""
    kick: tuple[float, ...] = (0.0, 0.3, 0.0, 0.5)
    """standard deviation of a random change of the state, met once in 20 steps: it widens what the policy meets"""
    divergence: tuple[float, ...] = (1.5, 4.0, 0.5, 10.0)
    """delta_div at the end of the curriculum: a stream starts anew where a state is beyond it"""
    first_divergence: float = 0.1
    """share of `divergence` that the curriculum begins with; it reaches 1 at half of the iterations"""

    def training_start(self, batch: int, progress: float, generator: torch.Generator) -> tuple[Tensor, Tensor]:
        spread = torch.minimum(torch.tensor(self.start_spread), self._limit(progress))
        state = spread * (2 * torch.rand(batch, len(spread), generator=generator) - 1)
        return state, state[:, :0]

    def cost(self, states: Tensor, plan: Tensor, now: Tensor, task_state: Tensor) -> Tensor:
        return self.cost_of(states, plan, now)

    def diverged(self, state: Tensor, task_state: Tensor, progress: float) -> Tensor:
        return (state.abs() > self._limit(progress)).any(1)

    def disturb(self, state: Tensor, generator: torch.Generator) -> Tensor:
        kicked = torch.rand(len(state), 1, generator=generator) < 0.05
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
