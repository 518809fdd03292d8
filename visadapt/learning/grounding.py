"""Grounding: the residual learns what the source leaves out (equation 10).

Where the source has effects of its own, their parameters are fitted first, so that less is left to the residual. The
part of the residual's network that was trained beforehand is kept; its head is fitted to all samples so far: a linear
one by ridge regression, an MLP by gradient descent from its weights of the last round.
"""

from __future__ import annotations

import copy
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import torch
from torch import Tensor, nn

from visadapt.effects import CameraEffect, Effect, Residual, SensingEffect
from visadapt.effects.catalogue import sized
from visadapt.estimation.effect_fit import fit_effects
from visadapt.learning.transitions import Transitions
from visadapt.policies.networks import ResidualNetwork
from visadapt.progress import Progress
from visadapt.world import World

STRETCH = 10  # Samples in a row that are held out together

EMBEDDED = 256  # Histories that pass through the network at once, which bounds the memory that frames take

FOLDS = 5  # Parts of the samples that are held out in turn where a ridge is chosen


@dataclass(frozen=True)
class GroundSettings:
    """How a residual is fitted. A linear head uses `ridges`, `negligible` and, for its losses, `held_out`."""

    ridges: tuple[float, ...] = (1.0,)
    """weights, from small to large, of the squared coefficients of a linear head (times the network's `penalties`),
    where a sample's squared error has weight 1; of several, that which predicts held-out samples best"""
    negligible: float = 0.0
    """least scale of the residual, as a share of the root mean square change of a state in a period"""
    steps: int = 2000  # optimisation steps at most
    batch: int = 64
    learning_rate: float = 2e-3
    weight_decay: float = 1e-2
    held_out: float = 0.2  # share of the samples, whole stretches of time, that only choose when to stop
    every: int = 25  # steps between evaluations on the held-out samples
    patience: int = 12  # most evaluations in a row without a lower held-out loss


class GroundLoss(NamedTuple):
    """Mean squared error in units of the residual's scale: 1 is what a residual of zero would get."""

    step: int
    train: float
    held_out: float


def gap(world: World, transitions: Transitions) -> Tensor:
    """s*_{t+1} - f(s_t, a_t) (N, n_state): what the source leaves out in one step."""
    with torch.no_grad():
        return transitions.next_state - world.step(transitions.start(world), transitions.action).state


def gap_with_residual(residual: Residual, source: World, transitions: Transitions) -> Tensor:
    """(N, n_state) the part of the gap that the residual's correction does not close."""
    every = torch.arange(len(transitions))
    with torch.no_grad():
        return gap(source, transitions) - residual.delta(transitions.history(every).acting(transitions.action))


def fit_named(source: World, transitions: Transitions) -> Transitions:
    """Fit the parameters of the source's own effects to all episodes so far, in place, within their ranges.

    By maximum likelihood over whole episodes (`estimation.effect_fit`). Where the source has sensing effects, the
    transitions returned have smoothed true states in place of those recorded: the residual corrects true states, and
    streams start from them; what policies see stays as recorded. Where the phase of a periodic effect differs from
    episode to episode, the transitions returned have times at which the first episode's phase is right. Effects of the
    camera, which states do not show, keep their values.
    """
    named = [effect for effect in source.effects if isinstance(effect, Effect) and not isinstance(effect, CameraEffect)]
    if not named:
        return transitions
    measured = list(transitions.states.split(transitions.lengths))
    commands = list(transitions.actions.split(transitions.lengths))
    fit = fit_effects(source.system, named, measured, commands, source.period)
    for effect in named:
        kind = sized(type(effect), source.system)
        for parameter, value in zip(kind.table, fit.values[kind].tolist(), strict=True):
            getattr(effect, parameter.name).data.fill_(min(max(value, parameter.low), parameter.high))
    if bool(fit.shifts.any()):
        later = fit.shifts.repeat_interleave(torch.tensor(transitions.lengths))
        transitions = replace(transitions, times=transitions.times + later.to(transitions.times))
    if not any(isinstance(effect, SensingEffect) for effect in named):
        return transitions
    return replace(transitions, states=torch.cat(fit.states).to(transitions.states))


def rescale(residual: Residual, source: World, transitions: Transitions, negligible: float = 0.0) -> None:
    """Set the residual's scale, the unit of its corrections, to the root mean square of the gap in each state.

    The scale is at least `negligible` times the root mean square change of the state in a period: gaps that come from
    rounding or from the integrator must not weigh as much as real ones.
    """
    missing = gap(source, transitions).square().mean(0).sqrt()
    change = (transitions.next_state - transitions.state).square().mean(0).sqrt()
    residual.scale.copy_(torch.maximum(missing, negligible * change).clamp(min=1e-9))


