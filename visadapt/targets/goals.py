"""A vehicle that knows nothing of a task, such as one in a gymnasium environment, with the goals of one."""

from __future__ import annotations

from dataclasses import replace

import torch

from visadapt.systems.rigid_body import POSITION
from visadapt.targets.base import Observation, Target, TargetError, TaskTarget
from visadapt.targets.rollout import checked_copy
from visadapt.tasks.base import FlightTask

LARGEST_START_ERROR = 1.0  # m from where the task's flights start to where one starts


class GoalTarget(TaskTarget):
    """A target that shows no goal, with the goals of a task; where its flights start is its own.

    Raises:
        TargetError: `reset` starts more than LARGEST_START_ERROR from where the task's flights start, or shows another
            number of states than the task's vehicle has.
    """

    start: str
    """where the task's flights start, in words"""
    right: str
    """what is right of a target that starts elsewhere"""

    def __init__(self, target: Target, task: FlightTask) -> None:
        self.target, self.task = target, task
        self.name, self.period, self.n_action, self.system = target.name, target.period, target.n_action, target.system

    def reset(self, batch: int, generator: torch.Generator) -> Observation:
        state, self.first = self.task.evaluation_start(batch, generator)
        self._task_state = self.first
        seen = checked_copy(self.target, self.target.reset(batch, generator), batch)
        if (shown := seen.state.shape[1]) != state.shape[1]:
            raise TargetError(f"{self.name}: shows {shown} states; the {state.shape[1]} of its vehicle are right")
        off = float((seen.state[:, POSITION] - state[:, POSITION].to(seen.state)).norm(dim=1).max())
        if off > LARGEST_START_ERROR:
            raise TargetError(f"{self.name}: starts {off:.3g} m from {self.start}; {self.right}")
        return self._with_goal(seen)

    def step(self, action: torch.Tensor) -> Observation:
        self._task_state = self.task.advance(self._task_state)
        return self._with_goal(checked_copy(self.target, self.target.step(action), len(action)))

    def _with_goal(self, seen: Observation) -> Observation:
        return replace(seen, goal=self.task.goal(self._task_state).to(seen.state), task_state=self._task_state)
