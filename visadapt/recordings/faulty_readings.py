"""Readings that are no measurements: outliers, what a stuck sensor repeats, and what is written while none answers are
set aside, and an episode is split where a position is suddenly elsewhere.

Left in, they would look like a push to whoever differentiates the positions.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from visadapt.recordings.clock import Note, RawEpisode
from visadapt.recordings.episode import RecordingError
from visadapt.recordings.runs import runs
from visadapt.recordings.sensors import FROZEN_ROWS, differences, variable_of
from visadapt.recordings.slow_sensors import with_usable
from visadapt.systems import CartPole, System, Variable

OUTLIER_SCALES = 50.0
"""Jump of a reading above which it may be an outlier, in usual departures from the mean of its neighbours."""
OUTLIER_ROWS = 3
"""Most consecutive rows that an outlier may last."""
OUTLIER_RETURN = 0.2
"""Share of a jump that may remain where the reading after an outlier counts as back at that before it."""
MOST_OUTLIERS = 0.05
"""Share of outliers among the rows of an episode above which the sensor is refused."""
STUCK_ROWS = 5
"""Equal readings of a position in a row, at least, that a stuck sensor repeats."""
STUCK_RATIO, STUCK_STEPS = 3.0, 8
"""Change of a position after its sensor stuck, over the next change and over the smallest of all, at least: a machine
that dry friction held starts slowly instead."""
OUTAGE_CHANCE = 1e-3
"""Probability that rows which are lost one by one repeat one as often somewhere in an episode, up to which a run of
equal rows is an outage."""
JUMP_SCALES = 12.0
"""Departure of a change from those around it, over the median departure, from which on a position may have jumped."""
JUMP_RATIO, AROUND_JUMP = 2.0, 5
"""The rate of that change over the fastest in so many rows on either side, at least: what is hit goes on moving."""
DEVIATION_PER_MEDIAN = 1.4826
"""Standard deviation over the median of the absolute values, of normal errors."""


def without_outliers(raw: RawEpisode, system: System, note: Note) -> RawEpisode:
    """The episode with outliers, and the readings of stuck sensors and of outages, marked as not usable.

    Outliers jump away and back faster than the state can move. Such rows keep time and command; their readings are
    interpolated.

    Raises:
        RecordingError: more than `MOST_OUTLIERS` of a column are outliers.
    """
    if len(raw.time) < FROZEN_ROWS:
        return raw
    bad = np.zeros(len(raw.time), bool)
    for name in raw.measured:
        variable, rows = variable_of(system, name), raw.read(name)
        if variable.unit == "1" or len(rows) < FROZEN_ROWS:  # a quaternion's sign may change
            continue
        values = raw.states[name][rows]
        rate = system.rate_of(name)
        allowed = variable.largest
        if rate is not None:
            allowed = min(allowed, 2 * float(np.median(np.diff(raw.time[rows]))) * variable_of(system, rate).largest)
        changes = differences(values, variable.unit == "rad")
        outliers = _outliers(changes, values, allowed)
        if outliers.mean() > MOST_OUTLIERS:
            first = int(outliers.argmax())
            raise RecordingError(
                f"{raw.cell(int(rows[first]), name)} is {values[first]:g}, far off the rows before and after, and "
                f"{outliers.mean():.0%} of the column lie as far off: a sensor that follows the motion is right"
            )
        for row in rows[outliers & ~bad[rows]].tolist():
            note(
                "lies far off the rows before and after: an outlier; the row's readings were set aside",
                f"{raw.cell(row, name)}: {raw.states[name][row]:g}",
            )
        bad[rows[outliers]] = True
        if rate is not None and not _may_stand_still(variable, system):
            for start, end in _stuck(raw.state[rows], values, changes):
                note(
                    f"{name} repeats a reading, then jumps: its sensor stuck; these rows' readings were set aside",
                    f"{raw.cell(int(rows[start]), name)}, and {end - start - 1} rows after it",
                )
                bad[rows[start:end]] = True
    for start, end in _outages(raw, system):
        note(
            "every reading is repeated, then jumps: no sensor answered; these rows' readings were set aside",
            f"{raw.origin}: {raw.place(start)}, and {end - start - 1} rows after it",
        )
        bad[start:end] = True
    return with_usable(raw, np.repeat(~bad[:, None], len(raw.measured), 1), system) if bad.any() else raw


def _outliers(steps: NDArray[np.float64], values: NDArray[np.float64], allowed: float) -> NDArray[np.bool_]:
    """Which rows (T,) follow a jump that is larger than `allowed` and than usual, and undone in `OUTLIER_ROWS` rows."""
    apart = np.diff(np.unique(values))
    usual = DEVIATION_PER_MEDIAN * float(np.median(np.abs(np.diff(steps)))) / 2
    least = max(allowed, OUTLIER_SCALES * max(usual, float(apart.min()) if len(apart) else 0.0))
    bad = np.zeros(len(values), bool)
    for jump in np.flatnonzero(np.abs(steps) > least):
        away = np.abs(np.cumsum(steps[jump : jump + OUTLIER_ROWS + 1]))
        back = np.flatnonzero(away < OUTLIER_RETURN * away[0])
        if len(back) and (away[: back[0]] > least).all():
            bad[jump + 1 : jump + 1 + back[0]] = True
    return bad


def _may_stand_still(variable: Variable, system: System) -> bool:
    """Whether readings of a variable that stand still in places are an effect of the catalogue."""
    return isinstance(system, CartPole) and variable.unit == "rad"


def _stuck(
    state: NDArray[np.float64], values: NDArray[np.float64], changes: NDArray[np.float64]
) -> Iterator[tuple[int, int]]:
    """First row, and the row after the last, of each run in which a sensor of `values` (T,), one of those of `state`
    (T, n_measured), with these `changes` (T - 1,), repeats an earlier one."""
    steps, least = _steps(changes)
    for start, end in runs(values):
        lost = (state[start:end] == state[start]).all()  # whole rows, which are an effect of the catalogue
        if end - start < STUCK_ROWS or end + 1 >= len(values) or lost:
            continue
        if _jumps(steps[end - 1 : end + 1], least):
            yield start + 1, end


def _outages(raw: RawEpisode, system: System) -> Iterator[tuple[int, int]]:
    """First row, and the row after the last, of each run of equal rows that were written while no sensor answered: too
    many for rows lost one by one, and zeros to or from which a position jumps, or the last readings of a machine that
    moved, from which one jumps."""
    positions = [raw.measured.index(name) for name in raw.measured if system.rate_of(name) is not None]
    if not positions or (len(raw.measured) == 1 and _may_stand_still(variable_of(system, raw.measured[0]), system)):
        return
    angles = [variable_of(system, raw.measured[column]).unit == "rad" for column in positions]
    changes = [differences(raw.state[:, column], angle) for column, angle in zip(positions, angles, strict=True)]
    steps, least = _steps(np.column_stack(changes))
    repeated = np.append(False, (raw.state[1:] == raw.state[:-1]).all(1))
    for start, end in runs((~repeated).cumsum()):
        others = (repeated.sum() - (end - start - 1) + 1) / len(repeated)
        if end - start < STUCK_ROWS or len(repeated) * others ** (end - start - 1) > OUTAGE_CHANCE:
            continue
        leaves = end + 1 < len(repeated) and _jumps(steps[end - 1 : end + 1], least)
        if (raw.state[start] == 0).all():
            if leaves or (start > 1 and _jumps(steps[start - 2 : start][::-1], least)):
                yield start, end
        elif leaves and start > 0 and (steps[start - 1] > least).any():
            yield start + 1, end


def _steps(changes: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Sizes (T - 1, ...) of the changes of positions, and the least (...) from which on one may be a jump."""
    steps = np.abs(changes)
    return steps, STUCK_STEPS * np.where(steps > 0, steps, np.inf).min(0, initial=np.inf)


