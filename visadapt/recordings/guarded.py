"""Reading that a damaged file cannot stop: HDF5 hangs, ends the process or asks for gigabytes on some of them."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import TypeVar

from visadapt.recordings.episode import RecordingError

Result = TypeVar("Result")

READING_S, READING_BYTES_PER_S = 5, 50e6
"""CPU time in s that opening any file may take, and bytes of its values, unpacked, for each second more."""
READING_BYTES, COPIES = 2**30, 8
"""Bytes of memory that opening any file may take, and how many times the bytes of its values in addition."""
MEMORY = Path("/proc/self/statm")
"""Pages of memory of this process, on Linux; the sixth number is that of its data."""


def tried(path: str | os.PathLike[str], read: Callable[[Callable[[int], None]], Result]) -> Result:
    """The result of `read`, tried first in a process of its own: a damaged file can make HDF5 hang, or end the process.

    `read` is given a function that it calls with the bytes that it is going to unpack: they take time and memory.

    Raises:
        RecordingError: that process was ended by either; or whatever `read` raises.
    """
    with _limited_memory() as allow_memory:
        if hasattr(os, "fork") and Path(path).is_file():
            import resource  # not on every system, as fork

            def allow(size: int) -> None:
                hard = resource.getrlimit(resource.RLIMIT_CPU)[1]
                resource.setrlimit(resource.RLIMIT_CPU, (READING_S + int(size / READING_BYTES_PER_S), hard))
                allow_memory(size)

            if (child := os.fork()) == 0:
                try:
                    allow(0)
                    with suppress(Exception):
                        read(allow)
                finally:
                    os._exit(0)
            if os.waitpid(child, 0)[1]:
                raise RecordingError(f"{path}: is damaged: to read it ends the process, or takes far too long")
        return read(allow_memory)


@contextmanager
def _limited_memory() -> Iterator[Callable[[int], None]]:
    """Limits how much more memory the process takes, since a damaged file can make HDF5 ask for gigabytes.

    Gives a function that allows for so many bytes of values. There is no limit on systems other than Linux.
    """
    if not MEMORY.exists():
        yield lambda size: None
        return
    import resource

    before = resource.getrlimit(resource.RLIMIT_DATA)
    used = int(MEMORY.read_text().split()[5]) * resource.getpagesize()

    def allow(size: int) -> None:
        most = used + READING_BYTES + COPIES * size
        resource.setrlimit(resource.RLIMIT_DATA, (most if before[0] < 0 else min(most, before[0]), before[1]))

    try:
        allow(0)
        yield allow
    finally:
        resource.setrlimit(resource.RLIMIT_DATA, before)
