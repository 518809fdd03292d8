"""Episodes, measurements and commands row by row, and the checked recording that is a list of them."""

from __future__ import annotations

from dataclasses import dataclass, field, fields, replace

import numpy as np
from numpy.typing import NDArray

EPISODE, FROM = ", episode ", ", from "
"""What stands behind a file in `Recording.sources` and in messages, before the number of an episode in it, and before
the time of a stretch of it."""


class RecordingError(ValueError):
    """A recording that cannot be used; the message is one line: which file and episode, and what would be right."""


class MisreadError(RecordingError):
    """A recording whose numbers are in another unit, sign, zero or order than their names say."""


@dataclass(frozen=True)
class Episode:
    """One uninterrupted run of T rows with states, frames, or both.

    Row t holds what was measured at t and the action commanded from t to t + 1; the action of the last row was
    not executed, so T rows are T - 1 samples.

    Raises:
        RecordingError: an array of another shape, type or number of rows, times that do not rise, or a value that is
            not finite.

    >>> import numpy as np, visadapt as va
    >>> episode = va.Episode(time=0.05 * np.arange(3), action=np.zeros((3, 1)), state=np.zeros((3, 4)))
    >>> episode.samples
    2
    """

    time: NDArray[np.floating]
    """(T,) s since the episode began"""
    action: NDArray[np.floating]
    """(T, n_action)"""
    state: NDArray[np.floating] | None = None
    """(T, n_state), SI units"""
    frame: NDArray[np.uint8] | None = None
    """(T, H, W)"""
    task_state: NDArray[np.floating] | None = None
    """(T, n_task_state) progress in its task, in the task's own numbers, from which policy learning can continue"""

    def __post_init__(self) -> None:
        if self.state is None and self.frame is None:
            raise RecordingError("an episode needs states or frames")
        rows = self.time.size
        for name, axes in (("time", 1), ("action", 2), ("state", 2), ("frame", 3), ("task_state", 2)):
            values = getattr(self, name)
            if values is None:
                continue
            if values.ndim != axes:
                shape = f"the shape {values.shape}"
                grey = " (grey levels, no colours)" if name == "frame" else ""
                raise RecordingError(f"{name} has {shape}; {axes} axes, of which time is the first, are right{grey}")
            if rows < 1:
                raise RecordingError("an episode needs at least one row")
            if len(values) != rows:
                raise RecordingError(f"an episode of {rows} rows has {len(values)} rows of {name}")
            kind, right = (np.uint8, "uint8") if name == "frame" else (np.floating, "floating point")
            if not np.issubdtype(values.dtype, kind):
                raise RecordingError(f"{name} is of type {values.dtype}; {right} is right")
            bad = ~np.isfinite(values.reshape(rows, -1)).all(1)
            if bad.any():
                raise RecordingError(
                    f"{name} is not finite in row {int(bad.argmax())} of {rows}; finite numbers are right (a cell "
                    "of a table may be empty)"
                )
        backwards = np.diff(self.time) <= 0
        if backwards.any():
            raise RecordingError(f"the clock does not run forward after row {int(backwards.argmax())}")

    @property
    def samples(self) -> int:
        """Executed actions: what the ledger counts."""
        return len(self.time) - 1

    def __repr__(self) -> str:
        """With the shapes of its arrays, of which a recording has thousands of numbers."""
        arrays = {each.name: getattr(self, each.name) for each in fields(self)}
        return (
            f"Episode({', '.join(f'{name} {values.shape}' for name, values in arrays.items() if values is not None)})"
        )

    def part(self, rows: slice) -> Episode:
        """Some of its rows; times still count from its start."""
        arrays = {each.name: getattr(self, each.name) for each in fields(self)}
        return replace(self, **{name: values[rows] for name, values in arrays.items() if values is not None})


@dataclass(frozen=True)
class Recording:
    """Episodes of states and actions, whose clocks may be unsteady: what counts is each row's `time`.

    Raises:
        RecordingError: no episode, or one whose states have other columns than `measured` says.

    >>> import numpy as np, visadapt as va
    >>> episode = va.Episode(time=0.05 * np.arange(3), action=np.zeros((3, 1)), state=np.zeros((3, 2)))
    >>> va.Recording((episode,), measured=("x", "theta"), period=0.05, sources=("run.csv",)).samples
    2
    """

    episodes: tuple[Episode, ...]
    """`state` has the columns `measured`, `action` all actions of the system, in its order"""
    measured: tuple[str, ...]
    """names of the measured states, in the system's order; none in a recording of frames"""
    period: float
    """s between rows, the median"""
    sources: tuple[str, ...]
    """where each episode comes from, for messages: "run3.csv, episode 2" """
    warnings: tuple[str, ...] = ()
    """what was changed or left out, a line each"""
    usable: tuple[NDArray[np.bool_], ...] = field(default=(), repr=False)
    """(T, n_measured) for each episode, which readings are measurements; without it, all are"""
    resolution: tuple[float, ...] = ()
    """smallest meaningful difference of each measured state; without it, the smallest between two of its readings"""
    command_period: float | None = None
    """median s between commands with stamps of their own, of which a row holds the mean until the next; None where they
    share those of readings, or one was sent but once"""

    def __post_init__(self) -> None:
        if not self.episodes:
            raise RecordingError("a recording needs at least one episode")
        names = ", ".join(self.measured)
        for number, episode in enumerate(self.episodes):
            if self.measured and (episode.state is None or episode.state.shape[1] != len(self.measured)):
                columns = "no states" if episode.state is None else f"{episode.state.shape[1]} columns of states"
                raise RecordingError(
                    f"episode {number} has {columns}; one for each of {names}, the measured ones, is right"
                )
        for number, (episode, usable) in enumerate(zip(self.episodes, self.usable, strict=bool(self.usable))):
            if usable.shape != (right := (len(episode.time), len(self.measured))):
                raise RecordingError(f"usable of episode {number} has the shape {usable.shape}; {right} is right")

    @property
    def samples(self) -> int:
        """Executed actions."""
        return sum(episode.samples for episode in self.episodes)


def file_of(source: str) -> str:
    """The file of one of `Recording.sources`.

    >>> file_of("runs.h5, episode 3, from 12.0 s")
    'runs.h5'
    """
    return source.partition(EPISODE)[0].partition(FROM)[0]
