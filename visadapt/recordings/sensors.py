"""Checks of sensors: dead rates are left out; dead or frozen positions and absurd values refused.

Values that cannot have been measured must not be diagnosed: the diagnosis would find an effect that imitates them.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import groupby

import numpy as np
import torch
from numpy.typing import NDArray

from visadapt.recordings.clock import Note, RawEpisode
from visadapt.recordings.episode import RecordingError
from visadapt.recordings.runs import runs
from visadapt.systems import System, Variable

TURN = 2 * np.pi

ABSURD_RANGES, ABSURD_TURNS = 100.0, 1e5
"""Multiples of the range that the system states, and turns of an angle, beyond which a reading is absurd."""
STILL_RANGES = 1e-9
"""Change, as a share of the range that the system states, up to which a column stands still."""
MOVING_RANGES = 1e-3
"""Rate of change, in ranges per s, by the source, above which a state must be seen to move."""
NOISE_RATIO, FEWEST_NOISY = 1.5, 30
"""Ratio of the variance of row-to-row changes to that of the values, above which a column is taken for white noise
(whose ratio is 2.0); and the fewest rows with which this is tested."""
DEAD = "a dead sensor"
"""What a note says of a velocity that never changes."""
FROZEN_ROWS = 20
"""Fewest equal readings in a row at which a position is compared with its measured rate."""


def differences(values: NDArray[np.float64], angle: bool) -> NDArray[np.float64]:
    """Changes (T - 1,) from row to row; jumps of an angle by a turn are removed."""
    steps = np.diff(values)
    if angle:
        steps = np.where(np.abs(np.abs(steps) - TURN) < 0.5 * np.pi, steps - np.sign(steps) * TURN, steps)
    return steps


def check_sensors(episodes: Sequence[RawEpisode], system: System, note: Note) -> list[RawEpisode]:
    """The episodes without measured rates that never change although the source says that they must.

    Raises:
        RecordingError: a reading is absurd, or a state that must change stands still.
    """
    for raw in episodes:
        for name, values in raw.states.items():
            variable, row = variable_of(system, name), int(np.abs(values).argmax())
            limit = ABSURD_RANGES * variable.largest
            if abs(values[row]) > (ABSURD_TURNS * TURN if variable.unit == "rad" else limit):
                raise RecordingError(
                    f"{raw.cell(row, name)} is {values[row]:g} {variable.unit}; "
                    f"within about [{variable.low:g}, {variable.high:g}] is right"
                )
        _check_not_frozen(raw, system)
        _note_noise(raw, system, note)
    if all(len(raw.time) == 1 for raw in episodes):
        return [*episodes]  # too short to say
    measured = episodes[0].measured
    if all(_is_still(raw.states[name], system, name) for raw in episodes for name in measured):
        raise RecordingError(
            f"{episodes[0].origin}: no state ever changes; a recording of something that moves is right"
        )
    rates = {system.rate_of(name) for name in measured}
    dead: set[str] = set()
    for _, of_file in groupby(episodes, key=lambda raw: raw.path):
        file = list(of_file)
        for name in measured:
            still = all(_is_still(raw.states[name], system, name) for raw in file)
            if name in dead or not still or not any(_must_move(raw, system, name) for raw in file):
                continue
            if name not in rates:
                raise RecordingError(
                    f"{file[0].cell(0, name)} is {file[0].states[name][0]:g}, as in every row, although what is "
                    "commanded and measured moves it: is the sensor dead, or does the machine stick? a recording in "
                    "which it moves is right"
                )
            note(f"{name} never changes although its position does: {DEAD}; it was left out", str(file[0].path))
            dead.add(name)
    return [raw.of([name for name in measured if name not in dead]) for raw in episodes]


def _is_still(values: NDArray[np.float64], system: System, name: str) -> bool:
    return float(np.ptp(values)) <= STILL_RANGES * variable_of(system, name).largest


def _must_move(raw: RawEpisode, system: System, name: str) -> bool:
    """Whether the source says that a state that is measured does not stand still."""
    columns = {
        name: np.unwrap(values) if variable_of(system, name).unit == "rad" else values
        for name, values in raw.states.items()
    }
    for position in raw.measured:
        if (rate := system.rate_of(position)) and len(raw.time) > 1:
            columns.setdefault(rate, np.gradient(columns[position], raw.time))
    state = np.column_stack([columns.get(one.name, np.zeros(len(raw.time))) for one in system.states])
    load = torch.zeros(len(state), len(system.loads), dtype=torch.float64)
    change = system.derivative(torch.from_numpy(state), torch.from_numpy(raw.action), load).numpy()
    moved = system.rate_of(name) or name
    largest = variable_of(system, moved).largest
    return float(np.abs(change[:, system.index(moved)]).max()) > MOVING_RANGES * largest


def variable_of(system: System, name: str) -> Variable:
    """The state of this name."""
    return system.states[system.index(name)]


def _check_not_frozen(raw: RawEpisode, system: System) -> None:
    """Raises RecordingError where a position stands still while its rate, which is measured, says that it moves."""
    for name, values in raw.states.items():
        variable = variable_of(system, name)
        rate = raw.states.get(system.rate_of(name) or "")
        # An angle that stands still in places is an effect of the catalogue.
        if rate is None or variable.unit == "rad":
            continue
        for start, end in runs(values):
            if end - start < FROZEN_ROWS:
                continue
            travelled = float(np.abs(rate[start : end - 1] @ np.diff(raw.time[start:end])))
            if travelled > 0.1 * variable.largest:
                raise RecordingError(
                    f"{raw.cell(start, name)} is {values[start]:g}, as in the {end - start - 1} rows after it, in "
                    f"which {system.rate_of(name)} says that it moves by {travelled:.3g} {variable.unit}: the sensor "
                    "was frozen; leave these rows out"
                )


def _note_noise(raw: RawEpisode, system: System, note: Note) -> None:
    """Notes where a position only jumps about although it must move: a broken sensor, or a machine that sticks."""
    for name, values in raw.states.items():
        if system.rate_of(name) is None or len(values) < FEWEST_NOISY or not np.ptp(values):
            continue
        values = np.unwrap(values) if variable_of(system, name).unit == "rad" else values
        if np.diff(values).var() > NOISE_RATIO * values.var() and _must_move(raw, system, name):
            note(
                f"{name} jumps about from row to row and does not move, although what is commanded and measured moves "
                "it: does its sensor follow the motion, or does the machine stick?",
                raw.origin,
            )
