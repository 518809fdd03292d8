"""The start of a policy's feed-forward: the commands that cancel, in the long run, what the residual predicts."""

from __future__ import annotations

import torch
from torch import Tensor

from visadapt.effects import Effect
from visadapt.estimation.linearise import linearise_step
from visadapt.history import HORIZON
from visadapt.policies import Policy
from visadapt.world import World

LASTING_COMMAND, LASTING_ROWS = 0.2, 40
"""Command, and periods that it lasts, by which the gain of a chain of actuation effects is measured."""
LEAST_GAIN = 0.05
"""Gain below which a command counts as lost in a dead zone: dividing by it would ask for more than there is."""


def initialise_feedforward(policy: Policy, source: World, scale: Tensor) -> None:
    """Make the feed-forward cancel the correction that the residual predicts, by least squares about rest.

    Effects with dry friction are left out of the linearisation, as if every joint were moving: at rest, dry friction
    would let no small command through. `scale` (n_state,) is the residual's, the unit of the corrections that the
    policy reads.
    """
    effects = [effect for effect in source.effects if isinstance(effect, Effect)]
    source = source.with_effects([e for e in effects if not e.rubs()])
    rest = torch.zeros(1, policy.n_state, dtype=torch.float64)
    no_command = rest.new_zeros(1, source.substeps, policy.n_action)
    with torch.no_grad():
        values, time = source.values.to(rest), rest[:, 0]
        step = linearise_step(source, values, time, rest, no_command, by_state=False, by_command=True)
        by_command = step.by_command[0] * lasting_gain(source).to(rest)
        cancelling = -torch.linalg.pinv(by_command / scale.to(rest)[:, None])
        policy.feedforward.weight.copy_(cancelling.repeat(HORIZON, 1))


def lasting_gain(source: World) -> Tensor:
    """(n_action,) steady-state gain of the actuation effects: what acts per unit of a constant command.

    Measured after LASTING_ROWS periods of +-LASTING_COMMAND; 1 where its magnitude is at most LEAST_GAIN.
    """
    with torch.no_grad():
        given = LASTING_COMMAND * torch.ones(2, LASTING_ROWS, len(source.system.actions), dtype=torch.float64)
        given[1] *= -1
        acting = source.actuate(given)[:, -1, -1]
    gain = (acting[0] - acting[1]) / (2 * LASTING_COMMAND)
    return torch.where(gain.abs() > LEAST_GAIN, gain, 1.0)
