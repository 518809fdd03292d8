"""A flight as a film shows it: interpolated between its rows, beside the course that it was to fly."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from visadapt.evaluation.scoring import FAR
from visadapt.films.widgets import Floats, running_mean
from visadapt.interpolation import cubic
from visadapt.systems import RigidBody
from visadapt.systems.rigid_body import ATTITUDE, POSITION, VELOCITY, continuous_quaternion, rotation
from visadapt.targets.rollout import Run
from visadapt.tasks.base import FlightTask
from visadapt.tasks.follow import Follow
from visadapt.tasks.reach import Reach
from visadapt.tasks.references import Reference

INSTANT_PERIOD_S = 0.02
"""s between the instants at which a flight is interpolated"""
SHOWN_AFTER_PASSING_S = 0.5
"""s for which a flight is shown after it passed its point"""
LARGEST_DRAWN = 1e4
"""m, m/s and N: positions, velocities and forces are clipped to +- this before they are drawn"""


class FlightPanel:
    """A flight and its task.

    Between rows, positions are cubic Hermite splines of the rows' positions and velocities, attitudes and forces are
    linear, and commands are held. A flight through a point is shown until 0.5 s after it passed the point.

    Args:
        title: of the panel.
        run: of the vehicle.
        vehicle: whose sizes are drawn.
        task: `Follow`, or `Reach`.
        task_state: in which the flight began, in the task's own numbers: the first of the episode's `task_state`.

    Attributes:
        follows: True where the task is a reference to follow, False where it is a point to fly through.
        states: (rows, 13) that are shown.
        times: (N,) s, the instants, INSTANT_PERIOD_S apart.
        rows: (N,) the last row at or before each instant.
        position, speed, attitude, force: (N, 3) m, (N,) m/s, (N, 3, 3) from body to world axes, (N, 3) N, zeros where
            the run does not know its force.
        reference: (M, 3) m, the whole reference at instants; or (2, 3), start and end of the line to the point.
        goal: (N, 3) m, where the reference is, or the point.
        away: (N,) m, to the goal; at the instant nearest to a point, the distance by which it was missed.
        score: (N,) m, of the rows so far: the mean distance to the reference, or the least to the point.
        nearest: (3,) m, where the path, straight between rows, came nearest to the point.
        worst: m, the greatest distance from the reference, or the distance by which the point was missed.
        passed: s at which the flight came nearest to its point.
        failed: s at which the flight failed: it was first more than FAR from its reference, it passed its point at more
            than FAR, or it ended early. None if it did not fail.

    Raises:
        ValueError: a run without states of a rigid body, or longer than its reference; a task of another kind.
    """

    def __init__(self, title: str, run: Run, vehicle: RigidBody, task: FlightTask, task_state: Tensor) -> None:
        if not isinstance(task, Follow | Reach):
            kind = type(task).__name__
            raise ValueError(f"panel {title!r}: no picture is known of a task {kind}; Follow and Reach can be filmed")
        state = run.episode.state
        if state is None or state.shape[1] != len(vehicle.states):
            raise ValueError(f"panel {title!r}: the run has no states of a {vehicle.name} to show")
        if isinstance(task, Follow) and len(state) > task.steps + 1:
            raise ValueError(f"panel {title!r}: the run has {len(state)} rows, its reference only {task.steps + 1}")
        self.title, self.run, self.vehicle, self.period = title, run, vehicle, task.period
        self.follows = isinstance(task, Follow)
        states = np.array(state, float)
        states[:, : VELOCITY.stop] = states[:, : VELOCITY.stop].clip(-LARGEST_DRAWN, LARGEST_DRAWN)
        if isinstance(task, Reach):
            misses = _misses(task, states, task_state)
            first = int(misses.argmin()) + 1 if len(misses) else 0
            states = states[: first + 1 + round(SHOWN_AFTER_PASSING_S / task.period)]
        self.states = states
        self.end = (len(states) - 1) * task.period
        self.times: Floats = np.arange(round(self.end / INSTANT_PERIOD_S) + 1) * INSTANT_PERIOD_S
        self.rows = np.minimum((self.times / task.period + 1e-6).astype(int), len(states) - 1)
        self.position = self._spline(states[:, POSITION], states[:, VELOCITY], self.times)
        self.speed = self._linear(np.linalg.norm(states[:, VELOCITY], axis=1))
        quaternions = continuous_quaternion(torch.from_numpy(states[:, ATTITUDE])).numpy()
        self.attitude: Floats = rotation(torch.from_numpy(self._linear(quaternions))).numpy()
        force = np.zeros((len(states), 3)) if run.force is None else run.force[: len(states)]
        self.force = self._linear(force.clip(-LARGEST_DRAWN, LARGEST_DRAWN))
        ended_early = None if run.survived else self.end
        if isinstance(task, Follow):
            self._along(task.references, int(task_state[0]), int(task_state[1]), ended_early)
        else:
            self._past(task_state.double().numpy(), misses[: len(states) - 1], ended_early)

    def _along(self, course: Reference, which: int, start: int, ended_early: float | None) -> None:
        """What is shown of a flight along one of the references, from its row `start` on; `ended_early` is the time in
        s at which the flight did, None where it did not."""
        positions, slopes = (part[which, start:].double().numpy() for part in (course.positions, course.velocities))
        count = round((len(positions) - 1) * course.period / INSTANT_PERIOD_S) + 1
        self.reference = self._spline(positions, slopes, np.arange(count) * INSTANT_PERIOD_S)
        self.goal = self.reference[: len(self.times)]
        self.away: Floats = np.linalg.norm(self.position - self.goal, axis=1)
        at_rows = np.linalg.norm(self.states[:, POSITION] - positions[: len(self.states)], axis=1)
        self.score: Floats = np.concatenate([at_rows[:1], running_mean(at_rows[1:])])[self.rows]
        self.worst, self.passed = float(self.away.max()), self.end
        far = np.flatnonzero(self.away > FAR)
        self.failed = float(self.times[far[0]]) if len(far) else ended_early

    def _past(self, point: Floats, misses: Floats, ended_early: float | None) -> None:
        """What is shown of a flight through a point (3,), which it misses by `misses` (rows - 1,) m in each period."""
        states = self.states
        self.reference = np.stack([states[0, POSITION], point])
        self.goal = np.tile(point, (len(self.times), 1))
        self.away = np.linalg.norm(self.position - self.goal, axis=1)
        least = np.minimum.accumulate(np.concatenate([self.away[:1], misses]))
        self.score, self.worst, row = least[self.rows], float(least[-1]), int(least.argmin())
        self.away[self.away.argmin()] = self.worst
        self.passed = row * self.period
        self.failed = self.passed if self.worst > FAR else ended_early
        before = states[max(row - 1, 0), POSITION]
        piece = states[row, POSITION] - before
        share = float((point - before) @ piece / max(float(piece @ piece), 1e-12))
        self.nearest: Floats = before + min(max(share, 0.0), 1.0) * piece

    def command(self, instant: int) -> Floats | None:
        """(4,) in [-1, 1], held from a row to the next; None in the episode's last row"""
        row = self.rows[instant]
        return self.run.episode.action[row] if row < len(self.run.episode.time) - 1 else None

    def lost(self, instant: int) -> bool:
        """Whether the flight has ended early by an instant."""
        return not self.run.survived and instant == len(self.times) - 1

    def failure(self, instant: int) -> str:
        """In words, how a flight that has failed by an instant did so."""
        if self.lost(instant):
            return f"LOST at t = {self.end:.2f} s"
        return f"STRAYED at t = {self.failed:.2f} s" if self.follows else f"MISSED by {length_text(self.worst)}"

    def _spline(self, values: Floats, slopes: Floats, times: Floats) -> Floats:
        """Values (M, n) at times (M,) of the cubic Hermite splines of values and slopes (rows, n)."""
        if len(values) == 1:
            return values
        rows = torch.arange(len(values)).double() * self.period
        return cubic(rows, torch.from_numpy(values), torch.from_numpy(slopes), torch.from_numpy(times)).numpy()

    def _linear(self, values: Floats) -> Floats:
        """Values (N, ...) at the instants, linear between rows (rows, ...)."""
        row = np.minimum(self.rows, max(len(values) - 2, 0))
        share = (self.times / self.period - row).reshape(-1, *[1] * (values.ndim - 1))
        return np.asarray(values[row] * (1 - share) + values[np.minimum(row + 1, len(values) - 1)] * share)


def _misses(task: Reach, states: Floats, point: Tensor) -> Floats:
    """(rows - 1,) m by which a flight misses the point (3,) in each period."""
    steps = torch.from_numpy(np.stack([states[:-1], states[1:]], 1))
    return np.asarray(task.misses(steps, point.double().expand(len(steps), 3))[:, 0])


def length_text(metres: float, digits: int | None = 1) -> str:
    """A length with its unit; without `digits`, as short as it goes, from mm on."""
    if digits is None and 0 < metres < 0.01:
        return f"{1000 * metres:g} mm"
    if digits is None:
        return f"{100 * metres:g} cm" if metres < 1 else f"{metres:g} m"
    if metres < 0.995:
        return f"{100 * metres:.{digits}f} cm"
    return f"{metres:.2f} m" if metres < 99.5 else f"{metres:.0f} m"
