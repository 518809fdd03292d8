"""The probabilistic ensemble of PETS, of the changes of a state over a period."""

from __future__ import annotations

from functools import reduce
from itertools import pairwise

import torch
from torch import Tensor, nn

from benchmarks.baselines.subjects import Subject
from visadapt.history import LENGTH, History
from visadapt.world import World

MEMBERS = 5
HIDDEN = 64
SOURCE_RATE = 1e-3


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


def source_runs(world: World, subject: Subject, generator: torch.Generator) -> tuple[History, Tensor]:
    """Short runs of the source from random states under random commands: N histories that end with the command which is
    then executed, and the states (N, n_state) that follow."""
    state = subject.draw(4000, generator)
    at, history = world.start(state), History.start(state, len(world.system.actions))
    before, after = [], []
    with torch.no_grad():
        for k in range(2 * LENGTH):
            command = torch.rand(history.actions[:, 0].shape, generator=generator) ** 2
            command = command * torch.randn(command.shape, generator=generator).sign()
            at = world.step(at, command)
            history = history.acting(command)
            if k >= LENGTH or not subject.with_history:
                before.append(history)
                after.append(at.state)
            history = history.observing(at.state)
    return reduce(History.joined, before), torch.cat(after)


def source_ensemble(world: World, subject: Subject, updates: int, seed: int) -> Ensemble:
    """An ensemble of the source, fitted to `source_runs`."""
    torch.manual_seed(seed)
    generator = torch.Generator().manual_seed(seed)
    history, after = source_runs(world, subject, generator)
    seen, change = subject.inputs(history), after - history.observations[:, -1]
    ensemble = Ensemble(seen.shape[1], change.shape[1])
    ensemble.centre.copy_(seen.mean(0))
    ensemble.width.copy_(seen.std(0))
    ensemble.unit.copy_(change.std(0))
    for rate in (SOURCE_RATE, SOURCE_RATE / 10):
        ensemble.fit(seen, change, updates // 2, rate, generator)
    return ensemble
