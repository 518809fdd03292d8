"""A target is anything that can be run: it takes actions and shows frames, states, or both."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass

import torch
from torch import Tensor

from visadapt.systems import System
from visadapt.tasks.base import FlightTask

PERIOD_ROUNDING = 1e-6  # s, by which equal periods may differ


def periods_differ(one: float, other: float) -> bool:
    """Whether two periods in s differ by more than rounding."""
    return abs(one - other) > PERIOD_ROUNDING


class TargetError(RuntimeError):
    """The target did something that no adaptation can go on from; the message says what, in one line."""


@dataclass(frozen=True)
class Observation:
    """What a batch of targets shows at one instant.

    >>> import torch, visadapt as va
    >>> seen = va.SyntheticTarget().reset(3, torch.Generator().manual_seed(0))
    >>> isinstance(seen, va.Observation), seen.state.shape, bool(seen.alive.all())
    (True, torch.Size([3, 4]), True)
    """

    state: Tensor
    """(B, n_state), SI units: for labels and scores, never for an image policy"""
    alive: Tensor
    """(B,) whether the episode can go on; of a cart-pole: up, and in the frame"""
    frame: Tensor | None = None
    """(B, H, W) uint8"""
    force: Tensor | None = None
    """(B,), or of vehicles (B, 3), the disturbance in N, where the target knows it: for films only"""
    goal: Tensor | None = None
    """(B, n_goal) what the policy is to do, where that is not always the same"""
    task_state: Tensor | None = None
    """(B, n_task_state) how far each is in its task, where the target has one: the task's own numbers"""


class Target(ABC):
    """A batch of machines of one kind, reset and stepped together.

    A row whose episode has ended may still be stepped: what it shows then means nothing.

    >>> import torch, visadapt as va
    >>> class Rig(va.Target):
    ...     name, period, n_action = "my rig", 0.05, 1
    ...     def reset(self, batch, generator):
    ...         return va.Observation(torch.zeros(batch, 4), torch.ones(batch, dtype=torch.bool))
    ...     def step(self, action):
    ...         return va.Observation(torch.zeros(len(action), 4), torch.ones(len(action), dtype=torch.bool))
    >>> policy = va.load_policy(va.shipped("cartpole_states"))
    >>> va.score(policy, Rig(), episodes=2, steps=5).survived
    2
    """

    name: str
    period: float
    """s between actions"""
    n_action: int
    system: System | type[System] | None = None
    """the machine's system, or its class where its parameters are not known; None where not even that is known"""

    @property
    def system_class(self) -> type[System] | None:
        """The class of the machine's system; None where it is not known."""
        return type(self.system) if isinstance(self.system, System) else self.system

    @abstractmethod
    def reset(self, batch: int, generator: torch.Generator) -> Observation:
        """Start `batch` new episodes."""

    @abstractmethod
    def step(self, action: Tensor) -> Observation:
        """Execute the action (B, n_action), in the range of the policy's commands, for one period."""


class TaskTarget(Target):
    """A target of a vehicle with a task, by which its flights are scored and filmed.

    What it shows has a goal, `task.goal`, and the task's state.

    >>> import visadapt as va
    >>> from visadapt.tasks.reach import Reach
    >>> isinstance(va.FlightTarget(Reach(), va.FixedWing()), va.TaskTarget)
    True
    """

    task: FlightTask
    first: Tensor
    """(B, n_task_state) in which the flights started"""
