"""Recordings from a robot's own logs: bags of ROS 1 and 2, and PX4's ULog.

The topics of a log have stamps of their own, a recording has rows. A row is one reading of the topic with states whose
messages are furthest apart. Readings of other topics are interpolated to its stamp, and its command is the mean of what
was commanded until the next row, each command being held until the next one. A topic that is much slower, as that of a
GPS receiver, has rows of its own instead, in which nothing else is measured.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from visadapt.recordings.clock import Note, RawEpisode
from visadapt.recordings.columns import Column, check_given, if_unmeasured, needed, read_column
from visadapt.recordings.command_clock import GAP, in_gaps, means_until_next
from visadapt.recordings.episode import RecordingError
from visadapt.recordings.topics import Read, Topic
from visadapt.systems import RigidBody, System
from visadapt.systems.rigid_body import ATTITUDE, continuous_quaternion

MOST_DISPLACED = 10
"""Places by which a message of a topic may come too early or too late, as a network delivers it, to be put in order."""

MUCH_SLOWER, SLOW = 4.0, 0.05
"""Interval between the messages of a topic that has rows of its own, over that of the fastest topic of states, and over
the system's prediction time, at least: rows at this interval would miss much of the motion."""

LEAST_KNOWN = 0.5
"""Share of the rows in which all numbers are known from which the others are left out: a column that has hardly any is
named instead."""

LEAST_STEADY = 20
"""Intervals between messages from which on a steady clock is told from one that is not."""

MOST_PROMPT = 0.99
"""Share of messages that are received within a period of the promptest, where a steady clock sent them."""

STEADY = "the clock's times are used"
"""What a note says of messages whose delays differ."""

STEADY_WITHIN_S = 1e-4
"""Difference between the delays of messages up to which their stamps are left as they are."""


def read_log(path: Path, read: Read, system: System, given: Mapping[str, str], note: Note) -> RawEpisode:
    """The rows of a log; `given` maps our names to TOPIC.FIELD.

    Raises:
        RecordingError: the log cannot be read, lacks a topic or a field, or its topics have no time in common.
    """
    ours = [*(state.name for state in system.states), *(action.name for action in system.actions)]
    check_given(given, ours, system)
    if missing := [name for name in needed(system) if name not in ("time", *given)]:
        raise RecordingError(
            f"{path}: say where {', '.join(missing)} are: --columns {missing[0]}=TOPIC.FIELD,... "
            f"(`ros2 bag info` and `ulog_info` list topics){if_unmeasured(system, missing[0])}"
        )
    named = {name: read_column(given[name]) for name in ours if given.get(name)}
    columns = {name: _topic_and_field(path, column.name) for name, column in named.items()}
    wanted: dict[str, set[str]] = {}
    for topic, field in columns.values():
        wanted.setdefault(topic, set()).add(field)
    topics = {name: _in_order(path, name, topic, note) for name, topic in _topics(path, read, wanted).items()}
    log = _Log(path, system, columns, named, topics)
    log.check_messages()
    log = log.with_steady_clocks(note)
    rows = log.rows(note)
    time = rows.time
    action = np.column_stack([log.command(one.name, time) for one in system.actions])
    states = np.column_stack([log.state(name, time) for name in log.measured])
    kept = _whole(np.column_stack([action, states]))
    if dropped := len(time) - int(kept.sum()):
        note(f"{dropped} rows in which a number is missing are left out", str(path))
    others = "".join(f"; {name} is interpolated to them" for name in log.together if name != log.slowest)
    apart = "".join(f"; {name}, which is slower, has rows of its own" for name in log.apart)
    note(f"rows are the readings of {log.slowest}{others}{apart}; a command is the mean until the next row", str(path))
    place = [f"message {index + 1} of {log.of_states[topic]}" for topic, index in rows.of[kept].tolist()]
    return RawEpisode(
        path,
        time[kept] - time[kept][0],
        action[kept],
        states[kept],
        log.measured,
        place.__getitem__,
        {name: ".".join(column) for name, column in columns.items()},
        given,
        usable=log.read_in(rows)[kept] if log.apart else None,
        command_period=log.command_period,
    )


