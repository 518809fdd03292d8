"""PETS (Chua et al. 2018): a probabilistic ensemble, trajectory sampling, and plans by the cross-entropy method.

Five networks predict mean and variance of the change of the state over a period. A plan's cost is the mean over one
particle for each network, which it stays with (TS-infinity). As all baselines it is pretrained in the source, here on
random short runs as many as it likes, and then fitted, from these weights, to the counted samples of the target that it
collects itself. The cart's position is no input, since nothing depends on it.

NOISE (0.01, 0.03, 0.1, 0.3), PLANS (64, 200) and ITERATIONS (3, 5) were chosen in the source, on ten episodes of the
tuning seed; three times the source's updates changed nothing. The target's updates and rate are not tuned.
"""

from __future__ import annotations

import copy
from collections.abc import Callable, Iterator
from functools import partial
from itertools import pairwise
from pathlib import Path

import torch
from torch import Tensor, nn

from benchmarks.baselines.mppi import carried
from benchmarks.baselines.problem import COST, Problem, Sizes, Stage, in_rounds
from visadapt.history import HORIZON, LENGTH, History
from visadapt.learning.transitions import Transitions
from visadapt.policies import Policy
from visadapt.world import World

MEMBERS = 5
HIDDEN = 64
PLANS, ELITES, ITERATIONS = 200, 8, 5
NOISE = 0.03
"""standard deviation of the first iteration's commands"""
KEPT = 0.1
"""of mean and deviation of the last iteration, in each (mbrl-lib's alpha)"""
SOURCE_RATE, TARGET_RATE = 1e-3, 1e-3
TARGET_UPDATES = 300
RANGES = (0.0, 1.5, 0.3, 1.5)
"""half-widths of the states that the source is sampled from"""


class Ensemble(nn.Module):
    """MEMBERS networks with two hidden layers: means and log variances of the scaled changes of a state."""

    centre: Tensor
    width: Tensor
    unit: Tensor

    def __init__(self, inputs: int, n_state: int = 4) -> None:
        super().__init__()
        widths = (inputs, HIDDEN, HIDDEN, 2 * n_state)
        pairs = list(pairwise(widths))
        self.weights = nn.ParameterList([torch.randn(MEMBERS, i, o) / (2 * i**0.5) for i, o in pairs])
        self.biases = nn.ParameterList([torch.zeros(MEMBERS, 1, o) for _, o in pairs])
        self.low, self.high = nn.Parameter(-10 * torch.ones(n_state)), nn.Parameter(0.5 * torch.ones(n_state))
        self.register_buffer("centre", torch.zeros(inputs))
        self.register_buffer("width", torch.ones(inputs))
        self.register_buffer("unit", torch.ones(n_state))

    def forward(self, inputs: Tensor) -> tuple[Tensor, Tensor]:
        """(MEMBERS, B, n_state) means and log variances, of inputs (MEMBERS, B, inputs)."""
        out = (inputs - self.centre) / self.width
        for weight, bias in zip(self.weights, self.biases, strict=True):
            last = weight is self.weights[-1]
            out = torch.baddbmm(bias, out, weight)
            out = out if last else nn.functional.silu(out)
        mean, log_variance = out.chunk(2, -1)
        log_variance = self.high - nn.functional.softplus(self.high - log_variance)
        return mean, self.low + nn.functional.softplus(log_variance - self.low)

    def fit(self, inputs: Tensor, changes: Tensor, updates: int, rate: float, generator: torch.Generator) -> None:
        """Gaussian likelihood by Adam; each member on its own draw of the samples (N, ...) with replacement."""
        rows = torch.randint(len(inputs), (MEMBERS, len(inputs)), generator=generator)
        optimiser = torch.optim.Adam(self.parameters(), rate, weight_decay=1e-5)
        for _ in range(updates):
            batch = rows.gather(1, torch.randint(len(inputs), (MEMBERS, 128), generator=generator))
            mean, log_variance = self(inputs[batch])
            error = (mean - changes[batch] / self.unit).square() * (-log_variance).exp() + log_variance
            loss = error.mean() + 0.01 * (self.high - self.low).mean()
            optimiser.zero_grad()
            loss.backward()
            optimiser.step()


