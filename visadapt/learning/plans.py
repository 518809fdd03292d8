"""Plans of the policy, simulated in the world, so that the gradient of their cost flows back to the policy."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any

import torch
from torch import Tensor

from visadapt.batch import Batch, placed
from visadapt.history import HORIZON, History
from visadapt.learning.streams import Streams, StreamState, sense
from visadapt.learning.transitions import Observe
from visadapt.policies import Policy
from visadapt.world import World, WorldState


@dataclass(frozen=True)
class Visited(Batch):
    """States that streams visited, with all that plans from there need, but without the frames."""

    at: WorldState
    task_state: Tensor  # (B, ...) the task's
    inputs: Tensor  # (B, inputs) of the policy's plan, `Policy.embed`
    expected: Tensor  # (B, n_state) the correction that the policy expects, in units of the residual's scale
    correction: Tensor  # (B, n_state) that the residual made


class Plans:
    """Plans from where the streams are now; the gradient flows through physics, effects, residual and camera.

    Args:
        noise: standard deviation of white noise on what the policy sees.
    """

    def __init__(self, policy: Policy, streams: Streams, noise: float, generator: torch.Generator) -> None:
        self.policy = policy
        self.streams = streams
        self.noise = noise
        self.generator = generator

    def loss(self, iteration: int, progress: float) -> Tensor:
        """The mean cost of the plans; each stream then takes its first planned step. `progress` is the curriculum's."""
        streams, now = self.streams, self.streams.now
        plan = self.policy(self.seen(now.history))
        show = partial(streams.task.show, task_state=now.task_state)
        states, first = imagine(streams.world, streams.observe, now.at, now.history, plan, show, self.generator)
        loss = streams.task.cost(states, plan, now.at.state, now.task_state).mean()
        streams.advance(first, plan[:, 0].detach(), progress, self.generator)
        return loss

    def seen(self, history: History) -> History:
        """The history with noise, as the policy sees it."""
        noise = self.noise * torch.randn(history.observations.shape, generator=self.generator)
        return History(history.observations + noise.to(history.observations), history.actions)

    def tree(self) -> dict[str, Any]:
        """All that plans depend on, as a tree of tensors, for a checkpoint."""
        return {"now": self.streams.now.tree(), "age": self.streams.age}

    def restore(self, tree: dict[str, Any]) -> None:
        """Go on from a `tree`."""
        streams = self.streams
        streams.now, streams.age = StreamState.of(tree["now"]).to(streams.like), placed(tree["age"], streams.like)


class ClosedLoop(Plans):
    """The policy decides anew at every step that is imagined, and the gradient is of the actions that it executes.

    Where a force cannot be foreseen, most of the cost of a plan that is simulated whole comes from its later actions,
    and little of the gradient reaches the first, the only one that is executed on the target. Here the streams go on
    after the last step (Xu et al. 2022, Accelerated policy learning with parallel differentiable simulation, ICLR): no
    simulated step is thrown away, and the next gradient is of other states.
    """

    def loss(self, iteration: int, progress: float) -> Tensor:
        streams, stream = self.streams, self.streams.now
        states: list[Tensor] = []
        actions: list[Tensor] = []
        for _ in range(HORIZON):
            actions.append(self.policy.act(self.seen(stream.history)))
            at = streams.world.step(stream.at, actions[-1], stream.history)
            states.append(at.state)
            stream = streams.after(stream, at, actions[-1], self.generator)
        began = streams.now
        plan = torch.stack(actions, 1)
        loss = streams.task.cost(torch.stack(states, 1), plan, began.at.state, began.task_state).mean()
        streams.continue_from(stream, HORIZON, progress, self.generator)
        return loss


class ReplayedPlans(Plans):
    """Plans from states drawn from all that the streams visited: few steps are simulated and few frames rendered.

    The gradient flows through physics and effects alone: the residual's correction is held over a plan, and no frame is
    rendered along it.

    Args:
        batch: plans drawn in an iteration.
        every: iterations between two steps of the streams.
    """

    def __init__(
        self, policy: Policy, streams: Streams, noise: float, generator: torch.Generator, batch: int, every: int
    ) -> None:
        super().__init__(policy, streams, noise, generator)
        self.batch = batch
        self.every = every
        self.past: Visited | None = None

    def loss(self, iteration: int, progress: float) -> Tensor:
        """The mean cost of the plans; in one iteration of every `every` the streams take a step first."""
        streams = self.streams
        if iteration % self.every == 0:
            visited, action, first = visit(self.policy, streams.world, streams.now, self.seen(streams.now.history))
            self.past = visited if self.past is None else self.past.joined(visited)
            streams.advance(first, action, progress, self.generator)
        assert self.past is not None
        drawn = self.past[torch.randint(len(self.past.inputs), (self.batch,), generator=self.generator)]
        plan = self.policy.decide(drawn.inputs, drawn.expected)
        states, _ = imagine(streams.world, None, drawn.at, None, plan, correction=drawn.correction)
        return streams.task.cost(states, plan, drawn.at.state, drawn.task_state).mean()

    def tree(self) -> dict[str, Any]:
        return super().tree() if self.past is None else {**super().tree(), "past": self.past.tree()}

    def restore(self, tree: dict[str, Any]) -> None:
        super().restore(tree)
        self.past = Visited.of(tree["past"]).to(self.streams.like)


def imagine(
    world: World,
    observe: Observe | None,
    at: WorldState,
    history: History | None,
    plan: Tensor,
    show: Callable[[Tensor], Tensor] = lambda seen: seen,
    generator: torch.Generator | None = None,
    correction: Tensor | None = None,
) -> tuple[Tensor, WorldState]:
    """Simulate a plan (B, K, n_action): the states that follow (B, K, n_state), and the world after the first step.

    Args:
        observe: the camera; None where the sensors' measurements are seen.
        at: where the plan begins; the sensors have read this row, but not yet that of the world returned.
        show: appends to an observation what the task shows beside it, such as a goal.
        generator: for random sensing effects.
        correction: (B, n_state), held over the plan in the place of the residual's, which then needs no history.
    """
    states = []
    first = at
    for k in range(plan.shape[1]):
        at = world.step(at, plan[:, k], history, correction)
        states.append(at.state)
        if k == 0:
            first = at
        if history is not None and world.has_residual and k + 1 < plan.shape[1]:
            seen, at = sense(world, observe, at, generator)
            history = history.acting(plan[:, k]).observing(show(seen))
    return torch.stack(states, 1), first


@torch.no_grad()
def visit(policy: Policy, world: World, stream: StreamState, shown: History) -> tuple[Visited, Tensor, WorldState]:
    """What is kept of the streams, the action (B, n_action) that the policy takes, and the world after it.

    `shown` is the history of the streams as the policy sees it, with noise.
    """
    inputs, expected = policy.embed(shown), policy.correction(shown)
    action = policy.decide(inputs, expected)[:, 0]
    correction = torch.zeros_like(stream.at.state)
    if world.has_residual:
        correction = world.correction(action, stream.history)
    visited = Visited(stream.at, stream.task_state, inputs, expected, correction)
    return visited, action, world.step(stream.at, action, correction=correction)
