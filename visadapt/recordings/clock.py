"""An episode as it was read, and its clock: steady, or every row at its own stamp; split where rows are missing."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from visadapt.recordings.columns import read_column
from visadapt.recordings.episode import EPISODE, RecordingError
from visadapt.systems import System

Note = Callable[[str, str], None]
"""Called with (what was changed or left out, where in the recording)."""

CONVERSION = re.compile(r"; --columns [^;]+? converts| \(--columns [^)]+\)")
"""How a message says that a file's columns are converted: `RawEpisode.conversion`, `RawEpisode.exchange`, and the check
of a vehicle's axes."""
GAP_PERIODS = 1.5
"""Step, in periods, above which rows are missing."""
LATER_PERIODS = 0.5
AROUND = 5
"""Periods by which the clock is later after a gap than before it, at least: rows that a log stamps late, or early, are
followed by others that are not. It is the median of AROUND rows on either side."""
MOST_GAPS = 0.05
"""Share of gaps among the steps above which a clock is irregular; below it, rows are missing."""
MOST_DECIMALS, MOST_HALVINGS = 6, 20
"""Decimals, or halvings of a second, up to which stamps may be rounded; a float32 of an hour has about as many."""
UNSTEADY_PERIODS = 0.1
"""Difference between the longest and the shortest step, in periods, above which a clock is reported as unsteady."""
LONGEST_STEP_PERIODS = 3.0
"""Longest step, in periods, of an irregular clock; at longer ones the episode is split."""
HARMLESS_GAP_S = 0.01
"""Step up to which an episode is never split: a loop of a few ms that stalls for so long holds its command."""
SHORTEST_PERIOD_S = 1e-4
BURST_STEP, LONGEST_BURST, FEWEST_IN_BURSTS = 0.25, 25, 30
"""Rows come in bursts where the median step is below this share of the mean, and no row is further than this many rows
from a steady clock; and the fewest steps with which this is tested."""
ROWS_TOGETHER = 6
"""Rows whose mean distance is a period where rows of two or three sensors come in turn, at unequal steps."""
LEAST_STEPS = 3
"""Steps in the time of a prediction, at least."""
LEAST_STEP_PERIODS = 1e-3
"""Step between two rows, in periods, below which the stamps are not those of the readings."""
UNITS_S = {"nanoseconds": 1e-9, "microseconds": 1e-6, "milliseconds": 1e-3, "minutes": 60, "hours": 3600, "days": 86400}
"""Units that stamps come in by mistake."""
PERIOD_RATIO = 1.5
"""Largest ratio between the periods of two episodes of one recording."""
ROUNDING_ERROR = 0.55
"""Largest deviation of rounded stamps from a steady clock, over the unit that they are rounded to: half of it, and what
the fit of the clock adds."""


