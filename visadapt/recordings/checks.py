"""Checks that a column's numbers fit its name: units, ranges, and columns that were exchanged.

These are heuristics that raise only where the numbers cannot be right; a recording that is merely unusual passes.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from itertools import combinations, product

import numpy as np
from numpy.typing import NDArray

from visadapt.recordings.attitude import check_attitude
from visadapt.recordings.axes import check_axes
from visadapt.recordings.clock import GAP_PERIODS, UNITS_S, Note, RawEpisode
from visadapt.recordings.episode import MisreadError, RecordingError
from visadapt.recordings.exchanged_columns import exchanged, exchanged_commands
from visadapt.recordings.physics import (
    DEGREE,
    are_degrees,
    correlation,
    is_half_a_turn_off,
    is_turned_round,
    rows_apart,
)
from visadapt.recordings.sensors import TURN, differences
from visadapt.systems import CartPole, RigidBody, System, Variable

LEAST_ROWS = 8
"""Rows of an episode below which its units are not judged."""
MOST_RATE_RANGES = 3.0
"""Rates above this multiple of the system's stated range are taken to be in another unit."""
COMMAND_ROUNDING = 1e-6
"""Share of its range by which a command may lie outside: single precision does not hold every bound."""
SMALL_COMMAND = 0.01
"""Share of its range within which a command that stays there is asked about."""
SURE_OF_DEGREES = 0.023
"""Half of the distance, in the logarithm, from the degrees in a radian to the seconds in a minute."""
IS_RATE_CORRELATION, NOT_RATE_CORRELATION = 0.8, 0.3
"""Correlation of a column with the change of another above which it is its rate, and below which it is not."""


def check_finite(raw: RawEpisode, actions: Sequence[Variable]) -> None:
    """Raises RecordingError that names the first cell that is not finite."""
    table = np.column_stack([raw.time, raw.state, raw.action])
    bad = ~np.isfinite(table)
    if bad.any():
        row, column = np.argwhere(bad)[0]
        name = ("time", *raw.measured, *(variable.name for variable in actions))[column]
        value = "empty or nan" if np.isnan(table[row, column]) else table[row, column]
        raise RecordingError(
            f"{raw.cell(int(row), name)} is {value}; a finite number is right (leave out rows without a measurement)"
        )


def check_commands(episodes: Sequence[RawEpisode], system: System, note: Note) -> None:
    """Check that commands lie in the system's range; notes those outside, and commands that never change.

    Raises:
        MisreadError: most commands lie outside, or one is more than twice as large as the range allows.
    """
    for column, variable in enumerate(system.actions):
        every = np.concatenate([raw.action[:, column] for raw in episodes])
        rounding = COMMAND_ROUNDING * (variable.high - variable.low)
        share = float(((every < variable.low - rounding) | (every > variable.high + rounding)).mean())
        if share == 0:
            if 0 < np.abs(every).max() < SMALL_COMMAND * max(-variable.low, variable.high):
                unit = "" if variable.unit == "1" else f" {variable.unit}"
                note(
                    f"{variable.name} stays within {np.abs(every).max():.3g}{unit}, of a range of "
                    f"[{variable.low:g}, {variable.high:g}]: is it in another unit?",
                    "the recording",
                )
            if np.ptp(every) == 0:
                note(
                    f"{variable.name} never changes: effects between command and motor (gain, delay, lag, dead zone) "
                    "cannot be identified, and a bias looks like a constant force",
                    "the recording",
                )
            continue
        scale = max(-variable.low, variable.high)
        middle = (variable.low + variable.high) / 2
        off = [np.abs(raw.action[:, column] - middle) for raw in episodes]
        raw, most = max(zip(episodes, off, strict=True), key=lambda pair: float(pair[1].max()))
        row = int(most.argmax())
        farthest = raw.action[row, column]
        right = f"within [{variable.low:g}, {variable.high:g}] is right"
        if share > 0.5 or abs(farthest) > 2 * scale:
            unit = "" if variable.unit == "1" else f" ({variable.unit})"
            hint = " (name a column in N 'force')" if not unit and hasattr(system, "max_force") else unit
            raise MisreadError(
                f"{raw.cell(row, variable.name)} is {farthest:g}, and {share:.0%} of the column lie outside; "
                f"{right}{hint}"
            )
        note(f"{share:.1%} of {variable.name} lie outside, {farthest:g} the farthest; {right}", "the recording")


def check_units(episodes: Sequence[RawEpisode], system: System) -> None:
    """Check the columns of a file's episodes, all of which have the same.

    Raises:
        MisreadError: angles are evidently in degrees or measured from another zero, lengths in cm or mm, signs
            wrong, or columns exchanged.
    """
    variables = {variable.name: variable for variable in system.states}
    judged = [raw for raw in episodes if len(raw.time) >= LEAST_ROWS]
    if not judged:
        return
    columns = judged[0].states
    angles = [name for name in columns if variables[name].unit == "rad"]
    for raw in judged:
        _check_jumps(raw, angles)
        _check_clock(raw, system)
    _check_exchanged(judged, variables, {name: rate for name in columns if (rate := system.rate_of(name))})
    for raw in judged:
        stride = rows_apart(raw, system)
        for name in columns:
            if (rate := system.rate_of(name)) is not None:
                _check_rate(raw, variables[name], variables[rate], stride)
        check_attitude(raw, system)
    _check_answers(judged, system, angles, [name for name in columns if variables[name].unit == "m"])


