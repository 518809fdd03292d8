"""Stretches of a recording's episodes, each as an episode of its own."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from visadapt.recordings.episode import FROM, Recording


def stretches_of(recording: Recording, stretches: Sequence[tuple[int, slice]], before: int) -> Recording:
    """The recording's `stretches`, the rows of an episode each, as episodes.

    Times still count from the start of the episode that a stretch is cut from. It is led by up to `before` earlier
    rows, marked as not usable: their commands are needed, since a late motor still acts on them.
    """
    rows = [len(episode.time) for episode in recording.episodes]
    every = recording.usable or [np.ones((own, len(recording.measured)), bool) for own in rows]
    episodes, sources, usable = [], [], []
    for number, own in stretches:
        episode, led = recording.episodes[number], slice(max(0, own.start - before), own.stop)
        whole = own == slice(0, rows[number])
        episodes.append(episode if whole else replace(episode.part(led), task_state=None))
        start = "" if whole else f"{FROM}{episode.time[own.start]:.1f} s"
        sources.append(f"{recording.sources[number]}{start}")
        usable.append(every[number][led] & (np.arange(led.start, led.stop) >= own.start)[:, None])
    return replace(recording, episodes=tuple(episodes), sources=tuple(sources), usable=tuple(usable))
