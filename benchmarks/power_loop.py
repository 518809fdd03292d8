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
from math import ceil, isfinite, pi
from pathlib import Path

import numpy as np
import torch
import tyro
from torch import Tensor

from experiments.flights import flight_target
from experiments.result_tables import Row, write_rows
from visadapt.evaluation import score
from visadapt.setups.flight import quadrotor
from visadapt.systems import Quadrotor
from visadapt.tasks.differential_flatness import commands
from visadapt.tasks.references import Reference
from visadapt.weights import shipped

LOOP_RADIUS = 7.0
"""m, one for all speeds, so that faster is harder. The rule: the smallest at which the paper's fastest power loop,
5 m/s, leaves the controller a tenth of the range of commands (`smallest_loop`), rounded up to half a metre."""
RAMP = 0.5
"""rad, by which a power loop turns while its curvature grows from none to the circle's, and again on the way out."""
STRAIGHT = 1.0  # s of straight flight at least, before and after a power loop

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


def power_loop(speed: float, radius: float = LOOP_RADIUS, period: float = 0.1) -> Reference:
    """A vertical circle in the x-z plane at a steady speed in m/s, flown into and out of on level straight lines.

    The manoeuvre of Kaufmann, Loquercio, Ranftl, Müller, Koltun and Scaramuzza (2020), Deep drone acrobatics, RSS,
    as gentle as it can be: a step of the curvature would ask for an infinite jerk, so it grows and falls smoothly (a
    polynomial of degree 5 of the way) while the path turns by `RAMP`. The reference begins at the origin, in motion
    along x, and ends at the same height.

    Raises:
        ValueError: a speed, radius or period that is not positive.
    """
    _check_positive(speed=speed, radius=radius, period=period)
    rows = ceil(_loop_length(radius) / (speed * period) + 2 * STRAIGHT / period) + 1
    motion = _loop(speed, radius, torch.arange(rows, dtype=torch.float64) * period)
    return Reference.of(motion[:4].to(torch.get_default_dtype()), period)


def smallest_loop(speed: float, quadrotor: Quadrotor, margin: float = 0.9) -> float:
    """Smallest radius in m, to a millimetre, of a power loop that a quadrotor flies upright within its commands.

    The circle's top decides: the thrust is least there, and its direction turns fastest. Loops on which the quadrotor
    turns upside down do not count, though one with more thrust and faster rates could fly them, and smaller ones.

    Args:
        speed: m/s.
        margin: share of the range of commands that the loop may ask for.
    """

    def feasible(radius: float) -> bool:
        length = _loop_length(radius) / speed + 2 * STRAIGHT
        motion = _loop(speed, radius, torch.linspace(0, length, 4001, dtype=torch.float64))
        upright = motion[2, :, 2].min() > -float(quadrotor.gravity)
        asked = commands(motion[2], motion[3], motion[4], quadrotor)
        return bool(upright and asked.abs().max() <= margin)

    low = high = speed**2 / float(quadrotor.gravity)  # weightless at the top
    while not feasible(high):
        low, high = high, 2 * high
    while high - low > 1e-3:
        middle = (low + high) / 2
        low, high = (low, middle) if feasible(middle) else (middle, high)
    return high


def _loop_length(radius: float) -> float:
    """m along the path from the first bend to the last: a ramp turns half as far as a circle of its length would."""
    return (2 * pi + 2 * RAMP) * radius


def _loop(speed: float, radius: float, time: Tensor) -> Tensor:
    """Position of a power loop and four derivatives (5, T, 3) at rising times (T,) in s, the first of them 0."""

    def bend(at: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Inclination in rad and curvature in 1/m, with two derivatives by the way, at times of any shape."""
        way = speed * (at - STRAIGHT)
        ramp = 2 * RAMP * radius
        total = torch.zeros(4, *at.shape, dtype=at.dtype)
        for begins, sign in ((0.0, 1.0), (_loop_length(radius) - ramp, -1.0)):
            s = ((way - begins) / ramp).clamp(0, 1)
            past = (way - begins - ramp).clamp(min=0)
            angle = ramp * s**4 * (2.5 - 3 * s + s**2) + past
            rising = (s**3 * (10 - 15 * s + 6 * s**2), 30 * (s * (1 - s)) ** 2 / ramp)
            bending = 60 * s * (1 - s) * (1 - 2 * s) / ramp**2
            total += sign * torch.stack((angle, *rising, bending)) / radius
        return total[0], total[1], total[2], total[3]

    def axes(inclination: Tensor) -> tuple[Tensor, Tensor]:
        """Directions (..., 3) along the path and towards the inside of its bend."""
        c, s, nothing = inclination.cos(), inclination.sin(), torch.zeros_like(inclination)
        return torch.stack((c, nothing, s), -1), torch.stack((-s, nothing, c), -1)

    angle, bent, bending, bends = bend(time)
    along, inward = axes(angle)
    bent, bending, bends = bent[:, None], bending[:, None], bends[:, None]
    # Gauss and Legendre's rule with 5 points in each interval: right to rounding, as the path is smooth.
    points, weights = (torch.from_numpy(part) / 2 for part in np.polynomial.legendre.leggauss(5))
    step = time.diff()
    within = axes(bend(time[:-1, None] + step[:, None] * (points + 0.5))[0])[0]
    steps = speed * step[:, None] * (within * weights[:, None]).sum(1)
    position = torch.cat((torch.zeros_like(along[:1]), steps.cumsum(0)))
    return torch.stack(
        (
            position,
            speed * along,
            speed**2 * bent * inward,
            speed**3 * (bending * inward - bent**2 * along),
            speed**4 * ((bends - bent**3) * inward - 3 * bent * bending * along),
        )
    )


def _check_positive(**values: float) -> None:
    for name, value in values.items():
        if not (value > 0 and isfinite(value)):
            raise ValueError(f"{name} is {value}, must be positive")


if __name__ == "__main__":
    main(tyro.cli(Settings, description=__doc__))
