"""Commands of a controller with a clock of its own, slower than the rows: a row holds the last one that was sent."""

from __future__ import annotations

from dataclasses import replace
from math import gcd

import numpy as np
from numpy.typing import NDArray

from visadapt.recordings.clock import Note, RawEpisode

FEWEST_CHANGES = 50  # of the command, to tell the controller's clock

MOST_PAIRED = 1000  # Changes, spread evenly, whose pairs bound the controller's period

SLACK = 0.02
"""Rows by which a command may come outside of the row in which it first shows: stamps are rounded."""

SLOWER = 1.05  # Rows that a controller's period must have, and its distance from whole rows, below which it has none

Floats = NDArray[np.float64]


def with_controllers_clock(raw: RawEpisode, note: Note) -> RawEpisode:
    """The episode with each command as the mean of what the controller sent until the next row, where commands change
    by a steady clock that is not that of the rows; else as it is.

    A command that shows in a row was sent between the row before and this one. The instants of all of them, one period
    apart, are known far better than that.
    """
    changed = np.flatnonzero(np.diff(raw.action, axis=0).any(1)) + 1
    if raw.stamped_commands or len(changed) < FEWEST_CHANGES:
        return raw
    sent = _instants(raw.time, changed)
    if sent is None:
        return raw
    period = float(np.median(np.diff(sent)))
    note(
        f"commands change every {period:.4g} s, by a clock that is not that of the rows: a command is the mean until "
        "the next row",
        raw.origin,
    )
    stamps, values = np.concatenate((raw.time[:1], sent)), raw.action[np.concatenate(([0], changed))]
    means = [means_until_next(raw.time, stamps, column) for column in values.T]
    return replace(raw, action=np.column_stack(means), stamped_commands=True)


def _instants(time: Floats, changed: NDArray[np.intp]) -> Floats | None:
    """The times at which commands were sent that first show in the rows `changed`, by a steady clock; None, where none
    fits, or it may be that of the rows."""
    row = float(np.median(np.diff(time)))
    rows = np.diff(changed)
    gaps = np.diff(time[changed])
    # Of two commands in turn that are equal, one shows in no row; without that, rows differ by one at most.
    single = rows <= rows.min() + 1
    period = float(gaps[single].mean())
    least = gcd(*rows.tolist())
    if period < SLOWER * row or (least == rows.min() and abs(period / (least * row) - 1) < SLOWER - 1):
        return None
    number = np.concatenate(([0.0], np.cumsum(np.where(single, 1, np.round(gaps / period)))))
    earliest, latest = time[changed - 1] - SLACK * row, time[changed] + SLACK * row
    some = np.unique(np.linspace(0, len(number) - 1, min(len(number), MOST_PAIRED)).round().astype(int))
    apart = number[some] - number[some][:, None]
    after = apart > 0
    shortest = ((earliest[some] - latest[some][:, None])[after] / apart[after]).max()
    longest = ((latest[some] - earliest[some][:, None])[after] / apart[after]).min()
    if shortest >= longest:
        return None
    clock = 0.5 * (shortest + longest) * number
    first, last = float((earliest - clock).max()), float((latest - clock).min())
    # The last of the phases that fit: stamps that are late the diagnosis can tell from a delay, not those too early.
    return None if first >= last else clock + last


def means_until_next(time: Floats, stamps: Floats, commands: Floats) -> Floats:
    """The mean of the held commands (N,) from each time (T,) to the next, NaN where one of them is; for the last time,
    the command held there."""

    def mean(values: Floats) -> Floats:
        total = np.concatenate(([0.0], np.cumsum(values[:-1] * np.diff(stamps))))
        after = np.maximum(time - stamps[-1], 0.0) * values[-1]  # a command goes on after the last message
        held: Floats = np.diff(np.interp(time, stamps, total) + after) / np.maximum(np.diff(time), 1e-12)
        return np.append(held, values[np.searchsorted(stamps, time[-1], side="right") - 1])

    missing = mean(np.isnan(commands).astype(float))
    return np.where(missing > 1e-9, np.nan, mean(np.nan_to_num(commands)))
