"""Running a policy on a target."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from visadapt.history import History
from visadapt.policies import Policy
from visadapt.recordings import Episode
from visadapt.targets import Observation, Target, TargetError
from visadapt.targets.base import periods_differ
from visadapt.tasks.balance import within_a_turn

See = Callable[[Observation], Tensor]
"""What the policy is shown of an observation: (B, ...) floating point."""


def see_frames(observation: Observation) -> Tensor:
    """Frames (B, H, W) in [0, 1]."""
    if observation.frame is None:
        raise TargetError("the policy is shown frames, but the target has none: give it a camera")
    return observation.frame.to(torch.get_default_dtype()) / 255


def see_states(observation: Observation) -> Tensor:
    """States (B, n_state)."""
    return observation.state


def see_within_a_turn(observation: Observation) -> Tensor:
    """States (B, 4) of a cart-pole with the angle between -pi and pi, as a policy that swings up is shown them."""
    return within_a_turn(observation.state)


def see_goals(observation: Observation) -> Tensor:
    """States and, after them, goals (B, n_state + n_goal)."""
    if observation.goal is None:
        raise TargetError(
            "the policy is shown its goal, but the target has none: give a quadrotor references, by --references, a "
            "fixed wing points (va.ReachingTarget)"
        )
    return torch.cat((observation.state, observation.goal), 1)


SHOWN: dict[str, See] = {"state": see_states, "frame": see_frames, "state and goal": see_goals}
"""By `Policy.shown`, what a policy is shown of an observation."""


@dataclass(frozen=True)
class Run:
    """One episode that was run: its rows up to its end, and how it ended."""

    episode: Episode
    survived: bool
    force: np.ndarray | None
    """(T,), or of vehicles (T, 3), the disturbance in N as the target tells it, None where it does not: for films"""


@torch.no_grad()
def run(
    target: Target,
    policy: Policy,
    batch: int,
    steps: int,
    generator: torch.Generator,
    exploration: float = 0.0,
    added: Tensor | None = None,
    strict: bool = True,
    see: See | None = None,
    keep_frames: bool = True,
    failed: Callable[[list[Run]], object] | None = None,
) -> list[Run]:
    """Run `batch` episodes of at most `steps` steps each; one that ends earlier is cut there, and not `survived`.

    Args:
        exploration: standard deviation of white noise on the commands, as a share of half their range, so that the data
            show their effect.
        added: (steps, n_action) or more of them, added to the policy's commands, such as those of a `Plan`.
        strict: whether a state that is not finite is an error; if not, its episode ends before it.
        see: what the policy is shown, where that is not what `policy.shown` names.
        keep_frames: whether the runs hold the target's frames, which take 3 MB for an episode of 250 of 120 x 100 px.
        failed: called with the runs up to the last observation where a step of the target raises an error.

    Raises:
        TargetError: the target shows a state that is not finite while its episode goes on, or no frame.

    >>> import torch, visadapt as va
    >>> policy = va.load_policy(va.shipped("cartpole_states"))
    >>> runs = va.run(va.SyntheticTarget(), policy, 2, 20, torch.Generator().manual_seed(0))
    >>> [(run.episode.samples, run.survived) for run in runs]
    [(20, True), (20, True)]
    """
    see = see or SHOWN[policy.shown]
    observation = _seen_by(policy, checked_copy(target, target.reset(batch, generator), batch), None)
    _check_finite(target, observation, torch.ones_like(observation.alive), "the first state")
    like = next(policy.parameters(), observation.state)
    history = History.start(see(observation).to(like), target.n_action)
    rows: list[tuple[Observation, Tensor]] = []
    length = torch.zeros(batch, dtype=torch.long)
    running = observation.alive.clone()
    low, high = (bound.to(observation.state) for bound in policy.command_range)
    for _ in range(steps):
        if not bool(running.any()):
            break
        action = policy.act(history).to(observation.state)
        if exploration > 0:
            noise = exploration * torch.randn(action.shape, generator=generator).to(action)
            action = (action + (high - low) / 2 * noise).clamp(low, high)
        if added is not None:
            action = (action + added[len(rows)].to(action)).clamp(low, high)
        rows.append((observation if keep_frames else replace(observation, frame=None), action))
        try:
            after = _seen_by(policy, checked_copy(target, target.step(action), batch), observation)
            if strict:
                _check_finite(target, after, running, f"the state after step {len(rows)}")
        except Exception:
            if failed is not None and len(rows) > 1:
                failed([_cut(rows, b, int(length[b]), bool(running[b]), target.period) for b in range(batch)])
            raise
        observation, finite = after, after.state.isfinite().all(1)
        length += running & finite
        running &= observation.alive & finite
        history = history.acting(action.to(like)).observing(see(observation).to(like))
    last = observation if keep_frames else replace(observation, frame=None)
    rows.append((last, torch.zeros(batch, target.n_action)))
    return [_cut(rows, b, int(length[b]), bool(running[b]), target.period) for b in range(batch)]


def check_period(policy: Policy, target: Target) -> None:
    """Raises ValueError where the policy is known to be trained for another period than the target's."""
    trained = policy.trained_period
    if trained is not None and periods_differ(trained, target.period):
        raise ValueError(
            f"{target.name} has {target.period:g} s between actions, the policy was trained for {trained:g} s: give "
            "the target that period, or train a policy for its own"
        )


