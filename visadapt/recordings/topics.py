"""Topics of a robot's own logs: bags of ROS 1 and 2, and PX4's ULog."""

from __future__ import annotations

import importlib
import io
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import redirect_stdout
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from visadapt.recordings.episode import RecordingError

MOST_NAMES = 40
"""Most names that a message lists."""
MOST_UNSTAMPED = 0.1
"""Share of a topic's messages whose header has no stamp up to which these are left out."""
SAME_CLOCK_S = 0.05
"""Median difference between the stamps in headers and the times of recording up to which both are of one clock."""
RECORDED = "its stamps are the times at which its messages were recorded"
"""The note on a topic whose messages have no stamps of their own."""
ULOG_HEADER = 3
"""Bytes of the header of a message of ULog: size and kind."""


@dataclass(frozen=True)
class Topic:
    """Some fields of a topic's messages."""

    time: NDArray[np.float64]
    """(N,) s"""
    values: Mapping[str, NDArray[np.float64]]
    """by field, (N,)"""
    notes: tuple[str, ...] = ()
    """what a reader must know of its stamps"""
    as_received: bool = False
    """whether its stamps are the times at which its messages were received and recorded"""


Read = Callable[[Path, Mapping[str, set[str]]], dict[str, Topic]]
"""(file, fields by topic) to the topics; raises RecordingError where one is not there."""


def reader(path: Path) -> Read | None:
    """What reads `path` if it is a log: a file .bag, a folder of ROS 2 or its file .mcap or .db3, or a file .ulg."""
    suffix = path.suffix.lower()
    if suffix == ".ulg":
        return _read_ulog
    if suffix in (".bag", ".mcap", ".db3") or (path / "metadata.yaml").is_file():
        return _read_bag
    return None


class _ULogFile(io.BufferedReader):
    """A log file that keeps pyulog from an endless loop. Where the last definition is cut short, pyulog reads the bytes
    that are left, then seeks back by the full size of the message, and so to its beginning or before it. Such a seek
    raises EOFError here."""

    def __init__(self, path: Path) -> None:
        super().__init__(io.FileIO(path))
        self._got = self._asked = 0

    def read(self, size: int | None = -1, /) -> bytes:
        data = super().read(size)
        self._got, self._asked = len(data), size or 0
        return data

    def seek(self, offset: int, whence: int = 0, /) -> int:
        if whence == 1 and self._got < self._asked and -offset >= ULOG_HEADER + self._got:
            raise EOFError("the last message is not whole")
        return super().seek(offset, whence)


def _read_ulog(path: Path, wanted: Mapping[str, set[str]]) -> dict[str, Topic]:
    """The second instance of a topic is NAME_1, and so on."""
    pyulog = _import(path, "pyulog")
    # It prints warnings about a log that a crash cut short.
    with redirect_stdout(io.StringIO()), _ULogFile(path) as file:
        log = pyulog.ULog(file)
    there = {f"{each.name}_{each.multi_id}" if each.multi_id else each.name: each.data for each in log.data_list}
    topics = {}
    for name, fields in wanted.items():
        _check(path, name, there)
        if unknown := fields - there[name].keys():
            raise RecordingError(f"{path}: {name} has no {min(unknown)!r}; it has {_some(there[name])}")
        values = {field: np.asarray(there[name][field], float) for field in fields}
        topics[name] = Topic(np.asarray(there[name]["timestamp"], float) / 1e6, values)
    return topics


def _read_bag(path: Path, wanted: Mapping[str, set[str]]) -> dict[str, Topic]:
    """Stamps are those of the messages' headers. Messages of a topic without them have the times at which they were
    recorded, and so have all topics, if that is another clock than the headers'."""
    highlevel, stores = _import(path, "rosbags.highlevel"), _import(path, "rosbags.typesys")
    fields = {name: sorted(each) for name, each in wanted.items()}
    rows: dict[str, list[list[float]]] = {name: [] for name in wanted}
    by_number = {name: [field for field in each if re.search(r"\[\d+\]", field)] for name, each in fields.items()}
    joints: dict[str, list[str]] = {}
    with highlevel.AnyReader([path], default_typestore=stores.get_typestore(stores.Stores.LATEST)) as bag:
        for name in wanted:
            _check(path, name, {each.topic for each in bag.connections})
        for connection, stamp, raw in bag.messages([each for each in bag.connections if each.topic in wanted]):
            name = connection.topic
            try:
                message = bag.deserialize(raw, connection.msgtype)
            except KeyError:
                raise RecordingError(
                    f"{path}: the bag does not define {connection.msgtype}, the type of {name}; a bag of ROS 2 "
                    "Iron or later, which stores definitions, or a standard type is right"
                ) from None
            if by_number[name]:
                _check_order(path, joints.setdefault(name, _joints(message)), message, name, by_number[name][0])
            numbers = [_number(path, message, name, field) for field in fields[name]]
            header = getattr(getattr(message, "header", None), "stamp", None)
            written = 0.0 if header is None else header.sec + 1e-9 * header.nanosec
            rows[name].append([1e-9 * stamp, written, *numbers])
    tables = {name: np.array(each).reshape(-1, 2 + len(fields[name])) for name, each in rows.items()}
    by_header = _stamped(tables)
    return {name: _topic(table, fields[name], name in by_header) for name, table in tables.items()}


