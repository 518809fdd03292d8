"""Writing files so that nothing half-written ever stands under its final name."""

from __future__ import annotations

import errno
import os
import uuid
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path


class DiskFullError(OSError):
    """The disk has no room for a file; the message is one line that names it."""


@contextmanager
def replacing(path: str | os.PathLike[str]) -> Iterator[Path]:
    """A temporary name beside `path` to write to; the file takes the name `path` once it is whole.

        with replacing("film.mp4") as temporary:
            write_film(temporary, frames)

    The temporary name is hidden and keeps the suffix, since many writers choose a format by it. Missing folders
    are made. Where the block raises, or is interrupted, the temporary is removed and what stood at `path` stays.

    Raises:
        DiskFullError: the disk, or the user's quota on it, is full.
        OSError: anything else that the writing raised.
    """
    final = Path(path)
    temporary = final.with_name(f".{final.stem[:100]}.{uuid.uuid4().hex[:12]}{final.suffix}")
    try:
        final.parent.mkdir(parents=True, exist_ok=True)
        yield temporary
        _settle(temporary)
        temporary.replace(final)
    except BaseException as error:
        with suppress(OSError):
            temporary.unlink(missing_ok=True)
        if isinstance(error, Exception) and _is_full(error):
            raise DiskFullError(f"{final} was not written: disk full; free some space and run again") from error
        raise


def _settle(path: Path) -> None:
    """Push the file to the disk, so that a full disk or a power cut shows before the old file is replaced."""
    with path.open("rb") as file:
        os.fsync(file.fileno())


def _is_full(error: BaseException | None) -> bool:
    """Whether the disk was full; libraries (h5py, ffmpeg, torch) may chain or only quote the system's error."""
    full = {errno.ENOSPC, errno.EDQUOT}
    while error is not None:
        if isinstance(error, OSError) and error.errno in full:
            return True
        if any(os.strerror(code) in str(error) for code in full):
            return True
        error = error.__cause__ or error.__context__
    return False
