"""Policy learning by backpropagation through a world: the inner loop of Algorithm 1 and equation 11.

A batch of simulated streams runs under the policy. At each iteration the policy plans K actions, the world
(physics, effects, residual, renderer) carries them out, and the gradient of the cost flows back through all of it; or,
in closed loop, the policy decides anew at each of K steps. Each stream then moves on by the first of the K steps or, in
closed loop, by all K. A stream further than delta_div from the reference starts anew, and delta_div grows as training
goes on, so the policy learns to recover from ever further off.

Where visited states are kept (`TuneSettings.streams`, `ReplayedPlans`), the feed-forward is not tuned: it reads a noisy
estimate of the correction that acts, and would learn to oppose only a part of it.
"""

from __future__ import annotations

from dataclasses import dataclass, is_dataclass
from pathlib import Path

import torch

from visadapt.learning.plans import ClosedLoop, Plans, ReplayedPlans
from visadapt.learning.streams import Streams
from visadapt.learning.training_state import TrainingState
from visadapt.learning.transitions import Observe, Transitions
from visadapt.policies import Policy
from visadapt.progress import Progress
from visadapt.tasks.base import Task
from visadapt.world import World


class DivergedError(RuntimeError):
    """The loss is not finite; the message says at which iteration."""


@dataclass(frozen=True)
class TuneSettings:
    """How a policy is trained in a world.

    Raises:
        TypeError: the task is no dataclass, so it could not be kept in a policy's file.
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
        task: object = self.task  # of the user's, so perhaps no Task either
        if not is_dataclass(task):
            raise TypeError(
                f"task: {type(task).__name__} is no frozen dataclass: write @dataclass(frozen=True) above it"
            )
        if self.closed_loop and self.streams is not None:
            raise ValueError(f"closed_loop decides at every step, so no states are kept: got streams = {self.streams}")


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
    return ReplayedPlans(*given, settings.batch, settings.every)


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
