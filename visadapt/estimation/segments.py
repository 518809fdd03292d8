"""The rows of a recording as tensors: one window per episode, or several where episodes are long."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import pad

from visadapt.estimation.colour import Colour
from visadapt.estimation.profiles import profile_of
from visadapt.interpolation import cubic
from visadapt.recordings.resolution import smallest_step
from visadapt.systems import System

Stretch = tuple[int, int, int]
"""A part of an episode: the episode's index, the first row, and the row past the last."""

MIN_STRETCH_ROWS = 15  # Of what is left of an episode where rows within it are left out, for it to be used


@dataclass(frozen=True)
class Segments:
    """W windows of at most T rows, in float64, padded with zeros that are neither `inside` nor `used`."""

    measured: Tensor  # (W, T, m)
    used: Tensor  # (W, T, m) 1 where there is a measurement that a fit may use
    inside: Tensor  # (W, T) 1 within the window, 0 in its padding
    time: Tensor  # (W, T) s since the start of the episode
    command: Tensor  # (E, L, n_action) of whole episodes, from their start
    held: Tensor  # (E, L) s for which each command was held: until the next row; `period` after the last
    first: Tensor  # (W,) row of the episode at which the window starts
    episode: Tensor  # (W,) index of the window's episode
    channels: tuple[int, ...]  # the m columns of the state that were measured
    period: float  # s between rows, the median where the clock is unsteady
    resolution: tuple[float, ...]  # of each channel: the smallest difference between two different readings
    colour: Colour | None = None  # of a fit's innovations, where they are known not to be white
    jumps: bool = False  # whether process noise is a jump of each velocity; False: a load on each joint
    estimated: Tensor | None = None  # (W, T, n) states, of which the `unmeasured` are used; None: these are 0
    longest_step: float = math.inf  # s, in which Runge-Kutta follows the motion of the rows

    @property
    def shape(self) -> tuple[int, int]:
        """(W, T)"""
        return self.inside.shape[0], self.inside.shape[1]

    @property
    def index(self) -> Tensor:
        """(W, T) row of the episode; it continues in the padding."""
        return self.first[:, None] + torch.arange(self.shape[1])

    @property
    def duration(self) -> Tensor:
        """(W, T) s from each row to the next; it continues in the padding."""
        return self.held[self.episode[:, None], self.index]

    @property
    def given(self) -> Tensor:
        """(W, T, n_action) commands of the rows."""
        return self.command[self.episode[:, None], self.index]

    @cached_property
    def filled(self) -> Tensor:
        """(W, T, m) readings; those that may not be used are interpolated between those of the window that may, and at
        its ends extrapolated by as much as the first, or last, two of these are apart: a vehicle flies on."""
        missing = (self.used == 0) & (self.inside[..., None] > 0)
        if not bool(missing.any()):
            return self.measured
        out = self.measured.clone()
        for window in missing.any(2).any(1).nonzero()[:, 0].tolist():
            own = self.inside[window] > 0
            part = out[window, own], self.used[window, own], self.time[window, own]
            out[window, own] = interpolated(*part) + _beyond_ends(*part)
        return out

    @property
    def clock(self) -> tuple[Tensor, Tensor]:
        """Times, and durations, (W (T - 1),) s, of every row but the last of each window."""
        return self.time[:, :-1].flatten(), self.duration[:, :-1].flatten()

    def later(self, values: Tensor, by: Sequence[int]) -> Tensor:
        """(W, T, m) for every row and channel, the value in `values` (W, T, m) of the row that is `by` (m,) rows later
        in the episode; 0 where no window contains that row."""
        if not any(by):
            return values
        inside, index = self.inside > 0, self.index
        whole = values.new_zeros(*self.held.shape, len(by))
        whole[self.episode[:, None].expand_as(index)[inside], index[inside]] = values[inside]
        later = (index[..., None] + torch.tensor(by)).clamp(max=whole.shape[1] - 1)
        return whole[self.episode[:, None, None], later, torch.arange(len(by))] * self.inside[..., None]

    def select(self, windows: Tensor) -> Segments:
        """These windows, by index."""
        every = ("measured", "used", "inside", "time", "first", "episode")
        estimated = None if self.estimated is None else self.estimated[windows]
        return replace(self, estimated=estimated, **{name: getattr(self, name)[windows] for name in every})

    def spread(self, most: int) -> Tensor:
        """Indices of windows spread evenly over the recording, with about `most` rows in all; at least four, or all."""
        count = max(4, int(most / float(self.inside.sum(1).mean())))
        if self.shape[0] <= count:
            return torch.arange(self.shape[0])
        return torch.linspace(0, self.shape[0] - 1, count).round().long()

    def with_channels(self, kept: Sequence[int]) -> Segments:
        """With these of the measured channels, by position in `channels`."""
        return replace(
            self,
            measured=self.measured[..., kept],
            used=self.used[..., kept],
            channels=tuple(self.channels[k] for k in kept),
            resolution=tuple(self.resolution[k] for k in kept),
        )