def _jumps(steps: NDArray[np.float64], least: NDArray[np.float64]) -> bool:
    """Whether the first of two changes (2, ...) of positions exceeds `least` (...) and what the second allows."""
    return bool((steps[0] > np.maximum(least, STUCK_RATIO * steps[1])).any())


FEW_JUMPS, JUMP_SHARE = 5, 0.01
"""Rows of an episode, and share of all its rows, in which a position may jump for the episode to be split there."""


def jumps(raw: RawEpisode, system: System, note: Note) -> list[int]:
    """The rows from which on a position is suddenly elsewhere: its sensor lost count, or was moved.

    None where it is so often elsewhere that an estimator, which corrects it with every reading it takes in, wrote it.
    """
    found = list(_found_jumps(raw, system))
    rows = {row for row, _, _ in found}
    if len(rows) > max(FEW_JUMPS, JUMP_SHARE * len(raw.time)):
        row, name, size = found[0]
        note(
            f"positions jump in {len(rows)} rows, as those of an estimator do where it takes in a reading: the episode "
            "was not split there",
            f"{raw.cell(row, name)}, by {size}",
        )
        return []
    for row, name, size in found:
        note(
            f"{name} is suddenly elsewhere and stays there: its sensor lost count or was moved, or an estimator was "
            "reset; the episode was split",
            f"{raw.cell(row, name)}, by {size}",
        )
    return sorted(rows)


def _found_jumps(raw: RawEpisode, system: System) -> Iterator[tuple[int, str, str]]:
    """The row, the position and the size, with its unit, of every jump."""
    for name, values in raw.states.items():
        rows = raw.read(name)
        if system.rate_of(name) is None or len(rows) <= FROZEN_ROWS:
            continue
        lasting, steps = np.diff(raw.time[rows]), np.diff(values[rows])
        padded = np.pad(steps / lasting, AROUND_JUMP, mode="edge")
        others = np.delete(np.lib.stride_tricks.sliding_window_view(padded, 2 * AROUND_JUMP + 1), AROUND_JUMP, 1)
        nearest = others[:, AROUND_JUMP - 2 : AROUND_JUMP + 2].mean(1)
        departs = steps - lasting * nearest
        size = np.abs(departs)
        moved = size[size > 0]  # a dead sensor's readings are all equal
        usual = JUMP_SCALES * DEVIATION_PER_MEDIAN * float(np.median(moved)) if len(moved) else 0.0
        jump = size > np.maximum(usual, JUMP_RATIO * lasting * np.abs(others).max(1))
        jump[1:] &= steps[:-1] != 0  # a sensor that stood still, which an effect of the catalogue does, then jumps
        for step in (np.flatnonzero(jump[AROUND_JUMP:-AROUND_JUMP]) + AROUND_JUMP).tolist():
            yield int(rows[step + 1]), name, f"{departs[step]:.3g} {variable_of(system, name).unit}"
