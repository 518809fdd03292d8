"""Policy learning by backpropagation through a world: the inner loop of Algorithm 1 and equation 11.

A batch of simulated streams runs under the policy. At each iteration the policy plans K actions, the world
(physics, effects, residual, renderer) carries them out, and the gradient of the cost flows back through all of it; or,
in closed loop, the policy decides anew at each of K steps. Each stream then moves on by the first of the K steps or, in
closed loop, by all K. A stream further than delta_div from the reference starts anew, and delta_div grows as training
goes on, so the policy learns to recover from ever further off.

Where visited states are kept (`TuneSettings.streams`, `KeptPlans`), the feed-forward is not tuned: it reads a noisy
estimate of the correction that acts, and would learn to oppose only a part of it.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor

from visadapt.effects import DynamicsEffect, Effect
from visadapt.estimation.linearise import linearise_step
from visadapt.history import HORIZON
from visadapt.learning.plans import ClosedLoop, KeptPlans, Plans
from visadapt.learning.streams import Streams
from visadapt.learning.training_state import TrainingState
from visadapt.learning.transitions import Observe, Transitions
from visadapt.policies import Policy
from visadapt.progress import Progress
from visadapt.tasks.base import Task
from visadapt.world import World

LASTING_COMMAND, LASTING_ROWS = 0.2, 40
"""Command, and periods that it lasts, by which the gain of a chain of actuation effects is measured."""
LEAST_GAIN = 0.05
"""Gain below which a command counts as lost in a dead zone: dividing by it would ask for more than there is."""


class DivergedError(RuntimeError):
    """The loss is not finite; the message says at which iteration."""


@dataclass(frozen=True)
class TuneSettings:
    """How a policy is trained in a world.

    Raises:
        ValueError: `closed_loop` with `streams`, whose visited states are kept to be planned from.
    """

    task: Task
    iterations: int
    batch: int = 64
    learning_rate: float = 1e-3
    longest: int = 150  # steps after which a stream starts anew
    streams: int | None = None
    """number of streams, whose visited states are kept and each batch drawn from them: few steps are simulated and few
    frames rendered, but a policy's encoder and feed-forward are not tuned, and the residual's correction is constant
    over a plan; None: as many as `batch`, and nothing is kept"""
    every: int = 1  # iterations between two steps of the streams
    closed_loop: bool = False
    """whether the policy decides anew at every step that is imagined; False: its plan is simulated whole"""
    curriculum: bool = True
    """whether streams start closer to the reference, and restart closer to it, early on; False for a trained policy"""
    recorded: float = 0.0  # share of the starts that are recorded transitions of the target, with their histories
    observation_noise: float = 0.01  # standard deviation of white noise on what the policy sees

    def __post_init__(self) -> None:
        if self.closed_loop and self.streams is not None:
            raise ValueError(f"closed_loop decides at every step, so no states are kept: got streams = {self.streams}")


def initialise_feedforward(policy: Policy, source: World, scale: Tensor) -> None:
    """Make the feed-forward cancel the correction that the residual predicts, by least squares about rest.

    Effects with dry friction are left out of the linearisation, as if every joint were moving: at rest, dry friction
    would let no small command through. `scale` (n_state,) is the residual's, the unit of the corrections that the
    policy reads.
    """
    effects = [effect for effect in source.effects if isinstance(effect, Effect)]
    source = source.with_effects([e for e in effects if not (isinstance(e, DynamicsEffect) and e.rubs())])
    rest = torch.zeros(1, policy.n_state, dtype=torch.float64)
    still = rest.new_zeros(1, source.substeps, policy.n_action)
    with torch.no_grad():
        step = linearise_step(source, source.values.to(rest), rest[:, 0], rest, still, by_state=False, by_command=True)
        by_command = step.by_command[0] * lasting_gain(source).to(rest)
        undo = -torch.linalg.pinv(by_command / scale.to(rest)[:, None])
        policy.feedforward.weight.copy_(undo.repeat(HORIZON, 1))


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


def plans_of(
    policy: Policy,
    world: World,
    observe: Observe | None,
    settings: TuneSettings,
    generator: torch.Generator,
    transitions: Transitions | None,
) -> Plans:
    """Plans as `tune` makes them, with its arguments; their streams are not started yet."""
    count = settings.streams or settings.batch
    like, longest = next(policy.parameters()), settings.longest
    streams = Streams(world, settings.task, observe, transitions, count, longest, settings.recorded, like)
    given = (policy, streams, settings.observation_noise, generator)
    if settings.closed_loop:
        return ClosedLoop(*given)
    if settings.streams is None:
        return Plans(*given)
    return KeptPlans(*given, settings.batch, settings.every)


def tune(
    policy: Policy,
    world: World,
    observe: Observe | None,
    settings: TuneSettings,
    generator: torch.Generator,
    transitions: Transitions | None = None,
    progress: Progress | None = None,
    checkpoint: Path | None = None,
) -> list[float]:
    """Train `policy` in `world`, in place, on its device; returns the loss of every iteration.

    Args:
        observe: the camera through which the policy sees, differentiable, since a residual may read its frames; None
            for a policy on states, which sees what the world's sensors measure.
        transitions: recorded starts, where settings.recorded asks for them, and the times at which other starts begin.
        checkpoint: file of the training state, from which an interrupted training goes on; None: none is written.

    Raises:
        DivergedError: the loss is not finite.
    """
    if not settings.iterations:
        return []
    world.requires_grad_(False)
    policy.feedforward.requires_grad_(settings.streams is None)
    optimiser = torch.optim.Adam(policy.parameters())
    steps = settings.iterations
    training = TrainingState(policy, optimiser, generator, settings.learning_rate, steps, progress, checkpoint)
    plans = plans_of(policy, world, observe, settings, generator, transitions)
    kept = training.resume()
    if kept is not None:
        plans.restore(kept)
    else:
        plans.streams.start(0.0 if settings.curriculum else 1.0, generator)
    policy.train()
    for iteration in range(len(training.losses), steps):
        loss = plans.loss(iteration, iteration / steps if settings.curriculum else 1.0)
        if not bool(loss.isfinite()):
            raise DivergedError(f"the policy's loss is {float(loss.detach())} at iteration {iteration}")
        training.descend(loss)
        training.keep(plans.tree())
    policy.eval()
    return training.losses
