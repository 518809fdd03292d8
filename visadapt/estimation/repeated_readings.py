"""Repeated readings: rows that were lost, and angles at which a sensor stood still.

Because of noise, a sensor in motion never gives the same number twice; where it does, the previous reading was
repeated. Such readings do not measure the state: they are excluded from fits, and counted here.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from visadapt.estimation.segments import smallest_step

MIN_JUMP_STEPS = 8
"""Jump into or out of a run of equal readings, in steps of the sensor's resolution, above which the run counts as
repeated; below, the quantity may have stood still."""

ZONE_EDGE_POINTS = 120  # Angles tried for either edge of the zone in which the angle sensor stands still

SMOOTHING_RATIO = 1 / 3  # Assumed standard deviation of a smoothed angle over that of a measured one


@dataclass(frozen=True)
class RepeatedReadings:
    """Which readings are repeated, by episode."""

    used: list[Tensor]  # (T, m) 1 where a reading is a measurement
    lost: list[Tensor]  # (T,) whether the whole row is repeated
    frozen: list[Tensor]  # (T,) whether the angle is repeated and the rest of the row is not


def find_repeats(
    measured: Sequence[Tensor], channels: tuple[int, ...], angle_sensor: Sequence[int]
) -> RepeatedReadings:
    """Find repeated readings in episodes (T, m) of these columns of the state.

    `angle_sensor` are the columns of the angle, which may stand still on its own, and of its rate; empty without one.
    """
    together = torch.cat(list(measured))
    steps = [smallest_step(together[:, k]) for k in range(len(channels))]
    pole = torch.tensor([c in angle_sensor for c in channels], dtype=torch.bool)
    angle = channels.index(angle_sensor[0]) if angle_sensor and angle_sensor[0] in channels else None
    used, lost, frozen = [], [], []
    for values in measured:
        same = torch.stack([_repeats(values[:, k], MIN_JUMP_STEPS * steps[k]) for k in range(len(channels))], 1)
        whole = same.all(1)
        # A rate from a separate sensor may go on while the angle stands still.
        partial = same & pole & ~whole[:, None]
        still = partial[:, angle] if angle is not None else torch.zeros_like(whole)
        # The first reading after a standstill may still be mixed with the repeated value.
        waking = torch.zeros_like(partial)
        waking[1:] = partial[:-1] & ~partial[1:]
        used.append(1.0 - (whole[:, None] | (still[:, None] & partial) | waking).double())
        lost.append(whole)
        frozen.append(still)
    return RepeatedReadings(used, lost, frozen)


def _repeats(readings: Tensor, jump: float) -> Tensor:
    """(T,) rows that repeat the row before, in runs preceded or followed by a change of more than `jump`."""
    change = readings.diff(prepend=readings[:1])
    same = change == 0
    same[0] = False
    # Rows of a run share a number; the jump into a run is the change at its first row, the jump out that of the next.
    run = (~same).cumsum(0) - 1
    jumps = torch.cat((change[~same].abs(), torch.zeros(1, dtype=readings.dtype)))
    return same & ((jumps[run] > jump) | (jumps[run + 1] > jump))


def zone(repeated: Tensor, angle: Tensor, deviation: float) -> tuple[float, float, float]:
    """Start and end in rad of the zone of angles in which a sensor stands still, and their standard deviation.

    Given whether each of N readings is `repeated`, and their estimated angles with a normal error of `deviation` rad.
    Posterior mean over a grid of both edges, with a uniform prior.
    """
    inside = angle[repeated]
    # An edge may lie anywhere between the last angle with a repeated reading and the next without.
    least, most, middle = inside.min(), inside.max(), float(inside.median())
    lower, higher = angle[~repeated & (angle < least)], angle[~repeated & (angle > most)]
    first, last = lower.max() if len(lower) else least, higher.min() if len(higher) else most
    low = torch.linspace(float(first) - 3 * deviation, middle, ZONE_EDGE_POINTS, dtype=angle.dtype)
    high = torch.linspace(middle, float(last) + 3 * deviation, ZONE_EDGE_POINTS, dtype=angle.dtype)
    below = torch.special.ndtr((low[:, None] - angle) / deviation)
    above = torch.special.ndtr((angle - high[:, None]) / deviation)
    chance = (1 - below[:, None] - above[None]).clamp(1e-6, 1 - 1e-6)
    score = torch.where(repeated, chance.log(), (1 - chance).log()).sum(-1)
    weight = (score - score.max()).exp()
    weight = weight / weight.sum()
    start, end = (weight.sum(1) * low).sum(), (weight.sum(0) * high).sum()
    spread = (weight.sum(1) * (low - start).square()).sum() + (weight.sum(0) * (high - end).square()).sum()
    return float(start), float(end), float((spread / 2).sqrt())
