"""Synthetic vehicles: a world whose effects the learner does not see, flown in a task."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from visadapt.systems import RigidBody
from visadapt.targets.base import Observation
from visadapt.targets.synthetic import DrawEffects, WorldTarget, no_effects
from visadapt.tasks.flight import FlightTask


class FlightTarget(WorldTarget):
    """A vehicle with hidden effects, integrated by another method and more finely (1 ms) than any source.

    A flight ends after the task's steps, or where its state is no longer finite; how far off it is does not end it,
    unless `reach` says so.

    Args:
        task: where flights start and what a policy is shown.
        system: its physics.
        draw_effects: draws the hidden effects of a batch of flights.
        reach: m off its task's line beyond which a flight ends.

    >>> import torch, visadapt as va
    >>> from visadapt.tasks.reach import Reach
    >>> target = va.FlightTarget(Reach(), va.FixedWing())
    >>> seen = target.reset(2, torch.Generator().manual_seed(0))
    >>> seen.state.shape, seen.goal.shape, target.period
    (torch.Size([2, 13]), torch.Size([2, 3]), 0.05)
    """

    name = "synthetic vehicle"

    def __init__(
        self, task: FlightTask, system: RigidBody, draw_effects: DrawEffects = no_effects, reach: float = math.inf
    ) -> None:
        super().__init__(system, task.period, draw_effects)
        self.task = task
        self.system: RigidBody = system
        self.reach = reach
        self.first: Tensor
        """task states in which the flights started"""
        self._task_state: Tensor

    def reset(self, batch: int, generator: torch.Generator) -> Observation:
        state, self.first = self.task.evaluation_start(batch, generator)
        self._task_state = self.first
        return self._start(state, self.draw_effects(batch, generator), generator)

    def step(self, action: Tensor) -> Observation:
        if self._world is not None:
            self._task_state = self.task.advance(self._task_state)
        return super().step(action)

    def _observe(self) -> Observation:
        seen = super()._observe()
        assert seen.force is not None
        near = self.task.distance_off(self._at.state, self._task_state) <= self.reach
        goal = self.task.goal(self._task_state)
        return Observation(seen.state, seen.alive & near, None, seen.force[:, :3], goal, self._task_state)
