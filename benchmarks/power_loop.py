"""The quadrotor on the power loop, faster and faster (the paper's Table 4).

    python -m benchmarks.power_loop

The policy of the source (the shipped one, trained on random references alone) flies a vertical circle in
the source, finely integrated, at five speeds: with a radius of 7 m, the least half metre that lets the fastest fly
with body rates of at most 0.5 rad/s and a body that stays upright, and as tight as each speed allows. The paper does
not say how wide its loop is. Nothing is drawn at random, so there is one flight each.

Writes results/power_loop.csv.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import tyro

from experiments.flights import flight_target
from experiments.result_tables import Row, write_rows
from visadapt.evaluation import score
from visadapt.setups.flight import quadrotor
from visadapt.systems import Quadrotor
from visadapt.tasks.references import Reference, power_loop, smallest_loop
from visadapt.weights import shipped

SPEEDS = (2.6, 3.4, 4.1, 4.6, 5.0)
"""m/s, the paper's"""


@dataclass(frozen=True)
class Settings:
    """Where things are."""

    out: Path = Path("results/power_loop.csv")


def main(settings: Settings) -> None:
    """Fly all loops and write the table."""
    rows = []
    for speed in SPEEDS:
        for name, loop in (
            ("power loop", power_loop(speed)),
            ("power loop, tightest", power_loop(speed, smallest_loop(speed, Quadrotor()))),
        ):
            rows += _flown(f"{name}, {speed} m/s", loop)
    write_rows(settings.out, rows)
    for row in rows:
        print(f"{row.experiment:32} {row.measure:24} {row.mean:.3f} m")


def _flown(name: str, loop: Reference) -> list[Row]:
    setup = quadrotor(loop)
    found = score(setup.load(shipped("quadrotor")), flight_target(setup), episodes=1)
    row = Row(
        name, "quadrotor", "ours, states", "source", 0, "mean tracking error", "m", found.mean, None, 1, found.failed, 1
    )
    return [
        replace(row, mean=round(found.mean, 4)),
        replace(row, measure="greatest tracking error", mean=round(found.worst, 4)),
    ]


if __name__ == "__main__":
    main(tyro.cli(Settings, description=__doc__))
