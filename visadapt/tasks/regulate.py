"""Come to rest at a goal and stay there: the task of a system of one's own, in code or in a TOML file."""

from __future__ import annotations

import math
import os
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import torch
from torch import Tensor

from visadapt.storage.toml_file import is_number, read_toml
from visadapt.systems import System
from visadapt.tasks.base import Task
from visadapt.tasks.linear_quadratic import Regulator, linear_quadratic
from visadapt.world import World

TABLES = ("goal", "tolerance", "start", "limits")  # Fields with a number for each state that they name
LEAST_POSITIVE = torch.finfo(torch.float32).tiny  # Smaller numbers count as zero
NEWTON_STEPS = 20  # for the commands that hold a goal
COMMAND_STEP = 1e-6  # Share of a command's range that is the step of the differences in these
MAX_RATE_AT_GOAL = 1e-3
"""Largest rate of a state at the goal, as a share of the state's tolerance in a second, and largest change of that rate
in a second as other states drift."""
DRIFT_TIME = 1e-3  # s, for which states without a tolerance drift in this test
FREE_STATE_WEIGHT = 1e-3
"""Weight of the rates of states without a tolerance, as a share of their range in a second, in Newton's method."""


class TaskFileError(ValueError):
    """A file of a task that cannot be used; the message is one line: which file, which key, what would be right."""


