"""Grounding: the residual learns what the source leaves out (equation 10)."""

from __future__ import annotations

import copy
from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from visadapt.effects import Residual
from visadapt.learning.windows import Windows
from visadapt.world import World

Progress = Callable[[int, int, float], None]
"""Called with (steps done, steps at most, held-out loss)."""


@dataclass(frozen=True)
class GroundSettings:
    """How a residual is fitted."""

    steps: int = 600
    """optimisation steps at most"""
    batch: int = 64
    learning_rate: float = 1e-3
    weight_decay: float = 1e-2
    held_out: float = 0.2
    """share of the samples, whole stretches of time, that only choose when to stop"""
    every: int = 25
    """steps between looks at the held-out samples"""
    patience: int = 8
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
        return windows.next_state - world.step(world.start(windows.state), windows.action).state


def ground(
    residual: Residual,
    source: World,
    windows: Windows,
    settings: GroundSettings,
    generator: torch.Generator,
    progress: Progress | None = None,
) -> list[GroundLoss]:
    """Fit `residual` to all windows so far, in place, keeping the weights that did best on held-out stretches."""
    target = gap(source, windows)
    residual.scale.copy_(target.square().mean(0).sqrt().clamp(min=1e-9))
    target = target / residual.scale
    train, held_out = split(len(windows), settings.held_out, generator)
    parameters = [parameter for parameter in residual.network.parameters()]
    for parameter in parameters:
        parameter.requires_grad_(True)
    optimiser = torch.optim.AdamW(parameters, settings.learning_rate, weight_decay=settings.weight_decay)
    best, best_weights, waited = float("inf"), copy.deepcopy(residual.network.state_dict()), 0
    losses: list[GroundLoss] = []
    running = 0.0
    for step in range(settings.steps + 1):
        if step % settings.every == 0:
            score = _loss(residual, windows, target, held_out)
            losses.append(GroundLoss(step, running / settings.every if step else score, score))
            running = 0.0
            if progress is not None:
                progress(step, settings.steps, score)
            if score < best:
                best, best_weights, waited = score, copy.deepcopy(residual.network.state_dict()), 0
            else:
                waited += 1
            if waited > settings.patience or step == settings.steps:
                break
        rows = train[torch.randint(len(train), (settings.batch,), generator=generator)]
        loss = _error(residual, windows, target, rows)
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
        running += float(loss.detach())
    residual.network.load_state_dict(best_weights)
    for parameter in parameters:
        parameter.requires_grad_(False)
    return losses


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


def _error(residual: Residual, windows: Windows, target: Tensor, rows: Tensor) -> Tensor:
    out: Tensor = residual.network(windows.history(rows).acting(windows.action[rows]))
    return (out - target[rows]).square().mean()


@torch.no_grad()
def _loss(residual: Residual, windows: Windows, target: Tensor, rows: Tensor) -> float:
    parts = [_error(residual, windows, target, part) * len(part) for part in rows.split(256)]
    return float(torch.stack(parts).sum() / len(rows))
