"""Recorded episodes cut into transitions: observations and actions up to a step, and the state after it."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import pad
from torch.nn.utils.rnn import pad_sequence

from visadapt.batch import placed
from visadapt.history import LENGTH, History
from visadapt.recordings import Episode, RecordingError
from visadapt.world import World, WorldState

Observe = Callable[[Tensor], Tensor]
"""True states (B, n_state) to frames (B, H, W): a camera. Without one (None) a policy sees what the sensors measure."""


@dataclass(frozen=True)
class Transitions:
    """N samples (s_t, a_t, s_{t+1}) of E recorded episodes, each with the history a policy had before a_t.

    All is kept once, for the R rows of the recording, one episode after the other; a transition refers to its
    rows.
    """

    lengths: list[int]  # (E,) rows of each episode
    observations: Tensor  # (R, ...): uint8 frames, or states
    actions: Tensor  # (R, n_action); zero in the last row of an episode
    states: Tensor  # (R, n_state)
    times: Tensor  # (R,) s since the start of the episode
    task_states: Tensor  # (R, n_task_state); of width 0 where the target has none
    rows: Tensor
    """(N, LENGTH) rows of the history, up to that of s_t; before an episode its first row is repeated"""

    @classmethod
    def cut(cls, episodes: Sequence[Episode], frames: bool = False) -> Transitions:
        """Transitions of all samples of the episodes, which show the camera's frames, or the states.

        Raises:
            ValueError: episodes without states, or without the frames that are asked for.
            RecordingError: there is no sample at all.
        """
        dtype = torch.get_default_dtype()
        parts: list[tuple[Tensor, ...]] = []
        first = 0
        for number, episode in enumerate(episodes):
            if episode.state is None:
                raise ValueError(f"episode {number} has no states to learn from: estimate them first")
            state = torch.as_tensor(episode.state, dtype=dtype)
            seen = state
            if frames:
                if episode.frame is None:
                    raise ValueError(f"episode {number} has no camera frames")
                seen = torch.from_numpy(np.ascontiguousarray(episode.frame))
            action = pad(torch.as_tensor(episode.action[:-1], dtype=dtype), (0, 0, 0, 1))
            time = torch.as_tensor(episode.time - episode.time[0], dtype=dtype)
            task_state = state[:, :0] if episode.task_state is None else torch.as_tensor(episode.task_state)
            back = torch.arange(-LENGTH + 1, 1) + torch.arange(episode.samples)[:, None]
            parts.append((seen, action, state, time, task_state, first + back.clamp(min=0)))
            first += len(state)
        if not any(episode.samples for episode in episodes):
            raise RecordingError(
                "there is no sample to learn from: every episode is too short; collect more in a round"
            )
        return cls([len(each.time) for each in episodes], *(torch.cat(own) for own in zip(*parts, strict=True)))

    def to(self, like: Tensor) -> Transitions:
        """The same on the device of `like`; what is of floating point gets its dtype."""
        tensors = (self.observations, self.actions, self.states, self.times, self.task_states, self.rows)
        return Transitions(self.lengths, *(placed(values, like) for values in tensors))

    def __len__(self) -> int:
        return len(self.rows)

    @property
    def state(self) -> Tensor:
        """(N, n_state) s_t"""
        return self.states[self.rows[:, -1]]

    @property
    def next_state(self) -> Tensor:
        """(N, n_state) s_{t+1}"""
        return self.states[self.rows[:, -1] + 1]

    @property
    def action(self) -> Tensor:
        """(N, n_action) a_t"""
        return self.actions[self.rows[:, -1]]

    @property
    def time(self) -> Tensor:
        """(N,) s from the start of the episode to s_t"""
        return self.times[self.rows[:, -1]]

    def start(self, world: World) -> WorldState:
        """`world` at s_t of every transition (N rows): its time, its state, and the effects' memory of the past.

        The sensors have not read these rows yet.
        """
        commands = pad_sequence(self.actions.split(self.lengths), batch_first=True)
        states = pad_sequence(self.states.split(self.lengths), batch_first=True)
        memory = [
            torch.cat([own[:length] for own, length in zip(each, self.lengths, strict=True)])[self.rows[:, -1]]
            for each in world.memories(states[:, 0], commands, states)
        ]
        return WorldState(self.time, self.state, tuple(memory))

    def history(self, index: Tensor) -> History:
        """What the policy had seen and done before the action of these transitions."""
        rows = self.rows[index]
        seen = self.observations[rows]
        if seen.dtype == torch.uint8:
            seen = seen.to(self.states) / 255
        # Before the first row of an episode comes the last one of another, in which the action is zero.
        return History(seen, self.actions[rows - 1])
