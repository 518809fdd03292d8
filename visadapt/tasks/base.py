"""What a policy is trained for: where streams start, what the policy is shown, what a plan costs, what is astray."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass

import torch
from torch import Tensor

from visadapt.tasks.cost import Cost


class Task(ABC):
    """Base of tasks. A place (B, ...) is where a stream is on its way: a tensor of the task's own, opaque to others.

    `progress` in [0, 1] drives the curriculum: early on, streams start and stray less far (delta_div, section 2.2).
    """

    @abstractmethod
    def begin(self, batch: int, progress: float, generator: torch.Generator) -> tuple[Tensor, Tensor]:
        """States (batch, n_state) that streams start from, and their places."""

    @abstractmethod
    def cost(self, states: Tensor, plan: Tensor, now: Tensor, place: Tensor) -> Tensor:
        """Cost (B,) of a plan (B, K, n_action) and the states (B, K, n_state) it leads to, from state and place now."""

    @abstractmethod
    def diverged(self, state: Tensor, place: Tensor, progress: float) -> Tensor:
        """(B,) whether a stream starts anew."""

    def show(self, seen: Tensor, place: Tensor) -> Tensor:
        """What the policy is shown, given what sensors see (B, ...): a task with a reference adds it."""
        return seen

    def advance(self, place: Tensor) -> Tensor:
        """The places a step later."""
        return place

    def augment(
        self, seen: Tensor, state: Tensor, place: Tensor, generator: torch.Generator
    ) -> tuple[Tensor, Tensor, Tensor]:
        """What was seen (B, LENGTH, ...) up to states (B, n_state), at places (B, LENGTH, ...), as if somewhere else.

        A few hundred samples are of a few courses only; a task that knows others moves there what it can.
        """
        return seen, state, place

    def disturb(self, state: Tensor, generator: torch.Generator) -> Tensor:
        """States (B, n_state) with what chance does to them between steps."""
        return state


@dataclass(frozen=True)
class Balance(Task):
    """Come to rest at the origin and stay there. The place is empty."""

    cost_of: Cost
    start_spread: tuple[float, ...] = (0.5, 0.3, 0.15, 0.3)
    """half-widths of the uniform distribution of states that streams start from"""
    kick: tuple[float, ...] = (0.0, 0.3, 0.0, 0.5)
    """standard deviation of a random change of the state, met once in 20 steps: it widens what the policy meets"""
    divergence: tuple[float, ...] = (1.5, 4.0, 0.5, 10.0)
    """delta_div at the end of the curriculum: a stream starts anew where a state is beyond it"""
    first_divergence: float = 0.1
    """share of `divergence` that the curriculum begins with; it reaches 1 at half of the iterations"""

    def begin(self, batch: int, progress: float, generator: torch.Generator) -> tuple[Tensor, Tensor]:
        spread = torch.minimum(torch.tensor(self.start_spread), self._limit(progress))
        state = spread * (2 * torch.rand(batch, len(spread), generator=generator) - 1)
        return state, state[:, :0]

    def cost(self, states: Tensor, plan: Tensor, now: Tensor, place: Tensor) -> Tensor:
        return self.cost_of(states, plan, now)

    def diverged(self, state: Tensor, place: Tensor, progress: float) -> Tensor:
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

    def show(self, seen: Tensor, place: Tensor) -> Tensor:
        return within_a_turn(seen)

    def disturb(self, state: Tensor, generator: torch.Generator) -> Tensor:
        return within_a_turn(super().disturb(state, generator))


def within_a_turn(state: Tensor) -> Tensor:
    """States (B, 4) of a cart-pole with the angle between -pi and pi."""
    x, x_dot, theta, theta_dot = state.unbind(-1)
    return torch.stack((x, x_dot, torch.atan2(theta.sin(), theta.cos()), theta_dot), -1)


def curriculum(first: float, progress: float) -> float:
    """A share that grows from `first` to 1 over the first half of the training."""
    return first + (1 - first) * min(1.0, 2 * progress)
