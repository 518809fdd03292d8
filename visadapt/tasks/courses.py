"""Courses: what a vehicle is to fly, where a flight starts, and how far it misses."""

from __future__ import annotations

from abc import ABC, abstractmethod

import torch
from torch import Tensor

from visadapt.history import HORIZON
from visadapt.systems import FixedWing
from visadapt.systems.rigid_body import POSITION
from visadapt.tasks.differential_flatness import demanded
from visadapt.tasks.references import Reference


class Course(ABC):
    """A kind of flight. A place (B, ...) is where a flight is on its course: a tensor of the course's own."""

    steps: int
    """of a flight"""

    @abstractmethod
    def start(self, batch: int, generator: torch.Generator) -> tuple[Tensor, Tensor]:
        """States (batch, 13) at the start of flights, and their places."""

    @abstractmethod
    def goal(self, place: Tensor) -> Tensor:
        """What a policy is told of the course at places: (B, n_goal)."""

    @abstractmethod
    def misses(self, states: Tensor, place: Tensor) -> Tensor:
        """How far flights (B, steps + 1, 13) from a start at `place` were off, in m: (B, any); their mean counts."""

    @abstractmethod
    def off(self, states: Tensor, place: Tensor) -> Tensor:
        """How far vehicles in states (B, 13) are from where, or from the line on which, they should be, in m (B,)."""

    def advance(self, place: Tensor) -> Tensor:
        """The places a step later."""
        return place


class AlongReferences(Course):
    """Follow one of many references (N, T, 3) from its first row to its last. A place is (reference, row)."""

    def __init__(self, references: Reference) -> None:
        self.references = references
        self.last = references.positions.shape[1] - 1
        self.steps = self.last

    def start(self, batch: int, generator: torch.Generator) -> tuple[Tensor, Tensor]:
        """References without repetition, as far as there are so many."""
        count = len(self.references.positions)
        drawn = [torch.randperm(count, generator=generator) for _ in range(-(-batch // count))]
        which = torch.cat(drawn)[:batch].to(self.references.positions.device)
        row = torch.zeros_like(which)
        return self.on(which, row), torch.stack((which, row), 1)

    def goal(self, place: Tensor) -> Tensor:
        return self.ahead(place).flatten(1)

    def advance(self, place: Tensor) -> Tensor:
        return place + place.new_tensor((0, 1))

    def misses(self, states: Tensor, place: Tensor) -> Tensor:
        """The distance to the reference at every row but the first (the paper's average tracking error)."""
        return (states[..., POSITION] - self.references.positions[place[:, 0]]).norm(dim=-1)[:, 1:]

    def off(self, states: Tensor, place: Tensor) -> Tensor:
        rows = place[:, 1].clamp(max=self.last)
        return (states[:, POSITION] - self.references.positions[place[:, 0], rows]).norm(dim=-1)

    def on(self, which: Tensor, row: Tensor) -> Tensor:
        """The quadrotor's states (B, 13) on the references `which` (B,) at rows (B,)."""
        own = self.references
        every = (own.positions, own.velocities, own.accelerations, own.jerks)
        position, velocity, acceleration, jerk = (values[which, row] for values in every)
        return demanded(acceleration, jerk).state(position, velocity)

    def ahead(self, place: Tensor) -> Tensor:
        """Positions and velocities (B, HORIZON, 6) after the rows of `place`; beyond its end a reference goes on."""
        which = place[:, :1]
        rows = place[:, 1:] + torch.arange(1, HORIZON + 1).to(place)
        beyond = (rows - self.last).clamp(min=0)[..., None] * self.references.period
        rows = rows.clamp(max=self.last)
        velocity = self.references.velocities[which, rows]
        return torch.cat((self.references.positions[which, rows] + beyond * velocity, velocity), -1)


class ToTarget(Course):
    """Fly a fixed wing through a point ahead (section 3.1). A place is the target's position (B, 3) in m."""

    distance = 50.0
    """m ahead"""
    sideways = 5.0
    """m: half-width of the uniform distribution of the target to the sides and up and down"""
    speed = 11.5
    """m/s at the start, along x"""

    def __init__(self, period: float, system: FixedWing | None = None) -> None:
        self.period = period
        self.steps = round(1.6 * self.distance / self.speed / period)
        self._start = (system or FixedWing()).trim(torch.tensor([self.speed]))[0]

    def start(self, batch: int, generator: torch.Generator) -> tuple[Tensor, Tensor]:
        """In trimmed level flight at the origin."""
        place = torch.full((batch, 3), self.distance)
        place[:, 1:] = self.sideways * (2 * torch.rand(batch, 2, generator=generator) - 1)
        return self._start.repeat(batch, 1), place

    def goal(self, place: Tensor) -> Tensor:
        return place

    def misses(self, states: Tensor, place: Tensor) -> Tensor:
        """The least distance (B, 1) between the target and the path, taken as straight between rows."""
        path = states[..., POSITION]
        start, way = path[:, :-1], path.diff(dim=1)
        to = place[:, None] - start
        share = ((to * way).sum(-1) / way.square().sum(-1).clamp(min=1e-12)).clamp(0, 1)
        return (to - share[..., None] * way).norm(dim=-1).amin(1, keepdim=True)

    def off(self, states: Tensor, place: Tensor) -> Tensor:
        """The distance to the line from the start through the point."""
        along = place / place.norm(dim=-1, keepdim=True)
        flown = states[:, POSITION]
        return (flown - (flown * along).sum(-1, keepdim=True) * along).norm(dim=-1)
