"""A flight as a film shows it: interpolated between its rows, beside the course that it was to fly."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import torch
from torch import Tensor

from visadapt.evaluation.scoring import FAR
from visadapt.films.canvas import Floats
from visadapt.systems import RigidBody
from visadapt.systems.rigid_body import ATTITUDE, POSITION, VELOCITY, rotation
from visadapt.targets.rollout import Run
from visadapt.tasks.base import FlightTask
from visadapt.tasks.follow import Follow
from visadapt.tasks.reach import Reach
from visadapt.tasks.references import cubic

INSTANT_PERIOD_S = 0.02
"""s between the instants at which a flight is interpolated"""
LARGEST_DRAWN = 1e4
"""m, m/s and N: positions, velocities and forces are clipped to +- this before they are drawn"""


@dataclass(frozen=True)
class FlightPanel:
    """A flight and its task.

    Between rows, positions are cubic Hermite splines of the rows' positions and velocities, attitudes and forces are
    linear, and commands are held. Arrays are over instants (N, ...), INSTANT_PERIOD_S apart, unless stated otherwise.

    Raises:
        ValueError: a run without states of a rigid body, or longer than its reference; a task of another kind.
    """

    title: str
    run: Run
    vehicle: RigidBody
    task: FlightTask
    """`Follow`, or `Reach`"""
    task_state: Tensor
    """in which the flight began, in the task's own numbers: the first row of the episode's `task_state`"""
    earlier: FlightPanel | None = None
    """another flight, drawn faintly for comparison"""

    def __post_init__(self) -> None:
        if not isinstance(self.task, Follow | Reach):
            raise ValueError(
                f"panel {self.title!r}: no picture is known of a task {type(self.task).__name__}; "
                "Follow and Reach can be filmed"
            )
        state = self.run.episode.state
        if state is None or state.shape[1] != len(self.vehicle.states):
            raise ValueError(f"panel {self.title!r}: the run has no states of a {self.vehicle.name} to show")
        if isinstance(self.task, Follow) and len(state) > self.task.steps + 1:
            raise ValueError(
                f"panel {self.title!r}: the run has {len(state)} rows, its reference only {self.task.steps + 1}"
            )

    @property
    def follows(self) -> bool:
        """True where the task is a reference to follow, False where it is a point to fly through."""
        return isinstance(self.task, Follow)

    @cached_property
    def states(self) -> Floats:
        """(rows, 13) that are shown: a flight through a point is shown until 0.5 s after it passed the point."""
        state = self.run.episode.state
        assert state is not None
        clipped = np.array(state, float)
        clipped[:, : VELOCITY.stop] = clipped[:, : VELOCITY.stop].clip(-LARGEST_DRAWN, LARGEST_DRAWN)
        if self.follows:
            return clipped
        nearest = int(self._misses(clipped).argmin()) if len(clipped) > 1 else 0
        return clipped[: nearest + 2 + round(0.5 / self.task.period)]

    @property
    def end(self) -> float:
        """s, of the last row that is shown"""
        return (len(self.states) - 1) * self.task.period

    @cached_property
    def times(self) -> Floats:
        """(N,) s"""
        return np.arange(round(self.end / INSTANT_PERIOD_S) + 1) * INSTANT_PERIOD_S

    def instant(self, t: float) -> int:
        """The last instant at or before t s."""
        return min(max(int(t / INSTANT_PERIOD_S + 1e-6), 0), len(self.times) - 1)

    def row(self, instant: int) -> int:
        """The last row at or before an instant."""
        return min(int(self.times[instant] / self.task.period + 1e-6), len(self.states) - 1)

    @cached_property
    def position(self) -> Floats:
        """(N, 3) m"""
        return self._smooth(self.states[:, POSITION], self.states[:, VELOCITY], self.times)

    @cached_property
    def speed(self) -> Floats:
        """(N,) m/s"""
        velocity = self.states[:, VELOCITY]
        return self._between(np.linalg.norm(velocity, axis=1))

    @cached_property
    def attitude(self) -> Floats:
        """(N, 3, 3) from body to world axes"""
        turns = self.states[:, ATTITUDE]
        # A quaternion and its negative are the same attitude: choose signs so that neighbouring rows are close.
        flips = np.where((turns[1:] * turns[:-1]).sum(1) < 0, -1.0, 1.0)
        turns = turns * np.concatenate([[1.0], flips.cumprod()])[:, None]
        return rotation(torch.from_numpy(self._between(turns))).numpy()

    @cached_property
    def force(self) -> Floats:
        """(N, 3) N, zeros where the target does not know its disturbance"""
        force = self.run.force[: len(self.states)]
        if force.ndim == 1:
            force = np.zeros((len(force), 3))
        return self._between(force.clip(-LARGEST_DRAWN, LARGEST_DRAWN))

    def command(self, instant: int) -> Floats:
        """(4,) in [-1, 1], held from a row to the next"""
        return np.asarray(self.run.episode.action[self.row(instant)])

    @cached_property
    def reference(self) -> Floats:
        """(M, 3) m, the whole reference, INSTANT_PERIOD_S apart; or (2, 3), start and end of the line to the point."""
        if isinstance(self.task, Reach):
            return np.stack([self.states[0, POSITION], self.task_state.double().numpy()])
        whole, which = self._along.references, int(self.task_state[0])
        rows = slice(int(self.task_state[1]), None)
        positions, velocities = (part[which, rows].double().numpy() for part in (whole.positions, whole.velocities))
        count = round((len(positions) - 1) * whole.period / INSTANT_PERIOD_S) + 1
        return self._smooth(positions, velocities, np.arange(count) * INSTANT_PERIOD_S)

    @cached_property
    def goal(self) -> Floats:
        """(N, 3) m: where the reference is, or the point to fly through"""
        if self.follows:
            return self.reference[: len(self.times)]
        return np.repeat(self.reference[-1:], len(self.times), 0)

    @cached_property
    def away(self) -> Floats:
        """(N,) m, to the goal"""
        return np.asarray(np.linalg.norm(self.position - self.goal, axis=1))

    @cached_property
    def score(self) -> Floats:
        """(rows,) m, the score up to each row: the mean distance to the reference, or the least to the point."""
        if self.follows:
            every = round(self.task.period / INSTANT_PERIOD_S)
            away = self.away[::every]
            mean: Floats = away[1:].cumsum() / np.arange(1, len(away))
            return np.concatenate([away[:1], mean])
        return np.concatenate([self.away[:1], np.minimum.accumulate(self._misses(self.states))])

    def scored(self, instant: int) -> float:
        """m, the score up to the last row at or before an instant"""
        return float(self.score[self.row(instant)])

    @cached_property
    def distances(self) -> Floats:
        """(N,) m, to the goal; at the instant that is nearest to a point, the distance by which it was missed"""
        out = self.away.copy()
        if not self.follows:
            out[out.argmin()] = self.worst
        return out

    @cached_property
    def nearest(self) -> Floats:
        """(3,) m: where the path, straight between rows, came nearest to the point"""
        row = int(self.score.argmin())
        start, end = self.states[max(row - 1, 0), POSITION], self.states[row, POSITION]
        way = end - start
        share = float((self.reference[-1] - start) @ way / max(float(way @ way), 1e-12))
        return np.asarray(start + min(max(share, 0.0), 1.0) * way)

    @cached_property
    def passed(self) -> float:
        """s at which the flight came nearest to its point"""
        return float(self.score.argmin() * self.task.period)

    @cached_property
    def failed(self) -> float | None:
        """s at which the flight failed, more than FAR off or lost; None where it did not."""
        lost = None if self.run.survived else self.end
        if self.follows:
            far = np.flatnonzero(self.away > FAR)
            return float(self.times[far[0]]) if len(far) else lost
        return self.passed if self.score[-1] > FAR else lost

    @cached_property
    def worst(self) -> float:
        """m: the greatest distance from the reference, or the distance by which the point was missed"""
        return float(self.away.max() if self.follows else self.score[-1])

    @property
    def _along(self) -> Follow:
        assert isinstance(self.task, Follow)
        return self.task

    def _misses(self, states: Floats) -> Floats:
        """(rows - 1,) m: the least distance to the point over each step."""
        steps = torch.from_numpy(np.stack([states[:-1], states[1:]], 1))
        return np.asarray(self.task.misses(steps, self.task_state.double().expand(len(steps), 3))[:, 0])

    def _smooth(self, values: Floats, slopes: Floats, times: Floats) -> Floats:
        """Values (M, n) at times (M,) of the cubic Hermite splines of values and slopes (rows, n)."""
        if len(values) == 1:
            return values
        rows = torch.arange(len(values)).double() * self.task.period
        return cubic(rows, torch.from_numpy(values), torch.from_numpy(slopes), torch.from_numpy(times)).numpy()

    def _between(self, values: Floats) -> Floats:
        """Values (N, ...) at the instants, linear between rows (rows, ...)."""
        at = self.times / self.task.period
        row = np.minimum(at.astype(int), max(len(values) - 2, 0))
        share = (at - row).reshape(-1, *[1] * (values.ndim - 1))
        return np.asarray(values[row] * (1 - share) + values[np.minimum(row + 1, len(values) - 1)] * share)
