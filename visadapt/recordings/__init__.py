"""Recordings: lists of episodes, and their files."""

from visadapt.recordings.episode import Episode, Recording, RecordingError
from visadapt.recordings.hdf5 import read_recording, write_recording
from visadapt.recordings.loading import load_recording

__all__ = ["Episode", "Recording", "RecordingError", "load_recording", "read_recording", "write_recording"]
