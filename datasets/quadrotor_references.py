"""Random references that a quadrotor can fly, to train and test its policies on.

python -m datasets.quadrotor_references --help

Each is a spline of degree 5 with uniform knots (four continuous derivatives), whose acceleration, jerk and snap give
the commands that it needs (see `visadapt.tasks.differential_flatness`). Its mean speed is drawn first, uniformly, and
whether it starts at rest; then shapes are drawn until one is feasible at that speed, so that high speeds are as
frequent as low ones:

    number of segments    uniform over whole numbers
    steps between control points    normal, each axis with a scale that is uniform in [0, 1]

Feasible: at instants half a period apart every command that the motion needs, including compensation of the rate
loop's lag, stays within the share `margin` of the range of commands, and the speed below `max_speed`.
"""

from __future__ import annotations

import dataclasses
import json
import zipfile
from dataclasses import dataclass
from math import comb, factorial
from pathlib import Path

import numpy as np
import torch
import tyro
from torch import Tensor

from visadapt.storage.atomic_files import replacing
from visadapt.systems import Quadrotor
from visadapt.tasks.differential_flatness import commands
from visadapt.tasks.references import Reference

PATH = Path("data/quadrotor_references.npz")
"""where they are kept, in the folder that a script is started in"""

SPLINE_DEGREE = 5

CHUNK_REFERENCES = 1000
"""References that are drawn at a time, to bound the memory; another value draws other references."""

FIELDS = ("positions", "velocities", "accelerations", "jerks")
"""Position and its derivatives, by their names in `Reference`."""


@dataclass(frozen=True)
class Settings:
    """What is drawn, and where it is written."""

    out: Path = PATH
    """file to write"""
    train: int = 9000
    """how many references to train on"""
    test: int = 1000
    """how many to test on"""
    seed: int = 0
    """of all random numbers"""
    duration: float = 10.0
    """s"""
    period: float = 0.1
    """s between rows"""
    min_mean_speed: float = 1.0
    """m/s"""
    max_mean_speed: float = 2.0
    """m/s"""
    max_speed: float = 5.0
    """m/s"""
    at_rest: float = 0.5
    """share of the references that start at rest"""
    min_segments: int = 6
    """of a spline"""
    max_segments: int = 15
    """of a spline"""
    margin: float = 0.9
    """share of the range of commands that a reference may need; the rest is left to the controller"""


def make(settings: Settings) -> tuple[Reference, Reference]:
    """Draw the references to train and to test on: rows (N, T, 3) in float32, all starting at the origin."""
    _check(settings)
    generator = torch.Generator().manual_seed(settings.seed)
    count = settings.train + settings.test
    drawn = torch.cat(
        [_draw(settings, min(CHUNK_REFERENCES, count - k), generator) for k in range(0, count, CHUNK_REFERENCES)], 1
    )
    rows = drawn.to(torch.float32)
    return (
        Reference.of(rows[:, : settings.train], settings.period),
        Reference.of(rows[:, settings.train :], settings.period),
    )


def _check(settings: Settings) -> None:
    if settings.train < 1 or settings.test < 0:
        raise ValueError(f"train and test are {settings.train} and {settings.test}, must be at least 1 and 0")
    if not 0 < settings.period < settings.duration:
        raise ValueError(f"period is {settings.period} s, must be between 0 and the duration, {settings.duration} s")
    if not 0 < settings.min_mean_speed <= settings.max_mean_speed < settings.max_speed:
        raise ValueError(
            f"speeds are {settings.min_mean_speed} and {settings.max_mean_speed} (mean) and {settings.max_speed} m/s, "
            "must be positive and in this order"
        )
    if not 1 <= settings.min_segments <= settings.max_segments:
        raise ValueError(f"segments are {settings.min_segments} to {settings.max_segments}, must be 1 or more")
    if not 0 < settings.margin <= 1 or not 0 <= settings.at_rest <= 1:
        raise ValueError(f"margin and at_rest are {settings.margin} and {settings.at_rest}, must be shares")