def _check_jumps(raw: RawEpisode, angles: Sequence[str]) -> None:
    """Raises MisreadError where an angle jumps by more than a turn from row to row."""
    for name in angles:
        steps = np.abs(np.diff(raw.states[name]))
        lasting = np.diff(raw.time)
        steps[lasting > GAP_PERIODS * np.median(lasting)] = 0.0  # a joint turns on while rows are missing
        row = int(steps.argmax()) + 1
        if steps.max() > 1.25 * TURN:
            raise MisreadError(
                f"{raw.cell(row, name)} jumps from {raw.states[name][row - 1]:g} to {raw.states[name][row]:g}; "
                f"radians are right (these look like degrees){raw.conversion(name, '*pi/180')}"
            )


def _check_answers(judged: Sequence[RawEpisode], system: System, angles: Sequence[str], lengths: Sequence[str]) -> None:
    """Raises MisreadError where states answer the commands as the source says only with another sign, zero, unit, or
    as each other; `angles` and `lengths` name the states in rad and in m."""
    whole = judged[0]
    check_axes(judged, system)
    if isinstance(system, RigidBody) and is_turned_round(judged, system, "z"):
        raise MisreadError(
            f"{whole.origin}: {whole.column('z')} accelerates against the thrust, as if it pointed down; up is right"
        )
    if is_half_a_turn_off(judged, system):
        zero = "0 upright" if isinstance(system, CartPole) else "the source's zero"
        raise MisreadError(
            f"{whole.origin}: {whole.column(angles[0])} answers the command as it should half a turn further; "
            f"{zero} is right{whole.conversion(angles[0], '-pi')}"
        )
    if are_degrees(judged, system):
        name, values = angles[0], np.concatenate([raw.states[angles[0]] for raw in judged])
        raise MisreadError(
            f"{whole.origin}: {whole.column(name)} goes from {values.min():.3g} to {values.max():.3g} and answers the "
            f"command as if in degrees; radians are right{whole.conversion(name, '*pi/180')}"
        )
    for name, other in product(lengths, angles):
        if exchanged(judged, system, name, other):
            raise MisreadError(
                f"{whole.origin}: {whole.column(name)} answers the command as {other} should, and "
                f"{whole.column(other)} as {name}: they are exchanged "
                "(or the command's sign is wrong: positive pushes towards +x)"
            )
    if not isinstance(system, RigidBody) and (commands := exchanged_commands(judged, system)):
        one, other = commands
        raise MisreadError(
            f"{whole.origin}: {whole.column(one)} moves what {other} should, and {whole.column(other)} what {one} "
            f"should: they are exchanged{whole.exchange(one, other)}"
        )


def _rates(time: NDArray[np.float64], values: NDArray[np.float64], angle: bool) -> NDArray[np.float64]:
    """Rates of change (T - 1,) between rows; jumps of an angle by a turn are removed."""
    return differences(values, angle) / np.diff(time)


def _check_clock(raw: RawEpisode, system: System) -> None:
    """Raises MisreadError where all positions change faster than their rates say, by the factor of a unit of time."""
    ratios = {}
    for name, values in raw.states.items():
        rate = raw.states.get(system.rate_of(name) or "")
        if rate is not None and rate.any():
            change = _rates(raw.time, values, system.states[system.index(name)].unit == "rad")
            ratios[name] = float(np.abs(change).mean() / np.abs(rate).mean())
    units = {system.states[system.index(name)].unit for name in ratios}
    in_degrees = [abs(math.log(max(ratio, 1e-9) * DEGREE)) < SURE_OF_DEGREES for ratio in ratios.values()]
    if len(ratios) > 1 and units == {"rad"} and all(in_degrees):
        raise MisreadError(
            f"{raw.origin}: columns {', '.join(ratios)} change {1 / DEGREE:.1f} times as fast as their rates say: they "
            f"are in degrees; radians are right{raw.conversion(next(iter(ratios)), '*pi/180')}"
        )
    for unit, seconds in UNITS_S.items():
        # With one ratio alone, the position may be in another unit instead.
        if len(ratios) > 1 and all(0.8 < ratio / seconds < 1.25 for ratio in ratios.values()):
            raise MisreadError(
                f"{raw.origin}: column 'time': by it {', '.join(ratios)} change {seconds:g} times as fast as their "
                f"rates say: the clock is in {unit}; seconds are right{raw.conversion('time', f'*{seconds:g}')}"
            )