class EnsemblePlanner(Policy):
    """Plans through an ensemble, for any number of episodes at once."""

    def __init__(self, ensemble: Ensemble, with_history: bool) -> None:
        super().__init__(4, 1)
        self.ensemble = ensemble
        self.with_history = with_history
        self.generator = torch.Generator().manual_seed(0)
        self.last = torch.zeros(0, HORIZON, 1)

    @torch.no_grad()
    def act(self, history: History) -> Tensor:
        mean = carried(self.last, history)
        spread = torch.full_like(mean, NOISE)
        for _ in range(ITERATIONS):
            noise = torch.randn(len(mean), PLANS, *mean.shape[1:], generator=self.generator)
            plans = (mean[:, None] + spread[:, None] * noise).clamp(-1, 1)
            best = self.costs(history, plans).topk(ELITES, largest=False).indices
            elite = plans.gather(1, best[..., None, None].expand(-1, -1, *plans.shape[2:]))
            mean, spread = KEPT * mean + (1 - KEPT) * elite.mean(1), KEPT * spread + (1 - KEPT) * elite.std(1)
        self.last = mean
        return mean[:, 0]

    def costs(self, history: History, plans: Tensor) -> Tensor:
        """(B, PLANS) mean costs over the particles of plans (B, PLANS, K, 1)."""
        many = history.map(lambda tensor: tensor.repeat_interleave(PLANS, 0).repeat(MEMBERS, *[1] * (tensor.dim() - 1)))
        commands = plans.flatten(0, 1).repeat(MEMBERS, 1, 1)
        now, states = many.observations[:, -1], []
        for k in range(HORIZON):
            many = many.acting(commands[:, k])
            mean, log_variance = self.ensemble(model_inputs(many, self.with_history).unflatten(0, (MEMBERS, -1)))
            change = mean + (log_variance / 2).exp() * torch.randn(mean.shape, generator=self.generator)
            states.append(many.observations[:, -1] + (change * self.ensemble.unit).flatten(0, 1))
            many = many.observing(states[-1])
        cost = COST(torch.stack(states, 1), commands, now)
        return cost.nan_to_num(1e9, 1e9).unflatten(0, (MEMBERS, -1, PLANS)).mean(0)


def model_inputs(history: History, with_history: bool) -> Tensor:
    """What the ensemble sees (B, inputs): states but for the position, and commands; all of them, or the last."""
    count = LENGTH if with_history else 1
    return torch.cat((history.observations[:, -count:, 1:].flatten(1), history.actions[:, -count:].flatten(1)), 1)


def source_ensemble(world: World, with_history: bool, updates: int, seed: int) -> Ensemble:
    """An ensemble of the source, on short runs from random states under random commands."""
    torch.manual_seed(seed)
    generator = torch.Generator().manual_seed(seed)
    state = torch.tensor(RANGES) * (2 * torch.rand(4000, 4, generator=generator) - 1)
    at, history = world.start(state), History.start(state, 1)
    inputs, changes = [], []
    with torch.no_grad():
        for k in range(2 * LENGTH):
            command = torch.rand(len(state), 1, generator=generator) ** 2
            command = command * torch.randn(len(state), 1, generator=generator).sign()
            at = world.step(at, command)
            history = history.acting(command)
            if k >= LENGTH or not with_history:
                inputs.append(model_inputs(history, with_history))
                changes.append(at.state - history.observations[:, -1])
            history = history.observing(at.state)
    seen, change = torch.cat(inputs), torch.cat(changes)
    ensemble = Ensemble(seen.shape[1])
    ensemble.centre.copy_(seen.mean(0))
    ensemble.width.copy_(seen.std(0))
    ensemble.unit.copy_(change.std(0))
    for rate in (SOURCE_RATE, SOURCE_RATE / 10):
        ensemble.fit(seen, change, updates // 2, rate, generator)
    return ensemble


def stages(problem: Problem, sizes: Sizes, folder: Path, seed: int) -> Iterator[Stage]:
    """The ensemble of the source, then fitted to all samples of the target so far, round after round."""
    world, with_history = problem.setup(sizes).source, problem.with_history
    source = source_ensemble(world, with_history, sizes.updates, seed)
    unfitted = partial(EnsemblePlanner, source, with_history)
    yield Stage("source", 0, unfitted())
    yield Stage("target", 0, unfitted())

    def learn(transitions: Transitions, generator: torch.Generator) -> Callable[[], Policy]:
        history = transitions.history(torch.arange(len(transitions))).acting(transitions.action)
        ensemble = copy.deepcopy(source)
        seen = model_inputs(history, with_history)
        ensemble.fit(seen, transitions.next_state - transitions.state, TARGET_UPDATES, TARGET_RATE, generator)
        return partial(EnsemblePlanner, ensemble, with_history)

    yield from in_rounds(problem, sizes, seed, lambda: (unfitted, learn))
