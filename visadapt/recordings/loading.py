"""Reads a recording from files and folders, checks it, and brings it to the source's names and units."""

from __future__ import annotations

import filecmp
import os
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from itertools import groupby
from pathlib import Path

import numpy as np

from visadapt.progress import Report, staged
from visadapt.recordings.checks import check_commands, check_finite, check_units
from visadapt.recordings.clock import (
    Note,
    RawEpisode,
    check_forward,
    check_steps,
    uninterrupted,
    with_common_period,
    without_bursts,
)
from visadapt.recordings.columns import convert, match
from visadapt.recordings.csv import read_rows
from visadapt.recordings.episode import Episode, Recording, RecordingError
from visadapt.recordings.faulty_readings import jumps, without_outliers
from visadapt.recordings.ground import in_flight
from visadapt.recordings.hdf5 import read_names, read_stretches
from visadapt.recordings.logs import read_log
from visadapt.recordings.physics import is_in_newtons, same_after_a_turn
from visadapt.recordings.sensors import TURN, check_sensors
from visadapt.recordings.slow_sensors import without_held_readings
from visadapt.recordings.thinning import thinned
from visadapt.recordings.topics import reader
from visadapt.systems import System

MOST_BYTES = 2**28
"""Most bytes of the values of all files: 4.8 million rows of a cart-pole. The checks make a few copies of them."""
SUFFIXES = (".csv", ".h5", ".hdf5", ".bag", ".mcap", ".db3", ".ulg")
"""Suffixes of the files that are read from a folder."""
TABLES = (".txt", ".tsv", ".dat")
"""Suffixes of files in a folder that may be tables, and are not read with the folder."""
VIDEOS = (".mp4", ".avi", ".mov", ".mkv", ".webm")
"""Suffixes of videos, which are told what they lack."""
UPRIGHT_RAD = 1.0
"""rad from 0 up to which an angle counts as upright when it is unwrapped."""


@np.errstate(over="ignore", invalid="ignore")  # by absurd readings, which are refused
def load_recording(
    paths: str | os.PathLike[str] | Sequence[str | os.PathLike[str]],
    system: System,
    columns: Mapping[str, str] | None = None,
    frames: bool = False,
    progress: Report | None = None,
) -> Recording:
    """Read states and actions from CSV and HDF5 files and logs, or frames and actions from HDF5 files.

    Names are matched by `columns.py`; those of logs, bags of ROS and ULog, are TOPIC.FIELD (`logs.py`). Clocks are
    checked by `clock.py`; rows of an unsteady one keep their stamps. An angle is unwrapped within an episode if the
    physics are the same after a whole turn. Upright is then 0; if the pole turns over, in the turn in which it is
    upright most often. A command in N (a column `force` that exceeds 1) is divided by the system's `max_force`. Where
    files are too long for memory, stretches of rows are left out (`thinning.py`). The recording's warnings say what was
    changed or left out.

    Args:
        paths: one or several: files, bags of ROS 2, or folders whose recordings are taken in the order of their names.
        system: the source, which defines names and units.
        columns: our names of columns to the file's, where these are not evident, perhaps with a conversion to our units
            behind them, as in "encoder*2*pi/4096"; "" for a state that was not measured.
        frames: whether to read frames in place of states.
        progress: called with (stage, MB done, MB in all, nan).

    Raises:
        RecordingError: the recording cannot be used; one line that says which file, row and column, and what would be
            right.

    >>> import pathlib, tempfile, torch, visadapt as va
    >>> policy, path = va.load_policy(va.shipped("cartpole_states")), pathlib.Path(tempfile.mkdtemp()) / "run.h5"
    >>> runs = va.run(va.SyntheticTarget(), policy, 2, 30, torch.Generator().manual_seed(0), exploration=0.3)
    >>> va.write_recording(path, [run.episode for run in runs], ["x", "x_dot", "theta", "theta_dot"], ["command"])
    >>> run = va.load_recording(path, va.CartPole())
    >>> run.samples, round(run.period, 6)
    (60, 0.05)
    """
    notes: dict[str, list[str]] = {}

    def note(text: str, where: str) -> None:
        notes.setdefault(text, []).append(where)

    columns = columns or {}
    if unmeasured := [name for name, theirs in columns.items() if not theirs]:
        note("not measured: estimated with the simulator from what was measured", ", ".join(unmeasured))
    whole: list[RawEpisode] = []
    files = _files([paths] if isinstance(paths, str | os.PathLike) else paths, note)
    sizes = [path.stat().st_size for path in files]
    for path, size in zip(files, sizes, strict=True):
        most = MOST_BYTES * size / max(1, sum(sizes))
        episodes = _read(path, system, columns, frames, note, most, progress)
        for raw in episodes:
            check_finite(raw, system.actions)
            check_forward(raw)
        episodes = [without_bursts(raw, note) for raw in episodes]
        check_steps(episodes, system)
        whole += [without_outliers(raw, system, note) for raw in without_held_readings(episodes, system, note)]
    whole = [in_flight(raw, system, note) for raw in _commands(_shared(whole, system, note), system, note)]
    check_commands(whole, system, note)
    if not frames:
        for _, of_file in groupby(whole, lambda raw: raw.path):
            check_units(list(of_file), system)
        whole = check_sensors(whole, system, note)
    turning = [state.name for state in system.states if state.unit == "rad" and same_after_a_turn(system, state.name)]
    whole = [_unwrapped(raw, turning) for raw in whole]
    parts = [part for raw in whole for part in uninterrupted(raw, note, () if frames else jumps(raw, system, note))]
    parts, period = with_common_period(_long_enough(parts, system.prediction_time, note), note)
    all_read = all(part.usable is None for part in parts)
    return Recording(
        episodes=tuple(Episode(part.time, part.action, None if frames else part.state, part.frame) for part in parts),
        measured=whole[0].measured,
        period=period,
        sources=tuple(part.origin for part in parts),
        usable=()
        if all_read
        else tuple(np.ones(part.state.shape, bool) if part.usable is None else part.usable for part in parts),
        warnings=tuple(
            f"{where[0]}{f' and {len(where) - 1} more' if len(where) > 1 else ''}: {text}"
            for text, where in notes.items()
        ),
        command_period=_command_period(parts),
    )