def _topics(path: Path, read: Read, wanted: Mapping[str, set[str]]) -> dict[str, Topic]:
    try:
        return read(path, wanted)
    except RecordingError:
        raise
    except Exception as error:  # parsers raise anything on a damaged file, MemoryError on a wrong size
        reason = " ".join(str(error).split())[:200] or type(error).__name__
    # Raised here and not above, so that it does not hold on to the parser's error and what that has read.
    raise RecordingError(f"{path}: cannot be read as a log, is it cut short or damaged? {reason}")


@dataclass(frozen=True)
class _Rows:
    """The rows of a log."""

    time: NDArray[np.float64]  # (T,) s
    of: NDArray[np.intp]  # (T, 2) the topic, by its place in `_Log.of_states`, and the message that each row is


@dataclass(frozen=True)
class _Log:
    """The topics of a log that a system's states and actions come from."""

    path: Path
    system: System
    columns: Mapping[str, tuple[str, str]]
    """topic and field of each measured state and each action"""
    conversions: Mapping[str, Column]
    """of each of these to our units"""
    topics: Mapping[str, Topic]

    @cached_property
    def measured(self) -> tuple[str, ...]:
        """The states that were measured."""
        return tuple(state.name for state in self.system.states if state.name in self.columns)

    @cached_property
    def of_states(self) -> list[str]:
        """The topics of these, each once."""
        return list(dict.fromkeys(self.columns[name][0] for name in self.measured))

    @cached_property
    def of_actions(self) -> list[str]:
        """The topics of the actions, each once."""
        return list(dict.fromkeys(self.columns[action.name][0] for action in self.system.actions))

    @property
    def command_period(self) -> float | None:
        """Median s between the slowest commands; None where they have the stamps of readings, or one was sent once."""
        stamps = [np.unique(self.topics[name].time) for name in self.of_actions if name not in self.of_states]
        if len(stamps) < len(self.of_actions) or any(len(each) < 2 for each in stamps):
            return None
        return max(float(np.median(np.diff(each))) for each in stamps)

    @cached_property
    def apart(self) -> list[str]:
        """The topics of states that have rows of their own, since they are MUCH_SLOWER than the fastest, and SLOW."""
        fastest = min(self._interval(name) for name in self.of_states)
        shortest = max(MUCH_SLOWER * fastest, SLOW * self.system.prediction_time)
        return [name for name in self.of_states if self._interval(name) >= shortest]

    @cached_property
    def together(self) -> list[str]:
        """The other topics of states."""
        return [name for name in self.of_states if name not in self.apart]

    @cached_property
    def slowest(self) -> str:
        """The one of these whose messages are furthest apart, which gives the rows."""
        return max(self.together, key=self._interval)

    def _interval(self, name: str) -> float:
        """s between the messages of a topic, the median."""
        return float(np.median(np.diff(self.topics[name].time)))

    def check_messages(self) -> None:
        """Raises RecordingError where a topic has too few messages."""
        for name in {topic for topic, _ in self.columns.values()}:
            stamps = self.topics[name].time
            if not len(stamps):
                raise RecordingError(f"{self.path}: {name} has no messages")
            if len(stamps) < 2 and name in self.of_states:
                raise RecordingError(f"{self.path}: {name} has a single message; readings all along are right")

    def with_steady_clocks(self, note: Note) -> _Log:
        """With the stamps of a steady clock for messages that were sent by one and received a little later each."""
        topics = dict(self.topics)
        for name, topic in self.topics.items():
            if topic.as_received:
                topics[name], late = _as_sent(topic)
                if late:
                    note(
                        f"{name}: sent by a steady clock and received up to {late:.2g} s late: {STEADY}", str(self.path)
                    )
        return replace(self, topics=topics)

    def rows(self, note: Note) -> _Rows:
        """The messages of the topic that gives the rows where the others have a value, and those of slower topics."""
        topics = (*self.together, *self.of_actions)
        begins = {name: self.topics[name].time[0] for name in topics}
        ends = {name: self.topics[name].time[-1] for name in self.together}
        ends |= {name: _held_until(self.topics[name].time) for name in self.of_actions if name not in ends}
        last_to_begin, first_to_end = max(begins, key=begins.__getitem__), min(ends, key=ends.__getitem__)
        time = self.topics[self.slowest].time
        early, late = time < begins[last_to_begin], time > ends[first_to_end]
        used = ~early & ~late
        for name in self.together:
            if name != self.slowest:
                used &= _between_readings(time, self.topics[name].time)
        for name in self.of_actions:
            unknown = used & in_gaps(time, self.topics[name].time)
            if unknown.any():
                note(f"rows in gaps of the commands are left out: {int(unknown.sum())}", str(self.path))
            used &= ~unknown
        rows = np.flatnonzero(used)
        if len(rows) < 2:
            raise RecordingError(f"{self.path}: {', '.join(topics)} have no time in common")
        if early.any():
            note(f"rows before the first message of {last_to_begin} are left out: {early.sum()}", str(self.path))
        if late.any():
            note(f"rows after the last message of {first_to_end} are left out: {late.sum()}", str(self.path))
        return self._with_slower(rows)

    def _with_slower(self, rows: NDArray[np.intp]) -> _Rows:
        """These messages of the topic that gives the rows, and those between them of topics that are much slower."""
        time = self.topics[self.slowest].time[rows]
        parts, every = [(self.slowest, rows)], time
        for name in self.apart:
            stamps = self.topics[name].time
            known = self._known(name) & (stamps >= time[0]) & (stamps <= time[-1])
            for action in self.of_actions:
                known &= ~in_gaps(stamps, self.topics[action].time)
            if known.sum() < 2:
                raise RecordingError(f"{self.path}: {name} and {self.slowest} have no time in common")
            own = np.flatnonzero(known & ~np.isin(stamps, every))  # a row has the readings of all with its stamp
            parts.append((name, own))
            every = np.concatenate((every, stamps[own]))
        topic = np.concatenate([np.full_like(own, self.of_states.index(name)) for name, own in parts])
        of = np.column_stack((topic, np.concatenate([own for _, own in parts])))
        order = np.argsort(every, kind="stable")
        return _Rows(every[order], of[order])

    def _known(self, topic: str) -> NDArray[np.bool_]:
        """In which messages (N,) of a topic all of its measured states are finite."""
        names = [name for name in self.measured if self.columns[name][0] == topic]
        return np.isfinite(np.column_stack([self.values(name) for name in names]).sum(1))

    def read_in(self, rows: _Rows) -> NDArray[np.bool_]:
        """Which measured states are read in which rows (T, n_measured)."""
        by_topic = {
            name: np.isin(rows.time, self.topics[name].time[self._known(name)])
            if name in self.apart
            else rows.of[:, 0] == self.of_states.index(self.slowest)
            for name in self.of_states
        }
        return np.column_stack([by_topic[self.columns[name][0]] for name in self.measured])

    def state(self, name: str, time: NDArray[np.float64]) -> NDArray[np.float64]:
        """A measured state at these times (T,): as read then, or interpolated."""
        topic = self.columns[name][0]
        known = self._known(topic) if topic in self.apart else np.ones(len(self.topics[topic].time), bool)
        values = self.values(name)[known]
        attitude = self.system.states[ATTITUDE] if isinstance(self.system, RigidBody) else ()
        quaternion = [state.name for state in attitude]
        if name in quaternion:
            together = [each for each in quaternion if each in self.columns and self.columns[each][0] == topic]
            whole = np.column_stack([self.values(each)[known] for each in together])
            values = continuous_quaternion(torch.from_numpy(whole)).numpy()[:, together.index(name)]
        if self.system.states[self.system.index(name)].unit == "rad":
            values = np.unwrap(values)
        return np.interp(time, self.topics[topic].time[known], values)

    def command(self, name: str, time: NDArray[np.float64]) -> NDArray[np.floating]:
        """The command of an action in rows with these stamps (T,)."""
        return means_until_next(time, self.topics[self.columns[name][0]].time, self.values(name))

    def values(self, name: str) -> NDArray[np.float64]:
        """A measured state, or an action, in our units in every message (N,) of its topic."""
        topic, field = self.columns[name]
        return self.conversions[name].converted(self.topics[topic].values[field])


