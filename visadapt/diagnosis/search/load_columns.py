"""What state and command may explain of the loads that a motion takes: columns of loads, linear in a world's errors.

The errors are those of friction, of the commands' gain and delay, of the parameters, of the zero of a sensor, and of a
compliant drive. Columns follow the accelerations of the world, not the measured ones: along these, a factor common to
all columns could explain a push away.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

import torch
from torch import Tensor

from visadapt.diagnosis.search.inverse_dynamics import Motion
from visadapt.diagnosis.search.unexplained import SmoothFunction
from visadapt.effects.own.dynamics import scalable

SLOW = 0.01  # Speed over the largest of its range below which a joint may stick

SLACK = 0.1  # Command over the largest of its range at which the play of a drive is taken up

DIFFERENCE = 1e-4  # Finite difference of a state in its unit, and of the log of a parameter

Column = tuple[Tensor, Tensor | None]
"""Loads (T, J), and their change (T, J, J) with the modelled motion per unit of load, None where they do not change"""


@dataclass(frozen=True)
class Loads:
    """The load that nothing explains, and what may explain it, at T instants."""

    load: Tensor  # (T, J)
    columns: Tensor  # (T, K, J)
    reaction: Tensor  # (T, K, J, J) change of the columns per unit of load
    dry: tuple[int, ...]  # the column of each joint's dry friction


def columns_of(motion: Motion, known: SmoothFunction | None) -> Loads:
    """The loads that a motion takes beyond the world's; `known` is a function, of states or of a command, that acts
    as a load."""
    response, columns = _of_commands(motion)
    driven = (response * motion.commanded[:, None]).sum(-1)
    sliding = motion.without_dry_friction()
    dry = []
    for joint in range(driven.shape[1]):
        dry.append(len(columns))
        columns += [*_of_friction(motion, joint, driven[:, joint]), *_of_position(motion, sliding, joint)]
    columns += [*_of_parameters(motion), *_of_function(motion, known)]
    loads = torch.stack([load for load, _ in columns], 1)
    reaction = loads.new_zeros(*loads.shape, loads.shape[-1])
    for k, (_, change) in enumerate(columns):
        if change is not None:
            reaction[:, k] = change
    return Loads(motion.loads(motion.measured - motion.by_world[0]), loads, reaction, tuple(dry))


def _of_commands(motion: Motion) -> tuple[Tensor, list[Column]]:
    """(T, J, n_action) loads per unit of each command; and the columns of an error of its gain, and of its delay."""
    acting, free = motion.acting, motion.by_world[0]
    units = torch.eye(acting.shape[1]).to(acting)
    response = [motion.loads(motion.acceleration(motion.state, acting + unit) - free) for unit in units]
    columns: list[Column] = []
    for by_unit, command in zip(response, motion.commanded.unbind(1), strict=True):
        columns += [(by_unit * command[:, None], None), (by_unit * motion.rate(command)[:, None], None)]
    return torch.stack(response, -1), columns


def _of_friction(motion: Motion, joint: int, driven: Tensor) -> Iterator[Column]:
    """Of a joint: dry friction (first), the same near rest, that which grows with the `driven` (T,) load; viscous and
    quadratic friction, and a constant load."""
    v = motion.state[:, motion.velocities[joint]]
    slip = v / (SLOW * motion.world.system.states[motion.velocities[joint]].largest)
    sign, near_rest = slip.tanh(), (-(0.2 * slip).square()).exp()
    for each in (sign, sign * near_rest, sign * driven.abs(), v, v * v.abs(), torch.ones_like(v)):
        yield each[:, None] * _on(motion, joint), None


def _of_position(motion: Motion, sliding: Motion, joint: int) -> Iterator[Column]:
    """Of a joint: added inertia; then errors of its position, which are the sensor's zero, and a drive's compliance and
    play. `sliding` is the same motion without dry friction."""
    yield (
        motion.measured[:, joint, None] * _on(motion, joint),
        (_on(motion, joint)[:, None] * motion.by_world[1][:, joint, None, :]),
    )
    position, velocity = motion.world.system.coordinates[joint]
    if position is None:
        return
    state, acting, commanded = motion.state, motion.acting, motion.commanded
    slides = sliding.acceleration(state, acting)
    slopes = [
        (sliding.acceleration(_moved(state, column), acting) - slides) / DIFFERENCE for column in (position, velocity)
    ]
    largest = torch.tensor([action.largest for action in motion.world.system.actions], dtype=state.dtype)
    slack = (commanded / (SLACK * largest)).tanh()
    for error in (torch.ones_like(state[:, 0]), *commanded.unbind(1), *slack.unbind(1)):
        first = motion.rate(error)
        change = -slopes[0] * error[:, None] - slopes[1] * first[:, None]
        yield motion.loads(change + motion.rate(first)[:, None] * _on(motion, joint)), None


def _of_parameters(motion: Motion) -> Iterator[Column]:
    """Of each parameter of the system, per unit of its logarithm."""
    system, joints = motion.world.system, torch.eye(motion.measured.shape[1], dtype=motion.state.dtype)
    plain = motion.by_system()
    for name in scalable(system):
        scaled = motion.by_system(**{name: getattr(system, name) * math.exp(DIFFERENCE)})
        taken = [torch.linalg.solve(g, (motion.measured - free)[..., None])[..., 0] for free, g in (plain, scaled)]
        reaction = (joints - torch.linalg.solve(scaled[1], plain[1])) / DIFFERENCE
        yield (taken[0] - taken[1]) / DIFFERENCE, reaction


def _of_function(motion: Motion, known: SmoothFunction | None) -> Iterator[Column]:
    """Of each bump, or wave, of a function of states, or of a command, that acts as a load."""
    if known is None or known.loads is None:
        return
    if known.states is not None:
        values = motion.state @ known.states
    elif known.command is not None:
        values = motion.commanded[:, known.command]
    else:
        return
    for each in known.basis(values).unbind(-1):
        yield each[:, None] * known.loads, None


def _on(motion: Motion, joint: int) -> Tensor:
    """(J,) a unit load on a joint."""
    return torch.eye(motion.measured.shape[1], dtype=motion.state.dtype)[joint]


def _moved(state: Tensor, column: int) -> Tensor:
    """States (T, n) with one column a little larger."""
    out = state.clone()
    out[:, column] += DIFFERENCE
    return out
