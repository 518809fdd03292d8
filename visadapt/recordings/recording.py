"""A checked recording: episodes in the system's names and units, and warnings about what was changed."""

from __future__ import annotations

from dataclasses import dataclass

from visadapt.recordings.episode import Episode


@dataclass(frozen=True)
class Recording:
    """Episodes of states and actions. Every episode's clock is steady: its rows are one period apart.

    >>> import numpy as np, visadapt as va
    >>> episode = va.Episode(time=0.05 * np.arange(3), action=np.zeros((3, 1)), state=np.zeros((3, 2)))
    >>> va.Recording((episode,), measured=("x", "theta"), period=0.05, sources=("run.csv",)).samples
    2
    """

    episodes: tuple[Episode, ...]
    """`state` has the columns `measured`, `action` all actions of the system, in its order"""
    measured: tuple[str, ...]
    """names of the measured states, in the system's order"""
    period: float
    """s between rows: the median of the episodes'"""
    sources: tuple[str, ...]
    """where each episode comes from, for messages: "run3.csv, episode 2" """
    warnings: tuple[str, ...] = ()
    """what was changed or left out, a line each"""

    @property
    def samples(self) -> int:
        """Executed actions."""
        return sum(episode.samples for episode in self.episodes)
