"""Readings of late sensors, each taken as a reading of the last row before the instant that it shows.

A reading of row t that is `delay` s late shows the state at that time less the delay: the state of an earlier row,
moved on by a period or less. The filter takes it at that row, as it may take readings in any order. So no motion is
integrated backwards: through dry friction it could not be, since a joint at rest may have stood or have just stopped.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from visadapt.batch import Batch
from visadapt.effects.late_sensors import LateSensors
from visadapt.estimation.segments import Segments
from visadapt.world import World

Delays = Mapping[int, float]
"""Late states, by index, to the s by which they are read late."""

ROUNDING_ERROR = 1e-6  # s, up to which two instants are the same

Rows = slice | Tensor
"""Rows of every window, by a slice or by their indices."""


@dataclass(frozen=True)
class Following(Batch):
    """The K periods after each of N states, and how long after it each sensor is read: a late sensor shows a state only
    in a later reading."""

    time: Tensor  # (N,) s since the episode began
    command: Tensor  # (N, K, substeps, n_action) that acts
    duration: Tensor  # (N, K) s
    read: Tensor  # (N, n_state) s from each state to the row in which each of its sensors is read


def reading(
    world: World, values: Tensor, state: Tensor, following: Following | None, applied: Tensor | None = None
) -> Tensor:
    """Readings (N, n_state) of the motion through each of N states; the sensor of column k is read
    `following.read[:, k]` s after the state. If `following` is None, no sensor is late, and all are read at the state.
    `values` (P,), or (N, P), are the effects' parameters; `applied` is that of `World.reading`."""
    here = world.with_values(values)
    if following is None:
        return here.reading(state, applied)
    every = values.expand(len(state), -1)
    sensors = [effect for effect in here.effects if isinstance(effect, LateSensors)]
    seen, shown = state.clone(), dict[tuple[int, ...], Tensor]()
    for column in range(state.shape[1]):
        of = tuple(k for k, sensor in enumerate(sensors) if column in sensor.late)
        if not of:
            continue
        if of not in shown:
            delay = sum(sensors[k].value("delay", state) for k in of)
            shown[of] = _later(world, every, state, following, following.read[:, column] - delay)
        seen[:, column] = shown[of][:, column]
    return here.reading(seen, applied)


def _later(world: World, values: Tensor, state: Tensor, following: Following, ahead: Tensor) -> Tensor:
    """The states (N, n_state) `ahead` (N,) s later, with parameters (N, P)."""
    time, last = following.time, following.command.shape[1] - 1
    out, rows = state.clone(), torch.arange(len(state), device=state.device)
    for k in range(last + 1):
        h = ahead if k == last else torch.minimum(ahead, following.duration[rows, k])
        state = world.with_values(values[rows]).integrate(time, state, following.command[rows, k], h)
        out[rows] = state
        # On an unsteady clock, few rows are further from what is shown than the others.
        far = (ahead > h).nonzero()[:, 0]
        rows, state, time, ahead = rows[far], state[far], (time + h)[far], (ahead - h)[far]
        if not len(rows):
            break
    return out


def rows_later(rows: Segments, delays: Delays, columns: Sequence[int]) -> list[int]:
    """By how many rows the readings of these columns of the state come after the row whose state they show: the least
    number of rows in which, everywhere in the episodes, more time than the delay passes; 0 for one that is not late."""
    if not delays:
        return [0] * len(columns)
    clock = _clock(rows)
    return [_rows_in(delays[column], clock, rows.period) if column in delays else 0 for column in columns]


def _rows_in(delay: float, clock: Tensor, period: float) -> int:
    """The least number of rows, at least 1, in which more than `delay` s pass everywhere on the `clock` (E, L + 1)."""
    count = 1 + int(delay / period)
    while count < clock.shape[1] - 1 and float((clock[:, count:] - clock[:, :-count]).min()) <= delay:
        count += 1
    return count


def following(rows: Segments, delays: Delays, acting: Tensor, states: int, chosen: Rows) -> Following:
    """What follows the `chosen` rows of every window, flattened, where `acting` (E, L, substeps, n_action) acts."""
    clock, episode, index = _clock(rows), rows.episode[:, None], rows.index[:, chosen]

    def passed(periods: int) -> Tensor:
        return _passed(clock, rows, periods)[:, chosen]

    read = torch.zeros(*index.shape, states, dtype=torch.float64)
    farthest = read[..., 0]
    for column, delay in delays.items():
        read[..., column] = passed(_rows_in(delay, clock, rows.period))
        farthest = torch.maximum(farthest, read[..., column] - delay)
    count = 1
    while count < clock.shape[1] and bool((passed(count) < farthest - ROUNDING_ERROR).any()):
        count += 1
    after = (index[..., None] + torch.arange(count)).clamp(max=acting.shape[1] - 1)
    return Following(
        rows.time[:, chosen].flatten(),
        acting[episode[..., None], after].flatten(0, 1),
        rows.held[episode[..., None], after].flatten(0, 1),
        read.flatten(0, 1),
    )


def _clock(rows: Segments) -> Tensor:
    """(E, L + 1) s from the start of each episode to its rows."""
    return torch.cat((torch.zeros_like(rows.held[:, :1]), rows.held.cumsum(1)), 1)


def _passed(clock: Tensor, rows: Segments, periods: int) -> Tensor:
    """(W, T) s on the `clock` from each row of the windows to the one `periods` later."""
    episode, index = rows.episode[:, None], rows.index
    return clock[episode, (index + periods).clamp(max=clock.shape[1] - 1)] - clock[episode, index]


def interpolated(
    rows: Segments, state: Tensor, later: Sequence[int], delays: Sequence[Tensor], position_of: Mapping[int, int]
) -> Tensor:
    """What late sensors show of the motion through states (W, T, n), without integrating it: (M, W, T, n).

    Between two rows velocities are linear, positions their integral, and other states linear. A reading of what was
    before the window, or comes after it, is NaN.

    Args:
        later: (n,) by how many rows the reading of each state comes after the row in which it is put.
        delays: (n,) of (M,) s, by which each state is read late.
        position_of: columns of velocities to those of their positions.
    """
    clock, last = _clock(rows), rows.inside.sum(1, dtype=torch.long)[:, None] - 1
    velocity_of, window = {position: velocity for velocity, position in position_of.items()}, torch.arange(len(state))
    out = state.expand(len(delays[0]), *state.shape).clone()
    for column, (by, delay) in enumerate(zip(later, delays, strict=True)):
        if not by and not bool(delay.any()):
            continue
        shown = rows.time + _passed(clock, rows, by) - delay[:, None, None]
        # The row before each of the instants shown.
        by_window = shown.movedim(0, 1).flatten(1)
        index = torch.searchsorted(rows.time, by_window).unflatten(1, (len(delay), -1)).movedim(1, 0)
        index = (index - 1).clamp(0, state.shape[1] - 2)
        first, second = (state[window[:, None], row].movedim(-1, 0) for row in (index, index + 1))
        passed = shown - rows.time[window[:, None], index]
        share = passed / rows.duration[window[:, None], index]
        seen = first[column] + share * (second[column] - first[column])
        if (rate := velocity_of.get(column)) is not None:
            seen = first[column] + passed * (first[rate] + share * (second[rate] - first[rate]) / 2)
        known = (shown > rows.time[:, :1] - ROUNDING_ERROR) & (shown < rows.time.gather(1, last) + ROUNDING_ERROR)
        out[..., column] = torch.where(known, seen, torch.nan)
    return out
