"""The times at which a controller sent the commands of a recording."""

from __future__ import annotations

from math import gcd

import numpy as np
from numpy.typing import NDArray

FEWEST_CHANGES = 50  # of the command, to tell the controller's clock

MOST_PAIRED = 1000  # Changes, spread evenly, whose pairs bound the controller's period

SLACK = 0.02, 0.5e-3
"""Rows, and s at most, by which a command may have been sent outside of the row before the one that shows it: stamps
may be rounded to ms."""

SLOWER = 1.05
"""Least period of the controller, in rows, and least ratio of its period to whole rows: else commands are taken to be
given in the loop of the rows."""

FEWEST_STEADY = 20
LATE, MOST_LATE = 1.5, 0.05
"""A controller sends steadily, where of so many intervals between commands this share at most is longer than LATE usual
ones: one that sends when a command changes does not."""

GAP = 5.0  # Usual intervals without a command, or a reading that is interpolated, from which on rows are left out

Floats = NDArray[np.floating]


def sent_by_clock(time: Floats, commands: Floats) -> Floats:
    """(T, n) the mean of the commands that a controller sent by its clock (`instants`), which shows in these rows (T,
    n), from each time (T,) to the next."""
    sent = instants(time, commands)
    assert sent is not None
    first = min(float(time[0]), float(sent[0]) - 1e-9)
    values = commands[np.concatenate(([0], _changed(commands)))]
    return np.column_stack([means_until_next(time, np.concatenate(([first], sent)), each) for each in values.T])


def instants(time: Floats, commands: Floats) -> Floats | None:
    """The times at which commands (T, n) were sent that rows at these times (T,) show, by a steady clock; None where no
    clock fits, or it may be that of the rows.

    A command that a row is the first to show was sent between the row before and this one. The instants of all of them,
    whole periods apart, are known far better than that.
    """
    changed = _changed(commands)
    if len(changed) < FEWEST_CHANGES:
        return None
    row = float(np.median(np.diff(time)))
    rows, gaps = np.diff(changed), np.diff(time[changed])
    # Of two commands in turn that are equal, one shows in no row; without that, rows differ by one at most.
    single = gaps < (rows.min() + 1.5) * row
    period, least = float(gaps[single].mean()), gcd(*rows.tolist())
    if period < SLOWER * row or (least == rows.min() and abs(period / (least * row) - 1) < SLOWER - 1):
        return None
    number = np.concatenate(([0.0], np.cumsum(np.where(single, 1, np.round(gaps / period)))))
    slack = min(SLACK[0] * row + SLACK[1], 0.1 * row)
    earliest, latest = time[changed - 1] - slack, time[changed] + slack
    some = np.unique(np.linspace(0, len(number) - 1, min(len(number), MOST_PAIRED)).round().astype(int))
    apart = number[some] - number[some][:, None]
    after = apart > 0
    shortest = ((earliest[some] - latest[some][:, None])[after] / apart[after]).max()
    longest = ((latest[some] - earliest[some][:, None])[after] / apart[after]).min()
    if shortest >= longest:
        return None
    clock = 0.5 * (shortest + longest) * number
    first, last = float((earliest - clock).max()), float((latest - clock).min())
    # The last of the phases that fit: commands that are late the diagnosis can tell from a delay, not those too early.
    return None if first >= last else clock + last - slack


def _changed(commands: Floats) -> NDArray[np.intp]:
    """The rows whose commands (T, n) are not those of the row before."""
    return np.flatnonzero(np.diff(commands, axis=0).any(1)) + 1


def in_gaps(time: Floats, stamps: Floats) -> NDArray[np.bool_]:
    """Which of some times (T,) lie in a gap of the commands of a controller that else sends steadily, from when the
    next one was due: some motors hold the last command there, others stop. `stamps` (N,) are those of the commands."""
    intervals = np.diff(stamps)
    if len(intervals) < FEWEST_STEADY:
        return np.zeros(len(time), bool)
    usual = float(np.median(intervals))
    if np.mean(intervals > LATE * usual) > MOST_LATE:
        return np.zeros(len(time), bool)
    last = np.searchsorted(stamps, time, side="right").clip(1, len(intervals)) - 1
    return (intervals[last] > GAP * usual) & (time >= stamps[last] + usual) & (time < stamps[last + 1])


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
