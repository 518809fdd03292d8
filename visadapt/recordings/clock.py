"""The rows' clock: a steady one is taken at its mean period, gaps split an episode, an irregular one is resampled."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from visadapt.recordings.episode import RecordingError

Note = Callable[[str, str], None]
"""Called with (what was changed or left out, where)."""

GAP = 1.5
"""Periods between two rows from which on a row is missing."""
IRREGULAR = 0.05
"""Share of gaps from which on the clock has no period, rather than a row missing here and there."""
JITTER = 0.1
"""Periods that the rows of a steady clock are off it, root mean square: a real rig's are off by 0.01."""
TOLERANCE = 0.02
"""Share by which the periods of two episodes of one recording may differ."""
LONGEST = 3.0
"""Periods over which an irregular clock is still interpolated."""


@dataclass(frozen=True)
class Rows:
    """Rows as read, before their clock is looked at."""

    source: str
    """for messages: the file, and the episode where it has several"""
    time: NDArray[np.float64]
    """(T,) s, as read; from `steadied` on, since the episode began"""
    action: NDArray[np.float64]
    """(T, n_action)"""
    state: NDArray[np.float64]
    """(T, n_measured)"""
    place: Callable[[int], str]
    """how a row, counted from 0, is called in messages"""
    names: Mapping[str, str] = field(default_factory=dict)
    """what the file calls our variables, where it calls them something else"""

    def column(self, name: str) -> str:
        """How the column of one of our variables is called in messages."""
        return f"column {self.names[name]!r} ({name})" if name in self.names else f"column {name!r}"

    def part(self, start: int, end: int) -> Rows:
        """The rows from `start` up to `end`, not included."""
        rows = slice(start, end)
        return replace(
            self,
            time=self.time[rows],
            action=self.action[rows],
            state=self.state[rows],
            place=lambda row: self.place(start + row),
        )

    def named(self, source: str) -> Rows:
        """The same rows, from `source`."""
        return replace(self, source=source)


def check_forward(rows: Rows) -> None:
    """Raises RecordingError where the clock repeats itself or runs backward."""
    steps = np.diff(rows.time)
    if (steps <= 0).any():
        row = int((steps <= 0).argmax())
        before, after = rows.time[row], rows.time[row + 1]
        problem = "repeats itself" if before == after else "runs backward"
        raise RecordingError(
            f"{rows.source}: {rows.place(row + 1)}, {rows.column('time')}: the clock {problem} (from {before:.9g} s to "
            f"{after:.9g} s); a rising one is right, and a column 'episode' where several episodes follow each other"
        )


def steadied(rows: Rows, note: Note) -> list[Rows]:
    """Parts whose rows are one period apart; `time` is since the episode began, in later parts too."""
    rows = replace(rows, time=rows.time - rows.time[0])
    steps = np.diff(rows.time)
    if len(steps) == 0:
        return [rows]
    period = float(np.median(steps))
    gaps = steps > GAP * period
    irregular = gaps.mean() > IRREGULAR and gaps.sum() > 1
    cuts = np.flatnonzero(steps > (LONGEST if irregular else GAP) * period)
    for cut in cuts:
        note("rows are missing here; the episode was split", f"{rows.source}, {rows.place(int(cut) + 1)}")
    edges = [0, *(int(cut) + 1 for cut in cuts), len(rows.time)]
    parts = [rows.part(start, end) for start, end in pairwise(edges)]
    return [_one_clock(part, period, note) for part in parts]


def _one_clock(part: Rows, nominal: float, note: Note) -> Rows:
    """The part at a steady clock: its own, where it has one, or else resampled at the period `nominal`."""
    index = np.arange(len(part.time))
    if len(index) < 3:
        return part
    period, start = np.polyfit(index, part.time, 1)
    off = part.time - (start + period * index)
    if np.sqrt(np.mean(off**2)) <= JITTER * period:
        return replace(part, time=part.time[0] + period * index)
    note(f"an irregular clock; resampled to one row every {nominal:.4g} s", part.source)
    time = np.arange(part.time[0], part.time[-1] + 1e-9, nominal)
    state = np.column_stack([np.interp(time, part.time, column) for column in part.state.T])
    # A command holds until the next one.
    held = np.searchsorted(part.time, time + 1e-9, side="right") - 1
    return replace(part, time=time, action=part.action[held], state=state)


def alike(parts: list[Rows], note: Note) -> tuple[list[Rows], float]:
    """The parts that share the recording's period, and that period in s; parts of at least two rows each."""
    periods = np.array([np.diff(part.time).mean() for part in parts])
    order = np.argsort(periods)
    rows = np.cumsum([len(parts[index].time) for index in order])
    period = float(periods[order][np.searchsorted(rows, rows[-1] / 2)])
    kept = []
    for part, own in zip(parts, periods, strict=True):
        if abs(own / period - 1) <= TOLERANCE:
            kept.append(part)
        else:
            note(f"left out, since its rows are not {period:.4g} s apart as most are", part.source)
    return kept, period