def _draw(settings: Settings, count: int, generator: torch.Generator) -> Tensor:
    """Feasible references: positions and three derivatives (4, count, T, 3)."""
    span = settings.max_mean_speed - settings.min_mean_speed
    speed = settings.min_mean_speed + span * torch.rand(count, generator=generator, dtype=torch.float64)
    rest = torch.rand(count, generator=generator) < settings.at_rest
    drawn: Tensor | None = None
    left = torch.arange(count)
    while len(left):
        segments = torch.randint(settings.min_segments, settings.max_segments + 1, (len(left),), generator=generator)
        remaining = [left[:0]]
        for number in segments.unique().tolist():
            tried = left[segments == number]
            motion = _motions(settings, number, speed[tried], rest[tried], generator)
            good = _feasible(settings, motion)
            if drawn is None:
                drawn = motion.new_empty(4, count, (motion.shape[2] + 1) // 2, 3)
            drawn[:, tried[good]] = motion[:4, good, ::2]
            remaining.append(tried[~good])
        left = torch.cat(remaining)
    assert drawn is not None
    return drawn


def _motions(settings: Settings, segments: int, speed: Tensor, rest: Tensor, generator: torch.Generator) -> Tensor:
    """Positions and four derivatives (5, B, 2 T - 1, 3) of splines of mean speeds (B,), half a period between rows."""
    steps = torch.randn(len(speed), segments + SPLINE_DEGREE - 1, 3, generator=generator, dtype=torch.float64)
    steps = steps * torch.rand(len(speed), 1, 3, generator=generator, dtype=torch.float64)
    # Where the first control points coincide, the spline starts at rest, with all derivatives zero.
    steps[:, : SPLINE_DEGREE - 1] *= ~rest[:, None, None]
    points = torch.cat((torch.zeros_like(steps[:, :1]), steps.cumsum(1)), 1)
    rows = 2 * round(settings.duration / settings.period) + 1
    time = torch.linspace(0, settings.duration, rows, dtype=torch.float64)
    motion = torch.stack([basis(time, settings.duration / segments, segments, d) @ points for d in range(5)])
    motion[0] -= motion[0, :, :1].clone()
    return motion * (speed / motion[1].norm(dim=-1).mean(1))[:, None, None]


def basis(time: Tensor, spacing: float, segments: int, derivative: int) -> Tensor:
    """Uniform B-splines (T, segments + SPLINE_DEGREE), or a derivative of lower order, at times (T,) in s.

    By the truncated powers of de Boor (1978), A Practical Guide to Splines, chapter IX: knots `spacing` s apart.
    """
    place = time[:, None] / spacing - torch.arange(segments + SPLINE_DEGREE) + SPLINE_DEGREE
    power = SPLINE_DEGREE - derivative
    terms = [
        (-1) ** k * comb(SPLINE_DEGREE + 1, k) * (place - k).clamp(min=0) ** power for k in range(SPLINE_DEGREE + 2)
    ]
    value = torch.stack(terms).sum(0) / factorial(power) / spacing**derivative
    return value * (place < SPLINE_DEGREE + 1)


def _feasible(settings: Settings, motion: Tensor) -> Tensor:
    """Which motions (5, B, T, 3) a quadrotor can follow: (B,)."""
    needed = commands(motion[2], motion[3], motion[4], Quadrotor())
    slow = motion[1].norm(dim=-1).amax(1) <= settings.max_speed
    # Commands of a motion that would turn the body upside down are out of range or nan, so it is not feasible.
    return slow & (needed.abs() <= settings.margin).all(-1).all(-1)


def main(settings: Settings) -> None:
    """Write the data set as npz: the fields of `Reference` for all, the first `train` of them to train on."""
    train, test = make(settings)
    arrays = {name: torch.cat((getattr(train, name), getattr(test, name))).numpy() for name in FIELDS}
    arrays["settings"] = np.array(json.dumps(dataclasses.asdict(settings), default=str))
    with replacing(settings.out) as temporary:
        np.savez(temporary, allow_pickle=False, **arrays)
    print(f"{settings.out}: {settings.train} references to train on, {settings.test} to test on")


def read(path: Path) -> tuple[Reference, Reference]:
    """Read a data set that `main` wrote: the references to train on, and those to test on.

    Raises:
        ValueError: one line that names the file and what is wrong with it.
    """
    if not path.is_file():
        raise ValueError(f"{path}: there is no such data set; make it with python -m datasets.quadrotor_references")
    try:
        with np.load(path) as file:
            about = json.loads(str(file["settings"]))
            rows = torch.stack([torch.from_numpy(file[name]) for name in FIELDS])
        train, period = int(about["train"]), float(about["period"])
    except (OSError, KeyError, ValueError, RuntimeError, zipfile.BadZipFile) as error:
        raise ValueError(f"{path}: not a complete data set of references ({error})") from error
    return Reference.of(rows[:, :train], period), Reference.of(rows[:, train:], period)


def ready() -> tuple[Reference, Reference]:
    """Read the data set in `PATH`; if there is none, it is made with the default settings first."""
    if not PATH.exists():
        main(Settings())
    return read(PATH)


if __name__ == "__main__":
    main(tyro.cli(Settings, description=__doc__))
