"""Policy learning by backpropagation through a world: the inner loop of Algorithm 1 and equation 11.

A batch of simulated streams runs under the policy. At each iteration the policy plans K actions, the world
(physics, effects, residual, renderer) carries them out, and the gradient of the cost flows back through all of it.
Then every stream takes the first planned step. A stream further than delta_div from the reference starts anew, and
delta_div grows as training goes on, so the policy learns to recover from ever further off.

Where what streams pass through is kept (`TuneSettings.streams`), the gradient flows through physics and effects alone:
the residual's correction is held over a plan, and no frame is rendered along it. The feed-forward stays as it is: what
is tuned sees a noisy correction beside the one that acts, and would learn to oppose less than all of it.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import torch
from torch import Tensor

from visadapt.estimation.linearise import linearise_step
from visadapt.history import HORIZON, History
from visadapt.learning.streams import Streams, StreamState, Visited, look
from visadapt.learning.training_state import TrainingState
from visadapt.learning.windows import Observe, Windows
from visadapt.policies import Policy
from visadapt.progress import Progress
from visadapt.tasks.base import Task
from visadapt.world import World, WorldState


class DivergedError(RuntimeError):
    """The loss is not finite; the message says at which iteration."""


@dataclass(frozen=True)
class TuneSettings:
    """How a policy is trained in a world."""

    task: Task
    iterations: int
    batch: int = 64
    learning_rate: float = 1e-3
    longest: int = 150  # steps after which a stream starts anew
    streams: int | None = None
    """number of streams where that is not `batch`: what they pass through is then kept, and each batch is drawn from
    all of it, so that few steps are simulated and few frames rendered; a policy's encoder and feed-forward stay as they
    are, and the residual's correction is constant over a plan"""
    every: int = 1  # iterations between two steps of the streams
    curriculum: bool = True
    """whether streams start, and are kept, closer to the reference at first; not for a trained policy"""
    recorded: float = 0.0  # share of the starts that are recorded windows of the target, with their histories
    observation_noise: float = 0.01  # standard deviation of white noise on what the policy sees


def initialise_feedforward(policy: Policy, source: World, scale: Tensor) -> None:
    """Make the feed-forward cancel the correction that the residual predicts, by least squares about rest.

    `scale` (n_state,) is the residual's, the unit of the corrections that the policy reads.
    """
    rest = torch.zeros(1, policy.n_state, dtype=torch.float64, device=scale.device)
    still = rest.new_zeros(1, source.substeps, policy.n_action)
    with torch.no_grad():
        step = linearise_step(source, source.values.to(rest), rest[:, 0], rest, still, by_state=False, by_command=True)
        undo = -torch.linalg.pinv(step.by_command[0] / scale.to(rest)[:, None])
        policy.feedforward.weight.copy_(undo.repeat(HORIZON, 1))


def tune(
    policy: Policy,
    world: World,
    observe: Observe | None,
    settings: TuneSettings,
    generator: torch.Generator,
    windows: Windows | None = None,
    progress: Progress | None = None,
    checkpoint: Path | None = None,
) -> list[float]:
    """Train `policy` in `world`, in place; returns the loss of every iteration.

    Args:
        observe: the camera through which the policy sees, differentiable for the sake of a residual that reads frames;
            None for a policy on states, which sees what the world's sensors measure.
        windows: recorded starts, where settings.recorded asks for them, and the times at which other starts begin.
        checkpoint: file of the training state, written every so often and resumed from.

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
    task = settings.task
    count = settings.streams or settings.batch
    streams = Streams(world, task, observe, windows, count, settings.longest, settings.recorded)
    past: Visited | None = None
    kept = training.resume()
    if kept is not None:
        streams.now, streams.age = StreamState.of(kept["now"]), kept["age"]
        past = Visited.of(kept["past"]) if "past" in kept else None
    else:
        streams.start(0.0 if settings.curriculum else 1.0, generator)
    policy.train()
    for iteration in range(len(training.losses), steps):
        done = iteration / steps if settings.curriculum else 1.0
        stream = streams.now
        shown = stream.history
        if settings.streams is None or iteration % settings.every == 0:
            noise = settings.observation_noise * torch.randn(shown.observations.shape, generator=generator)
            shown = History(shown.observations + noise.to(shown.observations), shown.actions)
        if settings.streams is None:
            plan = policy(shown)
            show = partial(task.show, task_state=stream.task_state)
            states, first = imagine(world, observe, stream.at, stream.history, plan, show, generator)
            loss = task.cost(states, plan, stream.at.state, stream.task_state).mean()
        else:
            if iteration % settings.every == 0:
                visited, action, first = visit(policy, world, stream, shown)
                past = visited if past is None else past.joined(visited)
                streams.advance(first, action, done, generator)
            assert past is not None
            drawn = past[torch.randint(len(past.inputs), (settings.batch,), generator=generator)]
            plan = policy.decide(drawn.inputs, drawn.expected)
            states = held(world, drawn.at, plan, drawn.correction)
            loss = task.cost(states, plan, drawn.at.state, drawn.task_state).mean()
        if not bool(loss.isfinite()):
            raise DivergedError(f"the policy's loss is {float(loss.detach())} at iteration {iteration}")
        training.descend(loss)
        if settings.streams is None:
            streams.advance(first, plan[:, 0].detach(), done, generator)
        kept = {"now": streams.now.tree(), "age": streams.age}
        training.keep(kept if past is None else {**kept, "past": past.tree()})
    policy.eval()
    return training.losses


def imagine(
    world: World,
    observe: Observe | None,
    at: WorldState,
    history: History,
    plan: Tensor,
    show: Callable[[Tensor], Tensor] = lambda seen: seen,
    generator: torch.Generator | None = None,
) -> tuple[Tensor, WorldState]:
    """Carry out a plan (B, K, n_action): the states that follow (B, K, n_state), and the world after the first step.

    Args:
        observe: the camera; None where the sensors' measurements are seen.
        at: where the plan begins, its row read; that of the world returned is not.
        show: adds to what is seen what the task shows beside it.
        generator: for random sensing effects.
    """
    states = []
    first = at
    for k in range(plan.shape[1]):
        at = world.step(at, plan[:, k], history)
        states.append(at.state)
        if k == 0:
            first = at
        if world.has_residual and k + 1 < plan.shape[1]:
            seen, at = look(world, observe, at, generator)
            history = history.acting(plan[:, k]).observing(show(seen))
    return torch.stack(states, 1), first


@torch.no_grad()
def visit(policy: Policy, world: World, stream: StreamState, shown: History) -> tuple[Visited, Tensor, WorldState]:
    """What is kept of a stream, the action (B, n_action) that the policy takes, and the world after it.

    `shown` is the stream's history with what the policy sees instead of it, noise included.
    """
    inputs, expected = policy.embed(shown), policy.correction(shown)
    action = policy.decide(inputs, expected)[:, 0]
    correction = torch.zeros_like(stream.at.state)
    if world.has_residual:
        correction = world.correction(action, stream.history)
    visited = Visited(stream.at, stream.task_state, inputs, expected, correction)
    return visited, action, world.step(stream.at, action, correction=correction)


def held(world: World, at: WorldState, plan: Tensor, correction: Tensor) -> Tensor:
    """The states (B, K, n_state) that follow a plan (B, K, n_action) under a constant correction (B, n_state)."""
    states = []
    for k in range(plan.shape[1]):
        at = world.step(at, plan[:, k], correction=correction)
        states.append(at.state)
    return torch.stack(states, 1)