@dataclass(frozen=True)
class RawEpisode:
    """The rows of an episode as they were read: clock, order of columns and units are not checked yet."""

    path: Path
    time: NDArray[np.float64]
    """(T,) s, as in the file; `uninterrupted` makes it start at 0"""
    action: NDArray[np.float64]
    """(T, n_action)"""
    state: NDArray[np.float64]
    """(T, n_measured)"""
    measured: tuple[str, ...]
    """names of the columns of state, in the system's order"""
    place: Callable[[int], str] = lambda row: f"row {row + 1}"
    """names a row, counted from 0, in messages"""
    names: Mapping[str, str] = field(default_factory=dict)
    """the file's names of the variables"""
    given: Mapping[str, str] = field(default_factory=dict)
    """the columns that the user named, perhaps with conversions"""
    number: float | None = None
    """of the episode, if the file has several"""
    frame: NDArray[np.uint8] | None = None
    """(T, H, W), where frames are read in the place of states"""
    usable: NDArray[np.bool_] | None = None
    """(T, n_measured) which readings are measurements; without it, all are"""
    command_period: float | None = None
    """median s between commands with stamps of their own, of which a row holds the mean until the next; None where they
    share those of readings, or one was sent but once"""

    @property
    def origin(self) -> str:
        """The file, and the episode if the file has several, for messages."""
        return str(self.path) if self.number is None else f"{self.path}{EPISODE}{self.number:.15g}"

    @property
    def states(self) -> dict[str, NDArray[np.float64]]:
        """The columns (T,) of state, by name."""
        return dict(zip(self.measured, self.state.T, strict=True))

    @property
    def period(self) -> float:
        """s between rows, the median; of rows of several sensors, each at its own instants, the median over
        ROWS_TOGETHER of them."""
        rows = 1 if self.usable is None else min(ROWS_TOGETHER, len(self.time) - 1)
        return float(np.median(self.time[rows:] - self.time[:-rows])) / rows

    def read(self, name: str) -> NDArray[np.intp]:
        """The rows in which a state was measured."""
        every = np.arange(len(self.time))
        return every if self.usable is None else every[self.usable[:, self.measured.index(name)]]

    def column(self, name: str) -> str:
        """The name in messages of a variable's column."""
        there = self.names.get(name, name)
        return f"column {name!r}" if there.lower() == name else f"column {there!r} ({name})"

    def conversion(self, name: str, how: str) -> str:
        """The end of a message: how a user has a variable's numbers converted, behind a factor that was given; empty
        where no file's column is read, or an offset was given."""
        if name not in self.names or (name in self.given and read_column(self.given[name], self.names.values()).offset):
            return ""
        return f"; --columns {name}={self._read_as(name)}{how} converts"

    def exchange(self, one: str, other: str) -> str:
        """The end of a message: how a user has two variables exchange their columns; empty where no file's is read."""
        if one not in self.names or other not in self.names:
            return ""
        return f"; --columns {one}={self._read_as(other)},{other}={self._read_as(one)} converts"

    def _read_as(self, name: str) -> str:
        """The file's column of a variable, perhaps with a conversion that the user gave."""
        return self.given.get(name) or self.names[name]

    def cell(self, row: int, name: str) -> str:
        """Where in the file a value stands, for messages."""
        return f"{self.origin}: {self.place(row)}, {self.column(name)}"

    def of(self, names: Sequence[str]) -> RawEpisode:
        """With these of the measured states."""
        columns = [self.measured.index(name) for name in names]
        usable = None if self.usable is None else self.usable[:, columns]
        return replace(self, measured=tuple(names), state=self.state[:, columns], usable=usable)

    def part(self, start: int, end: int) -> RawEpisode:
        """The rows from `start` up to, but not including, `end`."""
        return self._rows(slice(start, end), lambda row: self.place(start + row))

    def without(self, left_out: NDArray[np.bool_]) -> RawEpisode:
        """The rows that are not `left_out` (T,)."""
        kept = np.flatnonzero(~left_out)
        return self._rows(kept, lambda row: self.place(int(kept[row])))

    def _rows(self, rows: slice | NDArray[np.intp], place: Callable[[int], str]) -> RawEpisode:
        time, action, state = self.time[rows], self.action[rows], self.state[rows]
        frame = None if self.frame is None else self.frame[rows]
        usable = None if self.usable is None else self.usable[rows]
        return replace(self, time=time, action=action, state=state, frame=frame, usable=usable, place=place)


def check_forward(raw: RawEpisode) -> None:
    """Raises RecordingError where the time of a row is not later than that of the row before."""
    backwards = np.flatnonzero(np.diff(raw.time) <= 0)
    if len(backwards):
        row = int(backwards[0])
        before, after = raw.time[row], raw.time[row + 1]
        problem = "repeats itself" if before == after else "runs backward"
        raise RecordingError(
            f"{raw.cell(row + 1, 'time')}: the clock {problem} (from {before:.15g} s to {after:.15g} s); each row must "
            "be later than the one before; mark several episodes by a column 'episode'"
        )


def check_steps(episodes: Sequence[RawEpisode], system: System) -> None:
    """Check that the stamps of a file's episodes are in s.

    Raises:
        RecordingError: the period is too short, or too long for predictions of the system, or a step is less than
            `LEAST_STEP_PERIODS`.
    """
    steps = [np.diff(raw.time) for raw in episodes]
    every = np.concatenate(steps)
    if not len(every):
        return
    raw, period = episodes[0], float(np.median(every))
    longest = system.prediction_time / LEAST_STEPS * (1 + 1e-4)
    if not SHORTEST_PERIOD_S <= period <= longest:
        units = [name for name, unit in UNITS_S.items() if SHORTEST_PERIOD_S <= unit * period <= longest]
        slower = f"; the class of a slower machine states a prediction_time above {system.prediction_time:g} s"
        raise RecordingError(
            f"{raw.origin}: column 'time': rows are {period:.4g} s apart; {SHORTEST_PERIOD_S:g} to {longest:.4g} s are "
            "right"
            + (f" (is the clock in {' or '.join(units)}?)" if units else "")
            + (slower if period > longest else "")
        )
    for raw, own in zip(episodes, steps, strict=True):
        if len(own) and raw.usable is None and own.min() < LEAST_STEP_PERIODS * period:
            row = int(own.argmin()) + 1
            raise RecordingError(
                f"{raw.cell(row, 'time')}: only {own.min():.3g} s after the row before, where most are {period:.4g} s "
                "apart; stamps of the readings, not of when a log wrote them, are right"
            )


def without_bursts(raw: RawEpisode, note: Note) -> RawEpisode:
    """The episode on a steady clock where its rows are stamped as they arrived, several at once."""
    steps = np.diff(raw.time)
    if raw.usable is not None:  # rows of several sensors, each at its own instants
        return raw
    if len(steps) < FEWEST_IN_BURSTS or np.median(steps) > BURST_STEP * steps.mean():
        return raw
    index, newest = np.arange(len(raw.time)), np.flatnonzero(steps > steps.mean())  # the last of each burst
    period, start = np.polyfit(newest, raw.time[newest], 1)
    if np.abs(raw.time - start - period * index).max() > LONGEST_BURST * period:
        return raw
    note(
        f"rows arrive in bursts and are stamped as they arrive: they were taken to be {period:.4g} s apart", raw.origin
    )
    return replace(raw, time=raw.time[0] + period * index)


