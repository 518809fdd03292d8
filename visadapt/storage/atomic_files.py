"""Atomic writing: a file appears under its name only once it is complete."""

from __future__ import annotations

import errno
import os
import shutil
import uuid
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

FULL_DISK_BYTES = 2**18
"""With fewer bytes free than this, a write that failed without naming its cause is taken to have filled the disk."""


class DiskFullError(OSError):
    """The disk has no room for a file; the message is one line that names it."""


@contextmanager
def replacing(path: str | os.PathLike[str]) -> Iterator[Path]:
    """Gives a temporary path beside `path` to write to; the file is renamed to `path` when the block ends.

        with replacing("film.mp4") as temporary:
            write_film(temporary, frames)

    The temporary file is hidden and keeps the suffix, since many writers choose a format by it. Missing folders are
    made. If the block raises or is interrupted, the temporary file is removed and a file at `path` stays as it was.

    Raises:
        DiskFullError: the disk, or the user's quota on it, is full.
        Exception: whatever else the block raised.
    """
    final = Path(path)
    temporary = final.with_name(f".{final.stem[:100]}.{uuid.uuid4().hex[:12]}{final.suffix}")
    try:
        final.parent.mkdir(parents=True, exist_ok=True)
        yield temporary
        # Onto the disk first, so that a full disk or a power cut cannot cost the old file.
        with temporary.open("rb") as file:
            os.fsync(file.fileno())
        temporary.replace(final)
    except BaseException as error:
        # Before the temporary file, which may be what fills the disk, is removed.
        full = isinstance(error, Exception) and _is_full(error, final.parent)
        with suppress(OSError):
            temporary.unlink(missing_ok=True)
        if full:
            raise DiskFullError(f"{final} was not written: disk full; free some space and run again") from error
        raise


def _is_full(error: BaseException, folder: Path) -> bool:
    """Whether the disk was full. Some libraries chain the system's error, some quote it, some report neither."""
    codes = {errno.ENOSPC, errno.EDQUOT}
    link: BaseException | None = error
    while link is not None:
        if getattr(link, "errno", None) in codes or any(os.strerror(code) in str(link) for code in codes):
            return True
        link = link.__cause__ or link.__context__
    # torch.save reports "unexpected pos", ffmpeg a broken pipe.
    if isinstance(error, OSError | RuntimeError):
        with suppress(OSError):
            return shutil.disk_usage(folder).free < FULL_DISK_BYTES
    return False
