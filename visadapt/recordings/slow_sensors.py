"""Sensors slower than the rows: between two readings a table repeats the last one, or has empty cells.

Such cells are no measurements. Taken for some, they would look like a sensor that is late, that drops out, or whose
angle stands still.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from visadapt.recordings.clock import Note, RawEpisode
from visadapt.recordings.command_clock import in_gaps
from visadapt.recordings.resolution import smallest_step
from visadapt.recordings.runs import runs
from visadapt.recordings.sensors import TURN, variable_of
from visadapt.systems import System

Floats = NDArray[np.float64]

ENTERED_STEPS, LEFT_STEPS = 2.5, 1.5
"""Changes into and out of a run of equal readings, of which the larger exceeds ENTERED_STEPS of the sensor's steps and
the smaller LEFT_STEPS: the sensor moved on, so a reading that it repeats was held."""
MOST_STEPS = 50  # Steps in an encoder's range for each value that it reads, at most
LONGEST_RUN = 6.0
"""Rows of a run, over the median, up to which the machine cannot have rested within it."""
MOST_DISPERSION = 0.5
"""Variance of intervals over that of rows lost at random (a geometric distribution), below which they are regular: a
sensor with a clock of its own, even one that misses some readings."""
LEAST_LOG_ODDS = 12.0
"""Log likelihood that the intervals' own distribution gains over that of rows lost at random, at least."""
MOST_SHARED = 0.9
"""Share of the rows in which a sensor that is held changes, above which another that changes in these alone is held
too."""
LEAST_ZERO = 0.25
"""Share of zeros among a rate's values while its moving position is held, above which it is derived from that."""
FEWEST_EMPTY = 3
"""Empty cells of a column from which on they are those of a sensor that was not read; fewer are refused."""


def without_held_readings(episodes: Sequence[RawEpisode], system: System, note: Note) -> list[RawEpisode]:
    """The episodes of a file with the readings marked as not usable that repeat the last one of a sensor slower than
    the rows, and without rates that were derived from these."""
    if not episodes:
        return []
    origin, names = str(episodes[0].path), list(episodes[0].measured)
    values = {name: [raw.states[name] for raw in episodes] for name in names}
    found = {name: fresh for name in names if (fresh := _fresh(values[name])) is not None}
    for name in [one for one in names if one not in found]:
        # In steady motion all steps are alike, as an encoder's: what tells is that another changes in the same rows.
        other = next((one for one in found if _change_together(values[name], values[one])), None)
        if other is not None:
            found[name] = found[other]
    for name in [*found]:
        rate = system.rate_of(name)
        if rate in names and _is_derived([(raw.states[rate], raw.states[name]) for raw in episodes], found[name]):
            note(f"{rate} is 0 while {name} is held: derived on the rig from it, not measured; left out", origin)
            found.pop(rate, None)
            names.remove(rate)
    told: dict[str, list[str]] = {}
    for name, fresh in found.items():
        share = float(np.concatenate(fresh).mean())
        period = float(np.median(np.concatenate([np.diff(raw.time) for raw in episodes])))
        told.setdefault(f"{1 / share:.3g} rows ({period / share:.2g} s)", []).append(name)
    for every, slow in told.items():
        note(
            f"{', '.join(slow)}: read about every {every} and held in between: only new readings are used, which may "
            "be late by up to a row",
            origin,
        )
    out = []
    for number, raw in enumerate(raw.of(names) for raw in episodes):
        usable = [found[name][number] if name in found else np.ones(len(raw.time), bool) for name in names]
        out.append(with_usable(raw, np.column_stack(usable), system) if found else raw)
    return out


def _change_together(episodes: Sequence[Floats], others: Sequence[Floats]) -> bool:
    """Whether a sensor's values (T,) change in most of the rows in which another's, which is held, do, and in no
    other."""
    changed, other = (np.concatenate([np.diff(values) != 0 for values in each]) for each in (episodes, others))
    return not bool((changed & ~other).any()) and float(changed.sum()) > MOST_SHARED * float(other.sum())


def _is_derived(pairs: Sequence[tuple[Floats, Floats]], fresh: Sequence[NDArray[np.bool_]]) -> bool:
    """Whether a rate is the difference of a position that moves and is held between `fresh` readings; of episodes (T,)
    of both."""
    share = float(np.concatenate(fresh).mean())
    zero = [
        rate[a + 1 : b] == 0
        for rate, position in pairs
        for a, b in runs(position)
        if b - a > 1 and 0.5 < (b - a) * share < 1.5
    ]
    return bool(zero) and float(np.concatenate(zero).mean()) > LEAST_ZERO


