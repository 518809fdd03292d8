"""Recorded episodes cut into windows: what was seen, what was done, what came of it."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import pad

from visadapt.history import LENGTH, History
from visadapt.recordings import Episode
from visadapt.world import World, WorldState

Observe = Callable[[Tensor], Tensor]
"""True states (B, n_state) to frames (B, H, W): a camera. Without one (None) a policy sees what the sensors measure."""

SOURCES = ("camera", "rendered", "state")
"""What a window shows: the camera's frames, frames rendered from the states, or the states themselves."""


@dataclass(frozen=True)
class Windows:
    """N samples (s_t, a_t, s_{t+1}) of E recorded episodes, each with the history a policy had before a_t.

    Observations are kept once, by row of the recording; a window refers to the rows that it shows. Episodes are kept
    whole as well: effects with memory depend on all commands and states since the episode began.
    """

    observations: Tensor
    """(R, ...): uint8 frames, or states"""
    commands: Tensor
    """(E, T, n_action) of whole episodes, from their begin; zero after their end"""
    states: Tensor
    """(E, T, n_state) of whole episodes; after their end the last state repeats"""
    rows: Tensor
    """(N, LENGTH) rows of `observations`"""
    past_actions: Tensor
    """(N, LENGTH, n_action) actions before a_t"""
    action: Tensor
    """(N, n_action) a_t"""
    state: Tensor
    """(N, n_state) s_t"""
    next_state: Tensor
    """(N, n_state) s_{t+1}"""
    episode: Tensor
    """(N,) number of the episode"""
    task_state: Tensor
    """(N, LENGTH, n_task_state) the task states of the rows that it shows; of width 0 where the target has none"""
    time: Tensor
    """(N,) s from the begin of the episode to s_t"""
    row: Tensor
    """(N,) row of s_t in its episode"""

    @classmethod
    def cut(cls, episodes: Sequence[Episode], source: str, observe: Observe | None = None) -> Windows:
        """Windows of all samples of the episodes; before an episode the first observation stands still.

        Raises:
            ValueError: an unknown source, episodes without what it needs, or no sample at all.
        """
        if source not in SOURCES:
            raise ValueError(f"unknown source of observations {source!r}; there are {', '.join(SOURCES)}")
        dtype = torch.get_default_dtype()
        parts: list[tuple[Tensor, ...]] = []
        observations: list[Tensor] = []
        commands: list[Tensor] = []
        states: list[Tensor] = []
        longest = max((len(episode.time) for episode in episodes), default=0)
        first = 0
        for number, episode in enumerate(episodes):
            if episode.state is None:
                raise ValueError(f"episode {number} has no states to learn from: estimate them first")
            state = torch.as_tensor(episode.state, dtype=dtype)
            action = torch.as_tensor(episode.action, dtype=dtype)
            observations.append(_seen(episode, number, state, source, observe))
            count = episode.samples
            has_task = episode.task_state is not None
            task_state = torch.as_tensor(episode.task_state) if has_task else torch.zeros(len(state), 0)
            back = torch.arange(-LENGTH + 1, 1) + torch.arange(count)[:, None]
            padded = torch.cat((torch.zeros(LENGTH, action.shape[1], dtype=dtype), action))
            time = torch.as_tensor(episode.time - episode.time[0], dtype=dtype)
            commands.append(pad(action[:count], (0, 0, 0, longest - count)))
            states.append(torch.cat((state, state[-1:].expand(longest - len(state), -1))))
            parts.append(
                (
                    first + back.clamp(min=0),
                    padded[(back + LENGTH - 1)],
                    action[:count],
                    state[:count],
                    state[1 : count + 1],
                    torch.full((count,), number),
                    task_state[back.clamp(min=0)],
                    time[:count],
                    torch.arange(count),
                )
            )
            first += len(state)
        if not parts or not sum(len(part[0]) for part in parts):
            raise ValueError("the recording holds no sample: every episode has a single row")
        joined = (torch.cat(tensors) for tensors in zip(*parts, strict=True))
        return cls(torch.cat(observations), torch.stack(commands), torch.stack(states), *joined)

    def __len__(self) -> int:
        return len(self.rows)

    def start(self, world: World) -> WorldState:
        """`world` at s_t of every window (N rows): at its time, with the memory that its episode's past leaves there.

        Rows are not read yet.
        """
        memory = world.memories(self.states[:, 0], self.commands, self.states)
        return WorldState(self.time, self.state, tuple(each[self.episode, self.row] for each in memory))

    def with_states(self, states: Tensor) -> Windows:
        """The same windows with other states (E, T, n_state), say smoothed ones; observations stay as recorded."""
        state, following = states[self.episode, self.row], states[self.episode, self.row + 1]
        return replace(self, states=states, state=state, next_state=following)

    def history(self, index: Tensor) -> History:
        """What the policy had seen and done before the action of these windows."""
        seen = self.observations[self.rows[index]]
        if seen.dtype == torch.uint8:
            seen = seen.to(self.state) / 255
        return History(seen, self.past_actions[index])


def _seen(episode: Episode, number: int, state: Tensor, source: str, observe: Observe | None) -> Tensor:
    if source == "camera":
        if episode.frame is None:
            raise ValueError(f"episode {number} has no camera frames")
        return torch.from_numpy(np.ascontiguousarray(episode.frame))
    if source == "rendered":
        if observe is None:
            raise ValueError("rendered observations need a renderer")
        with torch.no_grad():
            # Kept as a camera would, in 8 bits, so that both sources weigh the same.
            return (observe(state).clamp(0, 1) * 255).round().to(torch.uint8)
    return state
