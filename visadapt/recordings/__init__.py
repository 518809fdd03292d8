"""Recordings: lists of episodes, and their files."""

from visadapt.recordings.csv import write_csv
from visadapt.recordings.episode import Episode, RecordingError
from visadapt.recordings.hdf5 import read_recording, write_recording
from visadapt.recordings.loading import load_recording
from visadapt.recordings.recording import Recording

__all__ = [
    "Episode",
    "Recording",
    "RecordingError",
    "load_recording",
    "read_recording",
    "write_csv",
    "write_recording",
]
