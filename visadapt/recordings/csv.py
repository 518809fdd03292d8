"""Recordings of states as CSV: columns `episode,time,<states>,<actions>`, SI units, one row per instant.

Without a column `episode` the file is one episode. Rates of change may be missing. Other common names, separators and
clocks are understood too; see `table.py` and `clock.py`.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np

from visadapt.recordings.clock import RawEpisode
from visadapt.recordings.episode import RecordingError
from visadapt.recordings.table import Table
from visadapt.systems import System

OTHER_NAMES: dict[str, dict[str, tuple[str, ...]]] = {
    "cartpole": {
        "x": ("position", "cart_position", "pos", "s"),
        "x_dot": ("positionD", "velocity", "cart_velocity"),
        "theta": ("angle", "pole_angle"),
        "theta_dot": ("angleD", "angular_velocity"),
        "command": ("action", "u", "Q", "control", "input", "force"),
    }
}
"""Other common names of a system's variables, in any case."""


def read_rows(path: Path, system: System, given: Mapping[str, str]) -> list[RawEpisode]:
    """The episodes of a file; `given` maps our names of columns to the file's, where these are not evident.

    Raises:
        RecordingError: the file or a column is missing, or a cell is not a number.
    """
    table = Table.open(path)
    found = _match(path, table.header, system, given)
    values = dict(zip(found, table.numbers(list(found.values())).T, strict=True))
    measured = tuple(variable.name for variable in system.states if variable.name in found)
    state = np.column_stack([values[name] for name in measured])
    action = np.column_stack([values[variable.name] for variable in system.actions])
    names = {name: table.header[index] for name, index in found.items()}
    whole = RawEpisode(path, values["time"], action, state, measured, table.place, names)
    if "episode" not in found:
        return [whole]
    label = values["episode"]
    if np.isnan(label).any():
        raise RecordingError(f"{path}: {table.place(int(np.isnan(label).argmax()))}, column 'episode' is not a number")
    edges = [0, *(np.flatnonzero(label[1:] != label[:-1]) + 1).tolist(), len(label)]
    return [replace(whole.part(start, end), number=float(label[start])) for start, end in pairwise(edges)]


def needed(system: System) -> tuple[str, ...]:
    """Columns that a recording must have: time, states and actions; rates of change (`_dot`) may be missing."""
    names = [variable.name for variable in system.states]
    states = [name for name in names if not name.endswith("_dot") or name.removesuffix("_dot") not in names]
    return ("time", *states, *(variable.name for variable in system.actions))


def _match(path: Path, header: tuple[str, ...], system: System, given: Mapping[str, str]) -> dict[str, int]:
    """The index of each of our variables in a file's header; `given` maps our names to the file's.

    Raises:
        RecordingError: a needed column is missing, several columns could be one variable, or `given` names a variable
            or a column that does not exist.
    """
    others = {"time": ("t", "timestamp"), **OTHER_NAMES.get(system.name, {})}
    ours = ["episode", "time", *(variable.name for variable in (*system.states, *system.actions))]
    for name in given:
        if name not in ours:
            raise RecordingError(f"--columns {name}=...: {system.name} has no {name!r}; it has {', '.join(ours)}")
    found: dict[str, int] = {}
    for name in ours:
        candidates: list[int] = []
        for names in ([given[name]],) if name in given else ([name], others.get(name, ())):
            lower = [wanted.lower() for wanted in names]
            candidates = candidates or [index for index, there in enumerate(header) if there.lower() in lower]
        if len(candidates) > 1:
            which = ", ".join(repr(header[index]) for index in candidates)
            raise RecordingError(f"{path}: the columns {which} could each be {name}; say which: --columns {name}=...")
        if candidates:
            found[name] = candidates[0]
        elif name in given:
            raise RecordingError(f"{path}: has no column {given[name]!r} for {name}; it has {', '.join(header)}")
        elif name in needed(system):
            raise RecordingError(
                f"{path}: column {name!r} is missing; it has {', '.join(header)}; "
                f"if one of them is {name}: --columns {name}=..."
            )
    return found