def _stamped(tables: Mapping[str, NDArray[np.float64]]) -> set[str]:
    """The topics whose stamps are those in the headers, of tables (N, 2 + F): time of recording, stamp, fields."""
    having = {name: table[:, 1] > 0 for name, table in tables.items()}
    stamped = {name for name, own in having.items() if len(own) and own.mean() >= 1 - MOST_UNSTAMPED}
    late = [float(np.median(np.diff(tables[name][having[name], 1::-1]))) for name in stamped]
    # Stamps of two clocks must not meet in one recording.
    return stamped if len(stamped) == len(tables) or all(abs(each) < SAME_CLOCK_S for each in late) else set()


def _topic(table: NDArray[np.float64], fields: Sequence[str], by_header: bool) -> Topic:
    kept = table[:, 1] > 0 if by_header else np.ones(len(table), bool)
    notes = [] if by_header else [RECORDED]
    if not kept.all():
        notes.append(f"{(~kept).sum()} of its messages have no stamp: they are left out")
    values = dict(zip(fields, table[kept, 2:].T, strict=True))
    return Topic(table[kept, int(by_header)], values, tuple(notes), as_received=not by_header)


def _joints(message: Any) -> list[str]:
    """The joints that a message such as a JointState names, in the order of its numbers."""
    names = getattr(message, "name", None)
    return [str(each) for each in names] if isinstance(names, (list, tuple)) else []


def _check_order(path: Path, first: Sequence[str], message: Any, topic: str, field: str) -> None:
    """Raises RecordingError where a message names its joints in another order than the `first` one did: `field`, which
    says one by its number, is then not always the same."""
    if (joints := _joints(message)) != first:
        by_name = f"{field.partition('[')[0]}[{(first or joints)[0]}]"
        raise RecordingError(
            f"{path}: {topic} names the joints {_listed(first)}, later {_listed(joints)}: {field} is not always "
            f"the same; {by_name} is right, with the name of the joint"
        )


def _listed(joints: Sequence[str]) -> str:
    return ", ".join(joints) or "(none)"


def _number(path: Path, message: Any, topic: str, field: str) -> float:
    """The number in a field such as pose.position.x, position[0], or position[elbow], of a joint that is named."""
    value = message
    for part in re.findall(r"[^.\[\]]+|\[[^\[\]]+\]", field):
        try:
            if not part.startswith("["):
                value = getattr(value, part)
            elif (index := part[1:-1]).isdecimal():
                value = value[int(index)]
            elif index in (joints := _joints(message)):
                value = value[joints.index(index)]
            else:
                raise RecordingError(f"{path}: {topic} has no {field!r}: its message names {_listed(joints)}")
        except (AttributeError, IndexError, TypeError):
            if names := getattr(value, "__dataclass_fields__", None):
                there = f"are {_some(set(names) - {'__msgtype__'})}"
            elif hasattr(value, "__len__"):
                there = f"are {len(value)} values"
            else:
                there = f"is a {type(value).__name__}"
            raise RecordingError(f"{path}: {topic} has no {field!r}: at {part!r} there {there}") from None
    try:
        return float(value)
    except (TypeError, ValueError):
        raise RecordingError(f"{path}: {topic}.{field} is no number but a {type(value).__name__}") from None


def _check(path: Path, name: str, there: Iterable[str]) -> None:
    if name not in there:
        raise RecordingError(f"{path}: has no topic {name!r}; it has {_some(there)}")


def _some(names: Iterable[str]) -> str:
    names = sorted(names)
    more = f" and {len(names) - MOST_NAMES} more" if len(names) > MOST_NAMES else ""
    return ", ".join(names[:MOST_NAMES]) + more


def _import(path: Path, module: str) -> Any:
    try:
        return importlib.import_module(module)
    except ImportError as error:
        raise RecordingError(f"{path}: {error}; logs need pip install 'visadapt[logs]'") from None
