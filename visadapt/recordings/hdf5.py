"""Recordings as HDF5: one group for each episode, with the datasets time, action, state, frame and task_state.

    /                       attributes format, version, state_names (optional), action_names (optional)
    /episode_00000/time     (T,) s, floating point
    /episode_00000/action   (T, n_action), floating point
    /episode_00000/state    (T, n_state), floating point; state, frame, or both
    /episode_00000/frame    (T, H, W) uint8, gzip
    /episode_00000/task_state  (T, n_task_state) floating point, where the target has a task

All datasets carry a checksum (Fletcher-32) and, since version 2, an attribute `sha256`, the hash of their type, shape,
values and column names, so that damage to any of these is reported and not read as data. Files that other programs
write or edit may be of version 1, without the hash. Links, and values stored in other files, are refused.
"""

from __future__ import annotations

import hashlib
import math
import os
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from itertools import accumulate, pairwise
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from visadapt.recordings.episode import Episode, RecordingError
from visadapt.recordings.guarded import tried
from visadapt.recordings.thinning import kept
from visadapt.storage.atomic_files import replacing
from visadapt.systems import System

FORMAT, VERSION = "visadapt recording", 2
READABLE = (1, VERSION)
COMPRESSION = 1100
"""Highest ratio of bytes to stored bytes that compression reaches; a dataset that claims more is damaged."""
DATASETS = ("time", "action", "state", "task_state", "frame")
PART_BYTES = 2**24
"""Bytes of a dataset that are read at once where not all of its rows are used."""
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
                if len({*names}) < width or not all(isinstance(name, str) for name in names):
                    called = f"the columns of {kind} are called {', '.join(map(str, names))}"
                    raise RecordingError(f"{path}: {called}; names that differ are right")
                if width:
                    file.attrs[f"{kind}_names"] = list(names)
        for number, episode in enumerate(episodes):
            group = file.create_group(_group_name(number))
            present = {name: values for name in DATASETS if (values := getattr(episode, name)) is not None}
            for name, values in present.items():
                packed = {}
                if name == "frame":
                    packed = {"chunks": (min(len(values), FRAMES_IN_CHUNK), *values.shape[1:]), "compression": "gzip"}
                dataset = group.create_dataset(name, data=values, fletcher32=True, **packed)
                about = _about(file, name, values, len(episodes), [*present])
                dataset.attrs["sha256"] = hashlib.sha256(about.encode() + values.tobytes()).hexdigest()
        file.flush()
        content = file.id.get_file_image()
    with replacing(path) as temporary:
        temporary.write_bytes(content)


def read_names(path: str | os.PathLike[str], system: System | type[System]) -> tuple[list[str], list[str]]:
    """Names of the columns of state and of action, the system's if the file has none; raises like `read_recording`."""

    def read(_: Callable[[int], None]) -> tuple[list[str], list[str]]:
        with _opened(Path(path)) as file:
            return (
                _names(file, "state") or [variable.name for variable in system.states],
                _names(file, "action") or [variable.name for variable in system.actions],
            )

    return tried(path, read)


def read_recording(path: str | os.PathLike[str]) -> list[Episode]:
    """All episodes of a file that `write_recording` wrote, in order.

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
    return [*read_stretches(path)[0].values()]


def read_stretches(
    path: str | os.PathLike[str], frames: bool = True, most_bytes: float = math.inf
) -> tuple[dict[int, Episode], int]:
    """As `read_recording`: the episodes by their number in the file, and the number of the file's rows; without their
    frames if `frames` is False.

    Where the values take more than `most_bytes`, stretches of rows are left out (`thinning.py`): episodes then have
    gaps, or are missing.
    """
    path = Path(path)

    def read(allow: Callable[[int], None]) -> tuple[dict[int, Episode], int]:
        with _opened(path) as file:
            for number in range(len(file)):
                if _group_name(number) not in file:
                    raise RecordingError(
                        f"{path}: {_group_name(number)} is missing; {len(file)} groups, numbered from 0, were expected"
                    )
            every = [_datasets(path, file, number, frames) for number in range(len(file))]
            starts = [0, *accumulate(each["time"].size for each in every)]
            size = sum(dataset.nbytes for each in every for dataset in each.values())
            allow(size)
            used = [kept(start, end, max(1, math.ceil(size / most_bytes))) for start, end in pairwise(starts)]
            episodes = {}
            for number, (datasets, rows) in enumerate(zip(every, used, strict=True)):
                if rows.any() or not rows.size:
                    where = f"{path}: {_group_name(number)}"
                    arrays = {name: _read_dataset(dataset, name, where, rows) for name, dataset in datasets.items()}
                    try:
                        episodes[number] = Episode(**arrays)
                    except ValueError as error:
                        raise RecordingError(f"{where}: {error}") from error
        _check_alike(path, [*episodes.values()])
        return episodes, starts[-1]

    return tried(path, read)


@contextmanager
def _opened(path: Path) -> Iterator[h5py.File]:
    if not path.is_file():
        raise RecordingError(f"{path}: there is no such file")
    try:
        with h5py.File(path, "r") as file:
            if not _is(file.attrs.get("format"), FORMAT):
                raise RecordingError(f"{path}: an HDF5 file, but its attribute 'format' is not {FORMAT!r}")
            version = file.attrs.get("version")
            if not any(_is(version, each) for each in READABLE):
                found = " ".join(str(version).split())[:30]
                raise RecordingError(
                    f"{path}: version {found} of the format; this visadapt reads versions 1 to {VERSION}"
                )
            yield file
    except RecordingError:
        raise
    except Exception as error:
        # HDF5's own messages describe its internals, may be several lines long, and are of many kinds.
        raise RecordingError(
            f"{path}: not a readable HDF5 file, or cut short or damaged; a recording written by visadapt is right"
        ) from error


def _is(value: object, wanted: str | int) -> bool:
    """Whether an attribute, which may have any type and shape, is `wanted`."""
    if isinstance(value, bytes):  # a string of fixed length, as other programs write
        value = value.decode(errors="replace")
    return isinstance(value, str if isinstance(wanted, str) else np.integer) and value == wanted


def _names(file: h5py.File, kind: str) -> list[str] | None:
    """The names of the columns of state or action, if the file has them."""
    if (found := file.attrs.get(f"{kind}_names")) is None:
        return None
    names = list(found) if isinstance(found, np.ndarray) and found.ndim == 1 else []
    if not names or not all(isinstance(name, str) for name in names) or len({*names}) < len(names):
        raise RecordingError(
            f"{file.filename}: its attribute '{kind}_names' is not a list of names, each different, of the columns"
        )
    return names


def _about(file: h5py.File, name: str, values: Any, episodes: int, present: Sequence[str]) -> str:
    """What the hash covers beside the values: their type and names, the number of episodes, the episode's datasets."""
    columns = _names(file, name) if name in ("state", "action") else None
    return f"{episodes} {sorted(present)} {name} {columns} {values.dtype.str} {values.shape}"


