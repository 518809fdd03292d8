"""The tasks of flying: along a reference, or through a point."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from visadapt.systems.rigid_body import POSITION, RATES, VELOCITY
from visadapt.tasks.base import Task, curriculum
from visadapt.tasks.courses import AlongReferences, ToTarget

CANDIDATES = 64
"""rows of other references among which that most alike is looked for"""
NEAR = 0.01
"""A cost that is small: about that of a plan with 1 cm of error all along."""


@dataclass(frozen=True)
class FollowCost:
    """Weights of squared distances from the reference and of effort, A.1.1 of the paper.

    C = sum_k position |x - x_nu|^2 + velocity |v - v_nu|^2 + rates |omega|^2 + action |a|^2

    The paper holds thrust and rates near the middle of their range with weights of 5 and 0.1 on commands in [0, 1];
    what pulls the thrust towards hovering also pulls the vehicle off its reference, so `action` is small.
    """

    position: float = 10.0
    velocity: float = 1.0
    rates: float = 0.1
    action: float = 0.01

    def __call__(self, states: Tensor, plan: Tensor, reference: Tensor) -> Tensor:
        """Cost (B,) of states (B, K, 13) and actions (B, K, n_action); `reference` (B, K, 6): positions, velocities."""
        away = states[..., : VELOCITY.stop] - reference
        return (
            self.position * away[..., POSITION].square().sum((1, 2))
            + self.velocity * away[..., VELOCITY].square().sum((1, 2))
            + self.rates * states[..., RATES].square().sum((1, 2))
            + self.action * plan.square().sum((1, 2))
        )


@dataclass(frozen=True)
class RecoverCost(FollowCost):
    """The same for a vehicle that may be pushed further off its reference than a plan can bring it back.

    sqrt(C + final |e_K + beyond e'_K|^2 + NEAR), with e_K the distance at the end of the plan and e'_K its rate

    A plan that ends on the reference but not with its velocity flies through it and out again, further each time: what
    counts is where the vehicle would be `beyond` s later. The root changes no best plan, but lets the many streams that
    are near weigh as much as the few that are far off.
    """

    final: float = 10.0
    beyond: float = 1.0
    """s"""

    def __call__(self, states: Tensor, plan: Tensor, reference: Tensor) -> Tensor:
        away = (states[..., : VELOCITY.stop] - reference)[:, -1]
        later = away[:, POSITION] + self.beyond * away[:, VELOCITY]
        return (super().__call__(states, plan, reference) + self.final * later.square().sum(1) + NEAR).sqrt()


@dataclass(frozen=True)
class Follow(Task):
    """Fly along one of many references. A place is the course's."""

    course: AlongReferences
    cost_of: FollowCost = FollowCost()
    start_spread: tuple[float, float] = (0.1, 0.2)
    """standard deviation in m and m/s of the start around the reference"""
    divergence: float = 2.0
    """m, delta_div at the end of the curriculum: a stream further from its reference starts anew"""
    first_divergence: float = 0.05
    """share of `divergence` that the curriculum begins with; it reaches 1 at half of the iterations"""

    def begin(self, batch: int, progress: float, generator: torch.Generator) -> tuple[Tensor, Tensor]:
        """Somewhere on a reference, and a little off it."""
        positions = self.course.references.positions
        which = torch.randint(len(positions), (batch,), generator=generator).to(positions.device)
        row = torch.randint(self.course.last, (batch,), generator=generator).to(which)
        state = self.course.on(which, row)
        metres, speed = self.start_spread
        spread = torch.tensor([metres] * 3 + [speed] * 3)
        share = curriculum(self.first_divergence, progress)
        off = share * spread * torch.randn(batch, len(spread), generator=generator)
        state[:, : len(spread)] += off.to(state)
        return state, torch.stack((which, row), 1)

    def cost(self, states: Tensor, plan: Tensor, now: Tensor, place: Tensor) -> Tensor:
        return self.cost_of(states, plan, self.course.ahead(place))

    def diverged(self, state: Tensor, place: Tensor, progress: float) -> Tensor:
        limit = self.divergence * curriculum(self.first_divergence, progress)
        return ~(self.course.off(state, place) <= limit) | (place[:, 1] >= self.course.last)

    def show(self, seen: Tensor, place: Tensor) -> Tensor:
        return torch.cat((seen, self.course.goal(place)), 1)

    def advance(self, place: Tensor) -> Tensor:
        return self.course.advance(place)

    def augment(
        self, seen: Tensor, state: Tensor, place: Tensor, generator: torch.Generator
    ) -> tuple[Tensor, Tensor, Tensor]:
        """As far off another reference, where that is flown most alike.

        A vehicle that feels no air flies alike wherever it is and however fast: position and velocity change by as much
        in all rows. Of CANDIDATES rows of references at random the one with the most similar velocity and acceleration
        is taken, so that drag and tilt change little.
        """
        own, batch = self.course.references, len(seen)
        which = torch.randint(len(own.positions), (batch, CANDIDATES), generator=generator)
        row = torch.randint(place.shape[1] - 1, self.course.last, (batch, CANDIDATES), generator=generator)

        def motion(which: Tensor, row: Tensor) -> Tensor:
            return torch.cat((own.velocities[which, row], own.accelerations[which, row]), -1)

        now = place[:, -1]
        unlike = (motion(which, row) - motion(now[:, :1], now[:, 1:])).square().sum(-1)
        best = unlike.argmin(1, keepdim=True)
        chosen, until = which.gather(1, best)[:, 0], row.gather(1, best)[:, 0]
        shift = torch.zeros_like(state)
        for part, values in ((POSITION, own.positions), (VELOCITY, own.velocities)):
            shift[:, part] = values[chosen, until] - values[now[:, 0], now[:, 1]]
        back = torch.arange(1 - place.shape[1], 1)
        there = torch.stack((chosen[:, None].expand(-1, len(back)), until[:, None] + back), -1)
        return seen + shift[:, None], state + shift, there.to(place)


@dataclass(frozen=True)
class Reach(Task):
    """Fly a fixed wing through a point. A place is the point, (B, 3).

    The reference is the straight line from where the vehicle is to the point, flown at the course's speed (A.1.2):
    C = sum_k along |e_k|^2 + (across - along) |e_k off the line|^2 + rates |omega|^2 + action |a|^2

    with e_k = x_{t+k} - nu_{t+k}. The paper weighs both by 10; but what decides is to be on the line, not when.
    """

    course: ToTarget
    along: float = 1.0
    across: float = 30.0
    rates: float = 0.1
    action: float = 0.01
    start_spread: tuple[float, float, float] = (0.5, 0.5, 0.1)
    """standard deviation in m, m/s and rad/s of the start around the straight line"""
    divergence: float = 8.0
    """m from the straight line at which a stream starts anew"""

    def begin(self, batch: int, progress: float, generator: torch.Generator) -> tuple[Tensor, Tensor]:
        """In level flight somewhere on the way, half of the streams at its beginning."""
        state, place = self.course.start(batch, generator)
        share = (2 * torch.rand(batch, 1, generator=generator) - 1).clamp(min=0)
        state[:, POSITION] += share * place
        for part, deviation in zip((POSITION, VELOCITY, RATES), self.start_spread, strict=True):
            state[:, part] += (share > 0) * deviation * torch.randn(batch, 3, generator=generator)
        return state, place

    def cost(self, states: Tensor, plan: Tensor, now: Tensor, place: Tensor) -> Tensor:
        to = place - now[:, POSITION]
        way = to / to.norm(dim=1, keepdim=True).clamp_min(1e-3)
        steps = self.course.speed * self.course.period * torch.arange(1, states.shape[1] + 1).to(states)
        reference = now[:, None, POSITION] + steps[:, None] * way[:, None]
        away = states[..., POSITION] - reference
        behind = (away * way[:, None]).sum(-1).square()
        return (
            (self.along - self.across) * behind.sum(1)
            + self.across * away.square().sum((1, 2))
            + self.rates * states[..., RATES].square().sum((1, 2))
            + self.action * plan.square().sum((1, 2))
        )

    def diverged(self, state: Tensor, place: Tensor, progress: float) -> Tensor:
        """Too far off, or past the point."""
        return ~(self.course.off(state, place) <= self.divergence) | (state[:, 0] >= place[:, 0])

    def show(self, seen: Tensor, place: Tensor) -> Tensor:
        return torch.cat((seen, self.course.goal(place)), 1)
