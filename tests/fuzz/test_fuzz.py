"""Damaged files are read or refused in one line; `make fuzz` tries more of them, and keeps those that are not."""

import pytest

from tests.fuzz.inputs import CRASHES, again, counted
from tests.fuzz.readers import READERS


@pytest.mark.parametrize("name", READERS)
def test_damaged_files_are_read_or_refused_in_one_line(name):
    slow = name in ("hdf5", "frames")  # each file is read in a process of its own
    _, failed = counted(name, 0, range(20 if slow else 100))
    assert not failed, f"{failed[0].answer}\n{failed[0].content[:2000]!r}"


@pytest.mark.parametrize("path", sorted(CRASHES.glob("[a-z]*-*")), ids=lambda path: path.name)
def test_what_once_failed(path):
    assert not (found := again(path)).failed, found.answer
