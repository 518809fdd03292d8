"""A quadrotor that knows nothing of a task, along references."""

from __future__ import annotations

from visadapt.targets.base import Target, periods_differ
from visadapt.targets.goals import GoalTarget
from visadapt.tasks.follow import Follow
from visadapt.tasks.references import Reference


class FollowingTarget(GoalTarget):
    """A target of a quadrotor that shows no goal, whose flights follow references from their first rows on.

    Args:
        target: where its flights start is its own.
        references: (N, T, 3) or (T, 3), their rows as far apart as the target's commands.

    Raises:
        TargetError: `reset` starts more than a metre from a reference's first row.
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

    start = "the first point of its reference"
    right = "references from where the machine starts are right"

    def __init__(self, target: Target, references: Reference) -> None:
        super().__init__(target, Follow(references))
        if periods_differ(references.period, target.period):
            raise ValueError(
                f"the references have rows {references.period:g} s apart, and {target.name} has {target.period:g} s "
                "between actions: references at those instants are right"
            )