def interpolated(values: Tensor, used: Tensor, stamps: Tensor) -> Tensor:
    """Readings (T, m); those that are not `used` (T, m) are interpolated linearly between those that are."""
    columns = [
        np.interp(stamps, stamps[kept], column[kept]) if kept.any() else column
        for column, kept in zip(values.numpy().T, used.numpy().T > 0, strict=True)
    ]
    return torch.tensor(np.stack(columns, 1))


def _beyond_ends(values: Tensor, used: Tensor, stamps: Tensor) -> Tensor:
    """(T, m) the change from the first reading that is `used` (T, m) back to each row before it, and from the last one
    to each row after it: at the rate between the two readings at that end, for as long as these are apart at most."""
    out = torch.zeros_like(values)
    for column, value, kept in zip(out.T, values.T, used.T > 0, strict=True):
        known = kept.nonzero()[:, 0]
        if len(known) < 2:
            continue
        for end, inner in ((known[0], known[1]), (known[-1], known[-2])):
            apart = stamps[end] - stamps[inner]
            share = ((stamps - stamps[end]) / apart).clamp(0, 1)  # 0 on the inner side
            column += share * (value[end] - value[inner])
    return out


def smoothly_filled(values: Tensor, used: Tensor, stamps: Tensor) -> Tensor:
    """Readings (T, m), with cubics through those that are `used` (T, m) in the place of the others.

    Lines instead would bend at their ends, and a bend looks like a push.
    """
    out = interpolated(values, used, stamps)
    for column, kept in zip(out.T, used.T > 0, strict=True):
        known = kept.nonzero()[:, 0]
        if len(known) < 3:
            continue
        inside = ~kept & (torch.arange(len(kept)) > known[0]) & (torch.arange(len(kept)) < known[-1])
        slopes = torch.gradient(column[known], spacing=(stamps[known],))[0]
        column[inside] = cubic(stamps[known], column[known, None], slopes[:, None], stamps[inside])[:, 0]
    return out


def unmeasured(rows: Segments, system: System) -> list[int]:
    """Columns of the states that no reading gives, and that are not the velocity of a position that one gives."""
    position_of, channels = profile_of(system).position_of, rows.channels
    return [k for k in range(len(system.states)) if k not in channels and position_of.get(k) not in channels]


def initial_states(rows: Segments, system: System) -> Tensor:
    """Initial guess (W, T, n) of the states: the measurements that may be used, those in between interpolated,
    difference quotients for missing velocities (one-sided in a window's first and last row), and what is `estimated` of
    states that no reading gives. Beyond a window's end its last row goes on: no attitude is a quaternion of zeros."""
    out = torch.zeros(*rows.shape, len(system.states), dtype=torch.float64)
    if rows.estimated is not None:
        columns = unmeasured(rows, system)
        out[..., columns] = rows.estimated[..., columns]
    for k, channel in enumerate(rows.channels):
        out[..., channel] = rows.filled[..., k]
    for channel, position_column in profile_of(system).position_of.items():
        if channel not in rows.channels and position_column in rows.channels:
            out[..., channel] = _difference_quotients(out[..., position_column], rows)
    windows, lasts = _last_rows(rows)
    return torch.where(rows.inside[..., None] > 0, out, out[windows, lasts][:, None])


def _difference_quotients(position: Tensor, rows: Segments) -> Tensor:
    """(W, T) rate of a position (W, T): central differences, one-sided in a window's first and last row."""
    ahead = position.diff(dim=1) / rows.duration[:, :-1]
    rate = torch.zeros_like(position)
    rate[:, 1:-1] = (position[:, 2:] - position[:, :-2]) / (rows.time[:, 2:] - rows.time[:, :-2])
    rate[:, 0] = ahead[:, 0]
    windows, lasts = _last_rows(rows)
    rate[windows, lasts] = ahead[windows, (lasts - 1).clamp(min=0)]
    return rate


def _last_rows(rows: Segments) -> tuple[Tensor, Tensor]:
    """(W,) each window, and the number of its last row."""
    lasts = rows.inside.sum(1).long() - 1
    return torch.arange(len(lasts)), lasts


def noise_of_readings(rows: Segments) -> Tensor:
    """(m,) variances of the readings' noise, from their third differences, in which smooth motion nearly vanishes."""
    windows, length = rows.shape
    place = (2 * length * torch.arange(windows)[:, None] + torch.arange(length)).flatten()  # apart, in two windows
    out = rows.measured.new_zeros(len(rows.channels))
    for k, (values, read) in enumerate(zip(rows.measured.flatten(0, 1).T, rows.used.flatten(0, 1).T > 0, strict=True)):
        third, span = values[read].diff(n=3), place[read][3:] - place[read][:-3]
        if len(span):
            # The squares of the coefficients 1, 3, 3 and 1 sum to 20.
            out[k] = third[span == span.median()].square().mean() / 20
    return out


