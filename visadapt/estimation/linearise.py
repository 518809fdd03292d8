"""Derivatives of a world's step and of its sensor readings, by states, parameters and commands.

By finite differences, all of them in one batch: World steps rows of a batch independently, and each row may have
parameters of its own. In float64 the error is about 1e-8 of a state.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache

import torch
from torch import Tensor

from visadapt.effects import DynamicsEffect, Effect, Parameter, Role, SensingEffect
from visadapt.estimation.late_readings import Following, reading
from visadapt.systems import System
from visadapt.world import World

STATE_STEP = 1e-6  # Finite difference of a state, in its SI unit, and of a command

PARAMETER_STEP = 1e-6  # Finite difference of a parameter, as a share of the range in which it is searched

ROWS_AT_ONCE = 4096
"""Rows that are integrated together: intermediate results of more leave the processor's cache, which takes a row 2 to 3
times as long."""

PHASE_MARGIN = 4 * math.pi
"""rad by which a phase may leave its range during a fit: the best phase may lie up to two turns outside it."""


@dataclass(frozen=True)
class Tangent:
    """A function of N states and of P parameters, with its first derivatives."""

    value: Tensor  # (N, m)
    by_state: Tensor  # (N, m, n); no columns where it was not asked for
    by_parameter: Tensor  # (N, m, P)
    by_command: Tensor  # (N, m, n_action); no columns where it was not asked for


@cache
def load_effect(system: type[System]) -> type[DynamicsEffect]:
    """An effect with one free load on each degree of freedom, to differentiate by; unnamed, so in no catalogue."""

    class Load(DynamicsEffect):
        table = tuple(Parameter(load.name, load.unit, -1.0, 1.0, 0.0) for load in system.loads)

        def load(self, time: Tensor, state: Tensor, system: System) -> Tensor:
            rows = [self.value(load.name, state).expand(len(state)) for load in system.loads]
            return torch.stack(rows, -1)

    return Load


def search_range(table: Sequence[Parameter]) -> tuple[Tensor, Tensor]:
    """Lowest and highest values (P,) that a fit may give the parameters."""
    margin = torch.tensor([PHASE_MARGIN * p.is_phase for p in table], dtype=torch.float64)
    low = torch.tensor([p.low for p in table], dtype=torch.float64)
    high = torch.tensor([p.high for p in table], dtype=torch.float64)
    return low - margin, high + margin


def parameter_steps(table: Sequence[Parameter], values: Tensor) -> Tensor:
    """Finite differences (..., P) of parameters (..., P), directed inwards so that none leaves its range."""
    low, high = search_range(table)
    step = PARAMETER_STEP * (high - low)
    return torch.where(values + step > high, -step, step)


def integrate(
    world: World, values: Tensor, time: Tensor, state: Tensor, commands: Tensor, duration: Tensor | None = None
) -> Tensor:
    """`World.integrate` with parameters `values` (N, P) of the effects, a row for each of N states."""
    given = [values, time, state, commands] + ([] if duration is None else [duration])
    parts = zip(*(x.split(ROWS_AT_ONCE) for x in given), strict=True)
    return torch.cat([world.with_values(parameters).integrate(*rest) for parameters, *rest in parts])


def linearise_step(
    world: World,
    values: Tensor,
    time: Tensor,
    state: Tensor,
    acting: Tensor,
    by_state: bool = True,
    by_command: bool = False,
    duration: Tensor | None = None,
) -> Tangent:
    """The state one period, or `duration` (N,) s, after each of N states, with derivatives.

    Args:
        world: the effects' present parameter values are not used.
        values: (P,) of the effects' parameters, or (N, P) with a row for each state.
        time: (N,) s since the episodes began.
        state: (N, n) in float64.
        acting: inputs after actuation over the substeps, (N, substeps, n_action); or (1 + P, N, substeps, n_action)
            where they depend on the parameters: under `values`, then with each parameter moved by `parameter_steps`.
        by_state, by_command: whether to compute these derivatives; that by the command is by a constant added to
            `acting` over the period.
    """
    given = acting if acting.dim() == 4 else acting[None].expand(1 + values.shape[-1], *acting.shape)

    def step(rows: Tensor, states: Tensor, moved: Sequence[int], pushed: Tensor) -> Tensor:
        commands = given[list(moved)]
        if by_command:
            commands = commands + STATE_STEP * pushed[:, None, None]
        lasting = None if duration is None else duration.repeat(len(moved))
        return integrate(world, rows, time.repeat(len(moved)), states, commands.flatten(0, 1), lasting)

    columns = _columns(world, sensing=False)
    return _tangent(step, world, values, state, columns, by_state, by_command)


def linearise_reading(
    world: World,
    values: Tensor,
    state: Tensor,
    following: Sequence[Following],
    applied: Sequence[Tensor],
    by_state: bool,
) -> Tangent:
    """Sensor readings (N, n) that show N states, with derivatives.

    `following` is what late sensors show: with `values`, then with each parameter moved by `parameter_steps`; empty
    without such sensors. `applied` is, in the same way, what acts in each row, (N, 2, n_action) as in `World.reading`;
    empty where no sensor depends on it. The other arguments are those of `linearise_step`.
    """

    def read(rows: Tensor, states: Tensor, moved: Sequence[int], pushed: Tensor) -> Tensor:
        after = [following[k] for k in moved] if following else []
        shown = after[0].map(lambda *each: torch.cat(each), *after[1:]) if after else None
        acts = torch.cat([applied[k] for k in moved]) if applied else None
        return reading(world, rows, states, shown, acts)

    if not any(isinstance(effect, SensingEffect) for effect in world.effects):
        count, n = state.shape
        identity = torch.eye(n, dtype=state.dtype, device=state.device).expand(count, n, n)[..., : n if by_state else 0]
        return Tangent(state, identity, state.new_zeros(count, n, values.shape[-1]), state.new_zeros(count, n, 0))
    columns = _columns(world, sensing=True) + (_columns(world, sensing=False) if following or applied else [])
    return _tangent(read, world, values, state, columns, by_state, by_command=False)


def _columns(world: World, sensing: bool) -> list[int]:
    """The parameters of the sensing effects, or those of the others."""
    effects = [effect for effect in world.effects if isinstance(effect, Effect)]
    acts = [isinstance(effect, SensingEffect) == sensing for effect in effects for _ in effect.table]
    # Rows have the phase of their own episode in the place of the first's.
    return [k for k, each in enumerate(acts) if each and world.table[k].role is not Role.EPISODE_PHASE]


def _tangent(
    function: Callable[[Tensor, Tensor, Sequence[int], Tensor], Tensor],
    world: World,
    values: Tensor,
    state: Tensor,
    columns: Sequence[int],
    by_state: bool,
    by_command: bool,
) -> Tangent:
    """Evaluate the base point, and with each state, parameter of `columns` and command moved, as one batch.

    The other parameters change nothing.
    """
    width = len(world.system.actions)
    commands = width if by_command else 0
    (count, n), parameters = state.shape, len(columns)
    states = n if by_state else 0
    replicas = 1 + states + parameters + commands
    base = values.expand(count, values.shape[-1])
    steps = parameter_steps(world.table, base)
    rows, states_moved = base.repeat(replicas, 1, 1), state.repeat(replicas, 1, 1)
    pushed = state.new_zeros(replicas, width)
    moved = [0] * replicas
    for i in range(states):
        states_moved[1 + i, :, i] += STATE_STEP
    for k, column in enumerate(columns):
        rows[1 + states + k, :, column] += steps[:, column]
        moved[1 + states + k] = 1 + column
    for k in range(commands):
        pushed[1 + states + parameters + k, k] = 1
    out = function(rows.flatten(0, 1), states_moved.flatten(0, 1), moved, pushed)
    out = out.reshape(replicas, count, out.shape[-1])
    change = (out[1:] - out[:1]).movedim(0, -1)
    by = change.split((states, parameters, commands), -1)
    by_parameter = out.new_zeros(*out[0].shape, values.shape[-1])
    by_parameter[..., list(columns)] = by[1] / steps[:, None, list(columns)]
    return Tangent(out[0], by[0] / STATE_STEP, by_parameter, by[2] / STATE_STEP)
