"""What a fitted set leaves unexplained: a black box of smooth functions, each of its own variable, and its evidence.

A function adds a force on the cart, a torque at the pivot, or an error to a reading. Each is a sum of Gaussian bumps
of one state, the command, the command before, or the time. What it adds passes through the gains of the set's own
filter, so that fitting it is a linear regression of whitened innovations, whose evidence is exact (MacKay 1992,
Bayesian interpolation, Neural Computation 4(3)).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from visadapt.estimation.candidate import CandidateModel, linearise
from visadapt.estimation.innovations import Innovations
from visadapt.estimation.likelihood import FitState
from visadapt.estimation.linearise import load_effect

BUMPS = 10
"""Bumps of a function."""

MOST = 8
"""Functions of a black box."""

PREVIOUS = "previous_"
"""What a command of the period before is called, before the command's name."""

SIZES = (0.03, 0.3, 3.0, 30.0)
"""Prior deviations that are tried of what the bumps together change of the innovations, in deviations of these."""


@dataclass(frozen=True)
class Function:
    """One function of the black box, fitted alone."""

    port: str
    """a load, or the state that is read"""
    variable: str
    """a state, a command, one of the period before, or time"""
    factor: str | None
    """a variable that multiplies it, so that it is a friction or a gain; None for a plain load"""
    evidence: float
    """log odds of it against nothing"""
    centres: Tensor
    """(BUMPS,) in the variable's unit"""
    values: Tensor
    """(BUMPS,) of the function at the centres, in the port's unit, over the factor's"""


@dataclass(frozen=True)
class Block:
    """The bumps of one function, as inputs to the filter."""

    port: str
    variable: str
    factor: str | None
    centres: Tensor
    drive: Tensor
    """(W, T - 1, n, BUMPS)"""
    reading: Tensor
    """(W, T, m, BUMPS)"""


def functions(model: CandidateModel, fits: FitState) -> list[Function]:
    """Every function of the black box beside a fitted set, the most evident first."""
    blocks = _blocks(model, fits)
    innovations = Innovations(model, fits)
    out = []
    for block, answer in zip(blocks, _answers(innovations, blocks), strict=True):
        weights, evidence = _regression(answer, innovations.error)
        _, shape = _bumps(block.centres, (float(block.centres[0]), float(block.centres[-1])))
        out.append(Function(block.port, block.variable, block.factor, evidence, block.centres, shape @ weights))
    return sorted(out, key=lambda function: -function.evidence)


def black_box(model: CandidateModel, fits: FitState, counts: Tensor) -> Tensor:
    """What loads learnt from the windows that count (W,) add to the states a period on, in all (W, T - 1, n).

    One function after the other, the most evident first, each fitted to what those before it leave.
    """
    blocks = [block for block in _blocks(model, fits) if not bool(block.reading.any())]
    innovations = Innovations(model, fits)
    counted = (model.rows.used * counts[:, None, None]).flatten()
    answers = [answer * counted[:, None] for answer in _answers(innovations, blocks)]
    left = innovations.error * counted
    drive = torch.zeros_like(blocks[0].drive[..., 0])
    for _ in range(MOST):
        fitted = [_regression(answer, left) for answer in answers]
        best = max(range(len(fitted)), key=lambda k: fitted[k][1])
        weights, evidence = fitted[best]
        if evidence <= 0:
            break
        left = left + answers[best] @ weights
        drive = drive + blocks[best].drive @ weights
    return drive


def _answers(innovations: Innovations, blocks: Sequence[Block]) -> tuple[Tensor, ...]:
    drive, reading = (torch.cat([getattr(block, name) for block in blocks], -1) for name in ("drive", "reading"))
    return innovations.answer(drive, reading).split(BUMPS, 1)


def _blocks(model: CandidateModel, fits: FitState) -> list[Block]:
    rows, system = model.rows, model.system
    state = fits.state[0]
    loads = loads_of(model, fits)
    variables = variables_of(model, state)
    still = torch.zeros(*state[:, 1:].shape, BUMPS, dtype=torch.float64)
    silent = torch.zeros(*rows.used.shape, BUMPS, dtype=torch.float64)
    out = []
    for name, place in variables.items():
        centres, bumps = _bumps(place, _ends(place, rows.inside > 0))
        inner = bumps[:, :-1] * rows.inside[:, 1:, None]
        for k, load in enumerate(system.loads):
            for factor in model.profile.factors.get(load.name, (None,)):
                by = 1.0 if factor is None else variables[factor][:, :-1, None]
                drive = loads[..., k, None] * (by * inner)[:, :, None]
                out.append(Block(load.name, name, factor, centres, drive, silent))
        for k, channel in enumerate(rows.channels):
            read = system.states[channel].name
            if name in (read, "time"):
                reading = silent.clone()
                reading[:, :, k] = -bumps * rows.used[:, :, k, None]
                out.append(Block(read, name, None, centres, still, reading))
    return out


def variables_of(model: CandidateModel, state: Tensor) -> dict[str, Tensor]:
    """(W, T) of every variable."""
    rows = model.rows
    index = rows.index
    command = rows.command[rows.episode[:, None], index]
    before = rows.command[rows.episode[:, None], (index - 1).clamp(min=0)] * (index > 0)[..., None]
    out = {variable.name: state[..., k] for k, variable in enumerate(model.system.states)}
    for k, action in enumerate(model.system.actions):
        out |= {action.name: command[..., k], f"{PREVIOUS}{action.name}": before[..., k]}
    return {**out, "time": rows.time}


def loads_of(model: CandidateModel, fits: FitState) -> Tensor:
    """What a unit of each load, held for a period, adds to the states, (W, T - 1, n, loads)."""
    count = len(model.system.loads)
    pushed = CandidateModel(model.system, [*model.effects, load_effect(type(model.system))], model.rows)
    theta = torch.cat((fits.theta[0, : len(model.table)], torch.zeros(count, dtype=torch.float64)))
    return linearise(pushed, theta, fits.state[0]).by_parameter[..., -count:]


def _ends(place: Tensor, inside: Tensor) -> tuple[float, float]:
    low, high = torch.quantile(place[inside], torch.tensor([0.01, 0.99], dtype=place.dtype)).tolist()
    return low, max(high, low + 1e-9)


def _bumps(place: Tensor, ends: tuple[float, float]) -> tuple[Tensor, Tensor]:
    """Centres (BUMPS,), evenly over where the data are, and the bumps (W, T, BUMPS)."""
    centres = torch.linspace(*ends, BUMPS, dtype=place.dtype)
    width = centres[1] - centres[0]
    return centres, torch.exp(-0.5 * ((place[..., None] - centres) / width).square())


def _regression(answers: Tensor, error: Tensor) -> tuple[Tensor, float]:
    """Weights (M,) that take most from `error` (N,) for their size, and their log odds against nothing."""
    normal = answers.T @ answers
    pull = -(answers.T @ error)
    scale = 1 / (normal.diagonal().mean() + 1e-300)
    identity = torch.eye(len(pull), dtype=normal.dtype)
    best, weights = -math.inf, torch.zeros_like(pull)
    for size in SIZES:
        variance = scale * size**2 * BUMPS
        inner = torch.linalg.solve(normal + identity / variance, pull)
        value = float(0.5 * pull @ inner - 0.5 * torch.linalg.slogdet(identity + variance * normal)[1])
        if value > best:
            best, weights = value, inner
    return weights, best - math.log(len(SIZES))
