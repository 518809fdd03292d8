"""Follow a reference: the quadrotor's task."""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from visadapt.history import HORIZON
from visadapt.systems.rigid_body import ATTITUDE, POSITION, RATES, VELOCITY, matvec, rotation
from visadapt.tasks.base import FlightTask, curriculum
from visadapt.tasks.differential_flatness import demanded
from visadapt.tasks.references import Reference


def turning(states: Tensor) -> Tensor:
    """The angular velocity (B, K, 3) in world axes, rad/s, of states (B, K, 13)."""
    turned = rotation(states[..., ATTITUDE].flatten(0, 1)).unflatten(0, states.shape[:2])
    return matvec(turned, states[..., RATES])


@dataclass(frozen=True)
class FollowCost:
    """Weights of squared distances from the reference and of effort, after A.1.1 of the paper.

    C = sum_k position |x - x_nu|^2 + velocity |v - v_nu|^2 + turning |omega - omega_nu|^2 + action |a|^2

    omega is the angular velocity in world axes, rad/s. The paper weighs omega itself, by 0.1, and holds thrust and
    rates near the middle of their range, by 5 and 0.1 on commands in [0, 1]. Such terms, which pull the thrust towards
    hovering and omega towards zero, also pull the vehicle off its reference. With little weight on them, a policy that
    is trained without motor lag may answer small errors with nearly its full body rates, and where the motors lag it
    oscillates ever more. A weight on the difference, omega - omega_nu, avoids both.
    """

    position: float = 10.0
    velocity: float = 1.0
    turning: float = 1.0
    action: float = 0.01

    def __call__(self, states: Tensor, plan: Tensor, reference: Tensor) -> Tensor:
        """Cost (B,) of states (B, K, 13) and actions (B, K, n_action).

        `reference` (B, K, 9): positions, velocities and angular velocities in world axes.
        """
        away = torch.cat((states[..., : VELOCITY.stop], turning(states)), -1) - reference
        return (
            self.position * away[..., POSITION].square().sum((1, 2))
            + self.velocity * away[..., VELOCITY].square().sum((1, 2))
            + self.turning * away[..., VELOCITY.stop :].square().sum((1, 2))
            + self.action * plan.square().sum((1, 2))
        )


@dataclass(frozen=True)
class RecoverCost(FollowCost):
    """The same for a vehicle that may be pushed further off its reference than a plan can bring it back.

    sqrt(C + final |e_K + beyond e'_K|^2 + floor), with e_K the distance at the end of the plan and e'_K its rate

    A plan that ends on the reference but not with its velocity flies through it and out again, further each time: what
    counts is where the vehicle would be `beyond` s later. The root changes no best plan, but gives the many streams
    near their references as much weight as the few that are far off. Turning costs little, since a vehicle that is
    pushed has to turn fast.
    """

    turning: float = 0.1
    final: float = 10.0
    beyond: float = 1.0  # s
    floor: float = 0.01  # keeps the root differentiable at zero; about the cost of a plan with 1 cm of error all along

    def __call__(self, states: Tensor, plan: Tensor, reference: Tensor) -> Tensor:
        away = states[:, -1, : VELOCITY.stop] - reference[:, -1, : VELOCITY.stop]
        later = away[:, POSITION] + self.beyond * away[:, VELOCITY]
        return (super().__call__(states, plan, reference) + self.final * later.square().sum(1) + self.floor).sqrt()


