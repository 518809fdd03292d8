"""Sensors slower than the rows: between two readings a table repeats the last one, or has empty cells.

Such cells are no measurements. Taken for some, they would look like a sensor that is late, that drops out, or whose
angle stands still.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from visadapt.recordings.clock import Note, RawEpisode
from visadapt.recordings.runs import runs
from visadapt.recordings.sensors import TURN, variable_of
from visadapt.systems import System

ENTERED_STEPS, LEFT_STEPS = 2.5, 1.5
"""Changes into and out of a run of equal readings, of which the larger exceeds ENTERED_STEPS of the sensor's steps and
the smaller LEFT_STEPS: the sensor moved on, so a reading that it repeats was held."""
FEWEST_RUNS = 30
"""Fewest such runs from which a sensor's rate is told."""
LONGEST_RUN = 3.0
"""Rows of a run, over the median, up to which the machine cannot have rested within it."""
LEAST_ROWS = 1.1
"""Mean rows of a run from which on a sensor is slower than the rows."""
LEAST_ZERO = 0.25
"""Share of zeros among a rate's values while its moving position is held, above which it is derived from that."""
LEAST_EMPTY = 0.05
"""Share of empty cells from which on a column is that of a sensor slower than the rows; fewer are refused."""
RUNS_TOGETHER = 8
MOST_DISPERSION = 0.25
"""Variance of the rows of a run, or of RUNS_TOGETHER runs for each of them, over that where rows are lost at random; a
sensor with a clock of its own has hardly any."""


def without_held_readings(raw: RawEpisode, system: System, note: Note) -> RawEpisode:
    """The episode with the readings marked as not usable that repeat the last one of a sensor slower than the rows, and
    without rates that were derived from these."""
    found = {name: fresh for name, values in raw.states.items() if (fresh := _fresh(values)) is not None}
    for name in [*found]:
        rate = system.rate_of(name)
        if rate in raw.measured and _is_derived(raw.states[rate], raw.states[name], found[name]):
            note(f"{rate} is 0 while {name} is held: derived on the rig from it, not measured; left out", raw.origin)
            found.pop(rate, None)
            raw = raw.of([other for other in raw.measured if other != rate])
    told: dict[str, list[str]] = {}
    usable = np.ones(raw.state.shape, bool)
    for name, fresh in found.items():
        usable[:, raw.measured.index(name)] = fresh
        interval = np.ptp(raw.time[fresh]) / (fresh.sum() - 1)
        told.setdefault(f"{1 / fresh.mean():.2g} rows ({interval:.2g} s)", []).append(name)
    for every, names in told.items():
        note(
            f"{', '.join(names)}: read about every {every} and held in between: only new readings are used, which may "
            "be late by up to a row",
            raw.origin,
        )
    return with_usable(raw, usable, system)


def _is_derived(rate: NDArray[np.float64], position: NDArray[np.float64], fresh: NDArray[np.bool_]) -> bool:
    """Whether a rate (T,) is the difference of a position (T,) that moves and is held between `fresh` (T,) readings."""
    zero = [rate[a + 1 : b] == 0 for a, b in runs(position) if 1 < (b - a) * fresh.mean() + 0.5 < 2 and b - a > 1]
    return bool(zero) and float(np.concatenate(zero).mean()) > LEAST_ZERO


def with_empty_cells(raw: RawEpisode, system: System, note: Note) -> RawEpisode:
    """The episode of a table in which the cells of a sensor slower than the rows are empty, or those of commands that
    come less often: these are held until the next.

    A column in which few cells are empty stays as it is.
    """
    empty = np.isnan(raw.action)
    sparse = empty.mean(0) > LEAST_EMPTY
    if sparse.any():
        first = int((~empty[:, sparse]).argmax(0).max())
        raw, empty = raw.part(first, len(raw.time)), empty[first:]
        action = raw.action.copy()
        for column in np.flatnonzero(sparse):
            rows = np.where(empty[:, column], 0, np.arange(len(action)))
            action[:, column] = action[np.maximum.accumulate(rows), column]
            told = f"{system.actions[column].name} is empty in {empty[:, column].mean():.0%} of the rows: held in them"
            note(told + (f"; the {first} rows before the first command are left out" if first else ""), raw.origin)
        raw = replace(raw, action=action)
    missing = np.isnan(raw.state)
    sparse = (missing.mean(0) > LEAST_EMPTY) & ~missing.all(0)
    if not sparse.any():
        return raw
    names = ", ".join(name for name, few in zip(raw.measured, sparse, strict=True) if few)
    note(
        f"{names}: read in the rows in which cells are not empty, {(~missing[:, sparse]).mean():.0%} of all", raw.origin
    )
    return with_usable(raw, ~(missing & sparse), system)


def _fresh(values: NDArray[np.float64]) -> NDArray[np.bool_] | None:
    """Which of a sensor's values (T,) are new readings; None where it is as fast as the rows, or repeats at random."""
    starts = np.array([start for start, _ in runs(values)])
    if len(starts) < FEWEST_RUNS + 2:
        return None
    jumps = np.abs(np.diff(values[starts]))
    step = jumps.min()
    smaller, larger = np.minimum(jumps[:-1], jumps[1:]), np.maximum(jumps[:-1], jumps[1:])
    moving = (smaller > LEFT_STEPS * step) & (larger > ENTERED_STEPS * step)  # all runs but the first and the last
    rows = np.diff(starts)[1:][moving]
    rows = rows[rows <= LONGEST_RUN * np.median(rows)] if len(rows) else rows
    mean = rows.mean() if len(rows) >= FEWEST_RUNS else 1.0
    if mean < LEAST_ROWS:
        return None
    together = rows[: len(rows) // RUNS_TOGETHER * RUNS_TOGETHER].reshape(-1, RUNS_TOGETHER).sum(1)
    variance = min(rows.var(), together.var() / RUNS_TOGETHER) if len(together) > RUNS_TOGETHER else rows.var()
    if variance > MOST_DISPERSION * mean * (mean - 1):
        return None
    fresh = np.zeros(len(values), bool)
    fresh[starts] = True
    for start, end in np.column_stack((starts, np.append(starts[1:], len(values))))[~np.pad(moving, 1)]:
        # At rest, a sensor reads the same value several times.
        fresh[start + np.round(mean * np.arange(round((end - start) / mean))).astype(int)] = True
    return fresh


def with_usable(raw: RawEpisode, usable: NDArray[np.bool_], system: System) -> RawEpisode:
    """The episode with only those of its readings marked as such that are also `usable` (T, n_measured).

    In the place of the others are values interpolated between those around, or the nearest at the ends.
    """
    if raw.usable is not None:
        usable = usable & raw.usable
    if usable.all():
        return raw
    state = raw.state.copy()
    for column, name in enumerate(raw.measured):
        kept, others = np.flatnonzero(usable[:, column]), np.flatnonzero(~usable[:, column])
        later = np.searchsorted(kept, others)
        before, after = kept[np.maximum(later - 1, 0)], kept[np.minimum(later, len(kept) - 1)]
        share = (raw.time[others] - raw.time[before]) / np.where(after > before, raw.time[after] - raw.time[before], 1)
        step = np.where(after > before, state[after, column] - state[before, column], 0.0)
        if variable_of(system, name).unit == "rad":
            step -= TURN * np.round(step / TURN)
        state[others, column] = state[before, column] + share * step
    return replace(raw, state=state, usable=usable)