def _in_order(path: Path, name: str, topic: Topic, note: Note) -> Topic:
    """The topic with its messages in the order of their stamps, where they come almost in it; with its notes made.

    Raises:
        RecordingError: a message is more than MOST_DISPLACED places from its own.
    """
    for each in topic.notes:
        note(f"{name}: {each}", str(path))
    order = np.argsort(topic.time, kind="stable")
    displaced = np.abs(order - np.arange(len(order)))
    if not displaced.any():
        return topic
    if displaced.max() > MOST_DISPLACED:
        back = np.flatnonzero(np.diff(topic.time) < 0)[0]
        raise RecordingError(
            f"{path}: the clock of {name} runs backwards after its message {back + 1}; the log of one run, whose clock "
            "is never set back, is right"
        )
    note(f"{name}: {(displaced > 0).sum()} messages are put in the order of their stamps", str(path))
    return replace(topic, time=topic.time[order], values={key: values[order] for key, values in topic.values.items()})


def _as_sent(topic: Topic) -> tuple[Topic, float]:
    """A topic with the stamps of the steady clock by which its messages were sent, and by how many s the latest of them
    was received later than the promptest; as it is, and 0, where they were not. A delay of one message leaves the next
    one where it was; a loop that sleeps between messages delays all that follow."""
    steps = np.diff(topic.time)
    period = float(np.median(steps)) if len(steps) >= LEAST_STEADY else 0.0
    if period <= 0:
        return topic, 0.0
    number, index = np.concatenate(([0.0], np.cumsum(np.round(steps / period)))), np.arange(len(topic.time))
    # One that is late by more than half a period is not taken for the next.
    number = np.minimum.accumulate((number - index)[::-1])[::-1] + index
    slope, first = np.polyfit(number, topic.time - topic.time[0], 1)
    late = topic.time - topic.time[0] - (slope * number + first)
    sleeps = np.var(late) > np.var(steps - slope * np.diff(number))
    if sleeps or np.ptp(late) <= STEADY_WITHIN_S or np.quantile(late - late.min(), MOST_PROMPT) >= period:
        return topic, 0.0
    return replace(topic, time=topic.time - (late - late.min())), float(np.ptp(late))


