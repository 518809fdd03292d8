"""PETS (Chua et al. 2018): a probabilistic ensemble, trajectory sampling, and plans by the cross-entropy method.

Five networks predict mean and variance of the change of the state over a period. A plan's cost is the mean over one
particle for each network, which it stays with (TS-infinity). As all baselines it is pretrained in the source, here on
random short runs as many as it likes, and then fitted, from these weights, to the counted samples of the target that it
collects itself.

The noise of the first iteration (`Subject.noise`: of 0.01, 0.03, 0.1 and 0.3; on vehicles of the last two), PLANS (64,
200) and ITERATIONS (3, 5) were chosen in the source, with the tuning seed; three times the source's updates changed
nothing. The target's updates and rate are not tuned.
"""

from __future__ import annotations

import copy
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path

import torch
from torch import Tensor

from benchmarks.baselines.ensemble import MEMBERS, Ensemble, source_ensemble
from benchmarks.baselines.mppi import carried
from benchmarks.baselines.problem import Problem, Sizes, Stage, in_rounds, unadapted
from benchmarks.baselines.subjects import Subject, subject_of
from visadapt.history import HORIZON, History
from visadapt.learning.transitions import Transitions
from visadapt.policies import Policy

PLANS, ELITES, ITERATIONS = 200, 8, 5
KEPT = 0.1
"""weight of the last iteration's mean and standard deviation in those of the next (mbrl-lib's alpha)"""
TARGET_RATE = 1e-3
TARGET_UPDATES = 300


class EnsemblePlanner(Policy):
    """Plans through an ensemble, for any number of episodes at once."""

    def __init__(self, ensemble: Ensemble, subject: Subject, n_action: int) -> None:
        super().__init__(len(ensemble.unit), n_action)
        self.shown = subject.show
        self.ensemble = ensemble
        self.subject = subject
        self.generator = torch.Generator().manual_seed(0)
        self.last = torch.zeros(0, HORIZON, n_action)

    @torch.no_grad()
    def act(self, history: History) -> Tensor:
        goal = history.observations[:, -1, self.n_state :]
        history = History(history.observations[..., : self.n_state], history.actions)
        mean = carried(self.last, history)
        spread = torch.full_like(mean, self.subject.noise)
        for _ in range(ITERATIONS):
            noise = torch.randn(len(mean), PLANS, *mean.shape[1:], generator=self.generator)
            plans = (mean[:, None] + spread[:, None] * noise).clamp(-1, 1)
            best = self.costs(history, goal, plans).topk(ELITES, largest=False).indices
            elite = plans.gather(1, best[..., None, None].expand(-1, -1, *plans.shape[2:]))
            mean, spread = KEPT * mean + (1 - KEPT) * elite.mean(1), KEPT * spread + (1 - KEPT) * elite.std(1)
        self.last = mean
        return mean[:, 0]

    def costs(self, history: History, goal: Tensor, plans: Tensor) -> Tensor:
        """(B, PLANS) mean costs over the particles of plans (B, PLANS, K, n_action)."""

        def particles(tensor: Tensor) -> Tensor:
            return tensor.repeat_interleave(PLANS, 0).repeat(MEMBERS, *[1] * (tensor.dim() - 1))

        many = history.map(particles)
        commands = plans.flatten(0, 1).repeat(MEMBERS, 1, 1)
        now, states = many.observations[:, -1], []
        for k in range(HORIZON):
            many = many.acting(commands[:, k])
            mean, log_variance = self.ensemble(self.subject.inputs(many).unflatten(0, (MEMBERS, -1)))
            change = mean + (log_variance / 2).exp() * torch.randn(mean.shape, generator=self.generator)
            states.append(many.observations[:, -1] + (change * self.ensemble.unit).flatten(0, 1))
            many = many.observing(states[-1])
        cost = self.subject.cost(torch.stack(states, 1), commands, now, particles(goal))
        return cost.nan_to_num(1e9, 1e9).unflatten(0, (MEMBERS, -1, PLANS)).mean(0)


def stages(problem: Problem, sizes: Sizes, folder: Path, seed: int) -> Iterator[Stage]:
    """The ensemble of the source, then fitted to all samples of the target so far, round after round."""
    world, subject = problem.setup(sizes).source, subject_of(problem, sizes)
    source = source_ensemble(world, subject, sizes.updates, seed)

    def planner(ensemble: Ensemble) -> Policy:
        return EnsemblePlanner(ensemble, subject, len(world.system.actions))

    unfitted = partial(planner, source)
    yield from unadapted(problem, unfitted)

    def learn(transitions: Transitions, generator: torch.Generator) -> Callable[[], Policy]:
        history = transitions.history(torch.arange(len(transitions))).acting(transitions.action)
        states = History(history.observations[..., : len(source.unit)], history.actions)
        ensemble = copy.deepcopy(source)
        changes = transitions.next_state - transitions.state
        ensemble.fit(subject.inputs(states), changes, TARGET_UPDATES, TARGET_RATE, generator)
        return partial(planner, ensemble)

    yield from in_rounds(problem, sizes, seed, lambda: (unfitted, learn))
