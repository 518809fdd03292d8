"""What the ensemble of PETS models: states to learn from, what it reads of them, what a plan costs."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import replace

import torch
from torch import Tensor

from benchmarks.baselines.cartpole import COST
from benchmarks.baselines.problem import Problem, Sizes
from visadapt.history import HORIZON, LENGTH, History
from visadapt.systems.rigid_body import ATTITUDE, RATES, VELOCITY, rotation
from visadapt.tasks.base import FlightTask
from visadapt.tasks.follow import Follow


class Subject(ABC):
    """A system as the ensemble sees it."""

    with_history: bool
    """whether it reads 5 states and commands, or the last alone"""
    show = "state"
    """what a policy is shown of it: `Policy.shown`"""
    noise: float
    """standard deviation of the commands that the first iteration of a plan draws"""

    @abstractmethod
    def draw(self, count: int, generator: torch.Generator) -> Tensor:
        """States (count, n_state) that runs of the source start from."""

    @abstractmethod
    def inputs(self, history: History) -> Tensor:
        """What it reads (B, inputs) of states and commands."""

    @abstractmethod
    def cost(self, states: Tensor, plans: Tensor, now: Tensor, goal: Tensor) -> Tensor:
        """Costs (B,) of plans (B, K, n_action) that lead to states (B, K, n_state), beside a goal (B, n_goal)."""


class CartPoleSubject(Subject):
    """A cart-pole. Its position is no input, since nothing depends on it."""

    noise = 0.03
    RANGES = (0.0, 1.5, 0.3, 1.5)
    """half-widths of the states that the source is sampled from"""

    def __init__(self, with_history: bool) -> None:
        self.with_history = with_history

    def draw(self, count: int, generator: torch.Generator) -> Tensor:
        return torch.tensor(self.RANGES) * (2 * torch.rand(count, len(self.RANGES), generator=generator) - 1)

    def inputs(self, history: History) -> Tensor:
        kept = LENGTH if self.with_history else 1
        return torch.cat((history.observations[:, -kept:, 1:].flatten(1), history.actions[:, -kept:].flatten(1)), 1)

    def cost(self, states: Tensor, plans: Tensor, now: Tensor, goal: Tensor) -> Tensor:
        return COST(states, plans, now)


class FlightSubject(Subject):
    """A vehicle, which reads its velocity, rotation matrix, rates and command, as the residual of ours does."""

    with_history = False
    show = "state and goal"
    noise = 0.3

    def __init__(self, task: FlightTask) -> None:
        self.task = task

    def draw(self, count: int, generator: torch.Generator) -> Tensor:
        return self.task.training_start(count, 1.0, generator)[0]

    def inputs(self, history: History) -> Tensor:
        state = history.observations[:, -1]
        turned = rotation(state[:, ATTITUDE]).flatten(1)
        return torch.cat((state[:, VELOCITY], turned, state[:, RATES], history.actions[:, -1]), 1)

    def cost(self, states: Tensor, plans: Tensor, now: Tensor, goal: Tensor) -> Tensor:
        if not isinstance(self.task, Follow):
            return self.task.cost(states, plans, now, goal)
        # How the reference turns is not shown, and so not weighed.
        reference = torch.cat((goal.unflatten(1, (HORIZON, -1)), torch.zeros_like(states[..., :3])), -1)
        return replace(self.task.plan_cost, turning=0.0)(states, plans, reference)


def subject_of(problem: Problem, sizes: Sizes) -> Subject:
    """The subject of a problem."""
    task = problem.setup(sizes).settings.source.task
    return FlightSubject(task) if isinstance(task, FlightTask) else CartPoleSubject(problem.with_history)
