"""Writing files so that nothing half-written ever stands under its final name."""

from __future__ import annotations

import errno
import os
import shutil
import uuid
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

LITTLE = 2**18
"""Bytes free on a disk at which a writer that failed for reasons it did not tell is taken to have run out of room."""


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
        # Asked before the temporary, which may be what fills the disk, is gone.
        full = isinstance(error, Exception) and _is_full(error, final.parent)
        with suppress(OSError):
            temporary.unlink(missing_ok=True)
        if full:
            raise DiskFullError(f"{final} was not written: disk full; free some space and run again") from error
        raise


def _settle(path: Path) -> None:
    """Push the file to the disk, so that a full disk or a power cut shows before the old file is replaced."""
    with path.open("rb") as file:
        os.fsync(file.fileno())


def _is_full(error: BaseException, folder: Path) -> bool:
    """Whether the disk was full: some libraries chain the system's error, some quote it, and some hide it."""
    codes = {errno.ENOSPC, errno.EDQUOT}
    link: BaseException | None = error
    while link is not None:
        if isinstance(link, OSError) and link.errno in codes:
            return True
        if any(os.strerror(code) in str(link) for code in codes):
            return True
        link = link.__cause__ or link.__context__
    # torch.save says "unexpected pos", ffmpeg breaks its pipe.
    if isinstance(error, OSError | RuntimeError):
        with suppress(OSError):
            return shutil.disk_usage(folder).free < LITTLE
    return False