def uninterrupted(raw: RawEpisode, note: Note, jumps: Sequence[int] = ()) -> list[RawEpisode]:
    """The episode in parts without missing rows, split at `jumps` too; `time` counts from the start of the whole
    episode."""
    raw = replace(raw, time=raw.time - raw.time[0])
    steps = np.diff(raw.time)
    if len(steps) == 0:
        return [raw]
    period = raw.period
    gaps = (steps > GAP_PERIODS * period * (1 + 1e-6)) & (_later_by(raw.time, period) > LATER_PERIODS * period)
    irregular = gaps.mean() > MOST_GAPS and gaps.sum() > 1
    longest = max(HARMLESS_GAP_S, (LONGEST_STEP_PERIODS if irregular else GAP_PERIODS) * period)
    long = steps > longest * (1 + 1e-6)
    cuts = (np.flatnonzero(long if irregular else long & gaps) + 1).tolist()
    for cut in cuts:
        note("rows are missing here; the episode was split", f"{raw.origin}, {raw.place(cut)}")
    edges = sorted({0, *cuts, *jumps, len(raw.time)})
    parts = [_clocked(raw.part(start, end)) for start, end in pairwise(edges)]
    unsteady = [own for part in parts if _is_unsteady(own := np.diff(part.time), period)]
    if unsteady:
        shortest, longest = min(own.min() for own in unsteady), max(own.max() for own in unsteady)
        note(f"an unsteady clock: its steps last {shortest:.3g} to {longest:.3g} s", raw.origin)
    return parts


def _is_unsteady(steps: NDArray[np.float64], period: float) -> bool:
    return len(steps) > 1 and bool(np.ptp(steps) > UNSTEADY_PERIODS * period)


def _later_by(time: NDArray[np.float64], period: float) -> NDArray[np.float64]:
    """By how many s the rows after each step (T - 1,) are later than a steady clock of the rows before it expects."""
    late = time - period * np.arange(len(time))
    padded = np.pad(late, AROUND, mode="edge")
    around = np.lib.stride_tricks.sliding_window_view(padded, AROUND)
    steps = np.arange(1, len(time)) + AROUND
    later: NDArray[np.float64] = np.median(around[steps], 1) - np.median(around[steps - AROUND], 1)
    return later


def _clocked(part: RawEpisode) -> RawEpisode:
    """The part on a steady clock where its stamps deviate by no more than their rounding; else with its own stamps.

    The diagnosis decides whether unsteady stamps are those of the readings, or of a log that wrote them late.
    """
    index = np.arange(len(part.time))
    if len(index) < 3:
        return part
    period, start = np.polyfit(index, part.time, 1)
    off = part.time - (start + period * index)
    if np.abs(off).max() <= ROUNDING_ERROR * _rounding(part.time):
        return replace(part, time=part.time[0] + period * index)
    return part


def _rounding(time: NDArray[np.float64]) -> float:
    """The power of ten, or of two as in single precision, in s, that all stamps (T,) are rounded to."""
    for decimals in range(MOST_DECIMALS):
        ticks = time * 10**decimals
        if np.abs(ticks - np.round(ticks)).max() < 0.01:
            return float(10**-decimals)
    for halvings in range(MOST_HALVINGS):
        if (np.ldexp(time, halvings) % 1 == 0).all():
            return float(2**-halvings)
    return float(10**-MOST_DECIMALS)


def with_common_period(parts: list[RawEpisode], note: Note) -> tuple[list[RawEpisode], float]:
    """The parts with about the period of most rows, and the median step in s; every part needs at least two rows.

    Raises:
        RecordingError: a file has no such part.
    """
    periods = np.array([part.period for part in parts])
    order = np.argsort(periods)
    rows = np.cumsum([len(parts[index].time) for index in order])
    period = float(periods[order][np.searchsorted(rows, rows[-1] / 2)])
    fits = (periods / period < PERIOD_RATIO) & (periods * PERIOD_RATIO > period)
    kept = [part for part, fit in zip(parts, fits, strict=True) if fit]
    usual = {part.path for part in kept}
    for part, own, fit in zip(parts, periods, fits, strict=True):
        if part.path not in usual:
            raise RecordingError(
                f"{part.origin}: column 'time': rows are {own:.4g} s apart, those of {kept[0].path} {period:.4g} s; "
                "recordings with one period, in seconds, are right"
            )
        if not fit:
            note(f"left out, since its rows are not {period:.4g} s apart as most are", part.origin)
    return kept, period
