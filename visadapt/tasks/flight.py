"""What all tasks of flying share: a goal, a start for flights that are scored, and how far a flight is off."""

from __future__ import annotations

from abc import abstractmethod

import torch
from torch import Tensor

from visadapt.tasks.base import Task


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

    def show(self, observed: Tensor, task_state: Tensor) -> Tensor:
        return torch.cat((observed, self.goal(task_state)), 1)
