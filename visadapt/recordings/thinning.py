"""Of a recording that is too long to be held, or to be diagnosed: stretches of rows, spread evenly over it."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from visadapt.recordings.episode import Recording

STRETCH = 5000  # Rows of a file that are kept or left out together


def thinned(used: int, total: int) -> str:
    """The warning of a file of which not all rows are used."""
    return f"{total:,} rows are more than can be held: {used:,} of them are used, in stretches spread evenly over it"


def kept(first: int, last: int, every: int) -> NDArray[np.bool_]:
    """Which rows of a file from `first` up to, but not including, `last` are used, where every so many stretches are.

    >>> kept(4999, 5002, 2)
    array([ True, False, False])
    """
    return np.arange(first, last) // STRETCH % every == 0


def spread(recording: Recording, most: int, length: int) -> Recording:
    """A recording of about `most` rows at most: stretches of about `length` rows, spread evenly over it.

    A warning says so. Each stretch is an episode; its times still count from the start of its own.
    """
    rows = [len(episode.time) for episode in recording.episodes]
    if sum(rows) <= most:
        return recording
    stretches = [
        (number, int(start), int(end))
        for number, own in enumerate(rows)
        for start, end in _pairs(np.linspace(0, own, -(-own // length) + 1).round())
    ]
    count = max(1, int(most / sum(rows) * len(stretches)))
    chosen = [stretches[k] for k in np.linspace(0, len(stretches) - 1, count).round().astype(int)]
    used = sum(end - start for _, start, end in chosen)
    return replace(
        recording,
        episodes=tuple(recording.episodes[number].part(start, end) for number, start, end in chosen),
        sources=tuple(recording.sources[number] for number, _, _ in chosen),
        usable=tuple(recording.usable[number][start:end] for number, start, end in chosen) if recording.usable else (),
        warnings=(
            *recording.warnings,
            f"{sum(rows):,} rows are more than are looked at: {used:,} of them were, in {count} stretches spread evenly",
        ),
    )


def _pairs(edges: Iterable[float]) -> Iterator[tuple[float, float]]:
    edges = list(edges)
    return zip(edges, edges[1:], strict=False)
