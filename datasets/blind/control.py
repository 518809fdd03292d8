"""The controller of the blind recordings: state feedback with an observer, and an excitation added to the command.

It is designed for the source, linearised and sampled at the period: s' = A s + B u, y = C s. Its gain K solves the
discrete Riccati equation for drawn weights; its observer is the Kalman filter for drawn noise. The command is
u = -K (s_hat - s_ref) + e, clipped to [-1, 1], with e a sum of sines, random steps or a chirp.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from datasets.blind.plant import PERIOD, Array, predict


def linearised(period: float) -> tuple[Array, Array]:
    """A (4, 4) and B (4, 1) of the source over one period in s, by central differences about upright."""
    small = 1e-5
    probes = np.concatenate((np.eye(4), -np.eye(4)), 1) * small
    ends = predict(probes, np.zeros((1, 8)), np.full((1, 8), period))
    pushed = predict(np.zeros((4, 2)), np.array([[small, -small]]), np.full((1, 2), period))
    return (ends[:, :4] - ends[:, 4:]) / (2 * small), (pushed[:, :1] - pushed[:, 1:]) / (2 * small)


def riccati(a: Array, b: Array, q: Array, r: Array) -> Array:
    """Gain K (m, n) that minimises sum s'Qs + u'Ru for s' = A s + B u, by iterating to the fixed point."""
    p, gain = q, np.zeros((b.shape[1], a.shape[0]))
    for _ in range(1000):
        gain = np.asarray(np.linalg.solve(r + b.T @ p @ b, b.T @ p @ a), np.float64)
        p = q + a.T @ p @ (a - b @ gain)
    return gain


@dataclass
class Driver:
    """One recording's controller and excitation, for all its episodes."""

    gain: Array
    """(4,)"""
    observer: Array | None
    """(4, 4), without weight on what is not measured; None: the controller is given the true state"""
    start: Array
    """(4, episodes): first states"""
    excitation: Array
    """(rows, episodes) in units of the command"""
    reference: Array
    """(rows, episodes): reference of x, m"""
    description: dict[str, str | float]
    """for the key"""


def draw_driver(
    rng: np.random.Generator,
    episodes: int,
    rows: int,
    noise: Array,
    velocities: bool,
    strength: float,
    period: float = PERIOD,
) -> Driver:
    """Draw a controller; `strength` < 1 scales the excitation down after earlier draws left the track or fell."""
    a, b = linearised(period)
    weights = np.array([3.0, 0.5, 20.0, 0.5]) * np.exp(rng.normal(0, 0.5, 4))
    gain = riccati(a, b, np.diag(weights), np.array([[np.exp(rng.uniform(np.log(20.0), np.log(200.0)))]]))[0]
    observer, seen = None, "true state"
    if rng.random() < 0.6:
        channels = np.eye(4) if velocities else np.eye(4)[[0, 2]]
        variance = (channels @ noise) ** 2
        unknown = b @ b.T * 0.05**2 + np.diag([1e-4, 1e-2, 1e-4, 1e-2]) ** 2
        observer, seen = riccati(a.T, channels.T, unknown, np.diag(variance)).T @ channels, "measurement"
    kind = str(rng.choice(["sines", "steps", "chirp"]))
    level = strength * float(rng.uniform(0.06, 0.2))
    excitation = np.stack([_excite(rng, kind, rows, period) for _ in range(episodes)], 1) * level
    time = np.arange(rows)[:, None] * period
    wander = strength * float(rng.uniform(0.0, 0.5))
    reference = wander * np.sin(
        2 * np.pi * rng.uniform(0.05, 0.25, episodes) * time + rng.uniform(-np.pi, np.pi, episodes)
    )
    spread = np.array([0.3, 0.2, 0.06, 0.2])[:, None] * min(1.0, strength)
    start = rng.uniform(-1, 1, (4, episodes)) * spread
    described: dict[str, str | float] = {"sees": seen, "excitation": kind, "level": level, "wander": wander}
    return Driver(gain, observer, start, excitation, reference, described)


def _excite(rng: np.random.Generator, kind: str, rows: int, period: float) -> Array:
    """A signal (rows,) of about unit root mean square."""
    time = np.arange(rows) * period
    if kind == "sines":
        frequencies = np.exp(rng.uniform(np.log(0.2), np.log(3.0), 4))[:, None]
        phases = rng.uniform(-np.pi, np.pi, 4)[:, None]
        return np.asarray(np.sin(2 * np.pi * frequencies * time + phases).sum(0) / np.sqrt(2))
    if kind == "steps":
        lengths = rng.integers(2, 12, rows) * round(PERIOD / period)
        return np.repeat(rng.uniform(-1.7, 1.7, rows), lengths)[:rows]
    rate = (3.0 - 0.2) / max(time[-1], period)
    return np.asarray(1.3 * np.sin(2 * np.pi * (0.2 + 0.5 * rate * time) * time + rng.uniform(-np.pi, np.pi)))


class Controllers:
    """The controllers of several recordings of one period, whose episodes are the columns of one batch."""

    def __init__(self, drivers: list[Driver], period: float) -> None:
        counts = [driver.start.shape[1] for driver in drivers]
        rows = max(len(driver.excitation) for driver in drivers)

        def laid_out(name: str) -> Array:
            padded = [np.pad(v, ((0, rows - len(v)), (0, 0))) for v in (getattr(driver, name) for driver in drivers)]
            return np.concatenate(padded, 1)

        self.a, self.b = linearised(period)
        self.gain = np.repeat([driver.gain for driver in drivers], counts, 0).T
        none = np.zeros((4, 4))
        observers = [none if driver.observer is None else driver.observer for driver in drivers]
        self.observer = np.repeat(observers, counts, 0)
        self.sees_state = np.repeat([driver.observer is None for driver in drivers], counts)
        self.excitation, self.reference = laid_out("excitation"), laid_out("reference")
        self.start = np.concatenate([driver.start for driver in drivers], 1)
        self.estimate: Array | None = None

    def __call__(self, row: int, state: Array, reading: Array) -> Array:
        """Command for the period that begins at `row`, from true states and readings (4, n)."""
        if self.estimate is None:
            self.estimate = reading * np.array([1.0, 0.0, 1.0, 0.0])[:, None]
        # The observer in its one-step form: s_hat' = A s_hat + B u + L (y - C s_hat).
        seen = np.where(self.sees_state, state, self.estimate)
        error = seen - np.array([1.0, 0.0, 0.0, 0.0])[:, None] * self.reference[row]
        command = np.clip(self.excitation[row] - (self.gain * error).sum(0), -1.0, 1.0)
        innovation = reading - self.estimate
        self.estimate = self.a @ self.estimate + self.b * command + np.einsum("nij,jn->in", self.observer, innovation)
        self.estimate = np.clip(self.estimate, -20.0, 20.0)
        return np.asarray(command)
