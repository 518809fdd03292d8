"""Policy learning by backpropagation through a world: the inner loop of Algorithm 1 and equation 11.

A batch of simulated streams runs under the policy. At each iteration the policy plans K actions, the world
(physics, effects, residual, renderer) carries them out, and the gradient of the cost flows back through all of it.
Then every stream takes the first planned step. A stream that strays further than delta_div from the reference
starts anew, and delta_div grows as training goes on, so the policy learns to recover from ever further off.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from visadapt.console import Progress
from visadapt.history import History
from visadapt.learning.resume import EVERY, Training
from visadapt.learning.tasks import Task
from visadapt.learning.windows import Observe, Windows
from visadapt.policies import HORIZON, Policy
from visadapt.world import World, WorldState


class DivergedError(RuntimeError):
    """Training left the numbers: the message says where."""


@dataclass(frozen=True)
class TuneSettings:
    """How a policy is trained in a world."""

    task: Task
    iterations: int
    batch: int = 64
    learning_rate: float = 1e-3
    longest: int = 150
    """steps after which a stream starts anew"""
    moving: int | None = None
    """streams, drawn anew, that take a step in each iteration; the others stay, and are learnt from again: where steps
    are counted. Without it, all move"""
    recorded: float = 0.0
    """share of the starts that are recorded windows of the target, histories and all"""
    observation_noise: float = 0.01
    """standard deviation of white noise on what the policy sees"""


class Streams:
    """A batch of simulated episodes in progress."""

    def __init__(self, world: World, observe: Observe, windows: Windows | None, settings: TuneSettings) -> None:
        self.world = world
        self.observe = observe
        self.windows = windows
        self.settings = settings
        self.task = settings.task
        self.at: WorldState
        self.history: History
        self.place: Tensor
        self.age: Tensor

    def show(self, state: Tensor) -> Tensor:
        """What the policy is shown of states (B, n_state) where the streams are now."""
        return self.task.show(self.observe(state), self.place)

    @torch.no_grad()
    def start(self, generator: torch.Generator) -> None:
        """Start all streams, at random ages, so that they do not end together."""
        self.at, self.history, self.place = self._fresh(0.0, generator)
        self.age = torch.randint(self.settings.longest, (self.settings.batch,), generator=generator)

    @torch.no_grad()
    def advance(self, at: WorldState, action: Tensor, progress: float, generator: torch.Generator) -> None:
        """Take the step to `at` under `action`; restart what strayed. `progress` in [0, 1] drives the curriculum."""
        before = self.at, self.history, self.place, self.age.clone()
        state = self.task.disturb(at.state, generator)
        self.at = WorldState(at.time, state, at.memory).detach()
        self.place = self.task.onward(self.place)
        self.history = self.history.acting(action).observing(self.show(state)).detach()
        self.age += 1
        self._hold(before, generator)
        keep = (self.age < self.settings.longest) & ~self.task.astray(self.at.state, self.place, progress)
        if not bool(keep.all()):
            at, history, place = self._fresh(progress, generator)
            self.at = self.at.where(keep, at)
            self.history = self.history.where(keep, history)
            self.place = torch.where(keep.reshape(-1, *[1] * (place.dim() - 1)), self.place, place)
            self.age = torch.where(keep, self.age, 0)

    def kept(self) -> dict[str, Any]:
        """All that `restore` needs."""
        return {
            "time": self.at.time,
            "state": self.at.state,
            "memory": list(self.at.memory),
            "observations": self.history.observations,
            "actions": self.history.actions,
            "place": self.place,
            "age": self.age,
        }

    def restore(self, kept: dict[str, Any]) -> None:
        """Go on from what `kept` gave."""
        self.at = WorldState(kept["time"], kept["state"], tuple(kept["memory"]))
        self.history = History(kept["observations"], kept["actions"])
        self.place = kept["place"]
        self.age = kept["age"]

    def _hold(self, before: tuple[WorldState, History, Tensor, Tensor], generator: torch.Generator) -> None:
        """Put all streams back but those that move."""
        if self.settings.moving is None:
            return
        moved = torch.zeros(self.settings.batch, dtype=torch.bool)
        moved[torch.randperm(self.settings.batch, generator=generator)[: self.settings.moving]] = True
        at, history, place, age = before
        self.at, self.history = self.at.where(moved, at), self.history.where(moved, history)
        self.place = torch.where(moved.reshape(-1, *[1] * (place.dim() - 1)), self.place, place)
        self.age = torch.where(moved, self.age, age)

    def _fresh(self, progress: float, generator: torch.Generator) -> tuple[WorldState, History, Tensor]:
        settings = self.settings
        state, place = self.task.begin(settings.batch, progress, generator)
        history = History.start(self.task.show(self.observe(state), place), len(self.world.system.actions))
        windows = self.windows
        if windows is not None and settings.recorded > 0:
            # A fall on record is beyond delta_div; starting from it would drown what can be learnt.
            near = (~self.task.astray(windows.state, place, progress)).nonzero()[:, 0]
            if len(near):
                from_record = torch.rand(settings.batch, generator=generator) < settings.recorded
                rows = near[torch.randint(len(near), (settings.batch,), generator=generator)]
                state = torch.where(from_record[:, None], windows.state[rows], state)
                history = windows.history(rows).where(from_record, history)
        return self.world.start(state), history, place


def oppose(policy: Policy, source: World, scale: Tensor) -> None:
    """Let the feed-forward undo what the residual expects, as far as commands can: least squares about rest.

    `scale` (n_state,) is the residual's, in whose units the policy hears corrections.
    """
    rest = source.start(torch.zeros(1, policy.n_state).to(scale))
    still = torch.zeros(1, policy.n_action).to(scale)
    push = torch.autograd.functional.jacobian(lambda action: source.step(rest, action).state[0], still)[:, 0]
    with torch.no_grad():
        policy.feedforward.weight.copy_(-torch.linalg.pinv(push / scale[:, None]).repeat(HORIZON, 1))


def tune(
    policy: Policy,
    world: World,
    observe: Observe,
    settings: TuneSettings,
    generator: torch.Generator,
    windows: Windows | None = None,
    progress: Progress | None = None,
    checkpoint: Path | None = None,
) -> list[float]:
    """Train `policy` in `world`, in place; returns the loss of every iteration.

    Args:
        observe: what the policy sees of a state; differentiable, it passes the gradient to a residual that looks.
        windows: recorded starts, where settings.recorded asks for them.
        checkpoint: where the training state is kept now and then and taken up again from.

    Raises:
        DivergedError: the loss is not finite.
    """
    world.requires_grad_(False)
    optimiser = torch.optim.Adam(policy.parameters())
    schedule = torch.optim.lr_scheduler.OneCycleLR(
        optimiser, settings.learning_rate, total_steps=settings.iterations, pct_start=0.1
    )
    training = Training(policy, optimiser, schedule, generator)
    streams = Streams(world, observe, windows, settings)
    losses: list[float] = []
    if checkpoint is not None and checkpoint.exists():
        losses, kept = training.resume(checkpoint)
        streams.restore(kept)
    else:
        streams.start(generator)
    policy.train()
    for iteration in range(len(losses), settings.iterations):
        noise = settings.observation_noise * torch.randn(streams.history.observations.shape, generator=generator)
        seen = History(streams.history.observations + noise.to(streams.history.observations), streams.history.actions)
        plan = policy(seen)
        states, first = imagine(world, streams.show, streams.at, streams.history, plan)
        loss = settings.task.cost(states, plan, streams.at.state, streams.place).mean()
        if not bool(loss.isfinite()):
            raise DivergedError(f"the policy's loss is {float(loss.detach())} at iteration {iteration}")
        optimiser.zero_grad()
        loss.backward()
        nn.utils.clip_grad_norm_(policy.parameters(), 1.0)
        optimiser.step()
        schedule.step()
        streams.advance(first, plan[:, 0].detach(), iteration / settings.iterations, generator)
        losses.append(float(loss.detach()))
        if progress is not None:
            progress(iteration + 1, settings.iterations, losses[-1])
        if checkpoint is not None and (iteration + 1) % EVERY == 0:
            training.keep(checkpoint, losses, streams.kept())
    policy.eval()
    return losses


def imagine(
    world: World, observe: Observe, at: WorldState, history: History, plan: Tensor
) -> tuple[Tensor, WorldState]:
    """Carry out a plan (B, K, n_action): the states that follow (B, K, n_state), and the world after the first step."""
    states = []
    first = at
    for k in range(plan.shape[1]):
        at = world.step(at, plan[:, k], history)
        states.append(at.state)
        if k == 0:
            first = at
        if world.has_residual and k + 1 < plan.shape[1]:
            history = history.acting(plan[:, k]).observing(observe(at.state))
    return torch.stack(states, 1), first
