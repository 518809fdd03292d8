"""Dry friction over one integration step: sliding, stopping and sticking.

While a coordinate slides, dry friction is a constant force against its motion, which the integrator sees as a load.
Where the velocity would change its sign within the step, the coordinate has stopped: for what is left of the step,
friction resists the start in the other direction, up to its largest force (Karnopp 1985, Computer simulation of
stick-slip friction in mechanical dynamic systems, J. Dyn. Sys. Meas. Control 107(1)). Exact where the acceleration is
constant over a step; a coordinate that sticks does not creep.
"""

from __future__ import annotations

import torch
from torch import Tensor

from visadapt.systems.base import System
from visadapt.systems.integrators import Duration


def sliding(limits: Tensor, velocity: Tensor) -> Tensor:
    """Friction (B, n_load) on coordinates that move with `velocity` (B, n_load); none on those at rest.

    `limits` (B, n_load, 2) are the largest frictions, N or N m, against positive and against negative motion.
    """
    forward, backward = limits.unbind(-1)
    zero = torch.zeros_like(forward)
    return torch.where(velocity > 0, -forward, torch.where(velocity < 0, backward, zero))


def stopped(system: System, before: Tensor, after: Tensor, command: Tensor, limits: Tensor, h: Duration) -> Tensor:
    """States (B, n_state) after a step of `h` s under sliding friction, with coordinates stopped that reversed in it.

    `before` and `after` are the states at either end of the step, `command` (B, n_action) acted in it; `limits` as in
    `sliding`.
    """
    velocities = [velocity for _, velocity in system.coordinates]
    first, last = before[:, velocities], after[:, velocities]
    # A row in which nothing reverses is left as it is: computing the response to loads for these too takes longer than
    # the step itself.
    rubs = torch.ones_like(first, dtype=torch.bool) if limits.requires_grad else (limits != 0).any(-1)
    rows = (((first == 0) | (first * last < 0)) & rubs).any(-1)
    if not bool(rows.any()):
        return after
    duration = h[rows] if isinstance(h, Tensor) and h.dim() else h
    acting = command.expand(len(rows), -1)[rows]
    out = after.clone()
    out[rows] = _stopped(system.of_rows(rows), before[rows], after[rows], acting, limits[rows], duration)
    return out


def _stopped(system: System, before: Tensor, after: Tensor, command: Tensor, limits: Tensor, h: Duration) -> Tensor:
    """`stopped` for rows in each of which something reverses."""
    none = torch.zeros_like(limits[..., 0])
    free = system.derivative(before, command, none)
    for k, (_, own) in enumerate(system.coordinates):
        forward, backward = limits[:, k].unbind(-1)
        if not limits.requires_grad and not bool((forward + backward).any()):
            continue  # no friction on this coordinate
        unit = none.clone()
        unit[:, k] = 1
        gain = system.derivative(before, command, unit) - free  # of all rates, per unit of this load
        first, last = before[:, own], after[:, own]
        rest = first == 0
        reverses = rest | (first * last < 0)
        # Share of the step that is left after the stop.
        left = torch.where(rest, torch.ones_like(last), last / torch.where(reverses & ~rest, last - first, 1.0))
        # Until now friction acted against the first direction for the whole step: that share of it is taken back.
        taken = torch.where(rest, none[:, k], torch.where(first > 0, forward, backward))
        most = torch.where(last > 0, forward, backward) + taken
        kept = last.sign() * (last.abs() - most * left * h * gain[:, own]).clamp_min(0)
        impulse = torch.where(reverses, (kept - last) / gain[:, own], torch.zeros_like(last))
        moved = after + gain * impulse[:, None]
        for position, velocity in system.coordinates:
            moved[:, position] = moved[:, position] + 0.5 * left * h * gain[:, velocity] * impulse
        moved[:, own] = torch.where(reverses, kept, last)  # exactly at rest
        after = moved
    return after
