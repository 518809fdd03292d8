"""Recordings as HDF5: one group for each episode, with the datasets time, action, state, frame and task_state.

    /                       attributes format, version, state_names (optional), action_names (optional)
    /episode_00000/time     (T,) s, floating point
    /episode_00000/action   (T, n_action), floating point
    /episode_00000/state    (T, n_state), floating point; state, frame, or both
    /episode_00000/frame    (T, H, W) uint8, gzip
    /episode_00000/task_state  (T, n_task_state) floating point, where the target has a task

All datasets carry a checksum (Fletcher-32), so that damaged bytes are reported and not read as data.
"""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from visadapt.recordings.episode import Episode, RecordingError
from visadapt.storage.atomic_files import replacing
from visadapt.systems import System

FORMAT, VERSION = "visadapt recording", 1
FRAMES_IN_CHUNK = 16
"""Frames that are compressed together, so that reading one decompresses at most this many."""


def write_recording(
    path: str | os.PathLike[str],
    episodes: Sequence[Episode],
    state_names: Sequence[str] | None = None,
    action_names: Sequence[str] | None = None,
) -> None:
    """Write episodes of any lengths, atomically.

    Raises:
        RecordingError: no episodes, episodes of different widths or contents, or names that do not fit the columns.
        DiskFullError: the disk is full; a file that was at `path` before is unchanged.

    >>> import pathlib, tempfile, torch, visadapt as va
    >>> policy, path = va.load_policy(va.shipped("cartpole_states")), pathlib.Path(tempfile.mkdtemp()) / "run.h5"
    >>> runs = va.run(va.SyntheticTarget(), policy, 2, 30, torch.Generator().manual_seed(0), exploration=0.3)
    >>> va.write_recording(path, [run.episode for run in runs], ["x", "x_dot", "theta", "theta_dot"], ["command"])
    >>> len(va.read_recording(path))
    2
    """
    path = Path(path)
    _check_alike(path, episodes)
    # In memory first, since HDF5 aborts the process when the disk fills up. The episodes are in memory already, and
    # uncompressed.
    with h5py.File("recording", "w", driver="core", backing_store=False) as file:
        file.attrs["format"] = FORMAT
        file.attrs["version"] = VERSION
        for kind, names in (("state", state_names), ("action", action_names)):
            if names is not None:
                columns = getattr(episodes[0], kind)
                width = 0 if columns is None else columns.shape[1]
                if len(names) != width:
                    raise RecordingError(f"{path}: {len(names)} names for {width} columns of {kind}")
                file.attrs[f"{kind}_names"] = list(names)
        for number, episode in enumerate(episodes):
            group = file.create_group(_group_name(number))
            for name in ("time", "action", "state", "task_state"):
                if (values := getattr(episode, name)) is not None:
                    group.create_dataset(name, data=values, fletcher32=True)
            if episode.frame is not None:
                rows, height, width = episode.frame.shape
                chunks = (min(rows, FRAMES_IN_CHUNK), height, width)
                group.create_dataset("frame", data=episode.frame, chunks=chunks, compression="gzip", fletcher32=True)
        file.flush()
        content = file.id.get_file_image()
    with replacing(path) as temporary:
        temporary.write_bytes(content)


def read_names(path: str | os.PathLike[str], system: System | type[System]) -> tuple[list[str], list[str]]:
    """Names of the columns of state and of action, the system's if the file has none; raises like `read_recording`."""
    with _opened(Path(path)) as file:
        state = file.attrs.get("state_names", [variable.name for variable in system.states])
        action = file.attrs.get("action_names", [variable.name for variable in system.actions])
    return list(state), list(action)


def read_recording(path: str | os.PathLike[str], frames: bool = True) -> list[Episode]:
    """All episodes of a file that `write_recording` wrote, in order; without their frames if `frames` is False.

    Raises:
        RecordingError: the file is missing, incomplete, or of another format or version, or its rows are not valid
            episodes; the message is one line that says which file and episode, and what would be right.

    >>> import numpy as np, pathlib, tempfile, visadapt as va
    >>> episode = va.Episode(time=0.05 * np.arange(3), action=np.zeros((3, 1)), state=np.zeros((3, 4)))
    >>> path = pathlib.Path(tempfile.mkdtemp()) / "run.h5"
    >>> va.write_recording(path, [episode])
    >>> va.read_recording(path)[0].samples
    2
    """
    path = Path(path)
    with _opened(path) as file:
        episodes = [_read_episode(path, file, number, frames) for number in range(len(file))]
    _check_alike(path, episodes)
    return episodes


@contextmanager
def _opened(path: Path) -> Iterator[h5py.File]:
    if not path.is_file():
        raise RecordingError(f"{path}: there is no such file")
    try:
        with h5py.File(path, "r") as file:
            if file.attrs.get("format") != FORMAT:
                raise RecordingError(f"{path}: an HDF5 file, but its attribute 'format' is not {FORMAT!r}")
            if (version := file.attrs.get("version")) != VERSION:
                raise RecordingError(f"{path}: version {version} of the format; this visadapt reads version {VERSION}")
            yield file
    except OSError as error:
        # HDF5's own message describes its internals and may be several lines long.
        raise RecordingError(
            f"{path}: not a readable HDF5 file, or cut short; a recording written by visadapt is right"
        ) from error


def _group_name(number: int) -> str:
    return f"episode_{number:05d}"


def _read_episode(path: Path, file: h5py.File, number: int, frames: bool) -> Episode:
    where = f"{path}: {_group_name(number)}"
    group = file.get(_group_name(number))
    if not isinstance(group, h5py.Group):
        raise RecordingError(f"{where} is missing; {len(file)} groups, numbered from 0, were expected")
    for name in ("time", "action"):
        if name not in group:
            raise RecordingError(f"{where} has no dataset {name!r}")
    if "state" not in group and not frames:
        raise RecordingError(f"{where} holds frames alone; states are needed (or a renderer, by --renderer)")
    arrays: dict[str, NDArray[Any]] = {}
    for name in ("time", "action", "state", "task_state", *(["frame"] if frames else [])):
        try:
            if name in group:
                arrays[name] = np.asarray(group[name][()])
        except (OSError, TypeError) as error:  # a group has no values
            raise RecordingError(f"{where}: {name!r} is damaged, or no dataset, and cannot be read") from error
    try:
        return Episode(**arrays)
    except ValueError as error:
        raise RecordingError(f"{where}: {error}") from error


def _check_alike(path: Path, episodes: Sequence[Episode]) -> None:
    """Raises RecordingError unless all episodes have the same datasets, of the same widths."""
    if not episodes:
        raise RecordingError(f"{path}: a recording needs at least one episode")
    for name in ("action", "state", "frame", "task_state"):
        every = [getattr(episode, name) for episode in episodes]
        first, *others = (None if values is None else values.shape[1:] for values in every)
        for number, shape in enumerate(others, 1):
            if shape != first:
                raise RecordingError(
                    f"{path}: {_group_name(number)} has {name} rows of shape {shape}, the first episode of {first}"
                )