def _group_name(number: int) -> str:
    return f"episode_{number:05d}"


def _datasets(path: Path, file: h5py.File, number: int, frames: bool) -> dict[str, h5py.Dataset]:
    """The datasets of an episode to read; raises RecordingError where one is evidently damaged or in another file."""
    name = _group_name(number)
    where = f"{path}: {name}"
    _check_own(file, name, where)
    group = file[name]
    for needed in ("time", "action"):
        if needed not in group:
            raise RecordingError(f"{where} has no dataset {needed!r}")
    if "state" not in group and not frames:
        raise RecordingError(f"{where} holds frames alone; states are needed (or a renderer, by --renderer)")
    found = {}
    for name in DATASETS:
        if name in group and (frames or name != "frame"):
            _check_own(group, name, where)
            with _undamaged(name, where):
                dataset = found[name] = group[name]
                if dataset.is_virtual or dataset.external:
                    raise RecordingError(f"{where}: the values of {name!r} are in another file; its own are right")
                if dataset.nbytes > COMPRESSION * dataset.id.get_storage_size() or dataset.dtype.hasobject:
                    raise TypeError  # `_undamaged` says it in words
    return found


def _read_dataset(dataset: h5py.Dataset, name: str, where: str, rows: NDArray[np.bool_]) -> NDArray[Any]:
    """These rows of a dataset; all are read, a part at a time, since the checksum is of all."""
    file, used = dataset.file, []
    with _undamaged(name, where):
        about = _about(file, name, dataset, len(file), [*dataset.parent])
        found = hashlib.sha256(about.encode())
        for part, own in _parts(dataset, rows):
            found.update(part.tobytes())
            used.append(own)
        if file.attrs["version"] > 1 and dataset.attrs.get("sha256") != found.hexdigest():
            raise TypeError  # `_undamaged` says it in words
    return used[0] if len(used) == 1 else np.concatenate(used)


def _parts(dataset: h5py.Dataset, rows: NDArray[np.bool_]) -> Iterator[tuple[NDArray[Any], NDArray[Any]]]:
    """The values of a dataset, part by part, each with those of the rows used; in one part where all rows are used."""
    if rows.all():
        values = np.asarray(dataset[()])
        yield values, values
        return
    step = max(FRAMES_IN_CHUNK, len(rows) * PART_BYTES // dataset.nbytes)
    for start in range(0, len(dataset), step):
        values = dataset[start : start + step]
        yield values, values[rows[start : start + step]]


@contextmanager
def _undamaged(name: str, where: str) -> Iterator[None]:
    """Turn what HDF5 raises where something is no dataset, or cannot be read, into RecordingError."""
    try:
        yield
    except (OSError, TypeError, AttributeError) as error:  # a group has no values
        raise RecordingError(
            f"{where}: {name!r} is damaged, or no dataset, or was edited, and cannot be read"
        ) from error


def _check_own(group: h5py.Group, name: str, where: str) -> None:
    """Raises RecordingError where an item of a group is a link, which may lead out of the file."""
    if not isinstance(group.get(name, getlink=True), h5py.HardLink):
        raise RecordingError(f"{where}: {name!r} is a link to elsewhere; what it leads to belongs into the file itself")


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
