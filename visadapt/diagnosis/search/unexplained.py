"""What a fitted set leaves unexplained: the log odds of smooth functions of one variable, each added alone.

A function adds a load (a force on the cart, say), opposite loads on two joints, or an error of a reading. It is a sum
of Gaussian bumps of one state, of one state less another, of the command, the previous command, or time; or, as a
motor's cogging is, a sum of waves that repeat in every turn of a shaft. What it adds passes through the gains of the
fitted set's filter, so that fitting it is a linear regression of whitened innovations, whose marginal likelihood is
exact (MacKay 1992, Bayesian interpolation, Neural Computation 4(3)).
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from itertools import combinations

import torch
from torch import Tensor

from visadapt.effects.own.statement import MIN_RANGE
from visadapt.estimation.candidate import FINE, CandidateModel, linearise, with_loads
from visadapt.estimation.likelihood import FitState
from visadapt.estimation.sensitivity import Innovations
from visadapt.systems import System

BUMPS = 10  # Gaussian bumps of a function

PREVIOUS_PREFIX = "previous_"  # Prefix of the name of a command in the period before

WAVES = 12  # Most waves within a turn

TURN_SUFFIX = "_within_a_turn"  # Suffix of the name of an angle, for what repeats in every turn

CLEAR_LOG_ODDS = 10.0
"""Log odds of a load above which it counts as unexplained although a black box closes no more of the gap."""

PRIOR_DEVIATIONS = (0.03, 0.3, 3.0, 30.0)
"""Prior standard deviations that are tried for the change of the whitened innovations by a whole function."""


@dataclass(frozen=True)
class SmoothFunction:
    """One smooth function of one variable, fitted alone."""

    port: str  # the load, "between_" two loads, or the state whose reading is in error
    of_reading: bool  # whether it is an error of a reading; a load may have the name of a state
    variable: str  # a state, an angle within a turn, one "_minus_" another, a command, a previous one, or time
    log_odds: float = math.nan  # that it is there, at even prior odds
    loads: Tensor | None = field(default=None, compare=False)
    """(L,) its share of each load: 1 for one load, 1 and -1 for opposite ones; None: an error of a reading"""
    states: Tensor | None = field(default=None, compare=False)
    """(n,) weights of the states whose sum is the variable; None: it is no state, or the function has a factor"""
    command: int | None = field(default=None, compare=False)
    """the command that is the variable; None: it is none, or the function has a factor"""
    centres: Tensor | None = field(default=None, compare=False)  # (BUMPS,) of its bumps; None: waves within a turn

    @property
    def is_of_motion(self) -> bool:
        """Whether states, or a command, give its variable: not time, nor a function with a factor."""
        return self.states is not None or self.command is not None

    @property
    def terms(self) -> int:
        """M, how many bumps or waves it has."""
        return 2 * WAVES if self.centres is None else BUMPS

    def basis(self, values: Tensor) -> Tensor:
        """(..., M) its bumps or waves at values (...) of its variable."""
        if self.centres is None:
            phases = values[..., None] * torch.arange(1, WAVES + 1, dtype=values.dtype)
            return torch.cat((phases.sin(), phases.cos()), -1)
        width = self.centres[1] - self.centres[0]
        return torch.exp(-0.5 * ((values[..., None] - self.centres) / width).square())


def smooth_functions(model: CandidateModel, fits: FitState, along: Tensor) -> list[SmoothFunction]:
    """Every function of states `along` (W, T, n), added alone to a fitted set, the largest log odds first.

    Where process noise moves a state after its readings, an error of the reading is a function of that state.
    """
    innovations = Innovations(model, fits)
    rows, by_load, used = model.rows, loads_of(model, fits), model.shown(fits.theta[0])[1]
    out = []
    # One after the other: together they would need much memory.
    for function, on, basis in _loads(model, along):
        inner = basis[:, :-1] * rows.inside[:, 1:, None]
        drive = (by_load @ on)[..., None] * inner[:, :, None]  # (W, T - 1, n, M)
        response = innovations.response(drive, basis.new_zeros(*used.shape, basis.shape[-1]))
        out.append(replace(function, log_odds=_log_odds(response, innovations.error)))
    for function, k, basis in _readings(model, along):
        reading = basis.new_zeros(*used.shape, basis.shape[-1])  # (W, T, m, M)
        reading[:, :, k] = -basis * used[:, :, k, None]
        response = innovations.response(basis.new_zeros(*along[:, 1:].shape, basis.shape[-1]), reading)
        out.append(replace(function, log_odds=_log_odds(response, innovations.error)))
    return sorted(out, key=lambda function: -function.log_odds)


def _loads(model: CandidateModel, along: Tensor) -> Iterator[tuple[SmoothFunction, Tensor, Tensor]]:
    """Functions that act as loads, each with its share (L,) of each load, and its bumps or waves (W, T, M)."""
    system, inside = model.system, model.rows.inside > 0
    column = {state.name: k for k, state in enumerate(system.states)}
    commands = {action.name: k for k, action in enumerate(system.actions)}
    variables = variables_of(model, along)
    for name, values in variables.items():
        centres = _centres(values[inside])
        for k, load in enumerate(system.loads):
            on = _unit(len(system.loads), k)
            for factor in model.profile.smooth_function_factors.get(load.name, (None,)):
                of = _unit(len(system.states), column[name]) if name in column and factor is None else None
                by = commands.get(name) if factor is None else None
                function = SmoothFunction(load.name, False, name, loads=on, states=of, command=by, centres=centres)
                yield function, on, function.basis(values) * (1.0 if factor is None else variables[factor][..., None])
    for port, name, on, of in _of_turns(system, along[inside]):
        function = SmoothFunction(port, False, name, loads=on, states=of)
        yield function, on, function.basis(along @ of)
    for port, name, on, of in _between_joints(system):
        values = along @ of
        function = SmoothFunction(port, False, name, loads=on, states=of, centres=_centres(values[inside]))
        yield function, on, function.basis(values)


_Named = tuple[str, str, Tensor, Tensor]
"""Port and variable of a load, its share (L,) of each load, and the weights (n,) of the states in its variable"""


def _of_turns(system: System, states: Tensor) -> Iterator[_Named]:
    """The load of each joint that makes several turns along `states` (N, n), by its angle within a turn: cogging."""
    for joint, (angle, _) in enumerate(system.coordinates):
        if angle is None or system.states[angle].unit != "rad":
            continue
        if float(states[:, angle].max() - states[:, angle].min()) > MIN_RANGE:
            name = system.states[angle].name + TURN_SUFFIX
            on, of = _unit(len(system.loads), joint), _unit(len(system.states), angle)
            yield system.loads[joint].name, name, on, of


def _between_joints(system: System) -> Iterator[_Named]:
    """Opposite loads on two joints, by how far, and by how fast, one moves against the other: a coupling."""
    for (i, first), (j, second) in combinations(enumerate(system.coordinates), 2):
        port = f"between_{system.loads[i].name}_and_{system.loads[j].name}"
        on = _unit(len(system.loads), i) - _unit(len(system.loads), j)
        for one, other in zip(first, second, strict=True):
            if one is None or other is None or system.states[one].unit != system.states[other].unit:
                continue
            name = f"{system.states[one].name}_minus_{system.states[other].name}"
            of = _unit(len(system.states), one) - _unit(len(system.states), other)
            yield port, name, on, of


def _readings(model: CandidateModel, along: Tensor) -> Iterator[tuple[SmoothFunction, int, Tensor]]:
    """Functions that are errors of a reading, of its own state or of time, each with the reading's position among the
    channels, and its bumps (W, T, M)."""
    rows = model.rows
    variables = variables_of(model, along)
    for k, channel in enumerate(rows.channels):
        state = model.system.states[channel].name
        for name in (state, "time"):
            function = SmoothFunction(state, True, name, centres=_centres(variables[name][rows.inside > 0]))
            yield function, k, function.basis(variables[name])


def _unit(size: int, k: int) -> Tensor:
    """(size,) zeros, and 1 at position k."""
    return torch.eye(size, dtype=torch.float64)[k]


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


def _centres(values: Tensor) -> Tensor:
    """(BUMPS,) centres, evenly spaced from the 1 % to the 99 % quantile of values (N,)."""
    low, high = torch.quantile(values, torch.tensor([0.01, 0.99], dtype=values.dtype)).tolist()
    return torch.linspace(low, max(high, low + 1e-9), BUMPS, dtype=values.dtype)


def _log_odds(responses: Tensor, error: Tensor) -> float:
    """Log odds that responses (N, M) with weights cancel a part of `error` (N,), against weights of zero."""
    normal = responses.T @ responses
    gradient = -(responses.T @ error)
    scale = 1 / (normal.diagonal().mean() + 1e-300)
    identity = torch.eye(len(gradient), dtype=normal.dtype)
    best = -math.inf
    for size in PRIOR_DEVIATIONS:
        variance = scale * size**2 * len(gradient)
        weights = torch.linalg.solve(normal + identity / variance, gradient)
        value = float(0.5 * gradient @ weights - 0.5 * torch.linalg.slogdet(identity + variance * normal)[1])
        if value > best:
            best = value
    return best - math.log(len(PRIOR_DEVIATIONS))
