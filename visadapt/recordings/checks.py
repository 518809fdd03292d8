"""Whether numbers can be what their column's name says: units, ranges, and columns that changed places.

These are heuristics, and each speaks up only where the numbers cannot be right: a recording that is merely strange is
for the diagnosis.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import combinations, product

import numpy as np
from numpy.typing import NDArray

from visadapt.recordings.clock import Note, Rows
from visadapt.recordings.episode import RecordingError
from visadapt.recordings.physics import DEGREE, are_degrees, changed_places
from visadapt.systems import System, Variable

TURN = 2 * math.pi

STRIDE = 0.05
"""s over which rates are taken from differences: over less, noise would outweigh motion."""
TOO_FAST = 3.0
"""Times the range that a system states for a rate at which the unit must be another."""
ALONG, NOT_ALONG = 0.8, 0.3
"""Correlations above which one column evidently is another's rate of change, and below which it evidently is not."""


def check_finite(rows: Rows, states: Sequence[str], actions: Sequence[str]) -> None:
    """Raises RecordingError at the first cell that is not finite."""
    table = np.column_stack([rows.time, rows.state, rows.action])
    bad = ~np.isfinite(table)
    if bad.any():
        row, column = np.argwhere(bad)[0]
        name = ("time", *states, *actions)[column]
        raise RecordingError(
            f"{rows.source}: {rows.place(int(row))}, {rows.column(name)} is {table[row, column]}; a finite number is "
            "right (a row without a measurement is better left out)"
        )


def check_commands(rows: Sequence[Rows], actions: Sequence[Variable], note: Note) -> None:
    """Commands lie in the range that the system states; few may be a little outside.

    Raises:
        RecordingError: most commands lie outside, or one lies outside twice over.
    """
    for column, variable in enumerate(actions):
        every = np.concatenate([one.action[:, column] for one in rows])
        share = float(((every < variable.low) | (every > variable.high)).mean())
        if share == 0:
            if np.ptp(every) == 0:
                note(
                    f"{variable.name} never changes: what acts between command and motor (gain, delay, lag, "
                    "dead zone) cannot be told from nothing, nor a bias from a constant force",
                    "the recording",
                )
            continue
        scale = max(-variable.low, variable.high)
        one = max(rows, key=lambda one: float(np.abs(one.action[:, column]).max()))
        row = int(np.abs(one.action[:, column]).argmax())
        largest = one.action[row, column]
        right = f"within [{variable.low:g}, {variable.high:g}] is right"
        if share > 0.5 or abs(largest) > 2 * scale:
            raise RecordingError(
                f"{one.source}: {one.place(row)}, {one.column(variable.name)} is {largest:g}, and {share:.0%} of the "
                f"column lie outside; {right} (name a column in N 'force')"
            )
        note(f"{share:.1%} of {variable.name} lie outside, up to {largest:g}; {right}", "the recording")


def check_units(rows: Rows, measured: Sequence[str], system: System) -> None:
    """Raises RecordingError where angles evidently are in degrees, lengths in mm, or columns changed places."""
    variables = {variable.name: variable for variable in system.states}
    if len(rows.time) < 8:
        return
    columns = dict(zip(measured, rows.state.T, strict=True))
    for name, values in columns.items():
        if variables[name].unit == "rad":
            _check_jumps(rows, name, values)
    _check_places(rows, columns, variables)
    for name, values in columns.items():
        rate_name = f"{name}_dot"
        if rate_name in variables:
            _check_rate(rows, variables[name], values, variables[rate_name], columns.get(rate_name))
    angles = [name for name in columns if variables[name].unit == "rad"]
    if are_degrees(rows, measured, system):
        name, values = angles[0], columns[angles[0]]
        raise RecordingError(
            f"{rows.source}: {rows.column(name)} goes from {values.min():.3g} to {values.max():.3g} and answers the "
            f"command as if in degrees; radians are right"
        )
    for name, other in product((name for name in columns if variables[name].unit == "m"), angles):
        if changed_places(rows, measured, system, name, other):
            raise RecordingError(
                f"{rows.source}: {rows.column(name)} answers the command as {other} should, and "
                f"{rows.column(other)} as {name}: they have changed places "
                f"(or the command's sign is wrong: positive pushes towards +x)"
            )


def rates(time: NDArray[np.float64], values: NDArray[np.float64], angle: bool) -> NDArray[np.float64]:
    """Rates of change (T - 1,) between rows; an angle may jump by a turn."""
    steps = np.diff(values)
    if angle:
        steps = np.where(np.abs(np.abs(steps) - TURN) < 0.5 * math.pi, steps - np.sign(steps) * TURN, steps)
    return steps / np.diff(time)


