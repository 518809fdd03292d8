"""Integral feedback: the source policy, and a command against the sum of what the cart has moved.

    command = policy(state) - gain * integral of x_dot

What a control engineer would try first: it needs no sample of the target and no learning. The gain is chosen in the
source under draws of the hidden kind of effect, so it is told the kind.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import torch
from torch import Tensor

from benchmarks.baselines.problem import TUNING_SEED, Problem, Sizes, Stage, drawn, source_policy
from visadapt.evaluation import score
from visadapt.history import History
from visadapt.policies import Policy
from visadapt.targets import SyntheticTarget

GAINS = (0.0, 0.01, 0.02, 0.05, 0.1, 0.2, 0.5)
"""1/m, of the command"""
LARGEST = 0.5
"""of the integral's command: it does not wind up beyond"""


class IntegralFeedback(Policy):
    """A policy with integral feedback of the cart's velocity."""

    def __init__(self, policy: Policy, gain: float, period: float) -> None:
        super().__init__(policy.n_state, policy.n_action)
        self.policy = policy
        self.gain = gain
        self.period = period
        self.command = torch.zeros(0, 1)

    def act(self, history: History) -> Tensor:
        velocity = history.observations[:, -1, 1:2]
        before = self.command if len(self.command) == len(velocity) else torch.zeros_like(velocity)
        before = torch.where(history.begins[:, None], 0.0, before)
        self.command = (before - self.gain * self.period * velocity).clamp(-LARGEST, LARGEST)
        return (self.policy.act(history) + self.command).clamp(-1, 1)


def stages(problem: Problem, sizes: Sizes, folder: Path, seed: int) -> Iterator[Stage]:
    """The source policy with the gain that loses the fewest episodes in the source, and of these is slowest."""
    policy = source_policy(problem, sizes, folder.parents[2], seed)
    period = problem.setup(sizes).source.period
    disturbed = SyntheticTarget(lambda batch, generator: (drawn(problem.kind, batch, generator),))

    def badness(gain: float) -> tuple[int, float]:
        found = score(IntegralFeedback(policy, gain, period), disturbed, sizes.episodes, TUNING_SEED)
        return -found.survived, found.mean_speed or 0.0

    gain = min(GAINS, key=badness)
    yield Stage("source", 0, IntegralFeedback(policy, gain, period))
    yield Stage("target", 0, IntegralFeedback(policy, gain, period))
