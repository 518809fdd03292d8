"""Model predictive control in image space: plans whose rendered frames come nearest to that of a cart-pole at rest.

The paper reports that online optimization in the image space "either does not converge or returns poor solutions" (its
Table 2). Here at each step STEPS of Adam lower, by gradients through renderer, residual and physics,

    |Psi(s_1..s_K) - Psi(rest)|^2 / pixels + ACTION |a|^2

over HORIZON commands, from the last plan; s_0 is what the frames show (`frames.Seeing`). Two settings were tried in the
source, on eight episodes of the tuning seed: 15 STEPS at a RATE of 0.1, and 30 at 0.03. With either all fall within 34
periods; ACTION was not tuned.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import torch
from torch import Tensor

from benchmarks.baselines.frames import renderer
from benchmarks.baselines.mppi import carried
from benchmarks.baselines.problem import Problem, Sizes, Stage, grounded_in_world
from visadapt.history import HORIZON, History
from visadapt.learning.plans import imagine
from visadapt.policies import Policy
from visadapt.world import World

STEPS, RATE, ACTION = 15, 0.1, 1e-3


class PixelPredictive(Policy):
    """Plans of `world` by what they look like, for any number of episodes at once."""

    def __init__(self, world: World) -> None:
        super().__init__(len(world.system.states), len(world.system.actions))
        self.world = world
        self.rest = renderer()(torch.zeros(1), torch.zeros(1))
        self.last = torch.zeros(0, HORIZON, self.n_action)

    def act(self, history: History) -> Tensor:
        self.last = carried(self.last, history)
        with torch.enable_grad():
            plans = self.last.clone().requires_grad_()
            optimiser = torch.optim.Adam([plans], RATE)
            for _ in range(STEPS):
                optimiser.zero_grad()
                self.cost(history, plans).sum().backward()
                optimiser.step()
                plans.data.clamp_(-1, 1)
        self.last = plans.detach()
        return self.last[:, 0]

    def cost(self, history: History, plans: Tensor) -> Tensor:
        """(B,) of plans (B, HORIZON, n_action)."""
        states, _ = imagine(self.world, None, self.world.start(history.observations[:, -1]), history, plans)
        frames = renderer()(states[..., 0].flatten(), states[..., 2].flatten())
        away = (frames - self.rest).square().mean((1, 2)).unflatten(0, (-1, HORIZON))
        return away.sum(1) + ACTION * plans.square().sum((1, 2))


def stages(problem: Problem, sizes: Sizes, folder: Path, seed: int) -> Iterator[Stage]:
    """On the source, then with the residual."""
    yield from grounded_in_world(problem, sizes, seed, PixelPredictive)
