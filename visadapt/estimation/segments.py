"""The rows of a recording as tensors: one window per episode, or several where episodes are long."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import torch
from torch import Tensor

ROUNDING = 1e-6
"""Differences that arithmetic makes of equal readings (turning an angle round, say), not the sensor."""


@dataclass(frozen=True)
class Segments:
    """W windows of at most T rows, in float64; what is beyond a window's end is zero and not `used`."""

    measured: Tensor
    """(W, T, m)"""
    used: Tensor
    """(W, T, m) 1 where a measurement counts"""
    inside: Tensor
    """(W, T) 1 within the window"""
    time: Tensor
    """(W, T) s since the episode began"""
    command: Tensor
    """(E, L, n_action) of whole episodes, from their beginning"""
    first: Tensor
    """(W,) row of the episode at which the window begins"""
    episode: Tensor
    """(W,) index of the window's episode"""
    channels: tuple[int, ...]
    """columns of the state that were measured"""
    period: float
    """s"""
    step: tuple[float, ...]
    """of each channel, the least difference between two readings that differ"""

    @property
    def shape(self) -> tuple[int, int]:
        """(W, T)"""
        return self.inside.shape[0], self.inside.shape[1]

    @property
    def index(self) -> Tensor:
        """(W, T) row of the episode; beyond a window's end it goes on."""
        return self.first[:, None] + torch.arange(self.shape[1])

    def of(self, windows: Tensor) -> Segments:
        """Only these windows."""
        every = ("measured", "used", "inside", "time", "first", "episode")
        return replace(self, **{name: getattr(self, name)[windows] for name in every})

    def reading(self, kept: Sequence[int]) -> Segments:
        """Only these of the measured channels."""
        return replace(
            self,
            measured=self.measured[..., kept],
            used=self.used[..., kept],
            channels=tuple(self.channels[k] for k in kept),
            step=tuple(self.step[k] for k in kept),
        )


def cut(
    measured: Sequence[Tensor],
    valid: Sequence[Tensor],
    commands: Sequence[Tensor],
    channels: tuple[int, ...],
    period: float,
    longest: int,
    stretches: Sequence[tuple[int, int, int]] | None = None,
) -> Segments:
    """Cut episodes into windows of equal length within each: measured (T, m), valid (T, m), commands (T, n_action).

    A window has `longest` rows at most. `stretches`, where given, are what is used: an episode's index, and the rows
    from which and up to which.
    """
    pieces = []
    for index, begin, end in stretches or [(k, 0, len(values)) for k, values in enumerate(measured)]:
        count = -(-(end - begin) // longest)
        edges = torch.linspace(begin, end, count + 1).round().long().tolist()
        pieces += [(index, a, b) for a, b in pairwise(edges)]
    rows = max(b - a for _, a, b in pieces)
    shape = (len(pieces), rows)
    out = torch.zeros(*shape, len(channels), dtype=torch.float64)
    inside = torch.zeros(shape, dtype=torch.float64)
    used = torch.zeros_like(out)
    for w, (index, a, b) in enumerate(pieces):
        out[w, : b - a] = measured[index][a:b]
        used[w, : b - a] = valid[index][a:b]
        inside[w, : b - a] = 1
    command = torch.zeros(
        len(commands), max(len(c) for c in commands) + rows, commands[0].shape[1], dtype=torch.float64
    )
    for index, values in enumerate(commands):
        command[index, : len(values)] = values
    first = torch.tensor([a for _, a, _ in pieces])
    time = period * (first[:, None] + torch.arange(rows)).double()
    episode = torch.tensor([index for index, _, _ in pieces])
    step = tuple(smallest_step(torch.cat([values[:, k] for values in measured])) for k in range(len(channels)))
    return Segments(out, used, inside, time, command, first, episode, channels, period, step)


def smallest_step(readings: Tensor) -> float:
    """Of a sensor: the least difference between two readings (N,) that differ."""
    steps = readings.unique().diff()
    steps = steps[steps > ROUNDING]
    return float(steps.min()) if len(steps) else 0.0
