"""The episodes of a reinforcement learner: where they start, what it sees, its reward for a step, and when they end.

The reward of a step is exp(-cost) or, for vehicles, whose errors are larger, exp(-sqrt(cost)). It is between 0 and 1,
so that it always pays to go on. A step that fails ends the episode and earns 0. `SwingingUp` has a reward of its own,
and `Reaching` adds one for passing the point.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable

import torch
from torch import Tensor

from benchmarks.baselines.cartpole import COST
from benchmarks.baselines.subjects import CartPoleSubject
from experiments.swing_up import ANYWHERE, STEPS
from visadapt.history import History
from visadapt.learning.transitions import Observe
from visadapt.policies import FollowPolicy, ReachPolicy
from visadapt.policies.flight import FlightPolicy
from visadapt.systems import CartPole, FixedWing, Quadrotor, System
from visadapt.systems.rigid_body import ATTITUDE, POSITION, VELOCITY, rotation
from visadapt.targets import Start
from visadapt.tasks.base import EPISODE_STEPS, FlightTask
from visadapt.tasks.follow import Follow
from visadapt.tasks.reach import Reach

Begin = Callable[[int, torch.Generator], tuple[Tensor, Tensor]]
"""First states and task states of a batch of episodes."""
Judged = tuple[Tensor, Tensor, Tensor]
"""Rewards (B,) of steps, whether they failed, and whether they are at the end of their course."""


class Course(ABC):
    """The episodes of one system."""

    system: System
    period: float
    """s between commands"""
    steps: int
    """in the longest episode"""
    start: Begin
    show = "state"
    """what a policy is shown of it: `Policy.shown`"""

    @abstractmethod
    def shown(self, history: History) -> Tensor:
        """What the network sees (B, inputs) of a policy's history."""

    @abstractmethod
    def judge(self, before: Tensor, command: Tensor, state: Tensor, task_state: Tensor) -> Judged:
        """Steps from states `before` to states and task states."""

    def observed(self, seen: Tensor, task_state: Tensor) -> Tensor:
        """What a history holds of what sensors read."""
        return seen

    def advance(self, task_state: Tensor) -> Tensor:
        """The task states one period later."""
        return task_state


class Balancing(Course):
    """A cart-pole that is held up.

    Args:
        begin: first states of a batch of episodes, and task states, which are empty.
        with_history: whether the network sees 5 states and actions, or the last alone.
    """

    system = CartPole()
    period = 0.05
    steps = EPISODE_STEPS
    scale = torch.tensor((1.0, 1.0, 0.1, 1.0))
    """of position, velocity, angle and angular velocity as shown"""

    def __init__(self, begin: Begin, with_history: bool) -> None:
        self.start, self.with_history = begin, with_history

    def shown(self, history: History) -> Tensor:
        """The position, and what the ensemble of PETS sees."""
        states = history.observations / self.scale
        others = CartPoleSubject(self.with_history).inputs(History(states, history.actions))
        return torch.cat((states[:, -1, :1], others), 1)

    def judge(self, before: Tensor, command: Tensor, state: Tensor, task_state: Tensor) -> Judged:
        weights = torch.tensor(COST.state)
        cost = (weights * state.square()).sum(1) + COST.action * command[:, 0].square()
        fallen = state[:, 2].abs() > 0.3
        return (-cost).exp(), fallen, torch.zeros_like(fallen)


class Filmed(Balancing):
    """A cart-pole that is held up, from frames: the network sees the last 5 in [0, 1], flattened, and 5 actions.

    Args:
        begin: as of `Balancing`.
        film: frames (B, H, W) in [0, 1] of states (B, 4).
        reach: m; an episode fails, too, where the cart is further than this from the middle, out of the frame.
    """

    show = "frame"

    def __init__(self, begin: Begin, film: Observe, reach: float) -> None:
        super().__init__(begin, with_history=True)
        self.film, self.reach = film, reach

    def shown(self, history: History) -> Tensor:
        return torch.cat((history.observations.flatten(1), history.actions.flatten(1)), 1)

    def observed(self, seen: Tensor, task_state: Tensor) -> Tensor:
        return self.film(seen)

    def judge(self, before: Tensor, command: Tensor, state: Tensor, task_state: Tensor) -> Judged:
        reward, fallen, over = super().judge(before, command, state, task_state)
        return reward, fallen | ~(state[:, 0].abs() <= self.reach), over