def _command_period(parts: Sequence[RawEpisode]) -> float | None:
    """The median over the episodes; None where one has commands without stamps of their own."""
    periods = [part.command_period for part in parts if part.command_period is not None]
    return float(np.median(periods)) if len(periods) == len(parts) else None


def _files(paths: Sequence[str | os.PathLike[str]], note: Note) -> list[Path]:
    """The files that are given, each once; of a folder, the recordings that are not hidden."""
    files: dict[Path, Path] = {}  # by their resolved paths
    of_size: dict[int, list[Path]] = {}
    for path in map(Path, paths):
        found = [path]
        if path.is_dir() and reader(path) is None:
            inside = sorted(file for file in path.iterdir() if not file.name.startswith("."))
            found = [each for each in inside if _is_recording(each)]
            for other in inside:
                if found and other not in found and (other.is_dir() or other.suffix.lower() in TABLES):
                    note("is not read: name it beside the folder", str(other))
            if not found:
                right = ", ".join(SUFFIXES)
                raise RecordingError(f"{path}: a folder without recordings; files that end in {right} are right")
        elif not path.exists():
            raise RecordingError(f"{path}: there is no such file or folder")
        elif not path.is_file() and not path.is_dir():
            raise RecordingError(f"{path}: no regular file; a CSV or HDF5 file is right")
        for file in found:
            resolved, as_large = file.resolve(), of_size.setdefault(file.stat().st_size, [])
            if twin := _the_same(file, resolved, files) or next((o for o in as_large if _same_content(file, o)), None):
                note(f"holds the same as {twin}, so it is not used twice", str(file))
            else:
                files[resolved] = file
                as_large.append(file)
    if not files:
        raise RecordingError("no recording was given")
    return [*files.values()]


def refuse_video(path: str | os.PathLike[str], missing: str) -> None:
    """Raise RecordingError of a video, which lacks what is `missing`."""
    if Path(path).suffix.lower() in VIDEOS:
        raise RecordingError(
            f"{path}: a video, which holds no {missing}: an HDF5 file with its frames and the {missing}, as "
            "visadapt.write_recording writes it, is right"
        )


def _is_recording(path: Path) -> bool:
    """Whether something in a folder is a recording: a file, or the folder of a bag of ROS 2."""
    return reader(path) is not None if path.is_dir() else path.is_file() and path.suffix.lower() in SUFFIXES


def _the_same(file: Path, resolved: Path, files: Mapping[Path, Path]) -> Path | None:
    """Of `files`, by their resolved paths, the one that is at `resolved`, or a bag that holds it or that it holds."""
    around = [files[each] for each in (resolved, *resolved.parents) if each in files]
    inside = [other for each, other in files.items() if resolved in each.parents] if file.is_dir() else []
    return next(iter((*around, *inside)), None)


def _same_content(one: Path, other: Path) -> bool:
    with suppress(OSError):
        return filecmp.cmp(one, other, shallow=False)
    return False


def _read(
    path: Path, system: System, given: Mapping[str, str], frames: bool, note: Note, most: float, report: Report | None
) -> list[RawEpisode]:
    if (log := reader(path)) is not None:
        if frames:
            raise RecordingError(f"{path}: frames are read from HDF5 alone, as visadapt.write_recording writes them")
        return [read_log(path, log, system, given, note)]
    try:
        with path.open("rb") as file:
            is_hdf5 = file.read(4) == b"\x89HDF"
    except OSError as error:
        raise RecordingError(f"{path}: cannot be read: {error.strerror}") from error
    refuse_video(path, "commands")
    if frames and not is_hdf5:
        raise RecordingError(
            f"{path}: no HDF5 file; times, commands and frames as visadapt.write_recording writes them are right"
        )
    if is_hdf5:
        return _read_hdf5(path, system, given, frames, note, most)
    return read_rows(path, system, given, note, most, staged(report, f"reading {path.name} (MB)"))


