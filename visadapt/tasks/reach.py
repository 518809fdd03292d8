"""Fly through a point: the fixed wing's task."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import torch
from torch import Tensor

from visadapt.systems import FixedWing
from visadapt.systems.rigid_body import POSITION, RATES, VELOCITY
from visadapt.tasks.base import FlightTask

DEFAULT_WING = FixedWing()

FLIGHT_TIME_RATIO = 1.6  # A flight that is scored to one over the point's distance at the first speed


@dataclass(frozen=True)
class Reach(FlightTask):
    """Fly a fixed wing through a point ahead (section 3.1). A task state is that point, (B, 3) in m.

    The reference is the straight line from where the vehicle is to the point, flown at `speed` (A.1.2):
    C = sum_k along |e_k|^2 + (across - along) |e_k off the line|^2 + rates |omega|^2 + action |a|^2

    with e_k = x_{t+k} - nu_{t+k}. The paper weighs both by 10; but the score is the miss, not its time.
    """

    period: float = 0.05  # s between commands
    system: FixedWing = DEFAULT_WING  # whose level flight at `speed` flights start in
    distance: float = 50.0  # m ahead
    sideways: float = 5.0  # m: half-width of the uniform distribution of the point to the sides and up and down
    speed: float = 11.5  # m/s at the start, along x
    along: float = 1.0
    across: float = 30.0
    rates: float = 0.1
    action: float = 0.01
    start_spread: tuple[float, float, float] = (0.5, 0.5, 0.1)
    """standard deviation in m, m/s and rad/s of the start around the straight line"""
    divergence: float = 8.0  # m from the straight line at which a stream starts anew

    @property
    def steps(self) -> int:
        return round(FLIGHT_TIME_RATIO * self.distance / self.speed / self.period)

    @cached_property
    def _level(self) -> Tensor:
        """Level flight at the origin, (13,)."""
        return self.system.trim(torch.tensor([self.speed]))[0]

    def evaluation_start(self, batch: int, generator: torch.Generator) -> tuple[Tensor, Tensor]:
        """In level flight at the origin."""
        point = torch.full((batch, 3), self.distance)
        point[:, 1:] = self.sideways * (2 * torch.rand(batch, 2, generator=generator) - 1)
        return self._level.repeat(batch, 1), point

    def goal(self, task_state: Tensor) -> Tensor:
        return task_state

    def misses(self, states: Tensor, task_state: Tensor) -> Tensor:
        """The least distance (B, 1) between the point and the path, taken as straight between rows."""
        path = states[..., POSITION]
        start, piece = path[:, :-1], path.diff(dim=1)
        to_point = task_state[:, None] - start
        share = ((to_point * piece).sum(-1) / piece.square().sum(-1).clamp(min=1e-12)).clamp(0, 1)
        return (to_point - share[..., None] * piece).norm(dim=-1).amin(1, keepdim=True)

    def distance_off(self, state: Tensor, task_state: Tensor) -> Tensor:
        """The distance to the line from the start through the point."""
        direction = task_state / task_state.norm(dim=-1, keepdim=True)
        position = state[:, POSITION]
        return (position - (position * direction).sum(-1, keepdim=True) * direction).norm(dim=-1)

    def passed(self, state: Tensor, task_state: Tensor) -> Tensor:
        return (state[:, POSITION] * task_state).sum(-1) >= task_state.square().sum(-1)

    def training_start(self, batch: int, progress: float, generator: torch.Generator) -> tuple[Tensor, Tensor]:
        """In level flight somewhere on the way, half of the streams at its beginning."""
        state, task_state = self.evaluation_start(batch, generator)
        share = (2 * torch.rand(batch, 1, generator=generator) - 1).clamp(min=0)
        state[:, POSITION] += share * task_state
        for part, deviation in zip((POSITION, VELOCITY, RATES), self.start_spread, strict=True):
            state[:, part] += (share > 0) * deviation * torch.randn(batch, 3, generator=generator)
        return state, task_state

    def cost(self, states: Tensor, plan: Tensor, now: Tensor, task_state: Tensor) -> Tensor:
        to_point = task_state - now[:, POSITION]
        direction = to_point / to_point.norm(dim=1, keepdim=True).clamp_min(1e-3)
        flown = self.speed * self.period * torch.arange(1, states.shape[1] + 1).to(states)
        reference = now[:, None, POSITION] + flown[:, None] * direction[:, None]
        error = states[..., POSITION] - reference
        along_line = (error * direction[:, None]).sum(-1)
        # |e off the line|^2 is |e|^2 - |e along it|^2.
        return (
            (self.along - self.across) * along_line.square().sum(1)
            + self.across * error.square().sum((1, 2))
            + self.rates * states[..., RATES].square().sum((1, 2))
            + self.action * plan.square().sum((1, 2))
        )

    def diverged(self, state: Tensor, task_state: Tensor, progress: float) -> Tensor:
        """Too far off, or past the point."""
        return ~(self.distance_off(state, task_state) <= self.divergence) | (state[:, 0] >= task_state[:, 0])