def ground(
    residual: Residual,
    source: World,
    transitions: Transitions,
    settings: GroundSettings,
    generator: torch.Generator,
    progress: Progress | None = None,
    accept: Callable[[], bool] = lambda: True,
) -> list[GroundLoss]:
    """Fit the head of the residual's network, in place, to the transitions; returns losses in units of its scale.

    Transitions whose history the network says is incomplete are left out, unless all are. A linear head is fitted with
    the one of the `ridges` that predicts held-out samples best. As long as `accept` returns False, it is fitted again
    with the next larger ridge; the largest is kept without a call of `accept`.
    """
    targets = gap(source, transitions) / residual.scale
    network = residual.network
    if not isinstance(network, ResidualNetwork):
        raise TypeError(f"grounding fits the head of a ResidualNetwork, not a {type(network).__name__}")
    with torch.no_grad():
        parts = torch.arange(len(transitions)).split(EMBEDDED)
        inputs = torch.cat([network.embed(transitions.history(p).acting(transitions.action[p])) for p in parts])
    complete = network.has_full_history(inputs)
    if bool(complete.any()):
        inputs, targets = inputs[complete], targets[complete]
    train, held_out = split(len(inputs), settings.held_out, generator)
    if not isinstance(network.head, nn.Linear):
        return _descend(network.head, inputs, targets, train, held_out, settings, generator, progress)
    penalties = [ridge * network.penalties(inputs) for ridge in settings.ridges]
    for number in range(_best_penalty(inputs, targets, penalties), len(penalties)):
        losses = _solve(network.head, inputs, targets, train, held_out, penalties[number])
        if number == len(penalties) - 1 or accept():
            break
    return losses


@torch.no_grad()
def _best_penalty(inputs: Tensor, targets: Tensor, penalties: Sequence[Tensor]) -> int:
    """The index of the penalty (inputs,) with which a linear head errs least on FOLDS parts held out in turn.

    The samples are cut into stretches of STRETCH in a row, as in `split`, which go to the parts in turn. With a single
    penalty, or a single stretch, returns the last index.
    """
    stretch = torch.arange(len(inputs)) // STRETCH
    if len(penalties) == 1 or not bool(stretch.any()):
        return len(penalties) - 1
    part = stretch % FOLDS

    def error(penalty: Tensor) -> float:
        squares = inputs.new_zeros(())
        for own in part.unique():
            weight = _ridge(inputs[part != own], targets[part != own], penalty)
            squares = squares + (inputs[part == own] @ weight - targets[part == own]).square().sum()
        return float(squares)

    errors = [error(penalty) for penalty in penalties]
    return errors.index(min(errors))


@torch.no_grad()
def _solve(
    head: nn.Linear, inputs: Tensor, targets: Tensor, train: Tensor, held_out: Tensor, penalty: Tensor
) -> list[GroundLoss]:
    """Fit a linear head to all samples, with the `penalty` (inputs,) on its squared weights.

    Returns the losses of a head of zeros and of a fit to the training samples.
    """

    def loss(step: int, weight: Tensor) -> GroundLoss:
        error = (inputs @ weight - targets).square().mean(1)
        return GroundLoss(step, float(error[train].mean()), float(error[held_out].mean()))

    zeros = inputs.new_zeros(inputs.shape[1], targets.shape[1])
    losses = [loss(0, zeros), loss(1, _ridge(inputs[train], targets[train], penalty))]
    head.weight.copy_(_ridge(inputs, targets, penalty).T)
    return losses


def _ridge(inputs: Tensor, targets: Tensor, penalty: Tensor) -> Tensor:
    """W (F, n) with the least |inputs W - targets|^2 + sum_f penalty_f |W_f|^2."""
    return torch.linalg.solve(inputs.T @ inputs + penalty.diag(), inputs.T @ targets)


def _descend(
    head: nn.Module,
    inputs: Tensor,
    targets: Tensor,
    train: Tensor,
    held_out: Tensor,
    settings: GroundSettings,
    generator: torch.Generator,
    progress: Progress | None,
) -> list[GroundLoss]:
    """Fit a head by gradient descent from its present weights; it keeps those with the lowest held-out loss."""
    head.requires_grad_(True)
    optimiser = torch.optim.AdamW(head.parameters(), settings.learning_rate, weight_decay=settings.weight_decay)
    best, best_weights, waited = float("inf"), copy.deepcopy(head.state_dict()), 0
    losses: list[GroundLoss] = []
    train_sum = 0.0  # of the training losses since the last evaluation
    for step in range(settings.steps + 1):
        if step % settings.every == 0:
            with torch.no_grad():
                loss_held_out = float((head(inputs[held_out]) - targets[held_out]).square().mean())
            losses.append(GroundLoss(step, train_sum / settings.every if step else loss_held_out, loss_held_out))
            train_sum = 0.0
            if loss_held_out < best:
                best, best_weights, waited = loss_held_out, copy.deepcopy(head.state_dict()), 0
            else:
                waited += 1
            ends = waited > settings.patience or step == settings.steps
            if progress is not None:
                progress(settings.steps if ends else step, settings.steps, loss_held_out)
            if ends:
                break
        rows = train[torch.randint(len(train), (settings.batch,), generator=generator)]
        loss = (head(inputs[rows]) - targets[rows]).square().mean()
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
        train_sum += float(loss.detach())
    head.load_state_dict(best_weights)
    head.requires_grad_(False)
    return losses


def split(count: int, share: float, generator: torch.Generator) -> tuple[Tensor, Tensor]:
    """Rows to train on and rows held out: stretches of STRETCH samples, since neighbouring ones are correlated.

    Where no stretch would be left to train on, both are all rows.
    """
    stretches = torch.arange(count).split(STRETCH)
    order = torch.randperm(len(stretches), generator=generator).tolist()
    held = max(1, round(share * len(stretches)))
    if held >= len(stretches):
        return torch.arange(count), torch.arange(count)
    return torch.cat([stretches[k] for k in order[held:]]), torch.cat([stretches[k] for k in order[:held]])
