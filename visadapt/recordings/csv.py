"""Recordings of states as CSV: columns `episode,time,<states>,<actions>`, SI units, one row per instant.

Without a column `episode` the file is one episode. Rates of change may be missing. Other common names, separators and
clocks are understood too; see `columns.py`, `table.py` and `clock.py`.
"""

from __future__ import annotations

import csv
import os
from collections.abc import Mapping, Sequence
from itertools import pairwise
from pathlib import Path

import numpy as np

from visadapt.recordings.clock import RawEpisode
from visadapt.recordings.columns import FORCE_NAME, match
from visadapt.recordings.episode import Episode, RecordingError
from visadapt.recordings.table import Table
from visadapt.storage.atomic_files import replacing
from visadapt.systems import System


def read_rows(path: Path, system: System, given: Mapping[str, str]) -> tuple[list[RawEpisode], tuple[str, ...], bool]:
    """The episodes of a file, the names of its states, and whether its command may be in N.

    `given` maps our names of columns to the file's, where these are not evident.

    Raises:
        RecordingError: the file or a column is missing, or a cell is not a number.
    """
    table = Table.open(path)
    found = match(path, table.header, system, given)
    order = list(found)
    numbers = table.numbers([found[name] for name in order])
    values = dict(zip(order, numbers.T, strict=True))
    measured = tuple(variable.name for variable in system.states if variable.name in found)
    actions = [variable.name for variable in system.actions]
    state = np.column_stack([values[name] for name in measured])
    action = np.column_stack([values[name] for name in actions])
    names = {name: table.header[found[name]] for name in found if table.header[found[name]].lower() != name}
    whole = RawEpisode(str(path), values["time"], action, state, table.place, names)
    force = any(table.header[found[name]].lower() == FORCE_NAME for name in actions)
    if "episode" not in found:
        return [whole], measured, force
    label = values["episode"]
    if np.isnan(label).any():
        raise RecordingError(f"{path}: {table.place(int(np.isnan(label).argmax()))}, column 'episode' is not a number")
    edges = [0, *(np.flatnonzero(label[1:] != label[:-1]) + 1), len(label)]
    parts = []
    for start, end in pairwise(edges):
        part = whole.part(int(start), int(end))
        parts.append(part.named(f"{path}, episode {label[start]:g}"))
    return parts, measured, force


def write_csv(
    path: str | os.PathLike[str], episodes: Sequence[Episode], states: Sequence[str], actions: Sequence[str]
) -> None:
    """Write episodes that hold states, atomically and with all digits, so that numbers are read back exactly.

    Args:
        path: of the file.
        episodes: of any lengths.
        states: the names of the columns of state.
        actions: the names of the columns of action.

    Raises:
        RecordingError: no episodes, one without states, or names that do not fit the columns.
        DiskFullError: the disk is full; a file that was at `path` before is unchanged.
    """
    if not episodes:
        raise RecordingError(f"{path}: a recording needs at least one episode")
    with replacing(path) as temporary, temporary.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(["episode", "time", *states, *actions])
        for number, episode in enumerate(episodes):
            if episode.state is None:
                raise RecordingError(f"{path}: episode {number} has no states; write frames as HDF5")
            if (episode.state.shape[1], episode.action.shape[1]) != (len(states), len(actions)):
                raise RecordingError(
                    f"{path}: episode {number} has {episode.state.shape[1]} columns of state and "
                    f"{episode.action.shape[1]} of action; there are names for {len(states)} and {len(actions)}"
                )
            for row in np.column_stack([episode.time, episode.state, episode.action]).tolist():
                writer.writerow([number, *row])
