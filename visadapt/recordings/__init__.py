"""Recordings: lists of episodes, and how they are kept on disk."""

from visadapt.recordings.episode import Episode, RecordingError
from visadapt.recordings.hdf5 import read_recording, write_recording

__all__ = ["Episode", "RecordingError", "read_recording", "write_recording"]
