"""What a policy is trained for: where episodes start, what it is shown, what a plan costs, when it has diverged."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import Self

import torch
from torch import Tensor

from visadapt.world import World

EPISODE_STEPS = 250
"""Steps of an episode, in training and in scores, of a task that states no other number; a cart-pole's."""


class Task(ABC):
    """Base of tasks, which are frozen dataclasses: their fields are kept in a policy's file and in a run's settings.

    A task state (B, ...) is how far episodes are in their task: a tensor that the task alone reads.

    `progress` in [0, 1] is the share of the training that is done. It drives the curriculum: early on, streams start
    near the goal and are cut off near it (delta_div, section 2.2 of the paper).

    >>> import torch, visadapt as va
    >>> from visadapt.tasks.balance import Balance
    >>> from visadapt.tasks.balance import PAPER_CARTPOLE
    >>> task = Balance(PAPER_CARTPOLE)
    >>> state, task_state = task.training_start(3, 0.0, torch.Generator().manual_seed(0))
    >>> isinstance(task, va.Task), state.shape, task_state.shape
    (True, torch.Size([3, 4]), torch.Size([3, 0]))
    """

    def episode_steps(self, period: float) -> int:
        """Steps of an episode, with commands `period` s apart."""
        return EPISODE_STEPS

    def to(self, like: Tensor) -> Self:
        """The same task; tensors that it holds get the device and dtype of `like`."""
        return self

    def in_world(self, world: World) -> Task:
        """The same task where the physics is that of `world`, for a task that knows the physics."""
        return self

    @abstractmethod
    def training_start(self, batch: int, progress: float, generator: torch.Generator) -> tuple[Tensor, Tensor]:
        """States (batch, n_state) that streams start from in training, and their task states."""

    @abstractmethod
    def cost(self, states: Tensor, plan: Tensor, now: Tensor, task_state: Tensor) -> Tensor:
        """Cost (B,) of a plan (B, K, n_action) from the state `now` and the states (B, K, n_state) it leads to."""

    @abstractmethod
    def diverged(self, state: Tensor, task_state: Tensor, progress: float) -> Tensor:
        """(B,) whether a stream is to start anew."""

    def show(self, observed: Tensor, task_state: Tensor) -> Tensor:
        """What the policy is shown (B, ...) of what sensors observe: a task with a goal appends it."""
        return observed

    def advance(self, task_state: Tensor) -> Tensor:
        """The task states one period later."""
        return task_state

    def augment(
        self, observed: Tensor, state: Tensor, task_state: Tensor, generator: torch.Generator
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Data augmentation: recorded histories moved to other goals at which the physics is the same; here unchanged.

        Takes and returns observations (B, LENGTH, ...), the states (B, n_state) at their last row, and task states
        (B, LENGTH, ...). It is needed since a few hundred samples cover only a few goals.
        """
        return observed, state, task_state

    def disturb(self, state: Tensor, generator: torch.Generator) -> Tensor:
        """States (B, n_state) with the random changes that happen between steps in training."""
        return state


def curriculum(first: float, progress: float) -> float:
    """A share that grows from `first` to 1 over the first half of the training."""
    return first + (1 - first) * min(1.0, 2 * progress)


class FlightTask(Task):
    """A task of a rigid body, whose policy is shown its state and, after it, its goal."""

    @property
    @abstractmethod
    def period(self) -> float:
        """s between commands."""

    @property
    @abstractmethod
    def steps(self) -> int:
        """Periods in a flight that is scored."""

    @abstractmethod
    def evaluation_start(self, batch: int, generator: torch.Generator) -> tuple[Tensor, Tensor]:
        """States (batch, 13) at the start of flights that are scored, and their task states."""

    @abstractmethod
    def goal(self, task_state: Tensor) -> Tensor:
        """What a policy is shown beside its state: (B, n_goal)."""

    @abstractmethod
    def misses(self, states: Tensor, task_state: Tensor) -> Tensor:
        """Errors in m, (B, any), of flights (B, steps + 1, 13) that started at `task_state`; their mean is scored."""

    @abstractmethod
    def distance_off(self, state: Tensor, task_state: Tensor) -> Tensor:
        """Distance (B,) in m of states (B, 13) from the point, or the line, where they should be."""

    def passed(self, state: Tensor, task_state: Tensor) -> Tensor:
        """(B,) whether the task is behind states (B, 13), so that it no longer matters where the vehicle is."""
        return torch.zeros_like(state[:, 0], dtype=torch.bool)

    def episode_steps(self, period: float) -> int:
        return self.steps

    def show(self, observed: Tensor, task_state: Tensor) -> Tensor:
        return torch.cat((observed, self.goal(task_state)), 1)