@dataclass(frozen=True)
class Regulate(Task):
    """Bring a system to rest at a goal, and keep it there. The task state is empty: (B, 0).

    The cost is that of a linear-quadratic regulator, its weights given by tolerances (Bryson's rule):

        C = sum_k sum_i ((s_{t+k} - goal)_i / tolerance_i)^2 + sum_j ((a_{t+k} - held)_j / (effort h_j))^2 + e' V e

    where h_j is half the range of command j, `held` are the commands that hold the goal, and V is the cost of what
    follows the last planned state, e = s_{t+K} - goal.

    Raises:
        ValueError: a state that the system does not have, a number that is not finite or not positive, no tolerance,
            starts beyond a limit, or a goal that no command holds.

    >>> import torch, visadapt as va
    >>> task = va.Regulate(va.CartPole(), tolerance={"x": 0.5, "theta": 0.05}, limits={"theta": 0.3})
    >>> state, task_state = task.training_start(3, 0.0, torch.Generator().manual_seed(0))
    >>> state.shape, bool((state[:, 2].abs() <= 0.05).all())
    (torch.Size([3, 4]), True)
    """

    system: System
    goal: Mapping[str, float] = field(default_factory=dict)
    """where each state is to be, in its unit; 0 for those that are not named"""
    tolerance: Mapping[str, float] = field(default_factory=dict)
    """deviations from the goal that are equally bad; states that are not named cost nothing, wherever they are"""
    start: Mapping[str, float] = field(default_factory=dict)
    """half-widths of the uniform distribution, around the goal, in which episodes start; the tolerance for states that
    are not named, 0 for those without one"""
    limits: Mapping[str, float] = field(default_factory=dict)
    """deviations from the goal beyond which an episode has failed; none for states that are not named"""
    effort: float = 1.0
    """share of half a command's range that is as bad as a deviation by the tolerance"""
    seconds: float = 5.0
    """s, of an episode"""
    to_go: tuple[tuple[float, ...], ...] = ()
    """V, (n_state, n_state); none without it"""

    def __post_init__(self) -> None:
        names = [state.name for state in self.system.states]
        for table in TABLES:
            for name, value in getattr(self, table).items():
                if name not in names:
                    raise ValueError(f"{table}: a {self.system.name} has no state {name!r}: {', '.join(names)}")
                if not is_number(value) or (table != "goal" and value < LEAST_POSITIVE):
                    right = "finite" if table == "goal" else "positive"
                    raise ValueError(f"{table}: {name} must be a {right} number, got {value!r}")
        for name in ("effort", "seconds"):
            value = getattr(self, name)
            if not is_number(value) or value < LEAST_POSITIVE:
                raise ValueError(f"{name} must be a positive number, got {value!r}")
        if not self.tolerance:
            raise ValueError(
                f"tolerance: name the states that are to be at the goal, of {', '.join(names)}, with deviations that "
                "are equally bad"
            )
        for state, spread, limit in zip(names, self.spread.tolist(), self.limit.tolist(), strict=True):
            if spread >= limit:
                raise ValueError(f"limits: {state} starts up to {spread:g} from the goal, and fails at {limit:g}")
        self._check_goal_is_held()

    def _check_goal_is_held(self) -> None:
        """Raises ValueError where states move off the goal under `held`, at once or as other states drift."""
        rates = self._rates(self.held[None])[0]
        changes = (self._rates(self.held[None], DRIFT_TIME * rates)[0] - rates) / DRIFT_TIME
        for each, unit in ((rates, "s"), (changes, "s2")):
            for state, rate, weight in zip(self.system.states, each.tolist(), self.weights.tolist(), strict=True):
                if weight and abs(rate) * math.sqrt(weight) > MAX_RATE_AT_GOAL:
                    unnamed = [one.name for one in self.system.states if one.name not in self.goal]
                    taken = f"; {', '.join(unnamed)} taken to be 0 there, as the goal does not say" if unnamed else ""
                    raise ValueError(
                        f"goal: no command within its range holds it: there {state.name} changes by {rate:.3g} "
                        f"{state.unit}/{unit}{taken}"
                    )

    def settings(self) -> dict[str, Any]:
        """What a user gives beside the system, as plain values: `Regulate(system, **settings)` is the same task."""
        tables = {name: dict(getattr(self, name)) for name in TABLES}
        return {**tables, "effort": self.effort, "seconds": self.seconds}

    def solved(self, world: World) -> tuple[Regulate, Regulator]:
        """The task with the commands that hold the goal in `world`, and its V; and the regulator that has this V.

        Raises:
            ValueError: no command holds the goal there, or as `linear_quadratic`.
        """
        with torch.no_grad():
            system = world.altered(self.at_goal[None])
        task = replace(self, system=system, to_go=())
        regulator = linear_quadratic(world, task.weights, task.command_weights, task.at_goal, task.held)
        return replace(task, to_go=tuple(tuple(row) for row in regulator.to_go.tolist())), regulator

    def in_world(self, world: World) -> Regulate:
        try:
            return self.solved(world)[0]
        except ValueError:  # the machine no longer holds the goal: its own commands there are as good as any
            return self

    def _of_states(self, values: Mapping[str, float], otherwise: float) -> Tensor:
        """(n_state,) values by the states' names, in float64."""
        given = [float(values.get(state.name, otherwise)) for state in self.system.states]
        return torch.tensor(given, dtype=torch.float64)

    @cached_property
    def at_goal(self) -> Tensor:
        """(n_state,) the goal, in float64."""
        return self._of_states(self.goal, 0.0)

    @cached_property
    def weights(self) -> Tensor:
        """(n_state,) of the squared deviations: 1 / tolerance^2, 0 without one."""
        return self._of_states(self.tolerance, math.inf).pow(-2)

    @cached_property
    def command_range(self) -> tuple[Tensor, Tensor]:
        """Lowest and highest commands, (n_action,) each."""
        ranges = [(action.low, action.high) for action in self.system.actions]
        low, high = torch.tensor(ranges, dtype=torch.float64).unbind(1)
        return low, high

    @cached_property
    def command_weights(self) -> Tensor:
        """(n_action,) of the squared commands."""
        low, high = self.command_range
        return (self.effort * (high - low) / 2).pow(-2)

    @cached_property
    def spread(self) -> Tensor:
        """(n_state,) half-widths of the starts."""
        return self._of_states({**self.tolerance, **self.start}, 0.0)

    @cached_property
    def limit(self) -> Tensor:
        """(n_state,) deviations beyond which an episode has failed."""
        return self._of_states(self.limits, math.inf)

    @cached_property
    def held(self) -> Tensor:
        """(n_action,) the commands within their range that hold the goal best, by Newton's method."""
        low, high = self.command_range
        held = ((low + high) / 2).where((low > 0) | (high < 0), torch.zeros_like(low))
        ranges = torch.tensor([state.high - state.low for state in self.system.states], dtype=torch.float64)
        scale = self.weights.sqrt().where(self.weights > 0, FREE_STATE_WEIGHT / ranges)
        for _ in range(NEWTON_STEPS):
            rates = self._rates(held[None])[0]
            step = COMMAND_STEP * (high - low)
            by_command = (self._rates(held + step.diag()) - rates).T / step
            off, slopes = scale * rates, scale[:, None] * by_command
            if not bool(off.isfinite().all() and slopes.isfinite().all()):
                raise ValueError(f"goal: the derivative of a {self.system.name} is not finite there")
            held = torch.clamp(held - torch.linalg.pinv(slopes) @ off, low, high)
        return held

    def _rates(self, commands: Tensor, off: Tensor | float = 0.0) -> Tensor:
        """Rates (N, n_state) of the states at the goal, or `off` (n_state,) it, under commands (N, n_action)."""
        state = (self.at_goal + off).expand(len(commands), -1)
        return self.system.derivative(state, commands, commands.new_zeros(len(commands), len(self.system.loads)))

    def episode_steps(self, period: float) -> int:
        return steps_in(self.seconds, period)

    def deviation(self, state: Tensor) -> Tensor:
        """(..., n_state) how far states are from the goal."""
        return state - self.at_goal.to(state)

    def within_limits(self, state: Tensor) -> Tensor:
        """(B,) whether the episodes of states (B, n_state) go on."""
        return (self.deviation(state).abs() <= self.limit.to(state)).all(1)

    def first_state(self, batch: int, generator: torch.Generator) -> Tensor:
        """States (batch, n_state) in which episodes start."""
        goal, spread = self.at_goal.float(), self.spread.float()
        return goal + spread * (2 * torch.rand(batch, len(goal), generator=generator) - 1)

    def training_start(self, batch: int, progress: float, generator: torch.Generator) -> tuple[Tensor, Tensor]:
        state = self.first_state(batch, generator)
        return state, state[:, :0]

    def cost(self, states: Tensor, plan: Tensor, now: Tensor, task_state: Tensor) -> Tensor:
        off, beyond = self.deviation(states), plan - self.held.to(plan)
        cost = (self.weights.to(off) * off.square()).sum((1, 2))
        cost = cost + (self.command_weights.to(plan) * beyond.square()).sum((1, 2))
        if not self.to_go:
            return cost
        return cost + ((off[:, -1] @ off.new_tensor(self.to_go)) * off[:, -1]).sum(1)

    def diverged(self, state: Tensor, task_state: Tensor, progress: float) -> Tensor:
        widths = state.new_tensor([variable.high - variable.low for variable in self.system.states])
        near = (self.deviation(state).abs() <= widths).all(1)
        return ~(near & self.within_limits(state))  # also where a state is not a number