def _check_jumps(rows: Rows, name: str, values: NDArray[np.float64]) -> None:
    steps = np.abs(np.diff(values))
    if steps.max() > 1.25 * TURN:
        row = int(steps.argmax()) + 1
        raise RecordingError(
            f"{rows.source}: {rows.place(row)}, {rows.column(name)} jumps from {values[row - 1]:g} to {values[row]:g}; "
            "radians are right (these look like degrees)"
        )


def _check_rate(
    rows: Rows,
    variable: Variable,
    values: NDArray[np.float64],
    rate: Variable,
    given: NDArray[np.float64] | None,
) -> None:
    """Compares a variable's change, and its rate as given, with each other and with what the system can do."""
    angle = variable.unit == "rad"
    looks = "degrees" if angle else "centimetres or millimetres"
    right = "radians are right" if angle else "metres are right"
    change = rates(rows.time, values, angle)
    stride = max(1, round(STRIDE / float(np.median(np.diff(rows.time)))))
    coarse = np.convolve(change, np.ones(stride) / stride, "valid")
    fast = float(np.quantile(np.abs(coarse), 0.9))
    limit = TOO_FAST * rate.high
    beyond = angle and float(np.abs(values).max()) > TURN
    if fast > (rate.high if beyond else limit):
        row = int(np.abs(values).argmax())
        raise RecordingError(
            f"{rows.source}: {rows.place(row)}, {rows.column(variable.name)} is {values[row]:g} {variable.unit}, and "
            f"it changes by up to {np.abs(coarse).max():.3g} {rate.unit}; {right} (these look like {looks})"
        )
    if given is None:
        return
    if float(np.quantile(np.abs(given), 0.9)) > limit:
        row = int(np.abs(given).argmax())
        raise RecordingError(
            f"{rows.source}: {rows.place(row)}, {rows.column(rate.name)} is {given[row]:g} {rate.unit}; "
            f"{right} (these look like {looks})"
        )
    between = 0.5 * (given[1:] + given[:-1])
    if angle and _correlation(change, between) > ALONG:
        ratio = float(change.std() / between.std()) * DEGREE
        for wrong, factor in ((variable, ratio), (rate, DEGREE**2 / ratio)):
            if 0.5 < factor < 2:
                raise RecordingError(
                    f"{rows.source}: {rows.column(wrong.name)} is {1 / DEGREE:.0f} times what the other says "
                    f"({variable.name} changes by {change.std():.3g} {rate.unit}, {rate.name} is {between.std():.3g} "
                    f"{rate.unit}, root mean square); {right} (these look like {looks})"
                )


def _check_places(rows: Rows, columns: dict[str, NDArray[np.float64]], variables: dict[str, Variable]) -> None:
    """Raises RecordingError where two columns evidently changed places."""
    bases = [name for name in columns if f"{name}_dot" in variables]
    changes = {name: rates(rows.time, columns[name], variables[name].unit == "rad") for name in bases}
    given = {name: columns[f"{name}_dot"] for name in bases if f"{name}_dot" in columns}
    for name, rate in given.items():
        crossed = _correlation(rates(rows.time, rate, False), columns[name][1:])
        if crossed > ALONG and _correlation(changes[name], rate[1:]) < NOT_ALONG:
            raise RecordingError(
                f"{rows.source}: {rows.column(name)} and {rows.column(f'{name}_dot')} have evidently changed places: "
                "the first is the second's rate of change"
            )
    for name, other in combinations(given, 2):
        crossed = min(_correlation(changes[name], given[other][1:]), _correlation(changes[other], given[name][1:]))
        own = max(_correlation(changes[one], given[one][1:]) for one in (name, other))
        if crossed > ALONG and own < NOT_ALONG:
            raise RecordingError(
                f"{rows.source}: {rows.column(name)} and {rows.column(other)} have evidently changed places: "
                f"{name} changes as {other}_dot says, and {other} as {name}_dot says"
            )
    for name in bases:
        steps = np.abs(np.diff(columns[name]))
        row = int(steps.argmax())
        wraps = abs(steps[row] - TURN) < 0.5 and np.abs(columns[name]).max() < 0.55 * TURN
        if variables[name].unit == "m" and wraps:
            raise RecordingError(
                f"{rows.source}: {rows.place(row + 1)}, {rows.column(name)} jumps by {steps[row]:.3g} m, as an angle "
                "does that wraps; metres are right (did two columns change places?)"
            )


def _correlation(a: NDArray[np.float64], b: NDArray[np.float64]) -> float:
    if a.std() == 0 or b.std() == 0:
        return 0.0
    return float(np.corrcoef(a, b)[0, 1])
