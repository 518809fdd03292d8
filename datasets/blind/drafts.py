"""A blind recording in the making, and its CSV."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from datasets.blind.control import draw_driver
from datasets.blind.plant import Array
from datasets.blind.rigs import Rig
from datasets.blind.simulation import Case, Run

COLUMNS = ("x", "x_dot", "theta", "theta_dot")
"""of the state"""

RECORDING_SUBSTEPS = 50
"""substeps of 1 ms in 50 ms of the recordings that are written"""
CART_REACH, POLE_REACH = 1.5, 0.3
"""m and rad: |x| and |theta| of a recording never exceed these"""


@dataclass
class Draft:
    """A recording in the making."""

    rng: np.random.Generator
    """its own random numbers, so that redrawing one recording does not change the others"""
    mixture: str
    """single, pair, triple, none (that a recording could show) or foreign"""
    case: Case | None = None
    """its machine, controller and noise"""
    run: Run | None = None
    """what it measured"""
    strengths: dict[str, float] | None = None
    """by effect"""
    row: str = ""
    """what it shows, where it is a row of datasets.blind.table"""


def draw_case(
    rng: np.random.Generator, rows: int, episodes: int, noise: Array, rig: Rig, velocities: bool, excitation: float
) -> Case:
    """Draw the controller, which reads `velocities` or not, and the noise, of deviations (4,) in m, m/s, rad, rad/s."""
    # What an observer expects of an encoder: its rounding as noise of the same variance.
    expected = np.sqrt(noise**2 + np.array([rig.counts[0], 0.0, rig.counts[1], 0.0]) ** 2 / 12)
    driver = draw_driver(rng, episodes, rows, expected, velocities, excitation, rig.period)
    return Case(driver, {}, rng.normal(size=(rows, 4, episodes)) * noise[:, None], rng.random((rows, episodes)), rig)


def stayed(run: Run) -> bool:
    """Whether the cart stayed on the track and the pole upright."""
    x, theta = run.reach
    return x <= CART_REACH and theta <= POLE_REACH


def lines(draft: Draft) -> Iterator[str]:
    """The CSV of a recording."""
    assert draft.case is not None
    assert draft.run is not None
    rig = draft.case.rig
    channels = (0, 2) if rig.velocities == "absent" else range(4)
    digits = 2 if rig.late is None else 6
    yield ",".join(("episode", "time", *(COLUMNS[c] for c in channels), "command"))
    rows, _, episodes = draft.run.measured.shape
    for episode in range(episodes):
        for row in range(rows):
            values = [f"{draft.run.measured[row, c, episode]:.7f}" for c in channels]
            yield ",".join(
                (
                    str(episode),
                    f"{draft.run.times[row, episode]:.{digits}f}",
                    *values,
                    f"{draft.run.commands[row, episode]:.7f}",
                )
            )
