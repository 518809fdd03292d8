"""What a blind recording's machine measures, and when: encoders, velocities and the clock of its loop."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from datasets.blind.plant import PERIOD, Array

Velocities = Literal["absent", "measured", "differences", "filtered"]
"""measured by sensors of their own, or derived from the positions: differences over the last step, without or behind a
low-pass filter of first order"""

MOST_LATE = 0.2
"""a step of an unsteady loop lasts at most this share of the period longer"""


@dataclass(frozen=True)
class Rig:
    """One recording's sensors and clock; without arguments, exact sensors of all states every 50 ms."""

    period: float = PERIOD
    """s, nominal"""
    late: Array | None = None
    """(rows + 1, episodes): s by which each row, and the end of the last, comes after its time on the grid"""
    counts: tuple[float, float] = (0.0, 0.0)
    """m and rad of one count of the encoders; 0 is exact"""
    velocities: Velocities = "measured"
    """where they come from"""
    time_constant: float = 0.0
    """s, of the filter"""

    @property
    def longest(self) -> float:
        """No step lasts longer (s)."""
        return self.period * (1.0 if self.late is None else 1.0 + MOST_LATE)

    def clock(self, rows: int, episodes: int) -> tuple[Array, Array]:
        """Times of the rows in s, and how long each lasts: (rows, episodes) each."""
        late = np.zeros((rows + 1, episodes)) if self.late is None else self.late
        return self.period * np.arange(rows)[:, None] + late[:-1], self.period + np.diff(late, axis=0)

    @property
    def description(self) -> dict[str, str | float]:
        """For the key."""
        described: dict[str, str | float] = {
            "period": self.period,
            "latest": 0.0 if self.late is None else float(self.late.max()),
            "count_position": self.counts[0],
            "count_angle": self.counts[1],
            "velocities": self.velocities,
        }
        return described | ({"time_constant": self.time_constant} if self.time_constant else {})


def late_steps(rng: np.random.Generator, rows: int, episodes: int, most: float) -> Array:
    """Every step lasts up to `most` seconds longer than the period, and the next begins later by that."""
    late = np.zeros((rows + 1, episodes))
    late[1:] = np.cumsum(rng.uniform(0.0, most, (rows, episodes)), 0)
    return np.round(late, 6)


def late_rows(rng: np.random.Generator, rows: int, episodes: int, most: float) -> Array:
    """Every row but the first comes up to `most` seconds after its time on the grid, the next none the later."""
    late = rng.uniform(0.0, most, (rows + 1, episodes))
    late[0] = 0.0
    return np.round(late, 6)


def draw_rig(rng: np.random.Generator, seconds: float, episodes: int) -> tuple[Rig, int]:
    """A lab's machine, and the rows of each episode: encoders, mostly an unsteady loop, velocities or none."""
    period = float(rng.choice([0.01, 0.02, 0.02, 0.05, 0.05]))
    rows = round(seconds / period / episodes)
    loop = str(rng.choice(["steady", "late steps", "late steps", "late rows"]))
    most = period * float(rng.uniform(0.05, MOST_LATE))
    late = {"late steps": late_steps, "late rows": late_rows}.get(loop, lambda *_: None)(rng, rows, episodes, most)
    counts = float(rng.choice([2.5e-5, 1e-4, 1e-4, 5e-4])), 2 * np.pi / float(rng.choice([2000, 4096, 4096, 8192]))
    velocities: Velocities = rng.choice(["absent", "measured", "differences", "filtered"])
    return Rig(period, late, counts, velocities, float(rng.uniform(0.02, 0.06)) * (velocities == "filtered")), rows