@dataclass(frozen=True)
class Follow(FlightTask):
    """Fly along one of many references, or a single one, from its first row to its last.

    A task state is (reference, row).
    """

    references: Reference  # (N, T, 3)
    plan_cost: FollowCost = FollowCost()
    start_spread: tuple[float, float] = (0.1, 0.2)  # standard deviation in m and m/s of the start around the reference
    divergence: float = 2.0
    """m, delta_div at the end of the curriculum: a stream further from its reference starts anew"""
    first_divergence: float = 0.05
    """share of `divergence` that the curriculum begins with; it reaches 1 at half of the iterations"""
    candidates: int = 64  # rows of references drawn at random, of which `augment` takes the most similar one
    gravity: float = 9.81  # m/s2, in which a quadrotor is to fly along them

    def __post_init__(self) -> None:
        object.__setattr__(self, "references", self.references.as_many())

    def to(self, like: Tensor) -> Follow:
        return replace(self, references=self.references.to(like))

    @property
    def period(self) -> float:
        return self.references.period

    @property
    def steps(self) -> int:
        return self.references.positions.shape[1] - 1

    def evaluation_start(self, batch: int, generator: torch.Generator) -> tuple[Tensor, Tensor]:
        """At the first rows of references drawn without replacement while they last."""
        count = len(self.references.positions)
        drawn = [torch.randperm(count, generator=generator) for _ in range(-(-batch // count))]
        which = torch.cat(drawn)[:batch].to(self.references.positions.device)
        row = torch.zeros_like(which)
        return self.states_on(which, row), torch.stack((which, row), 1)

    def training_start(self, batch: int, progress: float, generator: torch.Generator) -> tuple[Tensor, Tensor]:
        """Somewhere on a reference, and a little off it."""
        positions = self.references.positions
        which = torch.randint(len(positions), (batch,), generator=generator).to(positions.device)
        row = torch.randint(self.steps, (batch,), generator=generator).to(which)
        state = self.states_on(which, row)
        state = state + curriculum(self.first_divergence, progress) * self._spread(state, generator)
        return state, torch.stack((which, row), 1)

    def cost(self, states: Tensor, plan: Tensor, now: Tensor, task_state: Tensor) -> Tensor:
        return self.plan_cost(states, plan, torch.cat((self.ahead(task_state), self._turning_ahead(task_state)), -1))

    def diverged(self, state: Tensor, task_state: Tensor, progress: float) -> Tensor:
        limit = self.divergence * curriculum(self.first_divergence, progress)
        return ~(self.distance_off(state, task_state) <= limit) | (task_state[:, 1] >= self.steps)

    def goal(self, task_state: Tensor) -> Tensor:
        return self.ahead(task_state).flatten(1)

    def advance(self, task_state: Tensor) -> Tensor:
        return task_state + task_state.new_tensor((0, 1))

    def misses(self, states: Tensor, task_state: Tensor) -> Tensor:
        """The distance to the reference at every row but the first (the paper's average tracking error)."""
        course = self.references.positions[task_state[:, 0], : states.shape[1]]
        return (states[..., POSITION] - course).norm(dim=-1)[:, 1:]

    def distance_off(self, state: Tensor, task_state: Tensor) -> Tensor:
        rows = task_state[:, 1].clamp(max=self.steps)
        return (state[:, POSITION] - self.references.positions[task_state[:, 0], rows]).norm(dim=-1)

    def states_on(self, which: Tensor, row: Tensor) -> Tensor:
        """The quadrotor's states (..., 13) on the references `which` (...,) at rows (...,)."""
        own = self.references
        every = (own.positions, own.velocities, own.accelerations, own.jerks)
        position, velocity, acceleration, jerk = (values[which, row] for values in every)
        return demanded(acceleration, jerk, self.gravity).state(position, velocity)

    def ahead(self, task_state: Tensor) -> Tensor:
        """Positions and velocities (B, HORIZON, 6) of the next rows; at its end a reference goes straight on."""
        which, rows = self._rows_ahead(task_state)
        beyond = (rows - self.steps).clamp(min=0)[..., None] * self.period
        rows = rows.clamp(max=self.steps)
        velocity = self.references.velocities[which, rows]
        return torch.cat((self.references.positions[which, rows] + beyond * velocity, velocity), -1)

    def _turning_ahead(self, task_state: Tensor) -> Tensor:
        """Angular velocities (B, HORIZON, 3), in world axes, of the next rows; zero beyond the end of a reference."""
        which, rows = self._rows_ahead(task_state)
        return turning(self.states_on(which, rows.clamp(max=self.steps))).masked_fill(rows[..., None] > self.steps, 0.0)

    def _rows_ahead(self, task_state: Tensor) -> tuple[Tensor, Tensor]:
        """References (B, 1) and the next rows (B, HORIZON) of each, of which some may be beyond its end."""
        return task_state[:, :1], task_state[:, 1:] + torch.arange(1, HORIZON + 1).to(task_state)

    def augment(
        self, observed: Tensor, state: Tensor, task_state: Tensor, generator: torch.Generator
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Histories shifted to another reference: they keep their errors, and a random error is added.

        Without aerodynamic forces a motion does not depend on position and velocity, so these are shifted by the same
        amount in all rows. Of `candidates` rows of references drawn at random, the one with the most similar velocity
        and acceleration is taken, so that drag and tilt change little. The random error has the `start_spread` of other
        starts: recorded errors are few, and smaller than those that a gust causes under a new policy.
        """
        references, length = self.references, task_state.shape[1]
        draws, device = (len(observed), self.candidates), references.positions.device
        which = torch.randint(len(references.positions), draws, generator=generator).to(device)
        row = torch.randint(length - 1, self.steps, draws, generator=generator).to(device)

        def motion(which: Tensor, row: Tensor) -> Tensor:
            return torch.cat((references.velocities[which, row], references.accelerations[which, row]), -1)

        now = task_state[:, -1]
        difference = (motion(which, row) - motion(now[:, :1], now[:, 1:])).square().sum(-1)
        best = difference.argmin(1, keepdim=True)
        chosen, last_row = which.gather(1, best)[:, 0], row.gather(1, best)[:, 0]
        shift = torch.zeros_like(state)
        for part, values in ((POSITION, references.positions), (VELOCITY, references.velocities)):
            shift[:, part] = values[chosen, last_row] - values[now[:, 0], now[:, 1]]
        shift = shift + self._spread(state, generator)
        rows = last_row[:, None] + torch.arange(1 - length, 1).to(row)
        shifted = torch.stack((chosen[:, None].expand_as(rows), rows), -1)
        return observed + shift[:, None], state + shift, shifted.to(task_state)

    def _spread(self, state: Tensor, generator: torch.Generator) -> Tensor:
        """Random differences of position and velocity, zeros elsewhere; as large as `state` (B, 13)."""
        position, velocity = self.start_spread
        spread = torch.tensor([position] * 3 + [velocity] * 3)
        off = torch.zeros_like(state)
        off[:, : len(spread)] = (spread * torch.randn(len(state), len(spread), generator=generator)).to(state)
        return off