def cut(
    measured: Sequence[Tensor],
    valid: Sequence[Tensor],
    commands: Sequence[Tensor],
    stamps: Sequence[Tensor],
    channels: tuple[int, ...],
    period: float,
    longest: int,
    stretches: Sequence[Stretch] | None = None,
) -> Segments:
    """Cut each episode into windows of nearly equal length, at most `longest` rows.

    Args:
        measured, valid: (T, m) of each episode; `valid` is 1 where a measurement of these `channels` may be used.
        commands: (T, n_action).
        stamps: (T,) s since the start of the episode.
        period: s between rows, the median of all.
        stretches: the parts to use; whole episodes by default.
    """
    if stretches is None:
        stretches = [(k, 0, len(values)) for k, values in enumerate(measured)]
    pieces = []
    for index, begin, end in stretches:
        count = -(-(end - begin) // longest)
        edges = torch.linspace(begin, end, count + 1).round().long().tolist()
        pieces += [(index, a, b) for a, b in pairwise(edges)]
    rows = max(b - a for _, a, b in pieces)
    inside = torch.zeros(len(pieces), rows, dtype=torch.float64)
    time, out = torch.zeros_like(inside), inside.new_zeros(*inside.shape, len(channels))
    used = torch.zeros_like(out)
    for w, (index, a, b) in enumerate(pieces):
        out[w, : b - a] = measured[index][a:b]
        used[w, : b - a] = valid[index][a:b]
        inside[w, : b - a] = 1
        time[w] = stamps[index][a] + period * torch.arange(rows)
        time[w, : b - a] = stamps[index][a:b]
    command = torch.zeros(
        len(commands), max(len(c) for c in commands) + rows, commands[0].shape[1], dtype=torch.float64
    )
    held = torch.full(command.shape[:2], period, dtype=torch.float64)
    for index, (values, stamp) in enumerate(zip(commands, stamps, strict=True)):
        command[index, : len(values)] = values
        held[index, : len(values) - 1] = stamp.diff()
    first = torch.tensor([a for _, a, _ in pieces])
    episode = torch.tensor([index for index, _, _ in pieces])
    resolution = tuple(resolutions(measured, valid))
    return Segments(out, used, inside, time, command, held, first, episode, channels, period, resolution)


def joined(rows: Segments, state: Tensor) -> tuple[Segments, Tensor]:
    """Windows of which each goes on where the one before ends, joined; with states (W, T, n) in them, joined alike."""
    lengths = rows.inside.sum(1).long()
    goes_on = (rows.episode[1:] == rows.episode[:-1]) & (rows.first[1:] == rows.first[:-1] + lengths[:-1])
    begins = torch.cat((goes_on.new_ones(1), ~goes_on))
    number = begins.cumsum(0) - 1  # of the joined window that each is part of
    first = rows.first[begins]
    window, row = rows.inside.nonzero().T
    column = rows.first[window] - first[number[window]] + row
    columns = torch.arange(int(column.max()) + 1)

    def together(values: Tensor) -> Tensor:
        out = values.new_zeros(len(first), len(columns), *values.shape[2:])
        out[number[window], column] = values[window, row]
        return out

    inside, time = together(rows.inside), together(rows.time)
    lasts = inside.sum(1).long() - 1
    beyond = (columns - lasts[:, None]).clamp(min=0)  # rows beyond the window's end, where its last state goes on
    last = columns - beyond
    whole = replace(
        rows,
        measured=together(rows.measured),
        used=together(rows.used),
        inside=inside,
        time=time.gather(1, last) + rows.period * beyond,
        command=pad(rows.command, (0, 0, 0, len(columns))),
        held=pad(rows.held, (0, len(columns)), value=rows.period),
        first=first,
        episode=rows.episode[begins],
        estimated=None if rows.estimated is None else together(rows.estimated),
    )
    return whole, together(state)[torch.arange(len(first))[:, None], last]


def stretches_without(bad: Sequence[Tensor], stretches: Sequence[Stretch]) -> list[Stretch]:
    """What is left of stretches without the `bad` rows (T,) of each episode: the whole stretch, or parts of it."""
    out = []
    for index, begin, end in stretches:
        edges = [begin - 1, *(begin + bad[index][begin:end].nonzero()[:, 0]).tolist(), end]
        parts = [(index, a + 1, b) for a, b in pairwise(edges)]
        out += parts if len(parts) == 1 else [part for part in parts if part[2] - part[1] >= MIN_STRETCH_ROWS]
    return out


def resolutions(measured: Sequence[Tensor], valid: Sequence[Tensor]) -> list[float]:
    """The resolution of the sensor of each column of episodes (T, m), by its `valid` (T, m) readings."""
    readings, read = torch.cat([*measured]), torch.cat([*valid]) > 0
    return [smallest_step(values[kept].numpy()) for values, kept in zip(readings.T, read.T, strict=True)]