def _whole(numbers: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Which rows (T, n) have all numbers; all rows, where most of those between the first and the last lack one."""
    known = np.isfinite(numbers.sum(1))
    within = known[known.argmax() : len(known) - known[::-1].argmax()]
    return known if known.any() and within.mean() >= LEAST_KNOWN else np.ones_like(known)


def _held_until(stamps: NDArray[np.float64]) -> float:
    """The time in s up to which a topic's last command holds: to the end where commands come only when they change,
    else for GAP intervals, since one that comes steadily has then been lost."""
    intervals = np.diff(stamps)
    if not len(intervals) or intervals.max() > GAP * np.median(intervals):
        return math.inf
    return float(stamps[-1] + GAP * np.median(intervals))


def _between_readings(time: NDArray[np.float64], stamps: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Whether each time (T,) lies between two readings that are not far apart."""
    after = np.searchsorted(stamps, time).clip(1, len(stamps) - 1)
    intervals = np.diff(stamps)
    return intervals[after - 1] <= GAP * np.median(intervals)


def _topic_and_field(path: Path, column: str) -> tuple[str, str]:
    topic, dot, field = column.partition(".")
    if not (topic and dot and field):
        raise RecordingError(f"{path}: the column {column!r} is not of the form TOPIC.FIELD, say /cart/state.position")
    return topic, field
