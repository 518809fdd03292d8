"""Readings that are no readings: rows that repeat the one before, and a sensor that stands still.

A sensor in motion never gives the same number twice; where it does, the reading was held. Such readings say nothing
of the state, so they are set aside before anything is fitted, and counted here.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from visadapt.estimation.segments import smallest_step

MOVING = 8
"""Smallest steps of a sensor that it must jump by, before or after a repeated reading, for that to be a held one."""

GRID = 120
"""Places tried for either edge of a zone in which a sensor stands still."""


@dataclass(frozen=True)
class Holds:
    """What was held, by episode."""

    used: list[Tensor]
    """(T, m) 1 where a reading counts"""
    lost: list[Tensor]
    """(T,) the whole row was held"""
    frozen: list[Tensor]
    """(T,) the angle was held, the rest of the row was not"""


def find_holds(measured: Sequence[Tensor], channels: tuple[int, ...], worn: Sequence[int]) -> Holds:
    """Held readings in episodes (T, m) of these columns of the state, of which a `worn` angle sensor may hold some."""
    together = torch.cat(list(measured))
    steps = [smallest_step(together[:, k]) for k in range(len(channels))]
    pole = torch.tensor([c in worn for c in channels], dtype=torch.bool)
    angle = channels.index(worn[0]) if worn and worn[0] in channels else None
    used, lost, frozen = [], [], []
    for values in measured:
        same = torch.stack([_held(values[:, k], MOVING * steps[k]) for k in range(len(channels))], 1)
        whole = same.all(1)
        # An angular velocity of its own sensor may go on while the angle stands still.
        own = same & pole & ~whole[:, None]
        still = own[:, angle] if angle is not None else torch.zeros_like(whole)
        # What a sensor gives first when it wakes may still be half of what it held.
        waking = torch.zeros_like(own)
        waking[1:] = own[:-1] & ~own[1:]
        used.append(1.0 - (whole[:, None] | (still[:, None] & own) | waking).double())
        lost.append(whole)
        frozen.append(still)
    return Holds(used, lost, frozen)


def _held(readings: Tensor, moving: float) -> Tensor:
    """(T,) rows that repeat the one before, in runs that a jump leads into or out of."""
    change = readings.diff(prepend=readings[:1])
    same = change == 0
    same[0] = False
    # Segments of a run share a number; the jump into it is that of its first row, the jump out that of the next run's.
    run = (~same).cumsum(0) - 1
    jumps = torch.cat((change[~same].abs(), torch.zeros(1, dtype=readings.dtype)))
    return same & ((jumps[run] > moving) | (jumps[run + 1] > moving))


def zone(held: Tensor, angle: Tensor, deviation: float) -> tuple[float, float, float]:
    """Start and end of the angles at which a sensor stands still, and the deviation of either.

    Args:
        held: (N,) whether the reading was held.
        angle: (N,) true angles, known to `deviation`.

    Maximum likelihood with a normal error of the angles, over the edges between the angles met.
    """
    inside = angle[held]
    # An edge may lie anywhere between the last angle at which the reading was held and the next at which it was not.
    least, most, middle = inside.min(), inside.max(), float(inside.median())
    lower, higher = angle[~held & (angle < least)], angle[~held & (angle > most)]
    first, last = lower.max() if len(lower) else least, higher.min() if len(higher) else most
    low = torch.linspace(float(first) - 3 * deviation, middle, GRID, dtype=angle.dtype)
    high = torch.linspace(middle, float(last) + 3 * deviation, GRID, dtype=angle.dtype)
    below = torch.special.ndtr((low[:, None] - angle) / deviation)
    above = torch.special.ndtr((angle - high[:, None]) / deviation)
    chance = (1 - below[:, None] - above[None]).clamp(1e-6, 1 - 1e-6)
    score = torch.where(held, chance.log(), (1 - chance).log()).sum(-1)
    weight = (score - score.max()).exp()
    weight = weight / weight.sum()
    start, end = (weight.sum(1) * low).sum(), (weight.sum(0) * high).sum()
    spread = (weight.sum(1) * (low - start).square()).sum() + (weight.sum(0) * (high - end).square()).sum()
    return float(start), float(end), float((spread / 2).sqrt())
