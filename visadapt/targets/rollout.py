"""Running a policy on a target."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from visadapt.history import History
from visadapt.policies import Policy
from visadapt.recordings import Episode
from visadapt.targets import Observation, Target, TargetError

See = Callable[[Observation], Tensor]
"""What the policy is shown of an observation: (B, ...) floating point."""


def see_frames(observation: Observation) -> Tensor:
    """Frames (B, H, W) in [0, 1]."""
    if observation.frame is None:
        raise TargetError("the policy sees frames, but the target shows none: give it a camera")
    return observation.frame.to(torch.get_default_dtype()) / 255


def see_states(observation: Observation) -> Tensor:
    """States (B, n_state)."""
    return observation.state


def see_goals(observation: Observation) -> Tensor:
    """States and, after them, goals (B, n_state + n_goal)."""
    if observation.goal is None:
        raise TargetError("the policy is told its goal, but the target has none: give it a course")
    return torch.cat((observation.state, observation.goal), 1)


@dataclass(frozen=True)
class Run:
    """One episode that was run: its rows up to its end, and how it ended."""

    episode: Episode
    survived: bool
    force: np.ndarray
    """(T,), or of vehicles (T, 3), the disturbance in N as the target tells it, zeros where it does not: for films"""


@torch.no_grad()
def run(
    target: Target,
    policy: Policy,
    see: See,
    batch: int,
    steps: int,
    generator: torch.Generator,
    exploration: float = 0.0,
    strict: bool = True,
) -> list[Run]:
    """Run `batch` episodes of at most `steps` steps each; an episode that ends is cut there, and marked.

    Args:
        exploration: standard deviation of white noise on the commands, so that what they do shows in the data.
        strict: whether a state that is not finite is an error; if not, its episode ends before it.

    Raises:
        TargetError: the target shows a state that is not finite while its episode goes on, or no frame.
    """
    observation = target.reset(batch, generator)
    _check_finite(target, observation, torch.ones_like(observation.alive), "the first state")
    history = History.start(see(observation), target.n_action)
    rows: list[tuple[Observation, Tensor]] = []
    length = torch.zeros(batch, dtype=torch.long)
    running = observation.alive.clone()
    for _ in range(steps):
        if not bool(running.any()):
            break
        action = policy.act(history)
        if exploration > 0:
            action = (action + exploration * torch.randn(action.shape, generator=generator).to(action)).clamp(-1, 1)
        rows.append((observation, action))
        observation = target.step(action)
        finite = observation.state.isfinite().all(1)
        if strict:
            _check_finite(target, observation, running, f"the state after step {len(rows)}")
        length += running & finite
        running &= observation.alive & finite
        history = history.acting(action).observing(see(observation))
    rows.append((observation, torch.zeros(batch, target.n_action)))
    return [_cut(rows, b, int(length[b]), bool(running[b]), target.period) for b in range(batch)]


def _check_finite(target: Target, observation: Observation, rows: Tensor, which: str) -> None:
    broken = rows & ~observation.state.isfinite().all(1)
    if bool(broken.any()):
        raise TargetError(f"{target.name}: {which} is not finite (episode {int(broken.nonzero()[0])})")


def _cut(rows: list[tuple[Observation, Tensor]], b: int, length: int, survived: bool, period: float) -> Run:
    kept = rows[: length + 1]
    action = np.stack([action[b].numpy() for _, action in kept])
    action[-1] = 0.0
    frames = None
    if kept[0][0].frame is not None:
        frames = np.stack([seen.frame[b].numpy() for seen, _ in kept if seen.frame is not None])
    place = None
    if kept[0][0].place is not None:
        place = np.stack([seen.place[b].double().numpy() for seen, _ in kept if seen.place is not None])
    episode = Episode(
        time=np.arange(len(kept)) * period,
        action=action,
        state=np.stack([seen.state[b].numpy() for seen, _ in kept]),
        frame=frames,
        place=place,
    )
    force = np.array([0.0 if seen.force is None else seen.force[b].numpy() for seen, _ in kept])
    return Run(episode, survived, force)