def with_empty_cells(raw: RawEpisode, system: System, note: Note) -> RawEpisode:
    """The episode of a table in which the cells of a sensor slower than the rows are empty, or those of commands that
    come less often: these are held until the next. Rows before the first command are left out.

    A column in which hardly a cell is empty stays as it is.
    """
    first = int((~np.isnan(raw.action)).argmax(0).max(initial=0))
    if first:
        note(f"rows before the first command are left out: {first}", raw.origin)
        raw = raw.part(first, len(raw.time))
    empty = np.isnan(raw.action)
    sparse = empty.sum(0) >= FEWEST_EMPTY
    if sparse.any():
        given = raw.time[~empty[:, sparse].any(1)]
        unknown = in_gaps(raw.time, given)
        if unknown.any():
            note(f"rows in gaps of the commands are left out: {int(unknown.sum())}", raw.origin)
            raw, empty = raw.without(unknown), empty[~unknown]
        action = raw.action.copy()
        for column in np.flatnonzero(sparse):
            rows = np.where(empty[:, column], 0, np.arange(len(action)))
            action[:, column] = action[np.maximum.accumulate(rows), column]
            if count := int(empty[:, column].sum()):
                note(f"{system.actions[column].name} is empty in {count} of {len(empty)} rows: held", raw.origin)
        raw = replace(raw, action=action)
    missing = np.isnan(raw.state)
    sparse = (missing.sum(0) >= FEWEST_EMPTY) & ~missing.all(0)
    if not sparse.any():
        return raw
    counts = zip(raw.measured, missing.sum(0).tolist(), sparse, strict=True)
    of = ", ".join(f"{name} in {count}" for name, count, few in counts if few)
    note(f"cells are empty, of {of} of {len(missing)} rows: not read there", raw.origin)
    return with_usable(raw, ~(missing & sparse), system)


def _fresh(episodes: Sequence[Floats]) -> list[NDArray[np.bool_]] | None:
    """Which of a sensor's values (T,) of episodes are new readings; None where it is as fast as the rows, or repeats at
    random."""
    starts = [np.array([start for start, _ in runs(values)]) for values in episodes]
    jumps = [np.diff(values[first]) for values, first in zip(episodes, starts, strict=True)]
    every = np.concatenate(episodes)
    step = smallest_step(every)
    is_encoder = float(np.ptp(every)) < MOST_STEPS * step * len(np.unique(every))
    moving = [_moves(each, step, is_encoder) for each in jumps]
    lengths = [np.diff(first)[1:][moves] for first, moves in zip(starts, moving, strict=True)]
    held = [_repeated(first[1:-1][moves], own) for first, moves, own in zip(starts, moving, lengths, strict=True)]
    rows = _usual(np.concatenate([np.zeros(0), *lengths]))
    # Of a sensor nearly as fast as the rows, few readings are held, but at regular intervals.
    if not (_is_regular(rows) or _is_regular(_usual(np.concatenate([np.diff(each) for each in held])))):
        return None
    mean, out = float(rows.mean()), []
    for values, first, moves in zip(episodes, starts, moving, strict=True):
        fresh = np.zeros(len(values), bool)
        fresh[first] = True
        ends = np.append(first[1:], len(values))
        still = np.pad(~moves, 1, constant_values=True)[: len(first)]
        for start, end in np.column_stack((first, ends))[still]:
            # At rest, a sensor reads the same value several times.
            fresh[start + np.round(mean * np.arange(round((end - start) / mean))).astype(int)] = True
        out.append(fresh)
    return out


def _moves(jumps: Floats, step: float, is_encoder: bool) -> NDArray[np.bool_]:
    """Whether a sensor with this `step` moves on at both ends of each run, all but the first and the last, of readings
    that jump by `jumps` from run to run. Where a motion turns round, an encoder reads the same twice."""
    size = np.abs(jumps)
    smaller, larger = np.minimum(size[:-1], size[1:]), np.maximum(size[:-1], size[1:])
    moves: NDArray[np.bool_] = (smaller > LEFT_STEPS * step) & (larger > ENTERED_STEPS * step)
    return moves & (jumps[:-1] * jumps[1:] > 0) if is_encoder else moves


def _repeated(starts: NDArray[np.intp], lengths: NDArray[np.intp]) -> Floats:
    """All rows but the first of runs that start at (K,) rows and have these lengths (K,)."""
    return np.concatenate(
        [np.zeros(0), *(start + np.arange(1, own) for start, own in zip(starts, lengths, strict=True))]
    )


def _usual(rows: Floats) -> Floats:
    """Those of numbers of rows (N,) within which the machine cannot have rested."""
    return rows[rows <= LONGEST_RUN * np.median(rows)] if len(rows) else rows


def _is_regular(rows: Floats) -> bool:
    """Whether numbers of rows (N,) are more alike than those between rows that are lost at random."""
    mean = float(rows.mean()) if len(rows) else 1.0
    if mean == 1 or rows.var() > MOST_DISPERSION * mean * (mean - 1):
        return False
    values, counts = np.unique(rows, return_counts=True)
    at_random = -np.log(mean) + (values - 1) * np.log1p(-1 / mean)
    gained = float((counts * (np.log(counts / len(rows)) - at_random)).sum())
    # Each value's share was fitted; a few numbers that all differ show nothing regular.
    return len(rows) >= 2 * len(values) and gained - len(values) > LEAST_LOG_ODDS


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
