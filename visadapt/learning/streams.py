"""Simulated episodes in progress, in which a policy is trained."""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from visadapt.batch import Batch, placed
from visadapt.history import History
from visadapt.learning.transitions import Observe, Transitions
from visadapt.tasks.base import FlightTask, Task
from visadapt.world import World, WorldState

PROBE_COMMAND = 0.5
"""Under it a world is tested for a dependence on time: not zero, since some effects scale commands."""


@dataclass(frozen=True)
class StreamState(Batch):
    """The state of B streams: all that is needed to simulate on from here."""

    at: WorldState
    history: History
    task_state: Tensor  # (B, ...) the task's


@dataclass
class Streams:
    """A batch of simulated episodes in progress."""

    world: World
    task: Task
    observe: Observe | None  # the camera through which the policy sees; None where it sees what the sensors measure
    transitions: Transitions | None  # recorded starts, each at its time, with the memory that effects have there
    count: int
    longest: int  # steps after which a stream starts anew
    recorded_share: float  # share of the starts that are transitions, with their histories
    like: Tensor  # whose device and dtype the streams have

    def __post_init__(self) -> None:
        self.now: StreamState
        self.age: Tensor
        """(count,) steps since the stream's start"""
        self._recorded_starts: WorldState | None = None
        """the world at every transition; None where no stream starts from one"""
        self.task = self.task.to(self.like)
        if self.transitions is not None:
            self.transitions = self.transitions.to(self.like)
        with torch.no_grad():
            if self.transitions is None:
                times, state = episode_times_and_start(self.world, self.task)
            else:
                times, state = self.transitions.time, self.transitions.state[:1]
                # Without the progress of its task, where a flight is to go from a recorded state is not known.
                known = not isinstance(self.task, FlightTask) or self.transitions.task_states.shape[-1] > 0
                if self.recorded_share > 0 and known:
                    self._recorded_starts = self.transitions.start(self.world)
            self._start_times = times if depends_on_time(self.world, times.unique(), state) else None
            """(T,) s from the start of an episode, of which streams begin at one; None where the world is the same at
            all times"""

    @torch.no_grad()
    def start(self, progress: float, generator: torch.Generator) -> None:
        """Start all streams, at random ages, so that they do not end together."""
        self.now = self._fresh(torch.arange(self.count).to(self.like.device), progress, generator)
        self.age = torch.randint(self.longest, (self.count,), generator=generator).to(self.like.device)

    @torch.no_grad()
    def advance(self, at: WorldState, action: Tensor, progress: float, generator: torch.Generator) -> None:
        """Take the step to `at`, whose row the sensors have not read yet, under `action`; then `continue_from` it."""
        self.continue_from(self.after(self.now, at, action, generator), 1, progress, generator)

    def after(self, stream: StreamState, at: WorldState, action: Tensor, generator: torch.Generator) -> StreamState:
        """The streams after a step from `stream` to `at`, whose row the sensors have not read yet, under `action`."""
        at = replace(at, state=self.task.disturb(at.state, generator))
        task_state = self.task.advance(stream.task_state)
        seen, at = sense(self.world, self.observe, at, generator)
        history = stream.history.acting(action).observing(self.task.show(seen, task_state))
        return StreamState(at, history, task_state)

    @torch.no_grad()
    def continue_from(self, stream: StreamState, steps: int, progress: float, generator: torch.Generator) -> None:
        """Continue from `stream`, which is `steps` later than now, without gradients.

        Streams that have diverged, or have taken `longest` steps, start anew. `progress` in [0, 1] drives the
        curriculum.
        """
        self.now = stream.detach()
        self.age += steps
        keep = (self.age < self.longest) & ~self.task.diverged(stream.at.state, stream.task_state, progress)
        ended = (~keep).nonzero()[:, 0]
        if len(ended):
            self.now = self.now.replaced(ended, self._fresh(ended, progress, generator))
            self.age[ended] = 0

    def _fresh(self, ended: Tensor, progress: float, generator: torch.Generator) -> StreamState:
        """New starts for the streams `ended`: drawn for all streams, but only these are rendered."""
        state, task_state = self.task.training_start(self.count, progress, generator)
        state, task_state = placed(state, self.like)[ended], placed(task_state, self.like)[ended]
        at = self.world.start(state)
        if self._start_times is not None:
            # Streams are shorter than episodes: if all began at time 0, none would meet a late gust, or all phases of a
            # slow force. So they begin at the times of recorded samples, or, without a recording, at any time of an
            # episode.
            times = self._start_times[torch.randint(len(self._start_times), (self.count,), generator=generator)]
            at = replace(at, time=times.to(state)[ended])
        seen, at = sense(self.world, self.observe, at, generator)
        history = History.start(self.task.show(seen, task_state), len(self.world.system.actions))
        return self._some_recorded(StreamState(at, history, task_state), ended, progress, generator)

    def _some_recorded(
        self, fresh: StreamState, ended: Tensor, progress: float, generator: torch.Generator
    ) -> StreamState:
        """`fresh` starts for the streams `ended`, of which `recorded_share` are replaced by recorded transitions."""
        transitions = self.transitions
        if transitions is None or self._recorded_starts is None:
            return fresh
        task_states = transitions.task_states[transitions.rows].to(fresh.task_state)
        # Recorded falls are left out: a stream that starts beyond delta_div ends at once, at a cost above all others.
        near = (~self.task.diverged(transitions.state, task_states[:, -1], progress)).nonzero()[:, 0]
        if not len(near):
            return fresh
        is_recorded = torch.rand(self.count, generator=generator).to(fresh.at.state)[ended] < self.recorded_share
        chosen = near[torch.randint(len(near), (self.count,), generator=generator)][ended]
        past = transitions.history(chosen)
        observed, state, task_state = self.task.augment(
            past.observations, transitions.state[chosen], task_states[chosen], generator
        )
        shown = self.task.show(observed.flatten(0, 1), task_state.flatten(0, 1)).unflatten(0, observed.shape[:2])
        # The history ends with the recorded reading of this row, so the sensors have read it.
        _, at = sense(self.world, self.observe, replace(self._recorded_starts[chosen], state=state), generator)
        return StreamState(at, History(shown, past.actions), task_state[:, -1]).where(is_recorded, fresh)


def sense(
    world: World, observe: Observe | None, at: WorldState, generator: torch.Generator | None
) -> tuple[Tensor, WorldState]:
    """What is observed (B, ...) at the row `at`, and the world after that row was read.

    With a camera, `observe`: the frames of the true states, altered by the world's camera effects. Without one (None):
    what the sensors measure.
    """
    return world.measure(at, generator) if observe is None else world.show(at, observe, generator)


def episode_times_and_start(world: World, task: Task) -> tuple[Tensor, Tensor]:
    """Times (T,), in s, of the rows of an episode, and a state (1, n_state) in which one may start."""
    state, _ = task.training_start(1, 0.0, torch.Generator().manual_seed(0))
    return (world.period * torch.arange(task.episode_steps(world.period))).to(state), state


def depends_on_time(world: World, time: Tensor, state: Tensor) -> bool:
    """Whether a step from the state (1, n_state) under one command differs between the times (T,) in s."""
    state = state.expand(len(time), -1)
    command = torch.full((len(time), world.substeps, len(world.system.actions)), PROBE_COMMAND).to(state)
    after = world.integrate(time, state, command)
    return not torch.allclose(after, after[:1], rtol=1e-5, atol=1e-6)
