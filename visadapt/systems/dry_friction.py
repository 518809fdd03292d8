"""Dry friction over one integration step: sliding, stopping and sticking.

While a coordinate slides, dry friction is a force against its motion, which the integrator sees as a load. Where the
velocity would change its sign within the step, the coordinate has stopped: for what is left of the step, friction
resists the start in the other direction, up to its largest force (Karnopp 1985, Computer simulation of stick-slip
friction in mechanical dynamic systems, J. Dyn. Sys. Meas. Control 107(1)). A coordinate that sticks does not creep. One
that starts meets the friction at half the velocity that it reaches (midpoint rule). Exact where accelerations are
constant over a step.
"""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from visadapt.systems.base import System
from visadapt.systems.integrators import Duration

Limits = Callable[[Tensor], Tensor]
"""The largest frictions (B, n_load, 2), N or N m, against positive and against negative motion, as a function of the
velocities (B, n_load) of the coordinates."""


def sliding(limits: Limits, velocity: Tensor, direction: Tensor) -> Tensor:
    """Friction (B, n_load) on coordinates with `velocity` (B, n_load) that slide in the `direction` (B, n_load), +1 or
    -1; none where it is 0.

    A coordinate that has turned round has the friction of one at rest: `stopped` corrects what that does.
    """
    zero = torch.zeros_like(velocity)
    forward, backward = limits(torch.where(velocity * direction > 0, velocity, zero)).unbind(-1)
    return torch.where(direction > 0, -forward, torch.where(direction < 0, backward, zero))


def stopped(system: System, before: Tensor, after: Tensor, command: Tensor, limits: Limits, h: Duration) -> Tensor:
    """States (B, n_state) after a step of `h` s under sliding friction, with coordinates stopped that reversed in it.

    `before` and `after` are the states at either end of the step; `command` (B, n_action) acted in it.
    """
    velocities = [velocity for _, velocity in system.coordinates]
    first, last = before[:, velocities], after[:, velocities]
    at_rest = limits(torch.zeros_like(first))
    # A row in which nothing reverses is left as it is: computing the response to loads for these too takes longer than
    # the step itself.
    rubs = torch.ones_like(first, dtype=torch.bool) if at_rest.requires_grad else (at_rest + limits(last) != 0).any(-1)
    rows = (((first == 0) | (first * last < 0)) & rubs).any(-1)
    if not bool(rows.any()):
        return after
    duration = h[rows] if isinstance(h, Tensor) and h.dim() else h
    first, last, at_rest = before[rows], after[rows], at_rest[rows]
    loads = rubs.any(0).nonzero()[:, 0].tolist()
    acting, none = command.expand(len(rows), -1)[rows], torch.zeros_like(at_rest[..., 0])
    here = system.of_rows(rows)
    _, by_load = here.rates_per_load(first, acting, none, loads)
    responses = dict(zip(loads, by_load, strict=True))
    out = after.clone()
    out[rows] = _stopped(here, first, last, acting, responses, at_rest, at_rest, duration)
    started = limits(out[:, velocities] / 2)[rows]
    if started.requires_grad or not torch.equal(started, at_rest):  # friction may depend on velocity
        out[rows] = _stopped(here, first, last, acting, responses, at_rest, started, duration)
    return out


def _stopped(
    system: System,
    before: Tensor,
    after: Tensor,
    command: Tensor,
    responses: dict[int, Tensor],
    at_rest: Tensor,
    started: Tensor,
    h: Duration,
) -> Tensor:
    """`stopped` for rows in each of which something reverses, with the limits (B, n_load, 2) on coordinates at rest and
    on those that have started, and the change (B, n_state) of all rates per unit of each load that rubs, by index."""
    velocities, outside = [velocity for _, velocity in system.coordinates], system.outside_joints()
    for k, gain in responses.items():
        own = system.coordinates[k][1]
        forward, backward = at_rest[:, k].unbind(-1)
        first, last = before[:, own], after[:, own]
        rest = first == 0
        reverses = rest | (first * last < 0)
        # Share of the step that is left after the stop.
        left = torch.where(rest, 1.0, last / torch.where(reverses & ~rest, last - first, 1.0))
        # Until now friction acted against the first direction for the whole step: that share of it is taken back.
        taken = torch.where(rest, 0.0, torch.where(first > 0, forward, backward))
        holds = torch.where(last > 0, forward, backward) + taken
        slows = torch.where(last > 0, started[:, k, 0], started[:, k, 1]) + taken
        change = left * h * gain[:, own]  # of the velocity, per unit of a load since the stop
        moving = last.sign() * (last.abs() - slows * change).clamp_min(0)
        kept = torch.where(last.abs() > holds * change, moving, 0.0)
        impulse = torch.where(reverses, (kept - last) / gain[:, own], 0.0)
        moved = after + gain * impulse[:, None]
        for position, velocity in system.velocity_of().items():
            moved[:, position] = moved[:, position] + 0.5 * left * h * gain[:, velocity] * impulse
        moved[:, own] = torch.where(reverses, kept, last)  # exactly at rest
        if outside:  # what flows or is induced with the motion, as a cylinder's pressure or a motor's current
            slower = after.clone()
            slower[:, velocities] = moved[:, velocities]
            rates = _free(system, slower, command) - _free(system, after, command)
            moved[:, outside] = moved[:, outside] + (0.5 * left * h)[:, None] * rates[:, outside]
        after = moved
    return after


def _free(system: System, state: Tensor, command: Tensor) -> Tensor:
    """The rates (B, n_state) of all states without a load."""
    return system.derivative(state, command, state.new_zeros(len(state), len(system.loads)))
