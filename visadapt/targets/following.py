"""A quadrotor that knows nothing of a task, such as one in a gymnasium environment, along references."""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from visadapt.targets.base import Observation, Target, TargetError, TaskTarget, periods_differ
from visadapt.targets.rollout import checked_copy
from visadapt.tasks.follow import Follow
from visadapt.tasks.references import Reference

LARGEST_START_ERROR = 1.0  # m from a reference's first row to where a flight starts


class FollowingTarget(TaskTarget):
    """A target of a quadrotor that shows no goal, whose flights follow references from their first rows on.

    Args:
        target: where its flights start is its own.
        references: (N, T, 3) or (T, 3), their rows as far apart as the target's commands.

    Raises:
        TargetError: `reset` starts more than LARGEST_START_ERROR from a reference's first row.
        ValueError: references with another period.

    >>> import pathlib, tempfile, torch, visadapt as va
    >>> class Rig(va.Target):
    ...     name, period, n_action, system = "my rig", 0.1, 4, va.Quadrotor
    ...     def reset(self, batch, generator):
    ...         return va.Observation(torch.eye(13)[6].expand(batch, 13), torch.ones(batch, dtype=torch.bool))
    ...     def step(self, action):
    ...         return self.reset(len(action), None)
    >>> path = pathlib.Path(tempfile.mkdtemp()) / "line.csv"
    >>> _ = path.write_text("time,x,y,z\\n0,0,0,0\\n1,1,0,0\\n2,2,0,0\\n")
    >>> target = va.FollowingTarget(Rig(), va.read_reference(path))
    >>> target.reset(2, torch.Generator().manual_seed(0)).goal.shape
    torch.Size([2, 60])
    """

    def __init__(self, target: Target, references: Reference) -> None:
        self.target = target
        self.name, self.period, self.n_action, self.system = target.name, target.period, target.n_action, target.system
        self.task = Follow(references)
        if periods_differ(references.period, target.period):
            raise ValueError(
                f"the references have rows {references.period:g} s apart, and {target.name} has {target.period:g} s "
                "between actions: references at those instants are right"
            )

    def reset(self, batch: int, generator: torch.Generator) -> Observation:
        self.first = self._task_state = self.task.evaluation_start(batch, generator)[1]
        seen = checked_copy(self.target, self.target.reset(batch, generator), batch)
        off = float(self.task.distance_off(seen.state, self.first).max())
        if off > LARGEST_START_ERROR:
            raise TargetError(
                f"{self.name}: starts {off:.3g} m from the first point of its reference; references from where the "
                "machine starts are right"
            )
        return self._with_goal(seen)

    def step(self, action: Tensor) -> Observation:
        self._task_state = self.task.advance(self._task_state)
        return self._with_goal(checked_copy(self.target, self.target.step(action), len(action)))

    def _with_goal(self, seen: Observation) -> Observation:
        return replace(seen, goal=self.task.goal(self._task_state).to(seen.state), task_state=self._task_state)