class SwingingUp(Course):
    """A cart-pole from anywhere, whose pole is to be swung up and held in the middle of the track."""

    system = CartPole()
    period = 0.05
    steps = STEPS
    FARTHEST = 8.0
    """m from the middle at which an episode fails, as ours starts anew"""

    def __init__(self) -> None:
        self.start = starting(Start(*ANYWHERE))

    def shown(self, history: History) -> Tensor:
        x, velocity, angle, turning = history.observations[:, -1].unbind(1)
        return torch.stack((x, velocity, angle.sin(), angle.cos(), turning / 5), 1)

    def judge(self, before: Tensor, command: Tensor, state: Tensor, task_state: Tensor) -> Judged:
        x, velocity, angle, _ = state.unbind(1)
        reward = (1 + angle.cos()) / 2 * (-x.square() / 4 - velocity.square() / 10).exp()
        failed = ~(x.abs() <= self.FARTHEST)
        return reward, failed, torch.zeros_like(failed)


class Flying(Course):
    """A vehicle on a course. The network sees what the policy of ours makes of state and goal."""

    task: FlightTask
    eyes: FlightPolicy
    show = "state and goal"
    FARTHEST = 5.0
    """m off its course at which a flight fails"""

    def __init__(self, task: FlightTask, system: System, eyes: FlightPolicy, begin: Begin) -> None:
        self.task, self.system, self.eyes, self.start = task, system, eyes, begin
        self.period, self.steps = task.period, task.steps

    def observed(self, seen: Tensor, task_state: Tensor) -> Tensor:
        return self.task.show(seen, task_state)

    def advance(self, task_state: Tensor) -> Tensor:
        return self.task.advance(task_state)

    @torch.no_grad()
    def shown(self, history: History) -> Tensor:
        last = history.observations[:, -1]
        state, goal = last[:, : self.eyes.n_state], last[:, self.eyes.n_state :]
        return self.eyes.own_inputs(state, goal, rotation(state[:, ATTITUDE]))


class Following(Flying):
    """A quadrotor along its reference."""

    task: Follow

    def judge(self, before: Tensor, command: Tensor, state: Tensor, task_state: Tensor) -> Judged:
        own, row = self.task.plan_cost, task_state[:, 1].clamp(max=self.steps)
        away = state - self.task.states_on(task_state[:, 0], row)
        cost = own.position * away[:, POSITION].square().sum(1) + own.velocity * away[:, VELOCITY].square().sum(1)
        cost = cost + own.action * command.square().sum(1)
        failed = ~(self.task.distance_off(state, task_state) <= self.FARTHEST)
        return (-cost.sqrt()).exp(), failed, task_state[:, 1] >= self.steps


class Reaching(Flying):
    """A fixed wing to its point. What counts most is its miss, as much as PASSING steps without an error."""

    task: Reach
    PASSING, SHARPNESS = 50.0, 3.0
    """reward for a pass without a miss, and 1/m by which it falls"""

    def judge(self, before: Tensor, command: Tensor, state: Tensor, task_state: Tensor) -> Judged:
        cost = self.task.cost(state[:, None], command[:, None], before, task_state)
        failed = ~(self.task.distance_off(state, task_state) <= self.FARTHEST)
        passed = state[:, 0] >= task_state[:, 0]
        missed = self.task.misses(torch.stack((before, state), 1), task_state)[:, 0]
        reward = (-cost.sqrt()).exp() + passed * self.PASSING * (-self.SHARPNESS * missed).exp()
        return reward, failed, passed


def starting(first: Start) -> Begin:
    """Episodes of a cart-pole that start as `first` says; their task states are empty."""

    def begin(batch: int, generator: torch.Generator) -> tuple[Tensor, Tensor]:
        state = first.draw(batch, generator)
        return state, state[:, :0]

    return begin


def flying(task: FlightTask, system: System, begin: Begin) -> Flying:
    """The course of a vehicle in its task."""
    if isinstance(system, Quadrotor):
        return Following(task, system, FollowPolicy(task.period), begin)
    assert isinstance(system, FixedWing)
    return Reaching(task, system, ReachPolicy(), begin)
