"""Synthetic vehicles: a world whose effects the learner does not see, flown in a task."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from visadapt.systems import RigidBody
from visadapt.targets.base import Observation, Target, TargetError
from visadapt.targets.synthetic import DrawEffects, no_effects
from visadapt.tasks.base import FlightTask
from visadapt.world import World, WorldState


class FlightTarget(Target):
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

    def __init__(
        self,
        task: FlightTask,
        system: RigidBody,
        draw_effects: DrawEffects = no_effects,
        name: str = "synthetic vehicle",
        reach: float = math.inf,
    ) -> None:
        self.task = task
        self.system = system
        self.period = task.period
        self.draw_effects = draw_effects
        self.name = name
        self.reach = reach
        self.n_action = len(system.actions)
        self.first: Tensor
        """task states in which the flights started"""
        self._task_state: Tensor
        self._at: WorldState
        self._world: World | None = None
        self._generator: torch.Generator | None = None

    def reset(self, batch: int, generator: torch.Generator) -> Observation:
        state, self.first = self.task.evaluation_start(batch, generator)
        effects = self.draw_effects(batch, generator)
        substeps = round(self.period / 0.001)
        self._generator = generator
        self._world = World(self.system, effects, self.period, "midpoint", substeps).requires_grad_(False)
        self._at, self._task_state = self._world.start(state), self.first
        return self._observe(self._world)

    def step(self, action: Tensor) -> Observation:
        if self._world is None:
            raise TargetError(f"{self.name}: step before reset")
        with torch.no_grad():
            self._at = self._world.step(self._at, action)
        self._task_state = self.task.advance(self._task_state)
        return self._observe(self._world)

    def _observe(self, world: World) -> Observation:
        measured, self._at = world.measure(self._at, self._generator)
        state = self._at.state
        return Observation(
            measured,
            alive=state.isfinite().all(1) & (self.task.distance_off(state, self._task_state) <= self.reach),
            force=world.load(self._at)[:, :3],
            goal=self.task.goal(self._task_state),
            task_state=self._task_state,
        )