def steps_in(seconds: float, period: float) -> int:
    """Periods in an episode, at least one."""
    return max(1, round(seconds / period))


def read_task(path: str | os.PathLike[str], system: System) -> Regulate:
    """The task in a TOML file, whose tables and numbers have the names of the fields of `Regulate`.

    Raises:
        TaskFileError: the file is missing or no TOML, or a key is unknown, missing or impossible.

    >>> import pathlib, tempfile, visadapt as va
    >>> path = pathlib.Path(tempfile.mkdtemp()) / "task.toml"
    >>> _ = path.write_text("seconds = 8\\n[tolerance]\\nx = 0.5\\ntheta = 0.05\\n")
    >>> va.read_task(path, va.CartPole()).seconds
    8.0
    """
    given = read_toml(path, TaskFileError)
    known = (*TABLES, "effort", "seconds")
    for key, value in given.items():
        if key not in known:
            raise TaskFileError(f"{path}: unknown key {key!r}; there are {', '.join(known)}")
        if (key in TABLES) != isinstance(value, dict):
            right = f"a table, [{key}]" if key in TABLES else f"a number, {key} = 1.0"
            raise TaskFileError(f"{path}: {key} must be {right}")
    try:
        task = Regulate(system, **given)
    except ValueError as error:
        raise TaskFileError(f"{path}: {error}") from error
    return replace(task, effort=float(task.effort), seconds=float(task.seconds))