def _check_rate(raw: RawEpisode, variable: Variable, rate: Variable, stride: int) -> None:
    """Compares a variable's change with its measured rate; and both, the change over `stride` rows, with the range
    that the system states."""
    values, measured = raw.states[variable.name], raw.states.get(rate.name)
    angle = variable.unit == "rad"
    unit, mistaken = ("radians", "degrees") if angle else ("metres", "centimetres or millimetres")
    right = f"{unit} are right (these look like {mistaken})"
    to_ours = "*pi/180" if angle else "/1000 (or /100)"
    change = _rates(raw.time, values, angle)
    coarse = np.convolve(change, np.ones(stride) / stride, "valid")
    fast = float(np.quantile(np.abs(coarse), 0.9))
    limit = MOST_RATE_RANGES * rate.largest
    beyond = angle and float(np.abs(values).max()) > TURN
    if fast > (rate.largest if beyond else limit):
        row = int(np.abs(values).argmax())
        raise MisreadError(
            f"{raw.cell(row, variable.name)} is {values[row]:g} {variable.unit}, and it changes by up to "
            f"{np.abs(coarse).max():.3g} {rate.unit}; {right}{raw.conversion(variable.name, to_ours)}; or is the clock "
            f"not in seconds, or the range of {rate.name} ({rate.low:g} to {rate.high:g}) too narrow?"
        )
    if measured is None:
        return
    if float(np.quantile(np.abs(measured), 0.9)) > limit:
        row = int(np.abs(measured).argmax())
        raise MisreadError(
            f"{raw.cell(row, rate.name)} is {measured[row]:g} {rate.unit}; {right}{raw.conversion(rate.name, to_ours)}"
        )
    between = 0.5 * (measured[1:] + measured[:-1])
    if _is_opposite(change, between):
        raise MisreadError(
            f"{raw.origin}: {raw.column(rate.name)} has the opposite sign of the change of {variable.name}"
            f"{raw.conversion(rate.name, '*-1')}"
        )
    if correlation(change, between) < IS_RATE_CORRELATION:
        return
    sizes = float(change.std()), float(between.std())
    for times, exact in ((1 / DEGREE, to_ours),) if angle else ((100.0, "/100"), (1000.0, "/1000")):
        for wrong, (large, small) in ((variable, sizes), (rate, sizes[::-1])):
            if 0.5 * times * small < large < 2 * times * small:
                raise MisreadError(
                    f"{raw.origin}: {raw.column(wrong.name)} is {times:.0f} times what the other says "
                    f"({variable.name} changes by {change.std():.3g} {rate.unit}, {rate.name} is {between.std():.3g} "
                    f"{rate.unit}, root mean square); {right}{raw.conversion(wrong.name, exact)}"
                )


def _is_opposite(change: NDArray[np.float64], rate: NDArray[np.float64]) -> bool:
    """Whether a rate is that of the change with the other sign."""
    return correlation(change, rate) < -IS_RATE_CORRELATION and 0.8 < float(change.std() / rate.std()) < 1.25


def _check_exchanged(
    episodes: Sequence[RawEpisode], variables: Mapping[str, Variable], rates: Mapping[str, str]
) -> None:
    """Raises MisreadError where two columns are evidently exchanged; `rates` are the rates of those that have one."""
    raw = episodes[0]

    def changes(name: str, angle: bool) -> NDArray[np.float64]:
        return np.concatenate([_rates(each.time, each.states[name], angle) for each in episodes])

    def later(name: str) -> NDArray[np.float64]:
        return np.concatenate([each.states[name][1:] for each in episodes])

    change = {name: changes(name, variables[name].unit == "rad") for name in rates}
    measured = {name: later(rate) for name, rate in rates.items() if rate in raw.states}
    for name, rate in measured.items():
        crossed = correlation(changes(rates[name], False), later(name))
        own = correlation(change[name], rate)
        if crossed > IS_RATE_CORRELATION and own < NOT_RATE_CORRELATION and not _is_opposite(change[name], rate):
            raise MisreadError(
                f"{raw.origin}: {raw.column(name)} and {raw.column(rates[name])} are evidently exchanged: "
                "the first is the second's rate of change"
            )
    for name, other in combinations(measured, 2):
        crossed = min(correlation(change[name], measured[other]), correlation(change[other], measured[name]))
        own = max(correlation(change[one], measured[one]) for one in (name, other))
        if crossed > IS_RATE_CORRELATION and own < NOT_RATE_CORRELATION:
            raise MisreadError(
                f"{raw.origin}: {raw.column(name)} and {raw.column(other)} are evidently exchanged: "
                f"{name} changes as {rates[other]} says, and {other} as {rates[name]} says"
            )
    for raw, name in product(episodes, rates):
        values = raw.states[name]
        steps = np.abs(np.diff(values))
        row = int(steps.argmax())
        wraps = abs(steps[row] - TURN) < 0.5 and np.abs(values).max() < 0.55 * TURN
        if variables[name].unit == "m" and wraps:
            raise MisreadError(
                f"{raw.cell(row + 1, name)} jumps by {steps[row]:.3g} m, like an angle that wraps; metres are right "
                "(are two columns exchanged?)"
            )
