"""A disturbance observer (Chen et al. 2016) about the source policy, as in L1 adaptive control without its predictor.

    d = d + share * ((s_k - f(s_{k-1}, a_{k-1})) / (df / da) - d),    a_k = policy(history) - d

The observer explains the whole one-step error of the source f by an additional command, by least squares over the two
velocities, and smooths that estimate. It is what a control engineer would try first: it needs no sample of the target
and no learning, and it cancels what enters where the command does. The share is chosen in the source under draws of the
hidden kind of effect, so this baseline is told the kind.
"""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial
from pathlib import Path

import torch
from torch import Tensor

from benchmarks.baselines.cartpole import CartPoleProblem, source_policy
from benchmarks.baselines.problem import TUNING_SEED, Sizes, Stage, drawn, unadapted
from visadapt.evaluation import score
from visadapt.history import History
from visadapt.policies import Policy
from visadapt.targets import SyntheticTarget
from visadapt.world import World

SHARES = (0.0, 0.05, 0.1, 0.2, 0.5, 1.0)
"""of a new estimate, in a step: 0 is the source policy alone"""
LARGEST = 0.8
"""largest command against the disturbance, in [-1, 1]; the rest of the range is left for balancing the pole"""
VELOCITIES = slice(1, None, 2)


class DisturbanceObserver(Policy):
    """A policy, and a command against the disturbance that its simulator `source` sees in the last step."""

    def __init__(self, policy: Policy, source: World, share: float) -> None:
        super().__init__(policy.n_state, policy.n_action)
        self.policy = policy
        self.source = source
        self.share = share
        self.disturbance = torch.zeros(0, 1)

    @torch.no_grad()
    def act(self, history: History) -> Tensor:
        before, now, command = history.observations[:, -2], history.observations[:, -1], history.actions[:, -1]
        last = self.disturbance if len(self.disturbance) == len(now) else torch.zeros_like(command)
        foreseen, pushed = (self.source.step(self.source.start(before), a).state for a in (command, command + 0.1))
        slope, missed = ((x - foreseen)[:, VELOCITIES] for x in (pushed, now))
        unforeseen = 0.1 * (slope * missed).sum(1, keepdim=True) / slope.square().sum(1, keepdim=True)
        estimate = (last + self.share * (unforeseen - last)).clamp(-LARGEST, LARGEST)
        self.disturbance = torch.where(history.begins[:, None], 0.0, estimate)
        return (self.policy.act(history) - self.disturbance).clamp(-1, 1)


def stages(problem: CartPoleProblem, sizes: Sizes, folder: Path, seed: int) -> Iterator[Stage]:
    """The source policy with the share that loses the fewest episodes in the source, and of these is slowest."""
    policy, source = source_policy(problem, sizes, folder.parents[2], seed), problem.setup(sizes).source
    disturbed = SyntheticTarget(lambda batch, generator: (drawn(problem.kind, batch, generator),))

    def badness(share: float) -> tuple[int, float]:
        found = score(DisturbanceObserver(policy, source, share), disturbed, sizes.episodes, TUNING_SEED)
        return -found.survived, found.mean_speed or 0.0

    share = min(SHARES, key=badness)
    yield from unadapted(problem, partial(DisturbanceObserver, policy, source, share))
