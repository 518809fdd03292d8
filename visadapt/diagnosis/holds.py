"""Readings that are no readings: rows that repeat the one before, and a sensor that stands still.

A sensor with noise never gives the same number twice; where it does, the reading was held. Such readings say nothing
of the state, so they are set aside before anything is fitted, and counted here.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

DISTINCT = 0.5
"""Share of different numbers among a channel's readings from which on it counts as continuous."""

POLE = (2, 3)
"""Columns of the state that a worn angle sensor holds."""


@dataclass(frozen=True)
class Holds:
    """What was held, by episode."""

    used: list[Tensor]
    """(T, m) 1 where a reading counts"""
    lost: list[Tensor]
    """(T,) the whole row was held"""
    frozen: list[Tensor]
    """(T,) angle and angular velocity were held, the rest was not"""


def find_holds(measured: Sequence[Tensor], channels: tuple[int, ...]) -> Holds:
    """Held readings in episodes (T, m) of these columns of the state."""
    together = torch.cat(list(measured))
    continuous = [len(together[:, k].unique()) > DISTINCT * len(together) for k in range(len(channels))]
    used, lost, frozen = [], [], []
    for values in measured:
        same = torch.zeros_like(values, dtype=torch.bool)
        same[1:] = values[1:] == values[:-1]
        same &= torch.tensor(continuous)
        pole = torch.tensor([c in POLE for c in channels])
        whole = same.all(1) if all(continuous) else torch.zeros(len(values), dtype=torch.bool)
        still = same[:, pole].all(1) & ~whole if bool(pole.any()) else torch.zeros_like(whole)
        used.append(1.0 - (whole[:, None] | (still[:, None] & pole)).double())
        lost.append(whole)
        frozen.append(still)
    return Holds(used, lost, frozen)
