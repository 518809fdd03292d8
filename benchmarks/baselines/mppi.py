"""Model predictive path integral control (Williams et al. 2017) on the source, then with the residual of ours.

At each step, ITERATIONS times, PLANS plans are drawn about the last one, carried out in the simulator, and averaged
with weights exp(-cost / TEMPERATURE). Compared in the source, as it is and under a known force of 5 N, on ten episodes
of the tuning seed: noise 0.03, 0.06, 0.1 and 0.3, temperature 0.03 to 100, 128 to 2,048 plans, 1, 3 and 5 iterations.
The slowest cart among those that lose no episode was kept. With one iteration, as usual, 7 of 10 were lost under the
known force: an episode begins with plans of zeros, and noise that is small enough to rest with takes too long to leave
them.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import torch
from torch import Tensor

from benchmarks.baselines.cartpole import COST
from benchmarks.baselines.problem import Problem, Sizes, Stage, grounded_in_world
from visadapt.history import HORIZON, History
from visadapt.learning.plans import imagine
from visadapt.policies import Policy
from visadapt.world import World

PLANS, ITERATIONS = 512, 3
NOISE = 0.03
TEMPERATURE = 0.1


class PathIntegral(Policy):
    """Plans of `world` by weighted averages, for any number of episodes at once."""

    def __init__(self, world: World) -> None:
        super().__init__(len(world.system.states), len(world.system.actions))
        self.world = world
        self.generator = torch.Generator().manual_seed(0)
        self.last = torch.zeros(0, HORIZON, self.n_action)

    @torch.no_grad()
    def act(self, history: History) -> Tensor:
        self.last = carried(self.last, history)
        many = history.map(lambda tensor: tensor.repeat_interleave(PLANS, 0))
        now = many.observations[:, -1]
        for _ in range(ITERATIONS):
            noise = NOISE * torch.randn(len(self.last), PLANS, *self.last.shape[1:], generator=self.generator)
            plans = (self.last[:, None] + noise).clamp(-1, 1)
            states, _ = imagine(self.world, None, self.world.start(now), many, plans.flatten(0, 1))
            cost = COST(states, plans.flatten(0, 1), now).unflatten(0, (-1, PLANS))
            weight = torch.softmax(-cost.nan_to_num(1e9, 1e9) / TEMPERATURE, 1)
            self.last = (weight[..., None, None] * plans).sum(1)
        return self.last[:, 0]


def carried(last: Tensor, history: History) -> Tensor:
    """The last plans (B, K, n_action) a step on; of zeros where an episode begins."""
    width = history.actions.shape[-1]
    if len(last) != len(history.actions):
        return torch.zeros(len(history.actions), last.shape[1], width)
    onward = torch.cat((last[:, 1:], last[:, -1:]), 1)
    return torch.where(history.begins[:, None, None], 0.0, onward)


def stages(problem: Problem, sizes: Sizes, folder: Path, seed: int) -> Iterator[Stage]:
    """On the source, then with the residual."""
    yield from grounded_in_world(problem, sizes, seed, PathIntegral)
