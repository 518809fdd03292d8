"""The loads that a candidate model leaves out: how they move the states, and what they do to dry friction.

Process noise is such a load, held for a period: what is missing from a model of a machine is mostly a load on one of
its joints, which moves the others through the mass matrix and its own position by half of the period. Rows with
`Segments.jumps` have a jump of each velocity by itself instead (`diagnosis/search/jumps.py`).

The filter adds process noise to the state at the end of a period, so dry friction does not feel it. If the model lacks
a vibration that is stronger than the friction, a joint of the model sticks whenever its velocity changes sign, and the
machine's joint does not. Where the noise has a colour, something strong is known to be missing. There, a set with dry
friction takes its step under the load that leads from each state to the next; what that load does without friction is
then subtracted.
"""

from __future__ import annotations

import torch
from torch import Tensor

from visadapt.estimation.linearise import integrate, linearise_step, load_effect
from visadapt.estimation.profiles import profile_of
from visadapt.estimation.segments import Segments, initial_states
from visadapt.systems import System
from visadapt.systems.integrators import steps_within
from visadapt.world import World

LOAD_STEPS = 5
"""Fixed-point steps to the load that leads to the next state. One is enough where friction keeps its direction within
the period; where a cart turns round, five come within 0.05 N in most rows."""


def load_response(rows: Segments, system: System) -> Tensor:
    """(W, T - 1, n, L) change of the source's next state per unit of each load, held for a period, along the measured
    states."""
    windows, length = rows.shape
    load = load_effect(type(system))
    substeps = steps_within(float(rows.held.max()), profile_of(system).coarsest_step)
    nothing = load(**{parameter.name: 0.0 for parameter in load.table})
    world = World(system, [nothing], rows.period, substeps=substeps)
    (time, duration), state = rows.clock, initial_states(rows, system)[:, :-1].flatten(0, 1)
    commands = rows.given[:, :-1].flatten(0, 1)[:, None].expand(-1, substeps, -1)
    none = torch.zeros(len(system.loads), dtype=torch.float64)
    step = linearise_step(world, none, time, state, commands, by_state=False, duration=duration)
    return step.by_parameter.unflatten(0, (windows, length - 1)) * rows.inside[:, 1:, None, None]


def noise_directions(rows: Segments, system: System) -> Tensor:
    """(W, T - 1, n, L) change of the next state by each process noise: the `load_response` to a load that changes the
    velocities of its own group by 1, or a jump of one velocity by 1."""
    if rows.jumps:
        velocities = torch.tensor(profile_of(system).driven_columns)
        jump = torch.eye(len(system.states), dtype=torch.float64)[:, velocities]
        return rows.inside[:, 1:, None, None] * jump
    response = load_response(rows, system)
    groups = [list(group) for group in profile_of(system).driven for _ in group]
    own = torch.stack([response[:, :, group, k].norm(dim=-1) for k, group in enumerate(groups)], -1)
    return response / torch.where(own > 0, own, 1.0)[:, :, None]


def response_without_friction(world: World, state: Tensor, command: Tensor, duration: Tensor) -> Tensor:
    """(N, n, L) change of the next state per unit of each load on the joints of a world, held for `duration` (N,) s.

    Of first order in the duration, with the masses that the effects give the system, at N states under commands
    (N, n_action).
    """
    system = world.altered(state)
    _, by_load = system.response_to_loads(state, command, state.new_zeros(len(state), len(system.loads)))
    out = state.new_zeros(*state.shape, by_load.shape[-1])
    for joint, (position, velocity) in enumerate(system.coordinates):
        out[:, velocity] = duration[:, None] * by_load[:, joint]
        if position is not None:
            out[:, position] = 0.5 * duration[:, None] * out[:, velocity]
    return out


def leading_loads(
    world: World,
    values: Tensor,
    time: Tensor,
    state: Tensor,
    following: Tensor,
    acting: Tensor,
    duration: Tensor,
    response: Tensor,
) -> Tensor:
    """Loads (N, L) under which the velocities of N states (N, n) become those of the `following` ones (N, n).

    Args:
        world: its last effect is `load_effect`, whose L values, last in `values` (N, P + L), are not used.
        time, acting, duration: (N,) s, (N, substeps, n_action), and (N,) s, as in `linearise_step`.
        response: (N, n, L) of `response_without_friction`: friction makes it smaller, so that the steps converge.
    """
    velocities = [velocity for _, velocity in world.system.coordinates]
    loads = state.new_zeros(len(state), response.shape[-1])
    for _ in range(LOAD_STEPS):
        given = torch.cat((values[:, : values.shape[1] - loads.shape[1]], loads), 1)
        left = (following - integrate(world, given, time, state, acting, duration))[:, velocities]
        # The padding of windows may not respond.
        loads = loads + torch.linalg.solve_ex(response[:, velocities], left).result.nan_to_num(0, 0, 0)
    return loads