def _read_hdf5(
    path: Path, system: System, given: Mapping[str, str], frames: bool, note: Note, most: float
) -> list[RawEpisode]:
    state_names, action_names = read_names(path, system)
    if frames:
        state_names = []
    header = ("time", *state_names, *action_names)
    found = match(path, header, system, given, states=not frames)
    measured = tuple(variable.name for variable in system.states if variable.name in found)
    names = {name: header[index] for name, index in found.items()}
    raw = []
    episodes, total = read_stretches(path, frames, most)
    if (used := sum(len(episode.time) for episode in episodes.values())) < total:
        note(thinned(used, total), str(path))
    for number, episode in episodes.items():
        where = f"{path}, episode {number}"
        if frames and episode.frame is None:
            raise RecordingError(f"{where} has no frames; leave out --renderer to diagnose its states")
        states = np.zeros((len(episode.time), 0)) if frames else episode.state
        assert states is not None  # without states, read_recording raises
        if (widths := (states.shape[1], episode.action.shape[1])) != (len(state_names), len(action_names)):
            raise RecordingError(
                f"{where}: {widths[0]} columns of state and {widths[1]} of action; "
                f"{', '.join(state_names)} and {', '.join(action_names)} are right"
            )
        table = np.column_stack([episode.time, states, episode.action]).astype(float)
        values = convert({name: table[:, index] for name, index in found.items()}, given, header)
        action = np.column_stack([values[variable.name] for variable in system.actions])
        state = np.column_stack([values[name] for name in measured]) if measured else np.zeros((len(table), 0))
        seen = episode.frame if frames else None
        raw.append(
            RawEpisode(
                path, values["time"], action, state, measured, names=names, given=given, number=number, frame=seen
            )
        )
    return raw


def _shared(episodes: Sequence[RawEpisode], system: System, note: Note) -> list[RawEpisode]:
    """The episodes with only those states that all of them have."""
    shared = []
    for variable in system.states:
        without = [raw.path for raw in episodes if variable.name not in raw.measured]
        if not without:
            shared.append(variable.name)
        elif len(without) < len(episodes):
            note(f"has no column {variable.name!r}, so that of the other files is not used", str(without[0]))
    return [raw.of(shared) for raw in episodes]


def _commands(episodes: list[RawEpisode], system: System, note: Note) -> list[RawEpisode]:
    """The episodes with commands in [-1, 1]: a command column 'force' may be in N."""
    forces = [
        any(raw.names.get(one.name, "").lower().split(".")[-1] == "force" for one in system.actions if one.unit == "1")
        for raw in episodes
    ]
    limit = getattr(system, "max_force", None)
    if limit is None or not any(forces):
        return episodes
    largest = max(np.abs(raw.action).max() for raw, force in zip(episodes, forces, strict=True) if force)
    if largest <= 1 and not is_in_newtons(episodes, system, limit):
        within = "the column 'force' stays within [-1, 1] and is taken to be a share of max_force"
        note(f"{within}; a force in N is to be divided by it, {limit:g} N", "the recording")
        return episodes
    note(f"the column 'force' is taken to be in N and was divided by max_force, {limit:g} N", "the recording")
    return [
        replace(raw, action=raw.action / limit) if force else raw for raw, force in zip(episodes, forces, strict=True)
    ]


def _unwrapped(raw: RawEpisode, turning: Sequence[str]) -> RawEpisode:
    """The episode with the angles `turning` unwrapped, in the turn in which they are upright most often."""
    state = raw.state.copy()
    for column, name in enumerate(raw.measured):
        if name in turning:
            angle = np.unwrap(state[:, column])
            turn = np.round(angle / TURN)
            upright = np.abs(angle - TURN * turn) < UPRIGHT_RAD
            state[:, column] = angle - TURN * np.round(np.median(turn[upright] if upright.any() else turn))
    return replace(raw, state=state)


def _long_enough(parts: Sequence[RawEpisode], shortest: float, note: Note) -> list[RawEpisode]:
    """The parts of at least `shortest` s, the time of a prediction; notes the others."""
    least = shortest * (1 - 1e-6)
    durations = [part.time[-1] - part.time[0] for part in parts]
    longest = parts[int(np.argmax(durations))]
    if max(durations) < least:
        raise RecordingError(
            f"{longest.origin}: too short: {len(longest.time)} rows, {max(durations):.4g} s; an uninterrupted run of "
            f"at least {shortest:g} s, with a clock in seconds, is right: so far predictions reach"
        )
    for part, duration in zip(parts, durations, strict=True):
        if duration < least:
            note(f"shorter than {shortest:g} s, so it is left out", f"{part.origin}, from {part.place(0)} on")
    return [part for part, duration in zip(parts, durations, strict=True) if duration >= least]
