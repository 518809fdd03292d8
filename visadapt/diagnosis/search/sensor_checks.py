"""What readings show of sensors: velocities that lag behind their positions, and steps that are coarse."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from visadapt.estimation.profiles import profile_of
from visadapt.estimation.segments import Segments
from visadapt.systems import System

MAX_LAG = 0.2
"""Largest lag, in periods, of a measured velocity behind the slope of its position; backward differences lag by 0.5."""

SURE = 3.0  # Standard errors by which a lag must exceed MAX_LAG: noise alone also gives lags in few readings


def derived_velocities(system: System, rows: Segments) -> dict[str, float]:
    """Names of velocities that lag behind the slope of their position, with the lag in s.

    Differences of past positions lag, and filtered ones do more. Readings alone decide, so that no model has to be
    right: the slope between the rows before and after a row does not lag.
    """
    position_of = profile_of(system).position_of
    span = rows.time[:, 2:] - rows.time[:, :-2]
    inside = rows.inside[:, 2:] * rows.inside[:, :-2]
    out = {}
    for k, channel in enumerate(rows.channels):
        if position_of.get(channel) not in rows.channels:
            continue
        position, velocity = rows.measured[..., rows.channels.index(position_of[channel])], rows.measured[..., k]
        acceleration = (velocity[:, 2:] - velocity[:, :-2]) / span
        error = velocity[:, 1:-1] - (position[:, 2:] - position[:, :-2]) / span
        read = rows.used[..., k] * rows.used[..., rows.channels.index(position_of[channel])]
        used = inside * read.unfold(1, 3, 1).amin(-1)
        # Least squares of error = -lag acceleration.
        information = (acceleration.square() * used).sum()
        lag = -(error * acceleration * used).sum() / information
        variance = ((error + lag * acceleration).square() * used).sum() / used.sum()
        # Where an estimator takes in a reading, its position and velocity jump together, which looks like a lag: it is
        # none in most other rows.
        late = lag - SURE * (variance / information).sqrt() > MAX_LAG * rows.period
        if late and _median_lag(error, acceleration, used) > MAX_LAG * rows.period:
            out[system.states[channel].name] = float(lag)
    return out


def _median_lag(error: Tensor, acceleration: Tensor, used: Tensor) -> float:
    """The lag in s by least absolute values of error + lag acceleration, each (W, T): the weighted median of the
    ratios."""
    moving = (used > 0) & (acceleration != 0)
    ratios, order = (-error[moving] / acceleration[moving]).sort()
    weights = acceleration[moving].abs()[order].cumsum(0)
    return float(ratios[torch.searchsorted(weights, weights[-1:] / 2)])


COARSE_SHARE = 0.1
"""Rounding error of a position, as a share of the standard deviation of its readings, above which its steps are coarse.
On simulated machines with 2,000 to 8,192 counts a turn it is at most 0.025."""


@dataclass(frozen=True)
class CoarseSteps:
    """A position that is read in steps which are coarse for its motion."""

    state: str  # name of the position
    unit: str
    step: float  # in `unit`
    deviation: float  # standard deviation of the readings, in `unit`

    def __str__(self) -> str:
        return (
            f"{self.state} is read in steps of {self.step:.3g} {self.unit} and varies by {self.deviation:.3g} "
            f"{self.unit} (standard deviation): what is smaller than a step does not show"
        )


def coarse_steps(system: System, rows: Segments) -> tuple[CoarseSteps, ...]:
    """The positions whose steps are coarse; velocities are left out, since those of an encoder count its steps."""
    velocities = profile_of(system).position_of
    out = []
    for k, (channel, step) in enumerate(zip(rows.channels, rows.resolution, strict=True)):
        readings = rows.measured[..., k][rows.used[..., k] > 0]
        deviation = float(readings.std())
        if channel not in velocities and step / math.sqrt(12) > COARSE_SHARE * deviation:
            variable = system.states[channel]
            out.append(CoarseSteps(variable.name, variable.unit, step, deviation))
    return tuple(out)
