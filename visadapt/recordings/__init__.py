"""Recordings: lists of episodes, and how they are kept on disk."""

from visadapt.recordings.episode import Episode

__all__ = ["Episode"]
