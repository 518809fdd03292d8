"""Control of the blind flights: controllers with random steps added to their commands, and the actuation chain."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from datasets.blind.flight_plants import RESTING, Array, Motion, Parameters

PERIODS = {"quadrotor": 0.1, "fixed_wing": 0.05}
"""s between commands"""


class Flyers:
    """Controllers of N episodes, on the true state, with steps added to every command."""

    def __init__(self, steps: Array, targets: Array, first: Array) -> None:
        self.steps = steps
        """(rows, N, 4) added to the commands"""
        self.targets = targets
        """(rows, N, 3) target positions, m"""
        self.first = first
        """(N, 9) deviations of the first position, velocity, and roll, pitch, yaw (about x, y, z) from the trim"""

    def command(self, row: int, state: Array) -> Array:
        """Commands (N, 4) in a state (N, 13)."""
        raise NotImplementedError


def _euler_angles(state: Array) -> tuple[Array, Array, Array]:
    """Roll, pitch (nose down) and yaw (N,) in rad."""
    w, x, y, z = state[:, 6:10].T
    roll = np.arctan2(2 * (w * x + y * z), 1 - 2 * (x**2 + y**2))
    pitch = np.arcsin(np.clip(2 * (w * y - x * z), -1, 1))
    return roll, pitch, np.arctan2(2 * (w * z + x * y), 1 - 2 * (y**2 + z**2))


class QuadrotorFlyers(Flyers):
    """To random targets, by thrust and tilt for a wanted acceleration."""

    def command(self, row: int, state: Array) -> Array:
        wanted = 1.2 * (self.targets[row] - state[:, :3]) - 1.6 * state[:, 3:6]
        wanted = np.clip(wanted, -3.0, 3.0)
        roll, pitch, yaw = _euler_angles(state)
        # In the axes of the heading, a pitch forward and a roll to the right.
        ahead = np.cos(yaw) * wanted[:, 0] + np.sin(yaw) * wanted[:, 1]
        left = -np.sin(yaw) * wanted[:, 0] + np.cos(yaw) * wanted[:, 1]
        thrust = (9.81 + wanted[:, 2]) / (np.cos(roll) * np.cos(pitch))
        rates = np.stack([2.5 * (-left / 9.81 - roll), 2.5 * (ahead / 9.81 - pitch), -yaw], -1)
        command = np.concatenate([((thrust - 9.76) / 7.55)[:, None], rates / 0.5], 1)
        return np.asarray(np.clip(command + self.steps[row], -1, 1))


class WingFlyers(Flyers):
    """Along x at random heights, wings level except for the steps."""

    def command(self, row: int, state: Array) -> Array:
        roll, pitch, yaw = _euler_angles(state)
        down = np.clip(0.1 * (state[:, 2] - self.targets[row, :, 2]) + 0.1 * state[:, 5], -0.25, 0.25)
        rates = state[:, 10:13]
        thrust = -0.486 + 0.3 * (11.5 - np.linalg.norm(state[:, 3:6], axis=1))
        elevator = 0.026 - 1.2 * (pitch - down) - 0.25 * rates[:, 1]
        aileron = 1.5 * (roll + np.clip(0.6 * yaw, -0.3, 0.3)) + 0.3 * rates[:, 0]
        rudder = -0.3 * rates[:, 2]
        command = np.stack([thrust, elevator, aileron, rudder], -1)
        return np.asarray(np.clip(command + self.steps[row], -1, 1))


def _steps(rng: np.random.Generator, rows: int, episodes: int, sizes: Sequence[float], last: tuple[int, int]) -> Array:
    """(rows, episodes, n) values that are constant for random numbers of rows."""
    out = np.empty((rows, episodes, len(sizes)))
    for episode in range(episodes):
        for k, size in enumerate(sizes):
            row = 0
            while row < rows:
                length = int(rng.integers(*last))
                out[row : row + length, episode, k] = size * rng.uniform(-1, 1)
                row += length
    return out


def _flyers(
    kind: type[Flyers], steps: Sequence[float], last: tuple[int, int], goals: Sequence[float], start: Sequence[float]
) -> Callable[[Sequence[np.random.Generator], int, int], Flyers]:
    def draw(generators: Sequence[np.random.Generator], rows: int, episodes: int) -> Flyers:
        parts = [
            (
                _steps(rng, rows, episodes, steps, last),
                _steps(rng, rows, episodes, goals, (25, 50)),
                rng.normal(size=(episodes, 9)) * np.array(start),
            )
            for rng in generators
        ]
        return kind(*(np.concatenate([part[k] for part in parts], axis) for k, axis in ((0, 1), (1, 1), (2, 0))))

    return draw


CONTROLLERS = {
    "quadrotor": _flyers(
        QuadrotorFlyers, (0.3, 0.5, 0.5, 0.8), (2, 7), (2.0, 2.0, 1.0), (0.5,) * 3 + (0.5,) * 3 + (0.1, 0.1, 0.2)
    ),
    "fixed_wing": _flyers(
        WingFlyers, (0.4, 0.25, 0.5, 0.5), (4, 14), (0.0, 0.0, 4.0), (1.0,) * 3 + (0.5,) * 3 + (0.05,) * 3
    ),
}
"""(generators of each recording, rows, episodes) -> controllers of all their episodes"""


def starts(system: str, fly: Flyers) -> Motion:
    """First states of the episodes: near rest, or near level flight at 11.5 m/s."""
    first = fly.first
    velocity = first[:, 3:6] + (np.array([11.5, 0.0, 0.0]) if system == "fixed_wing" else 0.0)
    (cr, cp, cy), (sr, sp, sy) = np.cos(first[:, 6:].T), np.sin(first[:, 6:].T)
    turned = np.stack(
        [
            *(cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr),
            *(sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr),
            *(-sp, cp * sr, cp * cr),
        ],
        -1,
    ).reshape(-1, 3, 3)
    return Motion(first[:, :3], velocity, turned, np.zeros_like(velocity), RESTING)


class Chain:
    """The actuation chain: delay, backlash, dead zone, saturation, gain, bias, lag, in this order."""

    def __init__(self, p: Parameters, count: int) -> None:
        self._p = {name.split(".")[0]: values[:, None] for name, values in p.items() if name.startswith("actuator")}
        self._past: list[tuple[float, Array]] = []
        self._follows = np.zeros((count, 4))
        self._lagging = np.zeros((count, 4))
        self._now = 0.0

    def push(self, command: Array) -> None:
        """Append the controller's command for the next period."""
        # The longest delay reaches back no further.
        self._past = [*self._past[-5:], (self._now, command)]

    def __call__(self, time: float, h: float) -> Array:
        """The mean (N, 4) of the chain's output from `time` to `time` + h."""
        self._now = time + h
        given = np.zeros_like(self._follows)
        for begins, command in self._past:
            given = np.where(begins <= time - self._p["actuator_delay"] + 1e-6, command, given)
        half = self._p["actuator_backlash"] / 2
        self._follows = np.clip(self._follows, given - half, given + half)
        acts = np.sign(self._follows) * np.maximum(np.abs(self._follows) - self._p["actuator_deadzone"], 0.0)
        acts = np.clip(acts, -self._p["actuator_saturation"], self._p["actuator_saturation"])
        acts = self._p["actuator_gain"] * acts + self._p["actuator_bias"]
        ratio = np.maximum(self._p["actuator_lag"], 1e-9) / h
        before, left = self._lagging, np.exp(-1 / ratio)
        self._lagging = acts + (before - acts) * left
        return np.asarray(acts + (before - acts) * ratio * (1 - left))
