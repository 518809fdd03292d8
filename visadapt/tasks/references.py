"""References that a vehicle is to follow: positions and velocities on a steady clock, and their derivatives.

The power loop, or one's own from a CSV file; `datasets.quadrotor_references` draws random ones.
"""

from __future__ import annotations

import os
from dataclasses import dataclass
from math import ceil, isfinite, pi
from pathlib import Path
from typing import Self

import numpy as np
import torch
from torch import Tensor

from visadapt.history import LENGTH
from visadapt.interpolation import cubic
from visadapt.recordings import RecordingError
from visadapt.recordings.checks import check_finite
from visadapt.recordings.clock import RawEpisode, check_forward
from visadapt.recordings.csv import Table
from visadapt.systems import Quadrotor
from visadapt.tasks.differential_flatness import commands

SPEEDS = ("x_dot", "y_dot", "z_dot")

MAX_PERIODS = 1_000_000  # Periods that a reference of one's own may last: 28 hours of 0.1 s
MAX_SPEED = 5.0  # m/s: the quadrotor's policy was trained on references up to this speed

LOOP_RADIUS = 7.0
"""m, one for all speeds, so that faster is harder. The rule: the smallest at which the paper's fastest power loop,
5 m/s, leaves the controller a tenth of the range of commands (`smallest_loop`), rounded up to half a metre."""
RAMP = 0.5
"""rad, by which a power loop turns while its curvature grows from none to the circle's, and again on the way out."""
STRAIGHT = 1.0  # s of straight flight at least, before and after a power loop


@dataclass(frozen=True)
class Reference:
    """One reference, or many of one length: leading axes (...) number them, the next is time. World axes, z up."""

    positions: Tensor  # (..., T, 3) m
    velocities: Tensor  # (..., T, 3) m/s
    accelerations: Tensor  # (..., T, 3) m/s2
    jerks: Tensor  # (..., T, 3) m/s3
    period: float  # s between rows

    @classmethod
    def of(cls, motion: Tensor, period: float) -> Self:
        """From positions, velocities, accelerations and jerks, one after the other: (4, ..., T, 3)."""
        positions, velocities, accelerations, jerks = motion
        return cls(positions, velocities, accelerations, jerks, period)

    @property
    def motion(self) -> Tensor:
        """Positions, velocities, accelerations and jerks, one after the other, as `of` takes them: (4, ..., T, 3)."""
        return torch.stack((self.positions, self.velocities, self.accelerations, self.jerks))

    def to(self, like: Tensor) -> Self:
        """The same with the device and dtype of `like`."""
        return type(self).of(self.motion.to(like), self.period)

    def as_many(self) -> Self:
        """With a leading axis that numbers references, (1, T, 3), where this is a single one; else itself."""
        return self if self.positions.dim() > 2 else type(self).of(self.motion[:, None], self.period)


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


@np.errstate(over="ignore", invalid="ignore")  # by absurd numbers, which are refused as too fast
def read_reference(path: str | os.PathLike[str], period: float = 0.1) -> Reference:
    """A reference of one's own: a CSV file with columns time, x, y, z and, if known, x_dot, y_dot, z_dot.

    Seconds, metres and metres per second, z up; rows may be any time apart, and other columns are ignored. They
    are interpolated by cubics onto a clock of `period`; derivatives that the file does not give are differences
    over the period. It must last LENGTH periods at least, those of a policy's history.

    Raises:
        RecordingError: one line that says which file, row and column is wrong, and what would be right.

    >>> import pathlib, tempfile, visadapt as va
    >>> path = pathlib.Path(tempfile.mkdtemp()) / "line.csv"
    >>> _ = path.write_text("time,x,y,z\\n0,0,0,1\\n1,1,0,1\\n2,2,0,1\\n")
    >>> va.read_reference(path).positions.shape
    torch.Size([21, 3])
    """
    _check_positive(period=period)
    path = Path(path)
    table = Table.open(path)
    names = ["time", "x", "y", "z", *(SPEEDS if any(name in table.header for name in SPEEDS) else ())]
    for name in names:
        if name not in table.header:
            raise RecordingError(f"{path}: has no column {name!r}; its columns are {', '.join(table.header)}")
    rows = table.rows([table.header.index(name) for name in names])
    values = rows.values
    raw = RawEpisode(path, values[:, 0], values[:, :0], values[:, 1:], tuple(names[1:]), rows.place)
    check_finite(raw, ())
    check_forward(raw)
    lasts = values[-1, 0] - values[0, 0]
    if len(values) < 3 or lasts < LENGTH * period * (1 - 1e-6):
        raise RecordingError(
            f"{path}: {len(values)} rows over {lasts:g} s; at least 3 rows over {LENGTH * period:g} s are right"
        )
    if lasts > MAX_PERIODS * period:
        raise RecordingError(
            f"{path}: it lasts {lasts:g} s; at most {MAX_PERIODS * period:g} s are right (are times in s?)"
        )
    time, places = torch.from_numpy(values[:, 0] - values[0, 0]), values[:, 1:4]
    slopes = values[:, 4:] if len(names) > 4 else np.gradient(places, values[:, 0], axis=0, edge_order=2)
    at = torch.arange(int(float(time[-1]) / period + 1e-5) + 1, dtype=torch.float64) * period
    motion = [cubic(time, torch.from_numpy(places), torch.from_numpy(slopes), at).numpy()]
    if len(names) > 4:
        turns = np.gradient(slopes, values[:, 0], axis=0, edge_order=2)
        motion.append(cubic(time, torch.from_numpy(slopes), torch.from_numpy(turns), at).numpy())
    while len(motion) < 4:
        motion.append(np.gradient(motion[-1], period, axis=0, edge_order=2))
    speed = np.linalg.norm(motion[1], axis=1)
    if not (speed <= MAX_SPEED).all():
        first = int((~(speed <= MAX_SPEED)).argmax())
        raise RecordingError(
            f"{path}: {first * period:g} s after its start it moves at {speed[first]:.3g} m/s; "
            f"at most {MAX_SPEED:g} m/s is right (are lengths in m and times in s?)"
        )
    return Reference.of(torch.from_numpy(np.stack(motion)).to(torch.get_default_dtype()), period)


def _check_positive(**values: float) -> None:
    for name, value in values.items():
        if not (value > 0 and isfinite(value)):
            raise ValueError(f"{name} is {value}, must be positive")


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
