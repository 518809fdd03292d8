"""A fixed wing that knows nothing of a task, through points ahead."""

from __future__ import annotations

import torch

from visadapt.systems.rigid_body import POSITION, VELOCITY
from visadapt.targets.base import Observation, Target, TargetError
from visadapt.targets.goals import GoalTarget
from visadapt.tasks.reach import Reach


class ReachingTarget(GoalTarget):
    """A target of a fixed wing that shows no goal, whose flights are to pass through points ahead.

    Args:
        target: its flights start near the origin, in flight along x.
        task: where the points are; without it, 50 m ahead.

    Raises:
        TargetError: `reset` starts more than a metre from the origin, or not in flight towards a point.

    >>> import torch, visadapt as va
    >>> class Rig(va.Target):
    ...     name, period, n_action, system = "my rig", 0.05, 4, va.FixedWing
    ...     def reset(self, batch, generator):
    ...         flying = torch.eye(13)[6] + 11.5 * torch.eye(13)[3]
    ...         return va.Observation(flying.expand(batch, 13), torch.ones(batch, dtype=torch.bool))
    ...     def step(self, action):
    ...         return self.reset(len(action), None)
    >>> target = va.ReachingTarget(Rig())
    >>> target.reset(2, torch.Generator().manual_seed(0)).goal.shape
    torch.Size([2, 3])
    """

    start = "the origin"
    right = "positions from where a flight starts are right"

    def __init__(self, target: Target, task: Reach | None = None) -> None:
        super().__init__(target, task or Reach(target.period))

    def reset(self, batch: int, generator: torch.Generator) -> Observation:
        seen = super().reset(batch, generator)
        assert seen.goal is not None
        ahead = ((seen.goal - seen.state[:, POSITION]) * seen.state[:, VELOCITY]).sum(1) > 0
        if not bool(ahead.all()):
            x, y, z = seen.state[~ahead][0, VELOCITY].tolist()
            raise TargetError(
                f"{self.name}: starts at ({x:.3g}, {y:.3g}, {z:.3g}) m/s, not towards the points ahead, which lie "
                "along x: an x axis along which flights start is right"
            )
        return seen
