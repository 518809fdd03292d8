"""Thins a recording that is too long for memory, or for a diagnosis, to stretches of rows spread evenly over it."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from visadapt.recordings.episode import Recording
from visadapt.recordings.stretches import stretches_of

STRETCH = 5000  # Rows of a file that are kept or left out together


def thinned(used: int, total: int) -> str:
    """The warning of a file of which not all rows are used."""
    return f"{total:,} rows are more than can be held: {used:,} of them are used, in stretches spread evenly over it"


def kept(first: int, last: int, every: int) -> NDArray[np.bool_]:
    """Which rows of a file from `first` up to, but not including, `last` are used: one stretch of every `every`.

    >>> kept(4999, 5002, 2)
    array([ True, False, False])
    """
    return np.arange(first, last) // STRETCH % every == 0


def spread(recording: Recording, most: int, length: int, before: int) -> Recording:
    """A recording of at most about `most` usable rows: stretches of about `length`, spread evenly over it.

    Each stretch becomes an episode, led by up to `before` rows of which the commands alone are used (`stretches_of`).
    A warning says what is used.
    """
    rows = [len(episode.time) for episode in recording.episodes]
    if sum(rows) <= most:
        return recording
    stretches: list[tuple[int, slice]] = []
    for number, own in enumerate(rows):
        edges = np.linspace(0, own, -(-own // length) + 1).round().astype(int).tolist()
        stretches += [(number, slice(*pair)) for pair in pairwise(edges)]
    count = max(1, most * len(stretches) // sum(rows))
    chosen = [stretches[k] for k in np.linspace(0, len(stretches) - 1, count).round().astype(int)]
    used = sum(own.stop - own.start for _, own in chosen)
    told = (
        f"{sum(rows):,} rows are more than a diagnosis looks at: {used:,} of them were used, in {count} stretches "
        "spread evenly over the recording"
    )
    return replace(stretches_of(recording, chosen, before), warnings=(*recording.warnings, told))
