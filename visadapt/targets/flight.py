"""Synthetic vehicles: a world whose effects the learner does not see, flown over courses."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from visadapt.systems import RigidBody
from visadapt.targets.base import Observation, Target, TargetError
from visadapt.targets.synthetic import DrawEffects, no_effects
from visadapt.tasks.courses import Course
from visadapt.world import World, WorldState


class FlightTarget(Target):
    """A vehicle with hidden effects, integrated by another method and more finely (1 ms) than any source.

    A flight ends with its course, or where its state is no longer finite; however far it strays, it goes on, unless it
    is given a reach.

    Args:
        course: where flights start and what a policy is told.
        system: its physics.
        period: s between actions.
        draw_effects: draws the hidden effects of a batch of flights.
        reach: m off its course beyond which a flight ends.
    """

    def __init__(
        self,
        course: Course,
        system: RigidBody,
        period: float,
        draw_effects: DrawEffects = no_effects,
        name: str = "synthetic vehicle",
        reach: float = math.inf,
    ) -> None:
        self.course = course
        self.system = system
        self.period = period
        self.draw_effects = draw_effects
        self.name = name
        self.reach = reach
        self.n_action = len(system.actions)
        self.first: Tensor
        """places at which the flights started"""
        self._place: Tensor
        self._at: WorldState
        self._world: World | None = None
        self._generator: torch.Generator | None = None

    def reset(self, batch: int, generator: torch.Generator) -> Observation:
        state, self.first = self.course.start(batch, generator)
        effects = self.draw_effects(batch, generator)
        substeps = round(self.period / 0.001)
        self._generator = generator
        self._world = World(self.system, effects, self.period, "midpoint", substeps).requires_grad_(False)
        self._at, self._place = self._world.start(state), self.first
        return self._observe(self._world)

    def step(self, action: Tensor) -> Observation:
        if self._world is None:
            raise TargetError(f"{self.name}: step before reset")
        with torch.no_grad():
            self._at = self._world.step(self._at, action)
        self._place = self.course.advance(self._place)
        return self._observe(self._world)

    def _observe(self, world: World) -> Observation:
        measured, self._at = world.measure(self._at, self._generator)
        state = self._at.state
        return Observation(
            measured,
            alive=state.isfinite().all(1) & (self.course.off(state, self._place) <= self.reach),
            force=world.load(self._at)[:, :3],
            goal=self.course.goal(self._place),
            place=self._place,
        )
