"""Simulated episodes in progress, in which a policy is trained."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Self

import torch
from torch import Tensor

from visadapt.history import History
from visadapt.learning.windows import Observe, Windows
from visadapt.tasks.base import Task
from visadapt.world import World, WorldState


@dataclass(frozen=True)
class StreamState:
    """Where streams are: all that imagining on from there needs."""

    at: WorldState
    history: History
    place: Tensor
    """(B, ...) the task's"""

    def where(self, keep: Tensor, other: StreamState) -> StreamState:
        """This stream in the rows where `keep` (B,) holds, `other` in the rest."""
        place = torch.where(keep.reshape(-1, *[1] * (self.place.dim() - 1)), self.place, other.place)
        return StreamState(self.at.where(keep, other.at), self.history.where(keep, other.history), place)

    def __getitem__(self, rows: Tensor) -> StreamState:
        return StreamState(self.at[rows], self.history[rows], self.place[rows])

    def joined(self, other: StreamState) -> StreamState:
        """This stream and, after it, another."""
        return StreamState(
            self.at.joined(other.at), self.history.joined(other.history), torch.cat((self.place, other.place))
        )

    def tree(self) -> dict[str, Any]:
        """All of it, to be kept in a file."""
        return {
            "time": self.at.time,
            "state": self.at.state,
            "memory": list(self.at.memory),
            "observations": self.history.observations,
            "actions": self.history.actions,
            "place": self.place,
        }

    @classmethod
    def of(cls, tree: dict[str, Any]) -> Self:
        """From what `tree` gave."""
        at = WorldState(tree["time"], tree["state"], tuple(tree["memory"]))
        return cls(at, History(tree["observations"], tree["actions"]), tree["place"])


@dataclass(frozen=True)
class StreamSettings:
    """How streams run."""

    count: int
    longest: int
    """steps after which a stream starts anew"""
    recorded: float
    """share of the starts that are recorded windows of the target, histories and all"""


class Streams:
    """A batch of simulated episodes in progress."""

    def __init__(
        self, world: World, task: Task, observe: Observe, windows: Windows | None, settings: StreamSettings
    ) -> None:
        self.world = world
        self.task = task
        self.observe = observe
        self.windows = windows
        self.settings = settings
        self.now: StreamState
        self.age: Tensor

    def show(self, state: Tensor, place: Tensor) -> Tensor:
        """What the policy is shown of states (B, n_state) at places."""
        return self.task.show(self.observe(state), place)

    @torch.no_grad()
    def start(self, progress: float, generator: torch.Generator) -> None:
        """Start all streams, at random ages, so that they do not end together."""
        self.now = self._fresh(progress, generator)
        self.age = torch.randint(self.settings.longest, (self.settings.count,), generator=generator)

    @torch.no_grad()
    def advance(self, at: WorldState, action: Tensor, progress: float, generator: torch.Generator) -> None:
        """Take the step to `at` under `action`; restart what strayed. `progress` in [0, 1] drives the curriculum."""
        state = self.task.disturb(at.state, generator)
        place = self.task.advance(self.now.place)
        history = self.now.history.acting(action).observing(self.show(state, place)).detach()
        self.now = StreamState(WorldState(at.time, state, at.memory).detach(), history, place)
        self.age += 1
        keep = (self.age < self.settings.longest) & ~self.task.diverged(state, place, progress)
        if not bool(keep.all()):
            self.now = self.now.where(keep, self._fresh(progress, generator))
            self.age = torch.where(keep, self.age, 0)

    def _fresh(self, progress: float, generator: torch.Generator) -> StreamState:
        count, recorded, windows = self.settings.count, self.settings.recorded, self.windows
        state, place = self.task.begin(count, progress, generator)
        history = History.start(self.show(state, place), len(self.world.system.actions))
        if windows is not None and recorded > 0:
            places = windows.place.to(place)
            # A fall on record is beyond delta_div; starting from it would drown what can be learnt.
            near = (~self.task.diverged(windows.state, places[:, -1], progress)).nonzero()[:, 0]
            if len(near):
                from_record = torch.rand(count, generator=generator) < recorded
                rows = near[torch.randint(len(near), (count,), generator=generator)]
                past = windows.history(rows)
                seen, now, where = self.task.augment(past.observations, windows.state[rows], places[rows], generator)
                shown = self.task.show(seen.flatten(0, 1), where.flatten(0, 1)).unflatten(0, seen.shape[:2])
                history = History(shown, past.actions).where(from_record, history)
                place = torch.where(from_record[:, None], where[:, -1], place)
                state = torch.where(from_record[:, None], now, state)
        return StreamState(self.world.start(state), history, place)
