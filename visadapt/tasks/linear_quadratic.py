"""The linear-quadratic regulator of a world about a state of rest."""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor

from visadapt.effects import DynamicsEffect
from visadapt.estimation.linearise import linearise_step
from visadapt.world import World

SUMMED_PREDICTIONS = 100.0  # Prediction times over which costs are summed; what comes later adds next to nothing
MAX_GROWTH = 1e-4
"""Growth in a period, under the regulator, up to which a motion is steady: a position that costs nothing stays where it
is, by an eigenvalue of 1."""


class Regulator(NamedTuple):
    """A regulator a = -gain s of distances s from a state of rest, and what it costs."""

    closed: Tensor
    """(n_state, n_state) states to those one period later, under the regulator"""
    gain: Tensor
    """(n_action, n_state)"""
    to_go: Tensor
    """(n_state, n_state) V: s' V s is the least sum of the costs of all states and commands that follow s"""


@torch.no_grad()
def linear_quadratic(
    world: World, weights: Tensor, command_weights: Tensor, rest: Tensor | None = None, held: Tensor | None = None
) -> Regulator:
    """The regulator with the least sum of weighted squared distances and commands, in float64.

    The world, with those of its effects that act alike throughout an episode and are smooth at rest (parameters,
    springs, damping), is linearised there; the discrete algebraic Riccati equation is iterated from V = 0 over
    SUMMED_PREDICTIONS.

    Args:
        weights: (n_state,) of the squared distances. command_weights: (n_action,) of the squared commands.
        rest: (n_state,) the state of rest; the origin without it.
        held: (n_action,) the commands that hold it; 0 without them.

    Raises:
        ValueError: no regulator keeps the system at rest: what moves away from it there is not moved by the commands.
    """
    smooth = world.with_effects(
        [each for each in world.effects if isinstance(each, DynamicsEffect) and _is_smooth(each)]
    )
    weights, command_weights = weights.double().diag(), command_weights.double().diag()
    state = torch.zeros(1, len(weights)).to(weights) if rest is None else rest.to(weights)[None]
    command = state.new_zeros(len(command_weights)) if held is None else held.to(state)
    commands = command.expand(1, smooth.substeps, -1)
    step = linearise_step(smooth, smooth.values.to(state), state.new_zeros(1), state, commands, by_command=True)
    a, b = step.by_state[0], step.by_command[0]
    to_go = torch.zeros_like(weights)
    for _ in range(math.ceil(SUMMED_PREDICTIONS * world.system.prediction_time / world.period)):
        after = weights + to_go
        gain = torch.linalg.solve_ex(command_weights + b.T @ after @ b, b.T @ after @ a).result
        to_go = a.T @ after @ (a - b @ gain)
    closed = a - b @ gain
    if not bool(to_go.isfinite().all()) or float(torch.linalg.eigvals(closed).abs().max()) > 1 + MAX_GROWTH:
        raise ValueError(f"no commands keep a {world.system.name} at rest there: what moves away is not moved by them")
    return Regulator(closed, gain, to_go)


def _is_smooth(effect: DynamicsEffect) -> bool:
    """Whether an effect acts alike throughout an episode and does not jump where a motion turns round."""
    return not (effect.rubs() or effect.region() or any(parameter.is_phase for parameter in effect.table))
