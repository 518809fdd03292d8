"""The policy of a system of one's own that is brought to rest at a goal."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import torch
from torch import Tensor, nn

from visadapt.history import HORIZON, LENGTH, History
from visadapt.policies.base import Policy, ignore_correction
from visadapt.policies.networks import StateHistoryResidualNetwork, mlp
from visadapt.systems import System

WIDTH = 64  # of the MLP's layers
LARGEST_CORRECTION = 4.0
"""In units of the residual's scale, the root mean square of the gap. A linear map has no bound of
its own where a trajectory leaves the recorded states: without this one, tuning ended in NaN under a delay and a lag."""
FARTHEST = 1.25 * math.pi
"""rad from its goal up to which an angle's first reading is taken as it is; a pendulum may begin half a turn away."""
UNIT_PERIODS = 10  # Periods in which the unit of acceleration changes a velocity by its unit


class RegulatorPolicy(Policy):
    """A linear law of the state's distance from a goal, and an MLP on the last 5 states and actions that adds to it.

    The MLP adds nothing at first, so the policy begins as the linear law that it is given.

    Args:
        states: names of the states, with their units.
        goal: (n_state,) where the system is to rest.
        unit: (n_state,) typical distances from it.
        low, high: (n_action,) the ranges of the commands.
        task: the settings of its task, which it keeps: `Regulate.settings`.
        turning: names of angles in which the system is the same a turn further: a target may read them within a turn.

    >>> policy = RegulatorPolicy({"x": "m", "x_dot": "m/s"}, [0.5, 0.0], [0.1, 1.0], [-5.0], [5.0], {})
    >>> policy.act(History.start(torch.zeros(2, 2), n_action=1)).tolist()  # no law yet
    [[0.0], [0.0]]
    """

    goal: Tensor
    unit: Tensor
    low: Tensor
    high: Tensor

    def __init__(
        self,
        states: Mapping[str, str],
        goal: Sequence[float],
        unit: Sequence[float],
        low: Sequence[float],
        high: Sequence[float],
        task: Mapping[str, Any],
        turning: Sequence[str] = (),
    ) -> None:
        numbers = {"goal": list(goal), "unit": list(unit), "low": list(low), "high": list(high)}
        arguments = {"states": dict(states), **numbers, "task": dict(task), "turning": list(turning)}
        super().__init__(len(goal), len(low), arguments)
        self.turning = [list(states).index(name) for name in turning]
        self.states = dict(states)
        self.task = dict(task)
        for name, values in numbers.items():
            self.register_buffer(name, torch.tensor(values, dtype=torch.get_default_dtype()))
        self.law = nn.Linear(self.n_state, HORIZON * self.n_action)
        self.first = nn.Linear(LENGTH * (self.n_state + self.n_action) + self.n_state, WIDTH)
        self.rest = mlp(WIDTH, WIDTH, HORIZON * self.n_action)
        ignore_correction(self.first, self.n_state)
        for weight in (*self.law.parameters(), *self.rest[-1].parameters()):
            nn.init.zeros_(weight)

    @property
    def command_range(self) -> tuple[Tensor, Tensor]:
        return self.low, self.high

    def unwrapped(self, state: Tensor, before: Tensor | None) -> Tensor:
        """Of the angles that are `turning`: the turn nearest to that before and, at first, that of the goal, unless the
        reading is less than FARTHEST from it."""
        columns, out = self.turning, state.clone()
        away = state[:, columns] - (self.goal.to(state)[columns] if before is None else before[:, columns])
        turns = (away / (2 * math.pi)).round()
        if before is None:
            turns = torch.where(away.abs() > FARTHEST, turns, 0.0)
        out[:, columns] -= 2 * math.pi * turns
        return out

    def in_units(self, history: History) -> History:
        """Distances from the goal in the policy's units, and commands in [-1, 1]."""
        actions = (2 * history.actions - self.low - self.high) / (self.high - self.low)
        return History((history.observations - self.goal) / self.unit, actions)

    def embed(self, history: History) -> Tensor:
        seen = self.in_units(history)
        return torch.cat((seen.actions.flatten(1), seen.observations.flatten(1)), 1)

    def plan(self, inputs: Tensor, correction: Tensor) -> Tensor:
        now = inputs[:, -self.n_state :]
        return self.law(now) + self.rest(self.first(torch.cat((inputs, correction), 1)).tanh())

    def decide(self, inputs: Tensor, correction: Tensor) -> Tensor:
        share = super().decide(inputs, correction)
        return (self.low + self.high + (self.high - self.low) * share) / 2


class RegulatorResidualNetwork(StateHistoryResidualNetwork):
    """As `StateHistoryResidualNetwork`, in the units of a policy, which differ from state to state.

    Args:
        system: the source physics.
        period: s between actions.
        policy: gives the goal and the units.
    """

    acceleration_unit: Tensor

    def __init__(self, system: System, period: float, policy: RegulatorPolicy) -> None:
        super().__init__(system, period)
        self.in_units = policy.in_units
        velocities = [velocity for _, velocity in system.coordinates]
        self.register_buffer("acceleration_unit", policy.unit[velocities] / (UNIT_PERIODS * period))

    def embed(self, history: History) -> Tensor:
        seen = self.in_units(history)
        unexplained = self.unexplained(history.observations, history.actions) / self.acceleration_unit
        return torch.cat((seen.observations.flatten(1), seen.actions.flatten(1), unexplained.flatten(1)), 1)

    def forward(self, history: History) -> Tensor:
        return super().forward(history).clamp(-LARGEST_CORRECTION, LARGEST_CORRECTION)
