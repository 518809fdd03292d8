"""References that a vehicle is to follow: positions and velocities on a steady clock, and their derivatives.

One's own is read from a CSV file; `datasets.quadrotor_references` draws random ones, and `benchmarks.power_loop` flies
vertical circles.
"""

from __future__ import annotations

import os
from dataclasses import dataclass
from math import isfinite
from pathlib import Path
from typing import Self

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from visadapt.history import LENGTH
from visadapt.interpolation import cubic
from visadapt.recordings import RecordingError
from visadapt.recordings.checks import check_finite
from visadapt.recordings.clock import RawEpisode, check_forward
from visadapt.recordings.csv import Table

SPEEDS = ("x_dot", "y_dot", "z_dot")

MAX_PERIODS = 1_000_000  # Periods that a reference of one's own may last: 28 hours of 0.1 s
MAX_SPEED = 5.0  # m/s: the quadrotor's policy was trained on references up to this speed


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
    if not (period > 0 and isfinite(period)):
        raise ValueError(f"period is {period}, must be positive")
    path = Path(path)
    values, with_speeds = _read(path)
    lasts = values[-1, 0] - values[0, 0]
    if len(values) < 3 or lasts < LENGTH * period * (1 - 1e-6):
        raise RecordingError(
            f"{path}: {len(values)} rows over {lasts:g} s; at least 3 rows over {LENGTH * period:g} s are right"
        )
    if lasts > MAX_PERIODS * period:
        raise RecordingError(
            f"{path}: it lasts {lasts:g} s; at most {MAX_PERIODS * period:g} s are right (are times in s?)"
        )
    motion = _motion(values[:, 0], values[:, 1:4], values[:, 4:] if with_speeds else None, period)
    speed = np.linalg.norm(motion[1], axis=1)
    if not (speed <= MAX_SPEED).all():
        first = int((~(speed <= MAX_SPEED)).argmax())
        raise RecordingError(
            f"{path}: {first * period:g} s after its start it moves at {speed[first]:.3g} m/s; "
            f"at most {MAX_SPEED:g} m/s is right (are lengths in m and times in s?)"
        )
    return Reference.of(torch.from_numpy(np.stack(motion)).to(torch.get_default_dtype()), period)


def _read(path: Path) -> tuple[NDArray[np.float64], bool]:
    """The file's rows: time, three positions and, where the file has them, three velocities; and whether it has them.

    Raises:
        RecordingError: as `read_reference`.
    """
    table = Table.open(path)
    with_speeds = any(name in table.header for name in SPEEDS)
    names = ["time", "x", "y", "z", *(SPEEDS if with_speeds else ())]
    for name in names:
        if name not in table.header:
            raise RecordingError(f"{path}: has no column {name!r}; its columns are {', '.join(table.header)}")
    rows = table.rows([table.header.index(name) for name in names])
    values = rows.values
    raw = RawEpisode(path, values[:, 0], values[:, :0], values[:, 1:], tuple(names[1:]), rows.place)
    check_finite(raw, ())
    check_forward(raw)
    return values, with_speeds


def _motion(
    times: NDArray[np.float64], positions: NDArray[np.float64], speeds: NDArray[np.float64] | None, period: float
) -> list[NDArray[np.float64]]:
    """Positions, velocities, accelerations and jerks, each (T, 3), a period apart, of positions and, if known,
    velocities (N, 3) at rising times (N,) in s."""
    since_start = torch.from_numpy(times - times[0])
    # Up to 1e-5 of a period of rounding does not cost the last row.
    clock = torch.arange(int(float(since_start[-1]) / period + 1e-5) + 1, dtype=torch.float64) * period

    def at_periods(values: NDArray[np.float64], slopes: NDArray[np.float64]) -> NDArray[np.float64]:
        return cubic(since_start, torch.from_numpy(values), torch.from_numpy(slopes), clock).numpy()

    def slopes_of(values: NDArray[np.float64]) -> NDArray[np.float64]:
        return np.gradient(values, times, axis=0, edge_order=2)

    if speeds is None:
        motion = [at_periods(positions, slopes_of(positions))]
    else:
        motion = [at_periods(positions, speeds), at_periods(speeds, slopes_of(speeds))]
    while len(motion) < 4:
        motion.append(np.gradient(motion[-1], period, axis=0, edge_order=2))
    return motion
