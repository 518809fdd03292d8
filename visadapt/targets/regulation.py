"""A synthetic target of a system of one's own, that is to come to rest at a goal."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import torch

from visadapt.targets.base import Observation
from visadapt.targets.synthetic import DrawEffects, WorldTarget, no_effects
from visadapt.tasks.regulate import Regulate


class RegulationTarget(WorldTarget):
    """A system with hidden effects, integrated more finely and by another method than any source.

    An episode ends when a state is beyond the limits of its task.

    Args:
        task: where episodes start and end; its system is the physics.
        period: s between actions.
        draw_effects: draws the hidden effects of a batch of episodes.
        noise: standard deviations of white noise on what is measured, by the names of the states and in their units; 0
            for those that are not named.

    Raises:
        KeyError: noise on a state that the system does not have.

    >>> import torch, visadapt as va
    >>> task = va.Regulate(va.CartPole(), tolerance={"x": 0.5, "theta": 0.05}, limits={"theta": 0.3})
    >>> target = va.RegulationTarget(task, 0.05, va.constant_force(2.0))
    >>> target.reset(2, torch.Generator().manual_seed(0)).state.shape
    torch.Size([2, 4])
    """

    def __init__(
        self,
        task: Regulate,
        period: float,
        draw_effects: DrawEffects = no_effects,
        noise: Mapping[str, float] | None = None,
    ) -> None:
        super().__init__(task.system, period, draw_effects)
        self.name = f"synthetic {task.system.name}"
        self.task = task
        self.noise = torch.zeros(len(task.system.states))
        for state, deviation in (noise or {}).items():
            self.noise[task.system.index(state)] = deviation

    def reset(self, batch: int, generator: torch.Generator) -> Observation:
        effects = self.draw_effects(batch, generator)
        return self._start(self.task.first_state(batch, generator), effects, generator)

    def _observe(self) -> Observation:
        seen = super()._observe()
        measured = seen.state + self.noise * torch.randn(seen.state.shape, generator=self._generator)
        return replace(seen, state=measured, alive=seen.alive & self.task.within_limits(self._at.state), force=None)
