"""A flight as a film shows it: on a clock finer than the commands', with what it was to follow or fly through."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from visadapt.evaluation.flight_score import FAR
from visadapt.films.drawing3d import Floats
from visadapt.systems import RigidBody
from visadapt.systems.rigid_body import ATTITUDE, POSITION, VELOCITY, rotation
from visadapt.targets.rollout import Run
from visadapt.tasks.flight import FlightTask
from visadapt.tasks.follow import Follow
from visadapt.tasks.reach import Reach
from visadapt.tasks.references import cubic

FINE = 0.02
"""s between instants"""
AFTER = 0.5
"""s that a flight is shown for after it passed its target"""
LIMIT = 1e4
"""m, and m/s: a flight that strays further is shown as if it were there"""


@dataclass(frozen=True)
class FlownPanel:
    """A flight, and the task that it flew.

    Between rows, positions are cubics through the rows' positions and velocities, attitudes and forces are
    interpolated, and commands are held. Arrays are over instants (N, ...), FINE apart, unless they say otherwise.

    Raises:
        ValueError: a run without states of a rigid body, or longer than its reference; a task of another kind.
    """

    title: str
    run: Run
    vehicle: RigidBody
    task: FlightTask
    """`Follow`, or `Reach`"""
    task_state: Tensor
    """in which the flight began: one of `FlightTarget.first`"""
    earlier: FlownPanel | None = None
    """a flight to compare with, drawn faintly"""

    def __post_init__(self) -> None:
        if not isinstance(self.task, Follow | Reach):
            raise ValueError(f"panel {self.title!r}: no picture is known of a task {type(self.task).__name__}")
        state = self.run.episode.state
        if state is None or state.shape[1] != len(self.vehicle.states):
            raise ValueError(f"panel {self.title!r}: the run has no states of a {self.vehicle.name} to show")
        if isinstance(self.task, Follow) and len(state) > self.task.steps + 1:
            raise ValueError(
                f"panel {self.title!r}: the run has {len(state)} rows, its reference {self.task.steps + 1}"
            )

    @property
    def follows(self) -> bool:
        """Whether the flight is to follow a reference, and not to fly through a point."""
        return isinstance(self.task, Follow)

    @cached_property
    def states(self) -> Floats:
        """(rows, 13) that are shown: those of a flight through a point end soon after it is passed."""
        state = self.run.episode.state
        assert state is not None
        held = np.array(state, float)
        held[:, : VELOCITY.stop] = held[:, : VELOCITY.stop].clip(-LIMIT, LIMIT)
        if self.follows:
            return held
        nearest = int(self._misses(held).argmin()) if len(held) > 1 else 0
        return held[: nearest + 2 + round(AFTER / self.task.period)]

    @property
    def end(self) -> float:
        """s, of the last row that is shown"""
        return (len(self.states) - 1) * self.task.period

    @cached_property
    def times(self) -> Floats:
        """(N,) s"""
        return np.arange(round(self.end / FINE) + 1) * FINE

    def instant(self, t: float) -> int:
        """The last instant at or before t s."""
        return min(max(int(t / FINE + 1e-6), 0), len(self.times) - 1)

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
        # A quaternion and its negative are one attitude: take those that are near each other.
        flips = np.where((turns[1:] * turns[:-1]).sum(1) < 0, -1.0, 1.0)
        turns = turns * np.concatenate([[1.0], flips.cumprod()])[:, None]
        return rotation(torch.from_numpy(self._between(turns))).numpy()

    @cached_property
    def force(self) -> Floats:
        """(N, 3) N"""
        told = self.run.force[: len(self.states)]
        known = told if told.ndim == 2 else np.zeros((len(told), 3))  # of a target that does not tell
        return self._between(known.clip(-LIMIT, LIMIT))

    def command(self, instant: int) -> Floats:
        """(4,), held from a row to the next"""
        return np.asarray(self.run.episode.action[self.row(instant)])

    @cached_property
    def reference(self) -> Floats:
        """(M, 3) m, the whole reference from its start, FINE apart; or the straight line to the point, (2, 3)."""
        if isinstance(self.task, Reach):
            return np.stack([self.states[0, POSITION], self.task_state.double().numpy()])
        whole, which = self._along.references, int(self.task_state[0])
        rows = slice(int(self.task_state[1]), None)
        positions, velocities = (part[which, rows].double().numpy() for part in (whole.positions, whole.velocities))
        count = round((len(positions) - 1) * whole.period / FINE) + 1
        return self._smooth(positions, velocities, np.arange(count) * FINE)

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
        """(rows,) m up to each row, as flights are scored: the mean distance, or the nearest that it came."""
        if self.follows:
            every = round(self.task.period / FINE)
            away = self.away[::every]
            mean: Floats = away[1:].cumsum() / np.arange(1, len(away))
            return np.concatenate([away[:1], mean])
        return np.concatenate([self.away[:1], np.minimum.accumulate(self._misses(self.states))])

    def scored(self, instant: int) -> float:
        """m, the score up to the last row at or before an instant"""
        return float(self.score[self.row(instant)])

    @cached_property
    def distances(self) -> Floats:
        """(N,) m, to the goal, that of the instant of passing a target being how far it was missed"""
        out = self.away.copy()
        if not self.follows:
            out[out.argmin()] = self.worst
        return out

    @cached_property
    def nearest(self) -> Floats:
        """(3,) m: where the path, taken as straight between rows, came nearest to the target"""
        row = int(self.score.argmin())
        start, end = self.states[max(row - 1, 0), POSITION], self.states[row, POSITION]
        way = end - start
        share = float((self.reference[-1] - start) @ way / max(float(way @ way), 1e-12))
        return np.asarray(start + min(max(share, 0.0), 1.0) * way)

    @cached_property
    def passed(self) -> float:
        """s at which a flight came nearest to its target"""
        return float(self.score.argmin() * self.task.period)

    @cached_property
    def failed(self) -> float | None:
        """s at which the flight is known to have failed; None where it did not."""
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
        """(rows - 1,) m: how near each step of a flight came to its target."""
        steps = torch.from_numpy(np.stack([states[:-1], states[1:]], 1))
        return np.asarray(self.task.misses(steps, self.task_state.double().expand(len(steps), 3))[:, 0])

    def _smooth(self, values: Floats, slopes: Floats, times: Floats) -> Floats:
        """Values (M, n) at times (M,) of the cubics through values and slopes (rows, n)."""
        if len(values) == 1:
            return values
        rows = torch.arange(len(values)).double() * self.task.period
        return cubic(rows, torch.from_numpy(values), torch.from_numpy(slopes), torch.from_numpy(times)).numpy()

    def _between(self, values: Floats) -> Floats:
        """Values (N, ...) at the instants, linear between rows (rows, ...)."""
        at = self.times / self.task.period
        row = np.minimum(at.astype(int), max(len(values) - 2, 0))
        share = (at - row).reshape(-1, *[1] * (values.ndim - 1))
        following: NDArray[np.intp] = np.minimum(row + 1, len(values) - 1)
        return np.asarray(values[row] * (1 - share) + values[following] * share)
