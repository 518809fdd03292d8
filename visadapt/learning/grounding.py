"""Grounding: the residual learns what the source leaves out (equation 10).

Where the source has effects of its own, their parameters are fitted first: an effect with a name leaves less to learn.
What the residual's network has learnt to see beforehand stays as it is; its head is fitted to all samples so far: a
linear one by ridge regression, an MLP by descent from where the last round left it.
"""

from __future__ import annotations

import copy
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor, nn

from visadapt.effects import Effect, Parameter, Residual
from visadapt.learning.windows import Windows
from visadapt.policies.networks import ResidualNetwork
from visadapt.progress import Progress
from visadapt.world import World

NAMED_STEPS = 8
NUDGE = 1e-3
"""Iterations of the fit of named effects, and its finite difference as a share of a parameter's range."""


@dataclass(frozen=True)
class GroundSettings:
    """How a residual is fitted; all but the first two are for heads fitted by descent."""

    ridge: float = 10.0
    """weight of the squared coefficients of a linear head, in samples"""
    negligible: float = 0.0
    """share of a state's change in a period below which a gap is not heard as loudly as others"""
    steps: int = 2000
    """optimisation steps at most"""
    batch: int = 64
    learning_rate: float = 2e-3
    weight_decay: float = 1e-2
    held_out: float = 0.2
    """share of the samples, whole stretches of time, that only choose when to stop"""
    every: int = 25
    """steps between looks at the held-out samples"""
    patience: int = 12
    """looks without a better held-out loss before stopping"""


@dataclass(frozen=True)
class GroundLoss:
    """Mean squared error in units of the residual's scale: 1 is what a residual of zero would get."""

    step: int
    train: float
    held_out: float


def gap(world: World, windows: Windows) -> Tensor:
    """s*_{t+1} - f(s_t, a_t) (N, n_state): what the source leaves out in one step."""
    with torch.no_grad():
        return windows.next_state - world.step(windows.start(world), windows.action).state


def left_over(residual: Residual, source: World, windows: Windows) -> Tensor:
    """What the residual leaves of the gap (N, n_state)."""
    every = torch.arange(len(windows))
    with torch.no_grad():
        return gap(source, windows) - residual.delta(windows.history(every).acting(windows.action))


def fit_named(source: World, windows: Windows) -> None:
    """Fit the parameters of the source's own effects to all windows so far, in place: least squares of one step.

    Errors count in units of what the source leaves out without them, state by state; parameters stay within the ranges
    that their effects state.
    """
    named = [effect for effect in source.effects if isinstance(effect, Effect)]
    parameters = [(effect, each) for effect in named for each in effect.table]
    if not parameters:
        return
    bare = World(source.system, (), source.period, source.integrator, source.substeps)
    unit = gap(bare, windows).square().mean(0).sqrt().clamp(min=1e-9)
    values = [getattr(effect, each.name) for effect, each in parameters]
    # The problem is small and nearly linear: full steps of Gauss and Newton's method, from wherever it stands.
    for _ in range(NAMED_STEPS):
        left, slopes = _one_step_errors(source, windows, parameters, unit)
        step = torch.linalg.lstsq(slopes, -left[:, None]).solution[:, 0]
        with torch.no_grad():
            for value, change, (_, each) in zip(values, step, parameters, strict=True):
                value.copy_((value + change * (each.high - each.low)).clamp(each.low, each.high))


def _one_step_errors(
    source: World, windows: Windows, parameters: Sequence[tuple[Effect, Parameter]], unit: Tensor
) -> tuple[Tensor, Tensor]:
    """Errors (N n_state,), and how they change with each parameter as a share of its range, (N n_state, P)."""
    left = -(gap(source, windows) / unit).flatten()
    slopes = []
    for effect, each in parameters:
        value, span = getattr(effect, each.name), each.high - each.low
        with torch.no_grad():
            kept = value.clone()
            # Inwards, so that no parameter leaves its range.
            nudge = -NUDGE if float(kept) + NUDGE * span > each.high else NUDGE
            value.add_(nudge * span)
            moved = -(gap(source, windows) / unit).flatten()
            value.copy_(kept)
        slopes.append((moved - left) / nudge)
    return left, torch.stack(slopes, 1)