def checked_copy(target: Target, observation: Any, batch: int) -> Observation:
    """A copy of what a target shows of `batch` episodes, since it may write the next instant over it.

    Raises:
        TargetError: it is no observation of that many episodes.
    """
    if not isinstance(observation, Observation):
        what = type(observation).__name__
        raise TargetError(f"{target.name}: reset and step return a visadapt.Observation, not a {what}")
    right = {
        "state": f"({batch}, n_state)",
        "alive": f"({batch},) and bool",
        "frame": f"({batch}, H, W) and uint8, grey,",
    }
    copies: dict[str, Any] = {}
    for field in fields(observation):
        name, value = field.name, getattr(observation, field.name)
        if value is None and name not in ("state", "alive"):
            continue
        fits = isinstance(value, Tensor) and value.shape[:1] == (batch,)
        if fits and name == "state":
            fits = value.dim() == 2
        elif fits and name == "alive":
            fits = value.dtype == torch.bool
        elif fits and name == "frame":
            fits = value.dim() == 3 and value.dtype == torch.uint8
        if not fits:
            what = f"{tuple(value.shape)} and {value.dtype}" if isinstance(value, Tensor) else type(value).__name__
            needed = right.get(name, f"({batch}, ...)")
            raise TargetError(f"{target.name}: {name} is {what}; a torch tensor that is {needed} is right")
        copies[name] = value.clone()
    return Observation(**copies)


def _seen_by(policy: Policy, observation: Observation, before: Observation | None) -> Observation:
    """The observation with angles in the turns in which the policy reads them."""
    state = policy.unwrapped(observation.state, None if before is None else before.state)
    return replace(observation, state=state)


def _check_finite(target: Target, observation: Observation, rows: Tensor, which: str) -> None:
    broken = rows & ~observation.state.isfinite().all(1)
    if bool(broken.any()):
        raise TargetError(f"{target.name}: {which} is not finite (episode {int(broken.nonzero()[0])})")


def _cut(rows: list[tuple[Observation, Tensor]], b: int, length: int, survived: bool, period: float) -> Run:
    kept = rows[: length + 1]

    def column(name: str) -> NDArray[Any] | None:
        each = [getattr(seen, name) for seen, _ in kept]
        return None if any(values is None for values in each) else np.stack([values[b].numpy() for values in each])

    action = np.stack([action[b].numpy() for _, action in kept])
    action[-1] = 0.0
    time, task_state = np.arange(len(kept)) * period, column("task_state")
    if task_state is not None:
        task_state = task_state.astype(float)
    episode = Episode(time, action, column("state"), column("frame"), task_state)
    return Run(episode, survived, column("force"))
