"""What a fitted set leaves unexplained: the log odds of smooth functions of one variable, each added alone.

A function adds a load (a force on the cart, say) or an error of a reading. It is a sum of Gaussian bumps of one state,
the command, the previous command, or time. What it adds passes through the gains of the fitted set's filter, so that
fitting it is a linear regression of whitened innovations, whose marginal likelihood is exact (MacKay 1992,
Bayesian interpolation, Neural Computation 4(3)).
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

import torch
from torch import Tensor

from visadapt.estimation.candidate import FINE, CandidateModel, linearise, with_loads
from visadapt.estimation.likelihood import FitState
from visadapt.estimation.sensitivity import Innovations

BUMPS = 10  # Gaussian bumps of a function

PREVIOUS_PREFIX = "previous_"  # Prefix of the name of a command in the period before

PRIOR_DEVIATIONS = (0.03, 0.3, 3.0, 30.0)
"""Prior standard deviations that are tried for the change of the whitened innovations by all bumps together."""


@dataclass(frozen=True)
class SmoothFunction:
    """One smooth function of one variable, fitted alone."""

    port: str  # the load, or the state whose reading is in error
    of_reading: bool  # whether it is an error of a reading; a load may have the name of a state
    variable: str  # a state, a command, a command of the period before, or time
    log_odds: float  # that it is there, at even prior odds


@dataclass(frozen=True)
class Block:
    """The bumps of one function as inputs to the filter."""

    port: str
    of_reading: bool
    variable: str
    drive: Tensor  # (W, T - 1, n, BUMPS) to the states
    reading: Tensor  # (W, T, m, BUMPS) to the readings


def smooth_functions(model: CandidateModel, fits: FitState, along: Tensor) -> list[SmoothFunction]:
    """Every function of states `along` (W, T, n), added alone to a fitted set, the largest log odds first.

    Where process noise moves a state after its readings, an error of the reading is a function of that state.
    """
    innovations = Innovations(model, fits)
    out = []
    # One after the other: together they would need much memory.
    for block in _blocks(model, fits, along):
        response = innovations.response(block.drive, block.reading)
        log_odds = _log_odds(response, innovations.error)
        out.append(SmoothFunction(block.port, block.of_reading, block.variable, log_odds))
    return sorted(out, key=lambda function: -function.log_odds)


def _blocks(model: CandidateModel, fits: FitState, along: Tensor) -> Iterator[Block]:
    rows, system = model.rows, model.system
    loads = loads_of(model, fits)
    variables = variables_of(model, along)
    no_drive = torch.zeros(*along[:, 1:].shape, BUMPS, dtype=torch.float64)
    used = model.shown(fits.theta[0])[1]
    no_reading = torch.zeros(*used.shape, BUMPS, dtype=torch.float64)
    for name, values in variables.items():
        bumps = _bumps(values, rows.inside > 0)
        inner = bumps[:, :-1] * rows.inside[:, 1:, None]
        for k, load in enumerate(system.loads):
            for factor in model.profile.smooth_function_factors.get(load.name, (None,)):
                factors = 1.0 if factor is None else variables[factor][:, :-1, None]
                drive = loads[..., k, None] * (factors * inner)[:, :, None]
                yield Block(load.name, False, name, drive, no_reading)
        for k, channel in enumerate(rows.channels):
            state_name = system.states[channel].name
            if name in (state_name, "time"):
                reading = no_reading.clone()
                reading[:, :, k] = -bumps * used[:, :, k, None]
                yield Block(state_name, True, name, no_drive, reading)


def variables_of(model: CandidateModel, state: Tensor) -> dict[str, Tensor]:
    """(W, T) of every state, command and previous command, and of time last, by name; along states (W, T, n)."""
    rows = model.rows
    index = rows.index
    command = rows.given
    before = rows.command[rows.episode[:, None], (index - 1).clamp(min=0)] * (index > 0)[..., None]
    out = {variable.name: state[..., k] for k, variable in enumerate(model.system.states)}
    for k, action in enumerate(model.system.actions):
        out |= {action.name: command[..., k], f"{PREVIOUS_PREFIX}{action.name}": before[..., k]}
    return {**out, "time": rows.time}


def loads_of(model: CandidateModel, fits: FitState) -> Tensor:
    """Change of the states after a period per unit of each load, (W, T - 1, n, loads)."""
    count = len(model.system.loads)
    theta = torch.cat((fits.theta[0, : len(model.table)], torch.zeros(count, dtype=torch.float64)))
    return linearise(with_loads(model, FINE), theta, fits.state[0]).by_parameter[..., -count:]


def _bumps(values: Tensor, inside: Tensor) -> Tensor:
    """Bumps (W, T, BUMPS) at values (W, T), with centres evenly spaced from their 1 % to their 99 % quantile."""
    low, high = torch.quantile(values[inside], torch.tensor([0.01, 0.99], dtype=values.dtype)).tolist()
    centres = torch.linspace(low, max(high, low + 1e-9), BUMPS, dtype=values.dtype)
    width = centres[1] - centres[0]
    return torch.exp(-0.5 * ((values[..., None] - centres) / width).square())


def _log_odds(responses: Tensor, error: Tensor) -> float:
    """Log odds that responses (N, M) with weights cancel a part of `error` (N,), against weights of zero."""
    normal = responses.T @ responses
    gradient = -(responses.T @ error)
    scale = 1 / (normal.diagonal().mean() + 1e-300)
    identity = torch.eye(len(gradient), dtype=normal.dtype)
    best = -math.inf
    for size in PRIOR_DEVIATIONS:
        variance = scale * size**2 * BUMPS
        weights = torch.linalg.solve(normal + identity / variance, gradient)
        value = float(0.5 * gradient @ weights - 0.5 * torch.linalg.slogdet(identity + variance * normal)[1])
        if value > best:
            best = value
    return best - math.log(len(PRIOR_DEVIATIONS))