def rescale(residual: Residual, source: World, windows: Windows, negligible: float = 0.0) -> None:
    """Make the root mean square of the gap, state by state, the unit of the residual's corrections.

    A gap that is less than the share `negligible` of what a state changes by in a period, that of integrators and
    rounding say, has that share for its unit: in units of its own it would be heard as loudly as the others.
    """
    missing = gap(source, windows).square().mean(0).sqrt()
    change = (windows.next_state - windows.state).square().mean(0).sqrt()
    residual.scale.copy_(torch.maximum(missing, negligible * change).clamp(min=1e-9))


def ground(
    residual: Residual,
    source: World,
    windows: Windows,
    settings: GroundSettings,
    generator: torch.Generator,
    progress: Progress | None = None,
) -> list[GroundLoss]:
    """Fit the network of `residual` to all windows so far, in place, in units of its scale."""
    target = gap(source, windows) / residual.scale
    network = residual.network
    if not isinstance(network, ResidualNetwork):
        raise TypeError(f"grounding fits the head of a ResidualNetwork, not a {type(network).__name__}")
    seen = _embed(network, windows)
    informed = network.informed(seen)
    if bool(informed.any()):
        seen, target = seen[informed], target[informed]
    train, held_out = split(len(seen), settings.held_out, generator)
    if isinstance(network.head, nn.Linear):
        return _solve(network.head, seen, target, train, held_out, settings)
    return _descend(network.head, seen, target, train, held_out, settings, generator, progress)


@torch.no_grad()
def _solve(
    head: nn.Linear, seen: Tensor, target: Tensor, train: Tensor, held_out: Tensor, settings: GroundSettings
) -> list[GroundLoss]:
    """Fit a linear head to all samples. The losses are those before, and of a fit to the training samples alone."""
    losses = []
    everything = torch.arange(len(seen))
    for step, rows in enumerate((everything[:0], train, everything)):
        inputs = seen[rows]
        penalty = settings.ridge * torch.eye(seen.shape[1]).to(seen)
        head.weight.copy_(torch.linalg.solve(inputs.T @ inputs + penalty, inputs.T @ target[rows]).T)
        error = (head(seen) - target).square().mean(1)
        losses.append(GroundLoss(step, float(error[train].mean()), float(error[held_out].mean())))
    return losses[:2]


def _descend(
    head: nn.Module,
    seen: Tensor,
    target: Tensor,
    train: Tensor,
    held_out: Tensor,
    settings: GroundSettings,
    generator: torch.Generator,
    progress: Progress | None,
) -> list[GroundLoss]:
    """Fit a head to the training samples, from what it is, keeping the weights that did best on the held-out ones."""
    head.requires_grad_(True)
    optimiser = torch.optim.AdamW(head.parameters(), settings.learning_rate, weight_decay=settings.weight_decay)
    best, best_weights, waited = float("inf"), copy.deepcopy(head.state_dict()), 0
    losses: list[GroundLoss] = []
    running = 0.0
    for step in range(settings.steps + 1):
        if step % settings.every == 0:
            with torch.no_grad():
                score = float((head(seen[held_out]) - target[held_out]).square().mean())
            losses.append(GroundLoss(step, running / settings.every if step else score, score))
            running = 0.0
            if progress is not None:
                progress(step, settings.steps, score)
            if score < best:
                best, best_weights, waited = score, copy.deepcopy(head.state_dict()), 0
            else:
                waited += 1
            if waited > settings.patience and progress is not None:
                progress(settings.steps, settings.steps, best)
            if waited > settings.patience or step == settings.steps:
                break
        rows = train[torch.randint(len(train), (settings.batch,), generator=generator)]
        loss = (head(seen[rows]) - target[rows]).square().mean()
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
        running += float(loss.detach())
    head.load_state_dict(best_weights)
    head.requires_grad_(False)
    return losses


@torch.no_grad()
def _embed(network: ResidualNetwork, windows: Windows) -> Tensor:
    """What the head reads in every window, (N, ...)."""
    parts = torch.arange(len(windows)).split(256)
    return torch.cat([network.embed(windows.history(p).acting(windows.action[p])) for p in parts])


def split(count: int, share: float, generator: torch.Generator) -> tuple[Tensor, Tensor]:
    """Rows to train on and rows held out: stretches of 10 samples, since neighbours know each other."""
    stretches = torch.arange(count).split(10)
    order = torch.randperm(len(stretches), generator=generator)
    held = max(1, round(share * len(stretches)))
    if held >= len(stretches):
        every = torch.arange(count)
        return every, every
    return (
        torch.cat([stretches[int(k)] for k in order[held:]]),
        torch.cat([stretches[int(k)] for k in order[:held]]),
    )
