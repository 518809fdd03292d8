"""One recording out of one file, several, or a folder, checked and ready to be diagnosed."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from visadapt.recordings import checks
from visadapt.recordings.clock import Rows, alike, check_forward, steadied
from visadapt.recordings.columns import needed
from visadapt.recordings.csv import read_rows
from visadapt.recordings.episode import Episode, RecordingError
from visadapt.recordings.hdf5 import read_names, read_recording
from visadapt.recordings.recording import Recording
from visadapt.systems import System

HORIZON = 0.5
"""s: a shorter episode says too little about predictions several steps ahead."""
ROWS_IN_HORIZON = 3
"""A horizon is at least this many rows long."""
HDF5_MAGIC = b"\x89HDF"
UPRIGHT = 1.0
"""rad from 0 up to which an angle counts as upright."""
SUFFIXES = (".csv", ".h5", ".hdf5")
"""Files of a folder that are read."""


class _Notes:
    """Warnings, those of one kind in one line."""

    def __init__(self) -> None:
        self.places: dict[str, list[str]] = {}

    def __call__(self, text: str, where: str) -> None:
        self.places.setdefault(text, []).append(where)

    def lines(self) -> tuple[str, ...]:
        """Each kind once, with its first place and the number of others."""
        return tuple(
            f"{where[0]}{f' and {len(where) - 1} more' if len(where) > 1 else ''}: {text}"
            for text, where in self.places.items()
        )


def load_recording(
    paths: str | os.PathLike[str] | Sequence[str | os.PathLike[str]],
    system: System,
    columns: Mapping[str, str] | None = None,
) -> Recording:
    """Read states and actions from CSV and HDF5 files.

    Names are matched as `columns.match` says, and clocks as `clock.py` says. Angles are unwrapped within an episode,
    so that upright is 0 there (where a pole turns over, the turn in which it is upright most). A command in N (a
    column `force` that exceeds 1) is divided by the system's `max_force`. What was changed or left out is in the
    recording's warnings.

    Args:
        paths: one or several: files, or folders whose CSV and HDF5 files are taken in the order of their names.
        system: the source, whose names and units the recording is brought to.
        columns: our name of a column to the file's, where they are not evident.

    Raises:
        RecordingError: a recording that cannot be used; one line that says which file, row and column, and what
            would be right.

    >>> import pathlib, tempfile, torch, visadapt as va
    >>> target = va.SyntheticTarget(va.constant_force(2.0))
    >>> policy = va.load_policy(va.shipped("cartpole_states"))
    >>> runs = va.run(target, policy, 2, 30, torch.Generator().manual_seed(0), exploration=0.3)
    >>> path = pathlib.Path(tempfile.mkdtemp()) / "run.h5"
    >>> va.write_recording(path, [run.episode for run in runs], ["x", "x_dot", "theta", "theta_dot"], ["command"])
    >>> run = va.load_recording(path, va.CartPole())
    >>> run.samples, round(run.period, 6)
    (60, 0.05)
    """
    note = _Notes()
    every: list[tuple[list[Rows], tuple[str, ...], bool]] = []
    files = _files([paths] if isinstance(paths, str | os.PathLike) else paths)
    for path in files:
        rows, measured, force = _read(path, system, columns or {})
        for one in rows:
            checks.check_finite(one, measured, [variable.name for variable in system.actions])
            check_forward(one)
        every.append((rows, measured, force))
    measured = _shared(files, [names for _, names, _ in every], system, note)
    # A column not all files have goes, whatever it is called in the others.
    whole = [
        replace(one, state=one.state[:, [names.index(name) for name in measured]])
        for rows, names, _ in every
        for one in rows
    ]
    forces = [force for rows, _, force in every for _ in rows]
    whole = _commands(whole, forces, system, note)
    checks.check_commands(whole, system.actions, note)
    for one in whole:
        checks.check_units(one, measured, system)
    parts = [part for one in whole for part in steadied(_unwrapped(one, measured, system), note)]
    parts, period = alike(_long_enough(parts, note), note)
    if period * ROWS_IN_HORIZON > HORIZON:
        raise RecordingError(
            f"{parts[0].source}: column 'time': rows are {period:.4g} s apart; at most "
            f"{HORIZON / ROWS_IN_HORIZON:.2g} s is right (is the clock in milliseconds?)"
        )
    return Recording(
        episodes=tuple(Episode(part.time, part.action, part.state) for part in parts),
        measured=measured,
        period=period,
        sources=tuple(part.source for part in parts),
        warnings=note.lines(),
    )


def _files(paths: Sequence[str | os.PathLike[str]]) -> list[Path]:
    files = []
    for path in map(Path, paths):
        if path.is_dir():
            found = sorted(file for file in path.iterdir() if file.suffix.lower() in SUFFIXES and file.is_file())
            if not found:
                raise RecordingError(f"{path}: a folder without recordings; files that end in .csv or .h5 are right")
            files += found
        elif path.exists():
            files.append(path)
        else:
            raise RecordingError(f"{path}: there is no such file or folder")
    if not files:
        raise RecordingError("no recording was given")
    return files


def _read(path: Path, system: System, given: Mapping[str, str]) -> tuple[list[Rows], tuple[str, ...], bool]:
    try:
        with path.open("rb") as file:
            is_hdf5 = file.read(len(HDF5_MAGIC)) == HDF5_MAGIC
    except OSError as error:
        raise RecordingError(f"{path}: cannot be read: {error.strerror}") from error
    return _read_hdf5(path, system) if is_hdf5 else read_rows(path, system, given)


def _read_hdf5(path: Path, system: System) -> tuple[list[Rows], tuple[str, ...], bool]:
    ours = tuple(variable.name for variable in system.states)
    actions = [variable.name for variable in system.actions]
    names, action_names = read_names(path)
    names, action_names = names or list(ours), action_names or actions
    rows = []
    for number, episode in enumerate(read_recording(path, frames=False)):
        source = f"{path}, episode {number}"
        assert episode.state is not None  # or reading without frames had failed
        if episode.state.shape[1] != len(names) or episode.action.shape[1] != len(action_names):
            raise RecordingError(
                f"{source}: {episode.state.shape[1]} columns of state and {episode.action.shape[1]} of action; "
                f"{', '.join(names)} and {', '.join(action_names)} are right"
            )
        for name in needed(system)[1:]:
            if name not in (*names, *action_names):
                raise RecordingError(f"{source}: {name!r} is missing; it has {', '.join((*names, *action_names))}")
        state = episode.state[:, [names.index(name) for name in ours if name in names]]
        action = episode.action[:, [action_names.index(name) for name in actions]]
        rows.append(Rows(source, episode.time.astype(float), action.astype(float), state.astype(float), _row))
    return rows, tuple(name for name in ours if name in names), False


def _row(row: int) -> str:
    return f"row {row + 1}"


def _shared(
    files: Sequence[Path], measured: Sequence[tuple[str, ...]], system: System, note: _Notes
) -> tuple[str, ...]:
    """The states that all files have."""
    shared = []
    for variable in system.states:
        without = [path for path, names in zip(files, measured, strict=True) if variable.name not in names]
        if not without:
            shared.append(variable.name)
        elif len(without) < len(files):
            note(f"has no column {variable.name!r}, so that of the other files is not used", str(without[0]))
    return tuple(shared)


def _commands(rows: list[Rows], forces: Sequence[bool], system: System, note: _Notes) -> list[Rows]:
    """Commands in N, which only a column of that name may hold, as commands in [-1, 1]."""
    newtons = [one.action for one, force in zip(rows, forces, strict=True) if force]
    limit = getattr(system, "max_force", None)
    if limit is None or not newtons or max(np.abs(values).max() for values in newtons) <= 1:
        return rows
    note(f"the column 'force' is taken to be in N and was divided by max_force, {limit:g} N", "the recording")
    return [replace(one, action=one.action / limit) if force else one for one, force in zip(rows, forces, strict=True)]


def _unwrapped(rows: Rows, measured: Sequence[str], system: System) -> Rows:
    state = rows.state.copy()
    for column, name in enumerate(measured):
        if system.states[system.index(name)].unit == "rad":
            angle = np.unwrap(state[:, column])
            turns = np.round(angle / (2 * np.pi))
            upright = np.abs(angle - 2 * np.pi * turns) < UPRIGHT
            state[:, column] = angle - 2 * np.pi * np.round(np.median(turns[upright] if upright.any() else turns))
    return replace(rows, state=state)


def _long_enough(parts: Sequence[Rows], note: _Notes) -> list[Rows]:
    kept = [part for part in parts if part.time[-1] - part.time[0] >= HORIZON - 1e-6 * HORIZON]
    if not kept:
        longest = max(parts, key=lambda part: part.time[-1] - part.time[0])
        raise RecordingError(
            f"{longest.source}: too short: {len(longest.time)} rows, {longest.time[-1] - longest.time[0]:.3g} s; "
            f"an uninterrupted run of at least {HORIZON:g} s is right"
        )
    for part in parts:
        if part.time[-1] - part.time[0] < HORIZON - 1e-6 * HORIZON:
            note(f"shorter than {HORIZON:g} s, so it is left out", f"{part.source}, from {part.place(0)} on")
    return kept
