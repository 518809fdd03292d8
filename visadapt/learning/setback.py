"""Whether a tuned policy does much worse on the target than the one it began as, by the data of the rounds.

A residual on the last state alone cannot learn a motor that is late: the world with it is stable under a policy under
which the machine is not. Only the machine shows it, in the data that the next round collects.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Sequence
from dataclasses import dataclass

import numpy as np
import torch

from visadapt.history import HORIZON
from visadapt.recordings import Episode
from visadapt.tasks.base import Task

MUCH_WORSE, MUCH_WORSE_ONCE, FEW_ROUNDS = 3.0, 10.0, 3
"""Ratio of the later rounds' median cost to the first round's from which on the policy is much worse, and the same
where there are fewer later rounds than that. A round may be one episode, whose cost depends on where it started: of a
policy that did as well throughout, it was 0.5 to 7 times the first."""

FEWEST_FAILURES = 3  # Episodes that end early in the last round, below which more than in the first may be chance


@dataclass(frozen=True)
class Performance:
    """How a policy did in the episodes that it collected."""

    steps: int
    failures: int  # episodes that ended early
    cost: float  # mean cost of what was executed, by the task; NaN where that is not known

    @classmethod
    def of(cls, episodes: Sequence[Episode], longest: int, task: Task | None, cut: Collection[int] = ()) -> Performance:
        """Of the episodes of a round, in which none was to last more than `longest` steps; without a task, at no cost
        that is known. Those that were `cut`, by number, ended where the target failed, which is not the policy's."""
        left = steps = sum(episode.samples for episode in episodes)
        failures = 0
        for number, episode in enumerate(episodes):
            failures += episode.samples < min(left, longest) and number not in cut
            left -= episode.samples
        costs = np.concatenate([np.zeros(0), *(_costs(episode, task) for episode in episodes if task is not None)])
        return cls(steps, failures, float(costs.mean()) if len(costs) else math.nan)


@torch.no_grad()
def _costs(episode: Episode, task: Task) -> np.ndarray:
    """Costs (N,) of every HORIZON executed steps in the second half of an episode, when its start is forgotten."""
    count = episode.samples - HORIZON + 1
    if episode.state is None or count < 1:
        return np.zeros(0)
    dtype = torch.get_default_dtype()
    state, action = (torch.as_tensor(each, dtype=dtype) for each in (episode.state, episode.action))
    # As the task makes them: those of a reference are whole numbers, which a recording does not know.
    like = task.training_start(1, 1.0, torch.Generator().manual_seed(0))[1]
    known = state[:, :0] if episode.task_state is None else torch.as_tensor(episode.task_state)
    if known.shape[1] != like.shape[1]:  # of a machine that shows a policy its goal, and no other
        return np.zeros(0)
    task_state = known.to(like)
    ahead = state[1:].unfold(0, HORIZON, 1).movedim(-1, 1)[:count]
    plan = action.unfold(0, HORIZON, 1).movedim(-1, 1)[:count]
    return task.to(state).cost(ahead, plan, state[:count], task_state[:count])[count // 2 :].numpy()


def setback(rounds: Sequence[Performance]) -> str:
    """In words, why the policy of later rounds is much worse than that of the first; empty where it is not."""
    first, *later = rounds
    if not later:
        return ""
    last = later[-1]
    lasts = first.steps / (first.failures + 1) > MUCH_WORSE * last.steps / (last.failures + 1)
    if last.failures >= FEWEST_FAILURES and lasts:
        return (
            f"{last.failures} of its episodes on the machine ended early, in {last.steps} steps; of the policy that it "
            f"began as {first.failures} did, in {first.steps}"
        )
    cost = float(np.median([one.cost for one in later]))
    if cost > first.cost * (MUCH_WORSE if len(later) >= FEW_ROUNDS else MUCH_WORSE_ONCE) > 0:
        return f"on the machine it cost {cost / first.cost:.3g} times what the policy did that it began as"
    return ""
